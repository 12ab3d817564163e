//! Cameras.

pub mod aravis;
