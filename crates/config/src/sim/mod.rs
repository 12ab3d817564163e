//! `[sim]`: the parameters of a simulated rig.

mod dots;
mod plane;

pub use self::dots::{DotsConfig, SimDot, SimDotCamera, SimDotSensor, SimMirror};
pub use self::plane::{
    Beam, FlickerPhase, RowTable, SimAmbient, SimBoard, SimCamera, SimConfig, SimProjector, SimSensor,
    SimTruth, SimVsync, Spot,
};
