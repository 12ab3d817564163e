use std::ops::{Range, RangeInclusive};

/// Rows from one knot to the next.
const KNOT_ROWS: usize = 4;
/// Share of the rest of a period in which rows that are not seen may be drawn.
const PERIOD_USED: f64 = 0.999;
/// Rows beyond those seen that the spline covers, because their light reaches them.
const BORDER_ROWS: usize = 4;

/// The table of row starts as a cubic B-spline over the rows seen and [`BORDER_ROWS`] more. Weights of rows beyond continue
/// it with its outermost slopes, which tells how uncertain they are.
#[derive(Debug, Clone)]
pub(super) struct SplineTable {
    /// Number of coefficients.
    pub coefficients: usize,
    /// The row starts that the spline covers.
    covered: RangeInclusive<usize>,
    /// For each row start, the first of four coefficients and their weights.
    weights: Vec<(usize, [f64; 4])>,
}

impl SplineTable {
    pub fn new(projector_rows: usize, seen_rows: &Range<usize>) -> Self {
        let first = seen_rows.start.saturating_sub(BORDER_ROWS);
        let end = (seen_rows.end + BORDER_ROWS).min(projector_rows);
        let intervals = (end - first).div_ceil(KNOT_ROWS);
        let weights = (0..=projector_rows).map(|row| {
            let inside = row.clamp(first, end);
            let interval = ((inside - first) / KNOT_ROWS).min(intervals - 1);
            let x = (inside - first) as f64 / KNOT_ROWS as f64 - interval as f64;
            let rest = (row as f64 - inside as f64) / KNOT_ROWS as f64;
            let (value, slope) = (basis(x), basis_slope(x));
            (interval, std::array::from_fn(|index| value[index] + rest * slope[index]))
        });
        Self { coefficients: intervals + 3, covered: first..=end, weights: weights.collect() }
    }

    /// The first of the four coefficients on which a row's start depends, and their weights.
    #[inline]
    pub fn weights(&self, row: usize) -> (usize, &[f64; 4]) {
        let (first, weights) = &self.weights[row];
        (*first, weights)
    }

    /// Start of each row, and end of the last. Beyond the spline, the sweep goes on as it does over it, faster if the rows
    /// would not fit into a period: an outermost slope would carry the noise of a few rows, or a kink, over hundreds.
    pub fn starts_us(&self, coefficients: &[f64], period_us: f64) -> Vec<f64> {
        let start = |row: usize| -> f64 {
            let (first, weights) = self.weights(row);
            weights.iter().zip(&coefficients[first..]).map(|(weight, value)| weight * value).sum()
        };
        let (first, end) = (*self.covered.start(), *self.covered.end());
        let (from_us, to_us) = (start(first), start(end));
        let unseen = self.weights.len() - 1 - (end - first);
        let free_us = (period_us - (to_us - from_us)) * PERIOD_USED;
        let row_us = ((to_us - from_us) / (end - first) as f64).min(free_us / unseen.max(1) as f64);
        let continued = |row: usize| match row {
            row if row < first => from_us - (first - row) as f64 * row_us,
            row if row > end => to_us + (row - end) as f64 * row_us,
            row => start(row),
        };
        (0..self.weights.len()).map(continued).collect()
    }

    /// Weights of all coefficients in the start of a row, or of a fraction of it.
    pub fn weights_at(&self, row: f64) -> Vec<f64> {
        let whole = (row.max(0.0) as usize).min(self.weights.len() - 2);
        let fraction = row - whole as f64;
        let mut sum = vec![0.0; self.coefficients];
        for (row, share) in [(whole, 1.0 - fraction), (whole + 1, fraction)] {
            let (first, weights) = self.weights(row);
            sum[first..].iter_mut().zip(weights).for_each(|(sum, weight)| *sum += share * weight);
        }
        sum
    }
}

/// Values of the four cubic B-splines that overlap an interval, at `x` in 0..=1.
fn basis(x: f64) -> [f64; 4] {
    let y = 1.0 - x;
    [
        y * y * y / 6.0,
        (3.0 * x * x * x - 6.0 * x * x + 4.0) / 6.0,
        (3.0 * y * y * y - 6.0 * y * y + 4.0) / 6.0,
        x * x * x / 6.0,
    ]
}

/// Derivatives of [`basis`].
fn basis_slope(x: f64) -> [f64; 4] {
    let y = 1.0 - x;
    [-y * y / 2.0, (3.0 * x * x - 4.0 * x) / 2.0, (4.0 * y - 3.0 * y * y) / 2.0, x * x / 2.0]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_straight_table_stays_straight_beyond_the_rows_seen() {
        let table = SplineTable::new(720, &(296..424));
        // Coefficient k belongs to row 292 + KNOT_ROWS (k - 1).
        let coefficients: Vec<f64> =
            (0..table.coefficients).map(|k| 22.22 * (292.0 + KNOT_ROWS as f64 * (k as f64 - 1.0))).collect();
        for (row, start_us) in table.starts_us(&coefficients, 16_667.0).iter().enumerate() {
            assert!((start_us - 22.22 * row as f64).abs() < 1e-9, "row {row}: {start_us}");
        }
    }

    #[test]
    fn slopes_are_derivatives() {
        for x in [0.1, 0.5, 0.93] {
            let (above, below, slope) = (basis(x + 1e-6), basis(x - 1e-6), basis_slope(x));
            for index in 0..4 {
                assert!(((above[index] - below[index]) / 2e-6 - slope[index]).abs() < 1e-8, "{x} {index}");
            }
        }
    }
}
