//! A simulated GigE camera with its bench, in a network of its own.

#![allow(dead_code, reason = "not every test needs all of it")]

use std::fs;
use std::path::PathBuf;
use std::process::{Command, Stdio};

use nix::sched::{CloneFlags, unshare};
use raysweep_sim::bench::BenchProbe;
use tempfile::TempDir;

use crate::process::{Process, wait_for};

/// A camera on the wire, with the network that it is on.
pub struct WireRig {
    folder: TempDir,
    _camera: Process,
}

impl WireRig {
    /// In a network namespace of its own, whose packets have at most `mtu` bytes.
    pub fn start(rig: &str, faults: &[&str], mtu: u32) -> Self {
        unshare(CloneFlags::CLONE_NEWNET).expect("a network namespace needs root");
        let link = ["link", "set", "lo", "up", "mtu", &mtu.to_string()].map(str::to_owned);
        assert!(Command::new("ip").args(link).status().unwrap().success());
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("rig.toml"), rig).unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep-sim-camera"));
        command.arg("--rig").arg(folder.path().join("rig.toml"));
        command.args(faults.iter().flat_map(|fault| ["--fault", fault]));
        let camera = Process::start(command.stdout(Stdio::null()).stderr(Stdio::null()));
        let bench = folder.path().join("bench.sock");
        wait_for("the camera does not start", || BenchProbe::open(&bench).ok());
        Self { folder, _camera: camera }
    }

    /// A file beside the rig file.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }
}
