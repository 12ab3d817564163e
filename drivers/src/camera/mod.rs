//! Cameras.

#[cfg(feature = "aravis")]
pub mod aravis;
mod facts;
pub mod replay;
pub mod v4l2;

pub use facts::CameraFacts;
