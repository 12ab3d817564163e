/// Why frames, settings or calibrations of the dot rig cannot be used. Each message says what to change.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum DotsError {
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
    /// An array has another shape than the others imply.
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
    /// Stored columns contradict themselves.
    #[error("the columns are damaged: {problem} at index {index}; read them again or denoise the batch anew")]
    Damaged {
        /// What is wrong.
        problem: &'static str,
        /// Where in its array.
        index: usize,
    },
    /// A calibration has too little to go by.
    #[error("{what}: {given} given, at least {needed} needed")]
    TooFew {
        /// What is counted, and how to get more.
        what: &'static str,
        /// How many there are.
        given: usize,
        /// How many it takes.
        needed: usize,
    },
    /// Correspondences that leave the fundamental matrix undetermined.
    #[error(
        "the correspondences lie on one plane (singular value ratio {ratio:.1e}, at least {needed:.1e} needed): \
         scan the calibration plane at a second depth, or give mirror angles that were calibrated"
    )]
    Planar {
        /// The seventh singular value of the eight-point system over the largest.
        ratio: f64,
        /// The least that is accepted.
        needed: f64,
    },
}

/// Checks that an array has the shape that it must have.
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

/// Checks that a number fulfils what `allowed` says; NaN never does.
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
