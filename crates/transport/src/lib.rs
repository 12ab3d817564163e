//! The mathematics of light transport on plain arrays: no I/O, no devices, no threads except rayon's.
//!
//! - [`plane`]: plane-to-ray transport of a raster projector and a rolling-shutter camera.
//! - [`quality`]: metrics that compare an estimate with a known transport.

pub mod dots;
pub mod plane;
pub mod quality;
