//! Predicts the error of a plan before anything is captured, and finds better plans.
//!
//! The error of a plan depends on what it looks at. It is therefore predicted for a family of transports, whose
//! pixels are photographed and solved as those of a run will be ([`Conditions::foresee`]). Plans are compared by that
//! error ([`Search`]).

mod bias;
mod family;
mod foresee;
mod random;
mod search;

use super::{RowTiming, Setting};

pub use bias::BiasOfFamily;
pub(super) use bias::{BiasBound, bias_sizes};
pub use foresee::{Calibrated, Conditions, Noise, PredictedError, Spread};
pub use search::{Advice, Arrangement, Design, Proposal, Search, SweepGrid, Usable};

/// Indirect light that a white pixel is assumed to receive from each row: 0.38 in total from a scene of 128 rows. In
/// a rendered corner of two boards it is 0.0026 per direct light of 1.
const INDIRECT_PER_ROW: f64 = 0.003;

/// A setting that collects less of its own row's light does not see it.
const SEEN: f64 = 0.1;

/// The light that a white pixel in the middle of the frame, lit by its surroundings, collects with a setting.
pub fn white_light(timing: &RowTiming, setting: &Setting) -> f64 {
    let (weights, own_row) = timing.typical_weights(timing.camera_rows() / 2, setting);
    let own = weights[own_row];
    own + INDIRECT_PER_ROW * (weights.iter().sum::<f64>() - own)
}

/// Whether a pixel in the middle of the frame collects direct light with a setting.
pub fn sees_own_row(timing: &RowTiming, setting: &Setting) -> bool {
    let (weights, own_row) = timing.typical_weights(timing.camera_rows() / 2, setting);
    weights[own_row] > SEEN
}
