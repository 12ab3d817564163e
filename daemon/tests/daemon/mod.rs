//! The real daemon in a separate process, its clients and the ledgers that it writes.

#![allow(dead_code, reason = "not every test needs all of it")]

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use raysweep_proto::{Client, Event, RunParams};

use crate::process::{HUNG, Process, wait_for};

/// A daemon on the rig, and with the sessions, of a folder.
pub struct Daemon {
    pub process: Process,
    pub socket: PathBuf,
}

impl Daemon {
    pub fn start(folder: &Path) -> Self {
        Self::start_with_threads(folder, 2)
    }

    /// Simulator, stages and solver all take their number of threads from rayon's environment variable.
    pub fn start_with_threads(folder: &Path, threads: u32) -> Self {
        let socket = folder.join("socket");
        let mut command = Command::new(env!("CARGO_BIN_EXE_raysweepd"));
        command
            .arg("--rig")
            .arg(folder.join("rig.toml"))
            .arg("--socket")
            .arg(&socket)
            .arg("--data")
            .arg(folder.join("sessions"))
            .env("RAYON_NUM_THREADS", threads.to_string())
            // Without video encoders, as where its sessions are processed.
            .env("PATH", "/nonexistent")
            .stderr(Stdio::null());
        let process = Process::start(&mut command);
        Self { process, socket }
    }

    pub fn client(&mut self) -> Client {
        wait_for("the daemon does not listen", || {
            assert!(!self.process.has_ended(), "the daemon has ended");
            Client::connect(&self.socket).ok()
        })
    }

    pub fn kill(self) {
        drop(self);
    }

    pub fn terminate(&self) {
        self.process.signal(Signal::SIGTERM);
    }
}

pub fn plan(text: &str) -> RunParams {
    RunParams { plan: text.into(), ..RunParams::default() }
}

/// Starts a run and waits for its end.
pub fn end(daemon: &mut Daemon, begin: impl FnOnce(&mut Client)) -> (PathBuf, String) {
    let events = daemon.client().subscribe().unwrap();
    begin(&mut daemon.client());
    for event in events {
        if let Event::Finished { session, state, .. } = event.unwrap() {
            return (session, state);
        }
    }
    panic!("the daemon ended before the run");
}

/// Waits until the ledger has a given number of lines.
pub fn wait_for_line(session: &Path, line: usize) {
    let began = Instant::now();
    while ledger_lines(session) < line {
        let lines = ledger_lines(session);
        assert!(began.elapsed() < HUNG, "{lines} lines, not {line}");
        std::thread::sleep(Duration::from_micros(200));
    }
}

pub fn ledger_lines(session: &Path) -> usize {
    std::fs::read_to_string(session.join("ledger.jsonl")).unwrap().lines().count()
}
