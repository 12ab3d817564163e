use super::column::bits;
use super::error::{check_range, check_shape};
use super::sensor::median;
use super::shape::WORD_PX;
use super::{Correction, DotsError, FrameShape, Region};

/// Upper limit of the counts that the vector kernels support: the 12 bits of fast cameras.
pub(crate) const NARROW_LIMIT: u16 = 1 << 12;

/// Background of a hot pixel: any narrow count minus it is less than the difference of any sound pixel, so a hot
/// pixel is never the maximum. The square of the difference is small enough to sum 64 of them in 32 bits.
pub(crate) const HOT_BACKGROUND: u16 = 2 * NARROW_LIMIT - 1;

/// A running mean of the frames whose light went into the beam dump: ambient light and dark level.
///
/// Subtracting one such frame would put its noise into every column of a batch, so that sums over all N dots contain it
/// N times. The mean lowers that noise. It is a Kalman filter of a level that drifts as a random walk: after many frames
/// it is exponential with the weight 2/(n + 1), which gives the noise of a mean of the last n frames. Dark frames that
/// were taken at once, before anything could drift, lower it further until their weight is lost.
#[derive(Debug, Clone)]
pub struct BackgroundMean {
    /// Variance by which the level drifts from frame to frame; 1 is that of a frame's noise.
    drift: f64,
    /// Variance of the mean, in the same unit.
    variance: f64,
    mean: Vec<f32>,
}

impl BackgroundMean {
    /// A mean with the noise of `frames` averaged frames.
    ///
    /// # Errors
    /// [`DotsError::OutOfRange`] for 0.
    pub fn new(shape: FrameShape, frames: u32) -> Result<Self, DotsError> {
        check_range("background.frames", frames.into(), frames > 0, "at least 1; 64 is usual")?;
        let weight = 2.0 / (f64::from(frames) + 1.0);
        // The drift with which the weight stays as it is.
        let drift = weight * weight / (1.0 - weight);
        Ok(Self { drift, variance: f64::INFINITY, mean: vec![0.0; shape.values()] })
    }

    /// Adds one of the dark frames that are taken at once.
    ///
    /// # Errors
    /// [`DotsError::Shape`] if it does not have the frame's size.
    pub fn push_dark(&mut self, frame: &[u16]) -> Result<(), DotsError> {
        self.mix(frame, self.variance)
    }

    /// Adds a frame of the beam dump.
    ///
    /// # Errors
    /// [`DotsError::Shape`] if it does not have the frame's size.
    pub fn push(&mut self, frame: &[u16]) -> Result<(), DotsError> {
        self.mix(frame, self.variance + self.drift)
    }

    /// Adds a frame to a mean of this variance.
    fn mix(&mut self, frame: &[u16], variance: f64) -> Result<(), DotsError> {
        check_shape("frame", "[values]", &[frame.len()], &[self.mean.len()])?;
        let weight = 1.0 / (1.0 + 1.0 / variance);
        // The mean's variance is then that part of the frame's.
        self.variance = weight;
        for (mean, &raw) in self.mean.iter_mut().zip(frame) {
            *mean += weight as f32 * (f32::from(raw) - *mean);
        }
        Ok(())
    }

    /// Variance of the mean; 1 is that of a frame's noise.
    pub fn variance(&self) -> f64 {
        self.variance
    }

    /// The mean in counts, `[height, width, channels]`.
    pub fn mean(&self) -> &[f32] {
        &self.mean
    }
}

/// The background of one batch, prepared for the pass over its frames.
#[derive(Debug, Clone)]
pub struct Background {
    /// Mean counts, `[height, width, channels]`.
    pub(crate) mean: Vec<f32>,
    /// Luminance of each pixel's background, rounded to whole counts; [`HOT_BACKGROUND`] at hot pixels.
    pub(crate) counts: Vec<u16>,
    /// Whether the counts of all sound pixels are within the limit of the vector kernels.
    pub(crate) narrow: bool,
    /// The effect of rounding on each block's sum: rounded minus mean over its sound pixels, `[blocks, channels]`. It
    /// is the same in every frame, so uncorrected it would add up over all dots. RGB frames have no rounded
    /// background of their own; for them it is minus the whole mean.
    pub(crate) block_offset: Vec<f64>,
    /// Number of sound pixels in each block.
    pub(crate) block_sound: Vec<u32>,
}

impl Background {
    /// From mean counts `[height, width, channels]` as returned by [`BackgroundMean::mean`].
    ///
    /// # Errors
    /// [`DotsError::Shape`] if they do not have the frame's size, [`DotsError::OutOfRange`] if a value is not a valid
    /// count.
    pub fn new(correction: &Correction, mean: &[f32]) -> Result<Self, DotsError> {
        let shape = correction.shape();
        let mut background = Self {
            mean: vec![0.0; shape.values()],
            counts: vec![0; shape.pixels()],
            narrow: true,
            block_offset: vec![0.0; shape.blocks() * shape.channels()],
            block_sound: vec![0; shape.blocks()],
        };
        background.set(correction, mean)?;
        Ok(background)
    }

    /// The same as [`Background::new`], but reuses this background's memory.
    ///
    /// # Errors
    /// As [`Background::new`].
    pub fn set(&mut self, correction: &Correction, mean: &[f32]) -> Result<(), DotsError> {
        let shape = correction.shape();
        let channels = shape.channels();
        check_shape("background", "[values]", &[mean.len()], &[shape.values()])?;
        check_shape("prepared background", "[values]", &[self.mean.len()], &[shape.values()])?;
        if let Some(&value) = mean.iter().find(|&&value| !(0.0..=f32::from(u16::MAX)).contains(&value)) {
            check_range("background", value.into(), false, "0 to 65535 counts")?;
        }
        self.mean.copy_from_slice(mean);
        self.block_offset.fill(0.0);
        self.block_sound.fill(0);
        self.narrow = true;
        for (word, &hot) in correction.hot_masks().iter().enumerate() {
            for bit in bits(hot) {
                self.counts[word * WORD_PX + bit] = HOT_BACKGROUND;
            }
            for bit in bits(!hot) {
                let (pixel, block) = (word * WORD_PX + bit, shape.block_of(word, bit));
                self.block_sound[block] += 1;
                let of_pixel = &mean[pixel * channels..][..channels];
                let counts = mean_luminance(of_pixel).round() as u16;
                self.counts[pixel] = counts;
                self.narrow &= counts < NARROW_LIMIT;
                let rounded = if channels == 1 { f64::from(counts) } else { 0.0 };
                let offsets = &mut self.block_offset[block * channels..][..channels];
                offsets
                    .iter_mut()
                    .zip(of_pixel)
                    .for_each(|(offset, &mean)| *offset += rounded - f64::from(mean));
            }
        }
        Ok(())
    }
}

/// Luminance of a pixel's values: the value itself, or (R + 2 G + B) / 4.
fn mean_luminance(pixel: &[f32]) -> f32 {
    match pixel {
        [red, green, blue] => (red + 2.0 * green + blue) / 4.0,
        _ => pixel.iter().sum(),
    }
}

/// Luminance in whole counts, so that detection is the same for colour and monochrome frames.
pub(crate) fn luminance(pixel: [u16; 3]) -> u16 {
    let [red, green, blue] = pixel.map(u32::from);
    ((red + 2 * green + blue + 2) / 4) as u16
}

/// Mean and standard deviation of raw minus background where no light falls, in counts.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NoiseFloor {
    /// Mean; 0 where the background is up to date.
    pub mean: f64,
    /// Standard deviation, at least that of rounding to whole counts.
    pub sigma: f64,
}

impl NoiseFloor {
    /// Variance of rounding to whole counts, which a noise-free camera would have.
    pub(crate) const ROUNDING_VARIANCE: f64 = 1.0 / 12.0;

    /// The medians over frames of mean and variance within a region. The more frames, the less the choice of region
    /// matters; some frames may even have light there. Use the batch's own frames and a dark corner, or frames of the
    /// beam dump that are not part of the background's mean, with [`Region::whole`].
    ///
    /// # Errors
    /// [`DotsError::TooFew`] without frames or with fewer than 16 sound pixels, [`DotsError::Shape`] and
    /// [`DotsError::OutOfRange`] for frames and regions that do not fit.
    pub fn measured<'a>(
        frames: impl IntoIterator<Item = &'a [u16]>,
        correction: &Correction,
        background: &Background,
        region: &Region,
    ) -> Result<Self, DotsError> {
        let (mut means, mut variances) = (Vec::new(), Vec::new());
        for frame in frames {
            let Self { mean, sigma } = Self::of_frame(frame, correction, background, region)?;
            means.push(mean);
            variances.push(sigma * sigma);
        }
        if means.is_empty() {
            let what = "frames to measure the noise in: give some of the batch";
            return Err(DotsError::TooFew { what, given: 0, needed: 1 });
        }
        Ok(Self { mean: median(&mut means), sigma: median(&mut variances).sqrt() })
    }

    /// Of one frame's region alone, as in the paper's Algorithm 1.
    pub(crate) fn of_frame(
        frame: &[u16],
        correction: &Correction,
        background: &Background,
        region: &Region,
    ) -> Result<Self, DotsError> {
        const NEEDED: usize = 16;
        let shape = correction.shape();
        region.check(shape)?;
        check_shape("frame", "[values]", &[frame.len()], &[shape.values()])?;
        let (mut count, mut sum, mut squares) = (0_usize, 0_i64, 0_i64);
        for pixel in region.pixels(shape) {
            if correction.hot_masks()[pixel / WORD_PX] >> (pixel % WORD_PX) & 1 == 0 {
                let raw = match shape.channels() {
                    1 => frame[pixel],
                    _ => luminance([frame[3 * pixel], frame[3 * pixel + 1], frame[3 * pixel + 2]]),
                };
                let above = i64::from(raw) - i64::from(background.counts[pixel]);
                (count, sum, squares) = (count + 1, sum + above, squares + above * above);
            }
        }
        if count < NEEDED {
            let what = "sound pixels in the region that the noise is measured in: choose a larger one";
            return Err(DotsError::TooFew { what, given: count, needed: NEEDED });
        }
        Ok(Self::of_sums(count, sum, squares))
    }

    /// From the number of pixels, their sum and their sum of squares.
    pub(crate) fn of_sums(count: usize, sum: i64, squares: i64) -> Self {
        let mean = sum as f64 / count as f64;
        let variance = squares as f64 / count as f64 - mean * mean;
        Self { mean, sigma: variance.max(Self::ROUNDING_VARIANCE).sqrt() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn noisy_frames(shape: FrameShape, count: u64) -> Vec<Vec<u16>> {
        use rand_distr::{Distribution, Normal};
        use rand_xoshiro::rand_core::SeedableRng;
        let noise = Normal::<f64>::new(100.3, 3.0).unwrap();
        let frame = |seed| {
            let mut random = rand_xoshiro::Xoshiro256PlusPlus::seed_from_u64(seed);
            (0..shape.values()).map(|_| noise.sample(&mut random).round() as u16).collect()
        };
        (0..count).map(frame).collect()
    }

    #[test]
    fn the_mean_loses_noise_as_one_of_that_many_frames() {
        let shape = FrameShape::new(64, 64, 1).unwrap();
        let error = |count: u32| {
            let mut mean = BackgroundMean::new(shape, count).unwrap();
            for frame in noisy_frames(shape, 3 * u64::from(count)) {
                mean.push(&frame).unwrap();
            }
            let squares: f64 = mean.mean().iter().map(|mean| (f64::from(*mean) - 100.3).powi(2)).sum();
            (squares / 4096.0).sqrt()
        };
        assert!((error(1) / 3.0 - 1.0).abs() < 0.1, "{}", error(1));
        assert!((error(64) / (3.0 / 8.0) - 1.0).abs() < 0.1, "{}", error(64));
    }

    #[test]
    fn dark_frames_lower_the_noise_until_the_level_may_have_drifted() {
        let shape = FrameShape::new(64, 64, 1).unwrap();
        let frames = noisy_frames(shape, 464);
        let mut mean = BackgroundMean::new(shape, 16).unwrap();
        let mut error = |of: std::ops::Range<usize>, is_dark: bool| {
            for frame in &frames[of] {
                if is_dark { mean.push_dark(frame) } else { mean.push(frame) }.unwrap();
            }
            let squares: f64 = mean.mean().iter().map(|mean| (f64::from(*mean) - 100.3).powi(2)).sum();
            3.0 / (squares / 4096.0).sqrt()
        };
        // In roots of the number of frames that have the same noise.
        let [dark, soon, late] = [error(0..400, true), error(400..401, false), error(401..464, false)];
        assert!((dark / 20.0 - 1.0).abs() < 0.1, "{dark}");
        assert!(soon > 8.0, "one frame replaces a hundred: {soon}");
        assert!((late / 4.0 - 1.0).abs() < 0.1, "{late}");
    }

    #[test]
    fn the_noise_floor_is_that_of_the_noise_wherever_it_is_measured() {
        let shape = FrameShape::new(96, 96, 1).unwrap();
        let correction = Correction::none(shape);
        let background = Background::new(&correction, &vec![100.0; 96 * 96]).unwrap();
        let mut frames = noisy_frames(shape, 50);
        // A third of the frames have light in one of the regions.
        for frame in frames.iter_mut().step_by(3) {
            frame[..32 * 96].iter_mut().for_each(|raw| *raw += 500);
        }
        let measured = |rows| {
            let region = Region { rows, columns: 0..32 };
            let frames = frames.iter().map(Vec::as_slice);
            NoiseFloor::measured(frames, &correction, &background, &region).unwrap()
        };
        for floor in [measured(0..32), measured(64..96)] {
            assert!((floor.mean - 0.3).abs() < 0.15, "{floor:?}");
            assert!((floor.sigma - (9.0_f64 + 1.0 / 12.0).sqrt()).abs() < 0.15, "{floor:?}");
        }
    }

    #[test]
    fn what_cannot_be_a_background_is_refused() {
        let correction = Correction::none(FrameShape::new(2, 32, 1).unwrap());
        assert!(matches!(Background::new(&correction, &[0.0; 63]), Err(DotsError::Shape { .. })));
        assert!(matches!(Background::new(&correction, &[f32::NAN; 64]), Err(DotsError::OutOfRange { .. })));
    }
}
