//! Images computed from a batch's columns. All are `[height, width, channels]`, in the columns' counts.
//!
//! A column's light at a pixel is its value if the mask contains the pixel, otherwise its block's mean. Every pixel
//! is summed in the order of the dots, in f64, whatever the number of threads.

mod dual;
mod epipolar;
mod holes;
mod overlap;
mod relight;
mod shadow;
mod sum;

use ndarray::Array3;

use super::error::check_shape;
use super::{Batch, DotsError};

pub use dual::{DualImage, column_energies, dual};
pub use epipolar::{EpipolarMask, MaskRule, REFERENCE_WIDTH_PX, epipolar};
pub use holes::fill_holes;
pub use overlap::{compensate, coverage};
pub use relight::{floodlit, pattern_weights, relight, relight_sequence};
pub use shadow::{shadow_dot, shadow_neighbours};

/// The values of a floodlit image, if it has the batch's shape.
fn check_light<'a>(batch: &Batch, light: &'a Array3<f32>) -> Result<&'a [f32], DotsError> {
    let shape = batch.shape();
    let expected = [shape.height(), shape.width(), shape.channels()];
    check_shape("light", "[height, width, channels]", light.shape(), &expected)?;
    // An image with another memory order cannot be the floodlit image computed here.
    light.as_slice().ok_or_else(|| DotsError::Shape {
        array: "light",
        axes: "[height, width, channels] in this order in memory",
        actual: light.shape().to_vec(),
        expected: expected.to_vec(),
    })
}

/// Light that came directly from the mirror, and all other light.
#[derive(Debug, Clone, PartialEq)]
pub struct Separation {
    /// `[height, width, channels]`.
    pub direct: Array3<f32>,
    /// `[height, width, channels]`.
    pub global: Array3<f32>,
}
