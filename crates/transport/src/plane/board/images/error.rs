/// Why images of the board do not give a property of the pixels. Each message says what to change.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum ImagesError {
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
    /// An array's shape does not fit the others.
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
    /// Too few frames, levels or pixels for an estimate.
    #[error("{given} {what}, but at least {needed} are needed: {cure}")]
    TooFew {
        /// What there is too little of.
        what: &'static str,
        /// The number given.
        given: usize,
        /// The number needed.
        needed: usize,
        /// What to do.
        cure: &'static str,
    },
    /// The noise does not grow with the light.
    #[error(
        "the variance over frames falls by {fall} DN^2 per DN of light, but shot noise makes it grow: \
         switch off the camera's noise reduction, and keep saturated levels out"
    )]
    NoShotNoise {
        /// How much the variance falls per DN.
        fall: f64,
    },
    /// The camera's response is curved.
    #[error(
        "the camera's response is curved by {:.1} % of full scale, but at most {:.0} % are accepted: gamma is on; \
         switch off gamma, look-up tables and contrast enhancement in the camera",
        100.0 * bend, 100.0 * limit
    )]
    Curved {
        /// Deviation from a line at full scale, as a share of it.
        bend: f64,
        /// Largest accepted share.
        limit: f64,
    },
    /// The board does not fill the image.
    #[error(
        "white covers only {:.0} % of the image, but at least {:.0} % are needed: fill the view with the board, or \
         set camera.region",
        100.0 * coverage, 100.0 * limit
    )]
    Coverage {
        /// Share of the image that is lit.
        coverage: f64,
        /// Smallest accepted share.
        limit: f64,
    },
    /// White saturates.
    #[error(
        "{:.1} % of the pixels saturate under white, but at most {:.1} % are accepted: close the aperture by one stop",
        100.0 * share, 100.0 * limit
    )]
    Saturated {
        /// Share of the pixels that saturate.
        share: f64,
        /// Largest accepted share.
        limit: f64,
    },
    /// White is dark.
    #[error(
        "white gives {:.0} % of full scale, but at least {:.0} % are needed: open the aperture until it gives 50 to \
         65 %",
        100.0 * level, 100.0 * limit
    )]
    Dim {
        /// Median of the white map as a share of full scale.
        level: f64,
        /// Smallest accepted share.
        limit: f64,
    },
    /// The pictures of sparse rows do not add up to white.
    #[error(
        "the {pictures} row pictures add up to {sum:.3} of white, but must add up to 1 within {limit}: the projector \
         brightens sparse pictures, or scales them: switch off dynamic contrast, keystone and scaling"
    )]
    SumOfPhases {
        /// Number of pictures.
        pictures: usize,
        /// Median of their sum over white.
        sum: f64,
        /// Largest accepted deviation from 1.
        limit: f64,
    },
    /// Many pixels see two separate rows of one picture.
    #[error(
        "rows show two separate peaks in {:.0} % of the pixels, but at most {:.0} % are accepted: the picture is not \
         shown row by row: switch off scaling, keystone and frame interpolation in the projector",
        100.0 * share, 100.0 * limit
    )]
    TwoPeaks {
        /// Share of the pixels.
        share: f64,
        /// Largest accepted share.
        limit: f64,
    },
    /// Light of a row reaches far.
    #[error(
        "{:.1} % of a row's light lies beyond 6 rows, but at most {:.0} % are accepted: focus projector and camera, \
         or take a board that scatters less",
        100.0 * share, 100.0 * limit
    )]
    FarLight {
        /// Median share of the light beyond 6 rows.
        share: f64,
        /// Largest accepted share.
        limit: f64,
    },
    /// Places are not smooth over the image.
    #[error(
        "places differ from a smooth map by {rms:.2} {lines}, but at most {limit} are accepted: the board is bent, or \
         the picture is scaled: take a flat board, and switch off scaling and keystone"
    )]
    NotSmooth {
        /// What the places count, rows or columns.
        lines: &'static str,
        /// Root mean square of the difference.
        rms: f64,
        /// Largest accepted difference.
        limit: f64,
    },
    /// Flicker that the frames cannot follow.
    #[error(
        "{frequency_hz:.1} Hz flicker of {level:.4} of white cannot be followed at {frame_rate_hz:.0} frames/s: \
         switch the lamp off"
    )]
    Flicker {
        /// The flicker's frequency.
        frequency_hz: f64,
        /// Its amplitude in a row's dwell, as a share of white.
        level: f64,
        /// The camera's frame rate.
        frame_rate_hz: f64,
    },
}

/// Refuses a number outside its range.
pub(super) fn check_range(
    field: &'static str,
    value: f64,
    accepted: bool,
    allowed: &'static str,
) -> Result<(), ImagesError> {
    if accepted { Ok(()) } else { Err(ImagesError::OutOfRange { field, value, allowed }) }
}

/// Checks that an array has the expected shape.
pub(super) fn check_shape(
    array: &'static str,
    axes: &'static str,
    actual: &[usize],
    expected: &[usize],
) -> Result<(), ImagesError> {
    match actual == expected {
        true => Ok(()),
        false => {
            Err(ImagesError::Shape { array, axes, actual: actual.to_vec(), expected: expected.to_vec() })
        }
    }
}

/// Checks that there are enough frames.
pub(super) fn check_frames(given: usize, needed: usize) -> Result<(), ImagesError> {
    let cure = "take more frames of each picture";
    match given >= needed {
        true => Ok(()),
        false => Err(ImagesError::TooFew { what: "frames of one picture", given, needed, cure }),
    }
}
