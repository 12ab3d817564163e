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
const WITHIN: f64 = 0.98;

/// How far estimates of sums of the family's light are from the truth, beside what the prior is seen to do to them.
#[derive(Debug)]
pub struct BiasOfFamily {
    prior: Prior,
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
    /// One estimate, and the slots that are free in it.
    estimate: Array2<f64>,
    free: Array2<bool>,
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
        Ok(Self { prior, solved })
    }

    /// The bound on a sum in which the light of relative row `u` has the weight `weight(u)`, not negative: that of the
    /// camera row which sees the most of the sum.
    pub(in super::super) fn bound(&self, weight: impl Fn(i32) -> f64) -> Result<BiasBound, PlaneError> {
        let seen = |solved: &SolvedFamily| solved.rows.iter().map(|&(_, u)| weight(u)).sum::<f64>();
        let mut best: Option<(f64, &SolvedFamily)> = None;
        for solved in &self.solved {
            let seen = seen(solved);
            if best.is_none_or(|(most, _)| seen > most) {
                best = Some((seen, solved));
            }
        }
        match best {
            Some((seen, solved)) if seen > 0.0 => solved.bound(&self.prior, weight),
            // Nothing that any pixel could see is in the sum.
            _ => Ok(BiasBound { of_size: 0.0, of_light: 0.0 }),
        }
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
        let mut estimate = pixels.solve_all(&noise.added(settings, &light, 0), None);
        let near = estimate.mapv(|light| light > 0.0);
        let mut mean = estimate.clone();
        for draw in 1..DRAWS {
            mean += &pixels.solve_all(&noise.added(settings, &light, draw), Some(&near));
        }
        mean /= DRAWS as f64;
        let Pixels { slots, quadratic, own_slots, truth, .. } = pixels;
        let mut off = Array2::zeros(estimate.dim());
        for (of_truth, &slot) in truth.axis_iter(Axis(1)).zip(&own_slots) {
            off.column_mut(slot).assign(&(&mean.column(slot) - &of_truth));
        }
        let mut free = near;
        for (slot, _) in slots.iter().enumerate().filter(|(_, slot)| slot.kind != SlotKind::Own) {
            estimate.column_mut(slot).fill(0.0);
            free.column_mut(slot).fill(true);
        }
        let rows = own_slots.iter().map(|&slot| (slot, slots[slot].u)).collect();
        Ok(Self { rows, links: prior.links(&slots), quadratic, estimate, free, off })
    }

    fn bound(&self, prior: &Prior, weight: impl Fn(i32) -> f64) -> Result<BiasBound, PlaneError> {
        let (pixels, slots) = self.estimate.dim();
        let mut weights = Array1::zeros(slots);
        self.rows.iter().for_each(|&(slot, u)| weights[slot] = weight(u));
        let linear = weights.broadcast((pixels, slots)).ok_or(PlaneError::NotConvex)?.to_owned();
        let solutions = minimise_free(SimdLevel::best(), &self.quadratic, linear, self.free.view());
        if !solutions.iter().all(|entry| entry.is_finite()) {
            return Err(PlaneError::NotConvex);
        }
        let sizes = bias_sizes(prior, &self.links, &solutions, &self.estimate, 1);
        let light = self.estimate.sum_axis(Axis(1));
        // Both parts count alike on average; where smoothing leaves nothing to be seen, the light alone counts.
        let mean_size = sizes.sum();
        let light_share = if mean_size > 0.0 { mean_size / light.sum().max(f64::MIN_POSITIVE) } else { 1.0 };
        let bias = self.off.dot(&weights).mapv(f64::abs);
        let ratios = bias.iter().zip(&sizes).zip(&light).filter_map(|((bias, size), light)| {
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
