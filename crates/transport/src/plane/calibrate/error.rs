use super::super::PlaneError;

/// Why a stack does not determine the requested quantity.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum CalibrateError {
    /// The stack, the settings or a prior are invalid.
    #[error(transparent)]
    Plane(#[from] PlaneError),
    /// All pixels have masked samples.
    #[error(
        "every pixel has masked samples: use shorter exposures, so that some pixels saturate in no setting"
    )]
    NoPixels,
    /// The settings cannot be divided into folds.
    #[error(
        "{settings} settings leave {can_be_held_out} that can be held out without losing sight of some row, but at \
         least 2 are needed: add delays whose exposures overlap, or name the prior"
    )]
    TooFewSettings {
        /// Number of settings in the plan.
        settings: usize,
        /// Number of settings all of whose rows are also seen by other settings.
        can_be_held_out: usize,
    },
    /// Direct light does not stand out in enough pixels.
    #[error(
        "direct light stands out of its neighbouring rows in {pixels} sampled pixels, but at least {needed} are \
         needed: give the beam's width, and leave the direct light at u = 0"
    )]
    NoDirectLight {
        /// Number of sampled pixels with direct light.
        pixels: usize,
        /// Number needed.
        needed: usize,
    },
    /// The held-out residual hardly depends on the beam's width.
    #[error(
        "a beam of {other_rows:.2} rows raises the held-out residual of one of {sigma_rows:.2} rows by only \
         {rise_percent:.1} %, but it takes {needed_percent:.1} %: give the beam's width, or add settings whose edges \
         fall near u = 0"
    )]
    BeamUndetermined {
        /// The width that predicts held-out settings best, in rows.
        sigma_rows: f64,
        /// A clearly different width, in rows.
        other_rows: f64,
        /// Increase of the mean squared residual with the other width.
        rise_percent: f64,
        /// The increase needed.
        needed_percent: f64,
    },
    /// The best width lies at the end of the search range.
    #[error(
        "the beam is wider than {widest_rows} rows, or looks so: focus the projector, or give the beam's width"
    )]
    BeamTooWide {
        /// Largest width that is searched, in rows.
        widest_rows: f64,
    },
    /// The settings do not distinguish direct light in row 0 from direct light in row 1 or -1.
    #[error(
        "no setting's exposure begins or ends within |u| <= 1.5, so the place of direct light cannot be measured: \
         add settings with t_d ± t_e/2 between -1.5 and 1.5 rows, or report the band |u| <= 2 only"
    )]
    NoEdge,
    /// A candidate list without candidates.
    #[error("no candidates were given: name at least one prior")]
    NoCandidates,
}
