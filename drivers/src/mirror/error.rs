//! Errors of mirrors.

use raysweep_core::{DeviceError, DeviceErrorKind};

/// The name of the device in errors.
pub(super) const DEVICE: &str = "mirror";

/// An error of the mirror.
pub(super) fn fault(kind: DeviceErrorKind, what: impl Into<String>) -> DeviceError {
    DeviceError::new(DEVICE, kind, what.into())
}
