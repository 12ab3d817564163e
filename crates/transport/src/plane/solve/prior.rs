use std::str::FromStr;

use ndarray::Array2;

use super::super::PlaneError;
use super::super::model::Slot;

/// Prior of a pixel's profile `T(u)` in addition to `T >= 0`: the terms `alpha ||D T||^2 + beta sum(T)`.
///
/// The values of `alpha` and `beta` assume intensities on the scale on which a white surface gives 1.0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Prior {
    /// The paper's prior: `D` contains all differences `T(u+1) - T(u)` between existing rows, all with weight 1.
    Paper {
        /// Weight of smoothness.
        alpha: f64,
        /// Weight of sparsity.
        beta: f64,
    },
    /// Direct light is a spike at `u = 0` by geometry, and indirect light is smoother the farther away it comes from:
    /// the difference `T(u+1) - T(u)` has weight `|u + 1/2|`, no difference involves `u = 0`, and the bridge `T(1) -
    /// T(-1)` has weight 1.
    Split {
        /// Weight of smoothness.
        alpha: f64,
        /// Weight of sparsity, which includes `u = 0`.
        beta: f64,
    },
}

impl Prior {
    /// The paper's prior with the paper's weights.
    pub const PAPER: Self = Self::Paper { alpha: 0.01, beta: 0.01 };
    /// The split prior with weights that suit most scenes.
    pub const SPLIT: Self = Self::Split { alpha: 0.1, beta: 0.001 };

    /// The prior's name in plans and reports: `paper` or `split`.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Paper { .. } => "paper",
            Self::Split { .. } => "split",
        }
    }

    /// Weight of smoothness.
    pub fn alpha(&self) -> f64 {
        match *self {
            Self::Paper { alpha, .. } | Self::Split { alpha, .. } => alpha,
        }
    }

    /// Weight of sparsity.
    pub fn beta(&self) -> f64 {
        match *self {
            Self::Paper { beta, .. } | Self::Split { beta, .. } => beta,
        }
    }

    /// Checks the weights.
    ///
    /// # Errors
    /// [`PlaneError::OutOfRange`] for a weight that is negative or not finite.
    pub fn check(&self) -> Result<(), PlaneError> {
        for (field, value) in [("alpha", self.alpha()), ("beta", self.beta())] {
            if !(value.is_finite() && value >= 0.0) {
                let allowed = "finite and not negative: 0 switches the term off";
                return Err(PlaneError::OutOfRange { field, value, allowed });
            }
        }
        Ok(())
    }

    /// `D`, one row per difference between neighbouring existing slots, shape `[differences, slots]`. Wrapped slots
    /// form separate chains, because no measured row links them to the others.
    pub fn differences(&self, slots: &[Slot]) -> Array2<f64> {
        let links = self.links(slots);
        let mut differences = Array2::zeros((links.len(), slots.len()));
        for (row, link) in links.into_iter().enumerate() {
            link.into_iter().for_each(|(slot, weight)| differences[[row, slot]] = weight);
        }
        differences
    }

    /// The entries of each row of [`Self::differences`] other than 0, each with its slot.
    pub(in super::super) fn links(&self, slots: &[Slot]) -> Vec<[(usize, f64); 2]> {
        let mut links = Vec::with_capacity(slots.len());
        for (lower, &slot) in slots.iter().enumerate() {
            let (step_rows, weight) = match self {
                Self::Split { .. } if slot.u == 0 => continue,
                Self::Split { .. } if slot.u == -1 => (2, 1.0),
                Self::Split { .. } => (1, (f64::from(slot.u) + 0.5).abs()),
                Self::Paper { .. } => (1, 1.0),
            };
            let wanted = Slot { u: slot.u + step_rows, ..slot };
            // Rows in order, mostly without a gap.
            let near = lower + step_rows as usize;
            let upper = match slots.get(near) {
                Some(found) if *found == wanted => Some(near),
                _ => slots.iter().position(|&slot| slot == wanted),
            };
            links.extend(upper.map(|upper| [(lower, -weight), (upper, weight)]));
        }
        links
    }
}

impl Default for Prior {
    fn default() -> Self {
        Self::SPLIT
    }
}

impl FromStr for Prior {
    type Err = PlaneError;

    fn from_str(name: &str) -> Result<Self, PlaneError> {
        match name {
            "paper" => Ok(Self::PAPER),
            "split" => Ok(Self::SPLIT),
            _ => Err(PlaneError::UnknownPrior { name: name.to_owned() }),
        }
    }
}

#[cfg(test)]
mod tests {
    use ndarray::array;

    use super::super::super::model::SlotKind::{Own, Wrapped};
    use super::*;

    fn slots(own: &[i32], wrapped: &[i32]) -> Vec<Slot> {
        let own = own.iter().map(|&u| Slot { u, kind: Own });
        own.chain(wrapped.iter().map(|&u| Slot { u, kind: Wrapped })).collect()
    }

    #[test]
    fn the_papers_prior_joins_all_neighbours() {
        let expected = array![[-1., 1., 0., 0.], [0., -1., 1., 0.], [0., 0., -1., 1.]];
        assert_eq!(Prior::PAPER.differences(&slots(&[-2, -1, 0, 1], &[])), expected);
    }

    #[test]
    fn the_split_prior_frees_the_direct_row() {
        let expected = array![
            [-1.5, 1.5, 0., 0., 0., 0.], // -2, -1
            [0., -1., 0., 1., 0., 0.],   // the bridge over 0
            [0., 0., 0., -1.5, 1.5, 0.], // 1, 2
            [0., 0., 0., 0., -2.5, 2.5], // 2, 3
        ];
        assert_eq!(Prior::SPLIT.differences(&slots(&[-2, -1, 0, 1, 2, 3], &[])), expected);
    }

    #[test]
    fn at_the_border_there_is_no_bridge() {
        assert_eq!(Prior::SPLIT.differences(&slots(&[0, 1, 2], &[])), array![[0., -1.5, 1.5]]);
    }

    #[test]
    fn wrapped_slots_are_a_chain_of_their_own() {
        // 3 follows 2, but belongs to another frame, and -5 does not follow 4: neither pair is linked.
        let slots = slots(&[1, 2], &[-5, -4, 3]);
        assert_eq!(Prior::PAPER.differences(&slots), array![[-1., 1., 0., 0., 0.], [0., 0., -1., 1., 0.]]);
        assert_eq!(
            Prior::SPLIT.differences(&slots),
            array![[-1.5, 1.5, 0., 0., 0.], [0., 0., -4.5, 4.5, 0.]]
        );
    }

    #[test]
    fn names_are_read_back() {
        for prior in [Prior::PAPER, Prior::SPLIT] {
            assert_eq!(prior.name().parse(), Ok(prior));
        }
        assert_eq!(Prior::default().name(), "split");
        assert!("Split".parse::<Prior>().is_err());
        assert!(Prior::Split { alpha: -0.1, beta: 0.0 }.check().is_err());
        assert!(Prior::Paper { alpha: 0.1, beta: f64::NAN }.check().is_err());
    }
}
