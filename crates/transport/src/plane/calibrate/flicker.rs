//! A lamp that flickers while a sweep is taken: found in the dark images, followed through the sweep, and removed.

use std::f64::consts::{PI, TAU};

use nalgebra::{Complex, DMatrix, DVector};
use ndarray::{Array1, Array2};
use rayon::prelude::*;

use super::super::{PlaneError, Prior};
use super::problem::RowProblem;
use super::{CalibrateError, Sample};

/// When the frames of an averaged image were exposed.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameExposures {
    /// Exposure of each camera row.
    pub exposure_us: f64,
    /// Start of the exposure of camera row 0 in each frame, on one clock for all images.
    pub opened_s: Vec<f64>,
}

/// An image of the sweep and the dark image that was subtracted from it.
#[derive(Debug, Clone, PartialEq)]
pub struct TimedImage {
    /// The frames of the image.
    pub light: FrameExposures,
    /// The frames of its dark image.
    pub dark: FrameExposures,
}

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

/// Frequencies that are tried. The rows from which a sweep is judged lie too far apart for higher ones.
const LOWEST_HZ: f64 = 20.0;
const HIGHEST_HZ: f64 = 600.0;
/// Steps of the frequency: of the search, as a share of the resolution of the record, and of its refinement.
const STEP_SHARE: f64 = 0.1;
const FINE_HZ: f64 = 0.004;
/// Flicker must explain this many times the variance of the rest, and at least half of what the images show.
const LEAST_EVIDENCE: f64 = 40.0;
const LEAST_EXPLAINED: f64 = 0.5;
/// A lamp must explain this share of what a sweep shows beyond its scene; a dozen unknowns explain some of anything.
const LEAST_SEEN: f64 = 0.7;
/// Light is not negative, so an amplitude cannot much exceed the level.
const MOST_SHARE: f64 = 1.2;
/// Time between amplitudes.
const KNOT_S: f64 = 3.0;
/// Most amplitudes for a long sweep.
const MOST_KNOTS: usize = 32;
/// A pause that no amplitude bridges.
const PAUSE_S: f64 = 2.0 * KNOT_S;
/// The smoothness with which scene and flicker are told apart.
const PRIOR: Prior = Prior::Split { alpha: 0.01, beta: 0.001 };
/// Frequencies whose rows' levels are found.
const PEAKS: usize = 8;
/// How often the rows' levels, or the frequency, are found again.
const ROUNDS: usize = 4;
/// Most frames that are proposed for an average.
const MOST_FRAMES: u32 = 64;
/// Share of a flicker that may remain in an average that cancels it.
const CANCELLED_SHARE: f64 = 0.02;
/// Distance from multiples of the frame rate from which flicker can be followed.
const FOLLOWED_HZ: f64 = 0.5;

/// Share of a flicker that remains in the mean of `frames` frames.
pub fn averaged_share(frequency_hz: f64, frame_rate_hz: f64, frames: u32) -> f64 {
    let turn = PI * frequency_hz / frame_rate_hz;
    let n = f64::from(frames);
    if turn.sin().abs() < 1e-9 { 1.0 } else { ((n * turn).sin() / (n * turn.sin())).abs() }
}

/// The smallest number of frames, not less than `frames`, whose mean cancels a flicker at all of these frame rates;
/// `None` if 64 do not.
pub fn cancelling_frames(frequency_hz: f64, frame_rates_hz: &[f64], frames: u32) -> Option<u32> {
    let cancels = |n: &u32| {
        frame_rates_hz.iter().all(|&rate_hz| averaged_share(frequency_hz, rate_hz, *n) <= CANCELLED_SHARE)
    };
    (frames.max(1)..=MOST_FRAMES.max(frames)).find(cancels)
}

/// Whether flicker differs from frame to frame. Within 0.5 Hz of a multiple of the frame rate it is the same in all
/// frames, and cannot be told from the scene or cancelled.
pub fn can_be_followed(frequency_hz: f64, frame_rate_hz: f64) -> bool {
    let multiple = frame_rate_hz * (frequency_hz / frame_rate_hz).round();
    (frequency_hz - multiple).abs() >= FOLLOWED_HZ
}

impl FrameExposures {
    /// Mean over the frames of the integral of `hat exp(2 pi i f t)` over the exposure of row 0, in us; `hat` weighs
    /// each frame.
    fn phasor(&self, frequency_hz: f64, hat: impl Fn(f64) -> f64) -> Complex<f64> {
        let half_s = self.exposure_us * 0.5e-6;
        let seen_us = 1e6 * (TAU * frequency_hz * half_s).sin() / (PI * frequency_hz);
        let turned = |&opened_s: &f64| turn(frequency_hz, opened_s + half_s) * hat(opened_s);
        self.opened_s.iter().map(turned).sum::<Complex<f64>>() * seen_us / self.opened_s.len().max(1) as f64
    }
}

/// `exp(2 pi i f t)`.
fn turn(frequency_hz: f64, time_s: f64) -> Complex<f64> {
    Complex::from_polar(1.0, TAU * (frequency_hz * time_s).fract())
}

impl DarkFlicker {
    /// Searches for flicker in dark images of at least three exposures. With fewer, each row's dark level and the level
    /// of the room explain everything. `rows` are the camera rows of the means.
    pub fn find(darks: &[DarkRows], rows: &[usize], row_time_s: f64) -> Option<Self> {
        let series = DarkSeries::new(darks, rows, row_time_s)?;
        // Images at even distances look alike under several frequencies, until the levels of the rows are right.
        let best = series.peaks().into_iter().filter_map(|peak| series.settled(darks, peak));
        let best = best.max_by(|a, b| a.explained.total_cmp(&b.explained))?;
        let total: f64 = series.rest.iter().map(|rest| rest * rest).sum();
        let degrees = (series.rest.len() - 2 * rows.len()).saturating_sub(2).max(1) as f64;
        let variance = (total - best.explained) / degrees;
        (best.explained >= LEAST_EVIDENCE * variance && best.explained >= LEAST_EXPLAINED * total)
            .then_some(Self { frequency_hz: best.frequency_hz, share: best.amplitude.norm() })
    }
}

/// A sinusoid that was fitted to dark images.
#[derive(Debug, Clone, Copy)]
struct DarkFit {
    frequency_hz: f64,
    amplitude: Complex<f64>,
    /// Part of the sum of squares that it explains.
    explained: f64,
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
        let step_hz = (STEP_SHARE / (last - first).max(0.1)).min(1.0);
        Some(Self { rows, row_time_s, frames: frames.collect(), basis, rest, levels, step_hz })
    }

    /// The frequencies that explain the images best, each better than its neighbours.
    fn peaks(&self) -> Vec<DarkFit> {
        let steps = ((HIGHEST_HZ - LOWEST_HZ) / self.step_hz).ceil() as usize;
        let fits: Vec<Option<DarkFit>> = (0..=steps)
            .into_par_iter()
            .map(|step| self.fit(LOWEST_HZ + self.step_hz * step as f64))
            .collect();
        let explained = |fit: &Option<DarkFit>| fit.map_or(0.0, |fit| fit.explained);
        let is_peak = |fits: &&[Option<DarkFit>]| {
            explained(&fits[1]) >= explained(&fits[0]) && explained(&fits[1]) >= explained(&fits[2])
        };
        let mut peaks: Vec<DarkFit> = fits.windows(3).filter(is_peak).filter_map(|fits| fits[1]).collect();
        peaks.sort_by(|a, b| b.explained.total_cmp(&a.explained));
        peaks.truncate(PEAKS);
        peaks
    }

    /// A peak with the levels of the rows that belong to it.
    fn settled(&self, darks: &[DarkRows], peak: DarkFit) -> Option<DarkFit> {
        let mut series = self.clone();
        let mut best = series.refined(peak, self.step_hz)?;
        for _ in 0..ROUNDS {
            series.set_levels(darks, &best);
            best = series.refined(best, 10.0 * FINE_HZ)?;
        }
        Some(best)
    }

    /// The best of these frequencies.
    fn best(&self, frequencies: Vec<f64>) -> Option<DarkFit> {
        let fits: Vec<DarkFit> = frequencies.into_par_iter().filter_map(|f| self.fit(f)).collect();
        fits.into_iter().max_by(|a, b| a.explained.total_cmp(&b.explained))
    }

    fn refined(&self, around: DarkFit, within_hz: f64) -> Option<DarkFit> {
        let steps = (within_hz / FINE_HZ).ceil() as i32;
        let middle = around.frequency_hz;
        self.best((-steps..=steps).map(|step| middle + FINE_HZ * f64::from(step)).collect())
    }

    /// The least-squares amplitude of a frequency, if there can be any.
    fn fit(&self, frequency_hz: f64) -> Option<DarkFit> {
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
        let normal = [(norm + square.re) / 2.0, -square.im / 2.0, (norm - square.re) / 2.0];
        let mut right = Complex::<f64>::ZERO;
        for (image, rest) in of_images.iter().zip(self.rest.rows()) {
            right += image * of_rows.iter().zip(rest).map(|(row, rest)| row * *rest).sum::<Complex<f64>>();
        }
        let (x, y) = (right.re, -right.im);
        let determinant = normal[0] * normal[2] - normal[1] * normal[1];
        let a = (normal[2] * x - normal[1] * y) / determinant;
        let b = (normal[0] * y - normal[1] * x) / determinant;
        let amplitude = Complex::new(a, b);
        let is_possible = determinant > 1e-8 * norm * norm && amplitude.norm() <= MOST_SHARE;
        is_possible.then_some(DarkFit { frequency_hz, amplitude, explained: a * x + b * y })
    }

    /// Finds the rows' levels again, given the flicker.
    fn set_levels(&mut self, darks: &[DarkRows], fit: &DarkFit) {
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

impl LampFlicker {
    /// Follows a lamp of about this frequency through a sweep. `images` are those of the sample's settings, `levels_us`
    /// the room's light at its pixels, in the units of the stack per us.
    ///
    /// The scene's own light is projected out of the images: what a setting shows beyond that which transport can
    /// explain, at many pixels alike, is fitted by two unknowns for each of a few times, between which amplitude and
    /// phase are interpolated. Their drift then corrects the frequency.
    ///
    /// # Errors
    /// [`CalibrateError::NoPixels`] if the room's light does not reach the sample;
    /// [`PlaneError::NotConvex`] for a model without solution.
    pub fn follow(
        sample: &Sample,
        beam_sigma_rows: f64,
        images: &[TimedImage],
        levels_us: &[f64],
        lamp: (f64, f64),
    ) -> Result<Self, CalibrateError> {
        let (mut frequency_hz, row_time_s) = lamp;
        let projected = projected_rows(sample, beam_sigma_rows, levels_us)?;
        let knots_s = knots(images);
        let mut amplitudes = vec![Complex::ZERO; knots_s.len()];
        for _ in 0..ROUNDS {
            amplitudes = fit(&projected, images, &knots_s, (frequency_hz, row_time_s))?;
            let drift_hz = drift_hz(&knots_s, &amplitudes);
            if drift_hz.abs() < 1e-4 {
                break;
            }
            frequency_hz += drift_hz;
            let turned = amplitudes.iter_mut().zip(&knots_s);
            turned.for_each(|(amplitude, &knot_s)| *amplitude *= turn(-drift_hz, knot_s));
        }
        amplitudes = fit(&projected, images, &knots_s, (frequency_hz, row_time_s))?;
        let explained = explained(&projected, images, &knots_s, (frequency_hz, row_time_s), &amplitudes);
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

    /// Whether the sweep shows this lamp: it explains most of what the pixels of a row have in common beyond the scene's
    /// light. What has another phase in each image does not look like a lamp.
    pub fn is_seen(&self) -> bool {
        self.explained >= LEAST_SEEN && self.share() <= MOST_SHARE
    }
}

/// The light of the sample's rows without what transport explains, weighted and summed over the pixels of a row.
struct ProjectedRow {
    t: usize,
    /// `M = 1 - A H^-1 A'` of the row's model.
    projector: usize,
    /// Sum over pixels of `q m M y`.
    light: DVector<f64>,
    /// Sum over pixels of `q m^2`.
    weight: f64,
}

struct Projected {
    projectors: Vec<DMatrix<f64>>,
    rows: Vec<ProjectedRow>,
}

fn projected_rows(
    sample: &Sample,
    beam_sigma_rows: f64,
    levels_us: &[f64],
) -> Result<Projected, CalibrateError> {
    let (mut projectors, mut rows) = (Vec::new(), Vec::<ProjectedRow>::new());
    let mean_light = |pixel: ndarray::ArrayView1<f64>| pixel.sum() / pixel.len() as f64;
    let lights =
        || sample.classes.iter().flat_map(|class| class.intensities.rows().into_iter().map(mean_light));
    let least_light = 0.01 * lights().sum::<f64>() / lights().count().max(1) as f64;
    let mut levels = levels_us.iter();
    for class in &sample.classes {
        let weights = class.weights(beam_sigma_rows);
        let problem = RowProblem::new(weights.clone(), PRIOR.differences(&class.slots), &PRIOR)?;
        let explained = weights.dot(&problem.inverse()?).dot(&weights.t());
        let settings = weights.nrows();
        let projector = DMatrix::from_fn(settings, settings, |i, j| f64::from(i == j) - explained[[i, j]]);
        let first = rows.len();
        for (&(t, _), pixel) in class.pixels.iter().zip(class.intensities.rows()) {
            let level = levels.next().copied().unwrap_or(0.0);
            let weight = 1.0 / mean_light(pixel).max(least_light).max(f64::MIN_POSITIVE);
            let light = DVector::from_iterator(settings, pixel.iter().map(|light| light * weight * level));
            match rows[first..].iter_mut().find(|row| row.t == t) {
                Some(row) => {
                    row.light += light;
                    row.weight += weight * level * level;
                }
                None => rows.push(ProjectedRow {
                    t,
                    projector: projectors.len(),
                    light,
                    weight: weight * level * level,
                }),
            }
        }
        rows[first..].iter_mut().for_each(|row| row.light = &projector * &row.light);
        projectors.push(projector);
    }
    Ok(Projected { projectors, rows })
}

/// Amplitudes at the knots by least squares.
fn fit(
    projected: &Projected,
    images: &[TimedImage],
    knots_s: &[f64],
    (frequency_hz, row_time_s): (f64, f64),
) -> Result<Vec<Complex<f64>>, CalibrateError> {
    let unknowns = 2 * knots_s.len();
    let seen = seen_us(images, knots_s, frequency_hz);
    let of_row = |row: &ProjectedRow| {
        let columns = columns(&seen, turn(frequency_hz, row_time_s * row.t as f64));
        let normal = columns.tr_mul(&(&projected.projectors[row.projector] * &columns)) * row.weight;
        (normal, columns.tr_mul(&row.light))
    };
    // Summed in the order of the rows, so that the result is the same for any number of threads.
    let parts: Vec<_> = projected.rows.par_iter().map(of_row).collect();
    let (mut normal, mut right) = (DMatrix::zeros(unknowns, unknowns), DVector::zeros(unknowns));
    for (part, light) in &parts {
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
    projected: &Projected,
    images: &[TimedImage],
    knots_s: &[f64],
    (frequency_hz, row_time_s): (f64, f64),
    amplitudes: &[Complex<f64>],
) -> f64 {
    let seen = seen_us(images, knots_s, frequency_hz);
    let parts = amplitudes.iter().flat_map(|amplitude| [amplitude.re, amplitude.im]);
    let parts = DVector::from_iterator(2 * amplitudes.len(), parts);
    let (mut before, mut after) = (0.0, 0.0);
    for row in projected.rows.iter().filter(|row| row.weight > 0.0) {
        let flicker = columns(&seen, turn(frequency_hz, row_time_s * row.t as f64)) * &parts;
        let rest = &row.light - &projected.projectors[row.projector] * flicker * row.weight;
        before += row.light.norm_squared() / row.weight;
        after += rest.norm_squared() / row.weight;
    }
    if before > 0.0 { 1.0 - after / before } else { 0.0 }
}

/// Times for amplitudes: ends of every stretch without a pause, and evenly between them.
fn knots(images: &[TimedImage]) -> Vec<f64> {
    let mut times: Vec<f64> = images
        .iter()
        .flat_map(|image| image.light.opened_s.iter().chain(&image.dark.opened_s))
        .copied()
        .collect();
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
