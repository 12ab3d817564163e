//! The gain from coupling neighbours on a rendered scene, and checks on synthetic scenes that it does no harm.

#![allow(clippy::unwrap_used)] // helpers outside #[test] functions are tests too

#[allow(dead_code)]
mod common;

use common::{ELECTRONS_PER_COUNT, READ_NOISE_ELECTRONS, WHITE_COUNTS};
use common::{corner, ideal_stack, paper_sweep, photographed_in, timing};
use ndarray::{Array2, Array3, ArrayView2, ArrayView3, Axis, s};
use rand_distr::{Distribution, Normal};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;
use raysweep_transport::plane::{Coupling, Demux, NoiseModel, PlaneError, Prior, relative_rows};
use raysweep_transport::quality::{median_profile_error, relative_l2};

/// The noise of one frame of the test camera.
fn camera_noise() -> NoiseModel {
    let white_electrons = WHITE_COUNTS * ELECTRONS_PER_COUNT;
    NoiseModel {
        read_variance: (READ_NOISE_ELECTRONS / white_electrons).powi(2),
        gain: 1.0 / white_electrons,
    }
}

/// Errors of a transport: median over profiles, image at `u = 0`, indirect light at `u < 0` blurred over 3 rows.
#[derive(Debug)]
struct Errors {
    profile: f64,
    direct_image: f64,
    indirect: f64,
}

impl Errors {
    fn of(stack: ArrayView3<f32>) -> Self {
        let demux = Demux::new(timing(), paper_sweep(), Prior::SPLIT).unwrap();
        let truth = relative_rows(corner().view(), &demux.reach());
        let estimate = demux.solve(stack, None).unwrap();
        let blurred = |t: &Array3<f32>| {
            let below = t.slice(s![..94, .., ..]);
            &below.slice(s![..92, .., ..]) + &below.slice(s![1..93, .., ..]) + below.slice(s![2..94, .., ..])
        };
        Self {
            profile: median_profile_error(estimate.t.view(), truth.view()),
            direct_image: relative_l2(estimate.epipolar(1).view(), truth.slice(s![94, .., ..])),
            indirect: relative_l2(blurred(&estimate.t).view(), blurred(&truth).view()),
        }
    }

    fn all_below(&self, other: &Self, factor: f64) -> bool {
        self.profile <= factor * other.profile
            && self.direct_image <= factor * other.direct_image
            && self.indirect <= factor * other.indirect
    }
}

#[test]
fn one_coupled_frame_is_as_good_as_eight_uncoupled_ones() {
    let ideal = ideal_stack(&corner(), &paper_sweep());
    let [one, eight] = [1, 8].map(|frames| photographed_in(frames, &ideal, 1));
    let fitted = NoiseModel::fit(one.view(), None, &[1; 75]).unwrap();
    let coupled_one = Coupling::default().apply(one.view(), None, &fitted, &[1; 75]).unwrap();
    let coupled_eight = Coupling::default().apply(eight.view(), None, &camera_noise(), &[8; 75]).unwrap();

    // Measured: profile 0.0307, 0.0094, 0.0135, 0.0061; direct 0.0271, 0.0101, 0.0114, 0.0073.
    let [one, coupled_one] = [one.view(), coupled_one.stack.view()].map(Errors::of);
    let [eight, coupled_eight] = [eight.view(), coupled_eight.stack.view()].map(Errors::of);
    assert!(coupled_one.all_below(&eight, 1.0), "{coupled_one:?} against {eight:?}");
    assert!(coupled_one.all_below(&one, 0.5), "{coupled_one:?} against {one:?}");
    assert!(coupled_eight.all_below(&eight, 0.75), "{coupled_eight:?} against {eight:?}");
}

const SETTINGS: usize = 40;
const ROWS: usize = 24;
const COLUMNS: usize = 45;
const EDGE: usize = 20;

/// A stack of two surfaces that meet at column `EDGE`, each with its own profile that changes slowly over the image,
/// with a texture that changes from pixel to pixel. Pixel (12, 8) mirrors light that no other pixel sees.
fn two_surfaces() -> Array3<f32> {
    Array3::from_shape_fn((SETTINGS, ROWS, COLUMNS), |(n, t, s)| {
        let bump = |centre: f32, width: f32| (-((n as f32 - centre) / width).powi(2)).exp();
        let shape = match s < EDGE {
            true => bump(20.0 + 0.05 * s as f32, 5.0) + 0.2 * bump(8.0 + 0.1 * t as f32, 3.0),
            false => bump(24.0 - 0.03 * t as f32, 5.0) + 0.1 * bump(33.0, 6.0),
        };
        let albedo = 0.25 + 0.75 * ((31 * t + 17 * s * s) % 29) as f32 / 28.0;
        let mirrored = if (t, s) == (12, 8) { 0.5 * bump(34.0, 1.5) } else { 0.0 };
        albedo * shape + mirrored
    })
}

fn noisy(ideal: &Array3<f32>, noise: &NoiseModel, seed: u64) -> Array3<f32> {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
    let normal = Normal::new(0.0, 1.0).unwrap();
    ideal.mapv(|light| {
        let sd = noise.variance(f64::from(light), 1).sqrt();
        light + (sd * normal.sample(&mut random)) as f32
    })
}

fn couple(stack: &Array3<f32>, valid: Option<&Array3<bool>>, noise: &NoiseModel) -> Array3<f32> {
    let valid = valid.map(|valid| valid.view());
    Coupling::default().apply(stack.view(), valid, noise, &[1; SETTINGS]).unwrap().stack
}

/// Root mean square over the settings, `[t, s]`.
fn rms(difference: Array3<f32>) -> Array2<f32> {
    (difference.pow2().sum_axis(Axis(0)) / SETTINGS as f32).sqrt()
}

/// The test camera's noise with `share` of its variance.
fn quieter(share: f64) -> NoiseModel {
    let NoiseModel { read_variance, gain } = camera_noise();
    NoiseModel { read_variance: share * read_variance, gain: share * gain }
}

#[test]
fn surfaces_do_not_mix_and_mirrors_keep_their_light() {
    let ideal = two_surfaces();
    for share in [1e-4, 1e-2, 0.1, 1.0, 4.0] {
        let noise = quieter(share);
        let stack = noisy(&ideal, &noise, 3);
        let before = rms(&stack - &ideal);
        let after = rms(couple(&stack, None, &noise) - &ideal);
        let mean = |errors: ArrayView2<f32>| errors.mean().unwrap();
        let all = mean(after.view()) / mean(before.view());
        let edge = s![.., EDGE - 2..EDGE + 2];
        let edge = mean(after.slice(edge)) / mean(before.slice(edge));
        let mirror = after[[12, 8]] / before[[12, 8]];
        // Measured for the camera's own noise: 0.35, 0.40, 1.00.
        assert!(edge <= 0.85, "noise {share}: {edge} at the edge");
        assert!(mirror <= 1.05, "noise {share}: {mirror} at the mirror");
        let expected = if share >= 1.0 { 0.4 } else { 0.8 };
        assert!(all <= expected, "noise {share}: {all}");
    }
}

#[test]
fn without_noise_nothing_changes() {
    // All profiles of the left surface differ, though only slightly.
    let ideal = two_surfaces().slice(s![.., .., ..EDGE]).to_owned();
    let change = |share| {
        let coupled = couple(&ideal, None, &quieter(share));
        relative_l2(coupled.view(), ideal.view())
    };
    // Faster than the noise itself, which falls with the square root.
    let changes = [1.0, 1e-1, 1e-2, 1e-4].map(change);
    assert!(changes.is_sorted_by(|a, b| *a > 3.0 * b), "{changes:?}");
    assert!(changes[3] < 1e-6, "{changes:?}");
    assert!(change(0.0) < 1e-6);
}

#[test]
fn a_uniform_surface_loses_all_the_noise_that_it_can() {
    let ideal = Array3::from_shape_fn((SETTINGS, ROWS, COLUMNS), |(n, ..)| 0.2 + 0.02 * n as f32);
    let noise = camera_noise();
    let stack = noisy(&ideal, &noise, 5);
    let coupled = Coupling::default().apply(stack.view(), None, &noise, &[1; SETTINGS]).unwrap();
    let inner = s![3..ROWS - 3, 3..COLUMNS - 3];
    let variance_ratio = coupled.variance_ratio.slice(inner).mean().unwrap();
    // The remaining variance, besides the noise of the total, 1/40 of the variance, is the predicted one.
    let variance = |stack: &Array3<f32>| (stack - &ideal).pow2().sum_axis(Axis(0)).slice(inner).sum();
    let left = variance(&coupled.stack) / variance(&stack);
    assert!(variance_ratio < 1.5 / 49.0, "{variance_ratio}");
    assert!((left - 1.0 / 40.0 - variance_ratio).abs() < 0.015, "{left}, {variance_ratio}");
}

#[test]
fn masked_samples_neither_give_nor_take() {
    let noise = camera_noise();
    let stack = noisy(&two_surfaces(), &noise, 6);
    // A highlight whose long exposures are saturated, single dead samples, and a pixel without any samples.
    let valid = Array3::from_shape_fn(stack.dim(), |(n, t, s)| {
        let highlight = (10..16).contains(&t) && (15..30).contains(&s) && n >= 24 + s % 3;
        !(highlight || (n + 7 * t + 13 * s) % 61 == 0 || (t, s) == (4, 4))
    });
    let coupled = couple(&stack, Some(&valid), &noise);
    let mut other = stack.clone();
    other.zip_mut_with(&valid, |sample, &valid| *sample = if valid { *sample } else { 1000.0 });
    let coupled_other = couple(&other, Some(&valid), &noise);
    for (index, &valid) in valid.indexed_iter() {
        let expected = if valid { coupled[index] } else { other[index] };
        assert_eq!(coupled_other[index].to_bits(), expected.to_bits(), "{index:?}");
    }

    // Highlights are coupled with each other, over the settings that they have.
    let error = |stack: &Array3<f32>| {
        let mut difference = stack - &two_surfaces();
        difference.zip_mut_with(&valid, |difference, &valid| *difference *= f32::from(valid));
        rms(difference).slice(s![11..15, 22..28]).mean().unwrap()
    };
    assert!(error(&coupled) < 0.6 * error(&stack), "{} {}", error(&coupled), error(&stack));

    let nothing = Array3::from_elem(stack.dim(), false);
    assert_eq!(couple(&stack, Some(&nothing), &noise), stack);
}

#[test]
fn dark_pixels_keep_their_samples() {
    let noise = camera_noise();
    let mut ideal = two_surfaces();
    ideal.slice_mut(s![.., .., ..6]).fill(0.0);
    let stack = noisy(&ideal, &noise, 7);
    let coupled = Coupling::default().apply(stack.view(), None, &noise, &[1; SETTINGS]).unwrap();
    let unchanged = stack.axis_iter(Axis(2)).zip(coupled.stack.axis_iter(Axis(2))).map(|(a, b)| a == b);
    // One dark pixel in a thousand is mistaken for a lit one.
    assert!(relative_l2(coupled.stack.slice(s![.., .., ..6]), stack.slice(s![.., .., ..6])) < 0.1);
    assert_eq!(unchanged.skip(6).filter(|&unchanged| unchanged).count(), 0);
    assert_eq!(couple(&Array3::zeros(stack.dim()), None, &noise), Array3::zeros(stack.dim()));
}

#[test]
fn tiles_with_a_halo_and_any_number_of_threads_give_the_same_bits() {
    let noise = camera_noise();
    let stack = noisy(&two_surfaces(), &noise, 8);
    let whole = Coupling::default().apply(stack.view(), None, &noise, &[1; SETTINGS]).unwrap();
    for threads in [1, 3] {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        assert!(pool.install(|| couple(&stack, None, &noise)) == whole.stack);
    }
    let tile = stack.slice(s![.., 5..18, 9..30]).to_owned();
    let inner = s![.., 3..10, 3..18];
    assert!(couple(&tile, None, &noise).slice(inner) == whole.stack.slice(s![.., 8..15, 12..27]));
    // The memory order of the axes does not matter.
    let mut transposed = Array3::zeros((COLUMNS, ROWS, SETTINGS)).reversed_axes();
    transposed.assign(&stack);
    assert!(couple(&transposed, None, &noise) == whole.stack);
    let alone = Coupling { radius_px: 0 }.apply(stack.view(), None, &noise, &[1; SETTINGS]).unwrap();
    assert!(alone.stack == stack);
    assert!(alone.variance_ratio.iter().all(|&ratio| ratio == 1.0));
    let wide = Coupling { radius_px: 60 }.apply(stack.slice(s![.., ..3, ..4]), None, &noise, &[1; SETTINGS]);
    assert!(wide.unwrap().stack.iter().all(|sample| sample.is_finite()));
}

#[test]
fn misfits_are_refused() {
    let stack = Array3::<f32>::zeros((3, 2, 2));
    let apply = |stack: &Array3<f32>, valid: (usize, usize, usize), noise, frames: &[usize]| {
        let valid = Array3::from_elem(valid, true);
        Coupling::default().apply(stack.view(), Some(valid.view()), &noise, frames).err()
    };
    let right = stack.dim();
    assert_eq!(apply(&stack, right, camera_noise(), &[1; 3]), None);
    let shape = |error| matches!(error, Some(PlaneError::Shape { .. }));
    assert!(shape(apply(&stack, (3, 2, 1), camera_noise(), &[1; 3])));
    assert!(shape(apply(&stack, right, camera_noise(), &[1; 2])));
    let range = |error, name| matches!(error, Some(PlaneError::OutOfRange { field, .. }) if field == name);
    assert!(range(apply(&stack, right, camera_noise(), &[1, 0, 1]), "frames"));
    assert!(range(apply(&stack, right, quieter(-1.0), &[1; 3]), "read_variance"));
    assert!(range(apply(&stack, right, NoiseModel { gain: f64::NAN, ..camera_noise() }, &[1; 3]), "gain"));
    let mut broken = stack.clone();
    broken[[2, 1, 0]] = f32::NAN;
    let error = PlaneError::NotFinite { setting: 2, row: 1, column: 0 };
    assert_eq!(apply(&broken, right, camera_noise(), &[1; 3]), Some(error));
    let empty = Array3::<f32>::zeros((3, 0, 2));
    assert_eq!(apply(&empty, (3, 0, 2), camera_noise(), &[1; 3]), None);
}

#[test]
fn the_noise_is_found_in_the_stack() {
    let ideal = ideal_stack(&corner(), &paper_sweep());
    let stack = photographed_in(1, &ideal, 4);
    let fit = |stack: &Array3<f32>, frames: &[usize]| NoiseModel::fit(stack.view(), None, frames).unwrap();
    let near = |fit: NoiseModel, truth: NoiseModel, tolerance: f64| {
        let close = |a: f64, b: f64| (a / b - 1.0).abs() < tolerance;
        close(fit.read_variance, truth.read_variance) && close(fit.gain, truth.gain)
    };
    assert!(near(fit(&stack, &[1; 75]), camera_noise(), 0.06));
    // With few settings, each sample is a large part of the total by which it is scaled.
    let few = ideal_stack(&corner(), &paper_sweep()).slice(s![3..12, .., ..]).to_owned();
    assert!(near(fit(&photographed_in(1, &few, 4), &[1; 9]), camera_noise(), 0.08));
    // Different numbers of averaged frames.
    let frames: Vec<usize> = (0..SETTINGS).map(|n| 1 + n % 4).collect();
    let ideal = two_surfaces();
    let mut averaged = ideal.clone();
    for (n, &frames) in frames.iter().enumerate() {
        let noise = quieter(1.0 / frames as f64);
        averaged.index_axis_mut(Axis(0), n).assign(&noisy(&ideal, &noise, 9).index_axis(Axis(0), n));
    }
    assert!(near(fit(&averaged, &frames), camera_noise(), 0.1));
    // Far below the camera's noise: no texture is mistaken for shot noise.
    let constant = NoiseModel { read_variance: 1e-4, gain: 0.0 };
    let found = fit(&noisy(&ideal, &constant, 10), &[1; SETTINGS]);
    assert!((found.read_variance / 1e-4 - 1.0).abs() < 0.05 && found.gain < 4e-5, "{found:?}");

    let masked = Array3::from_elem(stack.dim(), false);
    let error = NoiseModel::fit(stack.view(), Some(masked.view()), &[1; 75]).unwrap_err();
    assert!(matches!(error, PlaneError::TooFewSamples { samples: 0, .. }));
    let black = NoiseModel::fit(Array3::zeros((75, 20, 20)).view(), None, &[1; 75]);
    assert!(matches!(black, Err(PlaneError::TooFewSamples { .. })));
}
