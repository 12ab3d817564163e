//! How a camera takes the settings of a film's cycle.

use raysweep_core::{CameraCapabilities, CameraSettings};
use raysweep_pipeline::{CycleOrder, Shot};
use raysweep_processing::plane::PlaneTask;

/// The settings of a cycle, and their order.
pub struct CyclePlan {
    /// The camera's settings, in the plan's order of the delays.
    pub shots: Vec<Shot>,
    /// The order in which they are taken.
    pub order: CycleOrder,
}

impl CyclePlan {
    /// The fastest way to take the cycles of `task` with this camera.
    pub fn new(task: &PlaneTask, camera: &CameraCapabilities) -> Self {
        let shots: Vec<Shot> =
            task.settings().map(|(_, point)| task.geometry.shot(point, camera.trigger_latency_us)).collect();
        let settings: Vec<CameraSettings> = shots.iter().map(|shot| shot.settings).collect();
        let period_us = task.geometry.raster.period_us;
        let order = CycleOrder::fastest(&settings, camera, period_us, task.max_jitter_us);
        Self { shots, order }
    }
}
