//! What `check` expects of a sweep's results, and what it advises instead.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What errors a sweep must expect, and a better sweep of the same length. Light is in white units: 1 is what a white
/// pixel collects from its own row.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SweepAdvice {
    /// Of the camera.
    pub noise: NoiseEstimate,
    /// The prior that is taken, with its weights; where the plan leaves it open, the one that is taken in doubt.
    pub prior: String,
    /// Of the plan's sweep.
    pub expected: ExpectedError,
    /// A sweep that takes no more frames and no longer, whose profiles are expected to err by a tenth less and none of
    /// whose bands by a tenth more; nothing if none was found.
    pub better: Option<BetterSweep>,
}

/// Noise of one frame, in white units.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct NoiseEstimate {
    /// Standard deviation of a dark sample, quantisation included.
    pub dark: f64,
    /// Standard deviation by which the light of a white pixel's row adds to that.
    pub shot: f64,
    /// How it is known.
    pub source: NoiseSource,
}

/// How the camera's noise is known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum NoiseSource {
    /// The rig file states `camera.electrons_per_dn` and `camera.read_noise_e`.
    Stated,
    /// What the rig file does not state of it is as simulated.
    Simulated,
    /// What the rig file does not state of it is assumed to be typical.
    Assumed,
}

/// Errors of a white pixel in the middle of the frame, in white units, before spatial coupling: what noise and
/// smoothing do if timing, beam and white level are true.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ExpectedError {
    /// Standard deviation of the light from the pixel's own row.
    pub epipolar: f64,
    /// Of the light from the ten rows on each side, in all.
    pub short_range: f64,
    /// Of the light from all rows beyond, in all.
    pub long_range: f64,
    /// Root of the sum of the squared errors of all rows.
    pub profile: f64,
}

/// A sweep to take instead; it reaches as many rows as the plan's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct BetterSweep {
    /// Its points.
    pub points: usize,
    /// Frames to average over all points, dark and regular images included.
    pub frames: u64,
    /// What to expect of it.
    pub expected: ExpectedError,
    /// The table `[sweep]` of its plan, in TOML.
    pub sweep: String,
}
