//! Orders given to a run from outside while it acquires.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// An order to a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// Acquire.
    Go,
    /// Pause before the next point.
    Pause,
    /// End cleanly; what was acquired is kept.
    Cancel,
    /// A device has failed: end cleanly.
    Fault,
}

/// The order in force, shared between the run's threads and those that give orders.
pub struct Orders {
    order: Mutex<Order>,
    changed: Condvar,
}

impl Default for Orders {
    fn default() -> Self {
        Self { order: Mutex::new(Order::Go), changed: Condvar::new() }
    }
}

impl Orders {
    fn lock(&self) -> MutexGuard<'_, Order> {
        self.order.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The order in force.
    pub fn now(&self) -> Order {
        *self.lock()
    }

    /// Whether acquisition continues, now or after a pause.
    pub fn go_on(&self) -> bool {
        matches!(self.now(), Order::Go | Order::Pause)
    }

    /// Gives an order. The first order to end is final.
    pub fn give(&self, order: Order) {
        let mut now = self.lock();
        if matches!(*now, Order::Go | Order::Pause) {
            *now = order;
            self.changed.notify_all();
        }
    }

    /// Waits for `time`, unless the run ends.
    pub fn rest(&self, time: Duration) {
        let ends = |now: &mut Order| matches!(now, Order::Go | Order::Pause);
        let _ = self.changed.wait_timeout_while(self.lock(), time, ends);
    }

    /// Waits while the order is to pause.
    pub fn wait_while_paused(&self) {
        let mut now = self.lock();
        while *now == Order::Pause {
            now = self.changed.wait(now).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::time::Instant;

    use super::*;

    #[test]
    fn a_rest_ends_with_the_run_and_not_with_a_pause() {
        let orders = Orders::default();
        std::thread::scope(|scope| {
            let resting = scope.spawn(|| orders.rest(Duration::from_secs(3600)));
            orders.give(Order::Pause);
            orders.give(Order::Cancel);
            resting.join().unwrap();
        });
        let orders = Orders::default();
        orders.give(Order::Pause);
        let began = Instant::now();
        orders.rest(Duration::from_millis(20));
        assert!(began.elapsed() >= Duration::from_millis(20));
    }
}
