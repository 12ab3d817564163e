//! What transport does not explain of images that a lamp may have lit.

use nalgebra::{DMatrix, DVector};
use ndarray::ArrayView1;
use rayon::prelude::*;

use super::super::super::{PlaneError, Prior};
use super::super::problem::RowProblem;
use super::super::sample::SampledClass;
use super::super::{CalibrateError, Sample};
use super::exposures::{FrameExposures, TimedImage};

/// The smoothness with which scene and flicker are told apart in a sweep.
const OF_SWEEP: Prior = Prior::Split { alpha: 0.01, beta: 0.001 };
/// The same in a cycle of a film: a rougher scene would explain almost all of its few images, and leave no more than one
/// number in which jitter looks like flicker.
const OF_CYCLE: Prior = Prior::Split { alpha: 1.0, beta: 0.001 };

/// The light of a sweep's or a cycle's images in the rows of a sample, without what transport explains of it, and the
/// times of the images.
pub struct Unexplained {
    pub(super) images: Vec<TimedImage>,
    /// `M = 1 - A H^-1 A'` of the rows' models.
    pub(super) projectors: Vec<DMatrix<f64>>,
    pub(super) rows: Vec<UnexplainedRow>,
}

/// That of a row, weighted and summed over its pixels: of each the room's level is `m` and the weight `q`.
pub(super) struct UnexplainedRow {
    pub t: usize,
    /// Index of the row's `M`.
    pub projector: usize,
    /// Sum over pixels of `q m M y`.
    pub light: DVector<f64>,
    /// Sum over pixels of `q m^2`.
    pub weight: f64,
    /// `Y' M Y / weight` with the sum `Y` over pixels of `q m y`: what an amplitude could explain at most.
    pub power: f64,
}

/// `M` of a class, and its rows.
type Projected = (DMatrix<f64>, Vec<UnexplainedRow>);

impl Unexplained {
    /// That of a sweep. `images` are those of the sample's settings, `levels_us` the room's light at its pixels, in the
    /// units of the stack per us.
    ///
    /// # Errors
    /// [`PlaneError::NotConvex`] for a model without solution.
    pub fn of_sweep(
        sample: &Sample,
        beam_sigma_rows: f64,
        images: Vec<TimedImage>,
        levels_us: &[f64],
    ) -> Result<Self, CalibrateError> {
        Self::with_prior(&OF_SWEEP, sample, beam_sigma_rows, images, levels_us)
    }

    /// That of a film's cycle, in which nothing of the lamp is subtracted with the dark image, or nothing that matters:
    /// what is the same in all frames of a row is left to the scene.
    ///
    /// # Errors
    /// Those of [`Self::of_sweep`].
    pub fn of_cycle(
        sample: &Sample,
        beam_sigma_rows: f64,
        frames: &[FrameExposures],
        levels_us: &[f64],
    ) -> Result<Self, CalibrateError> {
        let unseen = FrameExposures { exposure_us: 0.0, opened_s: Vec::new() };
        let image = |light: &FrameExposures| TimedImage { light: light.clone(), dark: unseen.clone() };
        let images = frames.iter().map(image).collect();
        Self::with_prior(&OF_CYCLE, sample, beam_sigma_rows, images, levels_us)
    }

    fn with_prior(
        prior: &Prior,
        sample: &Sample,
        beam_sigma_rows: f64,
        images: Vec<TimedImage>,
        levels_us: &[f64],
    ) -> Result<Self, CalibrateError> {
        let lights =
            || sample.classes.iter().flat_map(|class| class.intensities.rows().into_iter().map(mean_light));
        let least_light = 0.01 * lights().sum::<f64>() / lights().count().max(1) as f64;
        let (mut classes, mut others) = (Vec::with_capacity(sample.classes.len()), levels_us);
        for class in &sample.classes {
            let (own, rest) = others.split_at(class.pixels.len().min(others.len()));
            others = rest;
            classes.push((class, own));
        }
        let projected = |(index, (class, levels)): (usize, (&SampledClass, &[f64]))| {
            let projector = projector(class, prior, beam_sigma_rows)?;
            let rows = rows_of(class, levels, least_light, (index, &projector));
            Ok((projector, rows))
        };
        let parts = classes.into_par_iter().enumerate().map(projected);
        let parts = parts.collect::<Result<Vec<Projected>, PlaneError>>()?;
        let (projectors, rows): (Vec<_>, Vec<_>) = parts.into_iter().unzip();
        Ok(Self { images, projectors, rows: rows.into_iter().flatten().collect() })
    }
}

/// `M` of a class.
fn projector(class: &SampledClass, prior: &Prior, beam_sigma_rows: f64) -> Result<DMatrix<f64>, PlaneError> {
    let weights = class.weights(beam_sigma_rows);
    let hat = RowProblem::new(weights, prior.differences(&class.slots), prior)?.hat();
    Ok(DMatrix::from_fn(hat.nrows(), hat.ncols(), |i, j| f64::from(i == j) - hat[[i, j]]))
}

/// The rows of a class with the room's light `levels` at its pixels, and with its `M` and the index of that.
fn rows_of(
    class: &SampledClass,
    levels: &[f64],
    least_light: f64,
    (index, projector): (usize, &DMatrix<f64>),
) -> Vec<UnexplainedRow> {
    let mut rows = Vec::<UnexplainedRow>::new();
    let mut levels = levels.iter();
    for (&(t, _), pixel) in class.pixels.iter().zip(class.intensities.rows()) {
        let level = levels.next().copied().unwrap_or(0.0);
        let weight = 1.0 / mean_light(pixel).max(least_light).max(f64::MIN_POSITIVE);
        let light = DVector::from_iterator(pixel.len(), pixel.iter().map(|light| light * weight * level));
        let weight = weight * level * level;
        match rows.iter_mut().find(|row| row.t == t) {
            Some(row) => {
                row.light += light;
                row.weight += weight;
            }
            None => rows.push(UnexplainedRow { t, projector: index, light, weight, power: 0.0 }),
        }
    }
    for row in &mut rows {
        let unexplained = projector * &row.light;
        row.power = row.light.dot(&unexplained) / row.weight.max(f64::MIN_POSITIVE);
        row.light = unexplained;
    }
    rows
}

fn mean_light(pixel: ArrayView1<f64>) -> f64 {
    pixel.sum() / pixel.len() as f64
}
