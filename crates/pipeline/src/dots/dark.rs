//! What frames without light tell of the sensor.

use ndarray::ArrayView3;
use raysweep_transport::dots::{
    Background, BackgroundMean, Correction, DotsError, FrameShape, NoiseFloor, Observation, Region,
    RunStatistics, Sampling,
};

/// Frames in which the noise is measured; they are not in the mean that is subtracted from them.
const NOISE_FRAMES: usize = 8;

/// Dark frames on their way to a [`Sensor`].
pub struct DarkRun {
    shape: FrameShape,
    saturation_dn: u16,
    wanted: u32,
    taken: u32,
    statistics: RunStatistics,
    mean: BackgroundMean,
    noisy: Vec<Vec<u16>>,
}

/// What is known of the sensor before the first dot.
pub struct Sensor {
    /// Flat field and hot pixels.
    pub correction: Correction,
    /// The mean of the dark frames, in which the frames of the beam dump will be mixed.
    pub background: BackgroundMean,
    /// The noise of a frame above that background.
    pub floor: NoiseFloor,
}

impl DarkRun {
    /// A run of `frames` dark frames, the first part of a rolling mean worth `background_batches` frames. Frames in which
    /// most pixels have `saturation_dn` or more are left out.
    ///
    /// # Errors
    /// [`DotsError::OutOfRange`] for no batch, [`DotsError::TooFew`] for fewer frames than a sensor is known from.
    pub fn new(
        shape: FrameShape,
        saturation_dn: u16,
        frames: u32,
        background_batches: u32,
    ) -> Result<Self, DotsError> {
        let needed = 2 * NOISE_FRAMES;
        if (frames as usize) < needed {
            let what = "dark frames: raise batches.dark_frames";
            return Err(DotsError::TooFew { what, given: frames as usize, needed });
        }
        Ok(Self {
            shape,
            saturation_dn,
            wanted: frames,
            taken: 0,
            statistics: RunStatistics::new(shape),
            mean: BackgroundMean::new(shape, background_batches)?,
            noisy: Vec::with_capacity(NOISE_FRAMES),
        })
    }

    /// Takes a frame; whether more are wanted.
    ///
    /// # Errors
    /// [`DotsError::Shape`] if it is not of the frames' size.
    pub fn push(&mut self, frame: &[u16]) -> Result<bool, DotsError> {
        let whole = Region::whole(self.shape);
        let is_flash = Observation::new(0, frame, self.shape, &whole, self.saturation_dn)?.saturated;
        if self.taken < self.wanted && !is_flash {
            self.taken += 1;
            self.statistics.push(frame)?;
            match self.noisy.len() < NOISE_FRAMES {
                true => self.noisy.push(frame.to_vec()),
                false => self.mean.push(frame)?,
            }
        }
        Ok(self.taken < self.wanted)
    }

    /// The sensor as these frames show it: pixels whose level or noise lies `hot_sigmas` beyond the others' are hot;
    /// `gain` is the flat field `[height, width, 1]`, left out where the sensor is even.
    ///
    /// # Errors
    /// [`DotsError::TooFew`] while frames are lacking; [`DotsError::Shape`] and [`DotsError::OutOfRange`] for a gain that
    /// is none.
    pub fn finish(
        self,
        hot_sigmas: f64,
        gain: Option<ArrayView3<f32>>,
        sampling: Sampling,
    ) -> Result<Sensor, DotsError> {
        if self.taken < self.wanted {
            let (given, needed) = (self.taken as usize, self.wanted as usize);
            let what = "dark frames: the camera was stopped before it had taken them";
            return Err(DotsError::TooFew { what, given, needed });
        }
        let hot = self.statistics.hot_pixels(hot_sigmas)?;
        let even = ndarray::Array3::ones((self.shape.height(), self.shape.width(), self.shape.channels()));
        let correction = Correction::new(self.shape, gain.unwrap_or(even.view()), &hot, sampling)?;
        let background = Background::new(&correction, self.mean.mean())?;
        let frames = self.noisy.iter().map(Vec::as_slice);
        let floor = NoiseFloor::measured(frames, &correction, &background, &Region::whole(self.shape))?;
        Ok(Sensor { correction, background: self.mean, floor })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_dark_run_knows_level_noise_and_hot_pixels() {
        let shape = FrameShape::new(32, 64, 1).unwrap();
        let mut run = DarkRun::new(shape, 4000, 40, 64).unwrap();
        assert!(run.push(&vec![4095; shape.pixels()]).unwrap(), "a flash is no dark frame");
        for number in 0..40_u64 {
            let noise = |pixel: u64| {
                (pixel.wrapping_mul(6364136223846793005) ^ number << 40).wrapping_mul(1442695040888963407)
                    >> 61
            };
            let frame: Vec<u16> = (0..shape.pixels() as u64)
                .map(|pixel| if pixel == 70 { 900 } else { 100 + noise(pixel) as u16 })
                .collect();
            assert_eq!(run.push(&frame).unwrap(), number < 39);
        }
        let sensor = run.finish(8.0, None, Sampling::Full).unwrap();
        assert_eq!(sensor.correction.hot(), [70]);
        assert_eq!(sensor.background.seen(), 32);
        // Uniform over 0 to 7: sigma is the root of 63/12.
        assert!((sensor.floor.sigma - 2.29).abs() < 0.2, "{:?}", sensor.floor);
        assert!(sensor.floor.mean.abs() < 0.3, "{:?}", sensor.floor);
    }

    #[test]
    fn too_few_frames_are_no_calibration() {
        let shape = FrameShape::new(32, 64, 1).unwrap();
        assert!(matches!(DarkRun::new(shape, 4000, 15, 64), Err(DotsError::TooFew { needed: 16, .. })));
        let run = DarkRun::new(shape, 4000, 16, 64).unwrap();
        assert!(matches!(run.finish(8.0, None, Sampling::Full), Err(DotsError::TooFew { given: 0, .. })));
    }
}
