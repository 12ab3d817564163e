//! Frame ids that never wrap, and the start of a frame's exposure.

use std::collections::VecDeque;

use raysweep_core::ns_from_us;

use super::node::{
    FLAG_CLOCK_MASK, FLAG_CLOCK_MONOTONIC, FLAG_MOMENT_MASK, FLAG_MOMENT_START_OF_EXPOSURE, Filled,
};

/// Converts the kernel's 32-bit count to an id that increases for as long as the camera object lives.
#[derive(Debug, Default)]
pub(super) struct Ids {
    newest: Option<u64>,
    /// The kernel's count of the newest frame of this stream.
    count: Option<u32>,
}

impl Ids {
    /// Begins a stream, whose count is unrelated to earlier frames. Its first frame gets the id `first`.
    pub(super) fn stream_begins(&mut self, first: u64) {
        self.newest = first.checked_sub(1);
        self.count = None;
    }

    /// The id of the frame after the newest.
    pub(super) fn next(&self) -> u64 {
        self.newest.map_or(0, |newest| newest + 1)
    }

    /// The id of a frame of this stream.
    pub(super) fn take(&mut self, count: u32) -> u64 {
        let since = self.count.map_or(1, |last| count.wrapping_sub(last));
        // A driver that does not count, or restarts its count, gives no information about gaps.
        let since = if since == 0 || since > u32::MAX / 2 { 1 } else { since };
        let id = self.next() + u64::from(since - 1);
        self.count = Some(count);
        self.newest = Some(id);
        id
    }
}

/// The exposure time of each frame: settings are written while earlier frames are still pending.
#[derive(Debug)]
pub(super) struct ExposureTimes(VecDeque<(u64, f64)>);

impl ExposureTimes {
    pub(super) fn new(exposure_us: f64) -> Self {
        Self([(0, exposure_us)].into())
    }

    /// Sets the exposure from the first frame that is certain to have it.
    pub(super) fn set(&mut self, first_frame: u64, exposure_us: f64) {
        self.0.push_back((first_frame, exposure_us));
    }

    /// The exposure of a frame; must be called in the order of ids.
    pub(super) fn of(&mut self, id: u64) -> f64 {
        while self.0.get(1).is_some_and(|(first_frame, _)| *first_frame <= id) {
            self.0.pop_front();
        }
        self.0.front().map_or(0.0, |(_, exposure_us)| *exposure_us)
    }
}

/// Start of the exposure of row 0 on the host's clock, as exactly as the timestamp's flags allow: a frame ends when
/// its last row, which starts `readout_us` less one row after the first, is exposed and read.
pub(super) fn exposure_start_ns(filled: &Filled, exposure_us: f64, readout_us: f64, dequeued_ns: i64) -> i64 {
    let whole_frame_ns = ns_from_us(exposure_us + readout_us);
    if !is_monotonic(filled) {
        return dequeued_ns - whole_frame_ns;
    }
    match filled.flags & FLAG_MOMENT_MASK {
        FLAG_MOMENT_START_OF_EXPOSURE => filled.timestamp_ns,
        _ => filled.timestamp_ns - whole_frame_ns,
    }
}

/// Whether the timestamp is on the host's clock.
pub(super) fn is_monotonic(filled: &Filled) -> bool {
    filled.flags & FLAG_CLOCK_MASK == FLAG_CLOCK_MONOTONIC
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_rise_over_wraps_gaps_and_streams() {
        let mut ids = Ids::default();
        let taken: Vec<u64> =
            [0xFFFF_FF80, 0xFFFF_FF81, 0xFFFF_FFFF, 0, 3].into_iter().map(|count| ids.take(count)).collect();
        assert_eq!(taken, [0, 1, 127, 128, 131]);
        ids.stream_begins(ids.next());
        assert_eq!((ids.next(), ids.take(7), ids.take(8)), (132, 132, 133));
        // A driver that never counts.
        assert_eq!((ids.take(8), ids.take(8), ids.take(2)), (134, 135, 136));
        ids.stream_begins(0);
        assert_eq!(ids.take(9), 0);
    }

    #[test]
    fn frames_on_their_way_keep_the_exposure_before() {
        let mut exposures = ExposureTimes::new(100.0);
        exposures.set(5, 200.0);
        exposures.set(7, 300.0);
        let of: Vec<f64> = [3, 4, 5, 6, 9].into_iter().map(|id| exposures.of(id)).collect();
        assert_eq!(of, [100.0, 100.0, 200.0, 200.0, 300.0]);
    }

    #[test]
    fn stamps_mean_what_their_flags_say() {
        let start = |flags| {
            let filled = Filled { index: 0, bytes_used: 0, flags, timestamp_ns: 50_000_000, sequence: 0 };
            exposure_start_ns(&filled, 900.0, 16_000.0, 52_000_000)
        };
        assert_eq!(start(0x1_2000), 50_000_000, "monotonic, start of exposure");
        assert_eq!(start(0x2000), 33_100_000, "monotonic, end of frame");
        assert_eq!(start(0), 35_100_000, "unknown clock");
        assert_eq!(start(0x1_4000), 35_100_000, "copied from elsewhere");
    }
}
