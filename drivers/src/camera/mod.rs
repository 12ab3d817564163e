//! Cameras.

pub mod aravis;
pub mod v4l2;
