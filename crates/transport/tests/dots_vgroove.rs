//! The complete path from frames to images, on a V-groove rendered by independent software.

#![allow(clippy::unwrap_used)] // helpers outside #[test] functions are tests too

use std::fs::File;
use std::path::PathBuf;

use ndarray::{Array2, Array3, Axis};
use ndarray_npy::NpzReader;
use rand_distr::{Distribution, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;
use raysweep_transport::dots::calibrate::{Centroids, Footprints};
use raysweep_transport::dots::product::{
    DualImage, column_energies, dual, floodlit, pattern_weights, relight,
};
use raysweep_transport::dots::{
    Background, BackgroundMean, Batch, BatchArrays, Correction, DenoiseSettings, Denoiser, FrameShape,
    NoiseFloor, Region, SparseColumn, reference,
};
use raysweep_transport::quality::{relative_l2, snr_db, ssim};

/// Camera pixels per side of one rendered pixel: 32 pixels per dot, as in the paper.
const PX: usize = 16;
const SIZE: usize = 32 * PX;
/// Counts of a white plane under its dot, of ambient light, and of the dark level, which is not an integer.
const WHITE: f64 = 600.0;
const AMBIENT: f64 = 5.0;
const DARK: f64 = 85.4;
/// In counts; 4095 counts are 16,000 electrons.
const READ_NOISE: f64 = 3.0;
const ELECTRONS_PER_COUNT: f64 = 4.0;

fn transport() -> Array3<f32> {
    let path = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../../tests/data/fd_vgroove.npz");
    NpzReader::new(File::open(path).unwrap()).unwrap().by_name("T.npy").unwrap()
}

/// A frame with one dot, or none, in counts with shot and read noise.
fn photographed(image: Option<&Array2<f32>>, seed: u64) -> Vec<u16> {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
    let mut count = |pixel: usize| {
        let light = image.map_or(0.0, |image| f64::from(image[[pixel / SIZE / PX, pixel % SIZE / PX]]));
        let signal = AMBIENT + WHITE * light;
        let noise: f64 = StandardNormal.sample(&mut random);
        (DARK + signal + noise * (signal / ELECTRONS_PER_COUNT + READ_NOISE * READ_NOISE).sqrt())
            .round()
            .clamp(0.0, 4095.0) as u16
    };
    (0..SIZE * SIZE).map(&mut count).collect()
}

struct Acquired {
    shape: FrameShape,
    frames: Vec<Vec<u16>>,
    correction: Correction,
    background: Background,
    floor: NoiseFloor,
    settings: DenoiseSettings,
}

fn acquire(transport: &Array3<f32>) -> Acquired {
    let shape = FrameShape::new(SIZE, SIZE, 1).unwrap();
    let correction = Correction::none(shape);
    let mut mean = BackgroundMean::new(shape, 64).unwrap();
    (0..64).for_each(|batch| mean.push(&photographed(None, 5000 + batch)).unwrap());
    let background = Background::new(&correction, mean.mean()).unwrap();
    let dump = photographed(None, 6000);
    let floor =
        NoiseFloor::measured([dump.as_slice()], &correction, &background, &Region::whole(shape)).unwrap();
    let images = transport.outer_iter().enumerate();
    let frames = images.map(|(dot, image)| photographed(Some(&image.to_owned()), dot as u64)).collect();
    let settings = DenoiseSettings { radius_px: 25.0, ..DenoiseSettings::default() };
    Acquired { shape, frames, correction, background, floor, settings }
}

impl Acquired {
    fn batch(&self) -> Batch {
        let denoiser = Denoiser::new(self.correction.clone(), self.settings.clone()).unwrap();
        let frames: Vec<&[u16]> = self.frames.iter().map(Vec::as_slice).collect();
        denoiser.batch(&frames, &self.background, self.floor).unwrap()
    }
}

/// Enlarged to the camera's pixels, in counts.
fn counts(image: &Array2<f32>) -> Array3<f32> {
    Array3::from_shape_fn((SIZE, SIZE, 1), |(row, column, _)| WHITE as f32 * image[[row / PX, column / PX]])
}

#[test]
fn the_floodlit_scene_has_its_light_and_its_look() {
    let transport = transport();
    let acquired = acquire(&transport);
    let batch = acquired.batch();
    let truth = counts(&transport.sum_axis(Axis(0)));
    let with_residual = floodlit(&batch);
    let bare = BatchArrays { residual: vec![0.0; batch.arrays().residual.len()], ..batch.arrays().clone() };
    let discs_alone = floodlit(&Batch::new(acquired.shape, bare).unwrap());

    let snr = |image: &Array3<f32>| snr_db(image.view(), truth.view());
    let energy = with_residual.sum() / truth.sum();
    assert!((energy - 1.0).abs() < 0.01, "{energy}");
    // Measured: 26.3 dB against 20.2, where 0.93 of the light is in the discs.
    assert!(snr(&with_residual) >= snr(&discs_alone) + 5.0, "{} {}", snr(&with_residual), snr(&discs_alone));

    // At half a rendered pixel, as its copies in the camera's pixels have no structure of their own.
    let binned = |image: &Array3<f32>| {
        let bins = image.exact_chunks((PX / 2, PX / 2, 1)).into_iter().map(|bin| bin.mean().unwrap());
        Array2::from_shape_vec((64, 64), bins.collect()).unwrap()
    };
    let likeness = |image: &Array3<f32>| ssim(binned(image).view(), binned(&truth).view(), WHITE);
    assert!(
        likeness(&with_residual) > likeness(&discs_alone),
        "{} {}",
        likeness(&with_residual),
        likeness(&discs_alone)
    );
    assert_eq!(batch.counts().capped, 0);
}

#[test]
fn single_frames_equal_the_reference() {
    let acquired = acquire(&transport());
    let denoiser = Denoiser::new(acquired.correction.clone(), acquired.settings.clone()).unwrap();
    let (mut scratch, mut column) = (denoiser.scratch(), SparseColumn::default());
    for frame in acquired.frames.iter().step_by(37) {
        let Acquired { correction, background, floor, settings, .. } = &acquired;
        let expected = reference::column(frame, correction, background, *floor, settings).unwrap();
        denoiser.column(frame, background, *floor, &mut scratch, &mut column).unwrap();
        assert_eq!(
            (&column.words, &column.masks, column.outcome),
            (&expected.words, &expected.masks, expected.outcome)
        );
        assert_eq!(column.values, expected.values);
    }
}

#[test]
fn the_dual_image_and_relit_halves_are_those_of_the_transport() {
    let transport = transport();
    let acquired = acquire(&transport);
    let batch = acquired.batch();
    // A plane whose dots land side by side, 32 pixels apart.
    let plane: Vec<Vec<u16>> = (0..256)
        .map(|dot| {
            let lit = |(row, column)| if (row / 2, column / 2) == (dot / 16, dot % 16) { 1.0 } else { 0.0 };
            photographed(Some(&Array2::from_shape_fn((32, 32), lit)), 7000 + dot as u64)
        })
        .collect();
    let plane = Acquired { frames: plane, ..acquired }.batch();
    let centroids = Centroids::new(&plane, &Footprints::new(&plane, 0.5).unwrap()).unwrap();
    let DualImage { image, known } = dual(&batch, &centroids, &column_energies(&plane), (16, 16)).unwrap();
    assert!(known.iter().all(|&known| known));
    // Four rendered pixels of 1 under a dot of the plane.
    let truth = transport.map_axis(Axis(1), |column| column.sum()).sum_axis(Axis(1)) / 4.0;
    let truth = Array3::from_shape_vec((16, 16, 1), truth.to_vec()).unwrap();
    let error = relative_l2(image.view(), truth.view());
    assert!(error < 0.03, "{error}");

    let half = |left: bool| {
        let lit = |(_, column, _)| if (column < 8) == left { 1.0 } else { 0.0 };
        // As large as the grid of dots, so that each dot has its own pixel.
        let weights = pattern_weights(&centroids, Array3::from_shape_fn((16, 16, 1), lit).view()).unwrap();
        relight(&batch, weights.view()).unwrap()
    };
    let error = relative_l2((half(true) + half(false)).view(), floodlit(&batch).view());
    assert!(error < 1e-5, "{error}");
    let left_dots = transport.outer_iter().enumerate().filter(|(dot, _)| dot % 16 < 8);
    let truth = left_dots.fold(Array2::zeros((32, 32)), |sum, (_, image)| sum + image);
    assert!(snr_db(half(true).view(), counts(&truth).view()) > 20.0);
}
