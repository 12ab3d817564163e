use super::super::PlaneError;

/// Why a stack does not say what was asked of it.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CalibrateError {
    /// The stack, the settings or a prior cannot be used at all.
    #[error(transparent)]
    Plane(#[from] PlaneError),
    /// Masks leave nothing.
    #[error(
        "every pixel has masked samples: use shorter exposures, so that some pixels saturate in no setting"
    )]
    NoPixels,
    /// The settings cannot be divided.
    #[error(
        "{settings} settings leave {can_be_held_out} that can be held out without losing sight of some row, but at \
         least 2 are needed: add delays whose exposures overlap, or name the prior"
    )]
    TooFewSettings {
        /// Settings in the plan.
        settings: usize,
        /// Settings all of whose rows other settings see too.
        can_be_held_out: usize,
    },
    /// Nothing stands out at the direct row.
    #[error(
        "direct light stands out of its neighbouring rows in {pixels} sampled pixels, but at least {needed} are \
         needed: give the beam's width, and leave the direct light at u = 0"
    )]
    NoDirectLight {
        /// Sampled pixels with direct light.
        pixels: usize,
        /// How many it takes.
        needed: usize,
    },
    /// The held-out residual hardly depends on the beam's width.
    #[error(
        "the beam's width is {sigma_rows:.2} rows, uncertain by {error_percent:.0} %, but must be certain to \
         {allowed_percent:.0} %: give the beam's width, or add settings whose edges fall near u = 0"
    )]
    BeamUndetermined {
        /// The width that predicts held-out settings best.
        sigma_rows: f64,
        /// Its standard error.
        error_percent: f64,
        /// The largest that is of use.
        allowed_percent: f64,
    },
    /// The settings do not tell direct light in row 0 from direct light in row 1 or -1.
    #[error(
        "no setting's exposure begins or ends within |u| <= 1.5, so the place of direct light cannot be measured: \
         add settings with t_d ± t_e/2 between -1.5 and 1.5 rows, or report the band |u| <= 2 only"
    )]
    NoEdge,
    /// A candidate list without candidates.
    #[error("no candidates were given: name at least one prior")]
    NoCandidates,
}
