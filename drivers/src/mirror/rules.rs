//! What every driver of a mirror asks before it moves one.

use raysweep_core::{DeviceError, DeviceErrorKind, MirrorLimits, MirrorPath};

use super::light::LightGuard;
use super::port::fault;

/// The path, if it keeps to the limits of this mirror: it may have been made for another.
pub(super) fn fitting(path: &MirrorPath, limits: &MirrorLimits) -> Result<MirrorPath, DeviceError> {
    MirrorPath::new(path.points().to_vec(), path.rate_hz(), limits)
        .map_err(|error| fault(DeviceErrorKind::OutOfRange, error.to_string()))
}

/// Whether a path may be played now, so many times.
pub(super) fn may_start(path: &MirrorPath, batches: u32, light: &LightGuard) -> Result<(), DeviceError> {
    if batches == 0 {
        return Err(fault(DeviceErrorKind::OutOfRange, "batches = 0: play the path once at least"));
    }
    if path.is_lit() {
        light.permits().map_err(|no| fault(DeviceErrorKind::NotReady, no.to_string()))?;
    }
    Ok(())
}

/// The answer to a start without a path.
pub(super) fn nothing_loaded() -> DeviceError {
    fault(DeviceErrorKind::NotReady, "no path is loaded: load one before each start")
}

/// The answer to a feed without a start.
pub(super) fn nothing_played() -> DeviceError {
    fault(DeviceErrorKind::NotReady, "nothing is being played: load a path and start it")
}
