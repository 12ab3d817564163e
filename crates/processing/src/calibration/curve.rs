//! The camera's curve, from exposures of several passes of the beam.

use ndarray::{Array2, Array3};
use raysweep_transport::plane::board::images::{DarkFit, ImagesError, LightLevel, Linearity};

use super::images::{BoardImages, CalibrationError};

/// A curve is not used if full scale is known no better than this, relative to itself.
const KNOWN_BEND: f64 = 0.003;

/// What is known of the camera's curve.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum MeasuredCurve {
    /// It is known.
    Known(Linearity),
    /// No images of it were taken.
    NotTaken,
    /// Exposures of several periods saturate.
    Saturated,
    /// The images say too little of it.
    Uncertain,
}

impl MeasuredCurve {
    /// From exposures with one, two and three passes of the beam.
    pub(super) fn of(
        images: &BoardImages<'_>,
        dark: &DarkFit,
        saturation_dn: f32,
    ) -> Result<Self, CalibrationError> {
        let period_us = images.task.task.geometry.raster.period_us;
        let taken: Vec<(f64, Array3<f32>, Array2<f32>)> = images
            .task
            .passes()
            .map(|(passes, purpose)| {
                let passes = passes as f64;
                Ok((passes, images.frames(purpose)?, dark.image(passes * period_us)))
            })
            .collect::<Result<_, CalibrationError>>()?;
        if taken.is_empty() {
            return Ok(Self::NotTaken);
        }
        let levels: Vec<LightLevel<'_>> = taken
            .iter()
            .map(|(light, frames, dark_dn)| LightLevel {
                light: *light,
                frames: frames.view(),
                dark_dn: dark_dn.view(),
            })
            .collect();
        let usable = dark.hot.mapv(|hot| !hot);
        match Linearity::new(&levels, saturation_dn, Some(usable.view())) {
            Ok(found) if found.per_dn.sd * f64::from(saturation_dn) < KNOWN_BEND => Ok(Self::Known(found)),
            Ok(_) => Ok(Self::Uncertain),
            Err(ImagesError::TooFew { .. }) => Ok(Self::Saturated),
            Err(error) => Err(error.into()),
        }
    }

    /// The curve, if it is known.
    pub fn known(&self) -> Option<&Linearity> {
        match self {
            Self::Known(linearity) => Some(linearity),
            Self::NotTaken | Self::Saturated | Self::Uncertain => None,
        }
    }

    /// What is to be said to an operator.
    pub fn warning(&self) -> Option<&'static str> {
        match self {
            Self::Known(_) | Self::NotTaken => None,
            Self::Saturated => Some(
                "how linear the camera is could not be measured, and it is taken as linear: exposures of several VSYNC periods saturate; close the aperture until white gives 50 to 65 % of full scale, switch the lamps off, or take calibration.passes = 2",
            ),
            Self::Uncertain => Some(
                "how linear the camera is could not be measured, and it is taken as linear: exposures of several VSYNC periods differ among each other; switch lamps that flicker off",
            ),
        }
    }

    /// Images `[n, t, s]` whose counts are proportional to the light, as far as the curve is known.
    pub(super) fn straightened(&self, mut images: Array3<f32>, dark: &DarkFit) -> Array3<f32> {
        if let Some(linearity) = self.known() {
            linearity.straighten(images.view_mut(), &dark.offset_dn);
        }
        images
    }
}
