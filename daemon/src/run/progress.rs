//! Progress and speed of a run.

use std::time::Instant;

use raysweep_core::Counts;
use raysweep_proto::Progress;

/// Measures a run's progress.
pub struct ProgressMeter {
    began: Instant,
    stored_before: usize,
    /// Points stored in this run.
    pub stored: usize,
    planned: usize,
    /// Frame counts of this run.
    pub counts: Counts,
}

impl ProgressMeter {
    /// A run that begins now, with `stored_before` of `planned` points done.
    pub fn new(stored_before: usize, planned: usize) -> Self {
        Self { began: Instant::now(), stored_before, stored: 0, planned, counts: Counts::default() }
    }

    /// The progress so far, for display.
    pub fn shown(&self) -> Progress {
        let elapsed_s = self.began.elapsed().as_secs_f64();
        let left = self.planned.saturating_sub(self.stored_before + self.stored);
        Progress {
            points_stored: self.stored_before + self.stored,
            points_planned: self.planned,
            counts: self.counts.clone(),
            elapsed_s,
            left_s: (self.stored > 0).then(|| elapsed_s / self.stored as f64 * left as f64),
            frames_per_s: self.counts.averaged as f64 / elapsed_s.max(1e-9),
        }
    }
}
