//! Converts the times of a device that cannot be asked for its time to the host's clock, by what arrives from it.
//!
//! What a device sends (the samples of an analyser, the frames of a camera) arrives after its time: by at least the
//! latency of the bus, and by much more if the host was busy. So the least late arrival of each quarter of a second (at
//! first, of shorter times) is used, as a round trip that ends at its time. If the host was busy for that whole time,
//! the other quarters show how late even this one was: its round trip is lengthened by that time, and so its weight in
//! the fit is reduced.

use std::collections::VecDeque;

use raysweep_core::{ClockModel, ClockQuality, RoundTrip};

/// Window in which the least late arrival is sought: for the first few windows, and from then on.
const WINDOW_NS: [i64; 2] = [50_000_000, 250_000_000];
const SHORT_WINDOWS: usize = 8;
/// Maximum deviation of a window's least late arrival from the bus's latency [A].
const UNCERTAINTY_NS: i64 = 5_000;
/// Windows in the fit.
const WINDOWS: usize = 100;
/// Maximum relative drift of two crystals [A].
const MOST_DRIFT: f64 = 100e-6;

/// Conversion from a device's clock to the host's.
pub struct ArrivalClock {
    latency_ns: i64,
    /// The least late arrivals of the latest windows.
    best: VecDeque<Arrival>,
    model: ClockModel,
    window: Option<Window>,
}

/// The device time of what arrived, and the host time of its arrival less the bus's latency.
#[derive(Clone, Copy)]
struct Arrival {
    device_ns: i64,
    taken_ns: i64,
}

impl Arrival {
    /// Minimum lateness relative to another arrival, for any allowed drift of the clocks.
    fn later_than_ns(&self, other: &Self) -> i64 {
        let apart_ns = self.device_ns - other.device_ns;
        let drift_ns = (apart_ns.abs() as f64 * MOST_DRIFT) as i64;
        self.taken_ns - other.taken_ns - apart_ns - drift_ns
    }
}

struct Window {
    began_ns: i64,
    /// Device time and host time of the least late arrival.
    best: (i64, i64),
}

impl ArrivalClock {
    /// The clock of a device from which all arrives `latency_ns` after its time if nothing delays it.
    pub fn new(latency_ns: i64) -> Self {
        let (best, model) = (VecDeque::with_capacity(WINDOWS), ClockModel::new(WINDOWS));
        Self { latency_ns, best, model, window: None }
    }

    /// Records that what the device sent at `device_ns` had arrived at `host_ns`.
    pub fn arrived(&mut self, device_ns: i64, host_ns: i64) {
        let lateness = |(device_ns, host_ns): (i64, i64)| {
            host_ns.saturating_sub(self.model.host_ns(device_ns).unwrap_or(device_ns))
        };
        let window = self.window.get_or_insert(Window { began_ns: host_ns, best: (device_ns, host_ns) });
        if lateness((device_ns, host_ns)) <= lateness(window.best) {
            window.best = (device_ns, host_ns);
        }
        if host_ns - window.began_ns >= WINDOW_NS[usize::from(self.best.len() >= SHORT_WINDOWS)] {
            let (device_ns, arrived_ns) = window.best;
            if self.best.len() == WINDOWS {
                self.best.pop_front();
            }
            self.best.push_back(Arrival { device_ns, taken_ns: arrived_ns - self.latency_ns });
            self.fit();
            self.window = None;
        }
    }

    /// The lateness of each window's best arrival depends on all others, so each new window repeats the whole fit.
    fn fit(&mut self) {
        self.model.clear();
        for arrival in &self.best {
            let late_ns =
                self.best.iter().map(|other| arrival.later_than_ns(other)).max().unwrap_or(0).max(0);
            let Arrival { device_ns, taken_ns } = *arrival;
            let (request_ns, receive_ns) = (taken_ns - late_ns - UNCERTAINTY_NS, taken_ns + UNCERTAINTY_NS);
            self.model.add(RoundTrip { request_ns, device_ns, receive_ns });
        }
    }

    /// The host time of a time on the device's clock; `None` before the end of the first window.
    pub fn host_ns(&self, device_ns: i64) -> Option<i64> {
        self.model.host_ns(device_ns)
    }

    /// As [`Self::host_ns`], before the end of the first window by its least late arrival so far.
    #[cfg(any(feature = "aravis", test))]
    pub fn host_ns_so_far(&self, device_ns: i64) -> Option<i64> {
        let by_best = |Window { best: (at_ns, arrived_ns), .. }: &Window| {
            arrived_ns.saturating_sub(self.latency_ns).saturating_add(device_ns.saturating_sub(*at_ns))
        };
        self.host_ns(device_ns).or_else(|| self.window.as_ref().map(by_best))
    }

    /// Quality of the fit.
    pub fn quality(&self) -> Option<ClockQuality> {
        self.model.quality()
    }
}

#[cfg(test)]
mod tests {
    use rand_xoshiro::Xoshiro256PlusPlus;
    use rand_xoshiro::rand_core::{Rng, SeedableRng};

    use super::*;

    #[test]
    fn a_busy_host_moves_no_stamp() {
        // 30 ppm fast, transfers every 4 ms, at least 100 us late and mostly later, some by 20 ms.
        let mut clock = ArrivalClock::new(100_000);
        let mut random = Xoshiro256PlusPlus::seed_from_u64(1);
        let truth_ns = |device_ns: i64| 7_000_000_000_000 + (device_ns as f64 * (1.0 + 30e-6)) as i64;
        let mut worst_ns = 0;
        for k in 1..5000_i64 {
            let state = random.next_u64();
            let late_ns = match state >> 60 {
                0..4 => 0,
                15 => 20_000_000,
                _ => (state >> 40) as i64 % 400_000,
            };
            let device_ns = k * 4_000_000;
            clock.arrived(device_ns, truth_ns(device_ns) + 100_000 + late_ns);
            if k > 500 {
                let off_ns = clock.host_ns(device_ns).unwrap() - truth_ns(device_ns);
                worst_ns = off_ns.abs().max(worst_ns);
            }
        }
        assert!(worst_ns < 5_000, "{worst_ns} ns");
        let quality = clock.quality().unwrap();
        assert!((quality.rate_ppm - 30.0).abs() < 0.5 && quality.residual_us < 2.0, "{quality:?}");
    }

    #[test]
    fn before_the_first_window_ends_the_least_late_arrival_tells_the_time() {
        let mut clock = ArrivalClock::new(100_000);
        assert_eq!(clock.host_ns_so_far(0), None);
        for (device_ns, late_ns) in [(0, 90_000_000), (4_000_000, 0), (8_000_000, 95_000_000)] {
            clock.arrived(device_ns, 7_000_000_000_000 + device_ns + 100_000 + late_ns);
            let off_ns = clock.host_ns_so_far(device_ns).unwrap() - 7_000_000_000_000 - device_ns;
            assert_eq!(off_ns, if device_ns == 0 { late_ns } else { 0 });
        }
    }

    /// As when a run begins and opens its devices: no transfer is on time for whole windows.
    #[test]
    fn a_host_that_was_busy_for_a_second_knows_the_time_two_seconds_later() {
        let mut clock = ArrivalClock::new(100_000);
        for k in 1..=750_i64 {
            let late_ns = if k <= 250 { 1_000_000 + k * 7919 % 5_000_000 } else { k * 7919 % 400_000 };
            clock.arrived(k * 4_000_000, 7_000_000_000_000 + k * 4_000_000 + 100_000 + late_ns);
        }
        let off_ns = clock.host_ns(3_000_000_000).unwrap() - 7_003_000_000_000;
        assert!(off_ns.abs() < 30_000, "{off_ns} ns");
    }
}
