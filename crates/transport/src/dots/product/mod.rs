//! Images made of a batch's columns. All are `[height, width, channels]`, in the columns' counts.
//!
//! A column's light at a pixel is its value where the mask has the pixel, and its block's mean elsewhere. Every pixel is
//! summed in the order of the dots, in f64, whatever the number of threads.

mod dual;
mod epipolar;
mod overlap;
mod relight;
mod shadow;
mod sum;

use ndarray::Array3;

pub use dual::{DualImage, column_energies, dual, fill_holes};
pub use epipolar::{EpipolarMask, MaskRule, epipolar};
pub use overlap::{compensate, coverage};
pub use relight::{floodlit, pattern_weights, relight, relight_sequence};
pub use shadow::{shadow_dot, shadow_neighbours};

/// Light that came straight from the mirror, and all other light.
#[derive(Debug, Clone, PartialEq)]
pub struct Separation {
    /// `[height, width, channels]`.
    pub direct: Array3<f32>,
    /// `[height, width, channels]`.
    pub global: Array3<f32>,
}
