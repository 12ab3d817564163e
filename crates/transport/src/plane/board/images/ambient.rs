use std::f64::consts::{PI, TAU};

use nalgebra::{Matrix3, Vector3};
use ndarray::{Array1, Array2, ArrayView2, ArrayView3, Axis};
use rayon::prelude::*;

use super::{
    Estimate, ImagesError, SensorNoise, check_frames, check_range, check_shape, is_usable, mean_image, median,
};

/// Frames of the black picture without cap, with one exposure.
#[derive(Debug, Clone, Copy)]
pub struct BlackFrames<'a> {
    /// The exposure of each row.
    pub exposure_us: f64,
    /// The frames, `[n, t, s]`.
    pub frames: ArrayView3<'a, f32>,
    /// The dark image at this exposure, `[t, s]`.
    pub dark_dn: ArrayView2<'a, f32>,
    /// When the exposure of row 0 began in each frame, on one clock for all runs.
    pub opened_s: &'a [f64],
}

/// The light of the room.
#[derive(Debug, Clone, PartialEq)]
pub struct Ambient {
    /// Its mean level, `[t, s]`.
    pub level_dn_per_us: Array2<f32>,
    /// Standard deviation of the level, `[t, s]`.
    pub level_sd: Array2<f32>,
    /// What a frame contains whatever its exposure: the light of the projector's black picture, `[t, s]`. 0 with a
    /// single exposure, where it is part of the level.
    pub projector_black_dn: Array2<f32>,
    /// Its flicker, if there is any that the frames can show.
    pub flicker: Option<Flicker>,
}

/// A sinusoidal flicker: the light is `level (1 + share cos(2 pi frequency (time - reference) + phase))`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Flicker {
    /// Frequency.
    pub frequency_hz: Estimate,
    /// Amplitude as a share of the level.
    pub share: Estimate,
    /// Phase at the reference.
    pub phase_rad: Estimate,
    /// Middle of the record, on the frames' clock.
    pub reference_s: f64,
    /// Another frequency that explains the frames as well, to within chance.
    pub alias_hz: Option<f64>,
    /// Whether the frequency is 0.5 Hz or more from each multiple of the frame rate. Closer to it, flicker is the same
    /// in all frames and cannot be separated from the level; its amplitude is a rough estimate then. Flicker at a
    /// multiple itself leaves no trace.
    pub separable: bool,
    /// The camera's frame rate.
    pub frame_rate_hz: f64,
}

/// Frequencies that are tried.
const LOWEST_HZ: f64 = 10.0;
const HIGHEST_HZ: f64 = 1000.0;
const STEP_HZ: f64 = 0.02;
/// Rows are averaged over this time for the scan, a quarter of the shortest period.
const BIN_US: f64 = 250.0;
/// Flicker must explain this many times the variance of the rest: by chance, one of 50 000 frequencies reaches 25.
const LEAST_EVIDENCE: f64 = 40.0;
/// An alias explains the frames as well if its evidence is lower by less than this: 4 standard deviations.
const ALIAS_EVIDENCE: f64 = 16.0;
/// Light is not negative, so an amplitude cannot much exceed the level.
const MOST_SHARE: f64 = 1.2;
/// Number of times that the rows' levels and the flicker are fitted in turn.
const LEVEL_STEPS: usize = 4;
/// Distance from multiples of the frame rate from which flicker can be separated.
const SEPARABLE_HZ: f64 = 0.5;
/// Largest accepted amplitude of flicker that cannot be separated, of white in a row's dwell.
const MOST_FLICKER: f64 = 0.0005;

/// Level and flicker of the room's light from frames of the black picture, usually of two exposures.
///
/// Rows are averaged over their usable columns. Each row's mean over the frames of one exposure is its level, and the
/// rest is fitted by a sinusoid at the rows' mid-exposures, over frequencies from 10 to 1000 Hz in steps of 0.02 Hz.
/// The time between rows tells a frequency from its aliases at the frame rate. Columns with lamps of different phase
/// would average out.
///
/// # Errors
/// [`ImagesError::TooFew`] for runs of fewer than 8 frames or without usable pixels; [`ImagesError::Shape`];
/// [`ImagesError::OutOfRange`].
pub fn ambient(
    runs: &[BlackFrames],
    camera_row_time_us: f64,
    frame_rate_hz: f64,
    noise: SensorNoise,
    usable: Option<ArrayView2<bool>>,
) -> Result<Ambient, ImagesError> {
    noise.check()?;
    check(runs, camera_row_time_us, frame_rate_hz)?;
    let mut rows = RowMeans::new(runs, camera_row_time_us, frame_rate_hz, usable)?;
    let flicker = rows.flicker();
    let shares =
        |run: usize, frame: usize, t: usize| flicker.map_or(0.0, |found| rows.share(&found, run, frame, t));
    let mut ambient = level(runs, noise, shares);
    ambient.flicker = flicker;
    Ok(ambient)
}

/// Level of the room's light from frames whose times are not needed: those of lamps that do not flicker.
///
/// # Errors
/// [`ImagesError::TooFew`] for runs of fewer than 8 frames; [`ImagesError::Shape`]; [`ImagesError::OutOfRange`].
pub fn steady(runs: &[BlackFrames], noise: SensorNoise) -> Result<Ambient, ImagesError> {
    noise.check()?;
    check_frames_of(runs)?;
    Ok(level(runs, noise, |_, _, _| 0.0))
}

impl Ambient {
    /// Median level as a share of white, in the time of one projector row.
    pub fn level_of_white(&self, white_dn: f64, row_time_us: f64) -> f64 {
        let mut levels: Vec<f64> = self
            .level_dn_per_us
            .iter()
            .filter(|level| level.is_finite())
            .map(|&level| f64::from(level))
            .collect();
        median(&mut levels).unwrap_or(0.0) * row_time_us / white_dn
    }

    /// The room's light in an exposure that begins at `opened_s` in row 0, `[t, s]` in DN; without a time, on average.
    pub fn light_dn(&self, exposure_us: f64, opened_s: Option<f64>, camera_row_time_us: f64) -> Array2<f32> {
        let mut light_dn = &self.level_dn_per_us * exposure_us as f32;
        if let Some((flicker, opened_s)) = self.flicker.zip(opened_s) {
            let middle_s = opened_s + exposure_us * 0.5e-6 - flicker.reference_s;
            for (t, mut row) in light_dn.rows_mut().into_iter().enumerate() {
                let share =
                    flicker.share_at(exposure_us * 1e-6, middle_s + t as f64 * camera_row_time_us * 1e-6);
                row.mapv_inplace(|light| light * (1.0 + share) as f32);
            }
        }
        light_dn
    }

    /// Refuses flicker that the frames of a run could not follow.
    ///
    /// # Errors
    /// [`ImagesError::Flicker`] if it lies within 0.5 Hz of a multiple of the frame rate and its amplitude exceeds
    /// 0.0005 of white in a row's time.
    pub fn check(&self, white_dn: f64, row_time_us: f64) -> Result<(), ImagesError> {
        let Some(flicker) = self.flicker else { return Ok(()) };
        let level = self.level_of_white(white_dn, row_time_us) * flicker.share.value;
        match flicker.separable || level <= MOST_FLICKER {
            true => Ok(()),
            false => Err(ImagesError::Flicker {
                frequency_hz: flicker.frequency_hz.value,
                level,
                frame_rate_hz: flicker.frame_rate_hz,
            }),
        }
    }
}

fn check(runs: &[BlackFrames], camera_row_time_us: f64, frame_rate_hz: f64) -> Result<(), ImagesError> {
    let positive = |value: f64| value.is_finite() && value > 0.0;
    check_range("camera_row_time_us", camera_row_time_us, positive(camera_row_time_us), "positive")?;
    check_range("frame_rate_hz", frame_rate_hz, positive(frame_rate_hz), "positive")?;
    check_frames_of(runs)
}

fn check_frames_of(runs: &[BlackFrames]) -> Result<(), ImagesError> {
    let positive = |value: f64| value.is_finite() && value > 0.0;
    let frames: usize = runs.iter().map(|run| run.frames.len_of(Axis(0))).sum();
    check_frames(frames, 8)?;
    for run in runs {
        check_frames(run.frames.len_of(Axis(0)), 8)?;
        check_range("exposure_us", run.exposure_us, positive(run.exposure_us), "positive")?;
        check_shape("frames", "[t, s]", &run.frames.shape()[1..], &runs[0].frames.shape()[1..])?;
        check_shape("dark_dn", "[t, s]", run.dark_dn.shape(), &run.frames.shape()[1..])?;
        check_shape("opened_s", "[n]", &[run.opened_s.len()], &run.frames.shape()[..1])?;
        let wrong = run.opened_s.iter().copied().find(|time| !time.is_finite());
        check_range(
            "opened_s",
            wrong.unwrap_or(0.0),
            wrong.is_none(),
            "finite: leave out frames without time stamp",
        )?;
    }
    Ok(())
}

/// Whether two exposures are set, so that what does not grow with the exposure can be told from the level.
fn has_two_exposures(runs: &[BlackFrames]) -> bool {
    runs.iter().any(|run| run.exposure_us != runs[0].exposure_us)
}

/// `sin(pi x) / (pi x)`: how much of a sinusoid is left after averaging over `x` of its periods.
fn sinc(x: f64) -> f64 {
    if x.abs() < 1e-9 { 1.0 } else { (PI * x).sin() / (PI * x) }
}

/// Means over columns, and the level of each row.
struct RowMeans {
    runs: Vec<Run>,
    /// DN per us, `[t]`.
    level: Array1<f64>,
    row_time_s: f64,
    frame_rate_hz: f64,
    /// Middle of the record.
    reference_s: f64,
}

struct Run {
    exposure_s: f64,
    /// Means of the rows, `[n, t]`, in DN.
    mean: Array2<f64>,
    /// Mid-exposure of row 0 after the middle of the record.
    time_s: Vec<f64>,
    /// Deviation from the run's mean over frames, `[n, t]`, in DN.
    deviation: Array2<f64>,
}

impl RowMeans {
    fn new(
        runs: &[BlackFrames],
        camera_row_time_us: f64,
        frame_rate_hz: f64,
        usable: Option<ArrayView2<bool>>,
    ) -> Result<Self, ImagesError> {
        let (_, rows, columns) = runs[0].frames.dim();
        if let Some(usable) = usable {
            check_shape("usable", "[t, s]", usable.shape(), &[rows, columns])?;
        }
        let used: Vec<Vec<usize>> =
            (0..rows).map(|t| (0..columns).filter(|&s| is_usable(usable, t, s)).collect()).collect();
        if used.iter().all(Vec::is_empty) {
            let cure = "check the mask of hot pixels";
            return Err(ImagesError::TooFew { what: "usable pixels", given: 0, needed: 1, cure });
        }
        let means = runs.iter().map(|run| {
            let mut means = Array2::zeros((run.frames.len_of(Axis(0)), rows));
            means.axis_iter_mut(Axis(0)).into_par_iter().zip(run.frames.axis_iter(Axis(0))).for_each(
                |(mut means, frame)| {
                    for (t, columns) in used.iter().enumerate() {
                        let sum: f64 =
                            columns.iter().map(|&s| f64::from(frame[[t, s]] - run.dark_dn[[t, s]])).sum();
                        means[t] = sum / columns.len().max(1) as f64;
                    }
                },
            );
            means
        });
        let means: Vec<Array2<f64>> = means.collect();
        let mut times: Vec<f64> = runs.iter().flat_map(|run| run.opened_s).copied().collect();
        times.sort_by(f64::total_cmp);
        let row_time_s = camera_row_time_us * 1e-6;
        let reference_s = (times[0] + times[times.len() - 1] + rows as f64 * row_time_s) / 2.0;
        let runs = runs.iter().zip(means).map(|(run, mean)| {
            let exposure_s = run.exposure_us * 1e-6;
            let time_s = run.opened_s.iter().map(|open| open + exposure_s / 2.0 - reference_s).collect();
            let sums = mean.sum_axis(Axis(0));
            let deviation = &mean - &(sums / mean.nrows() as f64);
            Run { exposure_s, mean, time_s, deviation }
        });
        let runs: Vec<Run> = runs.collect();
        let mut of_rows = Self { runs, level: Array1::zeros(rows), row_time_s, frame_rate_hz, reference_s };
        of_rows.level = of_rows.levels(None);
        Ok(of_rows)
    }

    /// Level of each row in DN per us, given the flicker, `[t]`.
    fn levels(&self, flicker: Option<&Flicker>) -> Array1<f64> {
        let two = self.runs.iter().any(|run| run.exposure_s != self.runs[0].exposure_s);
        Array1::from_shape_fn(self.level.len(), |t| {
            let [mut n, mut h1, mut h2, mut y, mut hy] = [0.0; 5];
            for run in &self.runs {
                for (time, mean) in run.time_s.iter().zip(run.mean.column(t)) {
                    let time = time + self.row_time_s * t as f64;
                    let share = flicker.map_or(0.0, |flicker| flicker.share_at(run.exposure_s, time));
                    let h = run.exposure_s * 1e6 * (1.0 + share);
                    n += 1.0;
                    h1 += h;
                    h2 += h * h;
                    y += mean;
                    hy += h * mean;
                }
            }
            if two { (n * hy - h1 * y) / (n * h2 - h1 * h1) } else { hy / h2 }
        })
    }

    /// The sinusoid that explains the rows best, if any does.
    fn flicker(&mut self) -> Option<Flicker> {
        let scan = self.scan();
        let (best_hz, explained) = scan.iter().copied().max_by(|a, b| a.1.total_cmp(&b.1))?;
        let mut fit = self.refine(best_hz)?;
        // Over a few frames, flicker does not average out of the rows' levels.
        for _ in 0..LEVEL_STEPS {
            self.level = self.levels(Some(&fit.flicker));
            fit = self.refine(fit.flicker.frequency_hz.value)?;
        }
        let evidence = |explained: f64| explained / fit.bin_variance;
        let others = scan.iter().filter(|(frequency, _)| (frequency - best_hz).abs() > 1.0);
        let alias = others.copied().max_by(|a, b| a.1.total_cmp(&b.1));
        let alias_hz = alias
            .filter(|(_, other)| evidence(explained - other) < ALIAS_EVIDENCE)
            .map(|(frequency, _)| frequency);
        (evidence(explained) >= LEAST_EVIDENCE).then_some(Flicker { alias_hz, ..fit.flicker })
    }

    /// What a sinusoid of each frequency explains of the sum of squares.
    fn scan(&self) -> Vec<(f64, f64)> {
        let binned = Binned::new(self);
        let steps = ((HIGHEST_HZ - LOWEST_HZ) / STEP_HZ).round() as usize;
        (0..=steps)
            .into_par_iter()
            .map(|step| {
                let frequency = LOWEST_HZ + STEP_HZ * step as f64;
                (frequency, binned.explained(frequency))
            })
            .collect()
    }

    /// Least squares for the frequency and both amplitudes, from a frequency close to the best.
    fn refine(&self, start_hz: f64) -> Option<Fit> {
        let mut frequency = start_hz;
        let mut amplitudes = [0.0; 2];
        let mut last = None;
        for step in 0..8 {
            // The first step has no amplitude, from which the frequency could be told.
            let (normal, right, squares, samples) = self.normal(frequency, amplitudes);
            let normal = match step {
                0 => {
                    let mut fixed = normal;
                    for other in 0..2 {
                        (fixed[(2, other)], fixed[(other, 2)]) = (0.0, 0.0);
                    }
                    fixed[(2, 2)] = 1.0;
                    fixed
                }
                _ => normal,
            };
            let inverse = normal.try_inverse()?;
            let change = inverse * if step == 0 { Vector3::new(right[0], right[1], 0.0) } else { right };
            amplitudes = [amplitudes[0] + change[0], amplitudes[1] + change[1]];
            frequency += change[2].clamp(-STEP_HZ, STEP_HZ);
            last = Some((inverse, squares, samples));
        }
        let (inverse, squares, samples) = last?;
        let degrees = samples - self.level.len() as f64 * self.runs.len() as f64 - 3.0;
        let variance = squares / degrees;
        let covariance = inverse * variance;
        let [a, b] = amplitudes;
        let share = a.hypot(b);
        // cos(2 pi f t + phase) has the amplitudes cos(phase) and -sin(phase).
        let by_share = [a / share, b / share];
        let by_phase = [b / share.powi(2), -a / share.powi(2)];
        let sd = |by: [f64; 2]| {
            let variance = by[0] * by[0] * covariance[(0, 0)]
                + 2.0 * by[0] * by[1] * covariance[(0, 1)]
                + by[1] * by[1] * covariance[(1, 1)];
            variance.max(0.0).sqrt()
        };
        let multiple = self.frame_rate_hz * (frequency / self.frame_rate_hz).round();
        Some(Fit {
            flicker: Flicker {
                frequency_hz: Estimate { value: frequency, sd: covariance[(2, 2)].sqrt() },
                share: Estimate { value: share, sd: sd(by_share) },
                phase_rad: Estimate { value: (-b).atan2(a), sd: sd(by_phase) },
                reference_s: self.reference_s,
                alias_hz: None,
                separable: (frequency - multiple).abs() >= SEPARABLE_HZ,
                frame_rate_hz: self.frame_rate_hz,
            },
            bin_variance: variance / Binned::rows_per_bin(self) as f64,
        })
    }

    /// Normal matrix and right side for the changes of both amplitudes and the frequency, the sum of squares of the
    /// rest, and the number of samples.
    fn normal(&self, frequency: f64, [a, b]: [f64; 2]) -> (Matrix3<f64>, Vector3<f64>, f64, f64) {
        let parts = (0..self.level.len()).into_par_iter().map(|t| {
            let (mut normal, mut right, mut squares) = (Matrix3::zeros(), Vector3::zeros(), 0.0);
            for run in &self.runs {
                let scale = self.level[t] * run.exposure_s * 1e6;
                let kept = sinc(frequency * run.exposure_s);
                let slope = (sinc((frequency + 0.01) * run.exposure_s) - kept) / 0.01;
                let columns: Vec<(Vector3<f64>, f64)> = run
                    .time_s
                    .iter()
                    .zip(run.deviation.column(t))
                    .map(|(time, deviation)| {
                        let time = time + self.row_time_s * t as f64;
                        let (sin, cos) = (TAU * frequency * time).sin_cos();
                        let by_frequency =
                            slope * (a * cos + b * sin) + kept * TAU * time * (b * cos - a * sin);
                        (scale * Vector3::new(kept * cos, kept * sin, by_frequency), *deviation)
                    })
                    .collect();
                let n = columns.len() as f64;
                let mean = columns.iter().map(|(column, _)| column).sum::<Vector3<f64>>() / n;
                for (column, deviation) in &columns {
                    // The run's mean of each row is its level.
                    let column = column - mean;
                    let rest = deviation - a * column[0] - b * column[1];
                    normal += column * column.transpose();
                    right += column * rest;
                    squares += rest * rest;
                }
            }
            (normal, right, squares)
        });
        // In one order, so that the bits do not depend on the threads.
        let parts: Vec<(Matrix3<f64>, Vector3<f64>, f64)> = parts.collect();
        let zero = (Matrix3::zeros(), Vector3::zeros(), 0.0);
        let (normal, right, squares) = parts.into_iter().fold(zero, |x, y| (x.0 + y.0, x.1 + y.1, x.2 + y.2));
        let samples: usize = self.runs.iter().map(|run| run.deviation.len()).sum();
        (normal, right, squares, samples as f64)
    }

    /// Deviation of a row's light from the level, as a share of it.
    fn share(&self, flicker: &Flicker, run: usize, frame: usize, t: usize) -> f64 {
        let run = &self.runs[run];
        flicker.share_at(run.exposure_s, run.time_s[frame] + self.row_time_s * t as f64)
    }
}

impl Flicker {
    /// Deviation from the level, as a share of it, of an exposure whose middle lies `time_s` after the reference.
    fn share_at(&self, exposure_s: f64, time_s: f64) -> f64 {
        let frequency = self.frequency_hz.value;
        let phase = TAU * frequency * time_s + self.phase_rad.value;
        sinc(frequency * exposure_s) * self.share.value * phase.cos()
    }
}

struct Fit {
    flicker: Flicker,
    /// Variance of the rest, of a bin of rows.
    bin_variance: f64,
}

/// Row means averaged over a few rows each, in single precision, for the scan.
struct Binned {
    /// Time between bins.
    step_s: f64,
    /// Level times exposure of each run. The level is that of all rows: close to multiples of the frame rate, the
    /// levels of single rows contain the flicker.
    scales: Vec<f32>,
    runs: Vec<BinnedRun>,
}

struct BinnedRun {
    exposure_s: f64,
    /// Time of the first bin of each frame.
    time_s: Vec<f64>,
    /// `[n, bins]`.
    deviation: Array2<f32>,
}

impl Binned {
    fn rows_per_bin(of: &RowMeans) -> usize {
        ((BIN_US * 1e-6 / of.row_time_s) as usize).clamp(1, of.level.len())
    }

    fn new(of: &RowMeans) -> Self {
        let rows = Self::rows_per_bin(of);
        // Rows that do not fill a bin are left out of the scan.
        let bins = of.level.len() / rows;
        let level = of.level.sum() / of.level.len() as f64;
        let scales = of.runs.iter().map(|run| (level * run.exposure_s * 1e6) as f32).collect();
        let runs = of.runs.iter().map(|run| BinnedRun {
            exposure_s: run.exposure_s,
            time_s: run.time_s.iter().map(|time| time + of.row_time_s * (rows - 1) as f64 / 2.0).collect(),
            deviation: Array2::from_shape_fn((run.time_s.len(), bins), |(frame, bin)| {
                let rows = run.deviation.slice(ndarray::s![frame, bin * rows..(bin + 1) * rows]);
                (rows.sum() / rows.len() as f64) as f32
            }),
        });
        Self { step_s: of.row_time_s * rows as f64, scales, runs: runs.collect() }
    }

    /// Part of the sum of squares that a sinusoid explains beside the levels of the rows.
    fn explained(&self, frequency: f64) -> f64 {
        let bins = self.runs[0].deviation.ncols();
        let turns = |time: f64| {
            let (sin, cos) = (TAU * (frequency * time).fract()).sin_cos();
            (cos as f32, sin as f32)
        };
        let of_bins: Vec<(f32, f32)> = (0..bins).map(|bin| turns(self.step_s * bin as f64)).collect();
        // Averaging over the rows of a bin also takes from the amplitude.
        let in_bin = sinc(frequency * self.step_s) as f32;
        let [mut cc, mut cs, mut ss, mut cx, mut sx] = [0.0_f64; 5];
        let mut sums = vec![[0.0_f32; 7]; bins];
        for (run, scale) in self.runs.iter().zip(&self.scales) {
            sums.fill([0.0; 7]);
            for (frame, &time) in run.deviation.rows().into_iter().zip(&run.time_s) {
                let (cos, sin) = turns(time);
                for ((sum, &(bin_cos, bin_sin)), &deviation) in sums.iter_mut().zip(&of_bins).zip(frame) {
                    let (c, s) = (cos * bin_cos - sin * bin_sin, sin * bin_cos + cos * bin_sin);
                    sum[0] += c;
                    sum[1] += s;
                    sum[2] += c * c;
                    sum[3] += c * s;
                    sum[4] += s * s;
                    sum[5] += c * deviation;
                    sum[6] += s * deviation;
                }
            }
            let n = run.time_s.len() as f32;
            let kept = in_bin * sinc(frequency * run.exposure_s) as f32;
            let scale = kept * scale;
            for &[c, s, c2, c_s, s2, c_x, s_x] in &sums {
                cc += f64::from(scale * scale * (c2 - c * c / n));
                cs += f64::from(scale * scale * (c_s - c * s / n));
                ss += f64::from(scale * scale * (s2 - s * s / n));
                cx += f64::from(scale * c_x);
                sx += f64::from(scale * s_x);
            }
        }
        let determinant = cc * ss - cs * cs;
        let a = (ss * cx - cs * sx) / determinant;
        let b = (cc * sx - cs * cx) / determinant;
        // At multiples of the frame rate there is nothing to see, and rounding or drift would explain anything.
        let possible = a.hypot(b) <= MOST_SHARE && determinant > 1e-8 * (cc + ss).powi(2);
        if possible { a * cx + b * sx } else { 0.0 }
    }
}

/// Level and constant part of each pixel by least squares, given the flicker of its row.
fn level(
    runs: &[BlackFrames],
    noise: SensorNoise,
    share: impl Fn(usize, usize, usize) -> f64 + Sync,
) -> Ambient {
    let (_, rows, columns) = runs[0].frames.dim();
    let two = has_two_exposures(runs);
    let mut level_dn_per_us = Array2::<f32>::zeros((rows, columns));
    let mut level_sd = level_dn_per_us.clone();
    let mut projector_black_dn = level_dn_per_us.clone();
    let variances = runs.iter().map(|run| {
        let mean = mean_image(run.frames) - run.dark_dn;
        noise.variance_dn2(f64::from(mean.sum()) / mean.len() as f64)
    });
    let variances: Vec<f64> = variances.collect();
    level_dn_per_us
        .axis_iter_mut(Axis(0))
        .into_par_iter()
        .zip(level_sd.axis_iter_mut(Axis(0)))
        .zip(projector_black_dn.axis_iter_mut(Axis(0)))
        .enumerate()
        .for_each(|(t, ((mut level, mut sd), mut constant))| {
            let mut of_runs = vec![[0.0; 3]; runs.len()];
            let (mut y, mut hy) = (Array1::<f64>::zeros(columns), Array1::<f64>::zeros(columns));
            for (index, run) in runs.iter().enumerate() {
                let dark = run.dark_dn.row(t);
                for (frame, samples) in run.frames.axis_iter(Axis(0)).enumerate() {
                    let h = run.exposure_us * (1.0 + share(index, frame, t));
                    of_runs[index][0] += 1.0;
                    of_runs[index][1] += h;
                    of_runs[index][2] += h * h;
                    for (s, (sample, dark)) in samples.row(t).iter().zip(dark).enumerate() {
                        let light = f64::from(sample - dark);
                        y[s] += light;
                        hy[s] += h * light;
                    }
                }
            }
            let [n, h1] = [0, 1].map(|power| of_runs.iter().map(|sums| sums[power]).sum::<f64>());
            // Without a second exposure, the line passes through 0.
            let centre = if two { h1 / n } else { 0.0 };
            let about = |[n, h1, h2]: [f64; 3]| h2 - 2.0 * centre * h1 + centre * centre * n;
            let spread: f64 = of_runs.iter().map(|&sums| about(sums)).sum();
            let variance: f64 = of_runs.iter().zip(&variances).map(|(&sums, v)| about(sums) * v).sum();
            sd.fill((variance.sqrt() / spread) as f32);
            for s in 0..columns {
                let product = hy[s] - centre * y[s];
                level[s] = (product / spread) as f32;
                constant[s] = if two { ((y[s] - h1 * product / spread) / n) as f32 } else { 0.0 };
            }
        });
    Ambient { level_dn_per_us, level_sd, projector_black_dn, flicker: None }
}
