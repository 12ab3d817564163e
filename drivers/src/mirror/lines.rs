//! Controllers that answer each line with a line.

use std::fmt::Display;
use std::path::Path;
use std::time::Duration;

use raysweep_core::{DeviceError, DeviceErrorKind};

use super::error::{DEVICE, fault};
use crate::serial::port::Port;
use crate::serial::wire::Parsed;

/// The port of such a controller.
pub(super) struct LinePort<R> {
    port: Port,
    line_end: &'static str,
    parse: fn(&[u8]) -> Parsed<R>,
}

impl<R> LinePort<R> {
    /// Opens the port, completes a line that a cut-off write may have left, and discards the replies until then.
    pub fn open(
        path: &Path,
        baud: u32,
        line_end: &'static str,
        parse: fn(&[u8]) -> Parsed<R>,
    ) -> Result<Self, DeviceError> {
        let mut port = Port::open(DEVICE, path, baud)?;
        port.send(line_end.as_bytes())?;
        port.await_silence(parse)?;
        Ok(Self { port, line_end, parse })
    }

    /// Sends a command and waits for the reply.
    pub fn ask(&mut self, command: impl Display, wait: Duration) -> Result<R, DeviceError> {
        self.port.send(format!("{command}{}", self.line_end).as_bytes())?;
        self.port.await_reply(wait, self.parse, Some)?.ok_or_else(|| {
            let what = format!("no answer to \"{command}\": check the controller's power and cable");
            fault(DeviceErrorKind::Timeout, what)
        })
    }
}
