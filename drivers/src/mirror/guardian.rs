//! A process that outlives the one that drives a mirror, to park what a SIGKILL leaves.

use std::io::{self, Read};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};

use super::park::{ParkError, Parked, park};

/// Watches over this process as long as it lives. The guardian's input is a pipe whose other end only this process
/// holds, so it is closed whatever ends this process; the guardian then parks the mirror and ends.
pub struct Guardian {
    child: Child,
}

impl Guardian {
    /// Starts a guardian: `command` must call [`park_when_closed`] on its standard input, as
    /// `raysweep park --when-closed --state FILE` does. To be started before the mirror is opened and dropped after it.
    ///
    /// # Errors
    /// When the process cannot be started.
    pub fn start(mut command: Command) -> io::Result<Self> {
        // A group of its own: a Ctrl-C for the daemon must not end its guardian too.
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

/// The guardian's whole life: waits for `input` to be closed, then parks.
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
