use super::super::PlaneError;
use super::response::{FIRST_RESPONSE_ROW, Shares};

/// The spread of the light of one projector row over the rows of the scene.
///
/// The profile is the same everywhere: a point `d` rows away from the row drawn receives the share `g(d)` of its
/// light, and the shares sum to 1. Light that leaves the frame at its upper or lower border is lost to the model.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub enum Beam {
    /// All light falls on the row drawn.
    #[default]
    Ideal,
    /// A Gaussian sampled at the rows' centres.
    Gaussian {
        /// Standard deviation in rows.
        sigma_rows: f64,
    },
}

/// A Gaussian's tail is cut off after this many standard deviations: less than 1e-6 of the light is beyond.
const TAIL_SIGMAS: f64 = 5.0;

/// Standard deviation in rows up to which a response of 16 rows holds 98 % of a beam's light. Beyond it, half a row
/// more or less hardly matters.
pub(in super::super) const WIDEST_RESPONSE_SIGMA_ROWS: f64 = 3.0;

impl Beam {
    /// A Gaussian beam, or the ideal beam for a standard deviation of 0.
    pub fn of_sigma(sigma_rows: f64) -> Self {
        if sigma_rows == 0.0 { Self::Ideal } else { Self::Gaussian { sigma_rows } }
    }

    /// Standard deviation in rows; 0 for the ideal beam.
    pub fn sigma_rows(&self) -> f64 {
        match *self {
            Self::Ideal => 0.0,
            Self::Gaussian { sigma_rows } => sigma_rows,
        }
    }

    /// Checks the profile's extent.
    ///
    /// # Errors
    /// [`PlaneError::OutOfRange`] unless the standard deviation is above 0 and at most 100 rows.
    pub fn check(&self) -> Result<(), PlaneError> {
        match *self {
            Self::Gaussian { sigma_rows } if !(sigma_rows > 0.0 && sigma_rows <= 100.0) => {
                Err(PlaneError::OutOfRange {
                    field: "beam sigma_rows",
                    value: sigma_rows,
                    allowed: "above 0 and at most 100 rows: take the ideal beam for one without extent",
                })
            }
            _ => Ok(()),
        }
    }

    /// `k(d)`: the shares of the rows drawn `d` rows below a row in that row's light. `None` for beams that are wider
    /// than a response. The beam is symmetric, so its sign does not matter here.
    pub(super) fn shares(&self) -> Option<Shares> {
        let share = |d: f64| match *self {
            Self::Ideal => f64::from(u8::from(d == 0.0)),
            Self::Gaussian { sigma_rows } => (-(d / sigma_rows).powi(2) / 2.0).exp(),
        };
        let shares: Shares = std::array::from_fn(|index| share(index as f64 + f64::from(FIRST_RESPONSE_ROW)));
        let total: f64 = shares.iter().sum();
        (self.sigma_rows() <= WIDEST_RESPONSE_SIGMA_ROWS).then(|| shares.map(|share| share / total))
    }

    /// Converts the weights of the drawn rows to those of the scene's rows: `A' = A B`, for one row of `A`. Both have
    /// one entry per projector row; there are no drawn rows beyond the borders.
    pub(in super::super) fn spread(&self, drawn: Vec<f64>) -> Vec<f64> {
        let Self::Gaussian { sigma_rows } = *self else { return drawn };
        let reach_rows = (TAIL_SIGMAS * sigma_rows).ceil() as usize;
        let tail: Vec<f64> =
            (0..=reach_rows).map(|d| (-(d as f64 / sigma_rows).powi(2) / 2.0).exp()).collect();
        let total = 2.0 * tail.iter().sum::<f64>() - tail[0];
        let mut lit = vec![0.0; drawn.len()];
        for (v, &weight) in drawn.iter().enumerate().filter(|(_, weight)| **weight > 0.0) {
            let end = (v + reach_rows + 1).min(lit.len());
            for (row, lit) in lit.iter_mut().enumerate().take(end).skip(v.saturating_sub(reach_rows)) {
                *lit += weight * tail[row.abs_diff(v)] / total;
            }
        }
        lit
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_spreads_symmetrically_and_keeps_its_light() {
        let mut drawn = vec![0.0; 41];
        drawn[20] = 2.0;
        let lit = Beam::Gaussian { sigma_rows: 1.5 }.spread(drawn.clone());
        assert!((lit.iter().sum::<f64>() - 2.0).abs() < 1e-12);
        for d in 1..=20 {
            assert_eq!(lit[20 - d], lit[20 + d]);
        }
        // exp(-1/(2 1.5^2)) of the peak at a distance of one row; the variance is that of the Gaussian.
        assert!((lit[21] / lit[20] - (-1.0_f64 / 4.5).exp()).abs() < 1e-12);
        let variance: f64 = lit.iter().zip(-20..).map(|(l, d): (_, i32)| l / 2.0 * f64::from(d * d)).sum();
        assert!((variance - 2.25).abs() < 1e-3, "{variance}");
        assert_eq!(Beam::Ideal.spread(drawn.clone()), drawn);
    }

    #[test]
    fn light_beyond_the_border_is_lost() {
        let lit = Beam::Gaussian { sigma_rows: 0.5 }.spread(vec![1.0, 0.0, 0.0, 0.0]);
        // Sampled at the centres: 0.7866, 0.1065, 0.0003 to either side.
        assert!((lit[0] - 0.7866).abs() < 1e-4 && (lit[1] - 0.1065).abs() < 1e-4 && lit[3] < 1e-6);
    }

    #[test]
    fn an_extent_that_is_none_is_refused() {
        for sigma_rows in [0.0, -0.7, f64::NAN, 101.0] {
            assert!(Beam::Gaussian { sigma_rows }.check().is_err(), "{sigma_rows}");
        }
        assert_eq!(Beam::of_sigma(0.0), Beam::Ideal);
        assert_eq!(Beam::of_sigma(0.7).sigma_rows(), 0.7);
    }
}
