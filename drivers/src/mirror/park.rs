//! Parking what a process has left behind.

use std::path::Path;
use std::time::Duration;

use raysweep_core::{DeviceError, Tilt};

use super::state::{MirrorState, Reach, StateError, StateFile};
use super::{mti, optotune, playzerx};

/// Longest time to wait for a process that dies to let go of the mirror.
const LOCK_WAIT: Duration = Duration::from_secs(2);

/// Why a mirror could not be parked.
#[derive(Debug, thiserror::Error)]
pub enum ParkError {
    /// Its state cannot be read or written.
    #[error(transparent)]
    State(#[from] StateError),
    /// Its controller cannot be told.
    #[error("{0}: if the light is on, switch it off by hand")]
    Device(#[from] DeviceError),
}

/// How a mirror was parked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Parked {
    /// It was parked already, or has never been moved.
    Already,
    /// It was found there, and taken to the origin with the light off.
    From(Tilt),
    /// Nobody could say where it was, so its controller was started anew, which takes light and drive away, or told to be at the
    /// origin.
    ByReset,
}

/// Parks the mirror whose driver kept its state in `state`, after the driver's process has ended in whatever way. Light
/// off first, then a ramp from where the controller says that it is.
///
/// # Errors
/// `Locked` when a process still drives the mirror; `Device` when the controller cannot be reached.
pub fn park(state: &Path) -> Result<Parked, ParkError> {
    // Where no mirror was ever moved, nothing is written either.
    if matches!(state.try_exists(), Ok(false)) {
        return Ok(Parked::Already);
    }
    park_left(&StateFile::open(state, LOCK_WAIT)?)
}

/// The same with the lock in hand.
pub(super) fn park_left(file: &StateFile) -> Result<Parked, ParkError> {
    let Some((state, sent)) = file.read()? else { return Ok(Parked::Already) };
    if state.playing.is_none() {
        return Ok(Parked::Already);
    }
    let found = match &state.reach {
        Reach::PlayzerX { .. } => playzerx::recover(file, &state, sent)?,
        Reach::Mti { .. } => mti::recover(&state, sent)?,
        Reach::Optotune { .. } => optotune::recover(&state, sent)?,
    };
    file.write(&MirrorState { playing: None, ..state })?;
    Ok(found.map_or(Parked::ByReset, Parked::From))
}
