//! Mirrorcle's MTI controllers in their ASCII mode: one line per command, answered by `MTI-OK` or `MTI-ERR ...`.

use std::fmt;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::Duration;

pub use raysweep_config::rig::dots::MtiDrive;
use raysweep_core::{DeviceError, DeviceErrorKind, MechanicalDeg, MirrorLimits, MirrorPoint, Tilt};

use super::error::fault;
use super::light::LightGuard;
use super::lines::LinePort;
use super::points::{self, PointController, PointMirror};
use super::state::{MirrorState, Reach, Sent, StateFile};
use crate::serial::wire::{Parsed, parse_line};

const BAUD: u32 = 115_200;
/// A controller answers within milliseconds; the rest is for the kernel's workers of a busy host, see [`Timeout`].
///
/// [`Timeout`]: crate::serial::timeout::Timeout
const REPLY_WAIT: Duration = Duration::from_secs(1);
/// Maximum wait for switching the high voltage.
const ENABLE_WAIT: Duration = Duration::from_secs(2);

/// # Errors
/// The first value of a drive beyond `most` or beyond what the controller takes.
pub(super) fn check(drive: &MtiDrive, most: &MtiDrive) -> Result<(), DeviceError> {
    let rules = [
        ("bias_v", drive.bias_v, 0, most.bias_v.min(100)),
        ("difference_v", drive.difference_v, 0, most.difference_v.min(200)),
        ("bandwidth_hz", drive.bandwidth_hz, 50, most.bandwidth_hz.min(15_000)),
    ];
    for (field, value, low, high) in rules {
        if !(low..=high).contains(&value) {
            let what = format!("{field} = {value}: this mirror takes {low} to {high}");
            return Err(fault(DeviceErrorKind::OutOfRange, what));
        }
    }
    Ok(())
}

/// Configuration of an MTI controller and its mirror.
#[derive(Debug, Clone, PartialEq)]
pub struct MtiConfig {
    /// Its serial port.
    pub port: PathBuf,
    /// The drive settings.
    pub drive: MtiDrive,
    /// The mirror's maximum drive, from its data sheet.
    pub most: MtiDrive,
    /// Tilt of the mirror at the controller's full scale, with this drive.
    pub full_scale: MechanicalDeg,
    /// Limits of the mirror.
    pub limits: MirrorLimits,
    /// File for the state that must survive a crash.
    pub state: PathBuf,
    /// Permission for light.
    pub light: LightGuard,
}

/// A command to the controller.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum MtiCommand {
    /// Enters the command mode.
    Enter,
    /// Sets the bias in volts; only while the high voltage is off.
    Bias(u32),
    /// Sets the maximum voltage difference; only while the high voltage is off.
    Difference(u32),
    /// Sets the bandwidth in hertz; only while the high voltage is off.
    Bandwidth(u32),
    /// Switches the high voltage on.
    Enable,
    /// Switches the high voltage off.
    Disable,
    /// Goes to a position, -1..=1 of full scale, with light 0..=255.
    GoTo {
        /// Fraction of full scale.
        x: f64,
        /// Fraction of full scale.
        y: f64,
        /// 0: off, 255: full.
        light: u8,
    },
    /// Switches on answers to commands.
    Echo,
    /// Leaves the command mode.
    Exit,
}

/// The line of the command, without its end.
impl fmt::Display for MtiCommand {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Enter => write!(f, "$MTI$"),
            Self::Bias(volts) => write!(f, "MTI+VB {volts}"),
            Self::Difference(volts) => write!(f, "MTI+VD {volts}"),
            Self::Bandwidth(hz) => write!(f, "MTI+BW {hz}"),
            Self::Enable => write!(f, "MTI+EN"),
            Self::Disable => write!(f, "MTI+DI"),
            Self::GoTo { x, y, light } => write!(f, "MTI+GT {x:.5} {y:.5} {light}"),
            Self::Echo => write!(f, "MTI+EC"),
            Self::Exit => write!(f, "MTI+EX"),
        }
    }
}

/// A reply from the controller.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum MtiReply {
    /// The command was executed.
    Done,
    /// The command was refused, with the reason.
    Refused(String),
    /// The device's description, on entering or leaving the command mode.
    Device(String),
}

/// Parses the reply at the start of `bytes`.
pub fn parse_mti(bytes: &[u8]) -> Parsed<MtiReply> {
    parse_line(bytes, |text| match text.split_at_checked(4) {
        Some(("MTI-", "OK")) => Ok(MtiReply::Done),
        Some(("MTI-", said)) if said.starts_with("ERR") => Ok(MtiReply::Refused(said[3..].trim().to_owned())),
        Some(("MTI-", said)) if said.starts_with("Device ") => Ok(MtiReply::Device(said[7..].to_owned())),
        _ => Err(text.get(1..).and_then(|rest| rest.find("MTI-")).map(|at| at + 1)),
    })
}

/// An MTI controller in its command mode.
pub struct MtiLine {
    port: LinePort<MtiReply>,
    full_scale: MechanicalDeg,
}

impl MtiLine {
    fn tell(&mut self, command: MtiCommand, wait: Duration) -> Result<(), DeviceError> {
        match self.port.ask(command, wait)? {
            MtiReply::Refused(why) => {
                Err(fault(DeviceErrorKind::Protocol, format!("the controller refuses \"{command}\": {why}")))
            }
            MtiReply::Done | MtiReply::Device(_) => Ok(()),
        }
    }

    /// Asks the controller at this port what it is. Its high voltage stays as it is.
    pub(super) fn greet(port: &Path) -> Result<String, DeviceError> {
        let (mut line, model) = Self::enter(port, MechanicalDeg(1.0))?;
        line.tell(MtiCommand::Exit, REPLY_WAIT)?;
        Ok(model)
    }

    /// Enters the command mode, or detects that the controller is already in it.
    fn enter(port: &Path, full_scale: MechanicalDeg) -> Result<(Self, String), DeviceError> {
        use MtiReply::{Device, Done, Refused};
        let mut port = LinePort::open(port, BAUD, "\n", parse_mti)?;
        let [enter, echo] = [MtiCommand::Enter, MtiCommand::Echo].map(|command| command.to_string());
        let replies = port.greet(&[&enter, &echo], REPLY_WAIT, |reply| *reply == Done)?;
        // An earlier one is what another program was told when it left.
        let model = replies.into_iter().rev().find_map(|reply| match reply {
            Device(model) => Some(model),
            Done | Refused(_) => None,
        });
        Ok((Self { port, full_scale }, model.unwrap_or_else(|| "MTI controller".into())))
    }
}

impl PointController for MtiLine {
    /// At 115,200 baud, a point and its answer take 3 ms.
    const RATE_HZ: RangeInclusive<f64> = 1.0..=300.0;

    fn go(&mut self, point: MirrorPoint) -> Result<(), DeviceError> {
        let [x, y] = point.tilt.deg().map(|deg| (deg / self.full_scale.0).clamp(-1.0, 1.0));
        self.tell(MtiCommand::GoTo { x, y, light: point.light }, REPLY_WAIT)
    }

    fn release(&mut self) -> Result<(), DeviceError> {
        self.tell(MtiCommand::Disable, ENABLE_WAIT)?;
        self.tell(MtiCommand::Exit, REPLY_WAIT)
    }
}

/// A mirror driven by an MTI controller.
pub type Mti = PointMirror<MtiLine>;

impl PointMirror<MtiLine> {
    /// Opens the controller of a mirror that is parked, sets the drive and switches the high voltage on.
    pub(super) fn open_parked(config: MtiConfig, state: StateFile) -> Result<Self, DeviceError> {
        let MtiConfig { port, drive, full_scale, limits, light, .. } = config;
        let (mut line, model) = MtiLine::enter(&port, full_scale)?;
        // The drive can be set only with the high voltage off.
        line.tell(MtiCommand::Disable, ENABLE_WAIT)?;
        line.tell(MtiCommand::Bias(drive.bias_v), REPLY_WAIT)?;
        line.tell(MtiCommand::Difference(drive.difference_v), REPLY_WAIT)?;
        line.tell(MtiCommand::Bandwidth(drive.bandwidth_hz), REPLY_WAIT)?;
        line.tell(MtiCommand::Enable, ENABLE_WAIT)?;
        line.go(MirrorPoint { tilt: Tilt::ORIGIN, light: 0 })?;
        Ok(PointMirror::parked(state, limits, light, Reach::Mti { port, full_scale }, line, model))
    }
}

/// Parks a mirror that a process left behind. `None`: its drive was off or is switched off, so that it springs back.
pub(super) fn recover(
    file: &StateFile,
    state: &MirrorState,
    sent: Sent,
) -> Result<Option<Tilt>, DeviceError> {
    let Reach::Mti { port, full_scale } = &state.reach else { return Ok(None) };
    let (mut line, _) = MtiLine::enter(port, *full_scale)?;
    if sent == Sent::UNKNOWN {
        return line.release().map(|()| None);
    }
    match points::recover(&mut line, file, state, sent) {
        // A drive that is off refuses points, but not only such a one does.
        Err(error) if error.kind == DeviceErrorKind::Protocol => line.release().map(|()| None),
        recovered => recovered,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_are_the_documented_lines() {
        assert_eq!(MtiCommand::Enter.to_string(), "$MTI$");
        assert_eq!(MtiCommand::Bias(80).to_string(), "MTI+VB 80");
        let point = MtiCommand::GoTo { x: -0.5, y: 1.0, light: 7 };
        assert_eq!(point.to_string(), "MTI+GT -0.50000 1.00000 7");
    }

    #[test]
    fn replies_are_told_from_garbage() {
        let reply = |bytes: &[u8]| match parse_mti(bytes) {
            Parsed::Reply { reply, used } => (reply, used),
            other => panic!("{other:?}"),
        };
        assert_eq!(reply(b"MTI-OK\r\nMTI"), (MtiReply::Done, 8));
        assert_eq!(reply(b"MTI-ERR InvalidCommand\r\n").0, MtiReply::Refused("InvalidCommand".into()));
        assert_eq!(reply(b"MTI-Device MTI-MZ\n").0, MtiReply::Device("MTI-MZ".into()));
        assert_eq!(parse_mti(b"xyMTI-OK\r\n"), Parsed::Garbage { used: 2 });
        assert_eq!(parse_mti(b"M\x80TI-OK\r\n"), Parsed::Garbage { used: 2 });
        assert_eq!(parse_mti(b"hello\r\n"), Parsed::Garbage { used: 7 });
        assert_eq!(parse_mti(b"MTI-O"), Parsed::Incomplete);
    }

    #[test]
    fn a_drive_beyond_the_mirrors_is_refused() {
        let most = MtiDrive::A7B2_3_3600AL;
        assert!(check(&most, &most).is_ok());
        for drive in [
            MtiDrive { bias_v: 81, ..most },
            MtiDrive { difference_v: 151, ..most },
            MtiDrive { bandwidth_hz: 201, ..most },
            MtiDrive { bandwidth_hz: 49, ..most },
        ] {
            assert_eq!(check(&drive, &most).unwrap_err().kind, DeviceErrorKind::OutOfRange);
        }
    }
}
