//! The simulated plane rig with its camera behind a network connection.

use std::sync::Arc;

use crate::devices::{BenchDevices, open_shared};
use crate::gige::Look;
use crate::line::VsyncLine;
use crate::world::PlaneWorld;

/// The devices of one rig on the host's clock, with the camera behind a network connection.
pub struct WireDevices {
    /// The simulated scene as the camera's picture source.
    pub camera: Look,
    /// All other devices.
    pub bench: BenchDevices,
}

/// Opens the devices of a rig.
pub(crate) fn open(world: &Arc<PlaneWorld>, line: VsyncLine) -> WireDevices {
    let ([written, read], bench) = open_shared(world, line);
    WireDevices { camera: Look::at_scene(written, read), bench }
}
