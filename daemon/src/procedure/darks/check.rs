//! Predicts a run of dark images, before anything moves.

use raysweep_config::ConfigError;
use raysweep_processing::darks::DarksTask;
use raysweep_proto::CheckReport;

use crate::plane::foresight::periods;
use crate::procedure::lab::Lab;

/// Images in memory at once, including those of an exposure and the report's, in bytes per pixel.
const BYTES_PER_PX: u64 = 64;
/// Disk space of the report and other small files.
const OTHER_BYTES: u64 = 5_000_000;

/// Predicts a run of dark images.
///
/// # Errors
/// For an exposure that the camera does not support.
pub fn check(darks: &DarksTask, lab: &Lab<'_>) -> Result<CheckReport, ConfigError> {
    let task = &*darks.task;
    let (mut frames, mut light_periods) = (0, 0);
    for point in &task.schedule.points {
        let shot = task.geometry.shot(point, lab.camera.trigger_latency_us);
        let refused = |message| {
            task.refuse(&["darks"], format!("dark images are triggered as a sweep's are: {message}"))
        };
        lab.camera.allows(&shot.settings).map_err(refused)?;
        frames += u64::from(point.frames);
        light_periods += u64::from(point.frames) * periods(task, lab.camera, point);
    }
    let pixels = (task.geometry.height * task.geometry.width) as u64;
    let images = darks.points() as u64;
    // The means of all exposures are written as one sequence.
    let memory_bytes = pixels * (BYTES_PER_PX + 8 * images);
    let room = lab.room(memory_bytes, pixels * 4 * 2 * images + OTHER_BYTES);
    Ok(CheckReport {
        points: darks.points(),
        frames,
        light_s: light_periods as f64 * task.geometry.raster.period_us * 1e-6,
        warnings: room.warnings(),
        ..room.report()
    })
}
