//! A lamp that flickers in the dark images of a sweep.

use nalgebra::Complex;
use ndarray::{Array1, Array2};

use super::exposures::{FrameExposures, turn};
use super::search::{self, FINE_HZ, Sinusoid};

/// Means of some camera rows of a dark image, taken in a room with light.
#[derive(Debug, Clone, PartialEq)]
pub struct DarkRows {
    /// The frames of the image.
    pub frames: FrameExposures,
    /// Mean counts of each of the rows.
    pub means_dn: Vec<f64>,
}

/// What dark images say of a lamp.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DarkFlicker {
    /// Frequency.
    pub frequency_hz: f64,
    /// Amplitude as a share of the room's light.
    pub share: f64,
}

/// Flicker must explain this many times the variance of the rest, and at least half of what the images show.
const LEAST_EVIDENCE: f64 = 40.0;
const LEAST_EXPLAINED: f64 = 0.5;
/// How often the rows' levels, or the frequency, are found again.
const ROUNDS: usize = 4;

impl DarkFlicker {
    /// Searches for flicker in dark images of at least three exposures. With fewer, each row's dark level and the level
    /// of the room explain everything. `rows` are the camera rows of the means.
    pub fn find(darks: &[DarkRows], rows: &[usize], row_time_s: f64) -> Option<Self> {
        let series = DarkSeries::new(darks, rows, row_time_s)?;
        // Images at even distances look alike under several frequencies, until the levels of the rows are right.
        let peaks = search::peaks(series.step_hz, |frequency_hz| series.fit(frequency_hz));
        let best = search::best(peaks.into_iter().filter_map(|peak| series.settled(darks, peak)))?;
        let total: f64 = series.rest.iter().map(|rest| rest * rest).sum();
        let degrees = (series.rest.len() - 2 * rows.len()).saturating_sub(2).max(1) as f64;
        let variance = (total - best.explained) / degrees;
        (best.explained >= LEAST_EVIDENCE * variance && best.explained >= LEAST_EXPLAINED * total)
            .then_some(Self { frequency_hz: best.frequency_hz, share: best.amplitude.norm() })
    }
}

/// Dark images without what a constant and a part that grows with the exposure explain in each row.
#[derive(Clone)]
struct DarkSeries<'a> {
    rows: &'a [usize],
    row_time_s: f64,
    frames: Vec<FrameExposures>,
    /// Orthonormal vectors of the constant and of the exposure, over the images.
    basis: [Array1<f64>; 2],
    /// `[images, rows]`.
    rest: Array2<f64>,
    /// Light of the room in each row, in DN per us.
    levels: Vec<f64>,
    step_hz: f64,
}

impl<'a> DarkSeries<'a> {
    fn new(darks: &[DarkRows], rows: &'a [usize], row_time_s: f64) -> Option<Self> {
        let count = darks.len() as f64;
        let exposures: Array1<f64> = darks.iter().map(|dark| dark.frames.exposure_us).collect();
        let from_mean = &exposures - exposures.sum() / count;
        let spread = from_mean.dot(&from_mean).sqrt();
        let times = || darks.iter().flat_map(|dark| dark.frames.opened_s.iter().copied());
        let is_complete = darks.iter().all(|dark| dark.means_dn.len() == rows.len());
        if darks.len() < 3 || rows.is_empty() || spread <= 0.0 || !is_complete || times().next().is_none() {
            return None;
        }
        // Times are counted from the middle of the record, so that the frequency hardly changes the phase.
        let (first, last) =
            times().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), time| (a.min(time), b.max(time)));
        let middle_s = (first + last) / 2.0;
        let frames = darks.iter().map(|dark| FrameExposures {
            opened_s: dark.frames.opened_s.iter().map(|opened| opened - middle_s).collect(),
            ..dark.frames
        });
        let basis = [Array1::from_elem(darks.len(), 1.0 / count.sqrt()), from_mean / spread];
        let means = Array2::from_shape_fn((darks.len(), rows.len()), |(e, at)| darks[e].means_dn[at]);
        let mut rest = means.clone();
        let mut levels = Vec::with_capacity(rows.len());
        for (mut rest, means) in rest.columns_mut().into_iter().zip(means.columns()) {
            for vector in &basis {
                rest.scaled_add(-vector.dot(&means), vector);
            }
            levels.push(basis[1].dot(&means) / spread);
        }
        let step_hz = search::step_hz(last - first);
        Some(Self { rows, row_time_s, frames: frames.collect(), basis, rest, levels, step_hz })
    }

    /// A peak with the levels of the rows that belong to it.
    fn settled(&self, darks: &[DarkRows], peak: Sinusoid) -> Option<Sinusoid> {
        let mut series = self.clone();
        let mut best = series.refined(peak, self.step_hz)?;
        for _ in 0..ROUNDS {
            series.set_levels(darks, &best);
            best = series.refined(best, 10.0 * FINE_HZ)?;
        }
        Some(best)
    }

    fn refined(&self, around: Sinusoid, within_hz: f64) -> Option<Sinusoid> {
        search::refined(around.frequency_hz, within_hz, |frequency_hz| self.fit(frequency_hz))
    }

    /// The least-squares amplitude of a frequency, if there can be any.
    fn fit(&self, frequency_hz: f64) -> Option<Sinusoid> {
        let mut of_images: Vec<Complex<f64>> =
            self.frames.iter().map(|frames| frames.phasor(frequency_hz, |_| 1.0)).collect();
        for vector in &self.basis {
            let along: Complex<f64> = of_images.iter().zip(vector).map(|(z, v)| z * *v).sum();
            of_images.iter_mut().zip(vector).for_each(|(z, v)| *z -= along * *v);
        }
        let of_rows = self
            .rows
            .iter()
            .zip(&self.levels)
            .map(|(&t, level)| turn(frequency_hz, self.row_time_s * t as f64) * *level);
        let of_rows: Vec<Complex<f64>> = of_rows.collect();
        let sums = |of: &[Complex<f64>]| {
            let squares: Complex<f64> = of.iter().map(|z| z * z).sum();
            (of.iter().map(|z| z.norm_sqr()).sum::<f64>(), squares)
        };
        let ((images, image_squares), (rows, row_squares)) = (sums(&of_images), sums(&of_rows));
        let (norm, square) = (images * rows, image_squares * row_squares);
        let mut product = Complex::<f64>::ZERO;
        for (image, rest) in of_images.iter().zip(self.rest.rows()) {
            product += image * of_rows.iter().zip(rest).map(|(row, rest)| row * *rest).sum::<Complex<f64>>();
        }
        Sinusoid::fitted(frequency_hz, norm, square, product)
    }

    /// Finds the rows' levels again, given the flicker.
    fn set_levels(&mut self, darks: &[DarkRows], fit: &Sinusoid) {
        let of_images: Vec<Complex<f64>> =
            self.frames.iter().map(|frames| frames.phasor(fit.frequency_hz, |_| 1.0)).collect();
        for ((level, &t), at) in self.levels.iter_mut().zip(self.rows).zip(0..) {
            let turned = fit.amplitude * turn(fit.frequency_hz, self.row_time_s * t as f64);
            let seen_us: Vec<f64> = of_images
                .iter()
                .zip(&self.frames)
                .map(|(image, frames)| frames.exposure_us + (turned * image).re)
                .collect();
            let counts = darks.iter().map(|dark| dark.means_dn[at]);
            if let Some(slope) = slope(seen_us.iter().copied().zip(counts)) {
                *level = slope;
            }
        }
    }
}

/// Slope of the line through points.
fn slope(points: impl Iterator<Item = (f64, f64)> + Clone) -> Option<f64> {
    let (n, x, y) = points.clone().fold((0.0, 0.0, 0.0), |(n, sx, sy), (x, y)| (n + 1.0, sx + x, sy + y));
    let (x, y) = (x / n, y / n);
    let spread: f64 = points.clone().map(|(at, _)| (at - x).powi(2)).sum();
    let product: f64 = points.map(|(at, value)| (at - x) * (value - y)).sum();
    (spread > 0.0).then(|| product / spread)
}
