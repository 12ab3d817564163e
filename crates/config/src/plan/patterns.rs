//! `[patterns]` and `[[pattern]]`: the same few settings of the camera under each of many pictures.

use raysweep_core::{Pattern, PatternError, PatternLines};
use serde::Deserialize;

use super::Axis;
use crate::document::{Document, counted};
use crate::whole::whole;

/// `[patterns]`: what is taken under each picture.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PatternsPlan {
    /// Delays t_d, in microseconds.
    pub delay_us: Axis,
    /// Exposures t_e, in microseconds.
    pub exposure_us: Axis,
    /// Whether the regular image is taken under each picture too, with a whole VSYNC period of exposure.
    pub regular: bool,
    /// Frames averaged for each image.
    #[serde(deserialize_with = "whole::<_, 1, 65_536>")]
    pub average: u32,
    /// Frames whose measured delay deviates by more than this are dropped.
    pub max_jitter_us: f64,
    /// `[[pattern]]`, in the order of acquisition.
    #[serde(skip)]
    pub pattern: Vec<PatternPlan>,
}

impl Default for PatternsPlan {
    fn default() -> Self {
        Self {
            delay_us: Axis::List(vec![0.0]),
            exposure_us: Axis::List(vec![600.0]),
            regular: true,
            average: 4,
            max_jitter_us: 50.0,
            pattern: vec![PatternPlan::Checkerboard { size_px: SIZE_PX, shifts: SHIFTS }],
        }
    }
}

/// Side of a checkerboard's squares in the paper, and the number of its shifts.
const SIZE_PX: u32 = 24;
const SHIFTS: u32 = 128;
/// Most pictures.
const MAX_PATTERNS: usize = 1024;
/// Most images under all pictures.
const MAX_IMAGES: usize = 8192;
/// More rows than any projector has.
const MOST_ROWS: usize = 1 << 16;
/// Most delays and exposures.
const MAX_AXIS: usize = 256;

/// `[[pattern]]`: a picture, or a series of them.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case", deny_unknown_fields)]
pub enum PatternPlan {
    /// All pixels lit.
    White {},
    /// No pixel lit, with the projector on.
    Black {},
    /// One row lit.
    Line {
        /// The row.
        row: usize,
    },
    /// A brightness for each row.
    Rows {
        /// From 0 to 1, top row first.
        weights: Vec<f32>,
    },
    /// A checkerboard at all shifts, by which direct and global light are separated.
    Checkerboard {
        /// Side of a square.
        #[serde(default = "size_px")]
        size_px: u32,
        /// Number of shifts.
        #[serde(default = "shifts")]
        shifts: u32,
    },
    /// Lit and dark bars.
    Stripes {
        /// From one lit bar to the next.
        period_px: u32,
        /// Shift to higher rows or columns.
        #[serde(default)]
        phase_px: u32,
        /// Whether bars are rows or columns.
        #[serde(default)]
        direction: PatternLines,
    },
    /// The bits of the Gray code of rows or columns, the highest first, each followed by its inverse.
    GrayCode {
        /// Whether rows or columns are coded.
        #[serde(default)]
        direction: PatternLines,
        /// Rows or columns with the same code.
        #[serde(default = "one")]
        block_px: usize,
        /// Number of rows or columns; default for rows: the projector's.
        lines: Option<usize>,
    },
    /// Sinusoids, each shifted against the one before by the same part of a period.
    PhaseShift {
        /// From one maximum to the next.
        period_px: f32,
        /// Number of shifts.
        #[serde(default = "three")]
        steps: u32,
        /// Whether the brightness changes from row to row or from column to column.
        #[serde(default)]
        direction: PatternLines,
    },
}

fn size_px() -> u32 {
    SIZE_PX
}

fn shifts() -> u32 {
    SHIFTS
}

fn one() -> usize {
    1
}

fn three() -> u32 {
    3
}

/// Why a `[[pattern]]` cannot be shown.
#[derive(Debug, thiserror::Error)]
pub enum PatternRefused {
    /// One of its pictures.
    #[error(transparent)]
    Pattern(#[from] PatternError),
    /// How many columns there are is not known.
    #[error("lines is missing: give the number of columns that the projector has")]
    Columns,
    /// A number out of its range.
    #[error("{key} = {value}: must be {allowed}")]
    Number {
        /// The key.
        key: &'static str,
        /// Its value.
        value: f64,
        /// What is allowed.
        allowed: &'static str,
    },
}

impl PatternPlan {
    /// The pictures for a projector with this many rows.
    ///
    /// # Errors
    /// If they do not fit it.
    pub fn pictures(&self, projector_rows: usize) -> Result<Vec<Pattern>, PatternRefused> {
        let number = |key, value, allowed| PatternRefused::Number { key, value, allowed };
        let pictures = match *self {
            Self::White {} => vec![Pattern::White],
            Self::Black {} => vec![Pattern::Black],
            Self::Line { row } => vec![Pattern::Line { row }],
            Self::Rows { ref weights } => vec![Pattern::Rows(weights.clone())],
            Self::Checkerboard { size_px, shifts } => Pattern::shifted_checkerboards(size_px, shifts)?,
            Self::Stripes { period_px, phase_px, direction } => {
                vec![Pattern::Stripes { period_px, phase_px, lines: direction }]
            }
            Self::GrayCode { direction, block_px: block, lines } => {
                let lines = match (direction, lines) {
                    (_, Some(lines)) => lines,
                    (PatternLines::Rows, None) => projector_rows,
                    (PatternLines::Columns, None) => return Err(PatternRefused::Columns),
                };
                if !(2..=65_536).contains(&lines) {
                    return Err(number("lines", lines as f64, "from 2 to 65536"));
                }
                if !(1..lines).contains(&block) {
                    return Err(number(
                        "block_px",
                        block as f64,
                        "at least 1 and less than the number of lines",
                    ));
                }
                let bits = usize::BITS - (lines.div_ceil(block) - 1).leading_zeros();
                let picture = |bit, inverse| match direction {
                    PatternLines::Rows => Pattern::GrayRows { bit, inverse, block },
                    PatternLines::Columns => Pattern::GrayColumns { bit, inverse, block },
                };
                (0..bits).rev().flat_map(|bit| [picture(bit, false), picture(bit, true)]).collect()
            }
            Self::PhaseShift { period_px, steps, direction } => {
                if !(3..=64).contains(&steps) {
                    return Err(number("steps", steps.into(), "from 3 to 64"));
                }
                let phase = |step: u32| step as f32 / steps as f32;
                (0..steps)
                    .map(|step| Pattern::Sinusoid { period_px, phase: phase(step), lines: direction })
                    .collect()
            }
        };
        for picture in &pictures {
            picture.row_weights(projector_rows)?;
        }
        Ok(pictures)
    }
}

impl PatternsPlan {
    /// Delay and exposure of each image of the grid, the exposure in the outer loop.
    pub fn settings_us(&self) -> Vec<(f64, f64)> {
        let delays = self.delay_us.values();
        let exposures = self.exposure_us.values();
        exposures.iter().flat_map(|&exposure| delays.iter().map(move |&delay| (delay, exposure))).collect()
    }

    /// Takes over `[[pattern]]`.
    pub(super) fn with_patterns(self, pattern: Option<Vec<PatternPlan>>) -> Self {
        Self { pattern: pattern.unwrap_or(self.pattern), ..self }
    }

    pub(super) fn check(&self, document: &mut Document<'_>) {
        for (key, axis, least_us) in
            [("delay_us", &self.delay_us, f64::NEG_INFINITY), ("exposure_us", &self.exposure_us, 0.0)]
        {
            let path = ["patterns", key];
            let name = path.join(".");
            if !(1..=MAX_AXIS).contains(&axis.len()) {
                let message = format!("{name} has {}: give 1 to {MAX_AXIS}", counted(axis.len(), "value"));
                document.refuse(&path, message);
                continue;
            }
            let values = axis.values();
            if let Some(value) = values.iter().find(|us| !(us.is_finite() && **us > least_us)) {
                let allowed = if least_us == 0.0 { "more than 0 microseconds" } else { "finite" };
                document.refuse(&path, format!("{name} contains {value}: must be {allowed}"));
            } else if let Some(value) = axis.repeated() {
                document
                    .refuse(&path, format!("{name} contains {value} more than once: give each value once"));
            }
        }
        document.check_count(&["patterns", "average"], self.average.into(), 1..=65_536);
        document.check_range(&["patterns", "max_jitter_us"], self.max_jitter_us, 0.1..=10_000.0);
        self.check_patterns(document);
    }

    /// Checks the pictures as far as that is possible without a rig.
    fn check_patterns(&self, document: &mut Document<'_>) {
        if self.pattern.is_empty() {
            document
                .refuse(&["pattern"], "the plan has no [[pattern]]: give at least one, or leave the key out");
        }
        let mut pictures = 0_usize;
        for (index, pattern) in self.pattern.iter().enumerate() {
            match pattern.pictures(MOST_ROWS) {
                Ok(made) => pictures += made.len(),
                // Which rows there are is known with the rig.
                Err(PatternRefused::Pattern(PatternError::Rows { .. } | PatternError::Line { .. })) => {
                    pictures += 1;
                }
                Err(error) => document.refuse(&["pattern", &index.to_string()], error.to_string()),
            }
        }
        let settings = self.settings_us().len() + usize::from(self.regular);
        if pictures > MAX_PATTERNS {
            let message =
                format!("[[pattern]] asks for {pictures} pictures: at most {MAX_PATTERNS} are allowed");
            document.refuse(&["pattern"], message);
        } else if pictures.saturating_mul(settings) > MAX_IMAGES {
            let message = format!(
                "{pictures} pictures with {} make {} images: at most {MAX_IMAGES} are allowed",
                counted(settings, "setting"),
                pictures * settings
            );
            document.refuse(&["pattern"], message);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::tests::{documented, parse};
    use crate::plan::{Plan, Procedure};

    fn patterns(text: &str) -> Result<PatternsPlan, String> {
        let plan = parse(&format!("kind = \"patterns\"\n{text}")).map_err(|error| error.to_string())?;
        match plan.procedure {
            Procedure::Patterns(patterns) => Ok(patterns),
            other => Err(format!("{other:?}")),
        }
    }

    #[test]
    fn the_default_is_the_documented_one() {
        let documented = Plan::parse(documented("patterns")).unwrap();
        assert_eq!(documented.procedure, Procedure::Patterns(PatternsPlan::default()));
    }

    #[test]
    fn every_kind_of_pattern_makes_its_pictures() {
        let text = r#"
            [[pattern]]
            kind = "white"
            [[pattern]]
            kind = "black"
            [[pattern]]
            kind = "line"
            row = 3
            [[pattern]]
            kind = "rows"
            weights = [0.0, 0.5, 1.0, 0.0]
            [[pattern]]
            kind = "checkerboard"
            size_px = 8
            shifts = 32
            [[pattern]]
            kind = "stripes"
            period_px = 2
            direction = "columns"
            [[pattern]]
            kind = "gray-code"
            [[pattern]]
            kind = "gray-code"
            direction = "columns"
            lines = 5
            [[pattern]]
            kind = "phase-shift"
            period_px = 3.5
            steps = 4
        "#;
        let plan = patterns(text).unwrap();
        let made: Vec<usize> =
            plan.pattern.iter().map(|pattern| pattern.pictures(4).unwrap().len()).collect();
        assert_eq!(made, [1, 1, 1, 1, 32, 1, 4, 6, 4]);
    }

    #[test]
    fn what_cannot_be_shown_is_refused_with_its_key() {
        for (text, said) in [
            ("[[pattern]]\nkind = \"checkerboard\"\nshifts = 100", "32, 72, 128, 288 or 1152"),
            ("[[pattern]]\nkind = \"checkerboard\"\nsize_px = 0", "size_px = 0"),
            ("[[pattern]]\nkind = \"stripes\"\nperiod_px = 1", "period_px = 1: must be at least 2"),
            ("[[pattern]]\nkind = \"gray-code\"\ndirection = \"columns\"", "lines is missing"),
            ("[[pattern]]\nkind = \"gray-code\"\nblock_px = 0", "block_px = 0"),
            (
                "[[pattern]]\nkind = \"phase-shift\"\nperiod_px = 8\nsteps = 2",
                "steps = 2: must be from 3 to 64",
            ),
            ("[[pattern]]\nkind = \"phase-shift\"\nperiod_px = nan", "period_px = NaN"),
            ("[[pattern]]\nkind = \"plaid\"", "plaid"),
            ("[[pattern]]\nkind = \"white\"\nlevel = 1", "level"),
            ("pattern = []", "no [[pattern]]"),
            ("[patterns]\nexposure_us = [0]", "patterns.exposure_us contains 0"),
            ("[patterns]\ndelay_us = [1, 1]", "more than once"),
            ("[patterns]\naverage = 0", "patterns.average = 0"),
            ("[patterns]\ndelay_us = { start = 0, stop = 99, count = 100 }", "at most 8192"),
        ] {
            let error = patterns(text).unwrap_err();
            assert!(error.contains(said), "{text}: {error}");
        }
        let error = parse("kind = \"sweep\"\n[[pattern]]\nkind = \"white\"").unwrap_err().to_string();
        assert!(error.contains("kind = \"patterns\""), "{error}");
    }

    #[test]
    fn rows_are_checked_against_the_projector() {
        let pictures = |text| patterns(text).unwrap().pattern[0].pictures(4);
        assert!(
            pictures("[[pattern]]\nkind = \"line\"\nrow = 4").unwrap_err().to_string().contains("4 rows")
        );
        let weights = "[[pattern]]\nkind = \"rows\"\nweights = [1, 2]";
        assert!(pictures(weights).unwrap_err().to_string().contains("2 rows"));
    }
}
