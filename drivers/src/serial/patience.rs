//! How long a device is waited for.

use std::time::{Duration, Instant};

/// Minimum number of looks before the wait is over.
const LOOKS: u32 = 16;

/// Time left to wait for a device, counted by the one who looks: of the time between two looks, no more counts than
/// would pass between [`LOOKS`]. A host that was too busy to look has not waited.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Patience {
    longest_look: Duration,
    left: Duration,
    looked: Instant,
}

impl Patience {
    pub fn new(time: Duration, now: Instant) -> Self {
        Self { longest_look: time / LOOKS, left: time, looked: now }
    }

    /// Whether the wait ends with this look; take it before looking, so that what arrived while the host stood still is
    /// not late.
    pub fn is_over(&mut self, now: Instant) -> bool {
        let passed = now.saturating_duration_since(self.looked).min(self.longest_look);
        (self.left, self.looked) = (self.left.saturating_sub(passed), now);
        self.left.is_zero()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_host_that_stands_still_spends_no_patience() {
        let began = Instant::now();
        let ms = |ms| began + Duration::from_millis(ms);
        let mut patience = Patience::new(Duration::from_millis(160), began);
        assert!(!patience.is_over(ms(100_000)));
        assert!((1..15).all(|look| !patience.is_over(ms(100_000 + 1000 * look))));
        assert!(patience.is_over(ms(115_000)));
    }

    #[test]
    fn who_looks_often_waits_for_the_time_stated() {
        let began = Instant::now();
        let mut patience = Patience::new(Duration::from_millis(160), began);
        let over = (1..).find(|&ms| patience.is_over(began + Duration::from_millis(ms)));
        assert_eq!(over, Some(160));
    }
}
