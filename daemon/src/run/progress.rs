//! Progress and speed of a run.

use std::sync::Arc;
use std::time::{Duration, Instant};

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
        self.shown_after(self.began.elapsed(), self.orders.paused())
    }

    /// The progress after this time, of which the run was paused for a part.
    fn shown_after(&self, elapsed: Duration, paused: Duration) -> Progress {
        let elapsed_s = elapsed.as_secs_f64();
        let at_work_s = elapsed.saturating_sub(paused).as_secs_f64();
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

#[cfg(test)]
mod tests {
    use super::*;

    /// A meter of 12 points, of which 2 were stored before and 4 have been since, with 10 frames each.
    fn meter() -> ProgressMeter {
        let mut meter = ProgressMeter::new(&Arc::default(), 2, 12);
        (0..4).for_each(|_| meter.point_stored(&Counts { averaged: 10, ..Counts::default() }));
        meter
    }

    fn shown(meter: &ProgressMeter, elapsed_s: u64, paused_s: u64) -> (f64, f64, Option<f64>) {
        let shown = meter.shown_after(Duration::from_secs(elapsed_s), Duration::from_secs(paused_s));
        (shown.elapsed_s, shown.frames_per_s, shown.left_s)
    }

    #[test]
    fn a_pause_is_no_sign_of_a_slow_run() {
        assert_eq!(shown(&meter(), 8, 0), (8.0, 5.0, Some(12.0)));
        assert_eq!(shown(&meter(), 108, 100), (108.0, 5.0, Some(12.0)));
    }

    #[test]
    fn the_frames_of_a_point_under_way_count_for_rate_and_time_left() {
        let mut meter = meter();
        meter.under_way = Some(PointUnderWay { frames: 5, of: 10 });
        // 4.5 points of 10 frames in 9 s: 5.5 are left.
        assert_eq!(shown(&meter, 9, 0), (9.0, 5.0, Some(11.0)));
        // A point that is stored is not under way any more.
        meter.point_stored(&Counts { averaged: 10, ..Counts::default() });
        assert_eq!(shown(&meter, 10, 0), (10.0, 5.0, Some(10.0)));
    }

    #[test]
    fn the_first_point_tells_the_time_left_before_it_is_stored() {
        let mut meter = ProgressMeter::new(&Arc::default(), 2, 12);
        assert_eq!(shown(&meter, 100, 97), (100.0, 0.0, None));
        meter.under_way = Some(PointUnderWay { frames: 250, of: 1000 });
        assert_eq!(shown(&meter, 102, 97), (102.0, 50.0, Some(195.0)));
    }
}
