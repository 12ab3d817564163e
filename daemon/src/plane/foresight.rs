//! Predicts a plan's run on a plane rig, as far as that is independent of the procedure.

use raysweep_config::ConfigError;
use raysweep_core::CameraCapabilities;
use raysweep_pipeline::{DemuxFold, Point};
use raysweep_processing::plane::PlaneTask;

/// Condition number from which on noise is amplified more than the prior can compensate.
const ILL_CONDITIONED: f64 = 1e9;

/// The model that a task's points give on its rig.
pub struct Model {
    /// First and last relative row whose light can be distinguished.
    pub reach_rows: (i32, i32),
    /// Condition number of the system that is solved for a pixel in the middle of the frame.
    pub condition: f64,
    /// VSYNC periods per frame, for each point.
    pub periods: Vec<u64>,
}

impl Model {
    /// The model of a task whose points are in this table of the plan.
    ///
    /// # Errors
    /// When the points give no model on this rig, or exceed what the camera can do.
    pub fn of(task: &PlaneTask, camera: &CameraCapabilities, table: &str) -> Result<Self, ConfigError> {
        let no_model = |message: String| task.refuse(&[table], message);
        let geometry = &task.geometry;
        let demux = DemuxFold::new(task.demux_options()?, &task.schedule, geometry)
            .map_err(|error| no_model(error.to_string()))?
            .demux()
            .map_err(|error| no_model(error.to_string()))?;
        let condition = demux.condition(geometry.height / 2).map_err(|error| no_model(error.to_string()))?;
        let reach = demux.reach();
        for point in &task.schedule.points {
            let shot = geometry.shot(point, camera.trigger_latency_us);
            camera.allows(&shot.settings).map_err(no_model)?;
        }
        let periods = task.schedule.points.iter().map(|point| periods(task, camera, point)).collect();
        // JSON has no infinity.
        Ok(Self { reach_rows: (*reach.start(), *reach.end()), condition: condition.min(f64::MAX), periods })
    }

    /// Number of relative rows whose light can be distinguished.
    pub fn reach(&self) -> u64 {
        let (first, last) = self.reach_rows;
        (first..=last).count() as u64
    }

    /// Warnings for the operator.
    pub fn warnings(&self, task: &PlaneTask) -> Vec<String> {
        let (geometry, condition) = (&task.geometry, self.condition);
        let mut warnings = Vec::new();
        if condition > ILL_CONDITIONED {
            warnings.push(format!(
                "condition number {condition:.1e}: raise alpha or take delays that overlap more"
            ));
        }
        let (blind, (first_us, last_us)) = task.without_light();
        if blind > 0 {
            warnings.push(format!(
                "{blind} of {} settings see no row of the projector: give delays from {first_us:.0} to {last_us:.0} us",
                task.settings().count()
            ));
        }
        let brightest_rows = task
            .schedule
            .points
            .iter()
            .map(|point| (point.exposure_us / geometry.raster.row_time_us).min(geometry.raster.rows as f64))
            .fold(0.0, f64::max);
        let headroom = geometry.saturation_dn / geometry.white_dn;
        if headroom < 1.2 {
            warnings.push(format!(
                "a pixel saturates at {headroom:.2} times the direct light of a white one, and exposures collect light from up to {brightest_rows:.0} rows: lower camera.white_dn (gain, aperture) to leave room for indirect light"
            ));
        }
        warnings
    }
}

/// VSYNC periods per frame of a point.
pub fn periods(task: &PlaneTask, camera: &CameraCapabilities, point: &Point) -> u64 {
    let shot = task.geometry.shot(point, camera.trigger_latency_us);
    u64::from(camera.periods_per_frame(&shot.settings, task.geometry.raster.period_us))
}
