//! What a projector shows.

use std::f64::consts::TAU;
use std::fmt;
use std::path::PathBuf;

/// Columns of the pictures that raster projectors draw: 720p.
pub const PROJECTOR_COLUMNS: usize = 1280;

/// Most steps by which a checkerboard is shifted by the side of a square.
const MOST_STEPS: u32 = 32;

/// What a projector shows. Rows and columns count from the top left of its picture.
#[derive(Debug, Clone, PartialEq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Pattern {
    /// Every row fully lit.
    White,
    /// Every pixel at zero. A projector may leak some light then; [`crate::Projector::blank`] turns it off.
    Black,
    /// One row fully lit, the others dark.
    Line {
        /// The row.
        row: usize,
    },
    /// A weight in 0..=1 for each row, top row first.
    Rows(Vec<f32>),
    /// Alternating lit and dark squares. Unshifted, the one at the top left is lit.
    Checkerboard {
        /// Side of a square in pixels, at least 1.
        cell_px: u32,
        /// Shift of the board to the right and down in pixels: (x, y).
        shift_px: (u32, u32),
    },
    /// A lit cross through the middle of the picture.
    Cross {
        /// Width of its bars in pixels, at least 1.
        width_px: u32,
    },
    /// Every pixel at one level.
    Grey {
        /// The level, 0..=1.
        level: f32,
    },
    /// Every `period`-th row fully lit, beginning with row `phase`.
    SparseRows {
        /// The first lit row, less than `period`.
        phase: usize,
        /// From one lit row to the next.
        period: usize,
    },
    /// Rows lit where a bit of the binary-reflected Gray code of their block's number is set.
    GrayRows {
        /// The bit, 0 for the finest.
        bit: u32,
        /// Lights the rows where the bit is not set.
        inverse: bool,
        /// Rows of a block: row / `block` is the number of its block.
        block: usize,
    },
    /// [`Self::SparseRows`] over columns.
    SparseColumns {
        /// The first lit column, less than `period`.
        phase: usize,
        /// From one lit column to the next.
        period: usize,
    },
    /// [`Self::GrayRows`] over columns.
    GrayColumns {
        /// The bit, 0 for the finest.
        bit: u32,
        /// Lights the columns where the bit is not set.
        inverse: bool,
        /// Columns of a block.
        block: usize,
    },
    /// Lit and dark bars, each half a period wide. Unshifted, the first line is lit.
    Stripes {
        /// From one lit bar to the next, at least 2.
        period_px: u32,
        /// Shift to higher lines in pixels.
        phase_px: u32,
        /// The lines that make up a bar.
        lines: PatternLines,
    },
    /// A sinusoid over rows or columns: (1 + cos(2 pi (line / period - phase))) / 2.
    Sinusoid {
        /// From one maximum to the next, at least 2.
        period_px: f32,
        /// In periods, 0..=1.
        phase: f32,
        /// The lines over which it varies.
        lines: PatternLines,
    },
    /// A picture of the projector's size, from a PNG file.
    Image(PathBuf),
}

/// The lines of a picture that a pattern tells apart.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PatternLines {
    /// Each row has one brightness.
    #[default]
    Rows,
    /// Each column has one brightness.
    Columns,
}

impl fmt::Display for PatternLines {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Rows => "rows",
            Self::Columns => "columns",
        })
    }
}

/// What to show, for an operator: completes "make the projector show".
impl fmt::Display for Pattern {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::White => write!(f, "a white picture"),
            Self::Black => write!(f, "a black picture"),
            Self::Line { row } => write!(f, "row {row} lit"),
            Self::Rows(weights) => write!(f, "{} rows, each with a brightness of its own", weights.len()),
            Self::Checkerboard { cell_px, shift_px: (x, y) } => {
                write!(
                    f,
                    "a checkerboard of squares of {cell_px} pixels, shifted by {x} to the right and {y} down"
                )
            }
            Self::Cross { width_px } => write!(f, "a cross of bars of {width_px} pixels"),
            Self::Grey { level } => write!(f, "a grey picture of level {level}"),
            Self::SparseRows { phase, period } => write_sparse(f, "rows", *phase, *period),
            Self::GrayRows { bit, inverse, block } => write_gray(f, "row", *bit, *inverse, *block),
            Self::SparseColumns { phase, period } => write_sparse(f, "columns", *phase, *period),
            Self::GrayColumns { bit, inverse, block } => write_gray(f, "column", *bit, *inverse, *block),
            Self::Stripes { period_px, phase_px, lines } => {
                write!(f, "stripes of {lines} with a period of {period_px} pixels, shifted by {phase_px}")
            }
            Self::Sinusoid { period_px, phase, lines } => {
                write!(
                    f,
                    "a sinusoid over {lines} with a period of {period_px} pixels, shifted by {phase} periods"
                )
            }
            Self::Image(path) => write!(f, "the picture {}", path.display()),
        }
    }
}

fn write_sparse(f: &mut fmt::Formatter<'_>, lines: &str, phase: usize, period: usize) -> fmt::Result {
    let second = phase.saturating_add(period);
    write!(f, "{lines} {phase}, {second}, {}, ... lit", second.saturating_add(period))
}

fn write_gray(f: &mut fmt::Formatter<'_>, line: &str, bit: u32, inverse: bool, block: usize) -> fmt::Result {
    let inverted = if inverse { ", inverted" } else { "" };
    write!(f, "the Gray code of {line} blocks of {block}, bit {bit}{inverted}")
}

/// Why a pattern does not fit a projector.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PatternError {
    /// A line outside the picture.
    #[error("line at row {row}: the projector has {rows} rows, 0 to {}", rows.saturating_sub(1))]
    Line {
        /// The row asked for.
        row: usize,
        /// Rows of the projector.
        rows: usize,
    },
    /// The number of weights differs from the number of rows.
    #[error("the pattern has {given} rows, projector.rows = {rows}: give one weight for each row")]
    Rows {
        /// Rows of the pattern.
        given: usize,
        /// Rows of the projector.
        rows: usize,
    },
    /// A weight outside 0..=1.
    #[error("weight {weight} of row {row}: must be from 0 to 1")]
    Weight {
        /// The row.
        row: usize,
        /// Its weight.
        weight: f32,
    },
    /// Squares of size zero.
    #[error("checkerboard with cell_px = 0: give at least 1")]
    Cell,
    /// Bars of no width.
    #[error("cross with width_px = 0: give at least 1")]
    Bar,
    /// A level outside 0..=1.
    #[error("grey of level {0}: must be from 0 to 1")]
    Level(f32),
    /// A phase that is not within the period.
    #[error("sparse pattern with phase {phase} and period {period}: give a phase below the period")]
    Phase {
        /// The first lit row or column.
        phase: usize,
        /// From one lit row or column to the next.
        period: usize,
    },
    /// A period of less than two pixels.
    #[error("period_px = {0}: must be at least 2")]
    Period(f32),
    /// A sinusoid's phase outside 0..=1.
    #[error("phase = {0}: must be from 0 to 1, in periods")]
    SinusoidPhase(f32),
    /// A number of shifts that do not cover a checkerboard's period evenly.
    #[error("shifts = {shifts}: a checkerboard with size_px = {size_px} can be shifted {} times", allowed_shifts(*size_px))]
    Shifts {
        /// The number asked for.
        shifts: u32,
        /// Side of a square.
        size_px: u32,
    },
    /// A Gray code of blocks of no size, or of more bits than there are.
    #[error("Gray code with bit {bit} and blocks of {block}: give a bit up to 63 and blocks of at least 1")]
    Gray {
        /// The bit.
        bit: u32,
        /// Size of a block.
        block: usize,
    },
}

impl Pattern {
    /// A weight in 0..=1 for each of a projector's rows, if the pattern is constant along them; `None` if it is not.
    ///
    /// # Errors
    /// If the pattern does not fit a projector with `rows` rows.
    pub fn row_weights(&self, rows: usize) -> Result<Option<Vec<f32>>, PatternError> {
        match self {
            Self::White => Ok(Some(vec![1.0; rows])),
            Self::Black => Ok(Some(vec![0.0; rows])),
            Self::Line { row } if *row < rows => {
                let mut weights = vec![0.0; rows];
                weights[*row] = 1.0;
                Ok(Some(weights))
            }
            Self::Line { row } => Err(PatternError::Line { row: *row, rows }),
            Self::Rows(weights) if weights.len() != rows => {
                Err(PatternError::Rows { given: weights.len(), rows })
            }
            Self::Rows(weights) => {
                let outside = weights.iter().position(|weight| !(0.0..=1.0).contains(weight));
                match outside {
                    Some(row) => Err(PatternError::Weight { row, weight: weights[row] }),
                    None => Ok(Some(weights.clone())),
                }
            }
            Self::Grey { level } if (0.0..=1.0).contains(level) => Ok(Some(vec![*level; rows])),
            Self::Grey { level } => Err(PatternError::Level(*level)),
            Self::SparseRows { phase, period } => sparse(*phase, *period, rows).map(Some),
            Self::GrayRows { bit, inverse, block } => gray(*bit, *inverse, *block, rows).map(Some),
            Self::Stripes { lines: PatternLines::Rows, .. }
            | Self::Sinusoid { lines: PatternLines::Rows, .. } => self.line_weights(rows).map(Some),
            Self::Stripes { .. } | Self::Sinusoid { .. } => self.line_weights(1).map(|_| None),
            Self::Checkerboard { cell_px: 0, .. } => Err(PatternError::Cell),
            Self::Cross { width_px: 0 } => Err(PatternError::Bar),
            Self::Cross { .. }
            | Self::SparseColumns { .. }
            | Self::GrayColumns { .. }
            | Self::Checkerboard { .. }
            | Self::Image(_) => Ok(None),
        }
    }

    /// A weight in 0..=1 for each of a projector's columns, if the pattern is the same in every row and is not constant
    /// along them; `None` for other patterns.
    ///
    /// # Errors
    /// If the pattern is wrong in itself.
    pub fn column_weights(&self, columns: usize) -> Result<Option<Vec<f32>>, PatternError> {
        match self {
            Self::SparseColumns { phase, period } => sparse(*phase, *period, columns).map(Some),
            Self::GrayColumns { bit, inverse, block } => gray(*bit, *inverse, *block, columns).map(Some),
            Self::Stripes { lines: PatternLines::Columns, .. }
            | Self::Sinusoid { lines: PatternLines::Columns, .. } => self.line_weights(columns).map(Some),
            _ => Ok(None),
        }
    }

    /// The weights of the lines of stripes or a sinusoid; of no lines for other patterns.
    fn line_weights(&self, count: usize) -> Result<Vec<f32>, PatternError> {
        match *self {
            Self::Stripes { period_px, .. } if period_px < 2 => Err(PatternError::Period(period_px as f32)),
            Self::Stripes { period_px, phase_px, .. } => {
                let (period, phase) = (period_px as usize, (phase_px % period_px) as usize);
                Ok((0..count).map(|at| f32::from(2 * ((at + period - phase) % period) < period)).collect())
            }
            Self::Sinusoid { period_px, .. } if !(period_px >= 2.0 && period_px.is_finite()) => {
                Err(PatternError::Period(period_px))
            }
            Self::Sinusoid { phase, .. } if !(0.0..=1.0).contains(&phase) => {
                Err(PatternError::SinusoidPhase(phase))
            }
            Self::Sinusoid { period_px, phase, .. } => {
                let turns = |at: usize| at as f64 / f64::from(period_px) - f64::from(phase);
                Ok((0..count).map(|at| (0.5 + 0.5 * (TAU * turns(at)).cos()) as f32).collect())
            }
            _ => Ok(Vec::new()),
        }
    }

    /// Checkerboards of squares of `size_px`, shifted in even steps over their whole period, row of shifts after row: as
    /// many different ones as there are `shifts`, which is twice the square of the number of steps to a square. At
    /// least four steps are needed to see how sharp the edges are.
    ///
    /// # Errors
    /// [`PatternError::Shifts`] for another number.
    pub fn shifted_checkerboards(size_px: u32, shifts: u32) -> Result<Vec<Self>, PatternError> {
        let steps = steps_of(size_px).find(|steps| 2 * steps * steps == shifts);
        let Some(steps) = steps else { return Err(PatternError::Shifts { shifts, size_px }) };
        let step_px = size_px / steps;
        // A shift by a square to the right and one down changes nothing, so half of the shifts down suffice.
        let shift = |y: u32| (0..2 * steps).map(move |x| (x * step_px, y * step_px));
        let shifts = (0..steps).flat_map(shift);
        Ok(shifts.map(|shift_px| Self::Checkerboard { cell_px: size_px, shift_px }).collect())
    }

    /// A weight in 0..=1 for each of a projector's pixels, row by row; `None` for a picture from a file.
    ///
    /// # Errors
    /// If the pattern does not fit a projector of `columns` and `rows`.
    pub fn pixel_weights(&self, (columns, rows): (usize, usize)) -> Result<Option<Vec<f32>>, PatternError> {
        if let Some(weights) = self.row_weights(rows)? {
            let pixels = weights.iter().flat_map(|&weight| std::iter::repeat_n(weight, columns));
            return Ok(Some(pixels.collect()));
        }
        if let Some(weights) = self.column_weights(columns)? {
            return Ok(Some(weights.repeat(rows)));
        }
        if let Self::Cross { width_px } = self {
            let width = *width_px as usize;
            let is_bar = |at: usize, count: usize| (2 * at + 1).abs_diff(count) < width.max(1);
            let pixels = (0..rows).flat_map(|y| (0..columns).map(move |x| (x, y)));
            return Ok(Some(pixels.map(|(x, y)| f32::from(is_bar(x, columns) || is_bar(y, rows))).collect()));
        }
        let Self::Checkerboard { cell_px, shift_px } = self else { return Ok(None) };
        let cell = *cell_px as usize;
        // The checkerboard repeats after two cells, so shifts are taken modulo two cells.
        let lit_half =
            |at: usize, shift: u32| ((at + 2 * cell - shift as usize % (2 * cell)) / cell).is_multiple_of(2);
        let pixel = |x, y| lit_half(x, shift_px.0) == lit_half(y, shift_px.1);
        let pixels = (0..rows).flat_map(|y| (0..columns).map(move |x| (x, y)));
        Ok(Some(pixels.map(|(x, y)| f32::from(pixel(x, y))).collect()))
    }
}

/// The numbers of steps in which a checkerboard can be shifted by the side of a square.
fn steps_of(size_px: u32) -> impl Iterator<Item = u32> {
    (4..=size_px.min(MOST_STEPS)).filter(move |steps| size_px.is_multiple_of(*steps))
}

fn allowed_shifts(size_px: u32) -> String {
    let allowed: Vec<String> = steps_of(size_px).map(|steps| (2 * steps * steps).to_string()).collect();
    match allowed.as_slice() {
        [] => "in no useful number of steps; give a multiple of 4 pixels".into(),
        [only] => only.clone(),
        [first @ .., last] => format!("{} or {last}", first.join(", ")),
    }
}

fn sparse(phase: usize, period: usize, count: usize) -> Result<Vec<f32>, PatternError> {
    if phase >= period {
        return Err(PatternError::Phase { phase, period });
    }
    Ok((0..count).map(|at| f32::from(at % period == phase)).collect())
}

fn gray(bit: u32, inverse: bool, block: usize, count: usize) -> Result<Vec<f32>, PatternError> {
    if block == 0 || bit > 63 {
        return Err(PatternError::Gray { bit, block });
    }
    let code = |number: u64| number ^ (number >> 1);
    let is_set = |at: usize| (code((at / block) as u64) >> bit) & 1 == 1;
    Ok((0..count).map(|at| f32::from(is_set(at) != inverse)).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn weights_are_those_of_the_rows() {
        let weights = |pattern: Pattern| pattern.row_weights(3).unwrap().unwrap();
        assert_eq!(weights(Pattern::White), [1.0; 3]);
        assert_eq!(weights(Pattern::Black), [0.0; 3]);
        assert_eq!(weights(Pattern::Line { row: 2 }), [0.0, 0.0, 1.0]);
        assert_eq!(weights(Pattern::Rows(vec![0.0, 0.5, 1.0])), [0.0, 0.5, 1.0]);
        assert_eq!(weights(Pattern::Grey { level: 0.25 }), [0.25; 3]);
        assert_eq!(weights(Pattern::SparseRows { phase: 1, period: 2 }), [0.0, 1.0, 0.0]);
        let board = Pattern::Checkerboard { cell_px: 8, shift_px: (1, 0) };
        assert_eq!(board.row_weights(3), Ok(None));
    }

    #[test]
    fn neighbouring_blocks_of_the_gray_code_differ_in_one_bit() {
        let rows =
            |bit, inverse| Pattern::GrayRows { bit, inverse, block: 2 }.row_weights(32).unwrap().unwrap();
        let bits: Vec<_> = (0..4).map(|bit| rows(bit, false)).collect();
        let code = |row: usize| bits.iter().map(|bit| bit[row] as u32).collect::<Vec<_>>();
        for row in 1..32 {
            let changed = code(row).iter().zip(code(row - 1)).filter(|(a, b)| **a != *b).count();
            assert_eq!(changed, usize::from(row % 2 == 0), "row {row}");
        }
        assert_eq!(code(2 * 5), [1, 1, 1, 0], "5 is 0111");
        assert!((0..32).all(|row| rows(3, true)[row] == 1.0 - rows(3, false)[row]));
    }

    #[test]
    fn patterns_over_columns_are_the_same_in_every_row() {
        let sparse = Pattern::SparseColumns { phase: 1, period: 3 };
        assert_eq!(sparse.row_weights(2), Ok(None));
        assert_eq!(sparse.column_weights(4), Ok(Some(vec![0.0, 1.0, 0.0, 0.0])));
        let pixels = sparse.pixel_weights((4, 2)).unwrap().unwrap();
        assert_eq!(pixels, [0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0]);
        let gray = Pattern::GrayColumns { bit: 0, inverse: false, block: 1 };
        assert_eq!(gray.column_weights(4), Ok(Some(vec![0.0, 1.0, 1.0, 0.0])));
        assert_eq!(Pattern::White.column_weights(4), Ok(None));
    }

    #[test]
    fn a_cross_has_bars_of_its_width_through_the_middle() {
        let lit = |width_px, columns, rows| {
            let pixels = Pattern::Cross { width_px }.pixel_weights((columns, rows)).unwrap().unwrap();
            let lit = |x: usize, y: usize| pixels[y * columns + x] == 1.0;
            let along = |count, at: &dyn Fn(usize) -> bool| (0..count).filter(|&i| at(i)).collect::<Vec<_>>();
            (along(columns, &|x| lit(x, 0)), along(rows, &|y| lit(0, y)))
        };
        assert_eq!(lit(2, 8, 6), (vec![3, 4], vec![2, 3]));
        assert_eq!(lit(4, 8, 6), (vec![2, 3, 4, 5], vec![1, 2, 3, 4]));
        assert_eq!(lit(1, 7, 5), (vec![3], vec![2]));
    }

    #[test]
    fn stripes_and_sinusoids_vary_over_their_lines_alone() {
        let stripes = |lines| Pattern::Stripes { period_px: 4, phase_px: 1, lines };
        assert_eq!(stripes(PatternLines::Rows).row_weights(6), Ok(Some(vec![0.0, 1.0, 1.0, 0.0, 0.0, 1.0])));
        assert_eq!(stripes(PatternLines::Columns).row_weights(6), Ok(None));
        assert_eq!(stripes(PatternLines::Columns).column_weights(3), Ok(Some(vec![0.0, 1.0, 1.0])));
        let sinusoid = |phase| Pattern::Sinusoid { period_px: 4.0, phase, lines: PatternLines::Rows };
        let weights = sinusoid(0.25).row_weights(4).unwrap().unwrap();
        let expected = [0.5, 1.0, 0.5, 0.0];
        assert!(weights.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6), "{weights:?}");
        assert_eq!(sinusoid(1.5).row_weights(4), Err(PatternError::SinusoidPhase(1.5)));
        let thin = Pattern::Stripes { period_px: 1, phase_px: 0, lines: PatternLines::Columns };
        assert_eq!(thin.row_weights(4), Err(PatternError::Period(1.0)));
    }

    #[test]
    fn shifted_checkerboards_differ_and_light_each_pixel_half_of_the_time() {
        let boards = Pattern::shifted_checkerboards(24, 128).unwrap();
        let mut sum = vec![0.0; 60 * 50];
        let mut seen: Vec<Vec<f32>> = Vec::new();
        for board in &boards {
            let weights = board.pixel_weights((60, 50)).unwrap().unwrap();
            sum.iter_mut().zip(&weights).for_each(|(sum, weight)| *sum += weight);
            assert!(!seen.contains(&weights), "{board:?} comes twice");
            seen.push(weights);
        }
        assert_eq!((seen.len(), sum.iter().all(|&sum| sum == 64.0)), (128, true));
        let error = Pattern::shifted_checkerboards(24, 100).unwrap_err().to_string();
        assert!(error.contains("32, 72, 128, 288 or 1152"), "{error}");
        assert!(Pattern::shifted_checkerboards(5, 8).unwrap_err().to_string().contains("50"));
        assert!(Pattern::shifted_checkerboards(3, 8).unwrap_err().to_string().contains("multiple of 4"));
    }

    #[test]
    fn patterns_are_described_in_words() {
        for (pattern, words) in [
            (Pattern::White, "a white picture"),
            (Pattern::Line { row: 7 }, "row 7 lit"),
            (Pattern::Rows(vec![0.5; 4]), "4 rows, each with a brightness of its own"),
            (
                Pattern::Checkerboard { cell_px: 8, shift_px: (4, 0) },
                "a checkerboard of squares of 8 pixels, shifted by 4 to the right and 0 down",
            ),
            (Pattern::Cross { width_px: 4 }, "a cross of bars of 4 pixels"),
            (Pattern::Grey { level: 0.5 }, "a grey picture of level 0.5"),
            (Pattern::SparseRows { phase: 3, period: 16 }, "rows 3, 19, 35, ... lit"),
            (Pattern::SparseColumns { phase: 0, period: 2 }, "columns 0, 2, 4, ... lit"),
            (
                Pattern::GrayRows { bit: 3, inverse: true, block: 4 },
                "the Gray code of row blocks of 4, bit 3, inverted",
            ),
            (
                Pattern::GrayColumns { bit: 0, inverse: false, block: 1 },
                "the Gray code of column blocks of 1, bit 0",
            ),
            (Pattern::Image("board.png".into()), "the picture board.png"),
        ] {
            assert_eq!(pattern.to_string(), words);
        }
    }

    #[test]
    fn what_does_not_fit_is_refused_with_field_and_value() {
        for (pattern, told) in [
            (Pattern::Line { row: 3 }, "row 3: the projector has 3 rows, 0 to 2"),
            (Pattern::Rows(vec![1.0; 2]), "2 rows"),
            (Pattern::Rows(vec![1.0, 1.5, 0.0]), "weight 1.5 of row 1"),
            (Pattern::Rows(vec![1.0, 0.0, f32::NAN]), "weight NaN of row 2"),
            (Pattern::Checkerboard { cell_px: 0, shift_px: (0, 0) }, "cell_px = 0"),
            (Pattern::Cross { width_px: 0 }, "width_px = 0"),
            (Pattern::Grey { level: 1.5 }, "level 1.5"),
            (Pattern::SparseRows { phase: 3, period: 3 }, "phase 3 and period 3"),
            (Pattern::SparseColumns { phase: 0, period: 0 }, "period 0"),
            (Pattern::GrayRows { bit: 0, inverse: false, block: 0 }, "blocks of 0"),
            (Pattern::GrayColumns { bit: 64, inverse: false, block: 1 }, "bit 64"),
        ] {
            let error = pattern.pixel_weights((2, 3)).unwrap_err().to_string();
            assert!(error.contains(told), "{error}");
        }
    }
}
