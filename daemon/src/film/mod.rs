//! Films: what a film's plan amounts to on a rig, and what is made of its cycles.

mod process;
mod report;

use raysweep_core::{CameraCapabilities, CameraSettings, Readout};
use raysweep_pipeline::{CycleOrder, Shot};
use raysweep_proto::FilmCheck;
use raysweep_session::film::TransportFilm;
use raysweep_session::{Result, Session};
use serde_json::json;

use crate::processing::Task;
use crate::results;

pub use process::process;
pub use report::{make as make_report, shortcomings};

/// How the settings of a film's cycle are taken on a camera.
pub struct CyclePlan {
    /// The camera's settings, in the plan's order of the delays.
    pub shots: Vec<Shot>,
    /// In which order they are taken.
    pub order: CycleOrder,
}

impl CyclePlan {
    /// The fastest way to take the cycles of `task` on this camera.
    pub fn new(task: &Task, camera: &CameraCapabilities) -> Self {
        let shots: Vec<Shot> =
            task.settings().map(|(_, point)| task.geometry.shot(point, camera.trigger_latency_us)).collect();
        let settings: Vec<CameraSettings> = shots.iter().map(|shot| shot.settings).collect();
        let period_us = task.geometry.raster.period_us;
        let order = CycleOrder::fastest(&settings, camera, period_us, task.plan.max_jitter_us());
        Self { shots, order }
    }
}

/// What a film would do on this camera; `reach_rows` is how many rows its transports have.
pub fn check(task: &Task, camera: &CameraCapabilities, reach_rows: u64) -> FilmCheck {
    let geometry = &task.geometry;
    let CyclePlan { shots, order } = CyclePlan::new(task, camera);
    let settings = shots.len();
    let periods = order.cycle_periods();
    let transports_per_s = 1e6 / (f64::from(periods) * geometry.raster.period_us);
    let pixels = (geometry.height * geometry.width) as f64;
    let bytes_per_cycle = pixels * (2.0 * settings as f64 + 4.0 * reach_rows as f64);
    let missed = periods.saturating_sub(settings as u32);
    let readout_us = camera.readout_us;
    let reason = match (missed, camera.readout) {
        (0, _) => "the camera answers every trigger".to_owned(),
        (1, Readout::Overlapped) => format!(
            "its readout of {readout_us:.0} us leaves one trigger a cycle unanswered, where the delay falls back: take smaller gaps between the delays, or fewer camera rows"
        ),
        _ => format!(
            "trigger delay, exposure and a readout of {readout_us:.0} us together are longer than a VSYNC period, which leaves {missed} triggers a cycle unanswered: fewer camera rows or a camera that overlaps readout and exposure would be faster"
        ),
    };
    FilmCheck {
        settings,
        cycles: task.points(),
        periods_per_cycle: periods,
        transports_per_s,
        disk_bytes_per_minute: (bytes_per_cycle * transports_per_s * 60.0) as u64,
        reason,
    }
}

/// Makes the empty series of a film's transports, in place of what is there.
///
/// # Errors
/// When the disk refuses.
pub fn create_transports(session: &Session, task: &Task, reach_rows: (i32, i32)) -> Result<TransportFilm> {
    let geometry = &task.geometry;
    let (u_min, u_max) = reach_rows;
    let mut attributes = results::common(task);
    attributes.insert("u_min".into(), json!(u_min));
    attributes.insert("u_max".into(), json!(u_max));
    attributes.insert(
        "about".into(),
        json!("light from projector row v = t + first_row + u to camera pixel (t, s), by cycle; 0 where the projector has no such row, NaN where the cycle was not estimated"),
    );
    let cycle = [(u_max - u_min + 1) as usize, geometry.height, geometry.width];
    TransportFilm::create(&session.transport_film_path(), task.points(), cycle, &attributes)
}
