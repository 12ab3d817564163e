//! The averaged image of one point.

use std::sync::Arc;

use ndarray::Array2;
use raysweep_core::{Counts, SettingsId};

/// The sum of a point's frames and everything that is known of how they were exposed.
#[derive(Debug, Clone)]
pub struct Unit {
    /// Point and attempt.
    pub id: SettingsId,
    /// Frames summed.
    pub frames: u32,
    /// Exposure as the hardware took it.
    pub exposure_us: f64,
    /// True t_d of each frame, measured against the VSYNC edge of its light.
    pub delays_us: Vec<f64>,
    /// Start of the exposure of row 0 in the last frame, on the host's clock; nothing in a unit that is read back.
    pub last_exposure_ns: Option<i64>,
    /// Sum of counts, `[t, s]`.
    pub sum: Arc<Array2<u32>>,
    /// Where the attempt's triggers went.
    pub counts: Counts,
}

impl Unit {
    /// The mean image in counts, `[t, s]`: what stages work on.
    pub fn mean(&self) -> Array2<f32> {
        let scale = 1.0 / f64::from(self.frames);
        self.sum.mapv(|sum| (f64::from(sum) * scale) as f32)
    }
}
