//! Predicts the camera's trigger times from the timestamps of its frames.

/// A trigger this far from a whole number of periods after the previous one does not come from the line.
const GATE_NS: i64 = 500_000;
/// This many of those in a row mean that the previous one was wrong instead.
const RELOCK_AFTER: u32 = 3;

/// Trigger times of the newest frames.
pub struct TriggerTimes {
    period_ns: i64,
    /// The newest frame with known settings, and its trigger time.
    newest: Option<(u64, i64)>,
    astray: u32,
}

impl TriggerTimes {
    /// Starts without known triggers.
    pub fn new(period_ns: i64) -> Self {
        Self { period_ns, newest: None, astray: 0 }
    }

    /// The nominal period.
    pub fn period_ns(&self) -> i64 {
        self.period_ns
    }

    /// The newest frame that the line triggered, and its trigger time.
    pub fn newest(&self) -> Option<(u64, i64)> {
        self.newest
    }

    /// Records the trigger of a frame.
    pub fn note(&mut self, seq: u64, trigger_ns: i64) {
        if self.off_ns(trigger_ns).is_some_and(|off_ns| off_ns > GATE_NS) && self.astray + 1 < RELOCK_AFTER {
            self.astray += 1;
        } else {
            (self.newest, self.astray) = (Some((seq, trigger_ns)), 0);
        }
    }

    /// Forgets the triggers, which are too old.
    pub fn forget(&mut self) {
        self.newest = None;
    }

    /// Distance of a time from a whole number of periods after the newest trigger.
    pub fn off_ns(&self, time_ns: i64) -> Option<i64> {
        let (_, trigger_ns) = self.newest?;
        let since_ns = (time_ns - trigger_ns).rem_euclid(self.period_ns);
        Some(since_ns.min(self.period_ns - since_ns))
    }

    /// The first time from `now_ns` on that lies within `window_ns` after a trigger.
    pub fn between_ns(&self, now_ns: i64, (from_ns, to_ns): (i64, i64)) -> i64 {
        let Some((_, trigger_ns)) = self.newest else { return now_ns };
        let since_ns = (now_ns - trigger_ns).rem_euclid(self.period_ns);
        if since_ns < from_ns {
            now_ns + from_ns - since_ns
        } else if since_ns > to_ns {
            now_ns + self.period_ns - since_ns + from_ns
        } else {
            now_ns
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_NS: i64 = 16_000_000;

    #[test]
    fn a_false_trigger_does_not_move_the_line_and_a_line_that_has_moved_is_found_again() {
        let mut triggers = TriggerTimes::new(PERIOD_NS);
        triggers.note(1, 0);
        triggers.note(2, 7_000_000);
        assert_eq!(triggers.newest(), Some((1, 0)));
        triggers.note(3, PERIOD_NS + 5_000);
        assert_eq!(triggers.newest(), Some((3, PERIOD_NS + 5_000)));
        for seq in 4..7 {
            triggers.note(seq, seq as i64 * PERIOD_NS + 3_000_000);
        }
        assert_eq!(triggers.newest(), Some((6, 6 * PERIOD_NS + 3_000_000)));
    }

    #[test]
    fn moments_are_placed_between_triggers() {
        let mut triggers = TriggerTimes::new(PERIOD_NS);
        assert_eq!(triggers.between_ns(123, (2_000_000, 15_000_000)), 123, "nothing is known");
        triggers.note(1, 1_000);
        let between =
            |since_ns: i64| triggers.between_ns(1_000 + 3 * PERIOD_NS + since_ns, (2_000_000, 15_000_000));
        let after = |since_ns: i64| 1_000 + 3 * PERIOD_NS + since_ns;
        assert_eq!(between(500_000), after(2_000_000));
        assert_eq!(between(9_000_000), after(9_000_000));
        assert_eq!(between(15_500_000), after(PERIOD_NS + 2_000_000));
    }
}
