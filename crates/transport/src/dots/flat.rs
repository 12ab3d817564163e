//! The flat field: the differences between the pixels' responses to the same light.

use ndarray::Array3;

use super::error::check_range;
use super::sensor::median;
use super::{DotsError, FrameShape, RunStatistics, Sampling};

/// Pixels with less than this share of the median light of their colour are dead or shaded.
const LEAST_LIGHT: f64 = 0.25;
/// Largest share of dead pixels, and largest share of overexposed pixels.
const MOST_FAULTY: f64 = 0.01;
/// Largest noise of a pixel's mean relative to its light; the gain adds this noise to every later frame.
const MOST_NOISE: f64 = 0.01;
/// A pixel is overexposed if its mean plus this many standard deviations reaches saturation.
const HEADROOM_SIGMAS: f64 = 3.0;

/// Gain of each pixel from frames of even light (EMVA 1288's PRNU, plus the fall-off of light towards the corners).
#[derive(Debug, Clone, PartialEq)]
pub struct FlatField {
    /// Factor for counts above the dark level, `[height, width, channels]`: the mean of the colour's sound pixels
    /// divided by the pixel's own mean, so that even light keeps its energy; 1 where it is unknown.
    pub gain: Array3<f32>,
    /// Pixels whose gain cannot be measured: dead or overexposed, as (row, column), ascending.
    pub dead: Vec<(usize, usize)>,
}

impl FlatField {
    /// From frames of even light and from dark frames. `hot` pixels are left out. The colours of a mosaic are
    /// equalised separately: the lamp's colour is not an error of the sensor.
    ///
    /// # Errors
    /// [`DotsError::OutOfRange`] if the mean's noise exceeds 1 % of the light, or if more than 1 % of the pixels are
    /// overexposed (at `saturation_dn`) or have less than a quarter of the others' light; [`DotsError::TooFew`] for
    /// fewer than 8 frames.
    pub fn measured(
        shape: FrameShape,
        flat: &RunStatistics,
        dark: &RunStatistics,
        hot: &[(usize, usize)],
        sampling: Sampling,
        saturation_dn: u16,
    ) -> Result<Self, DotsError> {
        let light: Vec<f64> = (flat.mean()? - dark.mean()?).iter().map(|&light| f64::from(light)).collect();
        let noise = flat.spread()?;
        let (width, channels) = (shape.width(), shape.channels());
        let colour_of = |value: usize| {
            let pixel = value / channels;
            let phase = match sampling {
                Sampling::Full => 0,
                Sampling::Bayer => pixel / width % 2 * 2 + pixel % width % 2,
            };
            phase * channels + value % channels
        };
        let mut is_usable = vec![true; shape.pixels()];
        hot.iter().for_each(|&(row, column)| is_usable[row * width + column] = false);
        let all = is_usable.iter().filter(|usable| **usable).count().max(1) as f64;

        let mut errors: Vec<f64> = (0..light.len())
            .filter(|value| is_usable[value / channels])
            .map(|value| noise[value] / (flat.frames() as f64).sqrt() / light[value].max(f64::MIN_POSITIVE))
            .collect();
        let error = median(&mut errors);
        let allowed = "at most 0.01: give more light, or more batches.flat_frames";
        check_range("the flat field's noise in parts of its light", error, error <= MOST_NOISE, allowed)?;

        let mut dead = Vec::new();
        let mut set_aside = |is_usable: &mut [bool], is_faulty: &dyn Fn(usize) -> bool| {
            let before = dead.len();
            for (pixel, is_usable) in is_usable.iter_mut().enumerate().filter(|(_, usable)| **usable) {
                if (pixel * channels..(pixel + 1) * channels).any(is_faulty) {
                    *is_usable = false;
                    dead.push((pixel / width, pixel % width));
                }
            }
            (dead.len() - before) as f64 / all
        };
        let highest = flat.mean()?;
        let highest: Vec<f64> = highest
            .iter()
            .zip(&noise)
            .map(|(&mean, noise)| f64::from(mean) + HEADROOM_SIGMAS * noise)
            .collect();
        let share = set_aside(&mut is_usable, &|value| highest[value] >= f64::from(saturation_dn));
        let allowed = "at most 0.01: dim the light, or take a shorter batches.exposure_us";
        check_range("the flat field's share of overexposed pixels", share, share <= MOST_FAULTY, allowed)?;

        let of_colour = |is_usable: &[bool], colour: usize| -> Vec<f64> {
            let values =
                (0..light.len()).filter(|&value| is_usable[value / channels] && colour_of(value) == colour);
            values.map(|value| light[value]).collect()
        };
        let colours = 4 * channels;
        let middles: Vec<f64> =
            (0..colours).map(|colour| median(&mut of_colour(&is_usable, colour))).collect();
        let share =
            set_aside(&mut is_usable, &|value| light[value] < LEAST_LIGHT * middles[colour_of(value)]);
        let allowed =
            "at most 0.01: hold an evenly lit diffuser right before the lens, so that nothing shades it";
        let field = "the flat field's share of pixels with less than a quarter of the light";
        check_range(field, share, share <= MOST_FAULTY, allowed)?;

        let means: Vec<f64> = (0..colours)
            .map(|colour| {
                let light = of_colour(&is_usable, colour);
                light.iter().sum::<f64>() / light.len().max(1) as f64
            })
            .collect();
        let mut gain = Array3::ones((shape.height(), width, channels));
        for (value, gain) in gain.iter_mut().enumerate().filter(|(value, _)| is_usable[value / channels]) {
            *gain = (means[colour_of(value)] / light[value]) as f32;
        }
        dead.sort_unstable();
        Ok(Self { gain, dead })
    }
}

#[cfg(test)]
mod tests {
    use rand_distr::{Distribution, Normal};
    use rand_xoshiro::Xoshiro256PlusPlus;
    use rand_xoshiro::rand_core::SeedableRng;

    use super::*;

    fn shape() -> FrameShape {
        FrameShape::new(64, 64, 1).unwrap()
    }

    /// 64 frames with the given mean counts and noise of 3 counts.
    fn run(seed: u64, mean: impl Fn(usize) -> f64) -> RunStatistics {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
        let mut statistics = RunStatistics::new(shape());
        for _ in 0..64 {
            let counts = (0..shape().values()).map(|at| {
                Normal::new(mean(at), 3.0).unwrap().sample(&mut random).round().clamp(0.0, 4095.0) as u16
            });
            statistics.push(&counts.collect::<Vec<u16>>()).unwrap();
        }
        statistics
    }

    /// Response of each pixel: alternating by 5 %, like noise, and 30 % less in the last row.
    fn response(at: usize) -> f64 {
        let scattered = (at as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15) >> 63;
        (if scattered == 0 { 0.95 } else { 1.05 }) * (1.0 - 0.3 * (at / 64) as f64 / 63.0)
    }

    fn measured(
        flat: &RunStatistics,
        hot: &[(usize, usize)],
        sampling: Sampling,
    ) -> Result<FlatField, DotsError> {
        let dark = run(1, |at| if at == 77 { 600.0 } else { 64.0 });
        FlatField::measured(shape(), flat, &dark, hot, sampling, 4000)
    }

    #[test]
    fn even_light_comes_out_even_and_keeps_its_energy() {
        let hot = [(1, 13)];
        let flat = run(2, |at| match at {
            77 => 1600.0,
            100 => 64.0,
            200 => 4095.0,
            at => 64.0 + 1000.0 * response(at),
        });
        let FlatField { gain, dead } = measured(&flat, &hot, Sampling::Full).unwrap();
        assert_eq!(dead, [(1, 36), (3, 8)]);
        let gain: Vec<f64> = gain.iter().map(|&gain| f64::from(gain)).collect();
        assert!([77, 100, 200].iter().all(|&at| gain[at] == 1.0));
        let sound: Vec<usize> = (0..4096).filter(|at| ![77, 100, 200].contains(at)).collect();
        let mean =
            |of: &dyn Fn(usize) -> f64| sound.iter().map(|&at| of(at)).sum::<f64>() / sound.len() as f64;
        let level = mean(&|at| gain[at] * response(at));
        let pattern = mean(&|at| (gain[at] * response(at) / level - 1.0).powi(2)).sqrt();
        // 3 counts over the square root of 64 frames, for light and for dark, relative to 850 counts.
        assert!(pattern < 8e-4, "{pattern}, {} before", mean(&|at| (response(at) - 0.85).powi(2)).sqrt());
        assert!((level / mean(&response) - 1.0).abs() < 1e-3, "{level}");
    }

    #[test]
    fn a_mosaic_keeps_the_colour_of_the_lamp() {
        let warm = |at: usize| if (at / 64).is_multiple_of(2) && at.is_multiple_of(2) { 2.0 } else { 1.0 };
        let flat = run(3, |at| 64.0 + 1000.0 * warm(at) * response(at));
        let mosaic = measured(&flat, &[(1, 13)], Sampling::Bayer).unwrap().gain;
        let level = |red: bool| {
            let of = (0..4096).filter(|&at| (warm(at) > 1.0) == red && at != 77);
            let gains: Vec<f64> =
                of.map(|at| f64::from(mosaic[[at / 64, at % 64, 0]]) * response(at)).collect();
            gains.iter().sum::<f64>() / gains.len() as f64
        };
        assert!((level(true) / level(false) - 1.0).abs() < 0.01, "{} {}", level(true), level(false));
    }

    #[test]
    fn light_that_is_no_flat_field_is_refused_with_what_to_do() {
        let refused = |mean: &dyn Fn(usize) -> f64| {
            measured(&run(4, mean), &[(1, 13)], Sampling::Full).unwrap_err().to_string()
        };
        assert!(refused(&|_| 64.0).contains("batches.flat_frames"));
        assert!(refused(&|_| 84.0).contains("more light"));
        assert!(refused(&|at| if at < 200 { 4200.0 } else { 1000.0 }).contains("dim the light"));
        assert!(refused(&|at| if at % 64 < 4 { 100.0 } else { 1000.0 }).contains("diffuser"));
        let few = RunStatistics::new(shape());
        assert!(matches!(measured(&few, &[], Sampling::Full), Err(DotsError::TooFew { .. })));
    }
}
