//! MEMS mirrors over serial lines: Mirrorcle's PlayzerX and MTI controllers, Optotune's MR-E-2.
//!
//! A driver keeps a [`StateFile`]: what it is going to send is on disk before the first sample is sent, and how much
//! of it was sent is recorded next to it. After a crash, [`park()`], a [`Guardian`] or the next run can therefore
//! determine the mirror's position and move it to the origin, light off first. Where it cannot be determined, the drive
//! is switched off.

mod error;
mod greet;
mod guardian;
mod light;
mod lines;
mod mti;
mod open;
mod optotune;
mod park;
pub mod playzerx;
mod points;
mod rules;
mod sequence;
mod state;

pub use greet::greet;
pub use guardian::{Guardian, park_when_closed};
pub use light::{LightGuard, LightState, NoLight, arm_light};
pub use mti::{Mti, MtiCommand, MtiConfig, MtiDrive, MtiReply, parse_mti};
pub use optotune::{
    Laser, Optotune, OptotuneCommand, OptotuneConfig, OptotuneReply, RtsLaser, parse_optotune,
};
pub use park::{ParkError, Parked, park};
pub use playzerx::{PlayzerX, PlayzerXConfig, PlayzerXLink};
pub use state::{MirrorReport, StateError, StateFile};
