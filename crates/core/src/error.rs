//! The one error type that a device reports.

use std::error::Error;

/// What kind of failure it was: what a caller can act on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DeviceErrorKind {
    /// Somebody else holds the device.
    Busy,
    /// The device is gone: unplugged, powered off, or its process died.
    Disconnected,
    /// The device is there and did not answer in time.
    Timeout,
    /// A call that needs the device armed or open came while it was not.
    NotReady,
    /// The device cannot do what was asked, at any value.
    Unsupported,
    /// The device can do what was asked, but not at that value.
    OutOfRange,
    /// The device said something that its protocol does not allow.
    Protocol,
}

/// A failure of one device, with its name in the rig and the cause beneath it.
#[derive(Debug, thiserror::Error)]
#[error("{device}: {source}")]
pub struct DeviceError {
    /// The device's name in the rig: `camera`, `vsync`, `projector`.
    pub device: &'static str,
    /// What kind of failure it was.
    pub kind: DeviceErrorKind,
    /// What exactly happened, and what to do about it.
    pub source: Box<dyn Error + Send + Sync>,
}

impl DeviceError {
    /// An error of `device` from anything that tells what happened.
    pub fn new(
        device: &'static str,
        kind: DeviceErrorKind,
        source: impl Into<Box<dyn Error + Send + Sync>>,
    ) -> Self {
        Self { device, kind, source: source.into() }
    }
}
