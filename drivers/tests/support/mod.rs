//! Cameras that others wrote, each on a network of its own.

#![allow(
    dead_code,
    clippy::unwrap_used,
    clippy::expect_used,
    reason = "not every test needs all of it, and one that cannot go on may panic"
)]

use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::Duration;

use nix::sched::{CloneFlags, unshare};

/// Puts the calling thread, and what it starts from now on, on a network of its own: the loopback and nothing else. GigE Vision
/// has one port for all cameras, and discovery asks on every interface that it finds.
pub fn own_network() {
    unshare(CloneFlags::CLONE_NEWNET)
        .expect("a network namespace needs root: run `cargo xtask test` as root");
    let done = Command::new("ip").args(["link", "set", "lo", "up"]).status().expect("iproute2 is installed");
    assert!(done.success());
}

/// The address of the only camera of a test.
pub const ADDRESS: &str = "127.0.0.1";

/// `arv-fake-gv-camera-0.8`, ended with the test.
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
        // It has no way to say that it is there.
        thread::sleep(Duration::from_millis(200));
        Self(child)
    }
}

impl FakeCamera {
    /// Stops it as if its cable were pulled, or lets it go on.
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
