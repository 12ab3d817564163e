//! The daemon as a child process, for the commands that need one.

use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Command};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use crate::run::{Done, run};

/// Generous, because a large simulated scene is rendered first; only a faulty start takes longer.
const START_TIMEOUT: Duration = Duration::from_secs(120);

const SOCKET: &str = "raysweepd.sock";

/// The daemon's process; stopped properly on success, and killed otherwise.
pub struct Daemon {
    process: Child,
    runtime: PathBuf,
}

impl Daemon {
    /// Starts the daemon from a folder of programs, and waits until it listens.
    pub fn start(programs: &Path, rig: &Path, data: &Path) -> Done<Self> {
        // Paths of sockets are limited to 108 bytes; checkout paths may be longer.
        static STARTED: AtomicU32 = AtomicU32::new(0);
        let number = STARTED.fetch_add(1, Ordering::Relaxed);
        let runtime = std::env::temp_dir().join(format!("raysweep-xtask-{}-{number}", std::process::id()));
        // Another process of this number may have left it.
        let _ = std::fs::remove_dir_all(&runtime);
        std::fs::create_dir_all(&runtime).map_err(|error| format!("{}: {error}", runtime.display()))?;
        let process = Command::new(programs.join("raysweepd"))
            // As its unit does.
            .env("MALLOC_ARENA_MAX", "1")
            .arg("--rig")
            .arg(rig)
            .arg("--socket")
            .arg(runtime.join(SOCKET))
            .arg("--data")
            .arg(data)
            .spawn()
            .map_err(|error| format!("cannot start raysweepd: {error}"))?;
        let mut daemon = Self { process, runtime };
        daemon.wait()?;
        Ok(daemon)
    }

    /// Path of the daemon's socket.
    pub fn socket(&self) -> PathBuf {
        self.runtime.join(SOCKET)
    }

    /// Process id.
    pub fn id(&self) -> u32 {
        self.process.id()
    }

    fn wait(&mut self) -> Done {
        let socket = self.socket();
        let began = Instant::now();
        while UnixStream::connect(&socket).is_err() {
            if let Ok(Some(status)) = self.process.try_wait() {
                return Err(format!("raysweepd ended with {status}; see its message above"));
            }
            if began.elapsed() > START_TIMEOUT {
                return Err(format!("raysweepd does not listen on {}", socket.display()));
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        Ok(())
    }

    /// Asks the daemon to terminate, as systemd does, and waits for its end.
    pub fn stop(mut self) -> Done {
        // The shell's built-in `kill`: a bare Debian has no other.
        run(Command::new("sh").args(["-c", &format!("kill -TERM {}", self.process.id())]))?;
        let status = self.process.wait().map_err(|error| format!("raysweepd: {error}"))?;
        if status.success() { Ok(()) } else { Err(format!("raysweepd ended with {status}")) }
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        // Both fail if the daemon has already terminated properly.
        let _ = self.process.kill();
        let _ = self.process.wait();
        let _ = std::fs::remove_dir_all(&self.runtime);
    }
}
