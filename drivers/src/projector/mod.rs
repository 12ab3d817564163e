//! Projectors: what shows patterns.

pub mod drm;
pub mod external;
mod picture;

const DEVICE: &str = "projector";
