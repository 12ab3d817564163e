//! Denoising compared with its simple reference implementation, and its invariants.

#![allow(clippy::unwrap_used)] // helpers outside #[test] functions are tests too

use ndarray::Array3;
use proptest::prelude::*;
use rand_distr::{Distribution, Normal};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use raysweep_transport::dots::{
    Background, BatchCounts, Correction, DenoiseSettings, Denoiser, FrameShape, NoiseFloor, Region, Sampling,
    SparseColumn, StopRule, reference,
};
use raysweep_transport::plane::SimdLevel;

const SIGMA: f64 = 3.0;

/// A frame with a noisy background of 100.3 and round spots of light, (row, column, radius, counts).
fn frame(shape: FrameShape, seed: u64, spots: &[(f64, f64, f64, f64)]) -> Vec<u16> {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
    let noise = Normal::new(0.0, SIGMA).unwrap();
    let width = shape.width();
    let value = |at: usize| {
        let (pixel, channel) = (at / shape.channels(), at % shape.channels());
        let light = spots.iter().map(|&(row, column, radius, counts)| {
            let distance = ((pixel / width) as f64 - row).hypot((pixel % width) as f64 - column) / radius;
            (1.0 - distance.powi(4)).max(0.0) * counts * (1.0 - 0.2 * channel as f64)
        });
        (100.3 + light.sum::<f64>() + noise.sample(&mut random)).round().clamp(0.0, 4095.0) as u16
    };
    (0..shape.values()).map(value).collect()
}

fn rough_gain(shape: FrameShape, seed: u64) -> Array3<f32> {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
    let noise = Normal::new(1.0, 0.02).unwrap();
    Array3::from_shape_fn((shape.height(), shape.width(), shape.channels()), |_| {
        noise.sample(&mut random) as f32
    })
}

fn measured(frame: &[u16], correction: &Correction, background: &Background) -> NoiseFloor {
    NoiseFloor::measured([frame], correction, background, &Region::whole(correction.shape())).unwrap()
}

/// Compares every instruction level with the reference: all results are equal, the residual to within rounding.
fn assert_equals_reference(
    frame: &[u16],
    correction: &Correction,
    background: &Background,
    floor: NoiseFloor,
    settings: &DenoiseSettings,
) -> SparseColumn {
    let expected = reference::column(frame, correction, background, floor, settings).unwrap();
    for level in SimdLevel::available() {
        let denoiser = Denoiser::new(correction.clone(), settings.clone()).unwrap().at_level(level);
        let (mut scratch, mut column) = (denoiser.scratch(), SparseColumn::default());
        // The second time with reused memory.
        for _ in 0..2 {
            denoiser.column(frame, background, floor, &mut scratch, &mut column).unwrap();
            assert_eq!(column.outcome, expected.outcome, "{level:?}");
            assert_eq!(column.words, expected.words, "{level:?}");
            assert_eq!(column.masks, expected.masks, "{level:?}");
            assert_eq!(column.values, expected.values, "{level:?}");
            assert_eq!(column.residual.len(), expected.residual.len());
            for (residual, expected) in column.residual.iter().zip(&expected.residual) {
                assert!(
                    (residual - expected).abs() <= 1e-5 * (1.0 + expected.abs()),
                    "{residual} {expected}"
                );
            }
        }
    }
    expected
}

proptest! {
    #![proptest_config(ProptestConfig { failure_persistence: None, ..ProptestConfig::with_cases(48) })]

    #[test]
    fn every_level_equals_the_reference(
        seed in 0_u64..1000,
        height in 1_usize..100,
        width_words in 1_usize..5,
        channels in prop::sample::select(vec![1_usize, 3]),
        radius_px in 0.5_f64..30.0,
        max_discs in 1_u32..12,
        bright in 0.0_f64..6000.0,
        hot_count in 0_usize..30,
        printed in any::<bool>(),
        ties in any::<bool>(),
        wide in any::<bool>(),
    ) {
        let shape = FrameShape::new(height, 32 * width_words, channels).unwrap();
        let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
        let mut place = |size: usize| (random.next_u64() % size as u64) as usize;
        let spots: Vec<_> = (0..3)
            .map(|_| (place(height) as f64, place(shape.width()) as f64, 1.0 + place(12) as f64, bright / (1 + place(20)) as f64))
            .collect();
        let hot: Vec<_> = (0..hot_count).map(|_| (place(height), place(shape.width()))).collect();
        let mut frame = frame(shape, seed, &spots);
        for &(row, column) in &hot {
            frame[(row * shape.width() + column) * channels] = 4095;
        }
        if ties {
            frame.iter_mut().for_each(|raw| *raw = *raw / 64 * 64);
        }
        if wide {
            frame[place(shape.values())] = 65535;
        }
        let correction = Correction::new(shape, rough_gain(shape, seed).view(), &hot, Sampling::Full).unwrap();
        let mean: Vec<f32> = (0..shape.values()).map(|at| 99.7 + (at % 7) as f32 * 0.2).collect();
        let background = Background::new(&correction, &mean).unwrap();
        let patch = Region { rows: 0..height, columns: 0..32 };
        let stop = match printed {
            true if height > 1 => StopRule::Printed { patch, tolerance: 0.3 },
            _ => StopRule::FalseAlarms { per_frame: 0.05 },
        };
        let floor = NoiseFloor { mean: 0.0, sigma: SIGMA };
        let settings = DenoiseSettings { radius_px, stop, max_discs };
        assert_equals_reference(&frame, &correction, &background, floor, &settings);
    }
}

#[test]
fn ties_go_to_the_first_pixel_in_reading_order() {
    let shape = FrameShape::new(64, 64, 1).unwrap();
    let correction = Correction::none(shape);
    let background = Background::new(&correction, &[100.0; 64 * 64]).unwrap();
    let mut frame = vec![100; 64 * 64];
    for (row, column) in [(40, 3), (20, 50), (20, 40)] {
        frame[row * 64 + column] = 900;
    }
    let settings = DenoiseSettings { radius_px: 1.0, max_discs: 1, ..DenoiseSettings::default() };
    let floor = NoiseFloor { mean: 0.0, sigma: SIGMA };
    let column = assert_equals_reference(&frame, &correction, &background, floor, &settings);
    assert_eq!(column.pixels().collect::<Vec<_>>(), [20 * 64 + 40]);
    assert_eq!((column.values, column.outcome.capped), (vec![800.0], true));
}

#[test]
fn caps_and_empty_frames_are_counted() {
    let shape = FrameShape::new(96, 96, 1).unwrap();
    let correction = Correction::none(shape);
    let background = Background::new(&correction, &[100.3; 96 * 96]).unwrap();
    let one = frame(shape, 1, &[(40.0, 40.0, 8.0, 900.0)]);
    let many = frame(shape, 2, &[(40.0, 20.0, 30.0, 900.0), (60.0, 60.0, 30.0, 900.0)]);
    let none = frame(shape, 3, &[]);
    let settings = DenoiseSettings { radius_px: 10.0, max_discs: 3, ..DenoiseSettings::default() };
    let denoiser = Denoiser::new(correction, settings).unwrap();
    let floor = NoiseFloor { mean: 0.0, sigma: SIGMA };
    let batch = denoiser.batch(&[&one, &many, &none, &many, &none, &none], &background, floor).unwrap();
    assert_eq!(batch.counts(), BatchCounts { dots: 6, empty: 3, capped: 2 });
    assert_eq!(batch.arrays().capped, [false, true, false, true, false, false]);
}

/// Frames of a batch with a dot, secondary light and a glow.
fn scan(shape: FrameShape, count: usize) -> Vec<Vec<u16>> {
    let dot = |index: usize| {
        let (row, column) = (70.0 + 4.0 * (index / 8) as f64, 30.0 + 16.0 * (index % 8) as f64);
        let spots = [(row, column, 9.0, 1200.0), (220.0 - row, column, 6.0, 60.0), (row, column, 45.0, 3.0)];
        frame(shape, 10 + index as u64, &spots)
    };
    (0..count).map(dot).collect()
}

#[test]
fn the_result_does_not_depend_on_where_the_background_patch_lies() {
    let shape = FrameShape::new(192, 192, 1).unwrap();
    let correction = Correction::none(shape);
    let background = Background::new(&correction, &vec![100.3; shape.pixels()]).unwrap();
    let frames = scan(shape, 40);
    let frames: Vec<&[u16]> = frames.iter().map(Vec::as_slice).collect();
    let settings = DenoiseSettings { radius_px: 12.0, ..DenoiseSettings::default() };
    let denoiser = Denoiser::new(correction.clone(), settings).unwrap();
    // The third patch is lit by some of the dots.
    let patches = [(0..20, 0..192), (172..192, 0..192), (60..110, 0..24)];
    let batches = patches.map(|(rows, columns)| {
        let region = Region { rows, columns };
        let floor = NoiseFloor::measured(frames.iter().copied(), &correction, &background, &region).unwrap();
        denoiser.batch(&frames, &background, floor).unwrap()
    });
    assert!(batches[0].counts() == BatchCounts { dots: 40, empty: 0, capped: 0 });
    assert_eq!(batches[0], batches[1]);
    // Light in the third patch raises its noise by a few percent: the dimmest rims may differ, but not the dots.
    let discs = |at: usize| batches[at].arrays().discs.iter().sum::<u32>();
    assert!(discs(2).abs_diff(discs(0)) <= discs(0) / 10, "{} {}", discs(2), discs(0));
}

#[test]
fn columns_and_residuals_hold_all_light() {
    let shape = FrameShape::new(192, 192, 1).unwrap();
    let correction =
        Correction::new(shape, rough_gain(shape, 5).view(), &[(60, 60), (100, 3)], Sampling::Full).unwrap();
    let background = Background::new(&correction, &vec![100.3; shape.pixels()]).unwrap();
    let settings = DenoiseSettings { radius_px: 12.0, ..DenoiseSettings::default() };
    let denoiser = Denoiser::new(correction, settings).unwrap();
    let frames = scan(shape, 64);
    let slices: Vec<&[u16]> = frames.iter().map(Vec::as_slice).collect();
    let floor = NoiseFloor { mean: 0.0, sigma: SIGMA };
    let batch = denoiser.batch(&slices, &background, floor).unwrap();

    let gain = rough_gain(shape, 5);
    let hot = [60 * 192 + 60, 100 * 192 + 3];
    let (mut expected, mut sparse, mut kept) = (0.0, 0.0, 0.0);
    for (index, frame) in frames.iter().enumerate() {
        let sound = frame.iter().zip(&gain).enumerate().filter(|(pixel, _)| !hot.contains(pixel));
        expected += sound.map(|(_, (&raw, &gain))| (f64::from(raw) - 100.3) * f64::from(gain)).sum::<f64>();
        let column = batch.column(index);
        let side = shape.block_px();
        assert_eq!((side, shape.block_columns()), (16, 12));
        let mut outside = vec![(side * side) as f64; shape.blocks()];
        for (pixel, value) in column.pixels() {
            sparse += f64::from(value[0]);
            outside[pixel / 192 / side * 12 + pixel % 192 / side] -= 1.0;
        }
        kept +=
            column.residual().iter().zip(&outside).map(|(&mean, count)| f64::from(mean) * count).sum::<f64>();
    }
    // Hot pixels get their neighbours' light, so their own light is not missing.
    assert!(((sparse + kept) / expected - 1.0).abs() < 0.005, "{} of {expected}", sparse + kept);
    assert!(sparse / expected < 0.98, "the glow is beyond the discs: {}", sparse / expected);
}

#[test]
fn noise_alone_gives_no_more_discs_than_stated() {
    let shape = FrameShape::new(128, 128, 1).unwrap();
    let correction = Correction::none(shape);
    let background = Background::new(&correction, &vec![100.3; shape.pixels()]).unwrap();
    let frames: Vec<_> = (0..400).map(|seed| frame(shape, seed, &[])).collect();
    let slices: Vec<&[u16]> = frames.iter().map(Vec::as_slice).collect();
    let alarms = |per_frame| {
        let stop = StopRule::FalseAlarms { per_frame };
        let settings = DenoiseSettings { stop, ..DenoiseSettings::default() };
        let floor = measured(slices[0], &correction, &background);
        let batch =
            Denoiser::new(correction.clone(), settings).unwrap().batch(&slices, &background, floor).unwrap();
        batch.dots() - batch.counts().empty
    };
    // Four standard deviations of a binomial above 400 x 0.05 and 400 x 0.5. At least half of the second is required,
    // so that a rule that never fires fails.
    let (rare, frequent) = (alarms(0.05), alarms(0.5));
    assert!(rare <= 20 + 18, "{rare}");
    assert!((75..=240).contains(&frequent), "{frequent}");
}

#[test]
fn a_hot_pixel_is_never_the_maximum() {
    let shape = FrameShape::new(64, 64, 1).unwrap();
    let hot = [(5, 5), (30, 31), (63, 63)];
    let correction = Correction::new(shape, Array3::ones((64, 64, 1)).view(), &hot, Sampling::Full).unwrap();
    let background = Background::new(&correction, &vec![100.3; shape.pixels()]).unwrap();
    let floor = NoiseFloor { mean: 0.0, sigma: SIGMA };
    for level in [4095, 65535] {
        let mut dark = frame(shape, 1, &[]);
        let mut lit = frame(shape, 1, &[(31.0, 30.0, 6.0, 300.0)]);
        for (row, column) in hot {
            dark[row * 64 + column] = level;
            lit[row * 64 + column] = level;
        }
        let settings = DenoiseSettings { radius_px: 8.0, ..DenoiseSettings::default() };
        let column = assert_equals_reference(&dark, &correction, &background, floor, &settings);
        assert_eq!(column.outcome.discs, 0);
        // Inside a disc it gets its neighbours' light.
        let column = assert_equals_reference(&lit, &correction, &background, floor, &settings);
        let repaired = column.pixels().position(|pixel| pixel == 30 * 64 + 31).unwrap();
        assert!((250.0..350.0).contains(&column.values[repaired]), "{}", column.values[repaired]);
    }
}

#[test]
fn columns_are_the_same_for_any_number_of_threads() {
    let shape = FrameShape::new(192, 192, 1).unwrap();
    let correction = Correction::none(shape);
    let background = Background::new(&correction, &vec![100.3; shape.pixels()]).unwrap();
    let frames = scan(shape, 70);
    let slices: Vec<&[u16]> = frames.iter().map(Vec::as_slice).collect();
    let denoiser = Denoiser::new(correction, DenoiseSettings::default()).unwrap();
    let floor = NoiseFloor { mean: 0.0, sigma: SIGMA };
    let with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| denoiser.batch(&slices, &background, floor).unwrap())
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn memory_is_taken_once() {
    let shape = FrameShape::new(192, 192, 1).unwrap();
    let correction = Correction::none(shape);
    let background = Background::new(&correction, &vec![100.3; shape.pixels()]).unwrap();
    let denoiser = Denoiser::new(correction, DenoiseSettings::default()).unwrap();
    let floor = NoiseFloor { mean: 0.0, sigma: SIGMA };
    let (mut scratch, mut column) = (denoiser.scratch(), SparseColumn::default());
    let frames = scan(shape, 20);
    let mut places = || {
        let mut all = Vec::new();
        for frame in &frames {
            denoiser.column(frame, &background, floor, &mut scratch, &mut column).unwrap();
            let SparseColumn { words, masks, values, residual, .. } = &column;
            all.push((words.as_ptr(), masks.as_ptr(), values.as_ptr(), residual.as_ptr()));
        }
        all
    };
    let after_the_largest = *places().last().unwrap();
    assert!(places().iter().all(|place| *place == after_the_largest));
}

#[test]
fn frames_of_another_size_are_refused() {
    let shape = FrameShape::new(64, 64, 1).unwrap();
    let correction = Correction::none(shape);
    let background = Background::new(&correction, &vec![0.0; 64 * 64]).unwrap();
    let denoiser = Denoiser::new(correction, DenoiseSettings::default()).unwrap();
    let floor = NoiseFloor { mean: 0.0, sigma: SIGMA };
    let refused = denoiser.batch(&[&[0; 64 * 63]], &background, floor).unwrap_err();
    assert!(refused.to_string().contains("[4032]"), "{refused}");
    assert!(FrameShape::new(64, 60, 1).is_err() && FrameShape::new(64, 64, 2).is_err());
}
