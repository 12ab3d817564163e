//! `[sim]`: the parameters of a simulated rig.

mod dots;
mod plane;

pub use self::dots::{DotsConfig, SimDot, SimDotCamera, SimDotSensor, SimMirror};
pub use self::plane::{
    RowTable, SimAmbient, SimBeam, SimCamera, SimConfig, SimProjector, SimSensor, SimSpot, SimVsync,
};
