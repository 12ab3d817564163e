//! Checks that all mirror drivers make before they move a mirror.

use raysweep_core::{DeviceError, DeviceErrorKind, MirrorLimits, MirrorPath};

use super::error::fault;
use super::light::LightGuard;

/// Returns the path if it respects the limits of this mirror: it may have been made for another one.
pub(super) fn fitting(path: &MirrorPath, limits: &MirrorLimits) -> Result<MirrorPath, DeviceError> {
    MirrorPath::new(path.points().to_vec(), path.rate_hz(), limits)
        .map_err(|error| fault(DeviceErrorKind::OutOfRange, error.to_string()))
}

/// Whether a path may be played now for this number of batches.
pub(super) fn may_start(path: &MirrorPath, batches: u32, light: &LightGuard) -> Result<(), DeviceError> {
    if batches == 0 {
        return Err(fault(DeviceErrorKind::OutOfRange, "batches = 0: play the path once at least"));
    }
    if path.is_lit() {
        light.permits().map_err(|no| fault(DeviceErrorKind::NotReady, no.to_string()))?;
    }
    Ok(())
}

/// The error of a start without a loaded path.
pub(super) fn nothing_loaded() -> DeviceError {
    fault(DeviceErrorKind::NotReady, "no path is loaded: load one before each start")
}

/// The error of a feed without a start.
pub(super) fn nothing_played() -> DeviceError {
    fault(DeviceErrorKind::NotReady, "nothing is being played: load a path and start it")
}
