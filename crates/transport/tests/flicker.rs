//! A lamp that flickers in images whose light is integrated numerically, frame by frame.

#![allow(clippy::unwrap_used)] // helpers outside #[test] functions are tests too

mod common;

use std::f64::consts::TAU;

use common::{ideal_stack, paper_sweep, photographed, photographed_in, timing};
use ndarray::{Array3, s};
use rand_distr::{Distribution, Normal, Uniform};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;
use raysweep_transport::plane::Setting;
use raysweep_transport::plane::calibrate::{
    CycleFlicker, DarkFlicker, DarkRows, FrameExposures, LampFlicker, Sample, TimedImage, Unexplained,
    averaged_share, can_be_followed, cancelling_frames,
};

const ROW_TIME_S: f64 = 22.22e-6;
const FRAMES: usize = 8;
const EXPOSURES_US: [f64; 5] = [600.0, 750.0, 900.0, 1050.0, 1200.0];
/// Light of the room, of white per us: 0.01 in a row's time.
const LEVEL_US: f64 = 0.01 / 22.22;

/// A light whose frequency wanders about its mean.
fn light(frequency_hz: f64, time_s: f64) -> f64 {
    let wander = 0.3 * (TAU * time_s / 15.0).sin();
    1.0 + 0.9 * (TAU * frequency_hz * time_s + 0.7 + wander).cos()
}

/// Mean over the frames of what row `t` collects of a light of 1 per us.
fn collected(frames: &FrameExposures, t: usize, light: impl Fn(f64) -> f64) -> f64 {
    const STEPS: usize = 40;
    let step_s = frames.exposure_us * 1e-6 / STEPS as f64;
    let of_frame = |&opened_s: &f64| {
        let at = |step: usize| opened_s + t as f64 * ROW_TIME_S + (step as f64 + 0.5) * step_s;
        (0..STEPS).map(|step| light(at(step)) * step_s * 1e6).sum::<f64>()
    };
    frames.opened_s.iter().map(of_frame).sum::<f64>() / frames.opened_s.len() as f64
}

/// Exposures at 60 frames/s, one image after the other, with four to six frames between them: with four
/// alone, all images would see 100 Hz in the same phase.
fn taken(exposures_us: impl Iterator<Item = f64>, from_s: f64) -> Vec<FrameExposures> {
    let frame =
        |image: usize, frame: usize| from_s + ((FRAMES + 4) * image + image % 3 + frame) as f64 / 60.0;
    let image = |(image, exposure_us)| FrameExposures {
        exposure_us,
        opened_s: (0..FRAMES).map(|n| frame(image, n)).collect(),
    };
    exposures_us.enumerate().map(image).collect()
}

fn darks(frames: &[FrameExposures], rows: &[usize], light: &dyn Fn(f64) -> f64) -> Vec<DarkRows> {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(1);
    let noise = Normal::new(0.0, 0.3).unwrap();
    let image = |frames: &FrameExposures| DarkRows {
        frames: frames.clone(),
        means_dn: rows
            .iter()
            .map(|&t| {
                let (offset, level) = (64.0 + (t % 7) as f64, 1.0 + 0.2 * (t as f64 / 9.0).sin());
                offset + level * collected(frames, t, light) + noise.sample(&mut random)
            })
            .collect(),
    };
    frames.iter().map(image).collect()
}

#[test]
fn dark_images_show_frequency_and_share() {
    let rows: Vec<usize> = (0..128).step_by(2).collect();
    let frames = taken(EXPOSURES_US.into_iter(), 1000.0);
    for frequency_hz in [99.3, 100.0, 143.0] {
        let darks = darks(&frames, &rows, &|time_s| 1.0 + 0.5 * (TAU * frequency_hz * time_s).cos());
        let found = DarkFlicker::find(&darks, &rows, ROW_TIME_S).unwrap();
        assert!((found.frequency_hz - frequency_hz).abs() < 0.1, "{found:?} of {frequency_hz}");
        assert!((found.share - 0.5).abs() < 0.03, "{found:?}");
        assert_eq!(DarkFlicker::find(&darks[..2], &rows, ROW_TIME_S), None);
    }
    let steady = darks(&frames, &rows, &|_| 1.0);
    assert_eq!(DarkFlicker::find(&steady, &rows, ROW_TIME_S), None);
}

/// The images of the corner with flicker, those without, and the lamp that is found in them.
fn followed(
    light_of: &dyn Fn(usize, f64) -> f64,
) -> (Array3<f32>, Array3<f32>, LampFlicker, Vec<TimedImage>) {
    let settings = paper_sweep();
    let scene = common::corner().slice_move(s![.., .., ..;4]);
    let without = photographed(&ideal_stack(&scene, &settings), 3);
    let dark = taken(EXPOSURES_US.into_iter(), 0.0);
    let light = taken(settings.iter().map(|setting| setting.exposure_us), 1.0);
    let images: Vec<TimedImage> = light
        .into_iter()
        .enumerate()
        .map(|(image, light)| TimedImage { light, dark: dark[image / 15].clone() })
        .collect();
    let level = |t: usize, s: usize| LEVEL_US * (1.0 + 0.5 * ((t / 8 + s / 4) % 2) as f64);
    let mut with = without.clone();
    for (image, timed) in images.iter().enumerate() {
        for t in 0..128 {
            let more = collected(&timed.light, t, |time_s| light_of(image + 1, time_s))
                - collected(&timed.dark, t, |time_s| light_of(0, time_s));
            with.slice_mut(s![image, t, ..]).indexed_iter_mut().for_each(|(s, value)| {
                *value += (level(t, s) * more) as f32;
            });
        }
    }
    let sample = Sample::new(timing(), settings, with.view(), None).unwrap();
    let levels: Vec<f64> = sample.pixels().map(|(t, s)| level(t, s)).collect();
    let unexplained = Unexplained::of_sweep(&sample, 0.0, images.clone(), &levels).unwrap();
    let lamp = LampFlicker::follow(&[unexplained], (99.95, ROW_TIME_S)).unwrap();
    let mut corrected = with.clone();
    for (image, timed) in images.iter().enumerate() {
        for t in 0..128 {
            let excess_us = lamp.excess_us(&timed.light, t) - lamp.excess_us(&timed.dark, t);
            corrected.slice_mut(s![image, t, ..]).indexed_iter_mut().for_each(|(s, value)| {
                *value -= (level(t, s) * excess_us) as f32;
            });
        }
    }
    (&with - &without, &corrected - &without, lamp, images)
}

fn rms(images: &Array3<f32>) -> f64 {
    (images.iter().map(|value| f64::from(*value).powi(2)).sum::<f64>() / images.len() as f64).sqrt()
}

#[test]
fn a_lamp_is_followed_through_a_sweep() {
    let (before, after, lamp, images) = followed(&|_, time_s| light(100.0, time_s));
    let (before, after) = (rms(&before), rms(&after));
    println!("{before} before, {after} after: {} Hz, {}", lamp.frequency_hz, lamp.share());
    assert!(after < 0.1 * before, "{before} before, {after} after");
    assert!((lamp.frequency_hz - 100.0).abs() < 0.02, "{}", lamp.frequency_hz);
    assert!((lamp.share() - 0.9).abs() < 0.05 && lamp.is_seen(), "{lamp:?}");
    // What it says of a single exposure is what the light does.
    let single = FrameExposures { exposure_us: 600.0, opened_s: vec![images[20].light.opened_s[0]] };
    let true_us = collected(&single, 64, |time_s| light(100.0, time_s)) - 600.0;
    assert!((lamp.excess_us(&single, 64) - true_us).abs() < 60.0, "{true_us}");
}

#[test]
fn what_has_another_phase_in_each_image_is_no_lamp() {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(5);
    let turn = Uniform::new(0.0, 1.0).unwrap();
    let turns: Vec<f64> = (0..76).map(|_| turn.sample(&mut random)).collect();
    let drawn = |image: usize, time_s: f64| 1.0 + (TAU * (100.0 * time_s + turns[image])).cos();
    let (_, _, lamp, _) = followed(&drawn);
    assert!(!lamp.is_seen(), "{lamp:?}");
}

/// The default film's delays.
const DELAYS_US: [f64; 15] = [
    -1500.0, -1000.0, -640.0, -420.0, -333.0, -311.0, -289.0, 0.0, 289.0, 311.0, 333.0, 420.0, 640.0, 1000.0,
    1500.0,
];

/// Four cycles of a film of the corner in a room with this light, at 60 frames/s. Their delays jitter by 5 us and are
/// measured, or not.
fn cycles(light: &dyn Fn(f64) -> f64, is_measured: bool) -> Vec<Unexplained> {
    let scene = common::corner().slice_move(s![.., .., ..;4]);
    let mut random = Xoshiro256PlusPlus::seed_from_u64(7);
    let jitter = Normal::new(0.0, 5.0).unwrap();
    let cycle = |number: usize| {
        let settings =
            DELAYS_US.map(|delay_us| Setting::new(delay_us + jitter.sample(&mut random), 600.0)).to_vec();
        let opened_s = |k: usize| (15 * number + 14 - k) as f64 / 60.0 + DELAYS_US[k] * 1e-6;
        let frame = |k: usize| FrameExposures { exposure_us: 600.0, opened_s: vec![2.0 + opened_s(k)] };
        let frames: Vec<FrameExposures> = (0..15).map(frame).collect();
        let mut images = photographed_in(1, &ideal_stack(&scene, &settings), number as u64);
        for (k, frame) in frames.iter().enumerate() {
            for t in 0..128 {
                let more = LEVEL_US * (collected(frame, t, light) - frame.exposure_us);
                images.slice_mut(s![k, t, ..]).mapv_inplace(|value| value + more as f32);
            }
        }
        let planned = || DELAYS_US.map(|delay_us| Setting::new(delay_us, 600.0)).to_vec();
        let stated = if is_measured { settings } else { planned() };
        let sample = Sample::new(timing(), stated, images.view(), None).unwrap();
        let levels = vec![LEVEL_US; sample.pixels().count()];
        Unexplained::of_cycle(&sample, 0.0, &frames, &levels).unwrap()
    };
    (0..4).map(cycle).collect()
}

#[test]
fn cycles_show_a_lamp_even_if_all_of_them_see_it_in_the_same_phase() {
    // A cycle takes a quarter of a second: 25 periods of 100 Hz.
    for frequency_hz in [100.0, 99.0, 143.0] {
        let cycles = cycles(&|time_s| 1.0 + 0.9 * (TAU * frequency_hz * time_s + 0.7).cos(), true);
        let found = CycleFlicker::find(&cycles, ROW_TIME_S, None).unwrap();
        assert!((found.frequency_hz - frequency_hz).abs() < 0.02, "{found:?} of {frequency_hz}");
        assert!((found.share - 0.9).abs() < 0.02, "{found:?}");
        let expected = CycleFlicker::find(&cycles, ROW_TIME_S, Some(frequency_hz + 0.1)).unwrap();
        assert!((expected.frequency_hz - found.frequency_hz).abs() < 0.01, "{expected:?} and {found:?}");
        for cycle in &cycles {
            let lamp = LampFlicker::follow(std::slice::from_ref(cycle), (found.frequency_hz, ROW_TIME_S));
            let lamp = lamp.unwrap();
            assert!(lamp.is_seen() && (lamp.share() - 0.9).abs() < 0.02, "{lamp:?}");
        }
    }
}

#[test]
fn cycles_show_a_lamp_in_step_with_the_frames() {
    let cycles = cycles(&|time_s| 1.0 + 0.9 * (TAU * 120.0 * time_s + 0.7).cos(), true);
    let found = CycleFlicker::find(&cycles, ROW_TIME_S, None).unwrap();
    assert!(!can_be_followed(found.frequency_hz, 60.0), "{found:?}");
}

#[test]
fn jitter_is_no_lamp() {
    for is_measured in [true, false] {
        let cycles = cycles(&|_| 1.0, is_measured);
        assert_eq!(CycleFlicker::find(&cycles, ROW_TIME_S, None), None);
        assert_eq!(CycleFlicker::find(&cycles, ROW_TIME_S, Some(100.0)), None);
    }
}

#[test]
fn frames_that_cover_whole_beats_cancel() {
    assert!((averaged_share(100.0, 60.0, 8) - 0.125).abs() < 1e-9);
    assert!(averaged_share(100.0, 60.0, 9) < 1e-9);
    assert_eq!(cancelling_frames(100.0, &[60.0], 8), Some(9));
    assert_eq!(cancelling_frames(100.0, &[60.0, 30.0], 1), Some(3));
    assert_eq!(cancelling_frames(99.0, &[60.0], 8), Some(17));
    assert_eq!(cancelling_frames(120.0, &[60.0], 8), None);
    assert!(can_be_followed(100.0, 60.0) && !can_be_followed(120.3, 60.0) && !can_be_followed(60.0, 30.0));
}
