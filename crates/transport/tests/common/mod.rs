//! The rendered corner scene and a camera for it, shared by the tests.

use std::fs::File;
use std::path::PathBuf;

use ndarray::{Array2, Array3, Axis};
use ndarray_npy::NpzReader;
use rand_distr::{Distribution, Normal, Poisson};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;
use raysweep_transport::plane::{RowTiming, Setting, predict};

pub fn open(name: &str) -> NpzReader<File> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../tests/data").join(name);
    NpzReader::new(File::open(path).unwrap()).unwrap()
}

/// Transport of the corner scene, `[v, t, s]`, 128 each.
pub fn corner() -> Array3<f32> {
    open("p2r_corner.npz").by_name("T.npy").unwrap()
}

/// 128 rows of 22.22 us at 60 Hz.
pub fn timing() -> RowTiming {
    RowTiming::new(128, 22.22, 50_000.0 / 3.0).unwrap()
}

/// The paper's sweep: t_d -1500..1500 us in 15, t_e 600..1200 us in 5, delays fastest.
pub fn paper_sweep() -> Vec<Setting> {
    let delay_us = |point: usize| -1500.0 + 3000.0 / 14.0 * (point % 15) as f64;
    let exposure_us = |point: usize| 600.0 + 150.0 * (point / 15) as f64;
    (0..75).map(|point| Setting::new(delay_us(point), exposure_us(point))).collect()
}

/// Noise-free images of the settings, `[settings, t, s]`.
pub fn ideal_stack(transport: &Array3<f32>, settings: &[Setting]) -> Array3<f32> {
    let images: Vec<Array2<f32>> =
        settings.iter().map(|setting| predict(&timing(), transport.view(), setting).unwrap()).collect();
    let views: Vec<_> = images.iter().map(|image| image.view()).collect();
    ndarray::stack(Axis(0), &views).unwrap()
}

pub const WHITE_COUNTS: f64 = 2500.0;
pub const ELECTRONS_PER_COUNT: f64 = 8000.0 / 4095.0;
pub const READ_NOISE_ELECTRONS: f64 = 15.0;

/// The mean of 8 frames of a camera with 8000 e- full well, 15 e- read noise and 12 bits, in which a white pixel
/// collects 2500 of 4095 counts per row dwell.
pub fn photographed(ideal: &Array3<f32>, seed: u64) -> Array3<f32> {
    photographed_in(8, ideal, seed)
}

/// [`photographed`] with the given number of frames.
pub fn photographed_in(frames: usize, ideal: &Array3<f32>, seed: u64) -> Array3<f32> {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
    let read_noise = Normal::new(0.0, READ_NOISE_ELECTRONS).unwrap();
    ideal.mapv(|light| {
        let electrons = (f64::from(light) * WHITE_COUNTS * ELECTRONS_PER_COUNT).max(1e-9);
        let shot_noise = Poisson::new(electrons).unwrap();
        let mut frame = || {
            let collected: f64 = shot_noise.sample(&mut random) + read_noise.sample(&mut random);
            (collected / ELECTRONS_PER_COUNT).round().min(4095.0)
        };
        let mean = (0..frames).map(|_| frame()).sum::<f64>() / frames as f64;
        (mean / WHITE_COUNTS) as f32
    })
}
