//! Predicts a run under pictures, before anything moves.

use raysweep_config::ConfigError;
use raysweep_processing::patterns::PatternsTask;
use raysweep_proto::CheckReport;

use crate::plane::foresight::periods;
use crate::procedure::lab::Lab;

/// Disk space of the report and other small files.
const OTHER_BYTES: u64 = 10_000_000;
/// Sums over the pictures of a checkerboard, maps and images of a setting, in bytes per pixel.
const BYTES_PER_PX: u64 = 400;
/// Files of each setting's products, in images.
const PRODUCTS: u64 = 16;

/// Predicts a run under pictures.
///
/// # Errors
/// For settings that the camera does not support.
pub fn check(patterns: &PatternsTask, lab: &Lab<'_>) -> Result<CheckReport, ConfigError> {
    let task = &*patterns.task;
    let (mut frames, mut light_periods) = (0, 0);
    for point in &task.schedule.points {
        let shot = task.geometry.shot(point, lab.camera.trigger_latency_us);
        lab.camera.allows(&shot.settings).map_err(|message| task.refuse(&["patterns"], message))?;
        frames += u64::from(point.frames);
        light_periods += u64::from(point.frames) * periods(task, lab.camera, point);
    }
    let pixels = (task.geometry.height * task.geometry.width) as u64;
    let (images, settings) = (task.schedule.points.len() as u64, patterns.settings().len() as u64);
    // Images under pictures that are no checkerboards are written as one sequence for each setting.
    let channels = task.mosaic.channels() as u64;
    let memory_bytes =
        pixels * (BYTES_PER_PX * settings + 12 * channels * patterns.longest_captured() as u64);
    let files = channels * (PRODUCTS * settings + 3 * patterns.captured() as u64 * settings);
    let room = lab.room(memory_bytes, 4 * pixels * (images + files) + OTHER_BYTES);
    let (points, blind) = (patterns.points(), task.without_light());
    let mut warnings = Vec::new();
    if let (count @ 1.., (first_us, last_us)) = blind {
        warnings.push(format!(
            "{count} of {points} images see no row of the projector: exposures see rows at delays from {first_us:.0} to {last_us:.0} us"
        ));
    }
    warnings.extend(room.warnings());
    Ok(CheckReport {
        points,
        extra_points: task.schedule.points.len() - points,
        frames,
        light_s: light_periods as f64 * task.geometry.raster.period_us * 1e-6,
        warnings,
        ..room.report()
    })
}
