use ndarray::{Array2, ArrayView2};

use super::{PlaneError, Prior, Slot, cholesky};

/// Relative increase of the diagonal of `H`. Rows that the settings leave undetermined then have one solution, the
/// smallest, and every factorisation succeeds; the minimum moves by far less than a sample's rounding.
const RIDGE: f64 = 1e-12;

/// Condition up to which the inverse is used; the paper's sweep has at most 1e4, undetermined rows 1e12.
const WELL_CONDITIONED: f64 = 1e7;

/// The objective `||A T - I||^2 + alpha ||D T||^2 + beta sum(T)` of one camera row, as `T'HT - 2 c'T + I'I` with
/// `H = A'A + alpha D'D` and `c = A'I - beta/2`.
#[derive(Debug, Clone)]
pub(super) struct Quadratic {
    /// `H`, shape `[slots, slots]`.
    pub h: Array2<f64>,
    /// The inverse of `H`.
    pub inverse: Array2<f64>,
    /// Whether solutions may be taken from the inverse. Settings that leave rows undetermined give it entries so
    /// large that nothing but rounding would remain.
    pub well_conditioned: bool,
    half_beta: f64,
}

impl Quadratic {
    /// The objective of the settings whose `weights` are given, shape `[settings, slots]`.
    ///
    /// # Errors
    /// [`PlaneError::NotConvex`] if the numbers leave the range of floating point.
    pub fn new(weights: ArrayView2<f64>, slots: &[Slot], prior: &Prior) -> Result<Self, PlaneError> {
        let differences = prior.differences(slots);
        let mut h = weights.t().dot(&weights) + prior.alpha() * differences.t().dot(&differences);
        for diagonal in h.diag_mut() {
            // A slot that no setting sees and no difference holds must not make H singular; its T is 0 in any case.
            *diagonal = if *diagonal > 0.0 { *diagonal * (1.0 + RIDGE) } else { 1.0 };
        }
        let inverse = invert(&h)?;
        // The diagonal of the inverse of H scaled to a unit diagonal: a lower bound of its condition number.
        let condition =
            h.diag().iter().zip(inverse.diag()).fold(1.0_f64, |most, (h, inverse)| most.max(h * inverse));
        let well_conditioned = condition < WELL_CONDITIONED;
        Ok(Self { h, inverse, well_conditioned, half_beta: prior.beta() / 2.0 })
    }

    /// `c` of each pixel, shape `[pixels, slots]`, from intensities of shape `[pixels, settings]`.
    pub fn linear(&self, weights: ArrayView2<f64>, intensities: ArrayView2<f64>) -> Array2<f64> {
        intensities.dot(&weights) - self.half_beta
    }
}

/// The inverse of a symmetric positive definite matrix.
fn invert(h: &Array2<f64>) -> Result<Array2<f64>, PlaneError> {
    let n = h.nrows();
    // Scaled to a unit diagonal, because smoothness far from u = 0 weighs a million times more than the data.
    let scale: Vec<f64> = h.diag().iter().map(|diagonal| diagonal.sqrt().recip()).collect();
    let mut factor: Vec<f64> = h.indexed_iter().map(|((i, j), value)| value * scale[i] * scale[j]).collect();
    cholesky::factor(&mut factor, n).map_err(|cholesky::NotPositiveDefinite| PlaneError::NotConvex)?;
    let mut inverse = Vec::with_capacity(n * n);
    let mut column = vec![0.0; n];
    for i in 0..n {
        column.fill(0.0);
        column[i] = scale[i];
        cholesky::solve(&factor, n, &mut column);
        inverse.extend(column.iter().zip(&scale).map(|(value, scale)| value * scale));
    }
    Ok(Array2::from_shape_fn((n, n), |(i, j)| inverse[i * n + j]))
}

#[cfg(test)]
mod tests {
    use ndarray::array;

    use super::super::SlotKind::Own;
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
        assert!((&quadratic.h - &expected).iter().all(|difference| difference.abs() < 1e-10));
        let linear = quadratic.linear(weights.view(), array![[4.0, 8.0]].view());
        assert_eq!(linear, array![[4.0 - 0.1, 6.0 - 0.1, 8.0 - 0.1]]);
    }

    #[test]
    fn the_inverse_undoes_h() {
        let weights = array![[1.0, 0.5, 0.0], [0.0, 0.5, 1.0], [0.3, 0.0, 0.0]];
        let quadratic = Quadratic::new(weights.view(), &slots(), &Prior::PAPER).unwrap();
        let product = quadratic.h.dot(&quadratic.inverse) - Array2::<f64>::eye(3);
        assert!(product.iter().all(|entry| entry.abs() < 1e-12), "{product}");
    }

    #[test]
    fn rows_that_nothing_determines_do_not_stop_it() {
        let unseen = array![[1.0, 0.0, 1.0]];
        assert!(Quadratic::new(unseen.view(), &slots(), &Prior::Split { alpha: 0.0, beta: 0.0 }).is_ok());
        let infinite = Prior::Paper { alpha: f64::MAX, beta: 0.0 };
        assert_eq!(Quadratic::new(unseen.view(), &slots(), &infinite).err(), Some(PlaneError::NotConvex));
    }
}
