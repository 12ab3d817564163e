use ndarray::{Array1, Array2, Axis};
use rayon::prelude::*;

use super::super::solve::pivot::minimise_free;
use super::super::solve::quadratic::Quadratic;
use super::super::{PlaneError, Prior, RowTiming, Setting, SimdLevel, SlotKind};
use super::foresee::{Noise, Pixels};

/// Number of noise patterns over which the bias of an estimate is averaged.
const DRAWS: u64 = 4;
/// Share of the family's pixels within the bound: more than the 95 % that it is meant for, because scenes differ more
/// from the family than its pixels from each other.
const WITHIN: f64 = 0.99;

/// How far estimates of sums of the family's light are from the truth, beside what the prior is seen to do to them.
#[derive(Debug)]
pub struct BiasOfFamily {
    prior: Prior,
    projector_rows: i32,
    /// In the middle of the image, in its first and in its last camera row: a row sees other relative rows than others.
    solved: Vec<SolvedFamily>,
}

/// The family in one camera row. Each array is `[pixels, slots]`; light that is not part of profiles is 0, as it is for
/// the pixels of a run.
#[derive(Debug)]
struct SolvedFamily {
    /// Relative row of each slot that is part of profiles.
    rows: Vec<(usize, i32)>,
    links: Vec<[(usize, f64); 2]>,
    quadratic: Quadratic,
    /// An estimate for each noise pattern, and the slots that are free in it.
    estimates: Vec<(Array2<f64>, Array2<bool>)>,
    /// What estimates are off on average.
    off: Array2<f64>,
}

/// A bound on the bias of a sum of light, as multiples of what is known of a pixel.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(in super::super) struct BiasBound {
    /// Of the size of the bias that the estimate itself shows.
    pub of_size: f64,
    /// Of the pixel's whole light: the estimate does not show what smoothing has already removed.
    pub of_light: f64,
}

impl BiasOfFamily {
    /// Photographs and solves the family.
    pub(in super::super) fn new(
        timing: &RowTiming,
        prior: Prior,
        settings: &[Setting],
        noise: &Noise,
    ) -> Result<Self, PlaneError> {
        let last = timing.camera_rows() - 1;
        let solve = |camera_row| SolvedFamily::new(timing, prior, settings, noise, camera_row);
        let solved =
            [timing.camera_rows() / 2, 0, last].into_par_iter().map(solve).collect::<Result<_, _>>()?;
        Ok(Self { prior, projector_rows: timing.projector_rows() as i32, solved })
    }

    /// The bound on a sum in which the light of relative row `u` has the weight `weight(u)`, not negative: that of the
    /// camera row which sees the most of the sum. Where none sees any of it, the sum is taken for one of the farthest
    /// rows that are seen.
    pub(in super::super) fn bound(&self, weight: impl Fn(i32) -> f64) -> Result<BiasBound, PlaneError> {
        let all: f64 = (-self.projector_rows..=self.projector_rows).map(&weight).sum();
        let total = |solved: &SolvedFamily| solved.weights(&weight).sum();
        // Of equals the first: `max_by` takes the last.
        let best = self
            .solved
            .iter()
            .rev()
            .max_by(|a, b| total(a).total_cmp(&total(b)))
            .ok_or(PlaneError::NotConvex)?;
        if total(best) > 0.0 {
            return best.bound(&self.prior, best.weights(&weight));
        }
        let farthest = self.solved.iter().flat_map(|solved| {
            [solved.rows.first(), solved.rows.last()].into_iter().flatten().map(move |row| (solved, row.1))
        });
        let (solved, farthest) = farthest.max_by_key(|(_, u)| u.abs()).ok_or(PlaneError::NotConvex)?;
        solved.bound(&self.prior, solved.weights(|u| if u == farthest { all } else { 0.0 }))
    }
}

impl SolvedFamily {
    fn new(
        timing: &RowTiming,
        prior: Prior,
        settings: &[Setting],
        noise: &Noise,
        camera_row: usize,
    ) -> Result<Self, PlaneError> {
        let pixels = Pixels::new(timing, &prior, settings, camera_row)?;
        let light = pixels.light(settings, timing);
        let mut estimates: Vec<Array2<f64>> = Vec::new();
        for draw in 0..DRAWS {
            let near = estimates.first().map(|estimate| estimate.mapv(|light| light > 0.0));
            estimates.push(pixels.solve_all(&noise.added(settings, &light, draw), near.as_ref()));
        }
        let zeros = Array2::zeros((light.nrows(), pixels.slots.len()));
        let mean = estimates.iter().fold(zeros, |sum, estimate| sum + estimate) / DRAWS as f64;
        let Pixels { slots, quadratic, own_slots, truth, .. } = pixels;
        let mut off = Array2::zeros(mean.dim());
        for (of_truth, &slot) in truth.axis_iter(Axis(1)).zip(&own_slots) {
            off.column_mut(slot).assign(&(&mean.column(slot) - &of_truth));
        }
        let others = || slots.iter().enumerate().filter(|(_, slot)| slot.kind != SlotKind::Own);
        let of_profiles = |mut estimate: Array2<f64>| {
            let mut free = estimate.mapv(|light| light > 0.0);
            for (slot, _) in others() {
                estimate.column_mut(slot).fill(0.0);
                free.column_mut(slot).fill(true);
            }
            (estimate, free)
        };
        let estimates = estimates.into_iter().map(of_profiles).collect();
        let rows = own_slots.iter().map(|&slot| (slot, slots[slot].u)).collect();
        Ok(Self { rows, links: prior.links(&slots), quadratic, estimates, off })
    }

    /// The weight of each slot.
    fn weights(&self, weight: impl Fn(i32) -> f64) -> Array1<f64> {
        let mut weights = Array1::zeros(self.off.ncols());
        self.rows.iter().for_each(|&(slot, u)| weights[slot] = weight(u));
        weights
    }

    fn bound(&self, prior: &Prior, weights: Array1<f64>) -> Result<BiasBound, PlaneError> {
        let bias = self.off.dot(&weights).mapv(f64::abs);
        // What each estimate of a pixel shows: the size of its bias, and its light.
        let mut shown: Vec<[f64; 2]> = Vec::new();
        for (estimate, free) in &self.estimates {
            let linear = weights.broadcast(estimate.dim()).ok_or(PlaneError::NotConvex)?.to_owned();
            let solutions = minimise_free(SimdLevel::best(), &self.quadratic, linear, free.view());
            if !solutions.iter().all(|entry| entry.is_finite()) {
                return Err(PlaneError::NotConvex);
            }
            let sizes = bias_sizes(prior, &self.links, &solutions, estimate, 1);
            shown
                .extend(sizes.into_iter().zip(estimate.sum_axis(Axis(1))).map(|(size, light)| [size, light]));
        }
        // Both parts count alike on average; where smoothing leaves nothing to be seen, the light alone counts.
        let [sizes, light] = shown.iter().fold([0.0; 2], |sum, of| [sum[0] + of[0], sum[1] + of[1]]);
        let light_share = if sizes > 0.0 { sizes / light.max(f64::MIN_POSITIVE) } else { 1.0 };
        let ratios = shown.iter().zip(bias.iter().cycle()).filter_map(|([size, light], bias)| {
            let scale = size + light_share * light;
            (scale > 0.0).then(|| bias / scale)
        });
        let mut ratios: Vec<f64> = ratios.collect();
        ratios.sort_by(f64::total_cmp);
        let place = (WITHIN * ratios.len().saturating_sub(1) as f64).round() as usize;
        let of_size = ratios.get(place).copied().ok_or(PlaneError::NotConvex)?;
        Ok(BiasBound { of_size, of_light: of_size * light_share })
    }
}

/// Size of the bias that a prior gives to each sum, `[pixels * sums]`, as their estimates `[pixels, slots]` show it.
/// `links` are the prior's; `solutions`, `[pixels * sums, slots]`, are `H_FF^-1 e` for the weights `e` of each sum.
///
/// Without noise, the estimate of a sum differs from the truth by `alpha (D g)'(D T) + beta/2 sum(g)`, where
/// `g = H_FF^-1 e` and `T` is the truth. Here the estimate is taken for the truth, and the terms of the sum by their
/// sizes, so that terms that cancel by chance do not hide the others.
pub(in super::super) fn bias_sizes(
    prior: &Prior,
    links: &[[(usize, f64); 2]],
    solutions: &Array2<f64>,
    estimates: &Array2<f64>,
    sums: usize,
) -> Array1<f64> {
    Array1::from_shape_fn(solutions.nrows(), |row| {
        let (solution, estimate) = (solutions.row(row), estimates.row(row / sums));
        let term = |[(a, x), (b, y)]: &[(usize, f64); 2]| {
            ((x * solution[*a] + y * solution[*b]) * (x * estimate[*a] + y * estimate[*b])).abs()
        };
        prior.alpha() * links.iter().map(term).sum::<f64>() + prior.beta() / 2.0 * solution.sum().abs()
    })
}
