//! A serial device behind the kernel's `ftdi_sio`, plugged and unplugged: the conditions for drivers of mirrors and
//! trigger boxes. The far end of the line is a port of the guest itself, so that a simulated controller can run in
//! the test.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod guest;

use std::fs::File;
use std::io::{Read, Write};
use std::path::Path;

use guest::{Monitor, wait_for};

const PIPE: &str = "serial";
const PORT: &str = "/dev/ttyUSB0";

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn a_serial_line_carries_bytes_and_survives_a_replug() {
    let mut monitor = Monitor::open();
    let mut far = File::options().read(true).write(true).open(format!("/dev/virtio-ports/{PIPE}")).unwrap();
    for _ in 0..2 {
        monitor.plug_serial(PIPE);
        let mut near = wait_for(PORT, || File::options().read(true).write(true).open(PORT).ok());
        let raw = std::process::Command::new("stty").args(["-F", PORT, "raw", "-echo", "3000000"]).status();
        assert!(raw.unwrap().success());
        let mut bytes = [0; 4];
        near.write_all(b"ping").unwrap();
        far.read_exact(&mut bytes).unwrap();
        assert_eq!(&bytes, b"ping");
        far.write_all(b"pong").unwrap();
        near.read_exact(&mut bytes).unwrap();
        assert_eq!(&bytes, b"pong");

        monitor.unplug_serial(PIPE);
        // A pending read ends with an error or as the end of the file, depending on what the kernel notices first.
        assert!(matches!(near.read(&mut bytes), Ok(0) | Err(_)));
        drop(near);
        wait_for("the port's end", || (!Path::new(PORT).exists()).then_some(()));
    }
}
