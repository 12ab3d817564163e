//! `[sim]`: the parameters of a simulated rig.

mod dots;
mod plane;

pub use self::dots::{DotsConfig, SimDot, SimDotCamera, SimDotSensor, SimMirror};
pub use self::plane::{
    FlickerPhase, RowTable, SimAmbient, SimBeam, SimBoard, SimCamera, SimConfig, SimLens, SimProjector,
    SimSensor, SimSpot, SimTruth, SimVsync,
};
