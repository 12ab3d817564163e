//! Measures how regular a VSYNC line is: the expected position of its next edge, and the distance of edges from the
//! straight line through their neighbours.

use std::collections::VecDeque;

/// Edges on each side of the one whose deviation is measured: a quarter of a second at 60 Hz, too short for crystal
/// drift.
const REACH: usize = 8;
const WINDOW: usize = 2 * REACH + 1;
/// Number of edges needed to predict the position of the next one.
const MIN_EDGES: usize = REACH;
/// Number of deviations from which their standard deviation is considered known.
const MIN_DEVIATIONS: u64 = 16;
/// An edge farther off than this many standard deviations does not belong to the line.
const GATE_SIGMAS: f64 = 8.0;
/// Smallest half-width of the gate: corrections of a clock model shift a perfect line too.
const MIN_GATE_NS: f64 = 50_000.0;
/// Averaging time of the frequency for the Allan deviation.
const ALLAN_NS: i64 = 1_000_000_000;

/// A true edge and its index in the count of periods.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TrueEdge {
    /// Periods since the first true edge, including missed ones.
    pub index: i64,
    /// Time of the edge on the host's clock.
    pub host_ns: i64,
}

/// Statistics of a line, computed from its true edges.
pub struct Regularity {
    period_ns: i64,
    recent: VecDeque<TrueEdge>,
    deviations: Deviations,
    allan: Allan,
}

impl Regularity {
    /// Empty statistics of a line with this nominal period.
    pub fn new(period_ns: i64) -> Self {
        Self {
            period_ns,
            recent: VecDeque::with_capacity(WINDOW),
            deviations: Deviations::default(),
            allan: Allan::new(period_ns),
        }
    }

    /// Restarts after a new count of periods.
    pub fn restart(&mut self) {
        self.recent.clear();
        self.allan.seen.fill(None);
    }

    /// Adds the next true edge.
    pub fn push(&mut self, edge: TrueEdge) {
        if self.recent.len() == WINDOW {
            self.recent.pop_front();
        }
        self.recent.push_back(edge);
        if self.recent.len() == WINDOW
            && let Some(line) = self.line()
        {
            let middle = self.recent[REACH];
            // The fit has absorbed part of the edge's own deviation.
            let left = (1.0 - line.leverage(middle.index)).sqrt();
            self.deviations.note((middle.host_ns as f64 - line.host_ns(middle.index)).abs() / left);
        }
        self.allan.note(edge);
    }

    /// Whether an edge lies at the expected position of the line's edge `index`; always true while the position is
    /// unknown.
    pub fn fits(&self, index: i64, host_ns: i64) -> bool {
        let near = self.recent.back().is_some_and(|last| index - last.index <= WINDOW as i64);
        if !near || self.deviations.count < MIN_DEVIATIONS || self.recent.len() < MIN_EDGES {
            return true;
        }
        let gate_ns = (GATE_SIGMAS * self.deviations.sigma_ns()).max(MIN_GATE_NS);
        self.line().is_none_or(|line| (host_ns as f64 - line.host_ns(index)).abs() <= gate_ns)
    }

    /// Standard deviation of edges from the line.
    pub fn sigma_us(&self) -> f64 {
        self.deviations.sigma_ns() / 1e3
    }

    /// 99th percentile of the edges' deviation, to 2 %.
    pub fn p99_us(&self) -> f64 {
        self.deviations.quantile_ns(0.99) / 1e3
    }

    /// Allan deviation over a second (IEEE Std 1139-2008, overlapping estimate); `None` before two seconds.
    pub fn allan_1s(&self) -> Option<f64> {
        self.allan.deviation()
    }

    /// The straight line through the recent edges.
    fn line(&self) -> Option<Fit> {
        let origin = *self.recent.front()?;
        let points = || {
            self.recent.iter().map(|edge| {
                let periods = edge.index - origin.index;
                (periods as f64, (edge.host_ns - origin.host_ns - periods * self.period_ns) as f64)
            })
        };
        let n = self.recent.len() as f64;
        let (x, y) = points().fold((0.0, 0.0), |(x, y), point| (x + point.0 / n, y + point.1 / n));
        let (xx, xy) =
            points().fold((0.0, 0.0), |(xx, xy), p| (xx + (p.0 - x).powi(2), xy + (p.0 - x) * (p.1 - y)));
        (xx > 0.0).then_some(Fit { origin, period_ns: self.period_ns, n, x, y, slope_ns: xy / xx, xx })
    }
}

/// A least-squares line: excess over the nominal time in nanoseconds as a function of periods, both relative to
/// `origin`.
struct Fit {
    origin: TrueEdge,
    period_ns: i64,
    n: f64,
    x: f64,
    y: f64,
    slope_ns: f64,
    xx: f64,
}

impl Fit {
    fn host_ns(&self, index: i64) -> f64 {
        let periods = index - self.origin.index;
        let nominal_ns = self.origin.host_ns + periods * self.period_ns;
        nominal_ns as f64 + self.y + self.slope_ns * (periods as f64 - self.x)
    }

    /// Share of a point's own deviation that the fit follows.
    fn leverage(&self, index: i64) -> f64 {
        let periods = (index - self.origin.index) as f64;
        1.0 / self.n + (periods - self.x).powi(2) / self.xx
    }
}

/// Sum of squares, and a histogram with logarithmic bins.
#[derive(Default)]
struct Deviations {
    count: u64,
    sum_squares_ns2: f64,
    /// `bins[k]` starts at 2^(k/32) - 1 ns.
    bins: Vec<u64>,
}

const BINS_PER_OCTAVE: f64 = 32.0;
/// Up to a second, which exceeds every gate.
const BINS: usize = 30 * BINS_PER_OCTAVE as usize;

impl Deviations {
    fn note(&mut self, deviation_ns: f64) {
        self.count += 1;
        self.sum_squares_ns2 += deviation_ns * deviation_ns;
        let bin = (BINS_PER_OCTAVE * deviation_ns.ln_1p() / std::f64::consts::LN_2) as usize;
        self.bins.resize(BINS, 0);
        self.bins[bin.min(BINS - 1)] += 1;
    }

    fn sigma_ns(&self) -> f64 {
        (self.sum_squares_ns2 / self.count.max(1) as f64).sqrt()
    }

    fn quantile_ns(&self, share: f64) -> f64 {
        let mut below = 0;
        let bin = self.bins.iter().position(|&count| {
            below += count;
            below as f64 >= share * self.count as f64
        });
        // The centre of the bin.
        bin.map_or(0.0, |bin| ((bin as f64 + 0.5) / BINS_PER_OCTAVE).exp2() - 1.0)
    }
}

/// Second differences of the edges' times over a second, in which the nominal period cancels.
struct Allan {
    period_ns: i64,
    /// Number of periods in a second.
    periods: i64,
    /// The edges of the last two seconds, each at its index modulo the length.
    seen: Vec<Option<TrueEdge>>,
    count: u64,
    sum_squares_ns2: f64,
}

impl Allan {
    fn new(period_ns: i64) -> Self {
        let periods = (ALLAN_NS as f64 / period_ns as f64).round().max(1.0) as i64;
        Self {
            period_ns,
            periods,
            seen: vec![None; 2 * periods as usize + 1],
            count: 0,
            sum_squares_ns2: 0.0,
        }
    }

    fn place(&self, index: i64) -> usize {
        index.rem_euclid(self.seen.len() as i64) as usize
    }

    fn at(&self, index: i64) -> Option<i64> {
        self.seen[self.place(index)].filter(|edge| edge.index == index).map(|edge| edge.host_ns)
    }

    fn note(&mut self, edge: TrueEdge) {
        let place = self.place(edge.index);
        self.seen[place] = Some(edge);
        let earlier = (self.at(edge.index - self.periods), self.at(edge.index - 2 * self.periods));
        if let (Some(middle_ns), Some(first_ns)) = earlier {
            let second_difference_ns = (edge.host_ns - 2 * middle_ns + first_ns) as f64;
            self.count += 1;
            self.sum_squares_ns2 += second_difference_ns * second_difference_ns;
        }
    }

    fn deviation(&self) -> Option<f64> {
        let tau_ns = (self.periods * self.period_ns) as f64;
        (self.count > 0).then(|| (self.sum_squares_ns2 / (2.0 * self.count as f64)).sqrt() / tau_ns)
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use rand_xoshiro::Xoshiro256PlusPlus;
    use rand_xoshiro::rand_core::{Rng, SeedableRng};

    use super::*;

    const PERIOD_NS: i64 = 16_666_667;

    /// Generator of standard normal numbers (Box-Muller).
    pub struct Normal(Xoshiro256PlusPlus);

    impl Normal {
        pub fn new(seed: u64) -> Self {
            Self(Xoshiro256PlusPlus::seed_from_u64(seed))
        }

        pub fn uniform(&mut self) -> f64 {
            (self.0.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
        }

        pub fn next(&mut self) -> f64 {
            let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
            radius * (std::f64::consts::TAU * self.uniform()).cos()
        }
    }

    /// A line that is 80 ppm off its nominal period and drifts by 1 ppm per minute, with every 100th edge missing.
    fn line(jitter_ns: f64, edges: i64) -> Regularity {
        let mut normal = Normal::new(7);
        let mut regularity = Regularity::new(PERIOD_NS);
        for index in (0..edges).filter(|index| index % 100 != 50) {
            let minutes = index as f64 / 3600.0;
            let off_ns = index as f64 * PERIOD_NS as f64 * (80e-6 + 0.5e-6 * minutes);
            let host_ns = index * PERIOD_NS + (off_ns + jitter_ns * normal.next()) as i64;
            regularity.push(TrueEdge { index, host_ns });
        }
        regularity
    }

    #[test]
    fn spread_and_tail_are_the_edges_own_whatever_the_period_drifts() {
        let regularity = line(5000.0, 10_000);
        assert!((regularity.sigma_us() / 5.0 - 1.0).abs() < 0.03, "{}", regularity.sigma_us());
        // 99 % of a normal distribution lie within 2.576 sigma.
        assert!((regularity.p99_us() / 12.88 - 1.0).abs() < 0.06, "{}", regularity.p99_us());
        // White phase noise: sqrt(3) sigma / tau.
        let allan = regularity.allan_1s().unwrap();
        assert!((allan / (3_f64.sqrt() * 5e-6) - 1.0).abs() < 0.05, "{allan:e}");
    }

    #[test]
    fn allan_deviation_is_that_of_a_frequency_that_steps() {
        // Alternately fast and slow by 2 ppm, for a second each: the difference of consecutive averages over a
        // second, as a function of time, is a triangle of height 4 ppm, whose mean square is a third of its peak's.
        let mut regularity = Regularity::new(10_000_000);
        let mut host_ns = 0;
        for index in 0..20_000 {
            regularity.push(TrueEdge { index, host_ns });
            host_ns += if index / 100 % 2 == 0 { 10_000_020 } else { 9_999_980 };
        }
        let expected = 4e-6 / 6_f64.sqrt();
        assert!(
            (regularity.allan_1s().unwrap() / expected - 1.0).abs() < 0.02,
            "{:?}",
            regularity.allan_1s()
        );
        assert!(line(0.0, 100).allan_1s().is_none(), "two seconds are not over");
    }

    #[test]
    fn the_next_edge_is_known_to_a_few_sigma_and_no_better() {
        let regularity = line(5000.0, 1000);
        let last = *regularity.recent.back().unwrap();
        let next_ns = last.host_ns + PERIOD_NS;
        assert!(
            regularity.fits(last.index + 1, next_ns) && regularity.fits(last.index + 1, next_ns + 25_000)
        );
        assert!(!regularity.fits(last.index + 1, next_ns + 120_000));
        assert!(regularity.fits(last.index + 100, next_ns), "too far ahead to be known");
        assert!(line(5000.0, 20).fits(20, 0), "too little seen");
    }
}
