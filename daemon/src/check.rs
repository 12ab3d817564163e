//! What a plan would do, before anything moves.

use std::path::Path;

use raysweep_core::CameraCapabilities;
use raysweep_pipeline::{DemuxFold, Point, ProductSpec, Role};
use raysweep_proto::{CheckReport, FilmCheck};
use raysweep_session::{STRIP_ROWS, durable};

use crate::config::ConfigError;
use crate::film;
use crate::memory::{MemoryNeed, available_bytes};
use crate::processing::Task;

/// Condition number from which on noise is amplified more than the prior can hold.
const ILL_CONDITIONED: f64 = 1e9;

/// Foresees a task that makes `products` and whose session will lie in `data`; its results may take so much memory, or
/// what is free.
///
/// # Errors
/// When the plan makes no model on this rig.
pub fn check(
    task: &Task,
    products: &[ProductSpec],
    camera: &CameraCapabilities,
    data: &Path,
    memory_limit_bytes: Option<u64>,
) -> Result<CheckReport, ConfigError> {
    let no_model = |message: String| ConfigError { message, field: Some("sweep".into()), span: None };
    let options = task.demux_options()?;
    let geometry = &task.geometry;
    let demux = DemuxFold::new(options, &task.schedule, geometry)
        .map_err(|error| no_model(error.to_string()))?
        .demux()
        .map_err(|error| no_model(error.to_string()))?;
    let condition = demux.condition(geometry.height / 2).map_err(|error| no_model(error.to_string()))?;
    let reach = demux.reach();

    let points = task.points();
    let planned = task.schedule.points.iter().map(|point| (point, times_taken(task, point)));
    let frames: u64 = planned.clone().map(|(point, times)| times * u64::from(point.frames)).sum();
    let pixels = (geometry.height * geometry.width) as u64;
    let reach_rows = reach.clone().count() as u64;
    let memory = MemoryNeed::of(task, products).map_err(|error| no_model(error.to_string()))?;
    let memory_free_bytes = available_bytes(memory_limit_bytes);
    let memory_bytes = memory.bytes(memory_free_bytes);
    let files = 2 * products.iter().map(|product| product.images(geometry) as u64).sum::<u64>();
    let mut disk_bytes =
        pixels * 4 * (task.schedule.points.len() as u64 + 2 * reach_rows + files) + 10_000_000;
    let existing = data.ancestors().find(|folder| folder.exists()).unwrap_or(Path::new("/"));
    let disk_free_bytes = durable::available_bytes(existing).unwrap_or(u64::MAX);

    for point in &task.schedule.points {
        let shot = geometry.shot(point, camera.trigger_latency_us);
        camera.allows(&shot.settings).map_err(no_model)?;
    }

    let mut warnings = Vec::new();
    let film = task.is_film().then(|| film::check(task, camera, reach_rows));
    if let Some(film) = &film {
        let minutes = points as f64 / film.transports_per_s / 60.0;
        disk_bytes = (film.disk_bytes_per_minute as f64 * minutes) as u64 + 10_000_000;
    }
    let periods: Vec<u64> = task.schedule.points.iter().map(|point| periods(task, camera, point)).collect();
    let slow = periods.iter().filter(|&&periods| periods > 1).count();
    if slow > 0 && film.is_none() {
        warnings.push(format!(
            "{slow} of {} points take more than one VSYNC period a frame, because trigger delay, exposure and readout together are longer: a faster or overlapped readout would save time",
            periods.len()
        ));
    }
    if film.is_none() && points < reach_rows as usize / 8 {
        warnings.push(format!(
            "{points} points for {reach_rows} rows: expect smooth profiles only; take more delays"
        ));
    }
    if condition > ILL_CONDITIONED {
        warnings
            .push(format!("condition number {condition:.1e}: raise alpha or take delays that overlap more"));
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
            "a pixel saturates at {headroom:.2} of a white one over {brightest_rows:.0} rows: lower camera.white_dn (gain, aperture) to leave room for indirect light"
        ));
    }
    if memory.in_strips(memory_free_bytes) {
        warnings.push(format!(
            "{} MB of memory would be needed to solve the sweep in one piece and {} MB may be used: it is solved {STRIP_ROWS} camera rows at a time, after its end, without live estimates; the results are the same",
            memory.whole_bytes / 1_000_000,
            memory_free_bytes / 1_000_000
        ));
    }
    for (what, needed, free) in
        [("memory", memory_bytes, memory_free_bytes), ("disk", disk_bytes, disk_free_bytes)]
    {
        if needed > free {
            let (needed, free) = (needed / 1_000_000, free / 1_000_000);
            warnings.push(format!(
                "{needed} MB of {what} are needed and {free} MB are free: the run would be refused"
            ));
        }
    }
    Ok(CheckReport {
        points,
        extra_points: task.schedule.points.len() - task.settings().count(),
        frames,
        light_s: light_periods(&periods, task, film.as_ref()) as f64 * geometry.raster.period_us * 1e-6,
        memory_bytes,
        memory_free_bytes,
        disk_bytes,
        disk_free_bytes,
        reach_rows: (*reach.start(), *reach.end()),
        // JSON has no infinity.
        condition: condition.min(f64::MAX),
        // Worked out on request alone: a run must not wait for it.
        advice: None,
        film,
        batches: None,
        response: None,
        warnings,
    })
}

/// How often a point is taken where nothing goes wrong: those of a film's cycle once a cycle.
fn times_taken(task: &Task, point: &Point) -> u64 {
    let in_cycle = task.is_film() && matches!(point.role, Role::Sweep(_));
    if in_cycle { task.points() as u64 } else { 1 }
}

/// VSYNC periods of the whole run, at `periods` a frame of each point.
fn light_periods(periods: &[u64], task: &Task, film: Option<&FilmCheck>) -> u64 {
    let points = periods.iter().zip(&task.schedule.points);
    match film {
        Some(film) => {
            let dark = points.filter(|(_, point)| matches!(point.role, Role::Dark(_)));
            let dark: u64 = dark.map(|(n, point)| n * u64::from(point.frames)).sum();
            dark + film.cycles as u64 * u64::from(film.periods_per_cycle)
        }
        None => points.map(|(n, point)| n * u64::from(point.frames)).sum(),
    }
}

/// VSYNC periods that each frame of a point takes.
pub(crate) fn periods(task: &Task, camera: &CameraCapabilities, point: &Point) -> u64 {
    let shot = task.geometry.shot(point, camera.trigger_latency_us);
    u64::from(camera.periods_per_frame(&shot.settings, task.geometry.raster.period_us))
}
