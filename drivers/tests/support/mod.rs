//! Third-party simulated cameras, each on its own network.

#![allow(
    dead_code,
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "not every test needs all of it, and one that cannot go on may panic"
)]

#[path = "../suite/hung.rs"]
mod hung;

use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};
use std::{fs, thread};

use hung::HUNG;
use nix::sched::{CloneFlags, unshare};

/// Moves the calling thread, and all threads and processes that it starts later, to a network of its own with only
/// the loopback interface. GigE Vision uses one port for all cameras, and discovery searches all interfaces.
pub fn own_network() {
    unshare(CloneFlags::CLONE_NEWNET)
        .expect("a network namespace needs root: run `cargo xtask test` as root");
    let done = Command::new("ip").args(["link", "set", "lo", "up"]).status().expect("iproute2 is installed");
    assert!(done.success());
}

/// The address of a test's only camera.
pub const ADDRESS: &str = "127.0.0.1";

/// `arv-fake-gv-camera-0.8`, terminated at the end of the test.
pub struct FakeCamera(Child);

impl FakeCamera {
    pub fn start(arguments: &[&str]) -> Self {
        let child = Command::new("arv-fake-gv-camera-0.8")
            .args(["-i", ADDRESS, "-s", "TEST"])
            .args(arguments)
            .stdout(Stdio::null())
            .stderr(Stdio::null())
            .spawn()
            .expect("aravis-tools is installed");
        // It does not report when it is ready: when port 3956 is open at its own address and for searches.
        let began = Instant::now();
        while fs::read_to_string("/proc/thread-self/net/udp").unwrap().matches(":0F74 ").count() < 2 {
            assert!(began.elapsed() < HUNG, "the camera does not listen");
            thread::sleep(Duration::from_millis(5));
        }
        Self(child)
    }
}

impl FakeCamera {
    /// Stops it, as if its cable were unplugged, or continues it.
    pub fn signal(&self, signal: nix::sys::signal::Signal) {
        let id = nix::unistd::Pid::from_raw(self.0.id().try_into().unwrap());
        nix::sys::signal::kill(id, signal).unwrap();
    }
}

impl Drop for FakeCamera {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}
