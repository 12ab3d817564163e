//! Tools for tests in the kernel guest: QEMU's monitor, and waiting.
//!
//! `crates/xtask/src/guest` starts the guest and names the devices of each test.

#![allow(dead_code, reason = "each test uses its part")]

use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

/// Emulation under load is slow; only something that never happens may fail a test. The guest allows a test 120 s.
pub const PATIENCE: Duration = Duration::from_secs(100);

/// QEMU's monitor. One may be open at a time.
pub struct Monitor {
    port: BufReader<File>,
    commands: u64,
}

impl Monitor {
    /// Opens the monitor.
    pub fn open() -> Self {
        let port = File::options().read(true).write(true).open("/dev/virtio-ports/qmp").unwrap();
        let mut monitor = Self { port: BufReader::new(port), commands: u64::from(std::process::id()) << 32 };
        // Refused if an earlier test already did this: QEMU sees one session for all tests.
        let _ = monitor.try_execute("qmp_capabilities", json!({}));
        monitor
    }

    /// Executes a QMP command; the test fails if QEMU refuses it.
    pub fn execute(&mut self, command: &str, arguments: Value) -> Value {
        self.try_execute(command, arguments).unwrap_or_else(|error| panic!("QMP {command}: {error}"))
    }

    fn try_execute(&mut self, command: &str, arguments: Value) -> Result<Value, Value> {
        self.commands += 1;
        let order = json!({ "execute": command, "arguments": arguments, "id": self.commands });
        self.port.get_mut().write_all(format!("{order}\n").as_bytes()).unwrap();
        loop {
            let mut line = String::new();
            self.port.read_line(&mut line).unwrap();
            // Greetings, events and answers to earlier tests lack this id.
            let mut answer: Value = serde_json::from_str(&line).unwrap();
            if answer["id"] == self.commands {
                return if answer["error"].is_null() {
                    Ok(answer["return"].take())
                } else {
                    Err(answer["error"].take())
                };
            }
        }
    }

    /// Plugs in a USB serial converter (the kernel's `ftdi_sio`) whose far end is `/dev/virtio-ports/{pipe}`.
    pub fn plug_serial(&mut self, pipe: &str) {
        let device = json!({ "driver": "usb-serial", "id": format!("{pipe}-usb"), "chardev": pipe });
        // A converter that was just unplugged may still hold the pipe for a moment.
        wait_for("QMP device_add", || self.try_execute("device_add", device.clone()).ok());
    }

    /// Unplugs the converter.
    pub fn unplug_serial(&mut self, pipe: &str) {
        self.execute("device_del", json!({ "id": format!("{pipe}-usb") }));
    }

    /// The content of the guest's screen, as a PPM file.
    pub fn screen_dump(&mut self, name: &str) -> PathBuf {
        // QEMU runs in the folder that the guest sees as /share.
        self.execute("screendump", json!({ "filename": name }));
        Path::new("/share").join(name)
    }
}

/// Waits until `probe` returns a value.
pub fn wait_for<T>(what: &str, mut probe: impl FnMut() -> Option<T>) -> T {
    let began = Instant::now();
    loop {
        if let Some(found) = probe() {
            return found;
        }
        assert!(began.elapsed() < PATIENCE, "{what}: not within {PATIENCE:?}");
        std::thread::sleep(Duration::from_millis(10));
    }
}
