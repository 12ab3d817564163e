//! A lamp that flickers in the first cycles of a film.

use nalgebra::{Complex, DMatrix, DVector};

use super::exposures::turn;
use super::lamp::{LEAST_SEEN, PAUSE_S};
use super::search::{self, Sinusoid};
use super::unexplained::Unexplained;

/// What cycles of a film say of a lamp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CycleFlicker {
    /// Frequency.
    pub frequency_hz: f64,
    /// Amplitude as a share of the room's light.
    pub share: f64,
}

/// How far a lamp may be from its expected frequency.
const EXPECTED_WITHIN_HZ: f64 = 0.5;
/// How probable it may be that errors which all rows of a frame share, such as jitter, look as much like a lamp of one
/// frequency.
const MOST_CHANCE: f64 = 1e-6;

impl CycleFlicker {
    /// Searches cycles for a lamp: first at the frequency that is expected of it, if one is, then at all others. What
    /// transport does not explain must be explained by a sinusoid that is the same in all cycles; the rows, each exposed
    /// a little later than the one before, tell its frequency from its aliases, even if all cycles see it in the same
    /// phase.
    pub fn find(cycles: &[Unexplained], row_time_s: f64, expected_hz: Option<f64>) -> Option<Self> {
        let opened = || {
            let images = cycles.iter().flat_map(|cycle| &cycle.images);
            images.flat_map(|image| image.light.opened_s.iter().copied())
        };
        let record_s = opened().fold(f64::NEG_INFINITY, f64::max) - opened().fold(f64::INFINITY, f64::min);
        let step_hz = search::step_hz(record_s.min(PAUSE_S));
        let fit = |frequency_hz: f64| fit(cycles, frequency_hz, row_time_s);
        let total: f64 = cycles.iter().flat_map(|cycle| &cycle.rows).map(|row| row.power).sum();
        let degrees: f64 = cycles.iter().map(degrees).sum::<f64>() - 2.0;
        let is_certain = |found: &Sinusoid| {
            let explained = found.explained / total;
            explained >= LEAST_SEEN && (1.0 - explained).max(0.0).powf(degrees / 2.0) <= MOST_CHANCE
        };
        let expected = expected_hz.and_then(|at_hz| search::refined(at_hz, EXPECTED_WITHIN_HZ, fit));
        let found = expected.filter(is_certain).or_else(|| {
            let peaks = search::peaks(step_hz, fit).into_iter();
            let closer = peaks.filter_map(|peak| search::refined(peak.frequency_hz, step_hz, fit));
            search::best(closer).filter(is_certain)
        })?;
        Some(Self { frequency_hz: found.frequency_hz, share: found.amplitude.norm() })
    }
}

/// Number of values that transport leaves of a row's images, on average over the rows.
fn degrees(cycle: &Unexplained) -> f64 {
    let of_rows = cycle.rows.iter().map(|row| cycle.projectors[row.projector].trace());
    of_rows.sum::<f64>() / cycle.rows.len().max(1) as f64
}

/// The sinusoid of a frequency that explains most of what transport leaves of the cycles.
fn fit(cycles: &[Unexplained], frequency_hz: f64, row_time_s: f64) -> Option<Sinusoid> {
    let (mut norm, mut square, mut product) = (0.0, Complex::ZERO, Complex::ZERO);
    for cycle in cycles {
        let seen = cycle.images.iter().map(|image| image.light.phasor(frequency_hz, |_| 1.0));
        let seen: Vec<Complex<f64>> = seen.collect();
        let re = DVector::from_iterator(seen.len(), seen.iter().map(|seen| seen.re));
        let im = DVector::from_iterator(seen.len(), seen.iter().map(|seen| seen.im));
        let of_projector = |projector: &DMatrix<f64>| {
            let [left_re, left_im] = [projector * &re, projector * &im];
            let [re_re, im_im, re_im] = [re.dot(&left_re), im.dot(&left_im), re.dot(&left_im)];
            (re_re + im_im, Complex::new(re_re - im_im, 2.0 * re_im))
        };
        let of_projectors: Vec<(f64, Complex<f64>)> = cycle.projectors.iter().map(of_projector).collect();
        for row in &cycle.rows {
            let turned = turn(frequency_hz, row_time_s * row.t as f64);
            let (row_norm, row_square) = of_projectors[row.projector];
            norm += row.weight * row_norm;
            square += turned * turned * row_square * row.weight;
            product += turned * Complex::new(re.dot(&row.light), im.dot(&row.light));
        }
    }
    Sinusoid::fitted(frequency_hz, norm, square, product)
}
