//! Time, real or virtual. Virtual time stands still while any registered thread works. It jumps to the nearest
//! deadline when all of them wait, so a simulated rig runs as fast as possible and always in the same order.

use std::collections::BTreeMap;
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use nix::time::{ClockId, clock_gettime};

/// A clock shared by devices and their threads. A clone is the same clock.
#[derive(Clone)]
pub struct Clock(Arc<Kind>);

enum Kind {
    Real,
    Virtual { state: Mutex<VirtualTime>, woken: Condvar },
}

#[derive(Default)]
struct VirtualTime {
    now_ns: i64,
    registered: usize,
    /// Deadlines of the waiting threads, each with the number of threads that wait for it.
    deadlines: BTreeMap<i64, usize>,
    waiting: usize,
}

impl VirtualTime {
    /// Jumps to the nearest deadline if every registered thread waits.
    fn advance(&mut self) -> bool {
        if self.waiting < self.registered {
            return false;
        }
        let Some((deadline, threads)) = self.deadlines.pop_first() else { return false };
        self.now_ns = deadline;
        // Count the threads as working from now on, not from when the scheduler runs them: otherwise time would jump
        // twice.
        self.waiting -= threads;
        true
    }
}

impl Clock {
    /// The real clock: `CLOCK_MONOTONIC`.
    pub fn real() -> Self {
        Self(Arc::new(Kind::Real))
    }

    /// A virtual clock that starts at zero.
    pub fn simulated() -> Self {
        Self(Arc::new(Kind::Virtual { state: Mutex::default(), woken: Condvar::new() }))
    }

    /// Current time in nanoseconds.
    pub fn now_ns(&self) -> i64 {
        match &*self.0 {
            Kind::Real => monotonic_ns(),
            Kind::Virtual { state, .. } => lock(state).now_ns,
        }
    }

    /// Registers a participant: virtual time waits for the holder of the handle.
    pub fn register(&self) -> ClockHandle {
        if let Kind::Virtual { state, .. } = &*self.0 {
            lock(state).registered += 1;
        }
        ClockHandle { clock: self.clone() }
    }
}

/// One participant of a [`Clock`]. Dropping it removes the participant, so that time goes on for the others.
pub struct ClockHandle {
    clock: Clock,
}

impl ClockHandle {
    /// Current time in nanoseconds.
    pub fn now_ns(&self) -> i64 {
        self.clock.now_ns()
    }

    /// Blocks until the clock reads at least `deadline_ns`.
    pub fn sleep_until(&self, deadline_ns: i64) {
        match &*self.clock.0 {
            Kind::Real => {
                let left_ns = deadline_ns - monotonic_ns();
                if left_ns > 0 {
                    std::thread::sleep(Duration::from_nanos(left_ns.unsigned_abs()));
                }
            }
            Kind::Virtual { state, woken } => {
                let mut time = lock(state);
                if deadline_ns <= time.now_ns {
                    return;
                }
                *time.deadlines.entry(deadline_ns).or_default() += 1;
                time.waiting += 1;
                if time.advance() {
                    woken.notify_all();
                }
                while time.now_ns < deadline_ns {
                    time = woken.wait(time).unwrap_or_else(PoisonError::into_inner);
                }
            }
        }
    }
}

impl Drop for ClockHandle {
    fn drop(&mut self) {
        if let Kind::Virtual { state, woken } = &*self.clock.0 {
            let mut time = lock(state);
            time.registered -= 1;
            if time.advance() {
                woken.notify_all();
            }
        }
    }
}

fn lock(state: &Mutex<VirtualTime>) -> MutexGuard<'_, VirtualTime> {
    // No code panics between changing two fields, so the time is consistent even behind a poisoned lock.
    state.lock().unwrap_or_else(PoisonError::into_inner)
}

fn monotonic_ns() -> i64 {
    // CLOCK_MONOTONIC exists on every Linux. A zero would only stop time for this reader.
    clock_gettime(ClockId::CLOCK_MONOTONIC).map_or(0, |time| time.tv_sec() * 1_000_000_000 + time.tv_nsec())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc;

    #[test]
    fn virtual_time_visits_deadlines_in_order_over_all_threads() {
        let clock = Clock::simulated();
        let (tx, rx) = mpsc::channel();
        let handles = [clock.register(), clock.register(), clock.register()];
        let threads: Vec<_> = handles
            .into_iter()
            .zip([3_i64, 5, 7])
            .map(|(handle, step)| {
                let tx = tx.clone();
                std::thread::spawn(move || {
                    for k in 1..=100 {
                        handle.sleep_until(k * step);
                        assert_eq!(handle.now_ns(), k * step, "no thread may be overtaken");
                        tx.send(k * step).unwrap();
                    }
                })
            })
            .collect();
        threads.into_iter().for_each(|thread| thread.join().unwrap());
        drop(tx);
        let visited: Vec<i64> = rx.iter().collect();
        assert!(visited.is_sorted());
        assert_eq!(visited.len(), 300);
    }

    #[test]
    fn virtual_time_stands_still_while_a_participant_works() {
        let clock = Clock::simulated();
        let (worker, sleeper) = (clock.register(), clock.register());
        let thread = std::thread::spawn(move || sleeper.sleep_until(10));
        while !matches!(&*clock.0, Kind::Virtual { state, .. } if lock(state).waiting == 1) {
            std::thread::yield_now();
        }
        assert_eq!(clock.now_ns(), 0);
        drop(worker);
        thread.join().unwrap();
        assert_eq!(clock.now_ns(), 10);
    }
}
