//! The command line beside a daemon, each its own process.

#![allow(dead_code, reason = "not every test needs all of it")]

use std::process::{Command, Output};

use tempfile::TempDir;

use crate::daemon::Daemon;

/// The command line in the folder of a daemon of its own.
pub struct Program {
    pub folder: TempDir,
    daemon: Daemon,
}

impl Program {
    pub fn start(rig: &str) -> Self {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("rig.toml"), rig).unwrap();
        let mut daemon = Daemon::start(folder.path());
        daemon.client();
        Self { folder, daemon }
    }

    pub fn client(&mut self) -> raysweep_proto::Client {
        self.daemon.client()
    }

    pub fn command(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
        command.current_dir(&self.folder).args(["--socket", "socket"]).args(arguments);
        command
    }

    pub fn raysweep(&self, arguments: &[&str]) -> Output {
        self.command(arguments).output().unwrap()
    }

    /// Writes `plan.toml`.
    pub fn plan(&self, text: &str) {
        std::fs::write(self.folder.path().join("plan.toml"), text).unwrap();
    }
}
