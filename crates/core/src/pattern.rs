//! What a projector shows.

use std::fmt;
use std::path::PathBuf;

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
    /// A picture of the projector's size, from a PNG file.
    Image(PathBuf),
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
            Self::Grey { level } => write!(f, "a grey picture of level {level}"),
            Self::SparseRows { phase, period } => write_sparse(f, "rows", *phase, *period),
            Self::GrayRows { bit, inverse, block } => write_gray(f, "row", *bit, *inverse, *block),
            Self::SparseColumns { phase, period } => write_sparse(f, "columns", *phase, *period),
            Self::GrayColumns { bit, inverse, block } => write_gray(f, "column", *bit, *inverse, *block),
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
            Self::Checkerboard { cell_px: 0, .. } => Err(PatternError::Cell),
            Self::SparseColumns { .. }
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
            _ => Ok(None),
        }
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
    fn patterns_are_described_in_words() {
        for (pattern, words) in [
            (Pattern::White, "a white picture"),
            (Pattern::Line { row: 7 }, "row 7 lit"),
            (Pattern::Rows(vec![0.5; 4]), "4 rows, each with a brightness of its own"),
            (
                Pattern::Checkerboard { cell_px: 8, shift_px: (4, 0) },
                "a checkerboard of squares of 8 pixels, shifted by 4 to the right and 0 down",
            ),
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
