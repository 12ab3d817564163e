//! Orders given to a run from outside while it acquires.

use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use super::look::WantedLook;

/// An order to a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Order {
    /// Acquire.
    Go,
    /// Pause before the next point, or at once where a mirror moves.
    Pause,
    /// End cleanly; what was acquired is kept.
    Cancel,
    /// A device has failed: end cleanly.
    Fault,
}

/// The order in force, shared between the run's threads and those that give orders.
pub struct Orders {
    given: Mutex<Given>,
    changed: Condvar,
    /// What a viewfinder is to show.
    pub look: WantedLook,
}

/// One of the pauses of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pause(u64);

/// The order in force, and the pauses so far.
struct Given {
    order: Order,
    /// The newest pause.
    pause: Pause,
    /// When the present pause began.
    paused_since: Option<Instant>,
    /// Length of the pauses that are over.
    paused: Duration,
}

impl Default for Orders {
    fn default() -> Self {
        let (order, pause) = (Order::Go, Pause(0));
        let given = Given { order, pause, paused_since: None, paused: Duration::ZERO };
        Self { given: Mutex::new(given), changed: Condvar::new(), look: WantedLook::default() }
    }
}

impl Orders {
    fn lock(&self) -> MutexGuard<'_, Given> {
        self.given.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The order in force.
    pub fn now(&self) -> Order {
        self.lock().order
    }

    /// How long the run has been told to pause, in all.
    pub fn paused(&self) -> Duration {
        let given = self.lock();
        given.paused + given.paused_since.map_or(Duration::ZERO, |since| since.elapsed())
    }

    /// Whether acquisition continues, now or after a pause.
    pub fn go_on(&self) -> bool {
        matches!(self.now(), Order::Go | Order::Pause)
    }

    /// Gives an order. The first order to end is final.
    pub fn give(&self, order: Order) {
        self.give_with(&mut self.lock(), order);
    }

    fn give_with(&self, given: &mut Given, order: Order) {
        if matches!(given.order, Order::Go | Order::Pause) {
            if (given.order, order) == (Order::Go, Order::Pause) {
                given.pause.0 += 1;
            }
            given.order = order;
            if order == Order::Pause {
                given.paused_since.get_or_insert_with(Instant::now);
            } else if let Some(since) = given.paused_since.take() {
                given.paused += since.elapsed();
            }
            self.changed.notify_all();
        }
    }

    /// Pauses a run that goes on; `None` if it is paused already, or ends.
    pub fn pause(&self) -> Option<Pause> {
        let mut given = self.lock();
        let goes_on = given.order == Order::Go;
        self.give_with(&mut given, Order::Pause);
        goes_on.then_some(given.pause)
    }

    /// Ends this pause, and no later one, if `goes_on` says that the run may go on; returns whether it does.
    pub fn end_pause(&self, pause: Pause, goes_on: impl FnOnce() -> bool) -> bool {
        let mut given = self.lock();
        let ends = given.order == Order::Pause && given.pause == pause && goes_on();
        if ends {
            self.give_with(&mut given, Order::Go);
        }
        ends
    }

    /// Waits for `time`, unless the run ends.
    pub fn rest(&self, time: Duration) {
        let ends = |given: &mut Given| matches!(given.order, Order::Go | Order::Pause);
        let _ = self.changed.wait_timeout_while(self.lock(), time, ends);
    }

    /// Waits while the order is to pause.
    pub fn wait_while_paused(&self) {
        self.wait_while_paused_until(None);
    }

    /// Waits while the order is to pause, until this moment at most.
    pub fn wait_while_paused_until(&self, end: Option<Instant>) {
        let mut given = self.lock();
        while given.order == Order::Pause {
            let left = end.map(|end| end.saturating_duration_since(Instant::now()));
            given = match left {
                Some(Duration::ZERO) => return,
                Some(left) => {
                    self.changed.wait_timeout(given, left).unwrap_or_else(PoisonError::into_inner).0
                }
                None => self.changed.wait(given).unwrap_or_else(PoisonError::into_inner),
            };
        }
    }
}

#[cfg(test)]
mod tests {
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

    #[test]
    fn a_pause_is_waited_for_until_a_moment_at_most() {
        let orders = Orders::default();
        orders.give(Order::Pause);
        orders.wait_while_paused_until(Some(Instant::now() + Duration::from_millis(20)));
        assert_eq!(orders.now(), Order::Pause);
        orders.wait_while_paused_until(Some(Instant::now()));
        std::thread::scope(|scope| {
            let waiting = scope
                .spawn(|| orders.wait_while_paused_until(Some(Instant::now() + Duration::from_secs(3600))));
            orders.give(Order::Go);
            waiting.join().unwrap();
        });
    }

    #[test]
    fn a_pause_is_ended_by_whoever_began_it_and_no_other_is() {
        let orders = Orders::default();
        let first = orders.pause().unwrap();
        assert_eq!(orders.pause(), None);
        assert!(!orders.end_pause(first, || false));
        assert_eq!(orders.now(), Order::Pause);
        // Somebody continues, and pauses again.
        orders.give(Order::Go);
        orders.give(Order::Pause);
        assert!(!orders.end_pause(first, || true));
        assert_eq!(orders.now(), Order::Pause);
        orders.give(Order::Go);
        let second = orders.pause().unwrap();
        assert!(orders.end_pause(second, || true));
        assert_eq!(orders.now(), Order::Go);
    }

    #[test]
    fn pauses_add_up_and_end_with_the_next_order() {
        let orders = Orders::default();
        assert_eq!(orders.paused(), Duration::ZERO);
        orders.give(Order::Pause);
        std::thread::sleep(Duration::from_millis(20));
        assert!(orders.paused() >= Duration::from_millis(20));
        orders.give(Order::Go);
        let first = orders.paused();
        std::thread::sleep(Duration::from_millis(5));
        assert_eq!(orders.paused(), first);
        orders.give(Order::Pause);
        std::thread::sleep(Duration::from_millis(5));
        orders.give(Order::Cancel);
        let both = orders.paused();
        assert!(both >= first + Duration::from_millis(5));
        assert_eq!(orders.paused(), both);
    }
}
