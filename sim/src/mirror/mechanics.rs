//! Mechanics of a MEMS mirror: clamp -> zero-order hold -> 6th-order Bessel low-pass -> resonator, exact for commands
//! held for one sample each; then coupling between the axes, drift, and repeatability error.

use std::f64::consts::TAU;

use rand_distr::{Distribution, Normal};
use raysweep_core::{MechanicalDeg, Tilt};

use crate::keyed::{Purpose, keyed};

/// Natural frequencies relative to the -3 dB frequency, and Q, of the three sections of a 6th-order Bessel low-pass
/// (from the roots of the reverse Bessel polynomial).
const BESSEL: [(f64, f64); 3] = [(1.603_919, 0.510_318), (1.689_168, 0.611_195), (1.904_708, 1.023_314)];
/// Two states for each of the four sections.
const STATES: usize = 2 * (BESSEL.len() + 1);
const AUGMENTED: usize = STATES + 1;

type Matrix = [[f64; AUGMENTED]; AUGMENTED];

/// Parameters of a simulated mirror. Values without a data sheet behind them are marked [A].
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MechanicsConfig {
    /// Tilt in either direction at which the controller clamps.
    pub max_tilt: MechanicalDeg,
    /// Resonant frequencies, x and y.
    pub f0_hz: [f64; 2],
    /// Quality factors, x and y.
    pub q: [f64; 2],
    /// -3 dB frequency of the controller's low-pass filter.
    pub filter_hz: f64,
    /// Fraction of each axis' movement that appears in the other.
    pub coupling: f64,
    /// Drift of the rest position, x and y.
    pub drift_deg_per_s: [f64; 2],
    /// Standard deviation of the repeatability error, drawn anew every `repeat_s`.
    pub repeat_deg: f64,
    /// Duration of one draw of the repeatability error.
    pub repeat_s: f64,
    /// Seed of the repeatability error.
    pub seed: u64,
    /// Time since the mirror's first movement at which this one begins: drift goes on, and errors are drawn anew.
    pub begins_s: f64,
}

impl Default for MechanicsConfig {
    fn default() -> Self {
        Self {
            max_tilt: MechanicalDeg(6.5),
            f0_hz: [500.0, 480.0], // [A]
            q: [30.0, 30.0],       // [A]
            filter_hz: 200.0,
            coupling: 0.0,
            drift_deg_per_s: [0.0, 0.0],
            repeat_deg: 0.0,
            repeat_s: 1.0 / 6.0,
            seed: 1,
            begins_s: 0.0,
        }
    }
}

/// State of a moving mirror, advanced in samples of `1 / rate_hz`.
#[derive(Debug, Clone)]
pub struct Mechanics {
    config: MechanicsConfig,
    rate_hz: f64,
    step: [Matrix; 2],
    state: [[f64; STATES]; 2],
    samples: u64,
    offset_deg: [f64; 2],
    offset_drawn: u64,
}

impl Mechanics {
    /// A mirror at rest at the origin.
    pub fn new(config: MechanicsConfig, rate_hz: f64) -> Self {
        let mut mechanics = Self {
            config,
            rate_hz,
            step: [[[0.0; AUGMENTED]; AUGMENTED]; 2],
            state: [[0.0; STATES]; 2],
            samples: 0,
            offset_deg: [0.0; 2],
            offset_drawn: u64::MAX,
        };
        mechanics.set_rate(rate_hz);
        mechanics
    }

    /// Changes the sample rate; the motion continues from its current state.
    pub fn set_rate(&mut self, rate_hz: f64) {
        self.rate_hz = rate_hz;
        self.step = [0, 1].map(|axis| self.transition(axis, 1.0 / rate_hz));
    }

    /// The sample rate.
    pub fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    /// Holds a command for one sample; returns the mirror's tilt at its end.
    pub fn hold(&mut self, command: Tilt) -> Tilt {
        let limit = self.config.max_tilt.0;
        let mut moved = [0.0; 2];
        for (axis, deg) in command.deg().into_iter().enumerate() {
            let mut before = [0.0; AUGMENTED];
            before[..STATES].copy_from_slice(&self.state[axis]);
            before[STATES] = deg.clamp(-limit, limit);
            for (next, row) in self.state[axis].iter_mut().zip(&self.step[axis]) {
                *next = row.iter().zip(&before).map(|(m, b)| m * b).sum();
            }
            moved[axis] = self.state[axis][STATES - 2];
        }
        self.samples += 1;
        let seconds = self.config.begins_s + self.samples as f64 / self.rate_hz;
        self.draw_offset((seconds / self.config.repeat_s) as u64);
        let [x, y] = moved;
        let [drift_x, drift_y] = self.config.drift_deg_per_s.map(|drift| drift * seconds);
        let coupling = self.config.coupling;
        Tilt::new(
            x + coupling * y + drift_x + self.offset_deg[0],
            y + coupling * x + drift_y + self.offset_deg[1],
        )
    }

    fn draw_offset(&mut self, draw: u64) {
        if draw == self.offset_drawn {
            return;
        }
        self.offset_drawn = draw;
        let Ok(spread) = Normal::new(0.0, self.config.repeat_deg) else { return };
        let mut random = keyed(self.config.seed, Purpose::MirrorRepeat, &[draw]);
        self.offset_deg = [spread.sample(&mut random), spread.sample(&mut random)];
    }

    /// Exact transition matrix over `seconds` of the four sections' states (position, velocity over natural frequency)
    /// and their input.
    fn transition(&self, axis: usize, seconds: f64) -> Matrix {
        let bessel = BESSEL.map(|(frequency, q)| (frequency * self.config.filter_hz, q));
        let sections = bessel.into_iter().chain([(self.config.f0_hz[axis], self.config.q[axis])]);
        let mut rates = [[0.0; AUGMENTED]; AUGMENTED];
        for (section, (frequency_hz, q)) in sections.enumerate() {
            let (position, velocity) = (2 * section, 2 * section + 1);
            let input = if section == 0 { STATES } else { position - 2 };
            let w = TAU * frequency_hz * seconds;
            rates[position][velocity] = w;
            rates[velocity][input] = w;
            rates[velocity][position] = -w;
            rates[velocity][velocity] = -w / q;
        }
        exponential(rates)
    }
}

/// Matrix exponential by Taylor series with scaling and squaring.
fn exponential(mut matrix: Matrix) -> Matrix {
    let norm = matrix.iter().map(|row| row.iter().map(|v| v.abs()).sum::<f64>()).fold(0.0, f64::max);
    let squarings = norm.log2().ceil().max(0.0) as i32 + 2;
    matrix.iter_mut().flatten().for_each(|value| *value *= 2.0_f64.powi(-squarings));
    let mut term = [[0.0; AUGMENTED]; AUGMENTED];
    (0..AUGMENTED).for_each(|i| term[i][i] = 1.0);
    let mut sum = term;
    for order in 1..20 {
        term = product(&term, &matrix);
        term.iter_mut().flatten().for_each(|value| *value /= f64::from(order));
        sum.iter_mut().flatten().zip(term.iter().flatten()).for_each(|(s, t)| *s += t);
    }
    (0..squarings).for_each(|_| sum = product(&sum, &sum));
    sum
}

fn product(a: &Matrix, b: &Matrix) -> Matrix {
    let mut out = [[0.0; AUGMENTED]; AUGMENTED];
    for (row, a) in out.iter_mut().zip(a) {
        for (j, value) in row.iter_mut().enumerate() {
            *value = a.iter().zip(b).map(|(a, b)| a * b[j]).sum();
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE_HZ: f64 = 39_000.0;

    fn x_of(config: MechanicsConfig, command: impl Fn(usize) -> f64, samples: usize) -> Vec<f64> {
        let mut mechanics = Mechanics::new(config, RATE_HZ);
        (0..samples).map(|n| mechanics.hold(Tilt::new(command(n), 0.0)).x.0).collect()
    }

    /// Steady-state amplitude of a sine.
    fn gain(config: MechanicsConfig, frequency_hz: f64) -> f64 {
        let sine = |n: usize| (TAU * frequency_hz * n as f64 / RATE_HZ).sin();
        x_of(config, sine, 40_000)[30_000..].iter().fold(0.0, |peak: f64, x| peak.max(x.abs()))
    }

    #[test]
    fn the_filter_is_a_sixth_order_bessel() {
        // A resonator at a much higher frequency does not affect the filter.
        let filter = MechanicsConfig { f0_hz: [1e5, 1e5], q: [0.7, 0.7], ..Default::default() };
        // 20 lg |theta_6(0) / theta_6(2.703395 j f)|, calculated from the polynomial rather than from its sections.
        for (over_cutoff, expected_db) in [(0.5, -0.7282), (1.0, -3.0103), (2.0, -14.1721), (4.0, -44.6763)] {
            let db = 20.0 * gain(filter, 200.0 * over_cutoff).log10();
            assert!((db - expected_db).abs() < 0.05, "{over_cutoff}: {db} dB, expected {expected_db}");
        }
    }

    #[test]
    fn a_step_rings_at_the_resonance_and_dies_by_its_q() {
        // A filter at a much higher frequency does not affect the resonator.
        let config = MechanicsConfig { filter_hz: 15_000.0, q: [30.0, 20.0], ..Default::default() };
        let x = x_of(config, |_| 1.0, 8000);
        let (w0, q) = (TAU * 500.0, 30.0);
        let (decay, w) = (w0 / (2.0 * q), w0 * (1.0_f64 - 1.0 / (4.0 * q * q)).sqrt());
        // Delay of the filter: the sum of 1 / (w Q) over its sections.
        let delay = BESSEL.iter().map(|(f, q)| 1.0 / (TAU * 15_000.0 * f * q)).sum::<f64>();
        for (n, x) in x.iter().enumerate().skip(20) {
            let t = (n + 1) as f64 / RATE_HZ - delay;
            let expected = 1.0 - (-decay * t).exp() * ((w * t).cos() + decay / w * (w * t).sin());
            assert!((x - expected).abs() < 2e-3, "sample {n}: {x}, expected {expected}");
        }
    }

    #[test]
    fn commands_are_clamped_and_what_is_added_is_added() {
        let quiet = MechanicsConfig::default();
        let settled = |config, command| *x_of(config, |_| command, 80_000).last().unwrap();
        assert!((settled(quiet, 90.0) - 6.5).abs() < 1e-9);
        let drifting = MechanicsConfig { drift_deg_per_s: [0.01, 0.0], ..quiet };
        let drifted_deg = 0.01 * 80_000.0 / RATE_HZ;
        assert!((settled(drifting, 1.0) - 1.0 - drifted_deg).abs() < 1e-9);
        let spread = MechanicsConfig { repeat_deg: 0.1, ..quiet };
        assert_eq!(settled(spread, 1.0), settled(spread, 1.0), "the same seed, the same bits");
        assert_ne!(settled(spread, 1.0), settled(MechanicsConfig { seed: 2, ..spread }, 1.0));
    }

    #[test]
    fn the_motion_goes_on_when_the_rate_changes() {
        let command = Tilt::new(1.0, -1.0);
        let mut one = Mechanics::new(MechanicsConfig::default(), RATE_HZ);
        let mut other = one.clone();
        (0..400).for_each(|_| _ = one.hold(command));
        (0..200).for_each(|_| _ = other.hold(command));
        other.set_rate(RATE_HZ / 2.0);
        (0..100).for_each(|_| _ = other.hold(command));
        other.set_rate(RATE_HZ);
        let (one, other) = (one.hold(command), other.hold(command));
        assert!(one.distance_deg(other) < 1e-9, "{one:?} {other:?}");
    }
}
