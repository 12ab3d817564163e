//! How long a device is waited for.

use std::time::{Duration, Instant};

/// Minimum number of looks before a timeout is over.
const LOOKS: u32 = 16;

/// A timeout of which each look uses up little, so that a host that stands still or is busy does not use it up.
#[derive(Debug)]
pub(crate) struct Timeout {
    most_per_look: Duration,
    left: Duration,
    looked: Instant,
}

impl Timeout {
    /// A timeout that begins `now`, of which a look uses up at most `look`: the longest time between looks of a host that
    /// is not busy. With 18 runnable threads on 2 processors, the kernel's workers, through which a serial line's bytes
    /// pass, were seen to wait for half a second.
    pub fn new(time: Duration, look: Duration, now: Instant) -> Self {
        let most_per_look = (time / LOOKS).min(look).max(Duration::from_nanos(1));
        Self { most_per_look, left: time, looked: now }
    }

    /// Whether the timeout is over with this look. Call it before looking: what arrived while the host stood still is
    /// not late.
    pub fn look(&mut self, now: Instant) -> bool {
        let passed = now.saturating_duration_since(self.looked).min(self.most_per_look);
        (self.left, self.looked) = (self.left.saturating_sub(passed), now);
        self.left.is_zero()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_host_that_stands_still_does_not_use_it_up() {
        let began = Instant::now();
        let ms = |ms| began + Duration::from_millis(ms);
        let over_after = |timeout_ms| {
            let mut timeout =
                Timeout::new(Duration::from_millis(timeout_ms), Duration::from_millis(2), began);
            (1..).find(|look| timeout.look(ms(1000 * look)))
        };
        assert_eq!([16, 300].map(over_after), [Some(16), Some(150)]);
    }

    #[test]
    fn who_looks_often_waits_for_the_time_stated() {
        let began = Instant::now();
        let mut timeout = Timeout::new(Duration::from_millis(160), Duration::from_millis(2), began);
        let over = (1..).find(|&ms| timeout.look(began + Duration::from_millis(ms)));
        assert_eq!(over, Some(160));
    }
}
