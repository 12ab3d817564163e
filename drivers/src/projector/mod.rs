//! Projectors: devices that show patterns.

pub mod drm;
pub mod external;
mod picture;

const DEVICE: &str = "projector";
