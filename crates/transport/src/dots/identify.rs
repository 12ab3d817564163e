//! Determines the resonance of a mirror from a commanded chirp and the measured angles.
//!
//! Per axis, the ratio of the two spectra is fitted with `g exp(-i 2 pi f delay) / (1 - r^2 + i r / Q)`, r = f / f0.
//! The initial values come from a linear problem, `1 / |H|^2 = (1 + (1/Q^2 - 2) r^2 + r^4) / g^2`; Gauss-Newton
//! refines them. A controller's low-pass distorts the response over a wide band. If the fit fails for the whole band,
//! it is repeated near the largest movement, where the low-pass is little more than a gain and a delay.

use std::f64::consts::{PI, TAU};
use std::ops::RangeInclusive;

use nalgebra::Complex;

/// Number of frequencies at which the spectra are compared.
const FREQUENCIES: usize = 400;
/// Maximum number of Gauss-Newton steps; five suffice from good initial values.
const STEPS: usize = 30;
/// Maximum fraction of the measured movement that the model may leave unexplained.
const LARGEST_RESIDUAL: f64 = 0.2;
/// Corrections, in half periods of the resonance, that are tried for the delay from the slope of the phase.
const HALF_PERIODS: [i32; 5] = [0, -1, 1, -2, 2];
/// Half widths, relative to the frequency of the largest movement, of the bands that are tried after the whole band.
const NEIGHBOURHOODS: [f64; 3] = [0.4, 0.2, 0.1];

/// A damped resonance.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Resonance {
    /// Its frequency.
    pub f0_hz: f64,
    /// Its quality factor.
    pub q: f64,
}

/// What an axis answers to its command.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Identified {
    /// Its resonance.
    pub resonance: Resonance,
    /// Measured angle over commanded angle at rest, as the band shows it; negative where they run against each other.
    pub gain: f64,
    /// Delay of the controller's filter and of the measurement.
    pub delay_s: f64,
    /// Fraction of the measured movement (amplitude, within the band) that the model does not explain.
    pub residual: f64,
    /// The band in which the model holds, lower and upper end.
    pub band_hz: [f64; 2],
}

impl Identified {
    /// The response to a command of this frequency.
    pub fn at(&self, hz: f64) -> Transfer {
        let Self { resonance: Resonance { f0_hz, q }, gain, delay_s, .. } = *self;
        Transfer::new(hz, Model { gain, f0_hz, q, delay_s }.at(hz))
    }
}

/// Response to a command of one frequency.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Transfer {
    /// The frequency.
    pub hz: f64,
    /// Measured amplitude over commanded amplitude.
    pub amplitude: f64,
    /// Phase by which the measured angle leads, -pi to pi.
    pub phase_rad: f64,
}

impl Transfer {
    fn new(hz: f64, ratio: Complex<f64>) -> Self {
        Self { hz, amplitude: ratio.norm(), phase_rad: ratio.arg() }
    }
}

/// Why nothing could be identified.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum IdentifyError {
    /// The two records do not match.
    #[error(
        "{commanded} angles commanded, {measured} measured: give one measured angle for each sample, 100 at least"
    )]
    Lengths {
        /// Number of commanded angles.
        commanded: usize,
        /// Number of measured angles.
        measured: usize,
    },
    /// The band is invalid.
    #[error("band = {low_hz} to {high_hz} Hz: must be above 0, at most half the rate, and low before high")]
    Band {
        /// Its lower end.
        low_hz: f64,
        /// Its upper end.
        high_hz: f64,
    },
    /// The angles are not finite, or nothing moves.
    #[error(
        "nothing moves between {low_hz} and {high_hz} Hz: command a chirp over that band and measure its angles"
    )]
    Still {
        /// The band's lower end.
        low_hz: f64,
        /// The band's upper end.
        high_hz: f64,
    },
    /// The resonance is outside the band, or there is none.
    #[error(
        "no resonance between {low_hz} and {high_hz} Hz: command a chirp over a band in which it lies, and see that the controller's filter lets it through"
    )]
    NoResonance {
        /// The band's lower end.
        low_hz: f64,
        /// The band's upper end.
        high_hz: f64,
    },
    /// The response is not that of a resonator.
    #[error(
        "a resonator leaves {residual:.2} of the movement unexplained: {LARGEST_RESIDUAL} is allowed; measure with less noise, a wider band, or a smaller amplitude"
    )]
    NoResonator {
        /// The unexplained fraction of the movement.
        residual: f64,
    },
}

/// A sine sweep over `band` in `seconds` with smooth ends, followed by a rest of `rest_s`, so that the record
/// includes the ringing.
pub fn chirp(
    band: &RangeInclusive<f64>,
    amplitude_deg: f64,
    seconds: f64,
    rest_s: f64,
    rate_hz: f64,
) -> Vec<f64> {
    let samples = (seconds * rate_hz).round().max(0.0) as usize;
    let rest = (rest_s * rate_hz).round().max(0.0) as usize;
    let sweep = (0..samples).map(|n| {
        let t = n as f64 / rate_hz;
        let phase = TAU * (band.start() * t + (band.end() - band.start()) * t * t / (2.0 * seconds));
        // At each end, a twentieth of the samples fades with half a cosine.
        let edge = (n.min(samples - n) as f64 / (0.05 * samples as f64)).min(1.0);
        amplitude_deg * phase.sin() * (1.0 - (PI * edge).cos()) / 2.0
    });
    sweep.chain(std::iter::repeat_n(0.0, rest)).collect()
}

/// Fits one axis. `commanded` and `measured` are angles in degrees, sample by sample, starting and ending at rest at
/// 0. If the measured angles have another unit, the gain includes the conversion.
///
/// # Errors
/// If the records or the band are invalid, or the movement is not that of a resonator.
pub fn identify(
    commanded: &[f64],
    measured: &[f64],
    rate_hz: f64,
    band: &RangeInclusive<f64>,
) -> Result<Identified, IdentifyError> {
    let points = points(commanded, measured, rate_hz, band)?;
    let refused = match fit(&points, band) {
        Ok(found) => return Ok(found),
        Err(refused) => refused,
    };
    let Some(peak) = points.iter().max_by(|a, b| a.energy().total_cmp(&b.energy())) else {
        return Err(refused);
    };
    for share in NEIGHBOURHOODS {
        let near = peak.hz * (1.0 - share)..=peak.hz * (1.0 + share);
        // A movement that is largest at the end of the band is not a resonance within it.
        if band.contains(near.start())
            && band.contains(near.end())
            && let Ok(found) = fit(&self::points(commanded, measured, rate_hz, &near)?, &near)
        {
            return Ok(found);
        }
    }
    Err(refused)
}

/// The response at evenly spaced frequencies over the band, without a model.
///
/// # Errors
/// If spectra cannot be computed from the records or the band.
pub fn transfer(
    commanded: &[f64],
    measured: &[f64],
    rate_hz: f64,
    band: &RangeInclusive<f64>,
) -> Result<Vec<Transfer>, IdentifyError> {
    let points = points(commanded, measured, rate_hz, band)?;
    Ok(points.iter().map(|point| Transfer::new(point.hz, point.ratio)).collect())
}

/// The direction in which a track in a plane moves most within the band, as a unit vector. Slower movement, such as
/// drift, has no influence.
pub fn direction(track: [&[f64]; 2], rate_hz: f64, band: &RangeInclusive<f64>) -> [f64; 2] {
    let mut moments = [0.0; 3];
    for hz in frequencies(band) {
        let [a, b] = track.map(|values| spectrum_at(values, hz / rate_hz));
        let products = [a.norm_sqr(), b.norm_sqr(), (a * b.conj()).re];
        moments.iter_mut().zip(products).for_each(|(moment, product)| *moment += product);
    }
    let [aa, bb, ab] = moments;
    let (sin, cos) = (0.5 * (2.0 * ab).atan2(aa - bb)).sin_cos();
    [cos, sin]
}

fn frequencies(band: &RangeInclusive<f64>) -> impl Iterator<Item = f64> + use<> {
    let (low_hz, high_hz) = (*band.start(), *band.end());
    (0..FREQUENCIES).map(move |k| low_hz + (high_hz - low_hz) * k as f64 / (FREQUENCIES - 1) as f64)
}

/// The spectra over the band.
fn points(
    commanded: &[f64],
    measured: &[f64],
    rate_hz: f64,
    band: &RangeInclusive<f64>,
) -> Result<Vec<Point>, IdentifyError> {
    if commanded.len() != measured.len() || commanded.len() < 100 {
        return Err(IdentifyError::Lengths { commanded: commanded.len(), measured: measured.len() });
    }
    let (low_hz, high_hz) = (*band.start(), *band.end());
    if !(low_hz > 0.0 && low_hz < high_hz && high_hz <= rate_hz / 2.0) {
        return Err(IdentifyError::Band { low_hz, high_hz });
    }
    let points = frequencies(band).map(|hz| {
        let [command, answer] = [commanded, measured].map(|values| spectrum_at(values, hz / rate_hz));
        Point { hz, command: command.norm(), ratio: answer / command }
    });
    let points: Vec<Point> =
        points.filter(|point| point.ratio.is_finite() && point.ratio.norm() > 0.0).collect();
    match points.len() {
        0..2 => Err(IdentifyError::Still { low_hz, high_hz }),
        _ => Ok(points),
    }
}

fn fit(points: &[Point], band: &RangeInclusive<f64>) -> Result<Identified, IdentifyError> {
    let [low_hz, high_hz] = [*band.start(), *band.end()];
    let elsewhere = IdentifyError::NoResonance { low_hz, high_hz };
    let Some(start) = Model::start(points) else { return Err(elsewhere) };
    // A low-pass shifts the phase by a line that does not pass through 0, so the delay may be off by half periods of
    // the resonance.
    let refined = HALF_PERIODS.map(|halves| start.late_by(halves).refined(points));
    let [first, others @ ..] = refined;
    let better = |a: Model, b: Model| if b.error(points) < a.error(points) { b } else { a };
    let model = others.into_iter().fold(first, better);
    let residual = (model.error(points) / points.iter().map(Point::energy).sum::<f64>()).sqrt();
    if residual.is_nan() || residual > LARGEST_RESIDUAL {
        return Err(IdentifyError::NoResonator { residual });
    }
    if !(model.q > 0.0 && band.contains(&model.f0_hz)) {
        return Err(elsewhere);
    }
    let resonance = Resonance { f0_hz: model.f0_hz, q: model.q };
    let Model { gain, delay_s, .. } = model;
    Ok(Identified { resonance, gain, delay_s, residual, band_hz: [low_hz, high_hz] })
}

/// The spectra at one frequency.
struct Point {
    hz: f64,
    command: f64,
    ratio: Complex<f64>,
}

impl Point {
    fn energy(&self) -> f64 {
        (self.command * self.ratio.norm()).powi(2)
    }
}

fn spectrum_at(values: &[f64], cycles_per_sample: f64) -> Complex<f64> {
    let turn = Complex::cis(-TAU * cycles_per_sample);
    let mut unit = Complex::new(1.0, 0.0);
    let mut sum = Complex::new(0.0, 0.0);
    for &value in values {
        sum += unit * value;
        unit *= turn;
    }
    sum
}

#[derive(Clone, Copy)]
struct Model {
    gain: f64,
    f0_hz: f64,
    q: f64,
    delay_s: f64,
}

impl Model {
    /// Initial values: first from the magnitudes, then the delay from the slope of the remaining phase over
    /// frequency.
    fn start(points: &[Point]) -> Option<Self> {
        let mut normal = [[0.0; 4]; 3];
        let scale = points.last()?.hz;
        for point in points {
            let squared = point.ratio.norm_sqr();
            let f2 = (point.hz / scale).powi(2);
            // An error of H affects 1/|H|^2 by |H|^-3.
            let weight = point.command.powi(2) * squared.powi(3);
            accumulate(&mut normal, [1.0, f2, f2 * f2], 1.0 / squared, weight);
        }
        let [c0, c1, c2] = solve(normal)?;
        if !(c0 > 0.0 && c2 > 0.0) {
            return None;
        }
        let f0 = (c0 / c2).powf(0.25);
        let q2 = 1.0 / (c1 / c0 * f0 * f0 + 2.0).max(1e-6);
        let mut model = Self { gain: 1.0 / c0.sqrt(), f0_hz: f0 * scale, q: q2.sqrt(), delay_s: 0.0 };
        let left = |point: &Point| point.ratio / model.at(point.hz);
        let turns: Complex<f64> = points
            .windows(2)
            .map(|pair| left(&pair[1]) * left(&pair[0]).conj() * (pair[0].energy() * pair[1].energy()).sqrt())
            .sum();
        let spacing_hz = points.get(1)?.hz - points.first()?.hz;
        model.delay_s = -turns.arg() / (TAU * spacing_hz);
        let agreement: f64 =
            points.iter().map(|point| point.energy() * (point.ratio / model.at(point.hz)).re).sum();
        if agreement < 0.0 {
            model.gain = -model.gain;
        }
        Some(model)
    }

    /// The same response near the resonance, later by this number of half periods of the resonance.
    fn late_by(self, halves: i32) -> Self {
        let gain = if halves % 2 == 0 { self.gain } else { -self.gain };
        Self { gain, delay_s: self.delay_s + f64::from(halves) / (2.0 * self.f0_hz), ..self }
    }

    fn denominator(&self, hz: f64) -> Complex<f64> {
        let r = hz / self.f0_hz;
        Complex::new(1.0 - r * r, r / self.q)
    }

    fn at(&self, hz: f64) -> Complex<f64> {
        Complex::cis(-TAU * hz * self.delay_s) * self.gain / self.denominator(hz)
    }

    fn error(&self, points: &[Point]) -> f64 {
        points.iter().map(|p| (p.ratio - self.at(p.hz)).norm_sqr() * p.command * p.command).sum()
    }

    /// Gauss-Newton on relative parameters; a step without improvement is halved.
    fn refined(self, points: &[Point]) -> Self {
        let mut model = self;
        for _ in 0..STEPS {
            let mut normal = [[0.0; 5]; 4];
            for point in points {
                let (h, d) = (model.at(point.hz), model.denominator(point.hz));
                let r = point.hz / model.f0_hz;
                let derivatives = [
                    h,
                    -h / d * Complex::new(2.0 * r * r, -r / model.q),
                    h / d * Complex::new(0.0, r / model.q),
                    // In periods of the resonance.
                    h * Complex::new(0.0, -TAU * r),
                ];
                let error = point.ratio - h;
                let weight = point.command * point.command;
                accumulate(&mut normal, derivatives.map(|d| d.re), error.re, weight);
                accumulate(&mut normal, derivatives.map(|d| d.im), error.im, weight);
            }
            let Some([gain, f0, q, delay]) = solve(normal) else { break };
            let before = model.error(points);
            let better = (0..10).map(|halving| 0.5_f64.powi(halving)).find_map(|share| {
                let next = Self {
                    gain: model.gain * (1.0 + share * gain),
                    f0_hz: model.f0_hz * (1.0 + share * f0),
                    q: model.q * (1.0 + share * q),
                    delay_s: model.delay_s + share * delay / model.f0_hz,
                };
                (next.error(points) < before).then_some(next)
            });
            let Some(next) = better else { break };
            model = next;
        }
        model
    }
}

/// Adds an equation `row . x = value` to the normal equations, whose last column is the right-hand side.
fn accumulate<const N: usize, const M: usize>(
    normal: &mut [[f64; M]; N],
    row: [f64; N],
    value: f64,
    weight: f64,
) {
    for (equation, a) in normal.iter_mut().zip(row) {
        for (entry, b) in equation.iter_mut().zip(row.into_iter().chain([value])) {
            *entry += weight * a * b;
        }
    }
}

/// Gaussian elimination with pivoting; `None` for a singular matrix. It stays beside nalgebra's `LU` because the steps
/// of the fit end at rounding errors: with another order of operations, the tests' resonances change by up to 5e-11.
fn solve<const N: usize, const M: usize>(mut rows: [[f64; M]; N]) -> Option<[f64; N]> {
    for column in 0..N {
        let pivot = (column..N).max_by(|&a, &b| rows[a][column].abs().total_cmp(&rows[b][column].abs()))?;
        rows.swap(column, pivot);
        let pivot_row = rows[column];
        if !(pivot_row[column].abs() > 0.0 && pivot_row[column].is_finite()) {
            return None;
        }
        for row in (0..N).filter(|&row| row != column) {
            let factor = rows[row][column] / pivot_row[column];
            for (entry, above) in rows[row].iter_mut().zip(pivot_row) {
                *entry -= factor * above;
            }
        }
    }
    Some(std::array::from_fn(|row| rows[row][N] / rows[row][row]))
}
