//! Objects of built-in scenes: their direct and indirect light, and their place in the image.

use std::fmt;
use std::ops::Range;

use ndarray::{Array2, Array3, ArrayViewMut3, ArrayViewMut4, Axis, s};

use super::projector::PatternPart;
use super::size::SceneSize;

/// One object of a built-in scene and its position in the image.
#[derive(Debug)]
pub(super) struct Panel {
    /// Camera (and projector) row and camera column of the upper left corner.
    pub(super) row: usize,
    pub(super) column: usize,
    /// Range of projector columns that lights the object.
    pub(super) projector_columns: Range<f64>,
    pub(super) object: Object,
}

impl Panel {
    pub(super) fn whole(object: Object) -> Self {
        Self { row: 0, column: 0, projector_columns: 0.0..1.0, object }
    }

    pub(super) fn rows(&self) -> Range<usize> {
        self.row..self.row + self.object.direct.value.len_of(Axis(0))
    }

    pub(super) fn columns(&self) -> Range<usize> {
        self.column..self.column + self.object.direct.value.len_of(Axis(1))
    }

    pub(super) fn add_transport(&self, mut transport: ArrayViewMut4<f32>) {
        for (row, direct) in self.object.direct.value.outer_iter().enumerate() {
            let mut own_row = transport.slice_mut(s![row, row, .., ..]);
            own_row += &direct;
        }
        self.object.indirect.add_transport(transport);
    }

    pub(super) fn add_image(&self, pattern: &PatternPart, mut image: ArrayViewMut3<f32>) {
        let direct = &self.object.direct;
        for ((row, column, channel), value) in direct.value.indexed_iter() {
            image[[row, column, channel]] += value * pattern.mean(row, direct.columns(row, column));
        }
        self.object.indirect.add_image(pattern, image);
    }

    /// Projector column at each pixel's centre, relative to the whole projector.
    pub(super) fn middle_columns(&self) -> Array2<f32> {
        let (rows, columns, _) = self.object.direct.value.dim();
        let Range { start, end } = self.projector_columns;
        Array2::from_shape_fn((rows, columns), |(row, column)| {
            let (from, to) = self.object.direct.columns(row, column);
            (start + (end - start) * 0.5 * f64::from(from + to)) as f32
        })
    }
}

/// Direct and indirect light of an object of a built-in scene.
#[derive(Debug)]
pub(super) struct Object {
    pub(super) direct: Direct,
    pub(super) indirect: Box<dyn Indirect>,
}

/// Direct light from the projector: row t lights what camera row t sees.
#[derive(Debug, Clone)]
pub(super) struct Direct {
    /// Value under white light, `[row, column, channel]`.
    pub(super) value: Array3<f32>,
    /// `[row, column, 2]`: projector columns 0..1 at the pixel's left and right border.
    pub(super) columns: Array3<f32>,
}

impl Direct {
    /// All dark; `column_at(row, x)` is the projector column that lights the point seen at x.
    pub(super) fn new(size: SceneSize, channels: usize, column_at: impl Fn(usize, f64) -> f32) -> Self {
        Self {
            value: Array3::zeros((size.rows, size.columns, channels)),
            columns: Array3::from_shape_fn((size.rows, size.columns, 2), |(row, column, border)| {
                column_at(row, (column + border) as f64)
            }),
        }
    }

    pub(super) fn columns(&self, row: usize, column: usize) -> (f32, f32) {
        (self.columns[[row, column, 0]], self.columns[[row, column, 1]])
    }
}

/// Light that reaches the camera on any other path. Both methods describe the same light: the transport of a row
/// equals the image under that row alone.
pub(super) trait Indirect: fmt::Debug + Send + Sync {
    /// Adds the image under each row to `transport` `[V, H, W, C]`.
    fn add_transport(&self, transport: ArrayViewMut4<f32>);

    /// Adds the image under a pattern to `image` `[H, W, C]`.
    fn add_image(&self, pattern: &PatternPart, image: ArrayViewMut3<f32>);
}
