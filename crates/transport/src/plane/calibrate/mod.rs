//! Calibrates the model from the stack itself: the best prior, the width of the beam, and the position of direct
//! light.
//!
//! Everything is computed on a [`Sample`] of pixels, by two methods. The first predicts settings that an estimate has
//! not used: [`choose_prior`] compares priors this way, and [`beam_sigma`] widths. The second lets direct light,
//! which by geometry is a spike, move freely: [`spike_offset`] measures its position. Residuals are compared pixel by
//! pixel as logarithms, so that no model of the camera's noise is needed. If a stack does not determine a quantity, a
//! [`CalibrateError`] explains why.
//!
//! [`DarkFlicker`], [`CycleFlicker`] and [`LampFlicker`] are for rooms with a lamp that flickers.
//!
//! [`settings_on_direct_row`] and [`spike_weights`] are for projectors that draw their rows with a flying spot.

mod beam;
mod direct;
mod error;
mod flicker;
mod holdout;
mod latency;
mod problem;
mod sample;
mod spike;

pub use super::model::{FlyingSpot, Scan, settings_on_direct_row, spike_weights};
pub use beam::{BeamEstimate, OpticsEstimate, beam_sigma, estimate_optics};
pub use error::CalibrateError;
pub use flicker::{
    CycleFlicker, DarkFlicker, DarkRows, FrameExposures, LampFlicker, TimedImage, Unexplained,
    averaged_share, can_be_followed, cancelling_frames,
};
pub use holdout::{Candidate, Choice, candidates, choose_prior};
pub use latency::{LatencyEstimate, latency};
pub use sample::{Optics, Sample};
pub use spike::{SpikeMap, spike_offset};
