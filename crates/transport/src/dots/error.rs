/// Why frames, settings or calibrations of the dot rig cannot be used. Each message says what to change.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum DotsError {
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
    /// An array's shape does not fit the other arrays.
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
    /// Stored columns are inconsistent.
    #[error("the columns are damaged: {problem} at index {index}; read them again or denoise the batch anew")]
    Damaged {
        /// What is wrong.
        problem: &'static str,
        /// Index in its array.
        index: usize,
    },
    /// A calibration has too little data.
    #[error("{what}: {given} given, at least {needed} needed")]
    TooFew {
        /// The things counted, and how to get more of them.
        what: &'static str,
        /// Their number.
        given: usize,
        /// The number needed.
        needed: usize,
    },
    /// The trailing dot is not seen.
    #[error(
        "the trailing dot is not seen: of {frames} frames, the brightest is {energy:.0} counts above the median in batches.trailing_region, and more than {needed:.0} are needed. Likely causes: the lens cap is on, or the aperture closed; the laser is off or its shutter closed; the dot does not land in the trailing region; the exposure is too short, or at the wrong time for the mirror's samples"
    )]
    NoDot {
        /// Number of frames.
        frames: usize,
        /// The largest energy, above the median.
        energy: f64,
        /// The energy that is exceeded if there is a dot.
        needed: f64,
    },
    /// The planes do not determine the epipolar geometry.
    #[error(
        "the dots of the two calibration planes lie {parallax_px:.2} px apart, with a noise of {sd_px:.2} px: move the \
         second plane to another depth"
    )]
    Planar {
        /// Median distance between a dot's places on the two planes, in pixels.
        parallax_px: f64,
        /// Standard deviation of the dots from their epipolar lines, in pixels.
        sd_px: f64,
    },
}

/// Checks that an array has the expected shape.
pub(crate) fn check_shape(
    array: &'static str,
    axes: &'static str,
    actual: &[usize],
    expected: &[usize],
) -> Result<(), DotsError> {
    match actual == expected {
        true => Ok(()),
        false => Err(DotsError::Shape { array, axes, actual: actual.to_vec(), expected: expected.to_vec() }),
    }
}

/// Checks that a number lies in the range that `allowed` describes; NaN never does.
pub(crate) fn check_range(
    field: &'static str,
    value: f64,
    is_allowed: bool,
    allowed: &'static str,
) -> Result<(), DotsError> {
    match is_allowed {
        true => Ok(()),
        false => Err(DotsError::OutOfRange { field, value, allowed }),
    }
}
