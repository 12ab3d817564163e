//! Forward model and recovery on transport rendered by independent software.

#![allow(clippy::unwrap_used)] // helpers outside #[test] functions are tests too

mod common;

use common::{corner, ideal_stack, open, paper_sweep, photographed, timing};
use ndarray::{Array0, Array1, Array3, Axis, s};
use raysweep_transport::plane::{Demux, Prior, RowTiming, Setting, Transport, predict, relative_rows};
use raysweep_transport::quality::{median_profile_error, relative_l2, share_near};

#[test]
fn frames_made_by_stepping_through_time_are_predicted() {
    let mut reference = open("p2r_corner_frames.npz");
    let frames: Array3<f32> = reference.by_name("frames.npy").unwrap();
    let delay_us: Array1<f64> = reference.by_name("delay_us.npy").unwrap();
    let exposure_us: Array1<f64> = reference.by_name("exposure_us.npy").unwrap();
    let row_time_us: Array0<f64> = reference.by_name("row_time_us.npy").unwrap();
    let timing = RowTiming::new(128, row_time_us[()], 50_000.0 / 3.0).unwrap();
    let transport = corner();

    for (index, frame) in frames.axis_iter(Axis(0)).enumerate() {
        let setting = Setting::new(delay_us[index], exposure_us[index]);
        let predicted = predict(&timing, transport.view(), &setting).unwrap();
        let largest = frame.iter().fold(0.0_f32, |largest, &value| largest.max(value));
        let error = (&predicted - &frame).iter().fold(0.0_f32, |error, &value| error.max(value.abs()));
        assert!(error <= 1e-3 * largest, "{setting:?}: off by {error} of {largest}");
    }
}

/// Metrics of a recovery from a noisy stack of the paper's sweep.
struct Recovery {
    profile_error: f64,
    direct_image_error: f64,
    total_error: f64,
    near_share_error: f64,
}

fn recover(prior: Prior) -> Recovery {
    let transport = corner();
    let settings = paper_sweep();
    let stack = photographed(&ideal_stack(&transport, &settings), 1);
    let demux = Demux::new(timing(), settings, prior).unwrap();
    let truth = relative_rows(transport.view(), &demux.reach());
    let estimate = demux.solve(stack.view(), None).unwrap();

    let Transport { t, u_min, .. } = &estimate;
    assert_eq!((*u_min, estimate.u_max()), (-94, 94));
    assert!(t.iter().all(|&light| light >= 0.0));
    let sum = |rows: &Array3<f32>| rows.iter().map(|&light| f64::from(light)).sum::<f64>();
    Recovery {
        profile_error: median_profile_error(t.view(), truth.view()),
        direct_image_error: relative_l2(estimate.epipolar(1).view(), truth.slice(s![94, .., ..])),
        total_error: (sum(t) / sum(&truth) - 1.0).abs(),
        near_share_error: (share_near(t.view(), *u_min, 2) - share_near(truth.view(), *u_min, 2)).abs(),
    }
}

#[test]
fn the_split_prior_recovers_the_scene() {
    let figures = recover(Prior::SPLIT);
    // Measured: 0.0135, 0.0114, 0.0002, 0.0003.
    assert!(figures.profile_error <= 0.02, "{}", figures.profile_error);
    assert!(figures.direct_image_error <= 0.02, "{}", figures.direct_image_error);
    assert!(figures.total_error <= 0.005, "{}", figures.total_error);
    assert!(figures.near_share_error <= 0.005, "{}", figures.near_share_error);
}

#[test]
fn the_papers_prior_smears_the_direct_row_as_published_weights_do() {
    let figures = recover(Prior::PAPER);
    // Measured: 0.263, 0.196, 0.0059, 0.0069.
    assert!((figures.profile_error - 0.265).abs() <= 0.01, "{}", figures.profile_error);
    assert!((figures.direct_image_error - 0.197).abs() <= 0.01, "{}", figures.direct_image_error);
    assert!(figures.total_error <= 0.01, "{}", figures.total_error);
    assert!(figures.near_share_error <= 0.01, "{}", figures.near_share_error);
}
