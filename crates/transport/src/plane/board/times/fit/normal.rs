//! Normal equations of which each sample meets few unknowns.

use nalgebra::{DMatrix, DVector};

use super::super::model::{ExposureEdge, Sums};
use super::super::table::SplineTable;

/// Normal equations without the jitters of frames, and what is needed to find those afterwards.
pub(super) struct Normal {
    pub(super) matrix: DMatrix<f64>,
    pub(super) right: DVector<f64>,
    pub(super) frames: Vec<FrameNormal>,
}

/// One frame's part of the normal equations.
pub(super) struct FrameNormal {
    pub(super) frame: usize,
    pub(super) mixed: DVector<f64>,
    pub(super) weight: f64,
    pub(super) right: f64,
}

impl FrameNormal {
    /// Adds the samples of one camera row. The light is `closing` minus `opening`, and late light is an early edge.
    pub(super) fn add(
        &mut self,
        [opening, closing]: &[Sparse; 2],
        sums: &Sums,
        matrix: &mut DMatrix<f64>,
        right: &mut DVector<f64>,
    ) {
        let count = right.len();
        let matrix = matrix.as_mut_slice();
        for &(a, x) in opening.entries() {
            opening.entries().iter().for_each(|&(b, y)| matrix[b * count + a] += sums.opening_square * x * y);
            for &(b, y) in closing.entries() {
                matrix[b * count + a] -= sums.mixed * x * y;
                matrix[a * count + b] -= sums.mixed * x * y;
            }
            right[a] -= sums.opening_residual * x;
            self.mixed[a] -= (sums.opening_square - sums.mixed) * x;
        }
        for &(a, x) in closing.entries() {
            closing.entries().iter().for_each(|&(b, y)| matrix[b * count + a] += sums.closing_square * x * y);
            right[a] += sums.closing_residual * x;
            self.mixed[a] -= (sums.closing_square - sums.mixed) * x;
        }
        self.weight += sums.opening_square - 2.0 * sums.mixed + sums.closing_square;
        self.right += sums.opening_residual - sums.closing_residual;
    }
}

/// Derivative of an edge's time, relative to the light, to the unknowns.
#[derive(Default)]
pub(super) struct Sparse {
    entries: [(usize, f64); 8],
    count: usize,
}

impl Sparse {
    pub(super) fn push(&mut self, unknown: usize, value: f64) {
        self.entries[self.count] = (unknown, value);
        self.count += 1;
    }

    pub(super) fn entries(&self) -> &[(usize, f64)] {
        &self.entries[..self.count]
    }

    /// The light is late by the table at the place that is being drawn at the edge, not at the pixel's place.
    pub(super) fn add_table(&mut self, table: &SplineTable, edge: &ExposureEdge) {
        let (first, of_row) = table.weights(edge.row);
        let (of_next_first, of_next) = table.weights(edge.row + 1);
        // The two rows have their coefficients in common, or all but one: each entry costs as many products as there are.
        let mut sums = [0.0; 5];
        sums.iter_mut().zip(of_row).for_each(|(sum, weight)| *sum = -(1.0 - edge.fraction) * weight);
        let later = of_next_first - first;
        sums[later..].iter_mut().zip(of_next).for_each(|(sum, weight)| *sum -= edge.fraction * weight);
        sums[..4 + later].iter().enumerate().for_each(|(index, sum)| self.push(first + index, *sum));
    }
}

/// Adds the squares of third differences of the coefficients, which begin at `values`, to normal equations.
pub(super) fn add_third_differences(
    matrix: &mut DMatrix<f64>,
    right: &mut DVector<f64>,
    values: Option<&[f64]>,
    weight: f64,
) {
    const DIFFERENCE: [f64; 4] = [-1.0, 3.0, -3.0, 1.0];
    let count = values.map_or(matrix.nrows(), <[f64]>::len);
    for first in 0..count - 3 {
        let value: f64 = values.map_or(0.0, |values| {
            DIFFERENCE.iter().zip(&values[first..]).map(|(difference, value)| difference * value).sum()
        });
        for (a, x) in DIFFERENCE.iter().enumerate() {
            for (b, y) in DIFFERENCE.iter().enumerate() {
                matrix[(first + a, first + b)] += weight * x * y;
            }
            right[first + a] -= weight * x * value;
        }
    }
}
