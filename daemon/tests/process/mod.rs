//! Processes that tests start. None outlives its test, however the test ends.

#![allow(dead_code, reason = "not every test needs all of it")]

use std::os::unix::process::CommandExt;
use std::process::{Child, ChildStdout, Command, ExitStatus};
use std::thread;
use std::time::{Duration, Instant};

use nix::sys::prctl::set_pdeathsig;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

/// A test that has not come so far after this time hangs; a busy machine takes a minute.
pub const HUNG: Duration = Duration::from_secs(600);

/// A process that is killed when it is dropped, or when the thread that started it ends in any other way.
pub struct Process(Child);

impl Process {
    #[allow(unsafe_code, reason = "only the child itself can ask for the signal, between fork and exec")]
    pub fn start(command: &mut Command) -> Self {
        // SAFETY: the closure makes one system call; it neither allocates nor takes a lock.
        let command = unsafe { command.pre_exec(|| Ok(set_pdeathsig(Signal::SIGKILL)?)) };
        Self(command.spawn().unwrap_or_else(|error| panic!("{:?}: {error}", command.get_program())))
    }

    /// As [`Self::start`], with the standard output that the command pipes.
    pub fn with_output(command: &mut Command) -> (Self, ChildStdout) {
        let mut process = Self::start(command);
        let output = process.0.stdout.take().unwrap();
        (process, output)
    }

    pub fn signal(&self, signal: Signal) {
        kill(Pid::from_raw(self.0.id().try_into().unwrap()), signal).unwrap();
    }

    pub fn has_ended(&mut self) -> bool {
        self.0.try_wait().unwrap().is_some()
    }

    pub fn wait(&mut self) -> ExitStatus {
        self.0.wait().unwrap()
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Waits until `look` returns a value.
pub fn wait_for<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let began = Instant::now();
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(began.elapsed() < HUNG, "{what}");
        thread::sleep(Duration::from_millis(10));
    }
}
