//! Scenes: light transport from projector rows to camera pixels.
//!
//! A scene's transport T `[V, H, W, C]` is the image `[H, W, C]` that the camera sees while only projector row v is
//! lit, for each of the V rows; C is 1 (mono) or 3 (linear RGB). Top rows come first. T = 1 is a white Lambertian plane
//! at the reference distance, lit by that row alone during its dwell, so the image under row weights p is the sum over
//! v of p\[v\] T\[v\]. Camera row t lies on the epipolar plane of projector row t: direct light is T\[t, t, ..\].
//!
//! Scenes are loaded from files ([`Scene::load`]) or computed ([`Scene::builtin`]). Built-in scenes keep their columns
//! and can therefore render patterns that vary along a row.

mod ball;
mod candle;
mod dipole;
mod error;
mod form_factor;
mod groove;
mod mix;
mod motion;
mod names;
mod npz;
mod object;
mod projector;
mod quadrature;
mod size;
mod slab;
pub(crate) mod texture;
mod translucent;
mod vector;

use std::ops::Range;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use ndarray::{Array2, Array3, Array4, ArrayView2, Axis, s};
use rayon::prelude::*;

pub use error::SceneError;
pub use motion::SceneMotion;
pub use names::{BUILTIN_NAMES, MOVING_NAMES, is_file};
use object::Panel;
use projector::ColumnPattern;
pub use size::{MAX_ENTRIES, MIN_SIDE, SceneSize, Window};
pub use slab::slab_materials;

/// RGB bands of mono and colour scenes; mono uses the green coefficients of every medium and print.
const MONO: &[usize] = &[1];
const RGB: &[usize] = &[0, 1, 2];

/// Light transport of a scene under a rectified projector-camera pair; see the [module](self).
#[derive(Debug)]
pub struct Scene {
    /// T `[V, H, W, C]`: finite and not negative.
    pub transport: Array4<f32>,
    /// `[H, W]`: projector column 0..1 (left to right) that lights the point a pixel sees, if known. Pixels that see
    /// nothing lit hold an arbitrary value within 0..1.
    pub projector_column: Option<Array2<f32>>,
    /// Objects of a built-in scene; empty for scenes defined by row transport only.
    panels: Vec<Panel>,
    /// Images under rows with the same columns lit, the newest last.
    under_columns: Mutex<Vec<UnderColumns>>,
}

/// Weights of a row's columns, and the images `[V, H, W, C]` under each row alone.
type UnderColumns = (Vec<f32>, Arc<Array4<f32>>);

/// Most memory of these images.
const MOST_UNDER_COLUMNS_BYTES: usize = 512 << 20;

impl Scene {
    /// Loads a scene from a `.npz` file: `T` float32 (or float64, converted) `[V, H, W]` or
    /// `[V, H, W, 3]`, and optionally `proj_uv` `[H, W, 2]`, whose u becomes
    /// [`Scene::projector_column`].
    ///
    /// # Errors
    /// When the file cannot be opened or is damaged; when `T` is missing; when an array has another type or shape; when
    /// `T` holds a negative or non-finite value.
    pub fn load(path: &Path) -> Result<Self, SceneError> {
        npz::load(path)
    }

    /// Puts a white board without scattering into these columns of the image, in the scene's place.
    pub fn cover_with_board(&mut self, columns: Range<usize>) {
        for ((v, t, _, _), light) in self.transport.slice_mut(s![.., .., columns, ..]).indexed_iter_mut() {
            *light = f32::from(u8::from(v == t));
        }
    }

    /// Writes T (and `proj_uv`, if known) in the format that [`Scene::load`] reads.
    ///
    /// # Errors
    /// [`SceneError::Write`].
    pub fn save(&self, path: &Path) -> Result<(), SceneError> {
        npz::save(self, path)
    }

    /// Creates a scene from its row transport `[V, H, W, C]` and, if known, projector columns `[H, W]`.
    ///
    /// # Errors
    /// [`SceneError::Value`] for a negative or non-finite entry, [`SceneError::Layout`] for mismatched shapes.
    pub fn from_transport(
        transport: Array4<f32>,
        projector_column: Option<Array2<f32>>,
    ) -> Result<Self, SceneError> {
        Self::checked(transport, projector_column, "the transport array")
    }

    /// Computes a built-in scene in mono: one of [`BUILTIN_NAMES`].
    ///
    /// The seed varies print, texture and geometric details. The result does not depend on the number of threads.
    ///
    /// # Errors
    /// [`SceneError::UnknownName`], [`SceneError::Size`].
    pub fn builtin(name: &str, size: SceneSize, seed: u64) -> Result<Self, SceneError> {
        Self::compute(name, size, MONO, seed, 0.0)
    }

    /// Like [`Scene::builtin`], in linear RGB.
    ///
    /// # Errors
    /// [`SceneError::UnknownName`], [`SceneError::Size`].
    pub fn builtin_rgb(name: &str, size: SceneSize, seed: u64) -> Result<Self, SceneError> {
        Self::compute(name, size, RGB, seed, 0.0)
    }

    /// `swing` is the position of a moving object, from -1 at the left end of its swing to 1; ignored for scenes at
    /// rest.
    fn compute(
        name: &str,
        size: SceneSize,
        bands: &[usize],
        seed: u64,
        swing: f64,
    ) -> Result<Self, SceneError> {
        let SceneSize { rows, columns } = size;
        let entries = rows.saturating_mul(rows).saturating_mul(columns).saturating_mul(bands.len());
        if rows < MIN_SIDE || columns < MIN_SIDE || entries > MAX_ENTRIES {
            return Err(SceneError::Size { rows, columns, channels: bands.len() });
        }
        let panels = match name {
            "v-groove" => vec![Panel::whole(groove::build(size, bands, seed))],
            "mirror-ball" => vec![Panel::whole(ball::build(size, bands, seed))],
            "pendulum" => vec![Panel::whole(ball::build_swung(size, bands, seed, swing))],
            "slab" => vec![Panel::whole(slab::build(size, bands, seed))],
            "candle" => vec![Panel::whole(candle::build(size, bands, seed))],
            "moving-candle" => vec![Panel::whole(candle::build_swung(size, bands, seed, swing))],
            "mix" => mix::build(size, bands, seed),
            _ => return Err(SceneError::UnknownName { name: name.into() }),
        };
        let mut transport = Array4::zeros((rows, rows, columns, bands.len()));
        let mut projector_column = Array2::zeros((rows, columns));
        for panel in &panels {
            let (rows, columns) = (panel.rows(), panel.columns());
            panel.add_transport(transport.slice_mut(s![rows.clone(), rows.clone(), columns.clone(), ..]));
            projector_column.slice_mut(s![rows, columns]).assign(&panel.middle_columns());
        }
        let under_columns = Mutex::default();
        Ok(Self { transport, projector_column: Some(projector_column), panels, under_columns })
    }

    fn checked(
        transport: Array4<f32>,
        projector_column: Option<Array2<f32>>,
        origin: &str,
    ) -> Result<Self, SceneError> {
        let (rows, height, width, channels) = transport.dim();
        let column_shape = projector_column.as_ref().map(|column| column.dim());
        let sensible = rows > 0 && height > 0 && width > 0 && matches!(channels, 1 | 3);
        if !sensible || column_shape.is_some_and(|shape| shape != (height, width)) {
            return Err(SceneError::Layout { transport: transport.dim(), projector_column: column_shape });
        }
        if let Some((index, &value)) =
            transport.indexed_iter().find(|&(_, &value)| !(value.is_finite() && value >= 0.0))
        {
            return Err(SceneError::Value { origin: origin.into(), index, value });
        }
        Ok(Self { transport, projector_column, panels: Vec::new(), under_columns: Mutex::default() })
    }

    /// Number of projector rows, V.
    pub fn rows(&self) -> usize {
        self.transport.len_of(Axis(0))
    }

    /// Camera rows and columns, (H, W).
    pub fn size(&self) -> (usize, usize) {
        (self.transport.len_of(Axis(1)), self.transport.len_of(Axis(2)))
    }

    /// Number of channels, C: 1 or 3.
    pub fn channels(&self) -> usize {
        self.transport.len_of(Axis(3))
    }

    /// The window of all camera pixels.
    pub fn full_window(&self) -> Window {
        let (rows, columns) = self.size();
        Window { rows: 0..rows, columns: 0..columns }
    }

    /// Renders the image `[h, w, C]` of a window of camera pixels under `pattern` `[V, columns]`, whose columns divide
    /// the projector's width equally.
    ///
    /// # Errors
    /// [`SceneError::Pattern`] unless the pattern has V rows, at least one column and finite values;
    /// [`SceneError::RowsOnly`] for a pattern that varies along a row when the scene is defined by row transport only;
    /// [`SceneError::Window`] for a window outside the image.
    pub fn render(&self, pattern: ArrayView2<f32>, window: &Window) -> Result<Array3<f32>, SceneError> {
        let (height, width) = self.size();
        if window.rows.end > height
            || window.columns.end > width
            || window.rows.is_empty()
            || window.columns.is_empty()
        {
            return Err(SceneError::Window { window: window.clone(), height, width });
        }
        let shape = pattern.dim();
        if shape.0 != self.rows() || shape.1 == 0 || !pattern.iter().all(|value| value.is_finite()) {
            return Err(SceneError::Pattern { rows: shape.0, columns: shape.1, expected: self.rows() });
        }
        let pixels = s![window.rows.clone(), window.columns.clone(), ..];
        let constant = pattern.outer_iter().all(|row| row.iter().all(|&value| value == row[0]));
        if !constant {
            return Ok(self.render_columns(pattern)?.slice_move(pixels));
        }
        let mut image = Array3::zeros((window.rows.len(), window.columns.len(), self.channels()));
        for (row, transport) in pattern.outer_iter().zip(self.transport.outer_iter()) {
            if row[0] != 0.0 {
                image.scaled_add(row[0], &transport.slice(pixels));
            }
        }
        Ok(image)
    }

    /// The images `[V, H, W, C]` under each row alone, lit with these weights of its columns. A series of patterns has
    /// few different rows, so they are kept.
    ///
    /// # Errors
    /// As [`Scene::render`].
    pub fn under_columns(&self, columns: &[f32]) -> Result<Arc<Array4<f32>>, SceneError> {
        let kept = || self.under_columns.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((_, images)) = kept().iter().find(|(known, _)| known == columns) {
            return Ok(images.clone());
        }
        let mut images = Array4::zeros(self.transport.dim());
        images.axis_iter_mut(Axis(0)).into_par_iter().enumerate().try_for_each(|(v, mut image)| {
            let mut lit = Array2::zeros((self.rows(), columns.len()));
            lit.row_mut(v).iter_mut().zip(columns).for_each(|(lit, &weight)| *lit = weight);
            image.assign(&self.render(lit.view(), &self.full_window())?);
            Ok::<(), SceneError>(())
        })?;
        let images = Arc::new(images);
        let mut kept = kept();
        kept.push((columns.to_vec(), images.clone()));
        let most = (MOST_UNDER_COLUMNS_BYTES / (images.len() * size_of::<f32>()).max(1)).max(1);
        let too_many = kept.len().saturating_sub(most);
        kept.drain(..too_many);
        Ok(images)
    }

    /// Renders the image `[H, W, C]` under any pattern, from the scene's objects.
    fn render_columns(&self, pattern: ArrayView2<f32>) -> Result<Array3<f32>, SceneError> {
        if self.panels.is_empty() {
            return Err(SceneError::RowsOnly { columns: pattern.ncols() });
        }
        let (height, width) = self.size();
        let pattern = ColumnPattern::new(pattern);
        let mut image = Array3::zeros((height, width, self.channels()));
        for panel in &self.panels {
            let part = pattern.part(panel.rows(), panel.projector_columns.clone());
            panel.add_image(&part, image.slice_mut(s![panel.rows(), panel.columns(), ..]));
        }
        Ok(image)
    }
}

#[cfg(test)]
mod tests;
