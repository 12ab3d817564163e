//! What `check` and `design` expect of a plan's results, and the settings that they recommend instead.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Expected error of a plan, and better settings of the same length.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct PlanAdvice {
    /// Noise of the camera.
    pub noise: NoiseEstimate,
    /// How well the rig is taken to be known.
    pub rig: RigAccuracy,
    /// The prior, with its weights. If the plan does not choose one, the default.
    pub prior: String,
    /// Expected error of the plan's settings.
    pub expected: ExpectedError,
    /// Settings with no more frames and no longer duration, whose expected error is at least 10 % smaller, or 25 % if they
    /// would replace settings that were chosen for the calibration in use; `None` if none were found.
    pub better: Option<BetterPlan>,
}

/// How well a prediction takes the rig to be known: standard deviations.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct RigAccuracy {
    /// Whether the calibration in use says so; otherwise it is what a calibration would give, and the rig file's numbers
    /// are taken for true.
    pub calibrated: bool,
    /// Error that the times of all frames share.
    pub latency_us: f64,
    /// Error of the time of a single frame.
    pub edge_us: f64,
    /// Error of the length of exposures.
    pub exposure_us: f64,
    /// Distance of direct light from the pixel's place, in projector rows.
    pub place_rows: f64,
}

/// Noise of one frame. Light is in white units: 1 is the light that a white pixel receives from its own row.
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
    /// The calibration in use has measured it.
    Calibrated,
    /// The rig file states `camera.electrons_per_dn` and `camera.read_noise_e`.
    Stated,
    /// Values missing in the rig file are those of the simulation.
    Simulated,
    /// Values missing in the rig file are assumed to be typical.
    Assumed,
}

/// Expected relative error of the light transport over a family of scenes: of each scene the median over pixels of
/// `||estimate - T|| / ||T||`, before spatial coupling.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ExpectedError {
    /// All parts together.
    pub total: ErrorRange,
    /// Noise of the camera.
    pub noise: ErrorRange,
    /// What the settings leave to the prior.
    pub bias: ErrorRange,
    /// Errors of latency, exposure, edges and the pixel's place.
    pub calibration: ErrorRange,
    /// The total if rows |u| <= 2 count as one.
    pub band: ErrorRange,
}

/// Median and 10 to 90 % range over the family's scenes.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct ErrorRange {
    /// 10 % of the scenes lie below.
    pub low: f64,
    /// Half of the scenes lie below.
    pub median: f64,
    /// 90 % of the scenes lie below.
    pub high: f64,
}

/// Recommended settings; they cover as many rows as the plan's.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct BetterPlan {
    /// Number of settings.
    pub points: usize,
    /// Frames to average over all points, dark and regular images included; of a film, those of a cycle.
    pub frames: u64,
    /// Expected error.
    pub expected: ExpectedError,
    /// The tables `[sweep]` or `[film]` of its plan, in TOML.
    pub table: String,
}

/// Parameters of `design`. Either an error or a time is wanted, not both.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct DesignParams {
    /// The TOML text of a plan of kind `sweep` or `film`, whose ranges of delays and exposures are kept.
    pub plan: String,
    /// Wanted median relative error of the transport.
    pub error: Option<f64>,
    /// Wanted time with light, in seconds: that of the sweep's settings, or of one cycle of the film.
    pub light_s: Option<f64>,
    /// Standard deviation of the part of a frame's edges in time that nothing measures, in microseconds; 0.5 if
    /// omitted.
    pub edge_us: Option<f64>,
}

/// Result of `design`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct DesignReport {
    /// Number of settings.
    pub points: usize,
    /// Frames of these settings; of a film, those of a cycle.
    pub frames: u64,
    /// Time with light that they take, in seconds.
    pub light_s: f64,
    /// Expected error.
    pub expected: ExpectedError,
    /// The whole plan, in TOML.
    pub plan: String,
    /// What was not reached, or how the results are to be read.
    pub warnings: Vec<String>,
}
