use ndarray::{ArrayView1, ArrayView2};

use super::cholesky;
use super::quadratic::Quadratic;

/// Full exchanges allowed without progress before the backup rule takes over (Kim and Park recommend 3).
pub(super) const PATIENCE: usize = 3;

/// Steps after which a pixel is left to the reference solver; ordinary pixels take about five.
pub(super) const MAX_STEPS: usize = 300;

/// Infeasibility below this share of the problem's own scale is rounding.
pub(super) const TOLERANCE: f64 = 1e-11;

/// Minimises `x'Hx - 2 c'x` over `x >= 0` by block principal pivoting: exact in finitely many steps (Kim and Park,
/// "Fast Nonnegative Matrix Factorization: An Active-Set-Like Method and Comparisons", 2011, section 4).
///
/// One value serves one pixel after the other, and starts each from the free rows of the one before.
pub(super) struct Pivoting {
    free: Vec<bool>,
    /// The minimiser once [`Self::minimise`] has returned [`Outcome::Minimum`].
    pub x: Vec<f64>,
    /// Half the gradient, `Hx - c`.
    gradient: Vec<f64>,
    free_rows: Vec<usize>,
    zero_rows: Vec<usize>,
    matrix: Vec<f64>,
    values: Vec<f64>,
}

#[derive(Debug, PartialEq, Eq)]
pub(super) enum Outcome {
    Minimum,
    GaveUp,
}

impl Pivoting {
    pub fn new(slots: usize) -> Self {
        Self {
            free: vec![true; slots],
            x: vec![0.0; slots],
            gradient: vec![0.0; slots],
            free_rows: Vec::with_capacity(slots),
            zero_rows: Vec::with_capacity(slots),
            matrix: Vec::with_capacity(slots * slots),
            values: Vec::with_capacity(slots),
        }
    }

    /// `unconstrained` is `H^-1 c`.
    pub fn minimise(&mut self, quadratic: &Quadratic, c: &[f64], unconstrained: &[f64]) -> Outcome {
        let gradient_tolerance = TOLERANCE * largest(c);
        let mut fewest = usize::MAX;
        let mut patience = PATIENCE;
        for _ in 0..MAX_STEPS {
            if self.solve_for_free_rows(quadratic, c, unconstrained).is_err() {
                return Outcome::GaveUp;
            }
            let x_tolerance = TOLERANCE * largest(&self.x);
            let infeasible = |i: &usize| match self.free[*i] {
                true => self.x[*i] < -x_tolerance,
                false => self.gradient[*i] < -gradient_tolerance,
            };
            let wrong: Vec<usize> = (0..c.len()).filter(infeasible).collect();
            let Some(&last) = wrong.last() else {
                self.x.iter_mut().for_each(|x| *x = x.max(0.0));
                return Outcome::Minimum;
            };
            if wrong.len() < fewest {
                (fewest, patience) = (wrong.len(), PATIENCE);
            } else if patience > 0 {
                patience -= 1;
            } else {
                // Exchanging only the last row cannot cycle (Murty), so the count falls below `fewest` at last.
                self.free[last] = !self.free[last];
                continue;
            }
            wrong.into_iter().for_each(|i| self.free[i] = !self.free[i]);
        }
        Outcome::GaveUp
    }

    /// Sets `x` stationary in the free rows and 0 in the others, and the gradient there; by whichever of the two sets
    /// is smaller, as long as the inverse is accurate.
    fn solve_for_free_rows(
        &mut self,
        quadratic: &Quadratic,
        c: &[f64],
        unconstrained: &[f64],
    ) -> Result<(), cholesky::NotPositiveDefinite> {
        let slots = c.len();
        self.free_rows.clear();
        self.zero_rows.clear();
        (0..slots).for_each(|i| if self.free[i] { &mut self.free_rows } else { &mut self.zero_rows }.push(i));

        if quadratic.well_conditioned() && self.zero_rows.len() <= self.free_rows.len() {
            // x = H^-1 (c + g) with g != 0 only in the zero rows, where x = 0 determines it.
            let inverse = quadratic.inverse();
            self.values.clear();
            self.values.extend(self.zero_rows.iter().map(|&i| -unconstrained[i]));
            gather(inverse, &self.zero_rows, &mut self.matrix);
            cholesky::factor(&mut self.matrix, self.zero_rows.len())?;
            cholesky::solve(&self.matrix, self.zero_rows.len(), &mut self.values);
            self.x.copy_from_slice(unconstrained);
            self.gradient.fill(0.0);
            for (&i, &gradient) in self.zero_rows.iter().zip(&self.values) {
                self.gradient[i] = gradient;
                add_scaled(&mut self.x, gradient, inverse.row(i));
            }
            self.zero_rows.iter().for_each(|&i| self.x[i] = 0.0);
        } else {
            let h = quadratic.h();
            self.values.clear();
            self.values.extend(self.free_rows.iter().map(|&i| c[i]));
            gather(h, &self.free_rows, &mut self.matrix);
            cholesky::factor(&mut self.matrix, self.free_rows.len())?;
            cholesky::solve(&self.matrix, self.free_rows.len(), &mut self.values);
            self.x.fill(0.0);
            self.gradient.iter_mut().zip(c).for_each(|(gradient, c)| *gradient = -c);
            for (&i, &x) in self.free_rows.iter().zip(&self.values) {
                self.x[i] = x;
                add_scaled(&mut self.gradient, x, h.row(i));
            }
        }
        Ok(())
    }
}

fn largest(values: &[f64]) -> f64 {
    values.iter().fold(0.0, |largest, value| largest.max(value.abs()))
}

/// The lower triangle of the rows and columns `rows` of a symmetric matrix.
fn gather(symmetric: ArrayView2<f64>, rows: &[usize], into: &mut Vec<f64>) {
    into.clear();
    for (k, &i) in rows.iter().enumerate() {
        let row = symmetric.row(i);
        into.extend(rows[..=k].iter().map(|&j| row[j]));
        into.resize((k + 1) * rows.len(), 0.0);
    }
}

fn add_scaled(sum: &mut [f64], factor: f64, row: ArrayView1<f64>) {
    sum.iter_mut().zip(row).for_each(|(sum, row)| *sum += factor * row);
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use proptest::prelude::*;

    use super::super::{Prior, Slot, SlotKind, reference};
    use super::*;

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(200))]

        /// Random settings, priors and pixels: more unknowns than settings, both sides of the pivoting, warm starts.
        #[test]
        fn equals_the_reference(
            weights in prop::collection::vec(prop_oneof![Just(0.0), 0.0..1.0], 12 * 20),
            pixels in prop::collection::vec(-1.0..3.0, 4 * 12),
            beta in 0.0..2.0,
            split: bool,
        ) {
            let slots: Vec<Slot> = (-9..11).map(|u| Slot { u, kind: SlotKind::Own }).collect();
            let weights = Array2::from_shape_vec((12, 20), weights).unwrap();
            let prior =
                if split { Prior::Split { alpha: 0.01, beta } } else { Prior::Paper { alpha: 0.01, beta } };
            let quadratic = Quadratic::new(weights.view(), &slots, &prior).unwrap();
            let linear = quadratic.linear(weights.view(), Array2::from_shape_vec((4, 12), pixels).unwrap().view());
            let unconstrained = linear.dot(&quadratic.inverse());
            let mut pivoting = Pivoting::new(slots.len());
            for (c, unconstrained) in linear.rows().into_iter().zip(unconstrained.rows()) {
                let (c, unconstrained) = (c.to_vec(), unconstrained.to_vec());
                prop_assert_eq!(pivoting.minimise(&quadratic, &c, &unconstrained), Outcome::Minimum);
                let expected = reference::minimise(quadratic.h(), &c);
                let tolerance = 1e-8 * (1.0 + largest(&expected));
                for (x, expected) in pivoting.x.iter().zip(&expected) {
                    prop_assert!((x - expected).abs() < tolerance, "{x} is not {expected}");
                }
            }
        }
    }
}
