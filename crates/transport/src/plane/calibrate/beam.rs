use std::collections::HashSet;

use ndarray::Array1;

use super::super::{PlaneError, Prior};
use super::direct::direct_light;
use super::holdout::{folds, held_out, log_by_pixel};
use super::spike::MIN_PIXELS;
use super::{CalibrateError, Optics, Sample, SpikeMap, spike_offset};

/// Widths that the search starts from, in rows; between neighbours the residual has one minimum.
const COARSE_ROWS: [f64; 7] = [0.0, 0.3, 0.45, 0.7, 1.05, 1.55, 2.3];

/// Below this width a Gaussian sampled at the rows' centres keeps 99 % of the light in its own row, and no plan tells
/// it from an ideal beam.
const NARROWEST_ROWS: f64 = 0.3;
const WIDEST_ROWS: f64 = 3.0;

/// Factors between the widths that the refinement compares, coarse to fine.
const STEPS: [f64; 3] = [1.3, 1.12, 1.12];

/// The width counts as determined when a beam 30 % wider or narrower raises the mean squared residual this much.
const MIN_RISE: f64 = 0.1;

/// The width of the projector's beam across rows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BeamEstimate {
    /// Standard deviation of a Gaussian profile sampled at the rows' centres, in rows; 0 for rows that light only
    /// themselves.
    pub sigma_rows: f64,
    /// Its standard error, in rows.
    pub standard_error_rows: f64,
    /// Sampled pixels with direct light, which say it.
    pub pixels: usize,
}

/// The beam's width and the place of direct light, or why the stack does not say them.
#[derive(Debug, Clone)]
pub struct OpticsEstimate {
    /// What to solve with: the estimates, and an ideal beam or `u = 0` where there is none.
    pub optics: Optics,
    /// The width, unless it was given.
    pub beam: Option<Result<BeamEstimate, CalibrateError>>,
    /// The place.
    pub spike: Result<SpikeMap, CalibrateError>,
}

/// Estimates the width of the beam, unless it is known, and the place of direct light. They hardly interfere, because
/// a beam spreads light to both sides and an offset to one: the place is measured once with a rough width, and again
/// with the fine one.
///
/// # Errors
/// [`PlaneError::NotConvex`].
pub fn estimate_optics(
    sample: &Sample,
    known_beam_sigma_rows: Option<f64>,
) -> Result<OpticsEstimate, CalibrateError> {
    let Some(sigma_rows) = known_beam_sigma_rows else {
        let rough = spike_offset(sample, coarse_sigma(&sample.thinned())?).ok();
        let beam = beam_sigma(sample, rough.as_ref());
        let sigma_rows = beam.as_ref().map_or(0.0, |beam| beam.sigma_rows);
        let known = estimate_optics(sample, Some(sigma_rows))?;
        return Ok(OpticsEstimate { beam: Some(beam), ..known });
    };
    let spike = spike_offset(sample, sigma_rows);
    let optics = Optics { beam_sigma_rows: sigma_rows, spike: spike.as_ref().ok().cloned() };
    Ok(OpticsEstimate { optics, beam: None, spike })
}

/// Estimates the beam's width as the one under which held-out settings are predicted best.
///
/// # Errors
/// [`CalibrateError::NoDirectLight`] and [`CalibrateError::BeamUndetermined`] if the stack does not say it;
/// [`CalibrateError::TooFewSettings`]; [`PlaneError::NotConvex`].
pub fn beam_sigma(sample: &Sample, spike: Option<&SpikeMap>) -> Result<BeamEstimate, CalibrateError> {
    let sample = sample.thinned();
    let folds = folds(&sample)?;
    let coarse_rows = coarse_sigma(&sample)?;
    let sample = with_direct_light(&sample, coarse_rows)?;
    let pixels = sample.pixels().count();
    let log_residual = |sigma_rows: f64| -> Result<Array1<f64>, PlaneError> {
        let optics = Optics { beam_sigma_rows: sigma_rows, spike: spike.cloned() };
        Ok(log_by_pixel(&held_out(&sample, &Prior::SPLIT, &optics, &folds)?))
    };

    let mut sigma_rows = coarse_rows.max(NARROWEST_ROWS);
    let (mut rise, mut standard_error) = (f64::INFINITY, 0.0);
    for (round, step) in STEPS.into_iter().enumerate() {
        let (narrower, middle, wider) =
            (log_residual(sigma_rows / step)?, log_residual(sigma_rows)?, log_residual(sigma_rows * step)?);
        // In ln(sigma), per pixel: half the second difference, and the slope.
        let bend = (&wider + &narrower) / 2.0 - &middle;
        let slope = (&wider - &narrower) / (2.0 * step.ln());
        if round == 0 {
            rise = bend.mean().unwrap_or_default().exp_m1();
        }
        let curvature = 2.0 * bend.sum() / step.ln().powi(2);
        let change = if curvature > 0.0 { -slope.sum() / curvature } else { -slope.sum().signum() * f64::INFINITY };
        sigma_rows = (sigma_rows * change.clamp(-step.ln(), step.ln()).exp()).clamp(0.2, WIDEST_ROWS);
        standard_error = slope.dot(&slope).sqrt() / curvature.max(f64::MIN_POSITIVE);
    }
    if sigma_rows < NARROWEST_ROWS {
        return Ok(BeamEstimate { sigma_rows: 0.0, standard_error_rows: NARROWEST_ROWS, pixels });
    }
    if rise < MIN_RISE {
        let (rise_percent, needed_percent) = (100.0 * rise, 100.0 * MIN_RISE);
        return Err(CalibrateError::BeamUndetermined { rise_percent, needed_percent });
    }
    Ok(BeamEstimate { sigma_rows, standard_error_rows: standard_error * sigma_rows, pixels })
}

/// The best of a few widths by the objective's minimum. The place of direct light is free within a row, so an offset
/// is not taken for a width.
fn coarse_sigma(sample: &Sample) -> Result<f64, PlaneError> {
    let mut best = (f64::INFINITY, 0.0);
    for sigma_rows in COARSE_ROWS {
        let light = direct_light(sample, sigma_rows)?;
        let score: f64 = light.iter().map(|light| light.objective.max(f64::MIN_POSITIVE).ln()).sum();
        if score < best.0 {
            best = (score, sigma_rows);
        }
    }
    Ok(best.1)
}

/// Only the pixels in which direct light stands out: the others say nothing of the beam, but have noise.
fn with_direct_light(sample: &Sample, beam_sigma_rows: f64) -> Result<Sample, CalibrateError> {
    let light = direct_light(sample, beam_sigma_rows)?;
    let direct: HashSet<(usize, usize)> =
        light.iter().filter(|light| light.stands_out).map(|light| (light.t, light.s)).collect();
    if direct.len() < MIN_PIXELS {
        return Err(CalibrateError::NoDirectLight { pixels: direct.len(), needed: MIN_PIXELS });
    }
    let rows = sample.rows.iter().map(|row| row.keep(|pixel| direct.contains(&(row.t, row.columns[pixel]))));
    let rows = rows.filter(|row| !row.columns.is_empty()).collect();
    Ok(Sample { rows, ..sample.clone() })
}
