//! `[sim]`: what a simulated rig is made of.

mod dots;
mod plane;

pub use self::dots::{DotsConfig, SimDot, SimDotCamera, SimDotSensor, SimMirror};
pub use self::plane::{
    Beam, RowTable, SimAmbient, SimCamera, SimConfig, SimProjector, SimSensor, SimVsync, Spot,
};
