//! Geometry of the rig as used by the built-in scenes, and patterns as drawn by the projector.
//!
//! Camera and projector are distant compared with a scene's depth, so both are modelled as parallel projections: x
//! right, y down, z towards the camera, all in pixels (one camera column = one row pitch). The projector stands to the
//! right of the camera; a point (x, y, z) is drawn by row y, at x - z tan(angle) along the row. The pair is therefore
//! rectified by construction, with disparity along the rows only. Neglected: perspective, inverse-square fall-off,
//! defocus.

use std::ops::Range;

use ndarray::{Array2, ArrayView2, s};

/// Tangent of the angle between the directions of projector and camera \[A\]: a baseline of a quarter of the distance.
pub(super) const PROJECTOR_TAN: f64 = 0.25;

/// Millimetres per projector row at the scene \[A\]: a 720-row frame is 360 mm high.
pub(super) const ROW_PITCH_MM: f64 = 0.5;

/// Unit vector from the scene towards the projector.
pub(super) fn to_projector() -> [f64; 3] {
    let cos = projector_cos();
    [PROJECTOR_TAN * cos, 0.0, cos]
}

/// Cosine of the projector's angle. A fronto-parallel plane receives irradiance 1; a surface with normal n receives
/// n · [`to_projector`] divided by this cosine.
pub(super) fn projector_cos() -> f64 {
    1.0 / (1.0 + PROJECTOR_TAN * PROJECTOR_TAN).sqrt()
}

/// Section of the x axis covered by the projector's columns 0..1.
#[derive(Debug, Clone, Copy)]
pub(super) struct ProjectorFrame {
    left_px: f64,
    width_px: f64,
}

impl ProjectorFrame {
    /// The narrowest frame that lights all of `columns` between the plane z = 0 and `depth_px`.
    pub(super) fn covering(columns: usize, depth_px: f64) -> Self {
        let left_px = -PROJECTOR_TAN * depth_px;
        Self { left_px, width_px: columns as f64 - left_px }
    }

    /// Projector column 0..1 that draws the point (x, z).
    pub(super) fn column(&self, x: f64, z: f64) -> f32 {
        (((x - PROJECTOR_TAN * z - self.left_px) / self.width_px).clamp(0.0, 1.0)) as f32
    }
}

/// A projected pattern, prepared for averages over sections of a row.
#[derive(Debug)]
pub(super) struct ColumnPattern {
    /// `[row, column + 1]`: running sum along each row.
    cumulative: Array2<f64>,
}

impl ColumnPattern {
    pub(super) fn new(pattern: ArrayView2<f32>) -> Self {
        let (rows, columns) = pattern.dim();
        let mut cumulative = Array2::zeros((rows, columns + 1));
        for ((row, column), &value) in pattern.indexed_iter() {
            cumulative[[row, column + 1]] = cumulative[[row, column]] + f64::from(value);
        }
        Self { cumulative }
    }

    /// The part of the pattern that falls on a panel, in coordinates relative to the panel's corner.
    pub(super) fn part(&self, rows: Range<usize>, columns: Range<f64>) -> PatternPart<'_> {
        PatternPart { cumulative: self.cumulative.slice(s![rows, ..]), columns }
    }
}

/// A rectangle of a [`ColumnPattern`] whose columns run from 0 to 1.
#[derive(Debug)]
pub(super) struct PatternPart<'a> {
    cumulative: ArrayView2<'a, f64>,
    columns: Range<f64>,
}

impl PatternPart<'_> {
    /// Mean of the pattern over the projector columns `from..to` (0..1) of a row; a section much narrower than a column
    /// is a point sample.
    pub(super) fn mean(&self, row: usize, (from, to): (f32, f32)) -> f32 {
        let count = (self.cumulative.ncols() - 1) as f64;
        let place = |u: f32| {
            let width = self.columns.end - self.columns.start;
            ((self.columns.start + f64::from(u) * width) * count).clamp(0.0, count)
        };
        let (from, to) = (place(from), place(to));
        let sums = self.cumulative.row(row);
        let cell = |x: f64| (x.floor() as usize).min(sums.len() - 2);
        let value = |cell: usize| sums[cell + 1] - sums[cell];
        let sum_to = |x: f64| sums[cell(x)] + (x - cell(x) as f64) * value(cell(x));
        if (to - from).abs() < 1e-4 {
            return value(cell(0.5 * (from + to))) as f32;
        }
        ((sum_to(to) - sum_to(from)) / (to - from)) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use ndarray::array;

    #[test]
    fn mean_weighs_partial_columns() {
        let pattern = ColumnPattern::new(array![[1.0, 0.0, 3.0, 5.0]].view());
        let part = pattern.part(0..1, 0.0..1.0);
        // Columns 0.5..2.5 contain half of 1, all of 0 and half of 3.
        assert!((part.mean(0, (0.125, 0.625)) - 1.0).abs() < 1e-6);
        assert_eq!(part.mean(0, (0.6, 0.6)), 3.0);
        assert_eq!(part.mean(0, (1.0, 1.0)), 5.0);
        let right = pattern.part(0..1, 0.5..1.0);
        assert_eq!(right.mean(0, (0.0, 1.0)), 4.0);
    }

    #[test]
    fn frame_covers_the_scene_and_nothing_more() {
        let frame = ProjectorFrame::covering(100, 40.0);
        assert_eq!(frame.column(0.0, 40.0), 0.0);
        assert_eq!(frame.column(100.0, 0.0), 1.0);
    }
}
