//! Progress and speed of a run.

use std::sync::Arc;
use std::time::Instant;

use raysweep_core::{Counts, PointUnderWay};
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
    /// The point that is being taken, if that takes long.
    pub under_way: Option<PointUnderWay>,
    planned: usize,
    /// Frame counts of this run.
    pub counts: Counts,
}

impl ProgressMeter {
    /// A run that begins now, with `stored_before` of `planned` points done.
    pub fn new(orders: &Arc<Orders>, stored_before: usize, planned: usize) -> Self {
        let (began, orders) = (Instant::now(), orders.clone());
        Self { began, orders, stored_before, stored: 0, under_way: None, planned, counts: Counts::default() }
    }

    /// Notes that a point was stored, with the counts of its frames.
    pub fn point_stored(&mut self, counts: &Counts) {
        self.stored += 1;
        self.under_way = None;
        self.counts.add(counts);
    }

    /// The progress so far, for display.
    pub fn shown(&self) -> Progress {
        let elapsed = self.began.elapsed();
        let elapsed_s = elapsed.as_secs_f64();
        let at_work_s = elapsed.saturating_sub(self.orders.paused()).as_secs_f64();
        let points_stored = self.stored_before + self.stored;
        let frames = self.counts.averaged + self.under_way.map_or(0, |point| u64::from(point.frames));
        let done = self.stored as f64 + self.under_way.map_or(0.0, PointUnderWay::share);
        let left = self.planned.saturating_sub(self.stored_before) as f64 - done;
        Progress {
            points_stored,
            points_planned: self.planned,
            under_way: self.under_way,
            counts: self.counts.clone(),
            elapsed_s,
            left_s: (done > 0.0).then(|| at_work_s / done * left.max(0.0)),
            frames_per_s: frames as f64 / at_work_s.max(1e-9),
        }
    }
}
