//! Predicts a film, before anything moves.

use raysweep_config::ConfigError;
use raysweep_core::{CameraCapabilities, Readout};
use raysweep_pipeline::{PointRole, ProductSpec};
use raysweep_processing::film::FilmTask;
use raysweep_processing::memory::MemoryNeed;
use raysweep_proto::{CheckReport, FilmCheck};

use super::cycle::CyclePlan;
use crate::plane::foresight::Model;
use crate::procedure::lab::Lab;

/// Disk space of the report and other small files, in bytes.
const OTHER_BYTES: u64 = 10_000_000;

/// Disk space of a pixel of a product's image: float32 in its array and its EXR file, 8 bits in its picture and video; its
/// mask in an array of 8 bits and as float32 in the EXR file.
const BYTES_PER_PRODUCT_PIXEL: u64 = 4 + 4 + 1 + 1 + 1 + 4;

/// Predicts a film.
///
/// # Errors
/// When the plan gives no model on this rig.
pub fn check(film: &FilmTask, products: &[ProductSpec], lab: &Lab<'_>) -> Result<CheckReport, ConfigError> {
    let task = &*film.task;
    let model = Model::of(task, lab.camera, "film")?;
    let cycles = of_cycles(film, lab.camera, model.reach());
    let memory = MemoryNeed::of_film(task).map_err(|error| task.refuse(&["film"], error.to_string()))?;
    let minutes = film.points() as f64 / cycles.transports_per_s / 60.0;
    let channels = task.mosaic.channels() as u64;
    let image_bytes =
        (task.geometry.height * task.geometry.width) as u64 * channels * BYTES_PER_PRODUCT_PIXEL;
    let product_bytes = (products.len() * film.points()) as u64 * image_bytes;
    let disk_bytes = (cycles.disk_bytes_per_minute as f64 * minutes) as u64 + product_bytes + OTHER_BYTES;
    let room = lab.room(memory.bytes(lab.memory_free_bytes()), disk_bytes);
    let (mut dark_frames, mut dark_periods) = (0, 0);
    for (point, periods) in task.schedule.points.iter().zip(&model.periods) {
        if matches!(point.role, PointRole::Dark(_)) {
            dark_frames += u64::from(point.frames);
            dark_periods += periods * u64::from(point.frames);
        }
    }
    let settings = task.settings().count();
    let light_periods = dark_periods + cycles.cycles as u64 * u64::from(cycles.periods_per_cycle);
    let mut warnings = model.warnings(task);
    warnings.extend(products.iter().filter_map(|spec| spec.beyond(model.reach_rows)));
    warnings.extend(model.lamp_warning(task, None));
    warnings.extend(room.warnings());
    Ok(CheckReport {
        points: film.points(),
        extra_points: task.schedule.points.len() - settings,
        frames: dark_frames + (settings * film.points()) as u64,
        light_s: light_periods as f64 * task.geometry.raster.period_us * 1e-6,
        white_dn: Some(task.geometry.white_dn),
        reach_rows: Some(model.reach_rows),
        condition: Some(model.condition),
        film: Some(cycles),
        warnings,
        ..room.report()
    })
}

/// Predicts the cycles on this camera; `reach_rows` is the number of rows of the transports.
fn of_cycles(film: &FilmTask, camera: &CameraCapabilities, reach_rows: u64) -> FilmCheck {
    let geometry = &film.task.geometry;
    let CyclePlan { shots, order } = CyclePlan::new(&film.task, camera);
    let settings = shots.len();
    let periods = order.cycle_periods();
    let transports_per_s = 1e6 / (f64::from(periods) * geometry.raster.period_us);
    let pixels = (geometry.height * geometry.width) as f64;
    let bytes_per_cycle = pixels * (2.0 * settings as f64 + 5.0 * reach_rows as f64);
    let missed = periods.saturating_sub(settings as u32);
    let readout_us = camera.readout_us;
    let reason = match (missed, camera.readout) {
        (0, _) => "the camera answers every trigger".to_owned(),
        (1, Readout::Overlapped) => format!(
            "because of its readout of {readout_us:.0} us, the camera misses one trigger per cycle, where the delay jumps back: take smaller gaps between the delays, or fewer camera rows"
        ),
        _ => format!(
            "trigger delay, exposure and a readout of {readout_us:.0} us together are longer than a VSYNC period, which leaves {missed} triggers a cycle unanswered: fewer camera rows or a camera that overlaps readout and exposure would be faster"
        ),
    };
    FilmCheck {
        settings,
        cycles: film.points(),
        periods_per_cycle: periods,
        transports_per_s,
        disk_bytes_per_minute: (bytes_per_cycle * transports_per_s * 60.0) as u64,
        reason,
    }
}
