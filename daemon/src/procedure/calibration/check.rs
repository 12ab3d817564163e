//! Predicts a calibration, before anything moves.

use raysweep_config::ConfigError;
use raysweep_processing::calibration::{BoardPurpose, CalibrationTask};
use raysweep_proto::CheckReport;

use crate::plane::foresight::periods;
use crate::procedure::lab::Lab;

/// Disk space of calibration, report and other small files, beside that of the images.
const OTHER_BYTES: u64 = 10_000_000;
/// Bytes per pixel of `calibration.npz`.
const CALIBRATION_BYTES_PER_PX: u64 = 100;
/// Images in memory at once, beside the frames: fits, maps and responses, in bytes per pixel.
const MAPS_BYTES_PER_PX: u64 = 400;

/// Predicts a calibration.
///
/// # Errors
/// For settings that the camera does not support.
pub fn check(calibration: &CalibrationTask, lab: &Lab<'_>) -> Result<CheckReport, ConfigError> {
    let task = &*calibration.task;
    let (mut frames, mut light_periods) = (0, 0);
    for (ordinal, point) in (0..).zip(&task.schedule.points) {
        let shot = task.geometry.shot(point, lab.camera.trigger_latency_us);
        lab.camera.allows(&shot.settings).map_err(|message| match calibration.purpose(ordinal) {
            BoardPurpose::Passes(_) | BoardPurpose::Saturated => {
                let passes = calibration.calibration.passes;
                let cure = "take calibration.passes = 2, or 0: the camera is then taken as linear";
                let message = format!("calibration.passes = {passes}: {message}; {cure}");
                task.refuse(&["calibration", "passes"], message)
            }
            _ => task.refuse(&["calibration"], message),
        })?;
        frames += u64::from(point.frames);
        if !matches!(calibration.purpose(ordinal), BoardPurpose::Capped(_)) {
            light_periods += u64::from(point.frames) * periods(task, lab.camera, point);
        }
    }
    let pixels = (task.geometry.height * task.geometry.width) as u64;
    let images = task.schedule.points.len() as u64;
    // Frames of the capped lens and of the greys are in memory together, with 4 bytes a pixel.
    let memory_bytes = pixels * (MAPS_BYTES_PER_PX + 4 * images);
    let disk_bytes = pixels * (4 * images + CALIBRATION_BYTES_PER_PX) + OTHER_BYTES;
    let room = lab.room(memory_bytes, disk_bytes);
    Ok(CheckReport {
        points: calibration.points(),
        extra_points: task.schedule.dark_len(),
        frames,
        light_s: light_periods as f64 * task.geometry.raster.period_us * 1e-6,
        warnings: room.warnings(),
        ..room.report()
    })
}
