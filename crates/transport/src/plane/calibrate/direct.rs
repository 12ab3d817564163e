use ndarray::{Array1, Array2, Axis, s};
use rayon::prelude::*;

use super::super::{PlaneError, Prior};
use super::Sample;
use super::problem::RowProblem;
use super::sample::SampledClass;

/// Direct light is used if it exceeds the light of the neighbouring rows by this many standard errors.
const STANDS_OUT: f64 = 5.0;

/// The direct light of one sampled pixel, estimated with freedom to lie in rows -1, 0 and 1.
#[derive(Debug, Clone, Copy)]
pub(super) struct DirectLight {
    pub t: usize,
    pub s: usize,
    /// Whether the direct row is significantly brighter than its neighbours.
    pub stands_out: bool,
    /// Its mean position, and the standard error due to the samples' noise.
    pub u0_rows: f64,
    pub standard_error_rows: f64,
    /// Variance of the position for unit light and noise, which depends on the plan alone. If no setting
    /// distinguishes the rows, only rounding keeps it finite.
    pub plan_variance: f64,
    /// Minimum of the objective.
    pub objective: f64,
}

/// Estimates the direct light of all pixels of the sample for a given beam. Each has two more unknowns than with the
/// split prior: light in rows 1 and -1 that is not smoothed. Pixels at the border, whose row 1 or -1 does not exist,
/// are left out.
pub(super) fn direct_light(sample: &Sample, beam_sigma_rows: f64) -> Result<Vec<DirectLight>, PlaneError> {
    let by_class: Vec<Vec<DirectLight>> =
        sample.classes.par_iter().map(|class| of_class(class, beam_sigma_rows)).collect::<Result<_, _>>()?;
    Ok(by_class.concat())
}

fn of_class(class: &SampledClass, beam_sigma_rows: f64) -> Result<Vec<DirectLight>, PlaneError> {
    let (Some(above), Some(own), Some(below)) = (class.slot(-1), class.slot(0), class.slot(1)) else {
        return Ok(Vec::new());
    };
    let prior = Prior::SPLIT;
    let weights = class.weights(beam_sigma_rows);
    let slots = class.slots.len();
    let neighbours = weights.select(Axis(1), &[above, below]);
    let mut extended = Array2::zeros((weights.nrows(), slots + 2));
    extended.slice_mut(s![.., ..slots]).assign(&weights);
    extended.slice_mut(s![.., slots..]).assign(&neighbours);
    let differences = prior.differences(&class.slots);
    let mut extended_differences = Array2::zeros((differences.nrows(), slots + 2));
    extended_differences.slice_mut(s![.., ..slots]).assign(&differences);
    let problem = RowProblem::new(extended, extended_differences, &prior)?;
    let x = problem.minimise(class.intensities.view(), None);

    let moment = combination(slots + 2, &[(slots, -1.0), (slots + 1, 1.0)]);
    // The light at u = 0 is direct light plus indirect light, which is about that of the neighbours.
    let amount =
        combination(slots + 2, &[(slots, 1.0), (own, 1.0), (slots + 1, 1.0), (above, -0.5), (below, -0.5)]);
    let inverse = problem.inverse()?;
    let plan_variance = moment.dot(&inverse.dot(&moment));
    let amount_variance = amount.dot(&inverse.dot(&amount));
    let residual = x.dot(&problem.weights.t()) - &class.intensities;
    let minima = problem.minima(x.view(), class.intensities.view());
    let pixels = x.rows().into_iter().zip(residual.rows()).zip(minima).zip(&class.pixels);
    let light = pixels.map(|(((x, residual), objective), &(t, s))| {
        let noise_variance = residual.dot(&residual) / residual.len() as f64;
        let light = x.dot(&amount);
        DirectLight {
            t,
            s,
            stands_out: light > STANDS_OUT * (noise_variance * amount_variance).sqrt(),
            u0_rows: x.dot(&moment) / light,
            standard_error_rows: (noise_variance * plan_variance).sqrt() / light,
            plan_variance,
            objective,
        }
    });
    Ok(light.collect())
}

fn combination(length: usize, terms: &[(usize, f64)]) -> Array1<f64> {
    let mut vector = Array1::zeros(length);
    terms.iter().for_each(|&(index, factor)| vector[index] = factor);
    vector
}
