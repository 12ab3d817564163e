use super::super::super::PlaneError;

/// Why images of the board do not determine when the rows are lit.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum TimesError {
    /// An array or a number is invalid.
    #[error(transparent)]
    Plane(#[from] PlaneError),
    /// Global frames hardly show any edges of exposures.
    #[error(
        "only {borders} borders in {frames} global frames, over {covered_percent:.0} % of the rows seen, but at \
         least {needed} over half of the rows are needed: the trigger delay does not act in global mode, or the \
         nominal row times are wrong by more than 500 us"
    )]
    TooFewBorders {
        /// Number of borders found.
        borders: usize,
        /// Number of borders needed.
        needed: usize,
        /// Number of global frames.
        frames: usize,
        /// Share of the rows seen between the first and the last border.
        covered_percent: f64,
    },
    /// The short rolling frames do not cover the time at which the light arrives.
    #[error(
        "rolling frames of {exposure_us} us with delays from {from_us:.1} to {to_us:.1} us show the whole arrival of \
         light in {rows} of {seen} camera rows ({early} are lit at the first delay, {late} at the last), but half of \
         them are needed: extend the delays to the side that is lit, and expose for 3 row times"
    )]
    ArrivalsCut {
        /// Exposure of the frames.
        exposure_us: f64,
        /// Smallest delay.
        from_us: f64,
        /// Largest delay.
        to_us: f64,
        /// Camera rows whose arrival is covered.
        rows: usize,
        /// Camera rows with lit pixels.
        seen: usize,
        /// Camera rows that are already lit at the smallest delay.
        early: usize,
        /// Camera rows that are still lit at the largest delay.
        late: usize,
    },
    /// Too few rolling frames of the shortest exposure.
    #[error(
        "rolling frames have {delays} different delays at their shortest exposure, but at least {needed} are needed: \
         take the frames of arrival_settings"
    )]
    TooFewDelays {
        /// Number of different delays.
        delays: usize,
        /// Number needed.
        needed: usize,
    },
    /// A row ends before it begins.
    #[error(
        "the table folds back at row {row}, which would end {back_us:.1} us before it begins: force the projector's \
         native mode, so that it draws its rows in order, and take more frames"
    )]
    FoldsBack {
        /// The row.
        row: usize,
        /// Time from its end to its start.
        back_us: f64,
    },
    /// The normal equations cannot be solved.
    #[error(
        "the frames do not determine the times of the rows: take those of sweep_settings and arrival_settings"
    )]
    Undetermined,
    /// The model does not describe the frames.
    #[error(
        "chi^2 / n is {chi2_per_sample:.1} for exposures of {exposure_us} us, but must be at most {limit}: rows are \
         lit neither evenly nor by a spot in a direction that is known, or the responses are those of another picture"
    )]
    Misfit {
        /// Mean square of residuals, each divided by its expected variance.
        chi2_per_sample: f64,
        /// Largest allowed value.
        limit: f64,
        /// Exposure of the frames.
        exposure_us: f64,
    },
    /// The light jitters against the trigger.
    #[error(
        "jitter is {jitter_us:.0} us, but must be at most {limit_us:.0} us (half a row and 20 us): the trigger is not \
         the projector's VSYNC"
    )]
    Jitter {
        /// Standard deviation over frames.
        jitter_us: f64,
        /// Largest allowed value.
        limit_us: f64,
    },
    /// Exposures are longer than nominal by different amounts.
    #[error(
        "exposures of {exposure_us} us exceed their nominal length by {difference_us:.1} us more (sd {sd_us:.1} us) \
         than those of {reference_us} us, but at most {limit_us} us are allowed: the exposure is granular; take \
         exposures that are whole steps of the camera"
    )]
    Granular {
        /// Exposure that differs.
        exposure_us: f64,
        /// Exposure with which it is compared.
        reference_us: f64,
        /// By how much more its true length exceeds the nominal one.
        difference_us: f64,
        /// Standard deviation of the difference.
        sd_us: f64,
        /// Largest allowed difference.
        limit_us: f64,
    },
    /// A spot draws the rows in a direction that cannot be told.
    #[error(
        "a flying spot draws the rows, but whether odd rows are drawn backwards cannot be told: the image sees too \
         little of the projector's width near its middle; widen the camera's region"
    )]
    Direction,
}
