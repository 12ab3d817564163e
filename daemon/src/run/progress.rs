//! Progress and speed of a run.

use std::sync::Arc;
use std::time::Instant;

use raysweep_core::Counts;
use raysweep_proto::Progress;

use super::orders::Orders;

/// Measures a run's progress.
pub struct ProgressMeter {
    began: Instant,
    /// These know for how long the run was paused, which says nothing of its pace.
    orders: Arc<Orders>,
    stored_before: usize,
    /// Points stored in this run.
    pub stored: usize,
    planned: usize,
    /// Frame counts of this run.
    pub counts: Counts,
}

impl ProgressMeter {
    /// A run that begins now, with `stored_before` of `planned` points done.
    pub fn new(orders: &Arc<Orders>, stored_before: usize, planned: usize) -> Self {
        let (began, orders) = (Instant::now(), orders.clone());
        Self { began, orders, stored_before, stored: 0, planned, counts: Counts::default() }
    }

    /// The progress so far, for display.
    pub fn shown(&self) -> Progress {
        let elapsed = self.began.elapsed();
        let elapsed_s = elapsed.as_secs_f64();
        let at_work_s = elapsed.saturating_sub(self.orders.paused()).as_secs_f64();
        let left = self.planned.saturating_sub(self.stored_before + self.stored);
        Progress {
            points_stored: self.stored_before + self.stored,
            points_planned: self.planned,
            counts: self.counts.clone(),
            elapsed_s,
            left_s: (self.stored > 0).then(|| at_work_s / self.stored as f64 * left as f64),
            frames_per_s: self.counts.averaged as f64 / at_work_s.max(1e-9),
        }
    }
}
