//! The mathematics of light transport on plain arrays: no I/O, no devices, no threads of its own but rayon's.
//!
//! - [`plane`]: plane-to-ray transport of a raster projector and a rolling-shutter camera.
//! - [`quality`]: the figures by which an estimate is judged against a known transport.

pub mod dots;
pub mod plane;
pub mod quality;
