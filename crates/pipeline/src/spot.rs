//! A flying spot passes a pixel's column at some moment of its row's time: what becomes of images whose exposure begins
//! or ends while it draws the row that lights the pixel directly.

use raysweep_transport::plane::board::CalibrationParameter;
use raysweep_transport::plane::calibrate::{FlyingSpot, settings_on_direct_row};
use raysweep_transport::plane::{Demux, PlaneError, RowTiming, Setting};

use crate::schedule::{Spot, SweepGeometry};

/// The images of a stack whose exposure begins or ends while a flying spot draws the direct row of any camera row, as
/// indices, and what is done about them.
#[derive(Debug, Clone, PartialEq)]
pub enum SpotCut {
    /// There are none, or rows are lit evenly.
    Nowhere,
    /// They are modelled: it is known when the spot passes each pixel.
    Modelled {
        /// The images.
        cut: Vec<usize>,
        /// The spot's path.
        spot: FlyingSpot,
    },
    /// They are left out.
    LeftOut {
        /// The images.
        cut: Vec<usize>,
    },
    /// All images are such, and none is left out: direct light is not to be trusted.
    Everywhere,
}

impl SpotCut {
    /// What the spot of `geometry` does to images with these settings.
    ///
    /// # Errors
    /// Those of [`RowTiming::check`].
    pub fn of(
        geometry: &SweepGeometry,
        timing: &RowTiming,
        settings: &[Setting],
    ) -> Result<Self, PlaneError> {
        let Spot::Flying(_) = geometry.spot else { return Ok(Self::Nowhere) };
        // What may be wrong with the times of edges, on either side.
        let unknown_us = geometry.calibration.as_ref().map_or(0.0, |calibration| {
            calibration.jitter_us + calibration.covariance.sd(CalibrationParameter::Latency)
        });
        let cut = settings_on_direct_row(timing, settings, 2.0 * unknown_us)?;
        Ok(match geometry.modelled_spot() {
            _ if cut.is_empty() => Self::Nowhere,
            _ if cut.len() == settings.len() => Self::Everywhere,
            Some(spot) => Self::Modelled { cut, spot },
            None => Self::LeftOut { cut },
        })
    }

    /// Whether an image is used.
    pub fn keeps(&self, image: usize) -> bool {
        match self {
            Self::LeftOut { cut } => !cut.contains(&image),
            Self::Nowhere | Self::Modelled { .. } | Self::Everywhere => true,
        }
    }

    /// Whether it does not matter for an image when the spot passes a pixel.
    pub fn is_steady(&self, image: usize) -> bool {
        match self {
            Self::LeftOut { cut } | Self::Modelled { cut, .. } => !cut.contains(&image),
            Self::Nowhere | Self::Everywhere => true,
        }
    }

    /// The demultiplexer of the images that are used, with the spot where it is modelled.
    ///
    /// # Errors
    /// Those of [`Demux::with_spot`].
    pub fn modelled_by(self, demux: Demux) -> Result<Demux, PlaneError> {
        match self {
            Self::Modelled { spot, .. } => demux.with_spot(spot),
            Self::Nowhere | Self::LeftOut { .. } | Self::Everywhere => Ok(demux),
        }
    }
}
