//! Calibrates a plane rig from images of a flat, matt, white board.
//!
//! [`images`] turns images of the board under dark, white, grey and coded pictures into properties of each pixel: dark
//! image, gain and noise, linearity, white level, the projector row that it sees, and its response to the rows drawn
//! around that row. [`times`] turns images of the white board with different delays and exposures into the time at
//! which each projector row is lit. All functions are pure; no device takes part. The procedure `calibration` calls them
//! in order (`crates/processing/src/calibration/images.rs`).

mod calibration;
mod covariance;
mod estimate;
pub mod images;
pub mod times;

pub use calibration::{BoardCalibration, BoardStrip, FlickeringLamp, RowDrawing};
pub use covariance::{CalibrationCovariance, CalibrationParameter};
pub use estimate::Estimate;
