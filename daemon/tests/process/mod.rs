//! Processes that tests start. None outlives its test, however the test ends.

use std::os::unix::process::CommandExt;
use std::process::{Child, Command, ExitStatus};

use nix::sys::prctl::set_pdeathsig;
use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;

/// A process that is killed when it is dropped, or when the thread that started it ends in any other way.
pub struct Process(Child);

impl Process {
    #[allow(unsafe_code, reason = "only the child itself can ask for the signal, between fork and exec")]
    pub fn start(command: &mut Command) -> Self {
        // SAFETY: the closure makes one system call; it neither allocates nor takes a lock.
        let command = unsafe { command.pre_exec(|| Ok(set_pdeathsig(Signal::SIGKILL)?)) };
        Self(command.spawn().unwrap_or_else(|error| panic!("{:?}: {error}", command.get_program())))
    }
}

#[allow(dead_code, reason = "not every test needs all of it")]
impl Process {
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
