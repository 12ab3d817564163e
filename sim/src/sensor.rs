//! Sensor model after EMVA 1288 (release 4.0): converts light to electrons to counts.

use ndarray::Array2;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use crate::keyed::{Purpose, keyed, uniform};
use raysweep_config::sim::SimSensor;

/// One frame's exposure: its light, its duration and its noise key.
pub struct SensorExposure<'a> {
    /// Light of each pixel in the scene's units (1 = a white pixel's row), `[t, s]`, row-major.
    pub light: &'a mut [f32],
    /// Time for which each row collected dark current.
    pub exposure_us: f64,
    /// Noise key: point, attempt, frame.
    pub key: [u64; 3],
}

/// Scale of the camera's counts.
#[derive(Debug, Clone, Copy)]
pub struct Scale {
    /// Counts of a white pixel's row, above black.
    pub white_dn: f64,
    /// Counts without light.
    pub black_dn: f64,
    /// Bits per pixel.
    pub bits: u32,
}

/// Fixed properties of each pixel, drawn once.
pub struct ImageSensor {
    config: SimSensor,
    seed: u64,
    width: usize,
    /// Electrons of a white pixel's row, after vignetting and PRNU, `[t, s]` row-major.
    electrons_per_light: Vec<f32>,
    /// Electrons at zero light and zero exposure time, `[t, s]` row-major.
    offset_e: Vec<f32>,
    electrons_per_dn: f32,
    /// Dark current in electrons per microsecond, `[t, s]` row-major.
    dark_e_per_us: Vec<f32>,
    black_dn: f32,
    /// By how much each count of a signal lowers it, relative to itself.
    compression_per_dn: f32,
    /// The signal at which counts are highest.
    most_signal_dn: f32,
    /// Distance between neighbouring converter codes, in counts.
    step_dn: f32,
    max_dn: f32,
}

impl ImageSensor {
    /// A sensor of `size` (rows, columns).
    pub fn new(config: &SimSensor, size: (usize, usize), scale: Scale, seed: u64) -> Self {
        let (height, width) = size;
        // The same light fills the same fraction of the scale at any bit depth.
        let electrons_per_dn = config.electrons_per_dn * 2_f64.powi(12 - scale.bits as i32);
        let mut random = keyed(seed, Purpose::Pattern, &[]);
        let mut spread = |sigma: f64| -> f64 {
            let z: f64 = StandardNormal.sample(&mut random);
            if config.noise { sigma * z } else { 0.0 }
        };
        let gain = Array2::from_shape_fn(size, |(t, s)| {
            // Vignetting: quadratic in the distance from the centre, the first-order term of cos^4.
            let (y, x) = ((t as f64 + 0.5) / height as f64 - 0.5, (s as f64 + 0.5) / width as f64 - 0.5);
            let vignetting = 1.0 - config.vignetting_percent / 100.0 * 2.0 * (x * x + y * y);
            scale.white_dn * electrons_per_dn * vignetting * (1.0 + spread(config.prnu_percent / 100.0))
        });
        let mut offset_e: Vec<f32> = (0..height * width).map(|_| spread(config.dsnu_e) as f32).collect();
        let dark_e_per_us = (0..height * width)
            .map(|_| {
                let hot = config.noise && uniform(&mut random) < config.hot_pixels;
                let dark = if config.noise { config.dark_current_e_per_s } else { 0.0 };
                ((if hot { config.hot_pixel_e_per_s } else { dark }) * 1e-6) as f32
            })
            .collect();
        if config.noise && config.column_e > 0.0 {
            let mut random = keyed(seed, Purpose::Columns, &[]);
            let columns: Vec<f32> = (0..width)
                .map(|_| (config.column_e * Distribution::<f64>::sample(&StandardNormal, &mut random)) as f32)
                .collect();
            offset_e.iter_mut().zip(columns.iter().cycle()).for_each(|(offset, column)| *offset += column);
        }
        let step_dn = 2_f32.powi(scale.bits.saturating_sub(config.adc_bits.max(1)) as i32);
        let max_dn = 2_f32.powi(scale.bits as i32) - step_dn;
        let compression_per_dn = config.compression_percent as f32 / 100.0 / (max_dn - scale.black_dn as f32);
        Self {
            config: config.clone(),
            seed,
            width,
            electrons_per_light: gain.iter().map(|&gain| gain as f32).collect(),
            offset_e,
            dark_e_per_us,
            electrons_per_dn: electrons_per_dn as f32,
            black_dn: scale.black_dn as f32,
            step_dn,
            max_dn,
            compression_per_dn,
            most_signal_dn: 0.5 / compression_per_dn,
        }
    }

    /// Converts light to counts, `[t, s]` row-major.
    pub fn read(&self, exposed: SensorExposure<'_>, counts: &mut [u16]) {
        let SensorExposure { light, exposure_us, key } = exposed;
        let width = self.width;
        light.par_chunks_mut(width).zip(counts.par_chunks_mut(width)).enumerate().for_each(
            |(t, (light, counts))| {
                let mut random = keyed(self.seed, Purpose::Noise, &[key[0], key[1], key[2], t as u64]);
                let pixels = t * width..(t + 1) * width;
                let gains = &self.electrons_per_light[pixels.clone()];
                let offsets = &self.offset_e[pixels.clone()];
                let dark = &self.dark_e_per_us[pixels];
                for (s, (light, count)) in light.iter().zip(counts).enumerate() {
                    let collected_e = light * gains[s] + dark[s] * exposure_us as f32;
                    let mut electrons = collected_e;
                    if self.config.noise {
                        // Shot noise in its Gaussian limit: below about 20 electrons, where it is not Gaussian, read
                        // noise masks the difference.
                        let variance = collected_e.max(0.0) + (self.config.read_noise_e as f32).powi(2);
                        let z: f32 = StandardNormal.sample(&mut random);
                        electrons += variance.sqrt() * z;
                    }
                    let electrons = (electrons + offsets[s]).min(self.config.full_well_e as f32);
                    // Beyond the parabola's peak, counts would fall again.
                    let signal_dn = (electrons / self.electrons_per_dn).min(self.most_signal_dn);
                    let level = self.black_dn + signal_dn * (1.0 - self.compression_per_dn * signal_dn);
                    *count = ((level / self.step_dn).round() * self.step_dn).clamp(0.0, self.max_dn) as u16;
                }
            },
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Mean and variance over pixels and frames under a uniform `light`.
    fn field(config: &SimSensor, light: f32, frames: u64) -> (f64, f64) {
        let scale = Scale { white_dn: 2500.0, black_dn: 64.0, bits: 12 };
        let sensor = ImageSensor::new(config, (64, 64), scale, 3);
        let mut all = Vec::new();
        for frame in 0..frames {
            let mut counts = vec![0; 64 * 64];
            let mut field = vec![light; 64 * 64];
            sensor.read(
                SensorExposure { light: &mut field, exposure_us: 1000.0, key: [1, 0, frame] },
                &mut counts,
            );
            all.extend(counts.into_iter().map(f64::from));
        }
        let mean = all.iter().sum::<f64>() / all.len() as f64;
        (mean, all.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / all.len() as f64)
    }

    #[test]
    fn photon_transfer_follows_emva_1288() {
        // sigma_y^2 = K^2 sigma_d^2 + 1/12 + K (mu_y - mu_y.dark), K in counts per electron.
        let config = SimSensor { prnu_percent: 0.0, dsnu_e: 0.0, hot_pixels: 0.0, ..SimSensor::default() };
        let gain = 1.0 / config.electrons_per_dn;
        for light in [0.0, 0.05, 0.3, 1.0] {
            let (mean, variance) = field(&config, light, 8);
            assert!((mean - 64.0 - f64::from(light) * 2500.0).abs() < 1.0, "mean {mean} at {light}");
            let expected = (gain * config.read_noise_e).powi(2) + 1.0 / 12.0 + gain * (mean - 64.0);
            assert!(
                (variance / expected - 1.0).abs() < 0.04,
                "variance {variance}, expected {expected} at {light}"
            );
        }
    }

    #[test]
    fn codes_of_fewer_bits_step_and_saturate_on_the_12_bit_scale() {
        let config = SimSensor { adc_bits: 10, noise: false, ..SimSensor::default() };
        assert_eq!(field(&config, 0.1204, 1).0, 364.0);
        assert_eq!(field(&config, 100.0, 1).0, 4092.0);
    }

    #[test]
    fn other_formats_have_the_same_light_on_their_own_scale() {
        let config = SimSensor { noise: false, ..SimSensor::default() };
        for (bits, black_dn, saturated) in [(8, 4.0, 255), (10, 16.0, 1023), (16, 1024.0, 65_520)] {
            let white_dn = 2500.0 * 2_f64.powi(bits - 12);
            let scale = Scale { white_dn, black_dn, bits: bits as u32 };
            let sensor = ImageSensor::new(&config, (1, 2), scale, 1);
            let mut counts = [0; 2];
            sensor
                .read(SensorExposure { light: &mut [0.5, 9.0], exposure_us: 1.0, key: [0; 3] }, &mut counts);
            assert!(
                (f64::from(counts[0]) - black_dn - white_dn / 2.0).abs() <= 8.0,
                "{bits} bits: {counts:?}"
            );
            assert_eq!(counts[1], saturated, "{bits} bits");
        }
    }

    #[test]
    fn full_well_saturates_before_the_converter_where_it_is_smaller() {
        let config = SimSensor { full_well_e: 1660.0, noise: false, ..SimSensor::default() };
        assert_eq!(field(&config, 1.0, 1).0, 1064.0);
    }
}
