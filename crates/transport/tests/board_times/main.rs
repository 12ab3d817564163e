//! The times of rows, found in frames of a simulated board, compared with those with which the frames were made.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod rig;

use std::time::Instant;

use ndarray::Array2;
use raysweep_transport::plane::RowTiming;
use raysweep_transport::plane::board::Estimate;
use raysweep_transport::plane::board::images::Responses;
use raysweep_transport::plane::board::times::{
    BoardFrame, BoardSetting, CoarseSweep, Columns, ExposureMode, RollingSweep, RowTimes, TimesError,
    arrival_settings, check_settings, sweep_settings,
};
use raysweep_transport::plane::calibrate::{FlyingSpot, Scan};
use rig::{Case, Jitter, PROJECTOR_ROWS, PictureNoise, Rig};

/// Delays of a pass over the arrivals of light.
const DELAYS: usize = 64;
/// How often rows are pictured again.
const PICTURED_AGAIN: u64 = 5;

/// Frames of a whole calibration.
struct Session {
    rig: Rig,
    columns: Columns,
    frames: Vec<BoardFrame>,
}

impl Session {
    fn new(case: Case) -> Self {
        let rig = Rig::new(case);
        let columns = Columns::new(rig.responses.place.view(), rig.responses.response.view(), None).unwrap();
        let columns = columns.with_errors_of(&rig.responses).unwrap();
        Self { rig, columns, frames: Vec::new() }
    }

    fn take(&mut self, settings: &[BoardSetting], frames: usize) {
        for &setting in settings {
            for _ in 0..frames {
                let light = self.columns.average(self.rig.frame(setting).view()).unwrap();
                self.frames.push(BoardFrame { setting, light });
            }
        }
    }

    fn sweep(&mut self) -> Result<CoarseSweep, TimesError> {
        let nominal = self.rig.nominal();
        self.take(&sweep_settings(&nominal, self.columns.seen_rows()).unwrap(), 1);
        CoarseSweep::from_borders(&self.columns, &self.frames, &nominal)
    }

    /// A first pass over all times at which light may arrive.
    fn first_arrivals(&mut self, coarse: &CoarseSweep) -> Result<RollingSweep, TimesError> {
        let nominal = self.rig.nominal();
        let foreseen = RollingSweep::foreseen(coarse, &nominal, self.columns.rows());
        self.take(&arrival_settings(&self.columns, &foreseen, &nominal, DELAYS).unwrap(), 1);
        RollingSweep::from_arrivals(&self.columns, &self.frames, coarse)
    }

    /// All steps of the procedure, with about 130 frames on the light.
    fn taken(case: Case) -> Self {
        let mut session = Self::new(case);
        let nominal = session.rig.nominal();
        let coarse = session.sweep().unwrap();
        let rolling = session.first_arrivals(&coarse).unwrap();
        session.take(&arrival_settings(&session.columns, &rolling, &nominal, DELAYS).unwrap(), 2);
        session.take(&check_settings(&session.columns, &rolling, &nominal).unwrap(), 1);
        session
    }

    fn fit(&self) -> Result<RowTimes, TimesError> {
        RowTimes::fit(&self.columns, &self.frames, &self.rig.nominal(), self.rig.noise())
    }

    /// The camera sees the projector's whole width.
    fn find_spot(&self) -> Result<Option<(RowTimes, FlyingSpot)>, TimesError> {
        let (rows, columns) = self.rig.responses.place.dim();
        let seen =
            Array2::from_shape_fn((rows, columns), |(_, s)| ((s as f64 + 0.5) / columns as f64) as f32);
        RowTimes::find_spot(
            &self.rig.responses,
            seen.view(),
            &self.frames,
            &self.rig.nominal(),
            self.rig.noise(),
        )
    }
}

/// Estimates minus truth.
#[derive(Debug)]
struct Errors {
    /// Row time, relative.
    tau: f64,
    rows_rms: f64,
    rows_worst: f64,
    exposure_us: f64,
    latency_us: f64,
    /// Errors over standard deviations: row time, camera row time, exposure, mode, latency.
    sds: [f64; 5],
    /// Share of row starts, without their common offset and slope, within one standard deviation of the same.
    rows_within_sd: f64,
}

fn errors(rig: &Rig, times: &RowTimes) -> Errors {
    let case = rig.case();
    let seen = times.seen_rows.clone();
    let (first, end) = (seen.start, seen.end);
    let late: Vec<f64> = (first..=end).map(|v| times.row_starts_us[v] - rig.starts_us[v]).collect();
    let mean = late.iter().sum::<f64>() / late.len() as f64;
    let rows: Vec<f64> = late.iter().map(|late| (late - mean) / case.row_time_us).collect();
    let tau = (rig.starts_us[end] - rig.starts_us[first]) / (end - first) as f64;
    let sds = |measured: Estimate, truth: f64| (measured.value - truth) / measured.sd;
    // Light of the middle camera row.
    let middle = case.window.1 / 2;
    let place = case.window.0 + middle;
    let latency_us = times.row_starts_us[place]
        - rig.starts_us[place]
        - middle as f64 * (times.camera_row_time_us.value - case.camera_row_time_us);
    let mode = |times: &RowTimes| {
        times.row_starts_modes.rows().into_iter().skip(4).map(|mode| mode.to_vec()).collect::<Vec<_>>()
    };
    let modes = mode(times);
    let middle_row = (first + end) as f64 / 2.0;
    let length = late.len() as f64;
    let slope_square: f64 = (first..=end).map(|v| (v as f64 - middle_row).powi(2)).sum();
    let slope =
        (first..=end).zip(&late).map(|(v, late)| (v as f64 - middle_row) * (late - mean)).sum::<f64>()
            / slope_square;
    let within = (first..=end).zip(&late).filter(|(v, late)| {
        let rest = *late - mean - slope * (*v as f64 - middle_row);
        let sd = modes.iter().map(|mode| mode[*v].powi(2)).sum::<f64>().sqrt();
        rest.abs() < sd
    });
    Errors {
        tau: times.row_time_us.value / tau - 1.0,
        rows_rms: (rows.iter().map(|row| row * row).sum::<f64>() / length).sqrt(),
        rows_worst: rows.iter().fold(0.0, |worst: f64, row| worst.max(row.abs())),
        exposure_us: times.exposure_offset_us.value - case.exposure_offset_us,
        latency_us,
        sds: [
            sds(times.row_time_us, tau),
            sds(times.camera_row_time_us, case.camera_row_time_us),
            sds(times.exposure_offset_us, case.exposure_offset_us),
            sds(times.mode_offset_us, case.mode_offset_us),
            latency_us / times.latency_sd_us,
        ],
        rows_within_sd: within.count() as f64 / length,
    }
}

/// What calibration.md, section 12 demands.
fn check(case: Case) -> (RowTimes, Errors) {
    let session = Session::taken(case);
    let start = Instant::now();
    let times = session.fit().unwrap();
    println!("{} frames, {:.2} s", session.frames.len(), start.elapsed().as_secs_f64());
    let errors = check_times(&session, &times);
    (times, errors)
}

fn check_times(session: &Session, times: &RowTimes) -> Errors {
    let case = session.rig.case();
    let errors = errors(&session.rig, times);
    println!("{errors:.6?}");
    println!(
        "tau {:?} rc {:?} delta {:?} mode {:?} latency sd {:.3} jitter {:?} useful {} modes {} dropped {:?}",
        times.row_time_us,
        times.camera_row_time_us,
        times.exposure_offset_us,
        times.mode_offset_us,
        times.latency_sd_us,
        times.jitter_us,
        times.useful_frames,
        times.row_starts_modes.nrows(),
        times.dropped
    );
    println!("{:?}", times.residuals.iter().map(|r| (r.exposure_us, r.chi2_per_sample)).collect::<Vec<_>>());
    assert!(errors.tau.abs() < 2e-4, "{case:?}: {errors:?}");
    assert!(errors.rows_rms < 0.02 && errors.rows_worst < 0.05, "{case:?}: {errors:?}");
    assert!(errors.exposure_us.abs() < 0.1, "{case:?}: {errors:?}");
    assert!(errors.latency_us.abs() < 1.5, "{case:?}: {errors:?}");
    // Kinks between knots bias the mean row time of a whole raster, whose standard deviation is 5e-6 of itself.
    let most_sds = if case.window.1 < 720 { 3.0 } else { 5.0 };
    assert!(errors.sds.iter().all(|sds| sds.abs() < most_sds), "{case:?}: {errors:?}");
    errors
}

#[test]
fn the_whole_raster() {
    check(Case::full(1));
}

#[test]
fn a_window_of_128_rows() {
    check(Case::window(1));
}

#[test]
fn camera_and_projector_of_different_row_times() {
    for (seed, camera_row_time_us, jitter) in
        [(2, 22.22 * 1.03, Jitter::Uniform(5.0)), (3, 22.22 * 0.97, Jitter::Normal(5.0))]
    {
        check(Case { camera_row_time_us, jitter, latency_us: 100.0, ..Case::full(seed) });
        check(Case { camera_row_time_us, jitter, latency_us: -100.0, ..Case::window(seed) });
    }
}

/// What the camera says of its rows is 3 % off: over an image, light arrives up to half a millisecond from where it is
/// expected.
#[test]
fn a_camera_whose_row_time_is_not_known() {
    for (seed, error) in [(31, 0.03), (35, -0.03)] {
        check(Case { camera_row_error: error, latency_us: 22.0, ..Case::window(seed) });
    }
    check(Case { camera_row_error: -0.03, ..Case::full(34) });
}

#[test]
fn rows_outside_the_window_are_uncertain() {
    let session = Session::taken(Case::window(4));
    let times = session.fit().unwrap();
    assert_eq!(times.seen_rows, session.columns.seen_rows());
    let wrong = |v: usize| (times.row_starts_us[v] - session.rig.starts_us[v]).abs();
    for v in [0, 150, 250, 500, 600, 720] {
        assert!(times.row_starts_sd_us[v] > times.row_starts_sd_us[360] * 2.0, "row {v}");
        // The kinks of this sweep are sharper than the bend that is allowed for.
        assert!(wrong(v) < 3.0 * times.row_starts_sd_us[v] + 40.0, "row {v}: {}", wrong(v));
    }
    assert!(times.row_starts_sd_us[0] > 100.0 && times.row_starts_sd_us[360] < 1.0);
}

/// Where the sweep is slowest, a table that goes on as it does there leaves the period, which no model takes.
#[test]
fn all_rows_fit_into_a_period_wherever_the_window_is() {
    for first in [8, 584] {
        let session = Session::taken(Case { window: (first, 128), ..Case::window(41) });
        let starts_us = session.fit().unwrap().row_starts_us;
        let timing = RowTiming::new(PROJECTOR_ROWS, 22.22, session.rig.nominal().period_us).unwrap();
        let lit_us = starts_us[PROJECTOR_ROWS] - starts_us[0];
        println!("window from row {first}: all rows take {lit_us:.0} us");
        assert!(timing.with_row_table(&starts_us).is_ok(), "{lit_us}");
    }
}

#[test]
fn the_modes_are_the_covariance() {
    let times = Session::taken(Case::window(5)).fit().unwrap();
    for v in times.seen_rows.clone() {
        let sd_us = times.row_starts_modes.column(v).iter().map(|mode| mode * mode).sum::<f64>().sqrt();
        assert!((sd_us / times.row_starts_sd_us[v] - 1.0).abs() < 0.01, "row {v}");
    }
}

/// The noise of the pictures of rows is hardly in the residuals of the frames: the fit gives way to it.
#[test]
fn what_other_pictures_of_the_rows_would_change_is_stated() {
    let session = Session::taken(Case { picture_noise: 0.0, ..Case::window(14) });
    let fit = |responses: &Responses, has_errors: bool| {
        let columns = Columns::new(responses.place.view(), responses.response.view(), None).unwrap();
        let columns = if has_errors { columns.with_errors_of(responses).unwrap() } else { columns };
        let times = RowTimes::fit(&columns, &session.frames, &session.rig.nominal(), session.rig.noise());
        let times = times.unwrap();
        [times.exposure_offset_us, times.camera_row_time_us, times.row_time_us]
    };
    for noise in [PictureNoise { row: 0.006, black: 0.0 }, PictureNoise { row: 1e-6, black: 0.004 }] {
        let again = |seed| noise.measured_again(&session.rig.responses, seed);
        let [with, without] = [true, false].map(|has_errors| fit(&again(0), has_errors));
        let found: Vec<[f64; 3]> =
            (1..=PICTURED_AGAIN).map(|seed| fit(&again(seed), false).map(|found| found.value)).collect();
        for (index, name) in ["exposure offset", "camera row time", "row time"].iter().enumerate() {
            let stated = (with[index].sd.powi(2) - without[index].sd.powi(2)).sqrt();
            let mean = found.iter().map(|found| found[index]).sum::<f64>() / PICTURED_AGAIN as f64;
            let squares = found.iter().map(|found| (found[index] - mean).powi(2)).sum::<f64>();
            let scatter = (squares / (PICTURED_AGAIN - 1) as f64).sqrt();
            let told = format!("{name}: stated {stated:.2e} us, scatter {scatter:.2e} us");
            println!("{told}, without {:.2e} us", without[index].sd);
            // Four degrees of freedom tell a standard deviation to little more than a third.
            assert!((0.4..2.5).contains(&(scatter / stated)), "{told}");
        }
    }
}

#[test]
fn each_frames_jitter_is_found_and_frames_of_another_trigger_are_dropped() {
    let mut session = Session::taken(Case::window(7));
    let jitters_us = session.rig.jitters_us.clone();
    // One frame comes 60 us late, and one has the light of other settings.
    let late =
        session.frames.iter().position(|frame| frame.setting.shutter == ExposureMode::Rolling).unwrap() + 60;
    let setting = session.frames[late].setting;
    let light = session.rig.late_picture(setting, 60.0, |_| true);
    session.frames[late].light = session.columns.average(light.view()).unwrap();
    let times = session.fit().unwrap();
    assert!(times.dropped.iter().any(|dropped| dropped.0 == late), "{:?}", times.dropped);
    for shutter in [ExposureMode::Global, ExposureMode::Rolling] {
        let frames = (0..session.frames.len())
            .filter(|&frame| session.frames[frame].setting.shutter == shutter)
            .filter_map(|frame| times.jitters[frame].map(|found| (found, jitters_us[frame])));
        // Some frames have hardly an edge on the light, and say so.
        let pairs: Vec<(f64, f64)> = frames
            .filter(|(found, _)| found.sd_us < 0.5)
            .map(|(found, truth)| (found.late_us, truth))
            .collect();
        assert!(pairs.len() > 20, "{shutter:?}: {}", pairs.len());
        let mean = pairs.iter().map(|(found, truth)| found - truth).sum::<f64>() / pairs.len() as f64;
        let rms = pairs.iter().map(|(found, truth)| (found - truth - mean).powi(2)).sum::<f64>();
        let rms = (rms / pairs.len() as f64).sqrt();
        println!("{shutter:?}: jitters of {} frames within {rms:.3} us rms", pairs.len());
        assert!(rms < 0.5, "{shutter:?}: {rms}");
    }
    assert!((times.jitter_us.value - 5.0).abs() < 1.0, "{:?}", times.jitter_us);
}

#[test]
fn a_trigger_delay_that_does_not_act_is_refused() {
    let error = Session::new(Case { global_delay_acts: false, ..Case::full(7) }).sweep().unwrap_err();
    assert!(matches!(error, TimesError::TooFewBorders { .. }), "{error}");
}

#[test]
fn a_trigger_that_is_not_the_vsync_is_refused() {
    let error = Session::taken(Case { jitter: Jitter::Normal(45.0), ..Case::full(8) }).fit().unwrap_err();
    assert!(matches!(error, TimesError::Jitter { .. }), "{error}");
}

#[test]
fn a_granular_exposure_is_refused() {
    let error = Session::taken(Case { exposure_step_us: 4.0, ..Case::full(9) }).fit().unwrap_err();
    assert!(matches!(error, TimesError::Granular { .. }), "{error}");
}

/// Exposures longer than the light's arrival show one edge a frame, which the frame's jitter hides.
#[test]
fn long_exposures_for_arrivals_are_refused_or_uncertain() {
    let mut session = Session::new(Case::full(10));
    let coarse = session.sweep().unwrap();
    let nominal = session.rig.nominal();
    let rolling = session.first_arrivals(&coarse).unwrap();
    session.frames.retain(|frame| frame.setting.shutter == ExposureMode::Global);
    let mut arrivals = arrival_settings(&session.columns, &rolling, &nominal, DELAYS).unwrap();
    arrivals.iter_mut().for_each(|setting| setting.exposure_us = 600.0);
    let sweep = session.frames.len();
    session.take(&arrivals, 1);
    let error = session.fit().unwrap_err();
    assert!(matches!(error, TimesError::ArrivalsCut { .. }), "{error}");

    // With delays over both edges.
    session.frames.truncate(sweep);
    let earlier =
        arrivals.iter().map(|setting| BoardSetting { delay_us: setting.delay_us - 600.0, ..*setting });
    let all: Vec<BoardSetting> = earlier.chain(arrivals.iter().copied()).collect();
    session.take(&all, 2);
    let (long, short) = (session.fit().unwrap(), Session::taken(Case::full(10)).fit().unwrap());
    println!("delta {:?} against {:?}", long.exposure_offset_us, short.exposure_offset_us);
    let error = (long.exposure_offset_us.value - 3.2) / long.exposure_offset_us.sd;
    assert!(error.abs() < 3.0, "{error}");
    assert!(long.exposure_offset_us.sd > 1.5 * short.exposure_offset_us.sd);
}

/// The spot passes a 50th of the width at a time, and rows are as well known as those that are lit evenly.
#[test]
fn spots_are_recognised() {
    let one_way = (Case { slopes: [1.0, 1.0], ..Case::full(12) }, Scan::OneWay);
    let bidirectional = (Case { slopes: [1.0, -1.0], ..Case::window(12) }, Scan::Bidirectional);
    for (case, scan) in [one_way, bidirectional] {
        let session = Session::taken(Case { columns: 48, ..case });
        let (times, spot) = session.find_spot().unwrap().unwrap();
        assert_eq!(spot.scan, scan);
        check_times(&session, &times);
    }
    // Rows that are lit evenly look like neither.
    assert!(Session::taken(Case::window(13)).find_spot().unwrap().is_none());
}

#[test]
fn a_flying_spot_does_not_fit() {
    let error = Session::taken(Case { slopes: [1.0, -1.0], ..Case::window(12) }).fit().unwrap_err();
    println!("{error}");
    assert!(matches!(error, TimesError::Misfit { .. }), "{error}");
}

/// Share of errors within one standard deviation: `cargo test -p raysweep-transport --test board_times -- --ignored
/// --nocapture coverage`, with `CASE` for one of the cases and `RUNS` for the number of runs of each.
#[test]
#[ignore = "takes minutes"]
fn coverage() {
    let none = |seed| Case { unevenness: 0.0, picture_noise: 0.0, kinks_us: 0.0, ..Case::window(seed) };
    let kinks = |seed| Case { kinks_us: 20.0, ..none(seed) };
    let uneven = |seed| Case { unevenness: 0.01, ..none(seed) };
    let response = |seed| Case { picture_noise: 0.002, ..none(seed) };
    let cases: [(&str, &dyn Fn(u64) -> Case); 6] = [
        ("window", &Case::window),
        ("full", &Case::full),
        ("none", &none),
        ("kinks", &kinks),
        ("uneven", &uneven),
        ("response", &response),
    ];
    for (name, case) in cases {
        if std::env::var("CASE").is_ok_and(|only| only != name) {
            continue;
        }
        let mut within = [0; 5];
        let (mut rows, mut squares, mut refused) = (0.0, [0.0; 5], 0);
        let runs = std::env::var("RUNS").map_or(100, |runs| runs.parse().unwrap());
        for seed in 0..runs {
            let session = Session::taken(case(100 + seed));
            let times = match session.fit() {
                Ok(times) => times,
                Err(error) => {
                    println!("{error}");
                    refused += 1;
                    continue;
                }
            };
            let errors = errors(&session.rig, &times);
            for (index, sds) in errors.sds.iter().enumerate() {
                within[index] += usize::from(sds.abs() < 1.0);
                squares[index] += sds * sds / runs as f64;
            }
            println!(
                "{:.2?} {:.2e} {:.2e} latency {:.2} {:.2} jitter {:.2} useful {}",
                errors.sds,
                times.row_time_us.sd,
                times.camera_row_time_us.sd,
                errors.latency_us,
                times.latency_sd_us,
                times.jitter_us.value,
                times.useful_frames
            );
            rows += errors.rows_within_sd / runs as f64;
        }
        println!(
            "{name} tau, rc, delta, mode, latency: {within:?} of {runs} ({refused} refused), rms {:.2?}, rows {rows:.2}",
            squares.map(f64::sqrt)
        );
    }
}
