//! The serial port of a controller.

use std::io::{self, Read, Write};
use std::path::Path;
use std::thread;
use std::time::{Duration, Instant};

use nix::errno::Errno;
use raysweep_core::{DeviceError, DeviceErrorKind};
use serialport::{DataBits, FlowControl, Parity, SerialPort, StopBits, TTYPort};

use super::timeout::Timeout;
use super::wire::{Parsed, Receiver};

/// Maximum time for the port to accept bytes in one call: a feeding loop must return to reading.
const WRITE_WAIT: Duration = Duration::from_millis(5);
/// Sending a message fails if the port accepts no byte for this long.
const SEND_WAIT: Duration = Duration::from_millis(500);

/// A process that is ending, such as a guardian that has parked the mirror, gives its port back within this time.
const LOCK_WAIT: Duration = Duration::from_millis(500);
const LOCK_PACE: Duration = Duration::from_millis(10);

/// How long to wait for bytes between two looks at a timeout.
const LOOK_EVERY: Duration = Duration::from_millis(1);
/// The longest time between looks of a host that is not busy.
const LOOK: Duration = Duration::from_millis(2);

/// After this long without a reply, none is on its way: a line at 115,200 baud and a USB adapter's 16 ms are faster.
const SILENCE: Duration = Duration::from_millis(50);
/// A device that sends more unrequested replies than this never falls silent.
pub(crate) const MOST_STALE: usize = 16;

/// An open port in exclusive use, and the bytes received from it.
pub(crate) struct Port {
    device: &'static str,
    tty: TTYPort,
    name: String,
    received: Receiver,
}

/// What the crate says of a port that another program has opened.
fn is_locked(error: &serialport::Error) -> bool {
    error.kind() == serialport::ErrorKind::NoDevice
}

impl Port {
    /// Opens the port of a device, 8N1 without flow control; errors name the device.
    pub fn open(device: &'static str, path: &Path, baud: u32) -> Result<Self, DeviceError> {
        let name = path.display().to_string();
        let began = Instant::now();
        let opened = loop {
            let opened = serialport::new(&name, baud)
                .data_bits(DataBits::Eight)
                .parity(Parity::None)
                .stop_bits(StopBits::One)
                .flow_control(FlowControl::None)
                .timeout(WRITE_WAIT)
                .open_native();
            match &opened {
                Err(error) if is_locked(error) && began.elapsed() < LOCK_WAIT => thread::sleep(LOCK_PACE),
                _ => break opened,
            }
        };
        let tty = opened.map_err(|error| {
            let kind = match error.kind() {
                _ if is_locked(&error) => DeviceErrorKind::Busy,
                serialport::ErrorKind::Io(io::ErrorKind::PermissionDenied) => DeviceErrorKind::NotReady,
                // Missing, or a node whose device was pulled out (ENXIO, ENODEV, EIO).
                _ => DeviceErrorKind::Disconnected,
            };
            let what = format!(
                "cannot open {name}: {error}: check the cable, the rig file's port, and who else has it open"
            );
            DeviceError::new(device, kind, what)
        })?;
        Ok(Self { device, tty, name, received: Receiver::default() })
    }

    /// Writes what the port accepts now; returns the number of bytes.
    pub fn write_some(&mut self, bytes: &[u8]) -> Result<usize, DeviceError> {
        match self.tty.write(bytes) {
            Ok(written) => Ok(written),
            Err(error) if is_passing(&error) => Ok(0),
            Err(error) => Err(self.lost(&error)),
        }
    }

    /// Writes all bytes.
    pub fn send(&mut self, mut bytes: &[u8]) -> Result<(), DeviceError> {
        let patience = || Timeout::new(SEND_WAIT, 2 * WRITE_WAIT, Instant::now());
        let mut timeout = patience();
        while !bytes.is_empty() {
            let is_over = timeout.look(Instant::now());
            let written = self.write_some(bytes)?;
            bytes = &bytes[written..];
            if written > 0 {
                timeout = patience();
            } else if is_over {
                let what =
                    format!("{} takes no bytes: the controller hangs; switch it off and on", self.name);
                return Err(DeviceError::new(self.device, DeviceErrorKind::Timeout, what));
            }
        }
        Ok(())
    }

    /// Waits until bytes are available, for up to `timeout`; the caller reads its clock right afterwards.
    pub fn wait(&mut self, timeout: Duration) -> Result<(), DeviceError> {
        let mut buffer = [0; 64];
        self.tty.set_timeout(timeout).map_err(|error| self.lost(&error.into()))?;
        let read = self.tty.read(&mut buffer);
        self.tty.set_timeout(WRITE_WAIT).map_err(|error| self.lost(&error.into()))?;
        match read {
            Ok(0) => Err(self.lost(&io::ErrorKind::BrokenPipe.into())),
            Ok(read) => {
                self.received.push(&buffer[..read]);
                Ok(())
            }
            Err(error) if is_passing(&error) => Ok(()),
            Err(error) => Err(self.lost(&error)),
        }
    }

    /// The next received reply, without waiting.
    pub fn reply<R>(&mut self, parse: impl Fn(&[u8]) -> Parsed<R>) -> Result<Option<R>, DeviceError> {
        let mut buffer = [0; 1024];
        loop {
            let waiting = self.tty.bytes_to_read().map_err(|error| self.lost(&error.into()))?;
            if waiting == 0 {
                return Ok(self.received.next(&parse));
            }
            let wanted = buffer.len().min(waiting as usize);
            match self.tty.read(&mut buffer[..wanted]) {
                Ok(0) => return Err(self.lost(&io::ErrorKind::BrokenPipe.into())),
                Ok(read) => self.received.push(&buffer[..read]),
                Err(error) if is_passing(&error) => {}
                Err(error) => return Err(self.lost(&error)),
            }
            if let Some(reply) = self.received.next(&parse) {
                return Ok(Some(reply));
            }
        }
    }

    /// The next reply that `pick` accepts; `None` if there was none within `timeout`.
    pub fn await_reply<R, T>(
        &mut self,
        timeout: Duration,
        parse: impl Fn(&[u8]) -> Parsed<R>,
        mut pick: impl FnMut(R) -> Option<T>,
    ) -> Result<Option<T>, DeviceError> {
        let mut timeout = Timeout::new(timeout, LOOK, Instant::now());
        loop {
            let is_over = timeout.look(Instant::now());
            while let Some(reply) = self.reply(&parse)? {
                if let Some(picked) = pick(reply) {
                    return Ok(Some(picked));
                }
            }
            if is_over {
                return Ok(None);
            }
            self.wait(LOOK_EVERY)?;
        }
    }

    /// Reads replies until no more arrive: they answer earlier commands, perhaps of a process that was killed.
    pub fn await_silence<R>(&mut self, parse: impl Fn(&[u8]) -> Parsed<R>) -> Result<(), DeviceError> {
        for _ in 0..MOST_STALE {
            if self.await_reply(SILENCE, &parse, Some)?.is_none() {
                break;
            }
        }
        Ok(())
    }

    /// Number of received bytes that belonged to no reply.
    pub fn garbage_bytes(&self) -> u64 {
        self.received.garbage_bytes()
    }

    /// Sets the modem line RTS.
    pub fn set_rts(&mut self, on: bool) -> Result<(), DeviceError> {
        self.tty.write_request_to_send(on).map_err(|error| self.lost(&error.into()))
    }

    fn lost(&self, error: &io::Error) -> DeviceError {
        let what = format!("{}: {error}: the controller is gone; check its cable and its power", self.name);
        DeviceError::new(self.device, DeviceErrorKind::Disconnected, what)
    }
}

fn is_passing(error: &io::Error) -> bool {
    let again = error.raw_os_error() == Some(Errno::EAGAIN as i32);
    again
        || matches!(
            error.kind(),
            io::ErrorKind::TimedOut | io::ErrorKind::Interrupted | io::ErrorKind::WouldBlock
        )
}
