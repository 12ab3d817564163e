//! `[sweep]`: the grid of delays and exposures.

use serde::Deserialize;

use crate::document::Document;

/// `[sweep]`: the grid of delays and exposures; the defaults are the paper's.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SweepPlan {
    /// Delays t_d.
    pub delay_us: Axis,
    /// Exposures t_e.
    pub exposure_us: Axis,
    /// Frames averaged per point.
    pub average: u32,
    /// Frames whose measured delay deviates by more than this are dropped and taken again.
    pub max_jitter_us: f64,
    /// One more image under less light, for pixels that saturate; `None`: not taken.
    pub bracket: Option<BracketPlan>,
}

/// `sweep.bracket`: the image under less light.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BracketPlan {
    /// Level of the grey picture that the projector shows, as a share of white.
    pub light: f64,
}

impl Default for SweepPlan {
    fn default() -> Self {
        Self {
            delay_us: Axis::Range { start: -1500.0, stop: 1500.0, count: 15 },
            exposure_us: Axis::Range { start: 600.0, stop: 1200.0, count: 5 },
            average: 8,
            max_jitter_us: 50.0,
            bracket: None,
        }
    }
}

/// Values along one axis of the sweep.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(
    untagged,
    expecting = "expected a list of numbers, or { start = .., stop = .., count = .. }",
    deny_unknown_fields
)]
pub enum Axis {
    /// A list of values, in this order.
    List(Vec<f64>),
    /// Evenly spaced values, both ends included.
    Range {
        /// First value.
        start: f64,
        /// Last value.
        stop: f64,
        /// Number of values.
        count: usize,
    },
}

impl Axis {
    /// The values in order.
    pub fn values(&self) -> Vec<f64> {
        match *self {
            Self::List(ref values) => values.clone(),
            Self::Range { start, count: 1, .. } => vec![start],
            Self::Range { start, stop, count } => {
                (0..count).map(|k| start + (stop - start) * k as f64 / (count - 1) as f64).collect()
            }
        }
    }

    /// Number of values.
    #[allow(clippy::len_without_is_empty, reason = "an axis without values is refused")]
    pub fn len(&self) -> usize {
        match self {
            Self::List(values) => values.len(),
            Self::Range { count, .. } => *count,
        }
    }
}

/// Maximum number of values along an axis.
const MAX_AXIS: u64 = 1024;
/// Maximum number of points of a sweep.
const MAX_POINTS: usize = 8192;
/// Maximum number of frames of a point: with 16 bits per pixel, their sum fits into 32 bits.
const MAX_AVERAGE: u64 = 65_536;

impl SweepPlan {
    /// Whether this table is valid in a plan.
    pub fn is_possible(&self) -> bool {
        let Ok(mut document) = Document::parse("") else { return false };
        self.check(&mut document);
        document.finish(Some(())).is_ok()
    }

    pub(super) fn check(&self, document: &mut Document<'_>) {
        let mut is_grid = true;
        for (key, axis) in [("delay_us", &self.delay_us), ("exposure_us", &self.exposure_us)] {
            if !(1..=MAX_AXIS).contains(&(axis.len() as u64)) {
                let message = format!("sweep.{key} has {} values: give 1 to {MAX_AXIS}", axis.len());
                document.refuse(&["sweep", key, "count"], message);
                is_grid = false;
            } else if let Some(value) = axis.values().into_iter().find(|value| !value.is_finite()) {
                let message = format!("sweep.{key} contains {value}: must be finite");
                document.refuse(&["sweep", key], message);
            }
        }
        let exposures = if is_grid { self.exposure_us.values() } else { Vec::new() };
        if let Some(value) = exposures.into_iter().find(|&exposure_us| exposure_us <= 0.0) {
            let message = format!("sweep.exposure_us contains {value}: must be more than 0 microseconds");
            document.refuse(&["sweep", "exposure_us"], message);
        }
        let points = self.delay_us.len() * self.exposure_us.len();
        if is_grid && points > MAX_POINTS {
            let message =
                format!("the sweep has {points} points: at most {MAX_POINTS} are allowed; split it");
            document.refuse(&["sweep"], message);
        }
        if !(1..=MAX_AVERAGE).contains(&self.average.into()) {
            let message = format!("sweep.average = {}: must be from 1 to {MAX_AVERAGE} frames", self.average);
            document.refuse(&["sweep", "average"], message);
        }
        document.check_positive(&["sweep", "max_jitter_us"], self.max_jitter_us, "microseconds");
        if let Some(BracketPlan { light }) = self.bracket
            && !(light > 0.0 && light < 1.0)
        {
            let message = format!(
                "sweep.bracket.light = {light}: must be more than 0 and less than 1, a share of white; 0.125 suits highlights of up to 8 times the limit"
            );
            document.refuse(&["sweep", "bracket", "light"], message);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::tests::{documented, parse};

    #[test]
    fn every_key_but_kind_has_a_default_and_it_is_the_papers_sweep() {
        let sweep = SweepPlan::default();
        assert_eq!(sweep.delay_us.values().len() * sweep.exposure_us.values().len(), 75);
        assert_eq!((sweep.delay_us.values()[0], sweep.delay_us.values()[14]), (-1500.0, 1500.0));
        assert_eq!(sweep.exposure_us.values(), [600.0, 750.0, 900.0, 1050.0, 1200.0]);
        assert_eq!(parse("kind = \"sweep\"").unwrap().stages[0].name, "demux");
    }

    #[test]
    fn a_bracket_is_a_share_of_white() {
        let sweep =
            |light: &str| parse(&format!("kind = \"sweep\"\n[sweep]\nbracket = {{ light = {light} }}"));
        assert!(sweep("0.125").is_ok());
        for light in ["0.0", "1.0", "-0.5", "nan"] {
            let error = sweep(light).unwrap_err().to_string();
            assert!(error.contains("sweep.bracket.light"), "{error}");
        }
        assert!(parse("kind = \"sweep\"\n[sweep]\nbracket = { level = 0.1 }").is_err());
    }

    #[test]
    fn the_documented_plan_file_is_the_defaults() {
        let (documented, default) = (parse(documented("sweep")).unwrap(), parse("kind = \"sweep\"").unwrap());
        assert_eq!(documented.procedure, default.procedure);
        assert_eq!((&documented.name, &documented.stages[0].name), (&default.name, &default.stages[0].name));
    }
}
