//! When a pixel is overexposed.

use raysweep_core::PixelFormat;

/// A mean counts as saturated from this share of the converter's range on: the noise of single frames must not be
/// clipped.
const SATURATION: f64 = 0.97;

/// Counts from which on a pixel of this format is overexposed: wells may be full before the converter saturates.
pub fn saturation_dn(format: PixelFormat) -> f64 {
    SATURATION * f64::from(format.max_value())
}
