//! A lamp that flickers while a sweep or a cycle of a film is taken: followed by the times of the frames.

use std::f64::consts::TAU;

use nalgebra::{Complex, DMatrix, DVector};
use rayon::prelude::*;

use super::super::super::PlaneError;
use super::super::CalibrateError;
use super::exposures::{FrameExposures, TimedImage, turn};
use super::search::MOST_SHARE;
use super::unexplained::{Unexplained, UnexplainedRow};

/// A sinusoid whose amplitude and phase change slowly: the room's light is its level times `1 + Re(c(t) exp(2 pi i f
/// t))`.
#[derive(Debug, Clone, PartialEq)]
pub struct LampFlicker {
    /// Frequency.
    pub frequency_hz: f64,
    /// Time from the start of one camera row's exposure to the start of the next row's.
    row_time_s: f64,
    /// Times of the amplitudes, ascending; between them `c` is linear.
    knots_s: Vec<f64>,
    amplitudes: Vec<Complex<f64>>,
    /// Share that it explains of what pixels of a row have in common and transport does not explain.
    explained: f64,
}

/// A lamp must explain this share of what images show beyond their scene; a dozen unknowns explain some of anything.
pub(super) const LEAST_SEEN: f64 = 0.7;
/// Time between amplitudes.
const KNOT_S: f64 = 3.0;
/// Most amplitudes for a long sweep.
const MOST_KNOTS: usize = 32;
/// A pause that no amplitude bridges.
pub(super) const PAUSE_S: f64 = 2.0 * KNOT_S;
/// How often the frequency is found again.
const ROUNDS: usize = 4;

impl LampFlicker {
    /// Follows a lamp of about this frequency through a sweep, or through one or more cycles of a film. `lamp` is the
    /// frequency, and the time from the start of one camera row's exposure to the start of the next row's, in s.
    ///
    /// The scene's own light is projected out of the images: what a setting shows beyond that which transport can
    /// explain, at many pixels alike, is fitted by two unknowns for each of a few times, between which amplitude and
    /// phase are interpolated. Their drift then corrects the frequency.
    ///
    /// # Errors
    /// [`CalibrateError::NoPixels`] if the room's light does not reach the sample;
    /// [`PlaneError::NotConvex`] if the images do not tell the amplitudes.
    pub fn follow(parts: &[Unexplained], lamp: (f64, f64)) -> Result<Self, CalibrateError> {
        let (mut frequency_hz, row_time_s) = lamp;
        let knots_s = knots(parts.iter().flat_map(|part| &part.images));
        let mut amplitudes = vec![Complex::ZERO; knots_s.len()];
        for _ in 0..ROUNDS {
            amplitudes = fit(parts, &knots_s, (frequency_hz, row_time_s))?;
            let drift_hz = drift_hz(&knots_s, &amplitudes);
            if drift_hz.abs() < 1e-4 {
                break;
            }
            frequency_hz += drift_hz;
            let turned = amplitudes.iter_mut().zip(&knots_s);
            turned.for_each(|(amplitude, &knot_s)| *amplitude *= turn(-drift_hz, knot_s));
        }
        amplitudes = fit(parts, &knots_s, (frequency_hz, row_time_s))?;
        let explained = explained(parts, &knots_s, (frequency_hz, row_time_s), &amplitudes);
        Ok(Self { frequency_hz, row_time_s, knots_s, amplitudes, explained })
    }

    /// By how much longer than it did an exposure of camera row `t` would have seen the steady light of the room for
    /// what the flicker added, in us.
    pub fn excess_us(&self, frames: &FrameExposures, t: usize) -> f64 {
        let of_frame = |&opened_s: &f64| {
            let amplitude: Complex<f64> = hats(&self.knots_s, opened_s)
                .into_iter()
                .flatten()
                .map(|(knot, hat)| self.amplitudes[knot] * hat)
                .sum();
            let frame = FrameExposures { exposure_us: frames.exposure_us, opened_s: vec![opened_s] };
            (amplitude
                * frame.phasor(self.frequency_hz, |_| 1.0)
                * turn(self.frequency_hz, self.row_time_s * t as f64))
            .re
        };
        frames.opened_s.iter().map(of_frame).sum::<f64>() / frames.opened_s.len().max(1) as f64
    }

    /// Mean amplitude as a share of the room's light.
    pub fn share(&self) -> f64 {
        self.amplitudes.iter().map(|amplitude| amplitude.norm()).sum::<f64>()
            / self.amplitudes.len().max(1) as f64
    }

    /// Whether the images show this lamp: it explains most of what the pixels of a row have in common beyond the scene's
    /// light. What has another phase in each image does not look like a lamp.
    pub fn is_seen(&self) -> bool {
        self.explained >= LEAST_SEEN && self.is_possible()
    }

    /// Whether light can flicker like that: it is never negative.
    pub fn is_possible(&self) -> bool {
        self.share() <= MOST_SHARE
    }
}

/// Amplitudes at the knots by least squares.
fn fit(
    parts: &[Unexplained],
    knots_s: &[f64],
    (frequency_hz, row_time_s): (f64, f64),
) -> Result<Vec<Complex<f64>>, CalibrateError> {
    let unknowns = 2 * knots_s.len();
    let seen: Vec<DMatrix<Complex<f64>>> =
        parts.iter().map(|part| seen_us(&part.images, knots_s, frequency_hz)).collect();
    let of_row = |(part, seen, row): &(&Unexplained, &DMatrix<Complex<f64>>, &UnexplainedRow)| {
        let columns = columns(seen, turn(frequency_hz, row_time_s * row.t as f64));
        let normal = columns.tr_mul(&(&part.projectors[row.projector] * &columns)) * row.weight;
        (normal, columns.tr_mul(&row.light))
    };
    let rows: Vec<_> = parts
        .iter()
        .zip(&seen)
        .flat_map(|(part, seen)| part.rows.iter().map(move |row| (part, seen, row)))
        .collect();
    // Summed in the order of the rows, so that the result is the same for any number of threads.
    let sums: Vec<_> = rows.par_iter().map(of_row).collect();
    let (mut normal, mut right) = (DMatrix::zeros(unknowns, unknowns), DVector::zeros(unknowns));
    for (part, light) in &sums {
        normal += part;
        right += light;
    }
    let ridge = 1e-9 * normal.trace() / unknowns as f64;
    if ridge <= 0.0 || ridge.is_nan() {
        return Err(CalibrateError::NoPixels);
    }
    normal += DMatrix::identity(unknowns, unknowns) * ridge;
    let found = normal.cholesky().ok_or(PlaneError::NotConvex)?.solve(&right);
    Ok((0..knots_s.len()).map(|knot| Complex::new(found[2 * knot], found[2 * knot + 1])).collect())
}

/// What each image saw of unit amplitude at each knot, less its dark image, in row 0 and in us.
fn seen_us(images: &[TimedImage], knots_s: &[f64], frequency_hz: f64) -> DMatrix<Complex<f64>> {
    DMatrix::from_fn(images.len(), knots_s.len(), |image, knot| {
        let hat = |time_s: f64| {
            let at = hats(knots_s, time_s).into_iter().flatten().find(|(at, _)| *at == knot);
            at.map_or(0.0, |(_, hat)| hat)
        };
        let TimedImage { light, dark } = &images[image];
        light.phasor(frequency_hz, hat) - dark.phasor(frequency_hz, hat)
    })
}

/// The same for real and imaginary parts of the amplitudes, in the row of this phase.
fn columns(seen_us: &DMatrix<Complex<f64>>, turned: Complex<f64>) -> DMatrix<f64> {
    DMatrix::from_fn(seen_us.nrows(), 2 * seen_us.ncols(), |image, unknown| {
        let seen = seen_us[(image, unknown / 2)] * turned;
        if unknown % 2 == 0 { seen.re } else { -seen.im }
    })
}

/// Share of the rows' common light that amplitudes explain.
fn explained(
    parts: &[Unexplained],
    knots_s: &[f64],
    (frequency_hz, row_time_s): (f64, f64),
    amplitudes: &[Complex<f64>],
) -> f64 {
    let components = amplitudes.iter().flat_map(|amplitude| [amplitude.re, amplitude.im]);
    let components = DVector::from_iterator(2 * amplitudes.len(), components);
    let (mut before, mut after) = (0.0, 0.0);
    for part in parts {
        let seen = seen_us(&part.images, knots_s, frequency_hz);
        for row in part.rows.iter().filter(|row| row.weight > 0.0) {
            let flicker = columns(&seen, turn(frequency_hz, row_time_s * row.t as f64)) * &components;
            let rest = &row.light - &part.projectors[row.projector] * flicker * row.weight;
            before += row.light.norm_squared() / row.weight;
            after += rest.norm_squared() / row.weight;
        }
    }
    if before > 0.0 { 1.0 - after / before } else { 0.0 }
}

/// Times for amplitudes: ends of every stretch without a pause, and evenly between them.
fn knots<'a>(images: impl Iterator<Item = &'a TimedImage>) -> Vec<f64> {
    let mut times: Vec<f64> =
        images.flat_map(|image| image.light.opened_s.iter().chain(&image.dark.opened_s)).copied().collect();
    times.sort_by(f64::total_cmp);
    let stretches: Vec<&[f64]> = times.chunk_by(|a, b| b - a < PAUSE_S).collect();
    let length = |stretch: &[f64]| stretch[stretch.len() - 1] - stretch[0];
    let total_s: f64 = stretches.iter().map(|stretch| length(stretch)).sum();
    let step_s = KNOT_S.max(total_s / MOST_KNOTS as f64);
    let of_stretch = |stretch: &&[f64]| {
        let steps = (length(stretch) / step_s).round() as usize;
        let (first, step_s) = (stretch[0], length(stretch) / steps.max(1) as f64);
        (0..=steps).map(move |step| first + step_s * step as f64).collect::<Vec<f64>>()
    };
    stretches.iter().flat_map(of_stretch).collect()
}

/// The knots next to a time, with their weights.
fn hats(knots_s: &[f64], time_s: f64) -> [Option<(usize, f64)>; 2] {
    let above = knots_s.partition_point(|&knot_s| knot_s <= time_s);
    if above == 0 || above == knots_s.len() {
        return [Some((above.saturating_sub(1), 1.0)), None];
    }
    let share = (time_s - knots_s[above - 1]) / (knots_s[above] - knots_s[above - 1]);
    [Some((above - 1, 1.0 - share)), Some((above, share))]
}

/// By how much the frequency exceeds the assumed one, by the phases of neighbouring amplitudes.
fn drift_hz(knots_s: &[f64], amplitudes: &[Complex<f64>]) -> f64 {
    let pairs = knots_s.windows(2).zip(amplitudes.windows(2));
    let pairs = pairs.filter(|(knots_s, _)| knots_s[1] - knots_s[0] < PAUSE_S);
    let (weighted, weight) = pairs.fold((0.0, 0.0), |(weighted, weight), (knots_s, pair)| {
        let step_s = knots_s[1] - knots_s[0];
        let between = pair[1] * pair[0].conj();
        let strength = between.norm() * step_s * step_s;
        (weighted + strength * between.arg() / (TAU * step_s), weight + strength)
    });
    if weight > 0.0 { weighted / weight } else { 0.0 }
}
