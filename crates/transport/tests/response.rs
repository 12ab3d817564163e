//! Recovery with a measured response, from light that this file integrates by itself: pixels that look between rows,
//! rotated and off by rows, through a skewed beam, with a sweep that is not linear.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use ndarray::{Array2, Array3, s};
use raysweep_transport::plane::{
    CameraRows, Demux, FIRST_RESPONSE_ROW, PixelResponse, Prior, RESPONSE_ROWS, RelitBeam, RowTiming,
    Setting, Shares, Transport, relight,
};

const ROWS: usize = 160;
const HEIGHT: usize = 12;
const WIDTH: usize = 20;
const TAU_US: f64 = 20.0;
const FIRST_ROW: usize = 70;

/// When row `v` begins: a sweep that is early in the middle.
fn start_us(v: usize) -> f64 {
    let x = v as f64 / ROWS as f64;
    TAU_US * v as f64 - 60.0 * 4.0 * x * (1.0 - x)
}

/// Where a pixel looks: off by 0.4 row and rotated.
fn place(t: usize, s: usize) -> f64 {
    (FIRST_ROW + t) as f64 + 0.4 + 0.06 * (s as f64 - WIDTH as f64 / 2.0)
}

/// The light of a pixel from the place `u` rows below its own: a spike and scattering that falls off differently on
/// both sides.
fn light(t: usize, s: usize, u: i32) -> f64 {
    let albedo = 0.5 + 0.4 * ((t * 7 + s * 3) % 11) as f64 / 11.0;
    let reach = if u < 0 { 6.0 } else { 14.0 };
    let around = 0.02 * (-f64::from(u.abs()) / reach).exp();
    albedo * if u == 0 { 0.8 } else { around }
}

/// Share of a place's light that the row `d` rows below the place's own sends: a flat top from 0.5 rows above to 1.2
/// rows below, sampled by a footprint one row high at `fraction` of a row below the own row.
fn share(d: i32, fraction: f64) -> f64 {
    // The overlap of the box [-0.5, 1.2] with row d, for a pixel in the middle of its row.
    let beam = |d: i32| {
        let (from, to) = ((f64::from(d) - 0.5).max(-0.5), (f64::from(d) + 0.5).min(1.2));
        (to - from).max(0.0) / 1.7
    };
    let (low, high) = if fraction < 0.0 { (-fraction, 0.0) } else { (0.0, fraction) };
    beam(d) * (1.0 - fraction.abs()) + beam(d + 1) * low + beam(d - 1) * high
}

fn drawn_share(setting: &Setting, t: usize, v: usize) -> f64 {
    // The nominal centre of row FIRST_ROW is what delays refer to; the rows of the camera follow at the nominal pace.
    let centre_us = (FIRST_ROW as f64 + 0.5) * TAU_US + setting.delays_us[0] + t as f64 * TAU_US;
    let (from, to) = (centre_us - setting.exposure_us / 2.0, centre_us + setting.exposure_us / 2.0);
    let (start, end) = (start_us(v), start_us(v + 1));
    (end.min(to) - start.max(from)).max(0.0) / (end - start)
}

fn settings() -> Vec<Setting> {
    let edges = (-8..=8).map(|step| Setting::new(300.0 + 10.0 * f64::from(step), 600.0));
    let grid = [600.0, 900.0].into_iter().flat_map(|exposure_us| {
        (-12..=12).map(move |step| Setting::new(75.0 * f64::from(step), exposure_us))
    });
    grid.chain(edges).collect()
}

fn stack() -> Array3<f32> {
    let settings = settings();
    Array3::from_shape_fn((settings.len(), HEIGHT, WIDTH), |(n, t, s)| {
        let own = place(t, s).round();
        let fraction = place(t, s) - own;
        let mut sum = 0.0;
        for v in 0..ROWS {
            let drawn = drawn_share(&settings[n], t, v);
            if drawn > 0.0 {
                let relative = v as i32 - own as i32;
                sum += drawn * (-4..=4).map(|d| share(d, fraction) * light(t, s, relative - d)).sum::<f64>();
            }
        }
        sum as f32
    })
}

fn timing() -> RowTiming {
    let starts: Vec<f64> = (0..=ROWS).map(start_us).collect();
    let timing = RowTiming::new(ROWS, TAU_US, 10_000.0).unwrap().window(FIRST_ROW, HEIGHT).unwrap();
    timing.with_row_table(&starts).unwrap()
}

fn places() -> Array2<f32> {
    Array2::from_shape_fn((HEIGHT, WIDTH), |(t, s)| place(t, s) as f32)
}

fn response() -> PixelResponse {
    let shares = Array3::from_shape_fn((RESPONSE_ROWS, HEIGHT, WIDTH), |(d, t, s)| {
        share(d as i32 + FIRST_RESPONSE_ROW, place(t, s) - place(t, s).round()) as f32
    });
    PixelResponse::new(places(), shares).unwrap()
}

/// Median over the pixels of the relative error of the profile.
fn error(timing: RowTiming) -> f64 {
    let demux = Demux::new(timing, settings(), Prior::Split { alpha: 0.01, beta: 0.0 }).unwrap();
    median_error(&demux.solve(stack().view(), None).unwrap())
}

fn median_error(transport: &Transport) -> f64 {
    let mut errors: Vec<f64> = Vec::new();
    let (_, rows, columns) = transport.t.dim();
    for (t, s) in (0..rows).flat_map(|t| (0..columns).map(move |s| (t, s))) {
        let (mut wrong, mut all) = (0.0, 0.0);
        for (index, &found) in transport.t.slice(s![.., t, s]).iter().enumerate() {
            let truth = light(t, s, transport.u_min + index as i32);
            wrong += (f64::from(found) - truth).powi(2);
            all += truth.powi(2);
        }
        errors.push((wrong / all).sqrt());
    }
    errors.sort_by(f64::total_cmp);
    errors[errors.len() / 2]
}

#[test]
fn a_measured_response_recovers_what_no_assumed_beam_does() {
    let with = error(timing().with_response(response()).unwrap());
    let without = error(timing());
    assert!(with < 0.03, "{with}");
    assert!(without > 0.3, "{without}");
}

#[test]
fn a_response_on_whole_rows_is_the_ideal_beam() {
    let mut ideal: Shares = [0.0; RESPONSE_ROWS];
    ideal[-FIRST_RESPONSE_ROW as usize] = 1.0;
    let rows = Array2::from_shape_fn((HEIGHT, WIDTH), |(t, _)| (FIRST_ROW + t) as f32);
    let measured = timing().with_response(PixelResponse::with_beam(rows, &ideal).unwrap()).unwrap();
    let solve = |timing: RowTiming| {
        let demux = Demux::new(timing, settings(), Prior::SPLIT).unwrap();
        let transport = demux.solve(stack().view(), None).unwrap();
        let rows: Vec<usize> = (0..HEIGHT).collect();
        let predicted = demux.predict_rows(&rows, &transport).unwrap();
        (transport, predicted)
    };
    let ((nominal, nominal_images), (measured, measured_images)) = (solve(timing()), solve(measured));
    assert_eq!(nominal.t.dim(), measured.t.dim());
    assert!((&nominal.t - &measured.t).iter().all(|difference| difference.abs() < 1e-5));
    assert!((&nominal_images - &measured_images).iter().all(|difference| difference.abs() < 1e-4));
}

/// Camera rows of other pitch than the projector's look between its rows: their direct light is one spike still.
#[test]
fn camera_rows_between_projector_rows_keep_their_direct_light_in_one_row() {
    for pitch in [0.75, 1.25, 1.5] {
        let place = |t: usize| FIRST_ROW as f64 + pitch * t as f64;
        let stack = Array3::from_shape_fn((settings().len(), HEIGHT, 4), |(n, t, s)| {
            let setting = &settings()[n];
            // The exposure follows the place at the projector's pace; a footprint one row high divides the light.
            let centre_us = (place(t) + 0.5) * TAU_US + setting.delays_us[0];
            let (from, to) = (centre_us - setting.exposure_us / 2.0, centre_us + setting.exposure_us / 2.0);
            let (own, fraction) = (place(t).round(), place(t) - place(t).round());
            let drawn = |v: f64| (((v + 1.0) * TAU_US).min(to) - (v * TAU_US).max(from)).max(0.0) / TAU_US;
            let of_row = |u: i32| {
                let v = own + f64::from(u);
                let divided =
                    drawn(v) * (1.0 - fraction.abs()) + drawn(v + fraction.signum()) * fraction.abs();
                divided * light(t, s, u)
            };
            (-69..=70).map(of_row).sum::<f64>() as f32
        });
        let camera = CameraRows { first_row: FIRST_ROW, rows: HEIGHT, pitch, row_time_us: pitch * TAU_US };
        let timing = RowTiming::new(ROWS, TAU_US, 10_000.0).unwrap().with_camera(camera).unwrap();
        let demux = Demux::new(timing, settings(), Prior::Split { alpha: 0.01, beta: 0.0 }).unwrap();
        let transport = demux.solve(stack.view(), None).unwrap();
        let error = median_error(&transport);
        assert!(error < 0.03, "pitch {pitch}: {error}");
    }
}

#[test]
fn relighting_counts_from_each_pixels_own_row() {
    let timing = timing().with_response(response()).unwrap();
    let demux = Demux::new(timing.clone(), settings(), Prior::Split { alpha: 0.01, beta: 0.0 }).unwrap();
    let transport = demux.solve(stack().view(), None).unwrap();
    // Only the row that pixel (5, 2) looks at is lit: columns of other own rows see it as indirect light.
    let lit = place(5, 2).round();
    let weights = ndarray::Array1::from_shape_fn(ROWS, |v| f64::from(u8::from(v as f64 == lit)));
    let image = relight(&timing, &transport, weights.view(), RelitBeam::Ideal).unwrap();
    for s in 0..WIDTH {
        let u = (lit - place(5, s).round()) as i32;
        let expected = transport.t[[(u - transport.u_min) as usize, 5, s]];
        assert_eq!(image[[5, s]], expected, "column {s}");
    }
    assert!(image[[5, 2]] > 5.0 * image[[5, WIDTH - 1]]);
}

#[test]
fn a_stack_of_other_columns_is_refused() {
    let timing = timing().with_response(response()).unwrap();
    let demux = Demux::new(timing, settings(), Prior::SPLIT).unwrap();
    let narrow = stack().slice(s![.., .., ..WIDTH - 1]).to_owned();
    assert!(demux.solve(narrow.view(), None).is_err());
}
