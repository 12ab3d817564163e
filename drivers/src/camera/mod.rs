//! Cameras.

pub mod v4l2;
