use std::ops::RangeInclusive;

use ndarray::{Array1, Array2, Axis, s};
use rayon::prelude::*;
use raysweep_transport::plane::{Prior, RowModel, SlotKind, Transport, reference};
use serde::{Deserialize, Serialize};

use super::scene::Case;

/// The pixels solved by the slow reference, spread evenly.
#[derive(Debug, Clone, Copy)]
pub struct Sample {
    pub every_row: usize,
    pub every_column: usize,
}

impl Sample {
    pub const EVERY_PIXEL: Self = Self { every_row: 1, every_column: 1 };
}

/// How far an estimate is from the f64 reference.
#[derive(Debug, Serialize, Deserialize)]
pub struct Accuracy {
    pub pixels: usize,
    /// Objective above the minimum, relative to the minimum: median and largest.
    pub gap_median: f64,
    pub gap_largest: f64,
    /// Relative l2 distance of the profile: median and largest.
    pub error_median: f64,
    pub error_largest: f64,
}

/// Compares the sampled pixels of `transport` with [`reference::minimise`]. Also returns the least objective values,
/// shape `[t, s]`, NaN for pixels that are not in the sample.
///
/// Rows whose exposures reach into a neighbouring frame are left out: their minimiser has rows that a transport does
/// not contain.
pub fn against_the_reference(case: &Case, prior: Prior, transport: &Transport) -> (Accuracy, Array2<f64>) {
    let (_, rows, columns) = case.stack.dim();
    let reach = transport.u_min..=transport.u_max();
    let mut best = Array2::from_elem((rows, columns), f64::NAN);
    let figures: Vec<(f64, f64)> = best
        .axis_iter_mut(Axis(0))
        .into_par_iter()
        .enumerate()
        .filter(|(row, _)| row % case.sample.every_row == 0)
        .flat_map_iter(|(row, mut best)| {
            let objective = Objective::new(case, prior, &reach, row);
            let sampled = (0..columns).step_by(case.sample.every_column);
            let sampled = sampled.filter(|_| objective.holds_all_rows()).map(|column| {
                let samples = case.stack.slice(s![.., row, column]).mapv(f64::from);
                let expected = objective.minimiser(&samples);
                best[column] = objective.value(&expected, &samples);
                let x = objective.profile(transport, row, column);
                let error = &x - &expected;
                let gap = objective.value(&x, &samples) / best[column] - 1.0;
                (gap, (error.dot(&error) / expected.dot(&expected)).sqrt())
            });
            sampled.collect::<Vec<_>>()
        })
        .collect();

    let (mut gaps, mut errors): (Vec<f64>, Vec<f64>) = figures.into_iter().unzip();
    gaps.sort_by(f64::total_cmp);
    errors.sort_by(f64::total_cmp);
    let (middle, last) = (gaps.len() / 2, gaps.len() - 1);
    let accuracy = Accuracy {
        pixels: gaps.len(),
        gap_median: gaps[middle],
        gap_largest: gaps[last],
        error_median: errors[middle],
        error_largest: errors[last],
    };
    (accuracy, best)
}

/// The objective of one camera row, assembled in f64 from its definition.
pub struct Objective {
    pub model: RowModel,
    /// `D`, shape `[differences, slots]`.
    pub differences: Array2<f64>,
    prior: Prior,
    h: Array2<f64>,
}

impl Objective {
    pub fn new(case: &Case, prior: Prior, reach: &RangeInclusive<i32>, row: usize) -> Self {
        let model = RowModel::new(&case.timing, &case.settings, reach, row);
        let differences = prior.differences(&model.slots);
        let h = model.weights.t().dot(&model.weights) + prior.alpha() * differences.t().dot(&differences);
        Self { model, differences, prior, h }
    }

    /// Whether a transport contains all unknowns.
    fn holds_all_rows(&self) -> bool {
        self.model.slots.iter().all(|slot| slot.kind == SlotKind::Own)
    }

    fn minimiser(&self, samples: &Array1<f64>) -> Array1<f64> {
        let c = self.model.weights.t().dot(samples) - self.prior.beta() / 2.0;
        reference::minimise(self.h.view(), &c.to_vec()).into()
    }

    fn value(&self, x: &Array1<f64>, samples: &Array1<f64>) -> f64 {
        let misfit = self.model.weights.dot(x) - samples;
        let rough = self.differences.dot(x);
        misfit.dot(&misfit) + self.prior.alpha() * rough.dot(&rough) + self.prior.beta() * x.sum()
    }

    fn profile(&self, transport: &Transport, row: usize, column: usize) -> Array1<f64> {
        let index = |u: i32| (u - transport.u_min) as usize;
        self.model.slots.iter().map(|slot| f64::from(transport.t[[index(slot.u), row, column]])).collect()
    }
}
