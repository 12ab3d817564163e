use std::sync::OnceLock;

use aligned_vec::{AVec, avec};
use ndarray::{Array2, ArrayView1, ArrayView2, Axis, ShapeBuilder, aview2};

use super::super::PlaneError;
use super::super::model::Slot;
use super::narrow::Narrow;
use super::simd::MAX_LANES;
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
    half_beta: f64,
    solver: Solver,
}

/// How the systems of pivoting are solved.
#[derive(Debug, Clone)]
enum Solver {
    /// By the parts of `H` for the chain solver, if there are few settings for many rows. Its inverse is computed only
    /// when something else asks for it.
    Narrow(Narrow, OnceLock<Result<Inverse, PlaneError>>),
    /// By `H` or its inverse.
    Dense(Inverse),
}

/// The inverse of `H`.
#[derive(Debug, Clone)]
pub(super) struct Inverse {
    /// Padded as `H` is.
    pub padded: Padded,
    /// Whether solutions may be computed from it. If settings leave rows undetermined, its entries are so large that
    /// only rounding errors would remain.
    pub is_well_conditioned: bool,
}

impl Inverse {
    fn of(h: ArrayView2<f64>) -> Result<Self, PlaneError> {
        let inverse = invert(h)?;
        Ok(Self::new(h, inverse.view()))
    }

    fn new(h: ArrayView2<f64>, inverse: ArrayView2<f64>) -> Self {
        // From the diagonal of the inverse of H scaled to a unit diagonal: a lower bound of its condition number.
        let condition =
            h.diag().iter().zip(inverse.diag()).fold(1.0_f64, |most, (h, inverse)| most.max(h * inverse));
        Self { padded: Padded::new(inverse), is_well_conditioned: condition < WELL_CONDITIONED }
    }
}

impl Quadratic {
    /// The objective of settings with these `weights`, shape `[settings, slots]`.
    ///
    /// # Errors
    /// [`PlaneError::NotConvex`] if values exceed the range of floating point.
    pub fn new(weights: ArrayView2<f64>, slots: &[Slot], prior: &Prior) -> Result<Self, PlaneError> {
        Self::with_links(weights, &prior.links(slots), prior)
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
        let entries = |row: ArrayView1<f64>| -> Vec<(usize, f64)> {
            row.indexed_iter().filter(|(_, weight)| **weight != 0.0).map(|(i, w)| (i, *w)).collect()
        };
        let links: Vec<_> = differences.rows().into_iter().map(entries).collect();
        Self::with_links(weights, &links, prior)
    }

    /// The objective with a `D` given by the entries of each row other than 0.
    fn with_links<L: AsRef<[(usize, f64)]>>(
        weights: ArrayView2<f64>,
        links: &[L],
        prior: &Prior,
    ) -> Result<Self, PlaneError> {
        let mut h = weights.t().dot(&weights);
        for link in links {
            for &(i, a) in link.as_ref() {
                link.as_ref().iter().for_each(|&(j, b)| h[[i, j]] += prior.alpha() * a * b);
            }
        }
        let narrow = Narrow::new(weights, links, prior.alpha(), &h.diag().to_vec());
        for diagonal in h.diag_mut() {
            // A slot without any setting or difference must not make H singular; its T is 0 in any case.
            *diagonal = if *diagonal > 0.0 { *diagonal * (1.0 + RIDGE) } else { 1.0 };
        }
        let solver = match narrow {
            Some(_) if h.iter().any(|entry| !entry.is_finite()) => return Err(PlaneError::NotConvex),
            Some(narrow) => Solver::Narrow(narrow, OnceLock::new()),
            None => Solver::Dense(Inverse::of(h.view())?),
        };
        Ok(Self { h: Padded::new(h.view()), half_beta: prior.beta() / 2.0, solver })
    }

    /// The same objective without some of its settings, whose weights are `dropped`, shape `[dropped settings,
    /// slots]`: a downdate of `H` and of its inverse (Sherman, Morrison and Woodbury), much cheaper than a new
    /// factorisation. `None` if too little would remain to be accurate.
    pub fn without(&self, dropped: ArrayView2<f64>) -> Option<Self> {
        let (settings, _) = dropped.dim();
        let h = &self.h() - &dropped.t().dot(&dropped);
        // Only the ridge and rounding remain of rows that only the dropped settings saw.
        let lost = h.diag().iter().zip(self.h().diag()).any(|(left, had)| *left <= 1e-9 * had);
        let whole = self.inverted().ok()?;
        let seen = dropped.dot(&whole.padded.view());
        let mut core = (Array2::<f64>::eye(settings) - seen.dot(&dropped.t())).into_raw_vec_and_offset().0;
        let well_posed = (0..settings).all(|k| core[k * settings + k] > 1e-6);
        if lost || !well_posed || !whole.is_well_conditioned || cholesky::factor(&mut core, settings).is_err()
        {
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
        let inverse = &whole.padded.view() + &update.t().dot(&update);
        let inverse = Inverse::new(h.view(), inverse.view());
        inverse.is_well_conditioned.then(|| Self {
            h: Padded::new(h.view()),
            half_beta: self.half_beta,
            solver: Solver::Dense(inverse),
        })
    }

    /// The parts of `H` for the chain solver, if there are few settings for many rows.
    pub(super) fn narrow(&self) -> Option<&Narrow> {
        match &self.solver {
            Solver::Narrow(narrow, _) => Some(narrow),
            Solver::Dense(_) => None,
        }
    }

    /// The inverse for pivoting; `None` with the chain solver.
    pub(super) fn dense(&self) -> Option<&Inverse> {
        match &self.solver {
            Solver::Narrow(..) => None,
            Solver::Dense(inverse) => Some(inverse),
        }
    }

    fn inverted(&self) -> Result<&Inverse, PlaneError> {
        match &self.solver {
            Solver::Narrow(_, inverse) => {
                inverse.get_or_init(|| Inverse::of(self.h())).as_ref().map_err(Clone::clone)
            }
            Solver::Dense(inverse) => Ok(inverse),
        }
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
    ///
    /// # Errors
    /// [`PlaneError::NotConvex`] if values exceed the range of floating point.
    pub fn inverse(&self) -> Result<ArrayView2<'_, f64>, PlaneError> {
        Ok(self.inverted()?.padded.view())
    }

    /// `H`, padded for gathering systems.
    pub(super) fn padded_h(&self) -> &Padded {
        &self.h
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

    /// Without the padding.
    pub fn view(&self) -> ArrayView2<'_, f64> {
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
    cholesky::invert(&mut matrix, n).map_err(|cholesky::NotPositiveDefinite| PlaneError::NotConvex)?;
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
        let product = quadratic.h().dot(&quadratic.inverse().unwrap()) - Array2::<f64>::eye(3);
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
            assert!(
                close(downdated.h(), expected.h())
                    && close(downdated.inverse().unwrap(), expected.inverse().unwrap())
            );
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
