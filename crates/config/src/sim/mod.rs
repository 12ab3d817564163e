//! `[sim]`: the parameters of a simulated rig.

mod dots;
mod plane;

pub use self::dots::{DotsConfig, SimDot, SimDotCamera, SimDotSensor, SimMirror};
pub use self::plane::{
    Beam, RowTable, SimAmbient, SimCamera, SimConfig, SimProjector, SimSensor, SimVsync, Spot,
};
