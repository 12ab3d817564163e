/// Why a timing, a setting, a prior or a stack cannot be used. Each message says what to change.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum PlaneError {
    /// A number lies outside its range.
    #[error("{field} is {value}, but must be {allowed}")]
    OutOfRange {
        /// The field's name in the API.
        field: &'static str,
        /// Its value.
        value: f64,
        /// The accepted range, and what to do.
        allowed: &'static str,
    },
    /// The camera's window is not contained in the projector's rows.
    #[error(
        "camera rows are a window of projector rows {first_row}..{end}, but the projector has {projector_rows}: \
         give a window of at least one row inside the projector's"
    )]
    Window {
        /// First projector row of the window.
        first_row: usize,
        /// End of the window's projector rows (exclusive).
        end: usize,
        /// Number of projector rows.
        projector_rows: usize,
    },
    /// A camera row that does not exist.
    #[error("row {row} is asked for, but the camera has rows 0..{camera_rows}")]
    Rows {
        /// The row asked for.
        row: usize,
        /// Number of rows of the camera.
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
    /// No row collects enough light to be estimated.
    #[error("no setting sees 5 % of any row's light: lengthen the exposures or bring the delays nearer to 0")]
    NothingSeen,
    /// The objective cannot be factored.
    #[error(
        "the objective is not convex in floating point: choose alpha nearer to 0.1, or shorter exposures"
    )]
    NotConvex,
    /// The caller stopped the computation.
    #[error("ended before it was done; `raysweep process` makes the results again")]
    Stopped,
    /// An array's shape does not fit the timing and the settings.
    #[error("{array} has shape {actual:?}, but {axes} must be {expected:?}")]
    Shape {
        /// Name of the array.
        array: &'static str,
        /// Names of its axes, in order.
        axes: &'static str,
        /// The actual shape.
        actual: Vec<usize>,
        /// The expected shape.
        expected: Vec<usize>,
    },
    /// The stack contains a NaN or an infinity.
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
    /// The stack is too small, too dark or has too many masked samples to estimate its noise.
    #[error(
        "the noise cannot be fitted from {samples} samples, it takes {needed}: \
         give read_variance and gain, or use a larger window with fewer masked pixels"
    )]
    TooFewSamples {
        /// Number of usable samples.
        samples: usize,
        /// Number of samples needed.
        needed: usize,
    },
    /// A name that is not the name of a prior.
    #[error("prior is \"{name}\", but must be \"paper\" or \"split\"")]
    UnknownPrior {
        /// The given name.
        name: String,
    },
}

/// Checks that an array has the expected shape.
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
