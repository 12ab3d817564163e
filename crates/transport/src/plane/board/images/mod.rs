//! Properties of each pixel from images of the board.
//!
//! Images are `[t, s]` and runs of frames `[n, t, s]`, in DN as the camera delivers them unless a function says that
//! it takes the dark image, or the black picture, subtracted. [`DarkFit`] and [`photon_transfer`] come first: the dark
//! image and [`SensorNoise`] are what the others need. Then [`Linearity`] straightens the camera's response, and
//! [`WhiteMap`], [`locate_rows`] and [`Responses`] describe what each pixel sees of the projector. [`Ambient`] is the
//! light of the room.
//!
//! Projector rows count from 0, and row `v` has its centre at `v`. A pixel's place `p` is a position on that scale.

mod ambient;
mod comparison;
mod dark;
mod error;
mod linearity;
mod photon_transfer;
mod place;
mod response;
mod smooth;
mod white;

pub use ambient::{Ambient, BlackFrames, Flicker, ambient, steady};
pub use comparison::{Narrower, ResponseComparison, compare_responses};
pub use dark::{CappedFrames, DarkFit};
pub use error::ImagesError;
pub use linearity::{LightLevel, Linearity, MOST_BEND, SaturationLimit};
pub use photon_transfer::{PhotonTransfer, photon_transfer, prnu};
pub use place::{CodedPictures, Phases, RowPlaces, locate_columns, locate_rows};
pub use response::{ResponseChecks, Responses};
pub use white::WhiteMap;

pub(super) use response::{PICTURES, column_pairs, near_rows};

use ndarray::{Array2, ArrayView2, ArrayView3, Axis};
use rayon::prelude::*;

use super::Estimate;
use error::{check_frames, check_range, check_shape};

/// Variance of rounding to whole DN.
const ROUNDING_DN2: f64 = 1.0 / 12.0;
/// Scales a median absolute deviation to the standard deviation of normal noise.
const MAD_TO_SIGMA: f64 = 1.4826;

/// The noise of one frame of the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SensorNoise {
    /// Electrons per DN.
    pub electrons_per_dn: f64,
    /// Standard deviation of one reading in the dark, in electrons.
    pub read_noise_e: f64,
}

impl SensorNoise {
    /// Variance of one frame's sample, rounding included, where the light gives `signal_dn` above the dark image.
    pub fn variance_dn2(&self, signal_dn: f64) -> f64 {
        (self.read_noise_e / self.electrons_per_dn).powi(2)
            + signal_dn.max(0.0) / self.electrons_per_dn
            + ROUNDING_DN2
    }

    /// Checks the parameters.
    ///
    /// # Errors
    /// [`ImagesError::OutOfRange`] for a gain that is not positive or a read noise that is negative.
    pub fn check(&self) -> Result<(), ImagesError> {
        let Self { electrons_per_dn, read_noise_e } = *self;
        let allowed = "positive: estimate it by photon transfer";
        check_range(
            "electrons_per_dn",
            electrons_per_dn,
            electrons_per_dn.is_finite() && electrons_per_dn > 0.0,
            allowed,
        )?;
        check_range(
            "read_noise_e",
            read_noise_e,
            read_noise_e.is_finite() && read_noise_e >= 0.0,
            "at least 0: estimate it by photon transfer",
        )
    }
}

/// Mean over the frames.
fn mean_image(frames: ArrayView3<f32>) -> Array2<f32> {
    let n = frames.len_of(Axis(0)) as f32;
    let mut mean = Array2::zeros((frames.len_of(Axis(1)), frames.len_of(Axis(2))));
    mean.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(t, mut row)| {
        // Sums of 12 or 16 bits are exact in f32 for hundreds of frames.
        frames.axis_iter(Axis(0)).for_each(|frame| row += &frame.index_axis(Axis(0), t));
        row /= n;
    });
    mean
}

/// Median of values that are all finite; `None` without values.
fn median(values: &mut [f64]) -> Option<f64> {
    let middle = values.len() / 2;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

/// Standard deviation of normal noise with outliers, from the median absolute deviation from `centre`.
fn robust_sd(values: &[f64], centre: f64) -> f64 {
    let mut deviations: Vec<f64> = values.iter().map(|value| (value - centre).abs()).collect();
    MAD_TO_SIGMA * median(&mut deviations).unwrap_or(0.0)
}

/// Median of the mean of `degrees` squares of standard normal variables (Wilson and Hilferty).
fn median_of_variance(degrees: usize) -> f64 {
    (1.0 - 2.0 / (9.0 * degrees as f64)).powi(3)
}

/// Whether pixel `[t, s]` may be used: all of them without a mask.
fn is_usable(usable: Option<ArrayView2<bool>>, t: usize, s: usize) -> bool {
    usable.is_none_or(|usable| usable[[t, s]])
}
