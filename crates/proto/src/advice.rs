//! What `check` expects of a sweep's results, and the sweep that it recommends instead.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Expected errors of a sweep, and a better sweep of the same length. Light is in white units: 1 is the light
/// that a white pixel receives from its own row.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct SweepAdvice {
    /// Noise of the camera.
    pub noise: NoiseEstimate,
    /// The prior, with its weights. If the plan does not choose one, the default.
    pub prior: String,
    /// Expected errors of the plan's sweep.
    pub expected: ExpectedError,
    /// A sweep with no more frames and no longer duration, whose expected profile error is at least 10 %
    /// smaller and whose bands are each at most 10 % worse; `None` if none was found.
    pub better: Option<BetterSweep>,
}

/// Noise of one frame, in white units.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct NoiseEstimate {
    /// Standard deviation of a dark sample, quantisation included.
    pub dark: f64,
    /// Additional standard deviation due to the light of a white pixel's own row.
    pub shot: f64,
    /// Where the values come from.
    pub source: NoiseSource,
}

/// Source of the camera's noise values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum NoiseSource {
    /// The rig file states `camera.electrons_per_dn` and `camera.read_noise_e`.
    Stated,
    /// Values missing in the rig file are those of the simulation.
    Simulated,
    /// Values missing in the rig file are assumed to be typical.
    Assumed,
}

/// Errors of a white pixel in the middle of the frame, in white units, before spatial coupling: the effect of
/// noise and smoothing if timing, beam and white level are correct.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ExpectedError {
    /// Standard deviation of the light from the pixel's own row.
    pub epipolar: f64,
    /// Standard deviation of the total light from the ten rows on each side.
    pub short_range: f64,
    /// Standard deviation of the total light from all rows beyond those.
    pub long_range: f64,
    /// Root of the sum of the squared errors of all rows.
    pub profile: f64,
}

/// A recommended sweep; it covers as many rows as the plan's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct BetterSweep {
    /// Number of points.
    pub points: usize,
    /// Frames to average over all points, dark and regular images included.
    pub frames: u64,
    /// Expected errors.
    pub expected: ExpectedError,
    /// The `[sweep]` table of its plan, in TOML.
    pub sweep: String,
}
