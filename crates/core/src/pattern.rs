//! What a projector shows.

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
    /// A picture of the projector's size, from a PNG file.
    Image(PathBuf),
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
    #[error("weight {weight} of row {row}: allowed is 0 to 1")]
    Weight {
        /// The row.
        row: usize,
        /// Its weight.
        weight: f32,
    },
    /// Squares of size zero.
    #[error("checkerboard with cell_px = 0: give at least 1")]
    Cell,
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
            Self::Checkerboard { cell_px: 0, .. } => Err(PatternError::Cell),
            Self::Checkerboard { .. } | Self::Image(_) => Ok(None),
        }
    }
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
        let board = Pattern::Checkerboard { cell_px: 8, shift_px: (1, 0) };
        assert_eq!(board.row_weights(3), Ok(None));
    }

    #[test]
    fn what_does_not_fit_is_refused_with_field_and_value() {
        for (pattern, told) in [
            (Pattern::Line { row: 3 }, "row 3: the projector has 3 rows, 0 to 2"),
            (Pattern::Rows(vec![1.0; 2]), "2 rows"),
            (Pattern::Rows(vec![1.0, 1.5, 0.0]), "weight 1.5 of row 1"),
            (Pattern::Rows(vec![1.0, 0.0, f32::NAN]), "weight NaN of row 2"),
            (Pattern::Checkerboard { cell_px: 0, shift_px: (0, 0) }, "cell_px = 0"),
        ] {
            let error = pattern.row_weights(3).unwrap_err().to_string();
            assert!(error.contains(told), "{error}");
        }
    }
}
