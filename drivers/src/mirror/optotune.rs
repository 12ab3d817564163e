//! Optotune's MR-E-2 in its simple mode: one line per command, answered by `OK`, `NO`, `OL` or `OU`. It has no output
//! for a light, so the light is controlled by a separate [`Laser`].

use std::fmt;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};
use std::time::Duration;

use raysweep_core::{DeviceError, DeviceErrorKind, MirrorLimits, MirrorPoint, Tilt};

use super::error::{DEVICE, fault};
use super::light::LightGuard;
use super::lines::LinePort;
use super::points::{self, PointController, PointMirror};
use super::state::{MirrorState, Reach, Sent, StateFile, node_of};
use crate::serial::port::Port;
use crate::serial::wire::{Parsed, parse_line};

const BAUD: u32 = 256_000;
/// A controller answers within milliseconds; the rest is for the kernel's workers of a busy host, see [`Timeout`].
///
/// [`Timeout`]: crate::serial::timeout::Timeout
const REPLY_WAIT: Duration = Duration::from_secs(1);
/// The controller's coordinates are tan(optical angle) / tan(this angle).
const FULL_SCALE_OPTICAL_DEG: f64 = 50.0;

/// A light that is switched separately from the mirror.
pub trait Laser: Send {
    /// Switches the light on or off; returns when that is done.
    ///
    /// # Errors
    /// `Disconnected` if the light cannot be reached.
    fn switch(&mut self, on: bool) -> Result<(), DeviceError>;
}

/// A laser whose enable input is wired to the RTS line of a serial port: it goes off by itself when the process ends.
/// The kernel raises the line when the port is opened, before anybody can lower it, so that only an interlock in the
/// laser's own circuit keeps it dark at that moment.
pub struct RtsLaser {
    port: Port,
}

impl RtsLaser {
    /// Opens the port and switches the light off.
    ///
    /// # Errors
    /// If the port cannot be opened or has no RTS line.
    pub fn open(port: &Path) -> Result<Self, DeviceError> {
        let mut laser = Self { port: Port::open(DEVICE, port, 9600)? };
        laser.switch(false)?;
        Ok(laser)
    }
}

impl Laser for RtsLaser {
    fn switch(&mut self, on: bool) -> Result<(), DeviceError> {
        self.port.set_rts(on)
    }
}

/// Configuration of an MR-E-2.
#[derive(Debug, Clone, PartialEq)]
pub struct OptotuneConfig {
    /// Its serial port.
    pub port: PathBuf,
    /// The port whose RTS line enables the laser, for [`super::park()`] after a crash; `None` if the laser is
    /// controlled differently.
    pub laser_port: Option<PathBuf>,
    /// Limits of the mirror.
    pub limits: MirrorLimits,
    /// File for the state that must survive a crash.
    pub state: PathBuf,
    /// Permission for light.
    pub light: LightGuard,
}

/// A command to the controller.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum OptotuneCommand {
    /// Requests a sign of life.
    Start,
    /// Goes to a position; both coordinates are tan(optical angle) / tan 50 degrees, -1..=1.
    GoTo {
        /// Coordinate of the x axis.
        x: f64,
        /// Coordinate of the y axis.
        y: f64,
    },
}

/// The line of the command, without its end.
impl fmt::Display for OptotuneCommand {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Start => write!(f, "START"),
            Self::GoTo { x, y } => write!(f, "XY={x:.5};{y:.5}"),
        }
    }
}

/// A reply from the controller.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OptotuneReply {
    /// The command was executed.
    Ok,
    /// The command was not understood.
    No,
    /// The value is below the minimum.
    TooLow,
    /// The value is above the maximum.
    TooHigh,
}

/// The controller's word and its meaning.
impl fmt::Display for OptotuneReply {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Ok => write!(f, "OK"),
            Self::No => write!(f, "NO (not understood)"),
            Self::TooLow => write!(f, "OL (below the minimum)"),
            Self::TooHigh => write!(f, "OU (above the maximum)"),
        }
    }
}

/// Parses the reply at the start of `bytes`.
pub fn parse_optotune(bytes: &[u8]) -> Parsed<OptotuneReply> {
    parse_line(bytes, |text| match text {
        "OK" => Ok(OptotuneReply::Ok),
        "NO" => Ok(OptotuneReply::No),
        "OL" => Ok(OptotuneReply::TooLow),
        "OU" => Ok(OptotuneReply::TooHigh),
        _ if ["OK", "NO", "OL", "OU"].iter().any(|reply| text.ends_with(reply)) => Err(Some(text.len() - 2)),
        _ => Err(None),
    })
}

const MODEL: &str = "Optotune MR-E-2";

/// The controller and its separate laser.
pub struct OptotuneLine {
    port: LinePort<OptotuneReply>,
    laser: Box<dyn Laser>,
    lit: bool,
}

impl OptotuneLine {
    fn open(port: &Path, mut laser: Box<dyn Laser>) -> Result<Self, DeviceError> {
        // Also if the mirror cannot be reached.
        laser.switch(false)?;
        Ok(Self { port: greet_line(port)?, laser, lit: false })
    }

    fn light(&mut self, on: bool) -> Result<(), DeviceError> {
        if self.lit != on {
            self.laser.switch(on)?;
            self.lit = on;
        }
        Ok(())
    }

    fn tell(&mut self, command: OptotuneCommand) -> Result<(), DeviceError> {
        match self.port.ask(command, REPLY_WAIT)? {
            OptotuneReply::Ok => Ok(()),
            refused => {
                let what = format!("the controller answers {refused} to \"{command}\"");
                Err(fault(DeviceErrorKind::Protocol, what))
            }
        }
    }
}

impl PointController for OptotuneLine {
    /// At 256,000 baud, a point and its answer take 1 ms.
    const RATE_HZ: RangeInclusive<f64> = 1.0..=500.0;

    fn go(&mut self, point: MirrorPoint) -> Result<(), DeviceError> {
        // Off before the mirror moves; on after it was commanded to move.
        if point.light == 0 {
            self.light(false)?;
        }
        let full_scale = FULL_SCALE_OPTICAL_DEG.to_radians().tan();
        let [x, y] = point.tilt.deg().map(|deg| (2.0 * deg).to_radians().tan() / full_scale);
        self.tell(OptotuneCommand::GoTo { x, y })?;
        self.light(point.light > 0)
    }

    fn release(&mut self) -> Result<(), DeviceError> {
        self.light(false)
    }
}

/// Opens the port of a controller that gives a sign of life.
fn greet_line(port: &Path) -> Result<LinePort<OptotuneReply>, DeviceError> {
    let mut line = LinePort::open(port, BAUD, "\r\n", parse_optotune)?;
    line.greet(&[&OptotuneCommand::Start.to_string()], REPLY_WAIT, |reply| *reply == OptotuneReply::Ok)?;
    Ok(line)
}

/// Asks the controller at this port for a sign of life. Its laser's port is not opened, which would switch it.
pub(super) fn greet(port: &Path) -> Result<String, DeviceError> {
    greet_line(port)?;
    Ok(MODEL.into())
}

/// A mirror driven by an MR-E-2.
pub type Optotune = PointMirror<OptotuneLine>;

impl PointMirror<OptotuneLine> {
    /// Opens the controller of a mirror that is parked.
    pub(super) fn open_parked(
        config: OptotuneConfig,
        laser: Box<dyn Laser>,
        state: StateFile,
    ) -> Result<Self, DeviceError> {
        let OptotuneConfig { port, laser_port, limits, light, .. } = config;
        let node = node_of(&port);
        let mut line = OptotuneLine::open(&port, laser)?;
        line.go(MirrorPoint { tilt: Tilt::ORIGIN, light: 0 })?;
        let reach = Reach::Optotune { port, node, laser_port };
        Ok(PointMirror::parked(state, limits, light, reach, line, MODEL.into()))
    }
}

/// A laser that this process cannot reach; only the lab can switch it.
struct NoLaser;

impl Laser for NoLaser {
    fn switch(&mut self, _: bool) -> Result<(), DeviceError> {
        Ok(())
    }
}

/// Parks a mirror that a process left behind. `None`: it may not have been where it was left.
pub(super) fn recover(
    file: &StateFile,
    state: &MirrorState,
    sent: Sent,
) -> Result<Option<Tilt>, DeviceError> {
    let Reach::Optotune { port, node, laser_port } = &state.reach else { return Ok(None) };
    let laser: Box<dyn Laser> = match laser_port {
        Some(port) => Box::new(RtsLaser::open(port)?),
        None => Box::new(NoLaser),
    };
    let mut line = OptotuneLine::open(port, laser)?;
    if sent == Sent::UNKNOWN || !state.is_plugged_in_since(port, *node) {
        // Without power, it has sprung back. With power, its own control loop follows a step of any size.
        line.go(MirrorPoint { tilt: Tilt::ORIGIN, light: 0 })?;
        return Ok(None);
    }
    points::recover(&mut line, file, state, sent)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn commands_and_replies_are_the_documented_lines() {
        assert_eq!(OptotuneCommand::Start.to_string(), "START");
        assert_eq!(OptotuneCommand::GoTo { x: 0.25, y: -1.0 }.to_string(), "XY=0.25000;-1.00000");
        assert_eq!(parse_optotune(b"OK\r\nNO"), Parsed::Reply { reply: OptotuneReply::Ok, used: 4 });
        assert_eq!(parse_optotune(b"OL\r\n"), Parsed::Reply { reply: OptotuneReply::TooLow, used: 4 });
        assert_eq!(parse_optotune(b"xOU\r\n"), Parsed::Garbage { used: 1 });
        assert_eq!(parse_optotune(b"maybe\r\n"), Parsed::Garbage { used: 7 });
        assert_eq!(parse_optotune(b"O"), Parsed::Incomplete);
    }
}
