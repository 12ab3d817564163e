use crate::dots::error::check_range;
use crate::dots::{DotsError, Region};

/// When Algorithm 1 has taken enough discs from a frame.
#[derive(Debug, Clone, PartialEq)]
pub enum StopRule {
    /// When the largest count left is below `mean + k sigma` of the noise floor, with `k` such that noise alone
    /// causes a false disc in a frame with this probability.
    FalseAlarms {
        /// Expected false discs per frame without light, for example 0.05.
        per_frame: f64,
    },
    /// As printed in the paper: when mean and standard deviation of the rest equal those of a background patch of the
    /// same frame, here within `tolerance` standard deviations of the patch. At least one disc is taken. On real
    /// frames this mostly stops at the limit on discs or after the first disc.
    Printed {
        /// The background patch.
        patch: Region,
        /// In standard deviations of the patch; the paper requires equality.
        tolerance: f64,
    },
}

impl Default for StopRule {
    fn default() -> Self {
        Self::FalseAlarms { per_frame: 0.05 }
    }
}

/// Settings of Algorithm 1.
#[derive(Debug, Clone, PartialEq)]
pub struct DenoiseSettings {
    /// Radius of the discs, which should be that of the dot: pixels strictly nearer to the brightest pixel are taken
    /// with it.
    pub radius_px: f64,
    /// When to stop.
    pub stop: StopRule,
    /// Largest number of discs per frame; frames that stop here are counted.
    pub max_discs: u32,
}

impl Default for DenoiseSettings {
    fn default() -> Self {
        Self { radius_px: 20.0, stop: StopRule::default(), max_discs: 64 }
    }
}

impl DenoiseSettings {
    pub(super) fn check(&self) -> Result<(), DotsError> {
        let radius_px = self.radius_px;
        check_range(
            "radius_px",
            radius_px,
            radius_px > 0.0 && radius_px <= 1024.0,
            "above 0 and at most 1024 pixels",
        )?;
        check_range("max_discs", self.max_discs.into(), self.max_discs > 0, "at least 1")?;
        match self.stop {
            StopRule::FalseAlarms { per_frame } => {
                let rare = per_frame > 0.0 && per_frame <= 0.5;
                check_range("stop.per_frame", per_frame, rare, "above 0 and at most 0.5, as 0.05")
            }
            StopRule::Printed { tolerance, .. } => {
                check_range("stop.tolerance", tolerance, tolerance >= 0.0, "at least 0 standard deviations")
            }
        }
    }
}

/// The number of standard deviations that the largest of `pixels` independent normal values exceeds with probability
/// `per_frame`, by Bonferroni's bound: 5.3 for 0.05 and a million pixels.
pub fn false_alarm_sigmas(per_frame: f64, pixels: usize) -> f64 {
    let tail = per_frame / pixels as f64;
    let (mut low, mut high) = (1.0, 40.0);
    // Bisection to the last bit of a double.
    for _ in 0..64 {
        let middle = (low + high) / 2.0;
        if normal_tail(middle) > tail { low = middle } else { high = middle }
    }
    high
}

/// Probability that a normal value exceeds `x >= 1`, from Laplace's continued fraction for Mills' ratio (Abramowitz
/// and Stegun 26.2.14).
fn normal_tail(x: f64) -> f64 {
    let ratio = (1..200).rev().fold(x, |below, n| x + f64::from(n) / below);
    (-x * x / 2.0).exp() / (2.0 * std::f64::consts::PI).sqrt() / ratio
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sigmas_are_those_of_tables() {
        // Tabulated quantiles of the normal distribution.
        for (tail, expected) in [(0.05, 1.644_853_627), (1e-3, 3.090_232_306), (2.866_515_719e-7, 5.0)] {
            assert!((false_alarm_sigmas(tail, 1) - expected).abs() < 1e-6, "{tail}");
        }
        assert!((false_alarm_sigmas(0.05, 1 << 20) - 5.33).abs() < 0.01);
    }
}
