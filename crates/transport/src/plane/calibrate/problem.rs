use ndarray::{Array1, Array2, ArrayView1, ArrayView2, Axis};

use super::super::{PlaneError, Prior, cholesky, reference};

/// Relative increase of the diagonal of `H`: rows that nothing determines must not spoil the inverse, and a
/// billionth moves no estimate by anything near a sample's noise.
const RIDGE: f64 = 1e-9;

/// Smallest pivot at which the downdate of an inverse is trusted; below it the inverse is made anew.
const MIN_PIVOT: f64 = 1e-6;

/// Exchanges without progress before the backup rule takes over, and steps before the reference solver does.
const PATIENCE: usize = 3;
const MAX_STEPS: usize = 100;

/// Infeasibility below this share of the problem's own scale is rounding.
const TOLERANCE: f64 = 1e-9;

/// The objective `x'Hx - 2 c'x` over `x >= 0` of one camera row, in f64, for weights that calibration varies.
pub(super) struct RowProblem {
    /// `A`, shape `[settings, slots]`.
    pub weights: Array2<f64>,
    /// `H^-1`, shape `[slots, slots]`.
    pub inverse: Array2<f64>,
    h: Array2<f64>,
    half_beta: f64,
}

/// Which slots are free in a pixel's minimiser; the next minimisation starts from there.
pub(super) type FreeSet = Vec<bool>;

impl RowProblem {
    /// `differences` is `D`, shape `[differences, slots]`.
    pub fn new(
        weights: Array2<f64>,
        differences: ArrayView2<f64>,
        prior: &Prior,
    ) -> Result<Self, PlaneError> {
        let mut h = weights.t().dot(&weights) + prior.alpha() * differences.t().dot(&differences);
        for diagonal in h.diag_mut() {
            // A slot that nothing sees or holds must not make H singular; its x is 0 in any case.
            *diagonal = if *diagonal > 0.0 { *diagonal * (1.0 + RIDGE) } else { 1.0 };
        }
        let inverse = invert(&h)?;
        Ok(Self { weights, inverse, h, half_beta: prior.beta() / 2.0 })
    }

    /// The same problem for some of the settings only: those whose indices are in `kept`; `held` are the others.
    pub fn without(&self, kept: &[usize], held: &[usize]) -> Result<Self, PlaneError> {
        let removed = self.weights.select(Axis(0), held);
        let h = &self.h - &removed.t().dot(&removed);
        // Woodbury: (H - R'R)^-1 = H^-1 + G' (1 - R G')^-1 G with G = R H^-1.
        let gain = removed.dot(&self.inverse);
        let mut core: Vec<f64> = (-gain.dot(&removed.t())).into_iter().collect();
        (0..held.len()).for_each(|i| core[i * held.len() + i] += 1.0);
        let factored = cholesky::factor(&mut core, held.len()).is_ok();
        let inverse = if factored && (0..held.len()).all(|i| core[i * held.len() + i] > MIN_PIVOT) {
            let mut solved = gain.t().to_owned();
            for mut slot in solved.rows_mut() {
                let mut values = slot.to_vec();
                cholesky::solve(&core, held.len(), &mut values);
                slot.assign(&Array1::from(values));
            }
            &self.inverse + &solved.dot(&gain)
        } else {
            invert(&h)?
        };
        Ok(Self { weights: self.weights.select(Axis(0), kept), inverse, h, half_beta: self.half_beta })
    }

    /// Free sets to start from when nothing is known.
    pub fn all_free(&self, pixels: usize) -> Vec<FreeSet> {
        vec![vec![true; self.h.nrows()]; pixels]
    }

    /// Minimisers of several pixels, shape `[pixels, slots]`, from `samples`, `[pixels, settings]`. Starts from the
    /// pixels' free sets, and leaves there those of the minimisers.
    pub fn minimise(&self, samples: ArrayView2<f64>, free: &mut [FreeSet]) -> Array2<f64> {
        let linear = samples.dot(&self.weights) - self.half_beta;
        let mut x = linear.dot(&self.inverse);
        for ((mut x, c), free) in x.rows_mut().into_iter().zip(linear.rows()).zip(free) {
            let minimiser = self.minimise_one(c, x.view(), free);
            x.assign(&minimiser);
        }
        x
    }

    /// Value of `||A x - I||^2 + alpha ||D x||^2 + beta sum(x)` for each pixel at its minimiser.
    pub fn minima(&self, x: ArrayView2<f64>, samples: ArrayView2<f64>) -> Array1<f64> {
        // There x'(Hx - c) = 0, so of x'Hx - 2 c'x + I'I only I'I - c'x is left.
        let linear = samples.dot(&self.weights) - self.half_beta;
        (&samples * &samples).sum_axis(Axis(1)) - (&linear * &x).sum_axis(Axis(1))
    }

    /// Block principal pivoting (Kim and Park, 2011, section 4) on the smaller side: either the free rows' system in
    /// `H`, or that of the zero rows in `H^-1`.
    fn minimise_one(
        &self,
        c: ArrayView1<f64>,
        unconstrained: ArrayView1<f64>,
        free: &mut FreeSet,
    ) -> Array1<f64> {
        let slots = c.len();
        let gradient_tolerance = TOLERANCE * largest(c);
        let (mut fewest, mut patience) = (usize::MAX, PATIENCE);
        for _ in 0..MAX_STEPS {
            let Some((x, gradient)) = self.stationary_point(c, unconstrained, free) else { break };
            let x_tolerance = TOLERANCE * largest(x.view());
            let wrong: Vec<usize> = (0..slots)
                .filter(|&i| match free[i] {
                    true => x[i] < -x_tolerance,
                    false => gradient[i] < -gradient_tolerance,
                })
                .collect();
            let Some(&last) = wrong.last() else { return x.mapv_into(|x| x.max(0.0)) };
            if wrong.len() < fewest {
                (fewest, patience) = (wrong.len(), PATIENCE);
            } else if patience > 0 {
                patience -= 1;
            } else {
                free[last] = !free[last];
                continue;
            }
            wrong.into_iter().for_each(|i| free[i] = !free[i]);
        }
        reference::minimise(self.h.view(), &c.to_vec()).into()
    }

    /// The minimum with 0 in all rows that are not free, and half the gradient there.
    fn stationary_point(
        &self,
        c: ArrayView1<f64>,
        unconstrained: ArrayView1<f64>,
        free: &[bool],
    ) -> Option<(Array1<f64>, Array1<f64>)> {
        let (free_rows, zero_rows): (Vec<usize>, Vec<usize>) = (0..free.len()).partition(|&i| free[i]);
        if free_rows.len() < zero_rows.len() {
            let values = solve_part(&self.h, &free_rows, |i| c[i])?;
            let mut x = Array1::zeros(free.len());
            free_rows.iter().zip(values).for_each(|(&i, value)| x[i] = value);
            let gradient = self.h.dot(&x) - c;
            Some((x, gradient))
        } else {
            let values = solve_part(&self.inverse, &zero_rows, |i| -unconstrained[i])?;
            let mut gradient = Array1::zeros(free.len());
            let mut x = unconstrained.to_owned();
            for (&i, value) in zero_rows.iter().zip(values) {
                gradient[i] = value;
                x.scaled_add(value, &self.inverse.row(i));
            }
            zero_rows.iter().for_each(|&i| x[i] = 0.0);
            Some((x, gradient))
        }
    }
}

/// Solves the system of the chosen rows and columns of `matrix`; `None` if it is not positive definite.
fn solve_part(matrix: &Array2<f64>, chosen: &[usize], value: impl Fn(usize) -> f64) -> Option<Vec<f64>> {
    let mut part = Vec::with_capacity(chosen.len() * chosen.len());
    for &i in chosen {
        let row = matrix.row(i);
        part.extend(chosen.iter().map(|&j| row[j]));
    }
    let mut values: Vec<f64> = chosen.iter().map(|&i| value(i)).collect();
    cholesky::factor(&mut part, chosen.len()).ok()?;
    cholesky::solve(&part, chosen.len(), &mut values);
    Some(values)
}

/// The inverse of a symmetric positive definite matrix.
pub(super) fn invert(h: &Array2<f64>) -> Result<Array2<f64>, PlaneError> {
    let n = h.nrows();
    // Scaled to a unit diagonal, because smoothness far from u = 0 weighs a million times more than the data.
    let scale: Vec<f64> = h.diag().iter().map(|diagonal| diagonal.sqrt().recip()).collect();
    let mut factor: Vec<f64> = h.indexed_iter().map(|((i, j), value)| value * scale[i] * scale[j]).collect();
    cholesky::factor(&mut factor, n).map_err(|cholesky::NotPositiveDefinite| PlaneError::NotConvex)?;
    let mut inverse = Array2::zeros((n, n));
    let mut column = vec![0.0; n];
    for (i, mut row) in inverse.rows_mut().into_iter().enumerate() {
        column.fill(0.0);
        column[i] = scale[i];
        cholesky::solve(&factor, n, &mut column);
        row.iter_mut().zip(column.iter().zip(&scale)).for_each(|(to, (value, scale))| *to = value * scale);
    }
    Ok(inverse)
}

fn largest(values: ArrayView1<f64>) -> f64 {
    values.iter().fold(0.0, |largest, value| value.abs().max(largest))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn problem(weights: Vec<f64>, prior: Prior) -> RowProblem {
        let slots: Vec<_> = (-3..4)
            .map(|u| super::super::super::Slot { u, kind: super::super::super::SlotKind::Own })
            .collect();
        let weights = Array2::from_shape_vec((5, 7), weights).unwrap();
        RowProblem::new(weights, prior.differences(&slots).view(), &prior).unwrap()
    }

    proptest! {
        #[test]
        fn equals_the_reference(
            weights in prop::collection::vec(0.0..1.0, 35),
            samples in prop::collection::vec(-0.5..1.5, 15),
            prior in prop_oneof![Just(Prior::PAPER), Just(Prior::SPLIT)],
        ) {
            let problem = problem(weights, prior);
            let samples = Array2::from_shape_vec((3, 5), samples).unwrap();
            let x = problem.minimise(samples.view(), &mut problem.all_free(3));
            for (x, samples) in x.rows().into_iter().zip(samples.rows()) {
                let c = samples.dot(&problem.weights) - problem.half_beta;
                let expected = reference::minimise(problem.h.view(), &c.to_vec());
                for (x, expected) in x.iter().zip(expected) {
                    prop_assert!((x - expected).abs() < 1e-6, "{x} is not {expected}");
                }
            }
        }

        #[test]
        fn leaving_settings_out_equals_never_having_had_them(weights in prop::collection::vec(0.0..1.0, 35)) {
            let (kept, held) = ([0, 2, 4], [1, 3]);
            let whole = problem(weights, Prior::SPLIT);
            let part = whole.without(&kept, &held).unwrap();
            let kept_weights = whole.weights.select(Axis(0), &kept);
            prop_assert_eq!(&part.weights, &kept_weights);
            let identity = part.h.dot(&part.inverse) - Array2::<f64>::eye(7);
            prop_assert!(identity.iter().all(|entry| entry.abs() < 1e-5), "{}", identity);
        }
    }
}
