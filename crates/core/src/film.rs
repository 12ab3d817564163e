//! The outcome of a film, as given in its end record, its report and the daemon's status.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The result of a film. Planned cycles = stored + incomplete + not taken.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct FilmSummary {
    /// Cycles that the plan asks for.
    pub cycles_planned: usize,
    /// Cycles whose frames are all stored.
    pub cycles_stored: usize,
    /// Cycles that lack a frame; the ledger says which frame, and why.
    pub cycles_incomplete: usize,
    /// Stored cycles whose transport was estimated while the film was running.
    pub transports: usize,
    /// Stored cycles without a transport, because the machine did not keep up or a stage failed. `raysweep process`
    /// computes them.
    pub transports_missing: usize,
    /// Estimates between cycles, published but not stored.
    pub sliding_estimates: usize,
    /// Cycles per second between the first and the last stored cycle.
    pub cycles_per_s: Option<f64>,
    /// Time from the end of a cycle's last exposure to the publication of its transport; `None` on a virtual clock.
    pub latency_ms: Option<Percentiles>,
    /// By how much later than calibrated light was taken to arrive after the first cycles; `None` without a
    /// calibration, or for a film of few cycles.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub late_us: Option<f64>,
    /// Standard deviation of the beam in rows, as the first cycles showed it; `None` if they did not, or a calibration
    /// measured it pixel by pixel.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub beam_sigma_rows: Option<f64>,
    /// Whether the rows `|u| <= 2` are one band, because no setting tells where in it direct light lies.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub one_band: bool,
    /// How the cycles after the first few were demultiplexed, and why: each a subject and a sentence. Empty for a film
    /// of few cycles.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub findings: Vec<(String, String)>,
    /// What the first cycles showed to be wrong.
    #[serde(default, skip_serializing_if = "Vec::is_empty", alias = "calibration_warnings")]
    pub warnings: Vec<String>,
}

/// Percentiles of repeated measurements.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Percentiles {
    /// Median.
    pub p50: f64,
    /// 95th percentile.
    pub p95: f64,
    /// 99th percentile.
    pub p99: f64,
    /// Maximum.
    pub max: f64,
}

impl Percentiles {
    /// Computes them from values in ascending order; `None` if there are no values. Each is the smallest value that
    /// at least so many percent of the values do not exceed.
    pub fn of_sorted(values: &[f64]) -> Option<Self> {
        let at = |percent: usize| values.get((values.len() * percent).div_ceil(100).max(1) - 1).copied();
        Some(Self { p50: at(50)?, p95: at(95)?, p99: at(99)?, max: at(100)? })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn percentiles_are_values_that_were_measured() {
        let values: Vec<f64> = (1..=200).map(f64::from).collect();
        let all = Percentiles { p50: 100.0, p95: 190.0, p99: 198.0, max: 200.0 };
        assert_eq!(Percentiles::of_sorted(&values), Some(all));
        let one = Percentiles { p50: 7.0, p95: 7.0, p99: 7.0, max: 7.0 };
        assert_eq!(Percentiles::of_sorted(&[7.0]), Some(one));
        assert_eq!(Percentiles::of_sorted(&[]), None);
    }
}
