//! The simulated plane rig with its camera behind a network connection.

use std::sync::Arc;

use raysweep_core::{Projector, Vsync};

use crate::devices::{TruthProbe, open_shared};
use crate::gige::Look;
use crate::line::VsyncLine;
use crate::world::PlaneWorld;

/// The devices of one rig on the host's clock, with the camera behind a network connection.
pub struct WireDevices {
    /// The simulated scene as the camera's picture source.
    pub camera: Look,
    /// The VSYNC monitor.
    pub vsync: Box<dyn Vsync>,
    /// The projector, initially dark.
    pub projector: Box<dyn Projector>,
    /// Ground truth of the line, for tests only.
    pub truth: TruthProbe,
}

/// Opens the devices of a rig.
pub(crate) fn open(world: &Arc<PlaneWorld>, line: VsyncLine) -> WireDevices {
    let ([written, read], vsync, projector, truth) = open_shared(world, line);
    WireDevices { camera: Look::at_scene(written, read), vsync, projector, truth }
}
