//! The error type that all devices report.

use std::error::Error;

/// The kind of failure, as far as callers can react to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DeviceErrorKind {
    /// The device is in use by somebody else.
    Busy,
    /// The device cannot be reached now, whatever the cause: it is missing, unplugged or switched off, is being opened
    /// again after it was lost, or the thread or process that serves it has ended.
    Disconnected,
    /// The device is present but did not answer in time.
    Timeout,
    /// The device can be reached, but something must be done first, which the message names: arm it, load a path,
    /// permit light, grant access to it.
    NotReady,
    /// The device cannot do what was asked, with any value.
    Unsupported,
    /// The device can do what was asked, but not with this value.
    OutOfRange,
    /// The device violated its protocol.
    Protocol,
}

/// A failure of one device, with the device's name in the rig and the underlying cause.
#[derive(Debug, thiserror::Error)]
#[error("{device}: {source}")]
pub struct DeviceError {
    /// The device's name in the rig: `camera`, `vsync`, `projector`.
    pub device: &'static str,
    /// The kind of failure.
    pub kind: DeviceErrorKind,
    /// What exactly happened, and what to do about it.
    pub source: Box<dyn Error + Send + Sync>,
}

impl DeviceError {
    /// An error of `device` with the cause `source`.
    pub fn new(
        device: &'static str,
        kind: DeviceErrorKind,
        source: impl Into<Box<dyn Error + Send + Sync>>,
    ) -> Self {
        Self { device, kind, source: source.into() }
    }
}
