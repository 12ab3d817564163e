use ndarray::{Array1, Array2, ArrayView2, Axis, s};
use rayon::prelude::*;

use super::super::solve::cholesky;
use super::super::solve::pivot::{RUN_PX, Start, minimise, minimise_free};
use super::super::solve::quadratic::Quadratic;
use super::super::{PlaneError, Prior, SimdLevel};

/// The objective of one camera row, for weights that vary during calibration.
pub(super) struct RowProblem {
    /// `A`, shape `[settings, slots]`.
    pub weights: Array2<f64>,
    /// `D`, shape `[differences, slots]`.
    differences: Array2<f64>,
    prior: Prior,
    quadratic: Quadratic,
}

impl RowProblem {
    /// `differences` is `D`, shape `[differences, slots]`.
    pub fn new(weights: Array2<f64>, differences: Array2<f64>, prior: &Prior) -> Result<Self, PlaneError> {
        let quadratic = Quadratic::with_differences(weights.view(), differences.view(), prior)?;
        Ok(Self { weights, differences, prior: *prior, quadratic })
    }

    /// The same problem for the settings with indices in `kept` only; `held` are the others.
    pub fn without(&self, kept: &[usize], held: &[usize]) -> Result<Self, PlaneError> {
        let weights = self.weights.select(Axis(0), kept);
        let quadratic = match self.quadratic.without(self.weights.select(Axis(0), held).view()) {
            Some(quadratic) => quadratic,
            None => Quadratic::with_differences(weights.view(), self.differences.view(), &self.prior)?,
        };
        Ok(Self { weights, differences: self.differences.clone(), prior: self.prior, quadratic })
    }

    /// `H^-1`, shape `[slots, slots]`.
    ///
    /// # Errors
    /// Those of [`Self::new`].
    pub fn inverse(&self) -> Result<ArrayView2<'_, f64>, PlaneError> {
        self.quadratic.inverse()
    }

    /// The hat matrix `A H^-1 A'`, shape `[settings, settings]`: the part of a pixel's samples that the prior explains,
    /// whatever the sign of its light.
    pub fn hat(&self) -> Array2<f64> {
        let free = Array2::from_elem(self.weights.dim(), true);
        let solved = minimise_free(SimdLevel::best(), &self.quadratic, self.weights.clone(), free.view());
        self.weights.dot(&solved.t())
    }

    /// Minimisers of several pixels, shape `[pixels, slots]`, from `samples`, `[pixels, settings]`. The search starts
    /// from the free slots of `near`, the minimisers of a similar problem.
    pub fn minimise(&self, samples: ArrayView2<f64>, near: Option<&Array2<f64>>) -> Array2<f64> {
        let mut pixels = self.quadratic.linear(self.weights.view(), samples);
        // A sample has few classes, too few to keep all processors busy by themselves.
        pixels.axis_chunks_iter_mut(Axis(0), RUN_PX).into_par_iter().enumerate().for_each(
            |(run, mut pixels)| {
                let (first, lengths) = (run * RUN_PX, [pixels.nrows()]);
                let free = near.map(|near| near.slice(s![first..first + lengths[0], ..]).mapv(|x| x > 0.0));
                let start = free.as_ref().map_or(Start::Runs(&lengths), |free| Start::Free(free.view()));
                let minima = minimise(SimdLevel::best(), &self.quadratic, pixels.to_owned(), &start);
                pixels.assign(&minima);
            },
        );
        pixels
    }

    /// Value of `||A x - I||^2 + alpha ||D x||^2 + beta sum(x)` for each pixel at its minimiser.
    pub fn minima(&self, x: ArrayView2<f64>, samples: ArrayView2<f64>) -> Array1<f64> {
        // At the minimiser x'(Hx - c) = 0, so x'Hx - 2 c'x + I'I reduces to I'I - c'x.
        let linear = self.quadratic.linear(self.weights.view(), samples);
        (&samples * &samples).sum_axis(Axis(1)) - (&linear * &x).sum_axis(Axis(1))
    }
}

/// The inverse of a symmetric positive definite matrix.
pub(super) fn invert(matrix: &Array2<f64>) -> Result<Array2<f64>, PlaneError> {
    let n = matrix.nrows();
    let mut entries: Vec<f64> = matrix.iter().copied().collect();
    cholesky::invert(&mut entries, n).map_err(|cholesky::NotPositiveDefinite| PlaneError::NotConvex)?;
    Ok(Array2::from_shape_fn((n, n), |(i, j)| entries[i.max(j) * n + i.min(j)]))
}
