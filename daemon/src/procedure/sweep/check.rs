//! Predicts a sweep, before anything moves.

use raysweep_config::ConfigError;
use raysweep_core::Size;
use raysweep_pipeline::ProductSpec;
use raysweep_processing::memory::MemoryNeed;
use raysweep_processing::sweep::SweepTask;
use raysweep_proto::CheckReport;
use raysweep_session::STRIP_ROWS;

use crate::plane::foresight::Model;
use crate::procedure::lab::Lab;

/// Disk space of the report and other small files, in bytes.
const OTHER_BYTES: u64 = 10_000_000;

/// Predicts a sweep that makes `products`.
///
/// # Errors
/// When the plan gives no model on this rig.
pub fn check(sweep: &SweepTask, products: &[ProductSpec], lab: &Lab<'_>) -> Result<CheckReport, ConfigError> {
    let task = &*sweep.task;
    let geometry = &task.geometry;
    let model = Model::of(task, lab.camera, "sweep")?;
    let memory =
        MemoryNeed::of_sweep(task, products).map_err(|error| task.refuse(&["sweep"], error.to_string()))?;
    let memory_free_bytes = lab.memory_free_bytes();
    let pixels = (geometry.height * geometry.width) as u64;
    let channels = task.mosaic.channels() as u64;
    let files = 2 * channels * products.iter().map(|product| product.images(geometry) as u64).sum::<u64>();
    let images = task.schedule.points.len() as u64 + 2 * model.reach() + files;
    let room = lab.room(memory.bytes(memory_free_bytes), pixels * 4 * images + OTHER_BYTES);

    let (points, frames) =
        (sweep.points(), || task.schedule.points.iter().map(|point| u64::from(point.frames)));
    let mut warnings = Vec::new();
    let slow = model.periods.iter().filter(|&&periods| periods > 1).count();
    if slow > 0 {
        warnings.push(format!(
            "{slow} of {} points take more than one VSYNC period per frame, because trigger delay, exposure and readout together are longer: a faster or overlapped readout would save time",
            model.periods.len()
        ));
    }
    if points < model.reach() as usize / 8 {
        warnings.push(format!(
            "{points} points for {} rows: expect smooth profiles only; take more delays",
            model.reach()
        ));
    }
    warnings.extend(products.iter().filter_map(|spec| spec.beyond(model.reach_rows)));
    warnings.extend(model.warnings(task));
    warnings.extend(model.lamp_warning(task, Some("sweep.average")));
    if memory.in_strips(memory_free_bytes) {
        warnings.push(format!(
            "{} of memory would be needed to solve the sweep in one piece and {} may be used: it is solved {STRIP_ROWS} camera rows at a time, after its end, without live estimates; the results are the same",
            Size(memory.whole_bytes),
            Size(memory_free_bytes)
        ));
    }
    warnings.extend(room.warnings());
    let light_periods: u64 =
        model.periods.iter().zip(frames()).map(|(periods, frames)| periods * frames).sum();
    Ok(CheckReport {
        points,
        extra_points: task.schedule.points.len() - points,
        frames: frames().sum(),
        light_s: light_periods as f64 * geometry.raster.period_us * 1e-6,
        white_dn: Some(geometry.white_dn),
        reach_rows: Some(model.reach_rows),
        condition: Some(model.condition),
        warnings,
        ..room.report()
    })
}
