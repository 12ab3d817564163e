use std::collections::HashSet;

use ndarray::{Array1, Axis};
use rayon::prelude::*;

use super::super::{PlaneError, Prior};
use super::direct::direct_light;
use super::holdout::{folds, held_out, log_residuals};
use super::spike::MIN_PIXELS;
use super::{CalibrateError, Optics, Sample, SpikeMap, spike_offset};

/// Initial widths of the search, in rows; between neighbours the residual has one minimum.
const COARSE_ROWS: [f64; 7] = [0.0, 0.3, 0.45, 0.7, 1.05, 1.55, 2.3];

/// Below this width a Gaussian sampled at the rows' centres leaves 96 % of the light in its own row and cannot be
/// distinguished from a cusp of subsurface light around u = 0: the beam counts as ideal.
const NARROWEST_ROWS: f64 = 0.36;
const WIDEST_ROWS: f64 = 3.0;

/// Golden-section steps in the interval between the neighbours of the best coarse width; they leave 7 % of the width.
const GOLDEN_STEPS: usize = 5;
const GOLDEN_RATIO: f64 = 0.618_033_988_75;

/// Ratio of the widths through which the parabola of held-out residuals runs, and how often it may be moved.
const FINE_STEP: f64 = 1.06;
const FINE_ROUNDS: usize = 3;

/// The width counts as determined if changing it by this factor in either direction, or replacing an ideal beam by
/// one of twice the narrowest width, raises the mean squared held-out residual by this share and by this many
/// standard errors.
const OTHER_WIDTH: f64 = 1.5;
const MIN_RISE: f64 = 0.03;
const MIN_STANDARD_ERRORS: f64 = 2.0;

/// The width of the projector's beam across rows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BeamEstimate {
    /// Standard deviation in rows of a Gaussian profile sampled at the rows' centres; 0 if each row lights only
    /// itself.
    pub sigma_rows: f64,
    /// Its standard error, in rows.
    pub standard_error_rows: f64,
    /// Number of sampled pixels with direct light, on which the estimate is based.
    pub pixels: usize,
}

/// The beam's width and the position of direct light, or why the stack does not determine them.
#[derive(Debug, Clone)]
pub struct OpticsEstimate {
    /// The optics to solve with: the estimates, or an ideal beam and `u = 0` where there is none.
    pub optics: Optics,
    /// The width; `None` if it was given.
    pub beam: Option<Result<BeamEstimate, CalibrateError>>,
    /// The position.
    pub spike: Result<SpikeMap, CalibrateError>,
}

/// Estimates the beam's width, unless it is known, and the position of direct light. They hardly interfere, because a
/// beam spreads light to both sides and an offset moves it to one: the position is measured once with a rough width,
/// and again with the fine one.
///
/// # Errors
/// [`PlaneError::NotConvex`].
pub fn estimate_optics(
    sample: &Sample,
    known_beam_sigma_rows: Option<f64>,
) -> Result<OpticsEstimate, CalibrateError> {
    let beam = match known_beam_sigma_rows {
        Some(_) => None,
        None => {
            let thinned = sample.thinned();
            // A free position within a row prevents an offset from being mistaken for a width.
            let rough_rows = best_coarse(|sigma_rows| {
                Ok(direct_light(&thinned, sigma_rows)?.iter().map(|light| log(light.objective)).sum())
            })?;
            let rough = spike_offset(&thinned, COARSE_ROWS[rough_rows]).ok();
            Some(beam_sigma(sample, rough.as_ref()))
        }
    };
    let estimated = || beam.as_ref()?.as_ref().ok().map(|beam| beam.sigma_rows);
    let beam_sigma_rows = known_beam_sigma_rows.or_else(estimated).unwrap_or(0.0);
    let spike = spike_offset(sample, beam_sigma_rows);
    let optics = Optics { beam_sigma_rows, spike: spike.as_ref().ok().cloned() };
    Ok(OpticsEstimate { optics, beam, spike })
}

/// Estimates the beam's width: first roughly, by the smallest objective of the split prior, then by the best
/// prediction of held-out settings, because the objective alone mistakes a width for smoothness.
///
/// # Errors
/// [`CalibrateError::NoDirectLight`], [`CalibrateError::BeamUndetermined`] and [`CalibrateError::BeamTooWide`] if the
/// stack does not determine it; [`CalibrateError::TooFewSettings`]; [`PlaneError::NotConvex`].
pub fn beam_sigma(sample: &Sample, spike: Option<&SpikeMap>) -> Result<BeamEstimate, CalibrateError> {
    let sample = sample.thinned();
    let folds = folds(&sample)?;
    let optics = |sigma_rows: f64| Optics { beam_sigma_rows: sigma_rows, spike: spike.cloned() };
    let objective = |sample: &Sample, sigma_rows: f64| -> Result<f64, PlaneError> {
        Ok(in_sample(sample, &optics(sigma_rows))?.into_iter().map(log).sum())
    };
    let coarse = best_coarse(|sigma_rows| objective(&sample, sigma_rows))?;
    let sample = with_direct_light(&sample, COARSE_ROWS[coarse])?;
    let pixels = sample.pixels().count();
    let held_out_log = |sigma_rows: f64| -> Result<_, PlaneError> {
        Ok(log_residuals(&held_out(&sample, &Prior::SPLIT, &optics(sigma_rows), &folds)?))
    };
    let mut estimate = BeamEstimate { sigma_rows: 0.0, standard_error_rows: NARROWEST_ROWS, pixels };
    let mut best = held_out_log(0.0)?;
    if coarse > 0 {
        let lowest = COARSE_ROWS[coarse - 1].max(NARROWEST_ROWS / 1.5);
        let highest = COARSE_ROWS.get(coarse + 1).copied().unwrap_or(WIDEST_ROWS);
        let rough = golden_section(lowest.ln(), highest.ln(), |ln| objective(&sample, ln.exp()))?.exp();
        let (sigma_rows, standard_error_rows) =
            refine(rough, |sigma_rows| Ok(held_out_log(sigma_rows)?.by_pixel))?;
        let residuals = held_out_log(sigma_rows)?;
        // The ideal beam is kept unless the width predicts better by more than one standard error.
        let (log_ratio, standard_error) = residuals.ratio_to(&best);
        if sigma_rows >= NARROWEST_ROWS && log_ratio < -standard_error {
            estimate = BeamEstimate { sigma_rows, standard_error_rows, pixels };
            best = residuals;
        }
    }
    if estimate.sigma_rows >= WIDEST_ROWS {
        return Err(CalibrateError::BeamTooWide { widest_rows: WIDEST_ROWS });
    }
    // If the plan cannot determine the width, the smallest residual is meaningless: clearly different widths must
    // predict worse.
    let others_rows = match estimate.sigma_rows {
        0.0 => vec![2.0 * NARROWEST_ROWS],
        sigma_rows => vec![sigma_rows / OTHER_WIDTH, sigma_rows * OTHER_WIDTH],
    };
    for other_rows in others_rows {
        let (log_ratio, standard_error) = held_out_log(other_rows)?.ratio_to(&best);
        let needed = MIN_RISE.ln_1p().max(MIN_STANDARD_ERRORS * standard_error);
        if log_ratio < needed {
            return Err(CalibrateError::BeamUndetermined {
                sigma_rows: estimate.sigma_rows,
                other_rows,
                rise_percent: 100.0 * log_ratio.exp_m1(),
                needed_percent: 100.0 * needed.exp_m1(),
            });
        }
    }
    Ok(estimate)
}

/// The minimum of held-out residuals around a rough width and its standard error, from a parabola over the logarithm
/// of the width, which is moved until it contains its minimum.
fn refine(
    rough_rows: f64,
    log_residual: impl Fn(f64) -> Result<Array1<f64>, PlaneError> + Sync,
) -> Result<(f64, f64), PlaneError> {
    let step = FINE_STEP.ln();
    let (mut sigma_rows, mut relative_error) = (rough_rows, f64::INFINITY);
    for _ in 0..FINE_ROUNDS {
        let (middle, (narrower, wider)) = rayon::join(
            || log_residual(sigma_rows),
            || rayon::join(|| log_residual(sigma_rows / FINE_STEP), || log_residual(sigma_rows * FINE_STEP)),
        );
        let (middle, narrower, wider) = (middle?, narrower?, wider?);
        let slope = (&wider - &narrower) / (2.0 * step);
        let curvature = (&wider + &narrower - 2.0 * &middle).sum() / step.powi(2);
        let change = match curvature > 0.0 {
            true => (-slope.sum() / curvature).clamp(-step, step),
            false => -step * slope.sum().signum(),
        };
        sigma_rows = (sigma_rows * change.exp()).min(WIDEST_ROWS);
        relative_error = if curvature > 0.0 { slope.dot(&slope).sqrt() / curvature } else { 1.0 };
        if change.abs() < step / 2.0 || sigma_rows < NARROWEST_ROWS {
            break;
        }
    }
    Ok((sigma_rows, relative_error * sigma_rows))
}

/// Index of the coarse width with the smallest score.
fn best_coarse(score: impl Fn(f64) -> Result<f64, PlaneError> + Sync) -> Result<usize, PlaneError> {
    let scores: Vec<f64> = COARSE_ROWS.into_par_iter().map(&score).collect::<Result<_, _>>()?;
    Ok((0..scores.len()).min_by(|&a, &b| scores[a].total_cmp(&scores[b])).unwrap_or(0))
}

/// The middle of the interval around a minimum that remains after a few golden-section steps.
fn golden_section(
    mut from: f64,
    mut to: f64,
    f: impl Fn(f64) -> Result<f64, PlaneError> + Sync,
) -> Result<f64, PlaneError> {
    let mut low = to - GOLDEN_RATIO * (to - from);
    let mut high = from + GOLDEN_RATIO * (to - from);
    let (f_first, f_second) = rayon::join(|| f(low), || f(high));
    let (mut f_low, mut f_high) = (f_first?, f_second?);
    for _ in 0..GOLDEN_STEPS - 1 {
        if f_low < f_high {
            (to, high, f_high) = (high, low, f_low);
            low = to - GOLDEN_RATIO * (to - from);
            f_low = f(low)?;
        } else {
            (from, low, f_low) = (low, high, f_high);
            high = from + GOLDEN_RATIO * (to - from);
            f_high = f(high)?;
        }
    }
    Ok(if f_low < f_high { low } else { high })
}

/// The minimum of the split prior's objective for each pixel.
pub(super) fn in_sample(sample: &Sample, optics: &Optics) -> Result<Vec<f64>, PlaneError> {
    let by_class: Vec<Vec<f64>> = sample
        .classes
        .par_iter()
        .map(|class| {
            let mut objectives = vec![0.0; class.pixels.len()];
            for (problem, pixels) in class.problems(&Prior::SPLIT, optics)? {
                let intensities = class.intensities.select(Axis(0), &pixels);
                let x = problem.minimise(intensities.view(), None);
                let minima = problem.minima(x.view(), intensities.view());
                pixels.iter().zip(minima).for_each(|(&pixel, minimum)| objectives[pixel] = minimum);
            }
            Ok(objectives)
        })
        .collect::<Result<_, PlaneError>>()?;
    Ok(by_class.concat())
}

/// The logarithm makes each pixel count relative to its own noise.
pub(super) fn log(objective: f64) -> f64 {
    objective.max(f64::MIN_POSITIVE).ln()
}

/// Only the pixels in which direct light stands out: the others do not depend on the beam but add noise.
pub(super) fn with_direct_light(sample: &Sample, beam_sigma_rows: f64) -> Result<Sample, CalibrateError> {
    let light = direct_light(sample, beam_sigma_rows)?;
    let direct: HashSet<(usize, usize)> =
        light.iter().filter(|light| light.stands_out).map(|light| (light.t, light.s)).collect();
    if direct.len() < MIN_PIXELS {
        return Err(CalibrateError::NoDirectLight { pixels: direct.len(), needed: MIN_PIXELS });
    }
    Ok(sample.keep(|pixel| direct.contains(&pixel)))
}
