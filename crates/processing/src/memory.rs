//! Estimates the memory that results need, and decides whether to make them in strips.

use raysweep_pipeline::{ProductSpec, rows_to_choose_by};
use raysweep_session::STRIP_ROWS;
use raysweep_transport::plane::{PlaneError, Setting, objectives_bytes, reach};

use crate::plane::PlaneTask;

/// Memory that the results of a task need.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MemoryNeed {
    /// With the whole stack and transport in memory.
    pub whole_bytes: u64,
    /// With a strip of camera rows at a time; for a film, whose cycles are small, the same as `whole_bytes`.
    pub strips_bytes: u64,
}

impl MemoryNeed {
    /// Estimates a sweep that makes `products`.
    ///
    /// # Errors
    /// When the plan gives no model on its rig.
    pub fn of_sweep(task: &PlaneTask, products: &[ProductSpec]) -> Result<Self, PlaneError> {
        let Solver { reach_rows, solver_bytes, pixels, .. } = Solver::of(task)?;
        let (geometry, channels) = (&task.geometry, task.mosaic.channels() as u64);
        let strip_px = (geometry.height.min(STRIP_ROWS) * geometry.width) as u64;
        // An upper bound for the rows of a strip and its halo.
        let chosen_by_px = (rows_to_choose_by(geometry.height).len() * geometry.width) as u64;
        // The stack twice while it is handed over or coupled, and the mask of valid pixels.
        let stack_bytes_per_px = 9 * task.schedule.points.len() as u64;
        // The transport and its copy for the disk.
        let transport_bytes_per_px = 8 * reach_rows;
        let images = products.iter().map(|product| product.images(geometry) as u64);
        // Each image once; the largest sequence twice more: as EXR channels and as the file's bytes; in colour, it is three
        // times as large, and its demosaiced copy comes to it.
        let largest = images.clone().max().unwrap_or(0);
        let copies = if channels > 1 { 3 * channels } else { 2 };
        let product_images = images.sum::<u64>() + copies * largest;
        let product_bytes = 4 * pixels * product_images;
        // Sums of the transport for the report, and single images that are read and pass through the stages.
        let shown_bytes = 4 * pixels * (5 + 5);
        Ok(Self {
            whole_bytes: pixels * (stack_bytes_per_px + transport_bytes_per_px)
                + product_bytes
                + solver_bytes,
            strips_bytes: chosen_by_px * stack_bytes_per_px
                + strip_px * transport_bytes_per_px
                + product_bytes
                + solver_bytes
                + shown_bytes,
        })
    }

    /// Estimates a film.
    ///
    /// # Errors
    /// When the plan gives no model on its rig.
    pub fn of_film(task: &PlaneTask) -> Result<Self, PlaneError> {
        let Solver { settings, reach_rows, solver_bytes, pixels } = Solver::of(task)?;
        // Frames and images of the cycles in progress, a stack and its mask, the transport and its copies for the
        // disk.
        let bytes = pixels * (80 * settings + 16 * reach_rows) + solver_bytes;
        Ok(Self { whole_bytes: bytes, strips_bytes: bytes })
    }

    /// Whether the results must be made in strips to stay within `available_bytes`.
    pub fn in_strips(&self, available_bytes: u64) -> bool {
        self.whole_bytes > available_bytes && self.strips_bytes < self.whole_bytes
    }

    /// Memory needed if `available_bytes` should not be exceeded.
    pub fn bytes(&self, available_bytes: u64) -> u64 {
        if self.in_strips(available_bytes) { self.strips_bytes } else { self.whole_bytes }
    }
}

/// The sizes that determine a solver's memory.
struct Solver {
    settings: u64,
    reach_rows: u64,
    solver_bytes: u64,
    pixels: u64,
}

impl Solver {
    fn of(task: &PlaneTask) -> Result<Self, PlaneError> {
        let geometry = &task.geometry;
        let settings: Vec<Setting> = task
            .settings()
            .map(|(_, point)| geometry.setting(&[point.delay_us], point.exposure_us))
            .collect();
        let reach_rows = reach(&geometry.timing()?, &settings)?.count() as u64;
        let threads = std::thread::available_parallelism().map_or(1, |threads| threads.get() as u64);
        let pixels = (geometry.height * geometry.width) as u64;
        let solver_bytes = objectives_bytes(reach_rows, threads);
        Ok(Self { settings: settings.len() as u64, reach_rows, solver_bytes, pixels })
    }
}

/// Memory that results may use: `limit_bytes`, or else what the system reports as available.
pub fn available_bytes(limit_bytes: Option<u64>) -> u64 {
    limit_bytes.or_else(free_bytes).unwrap_or(u64::MAX)
}

fn free_bytes() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/meminfo").ok()?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    let kilobytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kilobytes * 1024)
}
