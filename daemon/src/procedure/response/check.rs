//! Predicts a plan of chirps, before anything moves.

use raysweep_config::ConfigError;
use raysweep_processing::response::{AXES, ResponseTask};
use raysweep_proto::{CheckReport, ResponseCheck};

use crate::devices::dots::FRAMES_AT_WORK;
use crate::procedure::lab::Lab;

/// Disk space of a frame's line in the records: three numbers, as text and as floats.
const LINE_BYTES: u64 = 96;
/// Disk space of report, spectra and everything else, in bytes.
const OTHER_BYTES: u64 = 2_000_000;
/// Memory for the summation of dark images, in bytes per pixel.
const DARK_BYTES: u64 = 64;

/// Predicts the run of the chirps.
///
/// # Errors
/// For what the camera cannot do.
pub fn check(task: &ResponseTask, lab: &Lab<'_>) -> Result<CheckReport, ConfigError> {
    let plan = &task.response;
    lab.camera_at(plan.camera_rate_hz)
        .allows(&task.camera_settings())
        .map_err(|message| task.refuse(&["response", "exposure_us"], format!("response.{message}")))?;
    let (frames, axes) = (task.frames() as u64, AXES.len());
    let frame_bytes = task.format.frame_bytes(task.shape.pixels()) as u64;
    let memory_bytes = FRAMES_AT_WORK as u64 * frame_bytes + DARK_BYTES * task.shape.pixels() as u64;
    let room = lab.room(memory_bytes, frames * axes as u64 * LINE_BYTES + OTHER_BYTES);
    Ok(CheckReport {
        points: axes,
        frames: frames * axes as u64 + u64::from(plan.dark_frames),
        light_s: axes as f64 * plan.duration_s(),
        response: Some(ResponseCheck {
            band_hz: plan.band_hz,
            amplitude_deg: plan.amplitude_deg,
            chirp_s: plan.chirp_s,
            rest_s: plan.rest_s,
            frames: task.frames(),
            camera_rate_hz: plan.camera_rate_hz,
            dark_frames: plan.dark_frames,
            samples: task.paths[0].points().len(),
            rate_hz: plan.rate_hz,
        }),
        ..room.report()
    })
}
