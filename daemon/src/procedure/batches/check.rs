//! Predicts a run of batches, before anything moves.

use raysweep_config::{BatchesPlan, ConfigError};
use raysweep_processing::batches::DotTask;
use raysweep_proto::{BatchesCheck, CheckReport};
use raysweep_transport::dots::Correction;

use super::frame_buffers;
use crate::procedure::lab::Lab;
use crate::rig::Pace;

/// Disk space of a dot's column in bytes, without its residual: measured on rendered scenes with dots of 32 pixels.
const COLUMN_BYTES: u64 = 4600;
/// Batches in memory at once: two that wait for their indices, one under construction, some being written.
const BATCHES_IN_MEMORY: u64 = 8;
/// Disk space of report, calibration and everything else.
const OTHER_BYTES: u64 = 20_000_000;

/// Predicts a run of batches.
///
/// # Errors
/// For what the camera or a stage cannot do, and a flat field that cannot be read.
pub fn check(task: &DotTask, lab: &Lab<'_>, pace: Pace) -> Result<CheckReport, ConfigError> {
    let plan = &task.batches;
    lab.camera_at(plan.camera_rate_hz())
        .allows(&task.camera_settings())
        .map_err(|message| task.refuse(&["batches", "exposure_us"], format!("batches.{message}")))?;
    task.stage(&Correction::none(task.shape))?;
    task.earlier_flat_field(lab.data).map_err(|error| {
        task.refuse_stage("correct", "flat_field", format!("stage correct: flat_field: {error}"))
    })?;
    let planes: Vec<u32> = plan.calibration.iter().map(|plane| plane.batches).collect();
    let passes = planes.iter().copied().chain([plan.count]);
    let still: u32 = [plan.dark_frames, plan.flat_frames].map(|frames| plan.dark_rounds(frames)).iter().sum();
    let rounds: u32 = still + passes.map(BatchesPlan::rounds).sum::<u32>();
    let batch_s = plan.path.duration_s();
    let dots = u64::from(plan.dots);
    let frame_bytes = task.format.frame_bytes(task.shape.pixels()) as u64;
    let residual_bytes = 4 * task.shape.blocks() as u64;
    let batch_bytes = dots * (COLUMN_BYTES.min(5 * task.shape.pixels() as u64) + residual_bytes);
    let total = plan.total() as u64;
    let raw_bytes = if plan.keep_raw { u64::from(rounds) * dots * 2 * task.shape.pixels() as u64 } else { 0 };
    let image_bytes = 4 * task.shape.pixels() as u64;
    let mut warnings = Vec::new();
    if plan.calibration.is_empty() {
        warnings.push("no calibration plane: there will be no relit, separated or dual images; add [[batches.calibration]]".into());
    } else if plan.calibration.len() == 1 {
        warnings.push(
            "one calibration plane: an epipolar mask needs two depths; add a second [[batches.calibration]]"
                .into(),
        );
    }
    let room = lab.room(
        frame_buffers(task, pace) as u64 * frame_bytes
            + BATCHES_IN_MEMORY * batch_bytes
            + 16 * image_bytes
            + task.products_bytes()?,
        total * batch_bytes + task.products_disk_bytes() + raw_bytes + OTHER_BYTES,
    );
    Ok(CheckReport {
        points: plan.total(),
        frames: u64::from(rounds) * dots,
        light_s: f64::from(rounds) * batch_s,
        batches: Some(BatchesCheck {
            scene: plan.count,
            planes,
            dots: plan.dots,
            camera_rate_hz: plan.camera_rate_hz(),
            batch_s,
            dark_frames: plan.dark_frames,
            samples: task.path.points().len(),
            rate_hz: task.path.rate_hz(),
            raw_bytes_per_s: (plan.camera_rate_hz() * frame_bytes as f64) as u64,
            disk_bytes_per_batch: batch_bytes,
        }),
        warnings,
        ..room.report()
    })
}
