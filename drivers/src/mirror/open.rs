//! Opening mirrors: one that a crashed process left away from rest is parked before its controller is opened.

use std::path::Path;
use std::time::Duration;

use raysweep_core::{DeviceError, DeviceErrorKind};

use super::error::fault;
use super::mti::{self, Mti, MtiConfig};
use super::optotune::{Laser, Optotune, OptotuneConfig};
use super::park::{ParkError, park_left};
use super::playzerx::{PlayzerX, PlayzerXConfig};
use super::state::{StateFile, of_state};

/// Maximum wait for another process to release the mirror.
const LOCK_WAIT: Duration = Duration::from_secs(1);

/// Takes the lock, and parks a mirror that was left behind.
fn parked(state: &Path) -> Result<StateFile, DeviceError> {
    let state = StateFile::open(state, LOCK_WAIT).map_err(of_state)?;
    park_left(&state).map_err(|error| match &error {
        ParkError::Device(cause) => fault(cause.kind, error.to_string()),
        ParkError::State(_) => fault(DeviceErrorKind::NotReady, error.to_string()),
    })?;
    Ok(state)
}

impl PlayzerX {
    /// Opens the controller. If a crashed process left the mirror away from rest, it is parked first.
    ///
    /// # Errors
    /// `Busy` if another process has it, `Disconnected` or `Timeout` if it is missing, `Unsupported` if it is another
    /// device, `NotReady` if it plays samples that this driver did not send.
    pub fn open(config: PlayzerXConfig) -> Result<Self, DeviceError> {
        let state = parked(&config.state)?;
        Self::open_parked(config, state)
    }
}

impl Mti {
    /// Opens the controller, sets the drive and switches the high voltage on. If a crashed process left the mirror
    /// away from rest, it is parked first.
    ///
    /// # Errors
    /// `OutOfRange` for a drive that would destroy the mirror, `Busy`, `Disconnected`, `Timeout`, `Protocol`.
    pub fn open(config: MtiConfig) -> Result<Self, DeviceError> {
        mti::check(&config.drive, &config.most)?;
        let state = parked(&config.state)?;
        Self::open_parked(config, state)
    }
}

impl Optotune {
    /// Opens the controller. If a crashed process left the mirror away from rest, it is parked first.
    ///
    /// # Errors
    /// `Busy`, `Disconnected`, `Timeout`, `Protocol`.
    pub fn open(config: OptotuneConfig, laser: Box<dyn Laser>) -> Result<Self, DeviceError> {
        let state = parked(&config.state)?;
        Self::open_parked(config, laser, state)
    }
}
