use ndarray::{Array1, Array2};

use super::direct::{DirectLight, direct_light};
use super::{CalibrateError, Sample};

/// Number of pixels with direct light needed to measure its position, and to let the position vary over the image.
pub(super) const MIN_PIXELS: usize = 16;
const MIN_PIXELS_TO_VARY: usize = 60;

/// Number of camera rows and columns below which the position is assumed to be the same everywhere in the image.
const MIN_EXTENT_TO_VARY: usize = 8;

/// If a pixel's position has this variance for unit light and noise, the plan does not distinguish rows -1, 0 and 1.
const MAX_PLAN_VARIANCE: f64 = 1e4;

/// Largest usable standard error of a pixel's position.
const MAX_PIXEL_ERROR_ROWS: f64 = 0.25;

/// Scatter of single pixels around a smooth map, from shading within a row; keeps bright pixels from dominating.
const PIXEL_SCATTER_ROWS: f64 = 0.02;

/// Number of reweighting steps, and the residual in units of the scatter at which a pixel's weight halves (Cauchy's,
/// 95 % efficient on Gaussian noise).
const ROBUST_STEPS: usize = 12;
const CAUCHY: f64 = 2.385;

/// Position of direct light, in rows relative to the pixel's own; 0 with perfect rectification.
#[derive(Debug, Clone, PartialEq)]
pub struct SpikeMap {
    /// `u0[t, s]` in rows, from -1 to 1: a second-order polynomial over the image.
    pub u0: Array2<f32>,
    /// Its standard error in rows, `[t, s]`, from the pixels' scatter. Indirect light with a cusp at `u = 0` adds a
    /// bias of up to a few per cent of `u0`, towards 0.
    pub standard_error: Array2<f32>,
    /// Number of sampled pixels with direct light.
    pub pixels: usize,
}

/// Measures the position of direct light, for a beam of the given width. Each sampled pixel gives the centroid of the
/// light that stands out in rows -1, 0 and 1; a robust polynomial is fitted to them.
///
/// Direct light that is off by more than a row must be corrected by rectification: the map ends at 1 and -1.
///
/// # Errors
/// [`CalibrateError::NoEdge`] if the settings do not determine it; [`CalibrateError::NoDirectLight`] if there is no
/// direct light; [`super::super::PlaneError::NotConvex`].
pub fn spike_offset(sample: &Sample, beam_sigma_rows: f64) -> Result<SpikeMap, CalibrateError> {
    let light = direct_light(sample, beam_sigma_rows)?;
    if !light.is_empty() && light.iter().all(|light| light.plan_variance > MAX_PLAN_VARIANCE) {
        return Err(CalibrateError::NoEdge);
    }
    let usable = |light: &&DirectLight| light.stands_out && light.standard_error_rows < MAX_PIXEL_ERROR_ROWS;
    let light: Vec<&DirectLight> = light.iter().filter(usable).collect();
    if light.len() < MIN_PIXELS {
        return Err(CalibrateError::NoDirectLight { pixels: light.len(), needed: MIN_PIXELS });
    }
    let (height, width) = (sample.timing.camera_rows(), sample.columns);
    let varies = light.len() >= MIN_PIXELS_TO_VARY && height.min(width) >= MIN_EXTENT_TO_VARY;
    let terms = if varies { 6 } else { 1 };
    let basis = |t: usize, s: usize| {
        let (y, x) = (centred(t, height), centred(s, width));
        Array1::from_iter([1.0, x, y, x * x, x * y, y * y].into_iter().take(terms))
    };
    let (coefficients, covariance) = fit(&light, basis);
    let at = |(t, s): (usize, usize)| basis(t, s);
    Ok(SpikeMap {
        u0: Array2::from_shape_fn((height, width), |pixel| {
            at(pixel).dot(&coefficients).clamp(-1.0, 1.0) as f32
        }),
        standard_error: Array2::from_shape_fn((height, width), |pixel| {
            at(pixel).dot(&covariance.dot(&at(pixel))).max(0.0).sqrt() as f32
        }),
        pixels: light.len(),
    })
}

/// Maps the first of `length` indices to -1, the last to 1.
fn centred(index: usize, length: usize) -> f64 {
    (2.0 * index as f64 + 1.0) / length as f64 - 1.0
}

/// Coefficients of the basis by iteratively reweighted least squares, and their covariance from the actual residuals,
/// whatever their cause.
fn fit(light: &[&DirectLight], basis: impl Fn(usize, usize) -> Array1<f64>) -> (Array1<f64>, Array2<f64>) {
    let rows: Vec<Array1<f64>> = light.iter().map(|light| basis(light.t, light.s)).collect();
    let terms = rows[0].len();
    let precision = |light: &DirectLight| light.standard_error_rows.hypot(PIXEL_SCATTER_ROWS).recip();
    let mut coefficients = Array1::zeros(terms);
    // A starting point that outliers cannot shift: the median position, the same everywhere.
    coefficients[0] = median(light.iter().map(|light| light.u0_rows).collect());
    let mut covariance = Array2::zeros((terms, terms));
    for _ in 0..ROBUST_STEPS {
        let residuals: Vec<f64> =
            light.iter().zip(&rows).map(|(light, row)| light.u0_rows - row.dot(&coefficients)).collect();
        let scaled: Vec<f64> =
            light.iter().zip(&residuals).map(|(light, r)| (r * precision(light)).abs()).collect();
        let scatter = (1.4826 * median(scaled.clone())).max(f64::MIN_POSITIVE);
        let mut normal = Array2::<f64>::zeros((terms, terms));
        let mut right = Array1::<f64>::zeros(terms);
        let mut spread = Array2::<f64>::zeros((terms, terms));
        for (((light, row), residual), scaled) in light.iter().zip(&rows).zip(&residuals).zip(&scaled) {
            let weight = precision(light).powi(2) / (1.0 + (scaled / (CAUCHY * scatter)).powi(2));
            for (i, a) in row.iter().enumerate() {
                right[i] += weight * a * residual;
                for (j, b) in row.iter().enumerate() {
                    normal[[i, j]] += weight * a * b;
                    spread[[i, j]] += (weight * residual).powi(2) * a * b;
                }
            }
        }
        // If the pixels do not span the polynomial, the terms that they determine are still fitted.
        normal.diag_mut().mapv_inplace(|diagonal| diagonal * (1.0 + 1e-9) + f64::MIN_POSITIVE);
        let Ok(inverse) = super::problem::invert(&normal) else { break };
        coefficients += &inverse.dot(&right);
        covariance = inverse.dot(&spread).dot(&inverse);
    }
    (coefficients, covariance)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}
