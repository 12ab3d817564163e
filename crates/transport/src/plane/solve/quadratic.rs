use aligned_vec::{AVec, avec};
use ndarray::{Array2, ArrayView2, Axis, ShapeBuilder, aview2};

use super::super::PlaneError;
use super::super::model::Slot;
use super::dense::MAX_LANES;
use super::narrow::Narrow;
use super::{Prior, cholesky};

/// Relative increase of the diagonal of `H`. Rows that the settings leave undetermined then have a unique solution,
/// the smallest, and every factorisation succeeds. The minimum moves by far less than a sample's rounding.
pub(super) const RIDGE: f64 = 1e-12;

/// Largest condition number for which the inverse is used; the paper's sweep has at most 1e4, undetermined rows give
/// 1e12.
const WELL_CONDITIONED: f64 = 1e7;

/// The objective `||A T - I||^2 + alpha ||D T||^2 + beta sum(T)` of one camera row, as `T'HT - 2 c'T + I'I` with
/// `H = A'A + alpha D'D` and `c = A'I - beta/2`.
#[derive(Debug, Clone)]
pub struct Quadratic {
    h: Padded,
    /// The inverse of `H`.
    inverse: Padded,
    /// Whether solutions may be computed from the inverse. If settings leave rows undetermined, its entries are so
    /// large that only rounding errors would remain.
    well_conditioned: bool,
    half_beta: f64,
    /// The parts of `H` for the chain solver; `None` unless there are few settings for many rows.
    narrow: Option<Narrow>,
}

impl Quadratic {
    /// The objective of settings with these `weights`, shape `[settings, slots]`.
    ///
    /// # Errors
    /// [`PlaneError::NotConvex`] if values exceed the range of floating point.
    pub fn new(weights: ArrayView2<f64>, slots: &[Slot], prior: &Prior) -> Result<Self, PlaneError> {
        Self::with_differences(weights, prior.differences(slots).view(), prior)
    }

    /// The objective with the given `D`, shape `[differences, slots]`.
    ///
    /// # Errors
    /// Those of [`Self::new`].
    pub fn with_differences(
        weights: ArrayView2<f64>,
        differences: ArrayView2<f64>,
        prior: &Prior,
    ) -> Result<Self, PlaneError> {
        let mut h = weights.t().dot(&weights);
        for difference in differences.rows() {
            let touched: Vec<(usize, f64)> = difference
                .indexed_iter()
                .filter(|(_, weight)| **weight != 0.0)
                .map(|(i, w)| (i, *w))
                .collect();
            for &(i, a) in &touched {
                touched.iter().for_each(|&(j, b)| h[[i, j]] += prior.alpha() * a * b);
            }
        }
        let narrow = Narrow::new(weights, differences, prior.alpha(), &h.diag().to_vec());
        for diagonal in h.diag_mut() {
            // A slot without any setting or difference must not make H singular; its T is 0 in any case.
            *diagonal = if *diagonal > 0.0 { *diagonal * (1.0 + RIDGE) } else { 1.0 };
        }
        let inverse = invert(h.view())?;
        Ok(Self { narrow, ..Self::from_parts(h, inverse, prior.beta() / 2.0) })
    }

    fn from_parts(h: Array2<f64>, inverse: Array2<f64>, half_beta: f64) -> Self {
        // From the diagonal of the inverse of H scaled to a unit diagonal: a lower bound of its condition number.
        let condition =
            h.diag().iter().zip(inverse.diag()).fold(1.0_f64, |most, (h, inverse)| most.max(h * inverse));
        let [h, inverse] = [h, inverse].map(|matrix| Padded::new(matrix.view()));
        Self { h, inverse, well_conditioned: condition < WELL_CONDITIONED, half_beta, narrow: None }
    }

    /// The same objective without some of its settings, whose weights are `dropped`, shape `[dropped settings,
    /// slots]`: a downdate of `H` and of its inverse (Sherman, Morrison and Woodbury), much cheaper than a new
    /// factorisation. `None` if too little would remain to be accurate.
    pub fn without(&self, dropped: ArrayView2<f64>) -> Option<Self> {
        let (settings, _) = dropped.dim();
        let h = &self.h() - &dropped.t().dot(&dropped);
        // Only the ridge and rounding remain of rows that only the dropped settings saw.
        let lost = h.diag().iter().zip(self.h().diag()).any(|(left, had)| *left <= 1e-9 * had);
        let seen = dropped.dot(&self.inverse());
        let mut core = (Array2::<f64>::eye(settings) - seen.dot(&dropped.t())).into_raw_vec_and_offset().0;
        let well_posed = (0..settings).all(|k| core[k * settings + k] > 1e-6);
        if lost || !well_posed || !self.well_conditioned || cholesky::factor(&mut core, settings).is_err() {
            return None;
        }
        // L^-1 of the core times `seen`, whose own product is the update.
        let mut update = seen;
        for i in 0..settings {
            for k in 0..i {
                let factor = core[i * settings + k];
                let (done, mut rest) = update.view_mut().split_at(Axis(0), i);
                rest.row_mut(0).scaled_add(-factor, &done.row(k));
            }
            update.row_mut(i).mapv_inplace(|value| value / core[i * settings + i]);
        }
        let inverse = &self.inverse() + &update.t().dot(&update);
        Some(Self::from_parts(h, inverse, self.half_beta)).filter(|downdated| downdated.well_conditioned)
    }

    /// The parts of `H` for the chain solver, if there are few settings for many rows.
    pub(super) fn narrow(&self) -> Option<&Narrow> {
        self.narrow.as_ref()
    }

    /// Number of unknowns.
    pub fn slots(&self) -> usize {
        self.h.slots
    }

    /// `H`, shape `[slots, slots]`.
    pub fn h(&self) -> ArrayView2<'_, f64> {
        self.h.view()
    }

    /// The inverse of `H`.
    pub fn inverse(&self) -> ArrayView2<'_, f64> {
        self.inverse.view()
    }

    /// `H`, padded for gathering systems.
    pub(super) fn padded_h(&self) -> &Padded {
        &self.h
    }

    /// The inverse, padded as [`Self::padded_h`].
    pub(super) fn padded_inverse(&self) -> &Padded {
        &self.inverse
    }

    /// Whether solutions may be computed from the inverse.
    pub fn well_conditioned(&self) -> bool {
        self.well_conditioned
    }

    /// `c` of each pixel, shape `[pixels, slots]`, from intensities of shape `[pixels, settings]`.
    pub fn linear(&self, weights: ArrayView2<f64>, intensities: ArrayView2<f64>) -> Array2<f64> {
        intensities.dot(&weights) - self.half_beta
    }
}

/// A square matrix padded to whole vectors of any width: zeros follow each row, and a row of zeros follows the last.
#[derive(Debug, Clone)]
pub(super) struct Padded {
    /// Rows and columns without the zeros.
    pub slots: usize,
    /// Number of columns with the zeros, of which there is at least one.
    pub stride: usize,
    values: AVec<f64>,
}

impl Padded {
    fn new(matrix: ArrayView2<f64>) -> Self {
        let slots = matrix.nrows();
        let stride = (slots + 1).next_multiple_of(MAX_LANES);
        let mut values = avec![0.0; (slots + 1) * stride];
        for (to, row) in values.chunks_exact_mut(stride).zip(matrix.rows()) {
            to.iter_mut().zip(row).for_each(|(to, value)| *to = *value);
        }
        Self { slots, stride, values }
    }

    /// A row with its padding; row number [`Self::slots`] is all zeros.
    #[inline(always)]
    pub fn row(&self, slot: usize) -> &[f64] {
        &self.values[slot * self.stride..(slot + 1) * self.stride]
    }

    fn view(&self) -> ArrayView2<'_, f64> {
        let shape = (self.slots, self.slots).strides((self.stride, 1));
        ArrayView2::from_shape(shape, &self.values).unwrap_or(aview2::<f64, 0>(&[]))
    }
}

/// The inverse of a symmetric positive definite matrix of shape `[n, n]`.
fn invert(h: ArrayView2<f64>) -> Result<Array2<f64>, PlaneError> {
    let n = h.nrows();
    // Scaled to a unit diagonal, because smoothness far from u = 0 weighs a million times more than the data.
    let scale: Vec<f64> = h.diag().iter().map(|diagonal| diagonal.sqrt().recip()).collect();
    let mut matrix: Vec<f64> = h.indexed_iter().map(|((i, j), value)| value * scale[i] * scale[j]).collect();
    pulp::Arch::new()
        .dispatch(|| cholesky::invert(&mut matrix, n))
        .map_err(|cholesky::NotPositiveDefinite| PlaneError::NotConvex)?;
    Ok(Array2::from_shape_fn((n, n), |(i, j)| matrix[i.max(j) * n + i.min(j)] * scale[i] * scale[j]))
}

#[cfg(test)]
mod tests {
    use ndarray::array;

    use super::super::super::model::SlotKind::Own;
    use super::*;

    fn slots() -> Vec<Slot> {
        [-1, 0, 1].map(|u| Slot { u, kind: Own }).to_vec()
    }

    #[test]
    fn the_objective_by_hand() {
        let weights = array![[1.0, 0.5, 0.0], [0.0, 0.5, 1.0]];
        let quadratic =
            Quadratic::new(weights.view(), &slots(), &Prior::Split { alpha: 2.0, beta: 0.2 }).unwrap();
        // A'A plus twice the bridge between -1 and 1.
        let expected = array![[1.0 + 2.0, 0.5, -2.0], [0.5, 0.5, 0.5], [-2.0, 0.5, 1.0 + 2.0]];
        assert!((&quadratic.h() - &expected).iter().all(|difference| difference.abs() < 1e-10));
        let linear = quadratic.linear(weights.view(), array![[4.0, 8.0]].view());
        assert_eq!(linear, array![[4.0 - 0.1, 6.0 - 0.1, 8.0 - 0.1]]);
    }

    #[test]
    fn the_inverse_undoes_h() {
        let weights = array![[1.0, 0.5, 0.0], [0.0, 0.5, 1.0], [0.3, 0.0, 0.0]];
        let quadratic = Quadratic::new(weights.view(), &slots(), &Prior::PAPER).unwrap();
        let product = quadratic.h().dot(&quadratic.inverse()) - Array2::<f64>::eye(3);
        assert!(product.iter().all(|entry| entry.abs() < 1e-12), "{product}");
    }

    #[test]
    fn a_downdate_equals_leaving_the_settings_out() {
        let weights =
            array![[1.0, 0.5, 0.0], [0.0, 0.5, 1.0], [0.3, 0.0, 0.9], [0.4, 1.0, 0.1], [0.2, 0.7, 1.0]];
        let whole = Quadratic::new(weights.view(), &slots(), &Prior::PAPER).unwrap();
        for dropped in [vec![1], vec![0, 3], vec![2, 4]] {
            let kept: Vec<usize> = (0..5).filter(|n| !dropped.contains(n)).collect();
            let downdated = whole.without(weights.select(Axis(0), &dropped).view()).unwrap();
            let expected =
                Quadratic::new(weights.select(Axis(0), &kept).view(), &slots(), &Prior::PAPER).unwrap();
            let close =
                |a: ArrayView2<f64>, b: ArrayView2<f64>| (&a - &b).iter().all(|error| error.abs() < 1e-8);
            assert!(close(downdated.h(), expected.h()) && close(downdated.inverse(), expected.inverse()));
        }
        assert!(whole.without(weights.view()).is_none(), "nothing is left");
    }

    #[test]
    fn rows_that_nothing_determines_do_not_stop_it() {
        let unseen = array![[1.0, 0.0, 1.0]];
        assert!(Quadratic::new(unseen.view(), &slots(), &Prior::Split { alpha: 0.0, beta: 0.0 }).is_ok());
        let infinite = Prior::Paper { alpha: f64::MAX, beta: 0.0 };
        assert_eq!(Quadratic::new(unseen.view(), &slots(), &infinite).err(), Some(PlaneError::NotConvex));
    }
}
