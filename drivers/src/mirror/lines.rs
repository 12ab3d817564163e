//! Controllers that answer each line with a line.

use std::fmt::{Debug, Display};
use std::path::Path;
use std::time::Duration;

use raysweep_core::{DeviceError, DeviceErrorKind};

use super::error::{DEVICE, fault};
use crate::serial::port::{MOST_STALE, Port};
use crate::serial::wire::Parsed;

/// The port of such a controller.
pub(super) struct LinePort<R> {
    port: Port,
    line_end: &'static str,
    parse: fn(&[u8]) -> Parsed<R>,
}

impl<R: Debug> LinePort<R> {
    /// Opens the port, completes a line that a cut-off write may have left, and discards the replies until then. A busy
    /// host may bring them later, see [`greet`](Self::greet).
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

    /// Asks until a reply is of the kind that the last command gets, discards what still comes, and returns all replies;
    /// those before the last, which a busy host may bring late, answer what another program left on the line.
    pub fn greet(
        &mut self,
        commands: &[&str],
        wait: Duration,
        is_last: impl Fn(&R) -> bool,
    ) -> Result<Vec<R>, DeviceError> {
        let mut replies = Vec::new();
        for command in commands {
            replies.push(self.ask(command, wait)?);
        }
        while !replies.last().is_some_and(&is_last) {
            let next = match replies.len() {
                ..MOST_STALE => self.port.await_reply(wait, self.parse, Some)?,
                _ => None,
            };
            let Some(next) = next else {
                let what = format!(
                    "the controller answers {replies:?} to {commands:?}: check that the rig file names its port and kind"
                );
                return Err(fault(DeviceErrorKind::Protocol, what));
            };
            replies.push(next);
        }
        // The program that was killed may have asked the same.
        self.port.await_silence(self.parse)?;
        Ok(replies)
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

#[cfg(test)]
mod tests {
    use raysweep_sim::mirror::{Pty, SerialLink, WireFaults};

    use super::*;
    use crate::serial::wire::parse_line;

    const LATE_NS: i64 = 120_000_000;

    /// A controller that repeats each line in its answer, `?` for one that it does not know, and whose answers are late.
    fn late_device() -> Pty {
        let (mut line, mut due) = (Vec::new(), Vec::<(i64, String)>::new());
        let run = move |bytes: &[u8], now_ns: i64, replies: &mut Vec<u8>| {
            for &byte in bytes {
                match byte {
                    b'\n' => {
                        let text = String::from_utf8(std::mem::take(&mut line)).unwrap();
                        due.push((now_ns + LATE_NS, if text.is_empty() { "?".into() } else { text }));
                    }
                    byte => line.push(byte),
                }
            }
            due.retain(|(at_ns, text)| {
                let is_due = *at_ns <= now_ns;
                if is_due {
                    replies.extend(format!("{text}\n").bytes());
                }
                !is_due
            });
        };
        Pty::plug(Box::new(run), SerialLink::VirtualCom, WireFaults::default()).unwrap()
    }

    fn parse(bytes: &[u8]) -> Parsed<String> {
        parse_line(bytes, |text| Ok(text.to_owned()))
    }

    #[test]
    fn a_late_answer_to_what_another_program_left_is_not_taken_for_that_to_a_command() {
        let wait = Duration::from_secs(5);
        for left in ["", "hel"] {
            let device = late_device();
            let mut other = Port::open(DEVICE, device.path(), 9600).unwrap();
            other.send(left.as_bytes()).unwrap();
            drop(other);
            let mut port = LinePort::open(device.path(), 9600, "\n", parse).unwrap();
            port.greet(&["$", "hello"], wait, |reply| reply == "hello").unwrap();
            for command in ["a", "b"] {
                assert_eq!(port.ask(command, wait).unwrap(), command, "after {left:?}");
            }
        }
    }

    #[test]
    fn a_device_that_answers_otherwise_is_named_with_its_answers() {
        let device = late_device();
        let mut port = LinePort::open(device.path(), 9600, "\n", parse).unwrap();
        let error = port.greet(&["hello"], Duration::from_millis(500), |_| false).unwrap_err();
        assert_eq!(error.kind, DeviceErrorKind::Protocol);
        assert!(error.to_string().contains(r#"["?", "hello"] to ["hello"]"#), "{error}");
    }
}
