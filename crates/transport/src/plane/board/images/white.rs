use ndarray::{Array2, ArrayView3, Axis, Zip};

use super::{Estimate, ImagesError, SensorNoise, check_frames, check_shape, mean_image, median};

/// What a pixel collects of the white picture in one pass of the beam, black picture subtracted.
///
/// It contains the lens's shading, the board's brightness and the projector's brightness at that place, which cannot
/// be told apart.
#[derive(Debug, Clone, PartialEq)]
pub struct WhiteMap {
    /// White, `[t, s]`.
    pub white_dn: Array2<f32>,
    /// Its standard deviation by the noise of the frames, `[t, s]`.
    pub sd_dn: Array2<f32>,
    /// Noise of a frame.
    pub noise: SensorNoise,
    /// Number of frames of the black picture.
    pub black_frames: usize,
    /// Median over the lit pixels; the standard deviation contains the changes of all pixels from frame to frame.
    pub level_dn: Estimate,
    /// Share of the pixels that are lit.
    pub coverage: f64,
    /// Share of the pixels that saturate in any frame.
    pub saturated: f64,
}

/// A pixel is lit if it has this share of the median over the lit pixels.
const LIT_SHARE: f32 = 0.3;
const LEAST_COVERAGE: f64 = 0.6;
const MOST_SATURATED: f64 = 0.001;
const LEAST_LEVEL: f64 = 0.25;

impl WhiteMap {
    /// From frames of the white and of the black picture with the same exposure, and from which DN on pixels saturate.
    ///
    /// # Errors
    /// [`ImagesError::TooFew`], [`ImagesError::Shape`], [`ImagesError::OutOfRange`]. The checks of the light are
    /// separate: see [`Self::check`].
    pub fn new(
        white: ArrayView3<f32>,
        black: ArrayView3<f32>,
        full_scale_dn: f32,
        noise: SensorNoise,
    ) -> Result<Self, ImagesError> {
        noise.check()?;
        let (frames, black_frames) = (white.len_of(Axis(0)), black.len_of(Axis(0)));
        check_frames(frames, 2)?;
        check_frames(black_frames, 1)?;
        check_shape("black", "[t, s]", &black.shape()[1..], &white.shape()[1..])?;
        let black_dn = mean_image(black);
        let white_dn = mean_image(white) - &black_dn;
        let black_variance_dn2 = noise.variance_dn2(0.0) / black_frames as f64;
        let sd_dn = white_dn.mapv(|white| {
            (noise.variance_dn2(f64::from(white)) / frames as f64 + black_variance_dn2).sqrt() as f32
        });
        let lit = lit(&white_dn);
        let mut values: Vec<f64> =
            white_dn.iter().zip(&lit).filter(|(_, lit)| **lit).map(|(&white, _)| f64::from(white)).collect();
        let level = median(&mut values).unwrap_or(0.0);
        let saturated = Zip::from(white.lanes(Axis(0)))
            .par_map_collect(|samples| samples.iter().any(|&sample| sample >= full_scale_dn));
        let share = |mask: &Array2<bool>| mask.iter().filter(|set| **set).count() as f64 / mask.len() as f64;
        Ok(Self {
            level_dn: Estimate { value: level, sd: level * drift(white, &black_dn, &lit) },
            coverage: share(&lit),
            saturated: share(&saturated),
            white_dn,
            sd_dn,
            noise,
            black_frames,
        })
    }

    /// Refuses a white that is of no use for calibration.
    ///
    /// # Errors
    /// [`ImagesError::Coverage`] below 60 % of the image, [`ImagesError::Saturated`] above 0.1 % of the pixels,
    /// [`ImagesError::Dim`] below a quarter of full scale.
    pub fn check(&self, full_scale_dn: f32) -> Result<(), ImagesError> {
        let level = self.level_dn.value / f64::from(full_scale_dn);
        if self.coverage < LEAST_COVERAGE {
            return Err(ImagesError::Coverage { coverage: self.coverage, limit: LEAST_COVERAGE });
        }
        if self.saturated > MOST_SATURATED {
            return Err(ImagesError::Saturated { share: self.saturated, limit: MOST_SATURATED });
        }
        if level < LEAST_LEVEL {
            return Err(ImagesError::Dim { level, limit: LEAST_LEVEL });
        }
        Ok(())
    }

    /// Pixels with at least 30 % of the median white, `[t, s]`.
    pub fn lit(&self) -> Array2<bool> {
        lit(&self.white_dn)
    }
}

/// Pixels with at least 30 % of the median over such pixels.
fn lit(white_dn: &Array2<f32>) -> Array2<bool> {
    // The 98th percentile is lit even if the board fills a twentieth of the image, and no highlight.
    let mut values: Vec<f32> = white_dn.iter().copied().collect();
    if values.is_empty() {
        return Array2::default(white_dn.dim());
    }
    let high = values.len() * 98 / 100;
    let bright = *values.select_nth_unstable_by(high, f32::total_cmp).1;
    let mut above: Vec<f64> =
        white_dn.iter().filter(|&&w| w > LIT_SHARE * bright).map(|&w| f64::from(w)).collect();
    let level = median(&mut above).unwrap_or(f64::INFINITY) as f32;
    white_dn.mapv(|white| white > 0.0 && white >= LIT_SHARE * level)
}

/// Relative standard deviation of the mean over frames of what all lit pixels have in common.
fn drift(white: ArrayView3<f32>, black_dn: &Array2<f32>, lit: &Array2<bool>) -> f64 {
    let sums: Vec<f64> = white
        .axis_iter(Axis(0))
        .map(|frame| {
            let mut sum = 0.0;
            Zip::from(&frame)
                .and(black_dn)
                .and(lit)
                .for_each(|&dn, &black, &lit| sum += if lit { f64::from(dn - black) } else { 0.0 });
            sum
        })
        .collect();
    let n = sums.len() as f64;
    let mean = sums.iter().sum::<f64>() / n;
    let scatter = sums.iter().map(|sum| (sum - mean).powi(2)).sum::<f64>() / (n - 1.0);
    if mean > 0.0 { (scatter / n).sqrt() / mean } else { 0.0 }
}
