//! Calibration of the sensor from runs of frames: dark level and hot pixels.

use ndarray::Array3;

use super::error::{check_range, check_shape};
use super::{DotsError, FrameShape};

/// Scales a median absolute deviation to the standard deviation of normal noise.
const MAD_TO_SIGMA: f64 = 1.4826;

/// Mean and variance of each value over a run of frames with constant light.
#[derive(Debug, Clone)]
pub struct RunStatistics {
    shape: FrameShape,
    frames: u64,
    sums: Vec<u64>,
    squares: Vec<u64>,
}

impl RunStatistics {
    /// Statistics without frames.
    pub fn new(shape: FrameShape) -> Self {
        Self { shape, frames: 0, sums: vec![0; shape.values()], squares: vec![0; shape.values()] }
    }

    /// Adds a raw frame, `[height, width, channels]`.
    ///
    /// # Errors
    /// [`DotsError::Shape`] if it does not have that size.
    pub fn push(&mut self, frame: &[u16]) -> Result<(), DotsError> {
        check_shape("frame", "[values]", &[frame.len()], &[self.shape.values()])?;
        self.frames += 1;
        for ((sum, square), &raw) in self.sums.iter_mut().zip(&mut self.squares).zip(frame) {
            *sum += u64::from(raw);
            *square += u64::from(raw).pow(2);
        }
        Ok(())
    }

    /// Mean of each value in counts, `[height, width, channels]`; for frames without light this is the dark frame.
    ///
    /// # Errors
    /// [`DotsError::TooFew`] without frames.
    pub fn mean(&self) -> Result<Array3<f32>, DotsError> {
        self.needs(1)?;
        let mean = self.sums.iter().map(|&sum| (sum as f64 / self.frames as f64) as f32);
        Ok(shaped(self.shape, mean.collect()))
    }

    /// Pixels whose dark level or noise exceeds that of most pixels by more than `sigmas` standard deviations, as
    /// (row, column). The standard deviation is derived from the median absolute deviation, so that hot pixels do not
    /// mask each other. Its square is at least 1/12 count squared, the variance of rounding.
    ///
    /// # Errors
    /// [`DotsError::TooFew`] below eight frames, [`DotsError::OutOfRange`] unless `sigmas` is above 0.
    pub fn hot_pixels(&self, sigmas: f64) -> Result<Vec<(usize, usize)>, DotsError> {
        check_range("sigmas", sigmas, sigmas > 0.0, "above 0, as 8")?;
        let spread = self.spread()?;
        let mean: Vec<f64> = self.sums.iter().map(|&sum| sum as f64 / self.frames as f64).collect();
        let (mean_limit, spread_limit) = (limit(&mean, sigmas), limit(&spread, sigmas));
        let channels = self.shape.channels();
        let is_hot = |pixel: usize| {
            (pixel * channels..(pixel + 1) * channels)
                .any(|at| mean[at] > mean_limit || spread[at] > spread_limit)
        };
        let hot = (0..self.shape.pixels()).filter(|&pixel| is_hot(pixel));
        Ok(hot.map(|pixel| (pixel / self.shape.width(), pixel % self.shape.width())).collect())
    }

    /// Number of frames so far.
    pub fn frames(&self) -> u64 {
        self.frames
    }

    /// Standard deviation of each value over the frames, in counts.
    pub(crate) fn spread(&self) -> Result<Vec<f64>, DotsError> {
        self.needs(8)?;
        let frames = self.frames as f64;
        let spread = self.sums.iter().zip(&self.squares).map(|(&sum, &square)| {
            let mean = sum as f64 / frames;
            let variance = (square as f64 / frames - mean * mean).max(0.0) * frames / (frames - 1.0);
            variance.sqrt()
        });
        Ok(spread.collect())
    }

    fn needs(&self, needed: usize) -> Result<(), DotsError> {
        let (given, what) = (self.frames as usize, "frames of the calibration run: record a longer one");
        if given < needed { Err(DotsError::TooFew { what, given, needed }) } else { Ok(()) }
    }
}

fn shaped(shape: FrameShape, values: Vec<f32>) -> Array3<f32> {
    let mut array = Array3::zeros((shape.height(), shape.width(), shape.channels()));
    array.iter_mut().zip(values).for_each(|(place, value)| *place = value);
    array
}

fn limit(values: &[f64], sigmas: f64) -> f64 {
    let mut sorted = values.to_vec();
    let middle = median(&mut sorted);
    sorted.iter_mut().for_each(|value| *value = (*value - middle).abs());
    let spread = MAD_TO_SIGMA * median(&mut sorted);
    middle + sigmas * spread.max((1.0_f64 / 12.0).sqrt())
}

/// The upper median; reorders the values. 0 without values.
pub(crate) fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    match values.is_empty() {
        true => 0.0,
        false => *values.select_nth_unstable_by(middle, f64::total_cmp).1,
    }
}

#[cfg(test)]
mod tests {
    use rand_distr::{Distribution, Normal};
    use rand_xoshiro::Xoshiro256PlusPlus;
    use rand_xoshiro::rand_core::SeedableRng;

    use super::*;

    /// 64 frames with the given mean counts and normal noise, of 20 counts at `noisy` and 3 elsewhere.
    fn run(shape: FrameShape, noisy: usize, mean: impl Fn(usize) -> f64) -> RunStatistics {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(7);
        let mut statistics = RunStatistics::new(shape);
        for _ in 0..64 {
            let frame: Vec<u16> = (0..shape.values())
                .map(|at| {
                    let noise = Normal::new(mean(at), if at == noisy { 20.0 } else { 3.0 }).unwrap();
                    noise.sample(&mut random).round().max(0.0) as u16
                })
                .collect();
            statistics.push(&frame).unwrap();
        }
        statistics
    }

    #[test]
    fn hot_pixels_are_found_by_level_and_by_noise_and_no_others() {
        let shape = FrameShape::new(64, 64, 1).unwrap();
        let dark = run(shape, 100, |at| if [7, 2000].contains(&at) { 400.0 } else { 64.0 });
        assert_eq!(dark.hot_pixels(8.0).unwrap(), [(0, 7), (1, 36), (31, 16)]);
        let mean = dark.mean().unwrap();
        assert!((mean[[10, 10, 0]] - 64.0).abs() < 2.0 && (mean[[0, 7, 0]] - 400.0).abs() < 2.0);
    }

    #[test]
    fn too_short_runs_are_refused() {
        let statistics = RunStatistics::new(FrameShape::new(8, 32, 1).unwrap());
        assert!(matches!(statistics.mean(), Err(DotsError::TooFew { needed: 1, .. })));
        assert!(matches!(statistics.hot_pixels(8.0), Err(DotsError::TooFew { needed: 8, .. })));
    }
}
