//! Asks a mirror's controller who it is. The mirror does not move, no drive is switched, and no light.

use std::path::Path;

use raysweep_config::rig::dots::MirrorDriver;
use raysweep_core::DeviceError;

use super::mti::MtiLine;
use super::{optotune, playzerx};

/// Opens the port of a controller, asks it what it is, and closes the port; `None` for a simulated one.
///
/// # Errors
/// `Busy` if another process has the port, `Disconnected` if it is missing, `Timeout` or `Protocol` if no such
/// controller answers, `Unsupported` for one that this driver does not drive.
pub fn greet(driver: MirrorDriver, port: &Path) -> Result<Option<String>, DeviceError> {
    match driver {
        MirrorDriver::Sim => Ok(None),
        MirrorDriver::PlayzerX => playzerx::greet(port).map(Some),
        MirrorDriver::Mti => MtiLine::greet(port).map(Some),
        MirrorDriver::Optotune => optotune::greet(port).map(Some),
    }
}
