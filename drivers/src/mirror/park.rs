//! Parking a mirror that a process left moving or away from the origin.

use std::path::Path;
use std::time::{Duration, Instant};

use raysweep_core::{DeviceError, DeviceErrorKind, Tilt};

use super::state::{MirrorState, Reach, StateError, StateFile};
use super::{mti, optotune, playzerx};

/// Maximum wait for a dying process to release the mirror.
const LOCK_WAIT: Duration = Duration::from_secs(2);
/// Maximum wait for a dying process to release the port: it closes its files one after the other, so it may release
/// the port after the lock.
const PORT_WAIT: Duration = Duration::from_secs(2);

/// Why a mirror could not be parked.
#[derive(Debug, thiserror::Error)]
pub enum ParkError {
    /// Its state cannot be read or written.
    #[error(transparent)]
    State(#[from] StateError),
    /// Its controller cannot be reached.
    #[error("{0}: if the light is on, switch it off by hand")]
    Device(#[from] DeviceError),
}

/// How a mirror was parked.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Parked {
    /// There is no state: no driver that keeps it there has moved a mirror.
    NeverMoved,
    /// It was parked already.
    Already,
    /// It was found at this tilt and moved to the origin with the light off.
    From(Tilt),
    /// Its position was unknown. Its controller was restarted, which switches off light and drive, or was commanded
    /// to the origin.
    ByReset,
}

/// Parks the mirror whose driver kept its state in `state`, however the driver's process ended. Switches the light
/// off first, then moves on a ramp from the position that the controller reports.
///
/// # Errors
/// `Locked` if a process still drives the mirror; `Device` if the controller cannot be reached.
pub fn park(state: &Path) -> Result<Parked, ParkError> {
    // If no mirror was ever moved, do not create files.
    if matches!(state.try_exists(), Ok(false)) {
        return Ok(Parked::NeverMoved);
    }
    park_left(&StateFile::open(state, LOCK_WAIT)?)
}

/// As [`park()`], with the lock already held.
pub(super) fn park_left(file: &StateFile) -> Result<Parked, ParkError> {
    let Some((state, sent)) = file.read()? else { return Ok(Parked::NeverMoved) };
    if state.playing.is_none() {
        return Ok(Parked::Already);
    }
    let deadline = Instant::now() + PORT_WAIT;
    let found = loop {
        let recovered = match &state.reach {
            Reach::PlayzerX { .. } => playzerx::recover(file, &state, sent),
            Reach::Mti { .. } => mti::recover(file, &state, sent),
            Reach::Optotune { .. } => optotune::recover(file, &state, sent),
        };
        match recovered {
            Err(error) if error.kind == DeviceErrorKind::Busy && Instant::now() < deadline => {
                std::thread::sleep(Duration::from_millis(1));
            }
            recovered => break recovered?,
        }
    };
    file.write(&MirrorState { playing: None, ..state })?;
    Ok(found.map_or(Parked::ByReset, Parked::From))
}
