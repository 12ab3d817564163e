//! Cameras.

#[cfg(feature = "aravis")]
pub mod aravis;
pub mod replay;
pub mod v4l2;
