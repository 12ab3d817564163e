//! A scene at rest.

use raysweep_core::Mosaic;

use crate::dots::beam::BeamSpot;

/// Names of the built-in scenes.
pub const BUILTIN_NAMES: [&str; 4] = ["v-groove", "glass", "candle", "fog"];

/// Images under one spot, `[row, column]` row-major, relative to a white plane under the full beam.
#[derive(Debug, Clone)]
pub struct SpotImages {
    /// Direct light from the mirror; for a scene from a file, all light.
    pub direct: Vec<f32>,
    /// All other light.
    pub global: Vec<f32>,
}

/// A scene at rest.
pub trait Still: Send + Sync {
    /// Adds the direct light of a spot; for a scene from a file, all light.
    fn add_direct(&self, spot: &BeamSpot, image: &mut [f32]);

    /// Adds all other light of a spot.
    fn add_global(&self, spot: &BeamSpot, image: &mut [f32]);
}

/// A colour as seen by a pixel of a mosaic; on a monochrome sensor, the mean.
pub(super) fn seen(mosaic: Mosaic, row: usize, column: usize, colour: [f32; 3]) -> f32 {
    let Some((red_column, red_row)) = mosaic.red() else {
        return colour.iter().sum::<f32>() / 3.0;
    };
    // Blue is diagonal to red; green is adjacent to both.
    colour[usize::from(row % 2 != red_row) + usize::from(column % 2 != red_column)]
}
