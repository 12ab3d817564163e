//! What the run is told from outside while it acquires.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

/// The latest word.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// Acquire.
    Go,
    /// Hold before the next point.
    Pause,
    /// End in order; what was acquired is kept.
    Cancel,
    /// A device has failed: end in order.
    Fault,
}

/// The order in force, shared between the run's threads and whoever gives it.
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

    /// Whether acquisition goes on, now or after a pause.
    pub fn go_on(&self) -> bool {
        matches!(self.now(), Order::Go | Order::Pause)
    }

    /// Gives an order. The first order to end stands: nothing makes an ending run go on.
    pub fn give(&self, order: Order) {
        let mut now = self.lock();
        if matches!(*now, Order::Go | Order::Pause) {
            *now = order;
            self.changed.notify_all();
        }
    }

    /// Waits for a while, unless the run ends.
    pub fn rest(&self, time: Duration) {
        let ends = |now: &mut Order| matches!(now, Order::Go | Order::Pause);
        let _ = self.changed.wait_timeout_while(self.lock(), time, ends);
    }

    /// Waits until the order is no longer to pause.
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
