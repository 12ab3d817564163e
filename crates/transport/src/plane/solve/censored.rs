//! Pixels with censored samples. A saturated sample says that the light is at least what it shows, so only what the
//! prediction lacks is squared: `max(0, I - A T)^2`. An active set on top of [`minimise`] finds the minimum.

use ndarray::{Array1, ArrayView1, Axis};

use super::super::PlaneError;
use super::pivot::{Start, minimise};
use super::tiles::Problem;
use super::{Prior, SimdLevel, reference};

/// Rounds after which a pixel is left to the reference solver; ordinary pixels take two to four.
const MAX_ROUNDS: usize = 30;

/// A prediction above a bound by no more than this share of it is attributed to rounding.
const TOLERANCE: f64 = 1e-9;

/// The minimum of one pixel, `[slots]`. `samples` are those of [`Problem::rows`], the bracket's scaled like its row.
/// Where `valid` is false, they are lower bounds, and those of 0 or less say nothing.
pub fn minimise_censored(
    simd: SimdLevel,
    problem: &Problem,
    prior: &Prior,
    samples: ArrayView1<f64>,
    valid: ArrayView1<bool>,
) -> Result<Array1<f64>, PlaneError> {
    let rows = problem.rows();
    let informative: Array1<bool> =
        samples.iter().zip(valid).map(|(&sample, valid)| *valid || sample > 0.0).collect();
    let linear = |of: &Problem| {
        let samples = samples.select(Axis(0), &of.settings).insert_axis(Axis(0));
        of.quadratic.linear(of.weights.view(), samples.view())
    };
    // At first all bounds count as exact and all rows as lit.
    let mut used = informative.clone();
    let mut lit = Array1::from_elem(rows.ncols(), true);
    for _ in 0..MAX_ROUNDS {
        let own = problem.of_samples(used.view(), prior)?;
        let start = lit.view().insert_axis(Axis(0));
        let x = minimise(simd, &own.quadratic, linear(&own), &Start::Free(start)).index_axis_move(Axis(0), 0);
        let predicted = rows.dot(&x);
        let next = Array1::from_shape_fn(used.len(), |n| {
            valid[n] || informative[n] && predicted[n] <= samples[n] * (1.0 + TOLERANCE)
        });
        if next == used {
            return Ok(x);
        }
        used = next;
        lit = x.mapv(|light| light > 0.0);
    }
    let all = problem.of_samples(informative.view(), prior)?;
    let censored: Vec<usize> = (0..informative.len()).filter(|&n| informative[n] && !valid[n]).collect();
    let (weights, bounds) = (rows.select(Axis(0), &censored), samples.select(Axis(0), &censored));
    let c = linear(&all).into_raw_vec_and_offset().0;
    Ok(reference::minimise_censored(all.quadratic.h(), &c, weights.view(), &bounds.to_vec()).into())
}
