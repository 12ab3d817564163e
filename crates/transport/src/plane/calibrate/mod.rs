//! What a stack says of its own making: which prior predicts it, how wide the beam is, where direct light arrives.
//!
//! All of it is computed on a [`Sample`] of pixels by the same two means. Settings that an estimate has not seen are
//! predicted from it: [`choose_prior`] compares priors that way, and [`beam_sigma`] widths. And direct light, which
//! geometry makes a spike, is let free to move: [`spike_offset`] measures its place. Residuals are compared pixel by
//! pixel in logarithms, so no model of the camera's noise is needed. Where a stack does not say something, a
//! [`CalibrateError`] says why.
//!
//! [`settings_on_direct_row`] and [`spike_weights`] are for projectors that draw their rows with a flying spot.

mod beam;
mod direct;
mod error;
mod holdout;
mod problem;
mod sample;
mod spike;
mod spot;

pub use beam::{BeamEstimate, OpticsEstimate, beam_sigma, estimate_optics};
pub use error::CalibrateError;
pub use holdout::{Candidate, Choice, candidates, choose_prior};
pub use sample::{Optics, Sample};
pub use spike::{SpikeMap, spike_offset};
pub use spot::{FlyingSpot, Scan, settings_on_direct_row, spike_weights};
