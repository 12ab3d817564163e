//! The times of rows, found in frames of a simulated board, compared with those with which the frames were made.

#![allow(clippy::unwrap_used)] // helpers outside #[test] functions are tests too

mod rig;

use std::time::Instant;

use raysweep_transport::plane::board::times::{
    BoardFrame, BoardSetting, Coarse, Columns, Measured, RowTimes, Shutter, TimesError, arrival_settings,
    check_settings, spot_slopes, sweep_settings,
};
use rig::{Case, Jitter, Rig};

/// Frames of a whole calibration.
struct Session {
    rig: Rig,
    columns: Columns,
    frames: Vec<BoardFrame>,
}

impl Session {
    fn new(case: Case) -> Self {
        let rig = Rig::new(case);
        let columns = Columns::new(rig.place.view(), rig.response.view()).unwrap();
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

    fn sweep(&mut self) -> Result<Coarse, TimesError> {
        let nominal = self.rig.nominal();
        self.take(&sweep_settings(&nominal, self.columns.seen_rows()).unwrap(), 1);
        Coarse::from_borders(&self.columns, &self.frames, &nominal)
    }

    /// All steps of the procedure, with about 150 frames or more on the light.
    fn taken(case: Case) -> Self {
        let mut session = Self::new(case);
        let nominal = session.rig.nominal();
        let coarse = session.sweep().unwrap();
        let arrivals = arrival_settings(&session.columns, &coarse, &nominal).unwrap();
        session.take(&arrivals, 3.max(150_usize.div_ceil(arrivals.len())));
        session.take(&check_settings(&session.columns, &coarse, &nominal).unwrap(), 1);
        session
    }

    fn fit(&self) -> Result<RowTimes, TimesError> {
        RowTimes::fit(&self.columns, &self.frames, &self.rig.nominal(), self.rig.noise())
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
    let sds = |measured: Measured, truth: f64| (measured.value - truth) / measured.sd;
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
    let session = Session::taken(case.clone());
    let start = Instant::now();
    let times = session.fit().unwrap();
    let errors = errors(&session.rig, &times);
    println!("{} frames, {:.2} s, {errors:.2e?}", session.frames.len(), start.elapsed().as_secs_f64());
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
    assert!(errors.sds.iter().all(|sds| sds.abs() < 3.0), "{case:?}: {errors:?}");
    (times, errors)
}

#[test]
fn the_whole_raster() {
    check(Case::full(1));
}

#[test]
fn a_window_of_128_rows() {
    check(Case::window(1));
}
