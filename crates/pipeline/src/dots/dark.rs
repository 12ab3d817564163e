//! Calibrates the sensor from frames without light and frames of even light.

use ndarray::Array3;
use raysweep_transport::dots::{
    Background, BackgroundMean, Correction, DotsError, FlatField, FrameShape, NoiseFloor, Observation,
    Region, RunStatistics, Sampling,
};

/// Number of frames in which the noise is measured; they are not part of the mean that is subtracted from them.
const NOISE_FRAMES: usize = 8;

/// Collects dark frames for a [`Sensor`].
pub struct DarkRun {
    shape: FrameShape,
    saturation_dn: u16,
    wanted: u32,
    taken: u32,
    statistics: RunStatistics,
    mean: BackgroundMean,
    noisy: Vec<Vec<u16>>,
}

/// The sensor's calibration, known before the first dot.
pub struct Sensor {
    /// Flat field and hot pixels.
    pub correction: Correction,
    /// The mean of the dark frames, to which the frames of the beam dump will be added.
    pub background: BackgroundMean,
    /// The noise of a frame relative to that background.
    pub floor: NoiseFloor,
}

impl DarkRun {
    /// A run of `frames` dark frames, which start a rolling mean worth `background_frames` frames. Frames in which
    /// most pixels have `saturation_dn` or more are left out.
    ///
    /// # Errors
    /// [`DotsError::OutOfRange`] for a mean of none, [`DotsError::TooFew`] for fewer frames than the calibration needs.
    pub fn new(
        shape: FrameShape,
        saturation_dn: u16,
        frames: u32,
        background_frames: u32,
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
            mean: BackgroundMean::new(shape, background_frames)?,
            noisy: Vec::with_capacity(NOISE_FRAMES),
        })
    }

    /// Adds a frame; returns whether more are needed.
    ///
    /// # Errors
    /// [`DotsError::Shape`] if it does not have the frames' size.
    pub fn push(&mut self, frame: &[u16]) -> Result<bool, DotsError> {
        if self.taken < self.wanted && !is_flash(self.shape, frame, self.saturation_dn)? {
            self.taken += 1;
            self.statistics.push(frame)?;
            match self.noisy.len() < NOISE_FRAMES {
                true => self.noisy.push(frame.to_vec()),
                false => self.mean.push_dark(frame)?,
            }
        }
        Ok(self.taken < self.wanted)
    }

    /// The sensor's calibration: pixels whose level or noise exceeds the others' by `hot_sigmas` are hot. `flat` is
    /// the flat field, `None` for an even sensor; its dead pixels are repaired like hot ones.
    ///
    /// # Errors
    /// [`DotsError::TooFew`] while frames are missing; [`DotsError::Shape`] and [`DotsError::OutOfRange`] for an
    /// invalid flat field.
    pub fn finish(
        self,
        hot_sigmas: f64,
        flat: Option<&FlatField>,
        sampling: Sampling,
    ) -> Result<Sensor, DotsError> {
        if self.taken < self.wanted {
            let (given, needed) = (self.taken as usize, self.wanted as usize);
            let what = "dark frames: the camera was stopped, lost them or saw light in them";
            return Err(DotsError::TooFew { what, given, needed });
        }
        let mut repaired = self.statistics.hot_pixels(hot_sigmas)?;
        repaired.extend(flat.iter().flat_map(|flat| &flat.dead));
        let even = Array3::ones((self.shape.height(), self.shape.width(), self.shape.channels()));
        let gain = flat.map_or(even.view(), |flat| flat.gain.view());
        let correction = Correction::new(self.shape, gain, &repaired, sampling)?;
        let background = Background::new(&correction, self.mean.mean())?;
        let frames = self.noisy.iter().map(Vec::as_slice);
        let floor = NoiseFloor::measured(frames, &correction, &background, &Region::whole(self.shape))?;
        Ok(Sensor { correction, background: self.mean, floor })
    }
}

/// Collects frames of even light for a [`FlatField`].
pub struct FlatRun {
    shape: FrameShape,
    saturation_dn: u16,
    wanted: u32,
    statistics: RunStatistics,
}

impl FlatRun {
    /// A run of `frames` frames. Those in which most pixels have `saturation_dn` or more are left out.
    pub fn new(shape: FrameShape, saturation_dn: u16, frames: u32) -> Self {
        Self { shape, saturation_dn, wanted: frames, statistics: RunStatistics::new(shape) }
    }

    fn wants_more(&self) -> bool {
        self.statistics.frames() < self.wanted.into()
    }

    /// Adds a frame; returns whether more are needed.
    ///
    /// # Errors
    /// [`DotsError::Shape`] if it does not have the frames' size.
    pub fn push(&mut self, frame: &[u16]) -> Result<bool, DotsError> {
        if self.wants_more() && !is_flash(self.shape, frame, self.saturation_dn)? {
            self.statistics.push(frame)?;
        }
        Ok(self.wants_more())
    }

    /// The flat field. Pixels that `dark` shows to be hot, as in [`DarkRun::finish`], are excluded.
    ///
    /// # Errors
    /// [`DotsError::TooFew`] while frames are missing; otherwise as [`FlatField::measured`].
    pub fn finish(self, dark: &DarkRun, hot_sigmas: f64, sampling: Sampling) -> Result<FlatField, DotsError> {
        if self.wants_more() {
            let (given, needed) = (self.statistics.frames() as usize, self.wanted as usize);
            let what = "frames of even light that are not overexposed: dim the light, or take a shorter batches.exposure_us";
            return Err(DotsError::TooFew { what, given, needed });
        }
        let hot = dark.statistics.hot_pixels(hot_sigmas)?;
        let Self { shape, statistics, saturation_dn, .. } = self;
        FlatField::measured(shape, &statistics, &dark.statistics, &hot, sampling, saturation_dn)
    }
}

/// Whether most of a frame is overexposed, so that it is unusable for calibration.
fn is_flash(shape: FrameShape, frame: &[u16], saturation_dn: u16) -> Result<bool, DotsError> {
    Ok(Observation::new(0, frame, shape, &Region::whole(shape), saturation_dn)?.saturated)
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
        assert!((sensor.background.variance() * 32.0 - 1.0).abs() < 1e-9, "the mean of 32 frames");
        // Uniform over 0 to 7: sigma is the square root of 63/12.
        assert!((sensor.floor.sigma - 2.29).abs() < 0.2, "{:?}", sensor.floor);
        assert!(sensor.floor.mean.abs() < 0.3, "{:?}", sensor.floor);
    }

    #[test]
    fn dead_pixels_are_repaired_and_flashes_are_no_even_light() {
        let shape = FrameShape::new(32, 64, 1).unwrap();
        let frame = |level: u16| (0..2048).map(move |pixel| if pixel == 9 { 101 } else { level + pixel % 2 });
        let frame = |level: u16| frame(level).collect::<Vec<u16>>();
        let mut dark = DarkRun::new(shape, 4000, 16, 64).unwrap();
        for number in 0..16 {
            assert_eq!(dark.push(&frame(100)).unwrap(), number < 15);
        }
        let mut flat = FlatRun::new(shape, 4000, 16);
        assert!(flat.push(&vec![4095; 2048]).unwrap(), "a flash is no frame of even light");
        for number in 0..15 {
            assert!(flat.push(&frame(1000)).unwrap(), "{number}");
        }
        assert!(!flat.push(&frame(1000)).unwrap());
        let field = flat.finish(&dark, 8.0, Sampling::Full).unwrap();
        let sensor = dark.finish(8.0, Some(&field), Sampling::Full).unwrap();
        assert_eq!(sensor.correction.hot(), [9]);
        assert!(sensor.correction.gain().iter().all(|gain| (gain - 1.0).abs() < 1e-6));

        let dark = DarkRun::new(shape, 4000, 16, 64).unwrap();
        let error = FlatRun::new(shape, 4000, 16).finish(&dark, 8.0, Sampling::Full).unwrap_err();
        assert!(matches!(error, DotsError::TooFew { given: 0, needed: 16, .. }), "{error}");
    }

    #[test]
    fn too_few_frames_are_no_calibration() {
        let shape = FrameShape::new(32, 64, 1).unwrap();
        assert!(matches!(DarkRun::new(shape, 4000, 15, 64), Err(DotsError::TooFew { needed: 16, .. })));
        let run = DarkRun::new(shape, 4000, 16, 64).unwrap();
        assert!(matches!(run.finish(8.0, None, Sampling::Full), Err(DotsError::TooFew { given: 0, .. })));
    }
}
