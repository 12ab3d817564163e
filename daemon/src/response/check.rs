//! What a plan of chirps would do, before anything moves.

use std::path::Path;

use raysweep_core::CameraCapabilities;
use raysweep_proto::{CheckReport, ResponseCheck};

use super::{AXES, ResponseTask};
use crate::config::ConfigError;
use crate::dots::free_bytes;
use crate::memory::available_bytes;
use crate::run::FRAMES_AT_WORK;

/// Bytes of a frame's line in the records: three numbers, as text and as floats.
const LINE_BYTES: u64 = 96;
/// Report, spectra and everything else.
const OTHER_BYTES: u64 = 2_000_000;
/// Images without light that are summed at once, in bytes a pixel.
const DARK_BYTES: u64 = 64;

/// Foresees a task whose session will lie in `data`; `text` is its plan's.
///
/// # Errors
/// For what the camera cannot do.
pub(crate) fn check(
    task: &ResponseTask,
    text: &str,
    camera: &CameraCapabilities,
    data: &Path,
    memory_limit_bytes: Option<u64>,
) -> Result<CheckReport, ConfigError> {
    camera.allows(&task.camera_settings()).map_err(|message| {
        ConfigError::at(text, &["response", "exposure_us"], format!("response.{message}"))
    })?;
    let plan = task.response();
    let (frames, axes) = (task.frames() as u64, AXES.len());
    let frame_bytes = task.format.frame_bytes(task.shape.pixels()) as u64;
    Ok(CheckReport {
        points: axes,
        extra_points: 0,
        frames: frames * axes as u64 + u64::from(plan.dark_frames),
        light_s: axes as f64 * plan.duration_s(),
        memory_bytes: FRAMES_AT_WORK as u64 * frame_bytes + DARK_BYTES * task.shape.pixels() as u64,
        memory_free_bytes: available_bytes(memory_limit_bytes),
        disk_bytes: frames * axes as u64 * LINE_BYTES + OTHER_BYTES,
        disk_free_bytes: free_bytes(data),
        reach_rows: (0, 0),
        condition: 1.0,
        advice: None,
        film: None,
        batches: None,
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
        warnings: Vec::new(),
    })
}
