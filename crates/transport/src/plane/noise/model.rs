use ndarray::{ArrayView2, ArrayView3, Axis, s};

use super::super::PlaneError;

/// The noise of an image: read noise and shot noise, independent from sample to sample.
///
/// In the units of the stack, in which 1.0 is the light that a white pixel collects per row dwell: a camera with read
/// noise `r` electrons that collects `w` electrons from white has `read_variance = (r / w)^2` and `gain = 1 / w`.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct NoiseModel {
    /// Variance of a sample of one frame in the dark.
    pub read_variance: f64,
    /// Variance that each unit of light adds to one frame's sample.
    pub gain: f64,
}

/// Largest number of samples used for a fit; half a million determine both parameters to about 1 %.
const MAX_SAMPLES: usize = 500_000;
/// Smallest number of samples for a meaningful line over the intensity.
const MIN_SAMPLES: usize = 1000;
/// Number of groups of similar intensity, each of which gives one variance.
const GROUPS: usize = 20;
/// Median of the square of a standard normal variable.
const MEDIAN_SQUARE: f64 = 0.454_94;

impl NoiseModel {
    /// Checks the parameters.
    ///
    /// # Errors
    /// [`PlaneError::OutOfRange`] for a parameter that is negative or not finite.
    pub fn check(&self) -> Result<(), PlaneError> {
        for (field, value) in [("read_variance", self.read_variance), ("gain", self.gain)] {
            if !(value.is_finite() && value >= 0.0) {
                let allowed = "finite and not negative: fit the noise from a stack, or use the data sheet";
                return Err(PlaneError::OutOfRange { field, value, allowed });
            }
        }
        Ok(())
    }

    /// Variance of the mean of `frames` samples of this intensity. Negative intensities count as 0.
    pub fn variance(&self, intensity: f64, frames: usize) -> f64 {
        (self.read_variance + self.gain * intensity.max(0.0)) / frames as f64
    }

    /// The same without the noise of dark images that were subtracted from the images to which it was fitted, each with
    /// this many frames for every frame of its dark image.
    #[must_use]
    pub fn without_darks(self, frames_per_dark_frame: f64) -> Self {
        Self { read_variance: self.read_variance / (1.0 + frames_per_dark_frame), ..self }
    }

    /// Fits the noise to a stack `[settings, t, s]` whose images are means of `frames[setting]` frames.
    ///
    /// A pixel is compared with the mean of its left and right neighbours, each scaled to the pixel's own total, so
    /// that texture cancels, as does a profile that changes steadily from pixel to pixel. Medians over groups of
    /// similar intensity resist edges, and a line through the groups gives both parameters. A second fit leaves out
    /// the pixels that this noise does not explain. Other differences between neighbours count as noise: the fit is
    /// an upper bound, and a close one for stacks of few frames. Pixels with samples masked in `valid` are left out.
    ///
    /// # Errors
    /// [`PlaneError::Shape`] if `frames` or `valid` do not fit the stack; [`PlaneError::TooFewSamples`].
    pub fn fit(
        stack: ArrayView3<f32>,
        valid: Option<ArrayView3<bool>>,
        frames: &[usize],
    ) -> Result<Self, PlaneError> {
        check_shapes(stack, valid, frames)?;
        let (settings, rows, columns) = stack.dim();
        let usable = |t: usize, column: usize| {
            valid.is_none_or(|valid| valid.slice(s![.., t, column]).iter().all(|&valid| valid))
        };
        let total = stack.fold_axis(Axis(0), 0.0, |sum, &sample| sum + f64::from(sample));
        let step = (settings * rows * columns).div_ceil(MAX_SAMPLES);
        let inner = (0..rows).flat_map(|t| (1..columns.saturating_sub(1)).map(move |column| (t, column)));
        let mut pixels: Vec<Vec<SquaredDifference>> = Vec::new();
        for (t, column) in inner.step_by(step) {
            let scale = |neighbour: usize| total[[t, column]] / total[[t, neighbour]];
            let scales = [scale(column - 1), scale(column + 1)];
            let alike = scales.iter().all(|scale| (0.5..=2.0).contains(scale));
            if alike && (column - 1..=column + 1).all(|column| usable(t, column)) {
                let samples = stack.slice(s![.., t, column - 1..=column + 1]);
                pixels.push(squared_differences(samples, scales, frames, total[[t, column]]).collect());
            }
        }
        let first = Self::of_pixels(&pixels)?;
        // Even medians shift by a tenth if one pixel in twenty lies at an edge, so such pixels are left out.
        let most = 1.0 + 3.0 * (2.0 / settings as f64).sqrt();
        let excess = |pixel: &[SquaredDifference]| {
            let variance = |s: &SquaredDifference| first.variance(s.intensity, 1).max(f64::MIN_POSITIVE);
            pixel.iter().map(|s| s.square / variance(s)).sum::<f64>() / settings as f64
        };
        pixels.retain(|pixel| excess(pixel) <= most);
        Self::of_pixels(&pixels)
    }

    /// The line through the medians of groups of similar intensity.
    fn of_pixels(pixels: &[Vec<SquaredDifference>]) -> Result<Self, PlaneError> {
        let mut squares: Vec<SquaredDifference> = pixels.concat();
        if squares.len() < MIN_SAMPLES {
            return Err(PlaneError::TooFewSamples { samples: squares.len(), needed: MIN_SAMPLES });
        }
        squares.sort_by(|a, b| a.intensity.total_cmp(&b.intensity));
        let group_size = squares.len().div_ceil(GROUPS);
        let groups: Vec<_> = squares.chunks_mut(group_size).map(SquaredDifference::median).collect();
        Ok(Self::line(&groups))
    }

    /// The line through variances as a function of intensity, each weighted by its own relative precision.
    fn line(groups: &[SquaredDifference]) -> Self {
        let mean_variance = groups.iter().map(|group| group.square).sum::<f64>() / groups.len() as f64;
        let mut model = Self { read_variance: mean_variance, gain: 0.0 };
        for _ in 0..10 {
            let [mut w, mut wx, mut wy, mut wxx, mut wxy] = [0.0; 5];
            for SquaredDifference { intensity, square } in groups {
                let weight = model.variance(*intensity, 1).max(f64::MIN_POSITIVE.sqrt()).powi(-2);
                w += weight;
                wx += weight * intensity;
                wy += weight * square;
                wxx += weight * intensity * intensity;
                wxy += weight * intensity * square;
            }
            let spread = w * wxx - wx * wx;
            let gain = if spread > 0.0 { (w * wxy - wx * wy) / spread } else { 0.0 };
            let read_variance = (wy - gain * wx) / w;
            // A line with a negative parameter is replaced by the best line with that parameter at 0.
            model = match (read_variance >= 0.0, gain >= 0.0) {
                (true, true) => Self { read_variance, gain },
                (false, _) => Self { read_variance: 0.0, gain: wxy / wxx },
                (true, false) => Self { read_variance: wy / w, gain: 0.0 },
            };
        }
        model
    }
}

/// The square of a difference that contains only noise, scaled to the variance of one sample of one frame.
#[derive(Debug, Clone, Copy)]
struct SquaredDifference {
    intensity: f64,
    square: f64,
}

impl SquaredDifference {
    /// Median intensity of a group, and the variance implied by the median of its squares.
    fn median(group: &mut [Self]) -> Self {
        let middle = group.len() / 2;
        let intensity = group[middle].intensity;
        let (_, median, _) = group.select_nth_unstable_by(middle, |a, b| a.square.total_cmp(&b.square));
        Self { intensity, square: median.square / MEDIAN_SQUARE }
    }
}

/// From `samples` `[settings, 3]`: the middle pixel, whose sum is `total`, minus the mean of the others times
/// `scales`.
fn squared_differences<'a>(
    samples: ArrayView2<'a, f32>,
    scales: [f64; 2],
    frames: &'a [usize],
    total: f64,
) -> impl Iterator<Item = SquaredDifference> + 'a {
    let [left, right] = scales;
    // The difference has the variance read * spread + gain * (the weighted sum of intensities).
    let spread = 1.0 + (left * left + right * right) / 4.0;
    (0..frames.len()).map(move |setting| {
        let [a, b, c] = [0, 1, 2].map(|pixel| f64::from(samples[[setting, pixel]]));
        let difference = b - (left * a + right * c) / 2.0;
        // Scaling to equal totals removes the part of a sample's noise that it shares with its total.
        let kept = 1.0 - (b / total).clamp(0.0, 0.5);
        SquaredDifference {
            intensity: (b + (left * left * a + right * right * c) / 4.0) / spread,
            square: difference * difference / (spread * kept) * frames[setting] as f64,
        }
    })
}

/// Checks that masks and frame counts fit a stack.
pub fn check_shapes(
    stack: ArrayView3<f32>,
    valid: Option<ArrayView3<bool>>,
    frames: &[usize],
) -> Result<(), PlaneError> {
    if let Some(valid) = valid.filter(|valid| valid.dim() != stack.dim()) {
        let (actual, expected) = (valid.shape().to_vec(), stack.shape().to_vec());
        return Err(PlaneError::Shape {
            array: "valid",
            axes: "[settings, camera rows, columns]",
            actual,
            expected,
        });
    }
    if frames.len() != stack.len_of(Axis(0)) {
        let (actual, expected) = (vec![frames.len()], vec![stack.len_of(Axis(0))]);
        return Err(PlaneError::Shape { array: "frames", axes: "[settings]", actual, expected });
    }
    if frames.contains(&0) {
        let allowed = "at least 1 for each setting: leave out settings without frames";
        return Err(PlaneError::OutOfRange { field: "frames", value: 0.0, allowed });
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(points: &[(f64, f64)]) -> NoiseModel {
        let groups = points.iter().map(|&(intensity, square)| SquaredDifference { intensity, square });
        NoiseModel::line(&groups.collect::<Vec<_>>())
    }

    #[test]
    fn a_line_is_found_and_stays_in_the_quadrant() {
        let NoiseModel { read_variance, gain } = line(&[(0.0, 2.0), (1.0, 5.0), (2.0, 8.0)]);
        assert!((read_variance - 2.0).abs() < 1e-9 && (gain - 3.0).abs() < 1e-9);
        let falling = line(&[(0.0, 3.0), (1.0, 2.0), (2.0, 1.0)]);
        assert!(falling.gain == 0.0 && (1.0..=3.0).contains(&falling.read_variance), "{falling:?}");
        let steep = line(&[(1.0, 0.5), (2.0, 3.0)]);
        assert!(steep.read_variance == 0.0 && (0.5..=1.5).contains(&steep.gain), "{steep:?}");
        assert_eq!(line(&[(0.5, 0.0), (1.0, 0.0)]), NoiseModel { read_variance: 0.0, gain: 0.0 });
    }

    #[test]
    fn variance_of_a_mean_by_hand() {
        let noise = NoiseModel { read_variance: 4.0, gain: 2.0 };
        assert_eq!((noise.variance(3.0, 5), noise.variance(-1.0, 1)), (2.0, 4.0));
    }
}
