//! The search for light that flickers, by its frequency.

use nalgebra::Complex;
use rayon::prelude::*;

/// Frequencies that are tried. The rows from which a sweep is judged lie too far apart for higher ones.
const LOWEST_HZ: f64 = 20.0;
const HIGHEST_HZ: f64 = 600.0;
/// Steps of the frequency: of the search, as a share of the resolution of the record, and of its refinement.
const STEP_SHARE: f64 = 0.1;
pub(super) const FINE_HZ: f64 = 0.004;
/// Light is not negative, so an amplitude cannot much exceed the level.
pub(super) const MOST_SHARE: f64 = 1.2;
/// Frequencies that are looked at closely.
const PEAKS: usize = 8;

/// A sinusoid that was fitted to images.
#[derive(Debug, Clone, Copy)]
pub(super) struct Sinusoid {
    pub frequency_hz: f64,
    pub amplitude: Complex<f64>,
    /// Part of the sum of squares that it explains.
    pub explained: f64,
}

impl Sinusoid {
    /// The least-squares amplitude `c` of a frequency, if there can be any. Of samples `y` that see `Re(c z)` of it,
    /// `norm` is the sum of `|z|^2`, `square` that of `z^2`, and `product` that of `z y`.
    pub fn fitted(frequency_hz: f64, norm: f64, square: Complex<f64>, product: Complex<f64>) -> Option<Self> {
        let normal = [(norm + square.re) / 2.0, -square.im / 2.0, (norm - square.re) / 2.0];
        let (x, y) = (product.re, -product.im);
        let determinant = normal[0] * normal[2] - normal[1] * normal[1];
        let a = (normal[2] * x - normal[1] * y) / determinant;
        let b = (normal[0] * y - normal[1] * x) / determinant;
        let amplitude = Complex::new(a, b);
        let is_possible = determinant > 1e-8 * norm * norm && amplitude.norm() <= MOST_SHARE;
        is_possible.then_some(Self { frequency_hz, amplitude, explained: a * x + b * y })
    }
}

/// The steps in which frequencies are tried on a record of this length.
pub(super) fn step_hz(record_s: f64) -> f64 {
    (STEP_SHARE / record_s.max(0.1)).min(1.0)
}

/// The frequencies that explain the images best, each better than its neighbours.
pub(super) fn peaks(step_hz: f64, fit: impl Fn(f64) -> Option<Sinusoid> + Sync) -> Vec<Sinusoid> {
    let steps = ((HIGHEST_HZ - LOWEST_HZ) / step_hz).ceil() as usize;
    let fits: Vec<Option<Sinusoid>> =
        (0..=steps).into_par_iter().map(|step| fit(LOWEST_HZ + step_hz * step as f64)).collect();
    let explained = |fit: &Option<Sinusoid>| fit.map_or(0.0, |fit| fit.explained);
    let is_peak = |fits: &&[Option<Sinusoid>]| {
        explained(&fits[1]) >= explained(&fits[0]) && explained(&fits[1]) >= explained(&fits[2])
    };
    let mut peaks: Vec<Sinusoid> = fits.windows(3).filter(is_peak).filter_map(|fits| fits[1]).collect();
    peaks.sort_by(|a, b| b.explained.total_cmp(&a.explained));
    peaks.truncate(PEAKS);
    peaks
}

/// The best frequency near another.
pub(super) fn refined(
    around_hz: f64,
    within_hz: f64,
    fit: impl Fn(f64) -> Option<Sinusoid> + Sync,
) -> Option<Sinusoid> {
    let steps = (within_hz / FINE_HZ).ceil() as i32;
    let frequency_hz = |step: i32| around_hz + FINE_HZ * f64::from(step);
    let fits: Vec<Sinusoid> =
        (-steps..=steps).into_par_iter().filter_map(|step| fit(frequency_hz(step))).collect();
    best(fits)
}

/// The one that explains most.
pub(super) fn best(fits: impl IntoIterator<Item = Sinusoid>) -> Option<Sinusoid> {
    fits.into_iter().max_by(|a, b| a.explained.total_cmp(&b.explained))
}
