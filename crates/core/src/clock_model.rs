//! Converts a device's clock to the host's: a line fitted to round trips of the question "what time is it?".
//!
//! Each round trip bounds the host's time at the moment when the device read its clock. The estimate is its middle,
//! and the largest possible error is half its length (Cristian, *Probabilistic clock synchronization*, 1989). The
//! line is a least-squares fit that weights each round trip by the inverse square of its length, so that long ones,
//! taken while host or wire were busy, have next to no influence. The slope is held near 1 until the round trips span
//! long enough to determine it better.

use std::collections::VecDeque;

/// One request for a device's time, and the answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RoundTrip {
    /// Host time of the request.
    pub request_ns: i64,
    /// The device's answer, in nanoseconds of its own clock.
    pub device_ns: i64,
    /// Host time when the answer arrived.
    pub receive_ns: i64,
}

impl RoundTrip {
    /// Time from the request to the answer.
    pub fn duration_ns(&self) -> i64 {
        self.receive_ns - self.request_ns
    }

    fn middle_ns(&self) -> i64 {
        self.request_ns + self.duration_ns() / 2
    }
}

/// Standard deviation of the relative rate error between two crystals, before any measurement [A].
const RATE_SIGMA: f64 = 50e-6;
/// Lower limit of the uncertainty: host time cannot be known better than a clock can be read.
const MIN_SIGMA_NS: f64 = 100.0;

/// The relation of a device's clock to the host's, fitted to the newest round trips.
#[derive(Debug, Clone)]
pub struct ClockModel {
    trips: VecDeque<RoundTrip>,
    capacity: usize,
    fit: Option<Fit>,
}

/// How accurately a device's clock is known.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
pub struct ClockQuality {
    /// Weighted root mean square distance of the round trips' middles from the line.
    pub residual_us: f64,
    /// How much faster the host's clock runs than the device's, in parts per million.
    pub rate_ppm: f64,
    /// Number of round trips in the fit.
    pub round_trips: usize,
}

/// host = host_ns + (device - device_ns) (1 + rate). Both origins lie within the data, so that no digits are lost.
#[derive(Debug, Clone, Copy)]
struct Fit {
    device_ns: i64,
    host_ns: i64,
    rate: f64,
    residual_ns: f64,
}

impl ClockModel {
    /// A model of the newest `capacity` round trips, at least 1.
    pub fn new(capacity: usize) -> Self {
        let capacity = capacity.max(1);
        Self { trips: VecDeque::with_capacity(capacity), capacity, fit: None }
    }

    /// Largest number of round trips that it keeps.
    pub fn capacity(&self) -> usize {
        self.capacity
    }

    /// Forgets all round trips.
    pub fn clear(&mut self) {
        self.trips.clear();
        self.fit = None;
    }

    /// Adds a round trip. Ignores one that ends before it begins.
    pub fn add(&mut self, trip: RoundTrip) {
        if trip.duration_ns() < 0 {
            return;
        }
        if self.trips.len() == self.capacity {
            self.trips.pop_front();
        }
        self.trips.push_back(trip);
        self.fit = self.fitted();
    }

    /// The host's time at a moment of the device's clock; `None` before the first round trip.
    pub fn host_ns(&self, device_ns: i64) -> Option<i64> {
        self.fit.map(|fit| {
            let since_ns = device_ns.saturating_sub(fit.device_ns);
            fit.host_ns.saturating_add(since_ns).saturating_add((since_ns as f64 * fit.rate).round() as i64)
        })
    }

    /// How much faster the host's clock runs than the device's: host nanoseconds per device nanosecond, minus 1.
    pub fn rate(&self) -> f64 {
        self.fit.map_or(0.0, |fit| fit.rate)
    }

    /// Weighted root mean square distance of the round trips' middles from the line.
    pub fn residual_ns(&self) -> Option<f64> {
        self.fit.map(|fit| fit.residual_ns)
    }

    /// How accurately the clock is known; `None` before the first round trip.
    pub fn quality(&self) -> Option<ClockQuality> {
        self.fit.map(|fit| ClockQuality {
            residual_us: fit.residual_ns / 1e3,
            rate_ppm: fit.rate * 1e6,
            round_trips: self.trips.len(),
        })
    }

    fn fitted(&self) -> Option<Fit> {
        let origin = *self.trips.front()?;
        // The error of a middle is uniformly distributed over plus or minus half the round trip; this is its
        // variance.
        let points = || {
            self.trips.iter().map(|trip| {
                let sigma_ns = (trip.duration_ns() as f64 / 12_f64.sqrt()).max(MIN_SIGMA_NS);
                let device_ns = trip.device_ns.saturating_sub(origin.device_ns) as f64;
                let host_ns = trip.middle_ns().saturating_sub(origin.middle_ns()) as f64;
                (device_ns, host_ns - device_ns, sigma_ns.powi(-2))
            })
        };
        let (mut weight, mut device_ns, mut ahead_ns) = (0.0, 0.0, 0.0);
        for (x, y, w) in points() {
            weight += w;
            device_ns += w * x;
            ahead_ns += w * y;
        }
        let (device_ns, ahead_ns) = (device_ns / weight, ahead_ns / weight);
        let (mut xx, mut xy) = (RATE_SIGMA.powi(-2), 0.0);
        for (x, y, w) in points() {
            xx += w * (x - device_ns).powi(2);
            xy += w * (x - device_ns) * (y - ahead_ns);
        }
        let rate = xy / xx;
        let squares: f64 =
            points().map(|(x, y, w)| w * (y - ahead_ns - rate * (x - device_ns)).powi(2)).sum();
        Some(Fit {
            device_ns: origin.device_ns.saturating_add(device_ns.round() as i64),
            host_ns: origin.middle_ns().saturating_add((device_ns + ahead_ns).round() as i64),
            rate,
            residual_ns: (squares / weight).sqrt(),
        })
    }
}

#[cfg(test)]
mod tests {
    use rand_xoshiro::Xoshiro256PlusPlus;
    use rand_xoshiro::rand_core::{Rng, SeedableRng};

    use super::*;

    /// A device whose clock shows 0 at `start_ns` and runs slow by `rate`, and a host with pseudorandom round trips:
    /// uniformly distributed durations, and occasionally a long and asymmetric one.
    struct Bench {
        random: Xoshiro256PlusPlus,
        start_ns: i64,
        rate: f64,
    }

    impl Bench {
        fn uniform(&mut self) -> f64 {
            (self.random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
        }

        fn device_ns(&self, host_ns: i64) -> i64 {
            ((host_ns - self.start_ns) as f64 / (1.0 + self.rate)).round() as i64
        }

        fn ask(&mut self, request_ns: i64) -> RoundTrip {
            let there_ns = (20_000.0 + 30_000.0 * self.uniform()) as i64;
            let mut back_ns = (20_000.0 + 30_000.0 * self.uniform()) as i64;
            if self.uniform() < 0.1 {
                back_ns += 3_000_000;
            }
            RoundTrip {
                request_ns,
                device_ns: self.device_ns(request_ns + there_ns),
                receive_ns: request_ns + there_ns + back_ns,
            }
        }
    }

    fn bench(seed: u64) -> Bench {
        Bench { random: Xoshiro256PlusPlus::seed_from_u64(seed), start_ns: 5_000_000_000_000, rate: 37e-6 }
    }

    #[test]
    fn offset_and_rate_are_found_in_spite_of_long_answers() {
        for seed in 0..20 {
            let mut bench = bench(seed);
            let mut model = ClockModel::new(100);
            for k in 0..150 {
                let trip = bench.ask(6_000_000_000_000 + k * 200_000_000);
                model.add(trip);
            }
            let host_ns = 6_000_000_000_000 + 150 * 200_000_000;
            let error_ns = model.host_ns(bench.device_ns(host_ns)).unwrap() - host_ns;
            assert!(error_ns.abs() < 10_000, "seed {seed}: {error_ns} ns");
            assert!((model.rate() - bench.rate).abs() < 1e-6, "seed {seed}: {}", model.rate());
            let residual_ns = model.residual_ns().unwrap();
            assert!((1_000.0..30_000.0).contains(&residual_ns), "seed {seed}: {residual_ns} ns");
        }
    }

    #[test]
    fn a_rate_is_followed_also_when_answers_become_slower() {
        // A quick burst when the device was opened, then answers that take ten times as long.
        let mut bench = bench(3);
        let mut model = ClockModel::new(100);
        for k in 0..8 {
            let trip = bench.ask(6_000_000_000_000 + k * 200_000);
            model.add(trip);
        }
        for k in 0..40 {
            let request_ns = 6_000_100_000_000 + k * 200_000_000;
            let slow_ns = (400_000.0 + 100_000.0 * bench.uniform()) as i64;
            model.add(RoundTrip {
                request_ns,
                device_ns: bench.device_ns(request_ns + slow_ns),
                receive_ns: request_ns + slow_ns + (400_000.0 + 100_000.0 * bench.uniform()) as i64,
            });
        }
        assert!((model.rate() - bench.rate).abs() < 10e-6, "{}", model.rate());
        let host_ns = 6_008_200_000_000;
        let error_ns = model.host_ns(bench.device_ns(host_ns)).unwrap() - host_ns;
        assert!(error_ns.abs() < 50_000, "{error_ns} ns");
    }

    #[test]
    fn a_short_beginning_does_not_run_away() {
        for seed in 0..20 {
            let mut bench = bench(seed);
            let mut model = ClockModel::new(100);
            for k in 0..8 {
                let trip = bench.ask(6_000_000_000_000 + k * 200_000);
                model.add(trip);
            }
            // One second later: the middle is off by at most tens of us, the rate by the tolerance of crystals.
            let host_ns = 6_001_000_000_000;
            let error_ns = model.host_ns(bench.device_ns(host_ns)).unwrap() - host_ns;
            assert!(error_ns.abs() < 100_000, "seed {seed}: {error_ns} ns");
        }
    }

    #[test]
    fn one_round_trip_gives_its_middle_and_none_gives_nothing() {
        let mut model = ClockModel::new(5);
        assert_eq!(model.host_ns(7), None);
        model.add(RoundTrip { request_ns: 100, device_ns: 7, receive_ns: 50 });
        assert_eq!(model.host_ns(7), None, "an answer before its question");
        model.add(RoundTrip { request_ns: 1_000, device_ns: 7, receive_ns: 3_000 });
        assert_eq!(model.host_ns(7), Some(2_000));
        assert_eq!(model.host_ns(1_007), Some(3_000));
    }

    #[test]
    fn old_round_trips_are_forgotten() {
        let mut model = ClockModel::new(10);
        let trip = |host_ns: i64, offset_ns: i64| RoundTrip {
            request_ns: host_ns - 500,
            device_ns: host_ns - offset_ns,
            receive_ns: host_ns + 500,
        };
        (0..20).for_each(|k| model.add(trip(k * 1_000_000, 0)));
        (20..30).for_each(|k| model.add(trip(k * 1_000_000, 300_000)));
        assert_eq!(model.host_ns(40_000_000), Some(40_300_000));
    }

    #[test]
    fn no_time_makes_it_panic() {
        let mut model = ClockModel::new(3);
        for device_ns in [i64::MAX, i64::MIN, 0] {
            model.add(RoundTrip { request_ns: 0, device_ns, receive_ns: 1 });
            let _ = model.host_ns(i64::MIN);
        }
        assert!(model.host_ns(i64::MAX).is_some());
    }
}
