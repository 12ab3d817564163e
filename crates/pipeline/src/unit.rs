//! The averaged image of one point.

use std::sync::Arc;

use ndarray::Array2;
use raysweep_core::{Counts, SettingsId};

/// The sum of a point's frames and everything known about their exposure.
#[derive(Debug, Clone)]
pub struct Unit {
    /// Point and attempt.
    pub id: SettingsId,
    /// Frames summed.
    pub frames: u32,
    /// Wanted delay t_d.
    pub delay_us: f64,
    /// The actual exposure of the hardware.
    pub exposure_us: f64,
    /// True delay t_d of each frame, relative to the VSYNC edge of its light.
    pub delays_us: Vec<f64>,
    /// Which run of the session took it, counted from 1; 0 until the unit reaches its sink. Each run has its own clock.
    pub run: u32,
    /// Start of the exposure of row 0 in each frame, on the host's clock; empty if it was not stored.
    pub starts_ns: Vec<i64>,
    /// Sum of counts, `[t, s]`.
    pub sum: Arc<Array2<u32>>,
    /// In how many of the frames each pixel saturates, `[t, s]`; `None` if none does, or if it is not known.
    pub clipped: Option<Arc<Array2<u32>>>,
    /// What became of the attempt's triggers.
    pub counts: Counts,
}

impl Unit {
    /// The mean image in counts, `[t, s]`, which stages process.
    pub fn mean(&self) -> Array2<f32> {
        let scale = 1.0 / f64::from(self.frames);
        self.sum.mapv(|sum| (f64::from(sum) * scale) as f32)
    }
}
