//! A separate process that parks the mirror if the driving process is killed, even by SIGKILL.

use std::io::{self, Read};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use super::park::{ParkError, Parked, park};

/// Guards this process for as long as it lives. The guardian's input is a pipe whose other end only this process
/// holds, so it closes however this process ends. The guardian then parks the mirror and exits.
pub struct Guardian {
    child: Child,
}

impl Guardian {
    /// Starts a guardian: `command` must call [`park_when_closed`] on its standard input, as
    /// `raysweep park --when-closed --state FILE` does. Start it before the mirror is opened and drop it afterwards.
    ///
    /// # Errors
    /// If the process cannot be started.
    pub fn start(mut command: Command) -> io::Result<Self> {
        // Own process group: a Ctrl-C for the daemon must not end its guardian.
        let child = command.stdin(Stdio::piped()).process_group(0).spawn()?;
        Ok(Self { child })
    }
}

impl Drop for Guardian {
    fn drop(&mut self) {
        drop(self.child.stdin.take());
        if let Err(error) = self.child.wait() {
            tracing::warn!(%error, "the mirror's guardian did not end");
        }
    }
}

/// Main function of the guardian: waits until `input` is closed, then parks.
///
/// # Errors
/// As [`park()`].
pub fn park_when_closed(mut input: impl Read, state: &Path) -> Result<Parked, ParkError> {
    let mut ignored = [0; 64];
    loop {
        match input.read(&mut ignored) {
            Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
            Ok(0) | Err(_) => return park(state),
            Ok(_) => {}
        }
    }
}
