use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis};
use rayon::prelude::*;

use super::{
    Estimate, ImagesError, check_frames, check_range, check_shape, mean_image, median, median_of_variance,
    robust_sd,
};

/// Frames of the capped camera with one exposure.
#[derive(Debug, Clone, Copy)]
pub struct CappedFrames<'a> {
    /// The exposure that was set.
    pub exposure_us: f64,
    /// The frames, `[n, t, s]`.
    pub frames: ArrayView3<'a, f32>,
}

/// The dark image over exposure: a straight line of each pixel.
#[derive(Debug, Clone, PartialEq)]
pub struct DarkFit {
    /// Level at exposure 0, `[t, s]`.
    pub offset_dn: Array2<f32>,
    /// Dark current, `[t, s]`.
    pub slope_dn_per_us: Array2<f32>,
    /// Variance of the offset, covariance, variance of the slope, `[3, t, s]`.
    pub covariance: Array3<f32>,
    /// Noise of one frame in the dark, `[t, s]`, rounding included.
    pub noise_dn: Array2<f32>,
    /// Median of the noise, with the standard deviation of that median.
    pub read_noise_dn: Estimate,
    /// Pixels with an unusual dark current or noise, `[t, s]`.
    pub hot: Array2<bool>,
}

/// Weight of the image's median in a pixel's own variance, in degrees of freedom: a pixel's variance from few frames
/// is itself noisy.
const PRIOR_DEGREES: f64 = 10.0;
/// A hot pixel's dark current differs from the median by this many standard deviations of the image.
const HOT_SIGMAS: f64 = 6.0;
/// A hot pixel's variance is at least this many times the median.
const HOT_VARIANCE: f64 = 4.0;

impl DarkFit {
    /// Fits the line to runs of frames with two or more exposures, weighting each run with its number of frames.
    ///
    /// A pixel is hot if its dark current over the longest exposure differs from the median by 6 standard deviations
    /// of the image and by the noise of a frame, or if its noise is twice the median beyond what chance explains.
    ///
    /// # Errors
    /// [`ImagesError::TooFew`] for fewer than two exposures, or frames that give fewer than 4 degrees of freedom for
    /// the noise; [`ImagesError::Shape`]; [`ImagesError::OutOfRange`] for an exposure that is not positive.
    pub fn new(runs: &[CappedFrames]) -> Result<Self, ImagesError> {
        let shape = check(runs)?;
        let weights: Vec<f64> = runs.iter().map(|run| run.frames.len_of(Axis(0)) as f64).collect();
        let frames: f64 = weights.iter().sum();
        let mean_us = weighted(runs, |run| run.exposure_us) / frames;
        let spread_us2 = weighted(runs, |run| (run.exposure_us - mean_us).powi(2));
        let degrees = frames as usize - runs.len();
        let means: Vec<Array2<f32>> = runs.iter().map(|run| mean_image(run.frames)).collect();

        let variance = within_runs(runs, &means, degrees);
        let mut variances: Vec<f64> = variance.iter().map(|&v| f64::from(v)).collect();
        let typical = median(&mut variances).unwrap_or(0.0) / median_of_variance(degrees);
        let own = degrees as f64 / (degrees as f64 + PRIOR_DEGREES);
        let shrunk = variance.mapv(|v| own * f64::from(v) + (1.0 - own) * typical);

        let mut offset_dn = Array2::zeros(shape);
        let mut slope_dn_per_us = Array2::zeros(shape);
        let exposures = runs.iter().zip(&weights).zip(&means);
        for ((run, weight), mean) in exposures {
            slope_dn_per_us.scaled_add((weight * (run.exposure_us - mean_us) / spread_us2) as f32, mean);
            offset_dn.scaled_add((weight / frames) as f32, mean);
        }
        offset_dn.scaled_add(-mean_us as f32, &slope_dn_per_us);
        let per_variance =
            [1.0 / frames + mean_us * mean_us / spread_us2, -mean_us / spread_us2, 1.0 / spread_us2];
        let covariance = Array3::from_shape_fn((3, shape.0, shape.1), |(n, t, s)| {
            (per_variance[n] * shrunk[[t, s]]) as f32
        });

        let longest_us = runs.iter().map(|run| run.exposure_us).fold(0.0, f64::max);
        let currents: Vec<f64> = slope_dn_per_us.iter().map(|&slope| longest_us * f64::from(slope)).collect();
        let current = median(&mut currents.clone()).unwrap_or(0.0);
        let most_current = (HOT_SIGMAS * robust_sd(&currents, current)).max(typical.sqrt());
        let most_variance = typical * HOT_VARIANCE.max(1.0 + HOT_SIGMAS * (2.0 / degrees as f64).sqrt());
        let hot = Array2::from_shape_fn(shape, |at| {
            let excess = (longest_us * f64::from(slope_dn_per_us[at]) - current).abs();
            excess > most_current || f64::from(variance[at]) > most_variance
        });
        // The median of n values has the standard deviation 1.25 / sqrt(n) of one value's.
        let of_one = robust_sd(&variances, typical) / (2.0 * typical.sqrt().max(f64::MIN_POSITIVE));
        let read_noise_dn =
            Estimate { value: typical.sqrt(), sd: 1.25 * of_one / (variances.len() as f64).sqrt() };
        let noise_dn = shrunk.mapv(|v| v.sqrt() as f32);
        Ok(Self { offset_dn, slope_dn_per_us, covariance, noise_dn, read_noise_dn, hot })
    }

    /// The dark image at an exposure, `[t, s]`.
    pub fn image(&self, exposure_us: f64) -> Array2<f32> {
        &self.offset_dn + &(&self.slope_dn_per_us * exposure_us as f32)
    }

    /// Standard deviation of [`Self::image`], `[t, s]`.
    pub fn image_sd(&self, exposure_us: f64) -> Array2<f32> {
        let [of_offset, both, of_slope] = [0, 1, 2].map(|n| self.covariance.index_axis(Axis(0), n));
        Array2::from_shape_fn(self.offset_dn.dim(), |at| {
            let [a, b, c] = [of_offset[at], both[at], of_slope[at]].map(f64::from);
            (a + exposure_us * (2.0 * b + exposure_us * c)).max(0.0).sqrt() as f32
        })
    }
}

fn check(runs: &[CappedFrames]) -> Result<(usize, usize), ImagesError> {
    let mut exposures: Vec<f64> = runs.iter().map(|run| run.exposure_us).collect();
    for &exposure_us in &exposures {
        let accepted = exposure_us.is_finite() && exposure_us > 0.0;
        check_range(
            "exposure_us",
            exposure_us,
            accepted,
            "positive: the exposure that the camera was set to",
        )?;
    }
    exposures.sort_by(f64::total_cmp);
    exposures.dedup();
    if exposures.len() < 2 {
        let cure = "cap the lens and take each exposure of the plan";
        return Err(ImagesError::TooFew {
            what: "exposures with cap",
            given: exposures.len(),
            needed: 2,
            cure,
        });
    }
    let (_, rows, columns) = runs[0].frames.dim();
    for run in runs {
        let (n, ..) = run.frames.dim();
        check_shape("frames", "[n, t, s]", run.frames.shape(), &[n, rows, columns])?;
        check_frames(n, 1)?;
    }
    let frames: usize = runs.iter().map(|run| run.frames.len_of(Axis(0))).sum();
    check_frames(frames, runs.len() + 4)?;
    Ok((rows, columns))
}

/// Sum over the runs, weighted with the number of frames.
fn weighted(runs: &[CappedFrames], value: impl Fn(&CappedFrames) -> f64) -> f64 {
    runs.iter().map(|run| run.frames.len_of(Axis(0)) as f64 * value(run)).sum()
}

/// Variance of each pixel about the mean of its run, `[t, s]`.
fn within_runs(runs: &[CappedFrames], means: &[Array2<f32>], degrees: usize) -> Array2<f32> {
    let mut variance = Array2::<f32>::zeros(means[0].dim());
    variance.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(t, mut row)| {
        for (run, mean) in runs.iter().zip(means) {
            let mean: ArrayView2<f32> = mean.view();
            for frame in run.frames.axis_iter(Axis(0)) {
                let samples = frame.index_axis_move(Axis(0), t);
                ndarray::Zip::from(&mut row)
                    .and(&samples)
                    .and(&mean.index_axis(Axis(0), t))
                    .for_each(|sum, sample, mean| *sum += (sample - mean).powi(2));
            }
        }
        row /= degrees as f32;
    });
    variance
}
