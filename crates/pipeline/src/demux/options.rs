//! How a plan wants a sweep demultiplexed.

use raysweep_transport::plane::Prior;
use serde::Deserialize;

/// The name of the stage in plans.
pub const DEMUX: &str = "demux";

/// Options of `demux` in a plan.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DemuxOptions {
    /// Which prior: `split` (direct light is a spike at u = 0) or `paper`. If omitted, prior and weights are those
    /// that predict held-out settings best, or `split` if there is no clear difference.
    pub prior: Option<PriorName>,
    /// Weight of smoothness over rows; if omitted, the prior's default.
    pub alpha: Option<f64>,
    /// Weight of sparsity; if omitted, the prior's default.
    pub beta: Option<f64>,
    /// Whether neighbouring pixels that see the same kind of light are averaged before they are solved.
    pub coupling: bool,
}

impl Default for DemuxOptions {
    fn default() -> Self {
        Self { prior: None, alpha: None, beta: None, coupling: true }
    }
}

/// The names of priors in plans.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum PriorName {
    /// Scale-free smoothness that excludes u = 0.
    Split,
    /// The paper's objective as printed.
    Paper,
}

impl DemuxOptions {
    /// Whether a plan fully specifies the prior.
    pub(crate) fn states_prior(&self) -> bool {
        self.prior.is_some() || self.alpha.is_some() || self.beta.is_some()
    }

    pub(crate) fn prior(&self) -> Prior {
        let prior = match self.prior {
            None | Some(PriorName::Split) => Prior::SPLIT,
            Some(PriorName::Paper) => Prior::PAPER,
        };
        match prior {
            Prior::Split { alpha, beta } => {
                Prior::Split { alpha: self.alpha.unwrap_or(alpha), beta: self.beta.unwrap_or(beta) }
            }
            Prior::Paper { alpha, beta } => {
                Prior::Paper { alpha: self.alpha.unwrap_or(alpha), beta: self.beta.unwrap_or(beta) }
            }
        }
    }
}
