use ndarray::{Array1, Array2, Axis};

use super::super::solve::pivot::minimise_free;
use super::super::{PlaneError, Prior, RowTiming, Setting, SimdLevel};
use super::foresee::{Noise, Pixels};

/// Number of noise patterns over which the bias of an estimate is averaged.
const DRAWS: u64 = 4;
/// Share of the family's estimates within the bound: more than the 95 % that it must hold for, because scenes differ
/// more from the family than its pixels from each other.
const WITHIN: f64 = 0.98;

/// How far estimates of sums of the family's light are from the truth, beside what the prior is seen to do to them.
#[derive(Debug)]
pub struct BiasOfFamily {
    pixels: Pixels,
    /// Estimates of all slots, `[pixels, slots]`, of each noise pattern.
    estimates: Vec<Array2<f64>>,
    prior: Prior,
}

/// A bound on the bias of a sum of light, as multiples of what is known of a pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in super::super) struct BiasBound {
    /// Of the size of the bias that the estimate itself shows.
    pub of_size: f64,
    /// Of the pixel's whole light: the estimate does not show what smoothing has already removed.
    pub of_light: f64,
}

impl BiasBound {
    /// That of a sum without light.
    pub const NONE: Self = Self { of_size: 0.0, of_light: 0.0 };

    /// A bound where either holds.
    pub fn or_larger(self, other: Self) -> Self {
        Self { of_size: self.of_size.max(other.of_size), of_light: self.of_light.max(other.of_light) }
    }
}

impl BiasOfFamily {
    /// Photographs and solves the family.
    pub(in super::super) fn new(
        timing: &RowTiming,
        prior: Prior,
        settings: &[Setting],
        noise: &Noise,
    ) -> Result<Self, PlaneError> {
        let pixels = Pixels::new(timing, &prior, settings)?;
        let light = pixels.light(settings, timing);
        let first = pixels.solve_all(&noise.added(settings, &light, 0), None);
        let free = first.mapv(|light| light > 0.0);
        let others =
            (1..DRAWS).map(|draw| pixels.solve_all(&noise.added(settings, &light, draw), Some(&free)));
        let estimates = others.collect();
        Ok(Self { pixels, estimates: [vec![first], estimates].concat(), prior })
    }

    /// The bound on a sum in which the light of relative row `u` has the weight `weight(u)`.
    pub(in super::super) fn bound(&self, weight: impl Fn(i32) -> f64) -> Result<BiasBound, PlaneError> {
        let Pixels { slots, quadratic, own_slots, truth, .. } = &self.pixels;
        let of_own: Array1<f64> = own_slots.iter().map(|&slot| weight(slots[slot].u)).collect();
        let mut of_slots = Array1::zeros(slots.len());
        own_slots.iter().zip(&of_own).for_each(|(&slot, &weight)| of_slots[slot] = weight);
        if of_own.iter().all(|&weight| weight == 0.0) {
            return Ok(BiasBound::NONE);
        }
        let differences = self.prior.differences(slots);
        let own = |estimate: &Array2<f64>| estimate.select(Axis(1), own_slots);
        let sums = self.estimates.iter().map(|estimate| own(estimate).dot(&of_own));
        let mean = sums.fold(Array1::zeros(truth.nrows()), |sum, of| sum + of) / self.estimates.len() as f64;
        let bias = (mean - truth.dot(&of_own)).mapv(f64::abs);
        // What the first estimate shows of it: its size, and the light.
        let estimate = &self.estimates[0];
        let mut linear = Array2::zeros(estimate.dim());
        linear.rows_mut().into_iter().for_each(|mut row| row.assign(&of_slots));
        let free = estimate.mapv(|light| light > 0.0);
        let solutions = minimise_free(SimdLevel::best(), quadratic, linear, free.view());
        if !solutions.iter().all(|entry| entry.is_finite()) {
            return Err(PlaneError::NotConvex);
        }
        let sizes = bias_sizes(&self.prior, &differences, &solutions, estimate, 1);
        let light = own(estimate).sum_axis(Axis(1));
        let median = |of: &Array1<f64>| quantile(of.to_vec(), 0.5);
        // Both parts count alike for a typical pixel.
        let light_share = median(&sizes) / median(&light).max(f64::MIN_POSITIVE);
        let ratios = bias.iter().zip(&sizes).zip(&light).map(|((bias, size), light)| {
            let scale = size + light_share * light;
            if scale > 0.0 { bias / scale } else { 0.0 }
        });
        let of_size = quantile(ratios.collect(), WITHIN);
        Ok(BiasBound { of_size, of_light: of_size * light_share })
    }
}

/// Size of the bias that a prior gives to each sum, `[pixels * sums]`, as their estimates `[pixels, slots]` show it.
/// `solutions`, `[pixels * sums, slots]`, are `H_FF^-1 e` for the weights `e` of each sum.
///
/// Without noise, the estimate of a sum differs from the truth by `alpha (D g)'(D T) + beta/2 sum(g)`, where
/// `g = H_FF^-1 e` and `T` is the truth. Here the estimate is taken for the truth, and the terms of the sum by their
/// sizes, so that terms that cancel by chance do not hide the others.
pub(in super::super) fn bias_sizes(
    prior: &Prior,
    differences: &Array2<f64>,
    solutions: &Array2<f64>,
    estimates: &Array2<f64>,
    sums: usize,
) -> Array1<f64> {
    let (stiff, rough) = (solutions.dot(&differences.t()), estimates.dot(&differences.t()));
    Array1::from_shape_fn(solutions.nrows(), |row| {
        let terms = stiff.row(row).into_iter().zip(rough.row(row / sums));
        let smoothed = terms.map(|(a, b)| (a * b).abs()).sum::<f64>();
        prior.alpha() * smoothed + prior.beta() / 2.0 * solutions.row(row).sum().abs()
    })
}

fn quantile(mut values: Vec<f64>, share: f64) -> f64 {
    values.sort_by(f64::total_cmp);
    values[(share * (values.len() - 1) as f64).round() as usize]
}
