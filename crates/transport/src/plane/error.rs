/// Why a timing, a setting, a prior or a stack cannot be used. Each message says what to change.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PlaneError {
    /// A number lies outside its range.
    #[error("{field} is {value}, but must be {allowed}")]
    OutOfRange {
        /// The field, as it is named in the API.
        field: &'static str,
        /// The value given.
        value: f64,
        /// What would be accepted, and what to do.
        allowed: &'static str,
    },
    /// The camera's window does not lie on the projector's rows.
    #[error(
        "camera rows are a window of projector rows {first_row}..{end}, but the projector has {projector_rows}: \
         give a window of at least one row inside the projector's"
    )]
    Window {
        /// First projector row of the window.
        first_row: usize,
        /// One past the window's last projector row.
        end: usize,
        /// Rows of the projector.
        projector_rows: usize,
    },
    /// A camera row that does not exist.
    #[error("row {row} is asked for, but the camera has rows 0..{camera_rows}")]
    Rows {
        /// The row asked for.
        row: usize,
        /// How many there are.
        camera_rows: usize,
    },
    /// No settings, or a setting without a delay.
    #[error(
        "setting {index} has no delays: give the true delay of each averaged frame, and at least one setting"
    )]
    NoDelays {
        /// Index of the setting, 0 when there are no settings at all.
        index: usize,
    },
    /// No row is seen strongly enough to be estimated.
    #[error("no setting sees 5 % of any row's light: lengthen the exposures or bring the delays nearer to 0")]
    NothingSeen,
    /// The objective cannot be factored.
    #[error(
        "the objective is not convex in floating point: choose alpha nearer to 0.1, or shorter exposures"
    )]
    NotConvex,
    /// The caller ended it.
    #[error("ended before it was done; `raysweep process` makes the results again")]
    Stopped,
    /// An array has another shape than the timing and the settings imply.
    #[error("{array} has shape {actual:?}, but {axes} must be {expected:?}")]
    Shape {
        /// Which array.
        array: &'static str,
        /// The names of its axes in order.
        axes: &'static str,
        /// The shape given.
        actual: Vec<usize>,
        /// The shape needed.
        expected: Vec<usize>,
    },
    /// The stack holds a NaN or an infinity.
    #[error(
        "the stack's sample at setting {setting}, row {row}, column {column} is not finite: \
         mask the sample and put any finite value in its place"
    )]
    NotFinite {
        /// Setting index.
        setting: usize,
        /// Camera row.
        row: usize,
        /// Camera column.
        column: usize,
    },
    /// A stack is too small, too dark or too much masked to tell its noise.
    #[error(
        "the noise cannot be fitted from {samples} samples, it takes {needed}: \
         give read_variance and gain, or use a larger window with fewer masked pixels"
    )]
    TooFewSamples {
        /// Samples that could be used.
        samples: usize,
        /// Samples needed.
        needed: usize,
    },
    /// A name that no prior has.
    #[error("prior is \"{name}\", but must be \"paper\" or \"split\"")]
    UnknownPrior {
        /// The name given.
        name: String,
    },
}

/// Checks that an array has the shape that it must have.
pub(super) fn check_shape(
    array: &'static str,
    axes: &'static str,
    actual: &[usize],
    expected: &[usize],
) -> Result<(), PlaneError> {
    match actual == expected {
        true => Ok(()),
        false => Err(PlaneError::Shape { array, axes, actual: actual.to_vec(), expected: expected.to_vec() }),
    }
}
