use std::ops::Range;

use ndarray::Array2;

use super::super::super::PlaneError;
use super::coarse::RollingSweep;
use super::columns::Columns;

/// How the rows of the camera are exposed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExposureMode {
    /// All rows at once.
    Global,
    /// One row after the other.
    Rolling,
}

/// Settings of one frame of the board.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BoardSetting {
    /// How the rows are exposed.
    pub shutter: ExposureMode,
    /// Time from the trigger edge to the start of camera row 0's exposure, as the rig believes it. An unknown constant
    /// of each shutter mode may be missing.
    pub delay_us: f64,
    /// Exposure of each row, as set.
    pub exposure_us: f64,
}

/// One frame of the white board, averaged by [`Columns::average`].
#[derive(Debug, Clone, PartialEq)]
pub struct BoardFrame {
    /// How the frame was taken.
    pub setting: BoardSetting,
    /// Light as a share of one pass of white, `[rows, groups]`.
    pub light: Array2<f32>,
}

/// What is known of the times before they are measured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Nominal {
    /// Number of rows that the projector draws.
    pub projector_rows: usize,
    /// Time from the trigger edge to the start of the projector's row 0, to within 100 us.
    pub first_row_us: f64,
    /// Time from one row of the projector to the next.
    pub row_time_us: f64,
    /// Time from one row of the camera to the next.
    pub camera_row_time_us: f64,
    /// Time from one trigger edge to the next.
    pub period_us: f64,
}

/// Rows on either side of an edge within which the beam blurs it.
pub(super) const BEAM_ROWS: f64 = 4.0;
/// Fewest rows from which the times of a sweep are found.
const LEAST_SEEN: usize = 64;
/// Exposure of the rolling frames that find arrivals, in row times.
const ARRIVAL_ROWS: f64 = 3.0;
/// How far the delays of the arrival step extend beyond the range of arrivals, in row times.
const ARRIVAL_MARGIN_ROWS: f64 = 3.5;
/// The two exposures that check the shortest one.
const CHECK_EXPOSURES_US: [f64; 2] = [600.0, 1200.0];
const CHECK_DELAYS: usize = 6;
/// Fractional part of the golden ratio, whose multiples fill an interval evenly however many are taken.
const GOLDEN: f64 = 0.618_033_988_749_895;

impl Nominal {
    /// Checks the numbers.
    ///
    /// # Errors
    /// [`PlaneError::OutOfRange`] for times that are not positive, or rows that do not fit into the period.
    pub fn check(&self) -> Result<(), PlaneError> {
        let times = [("row_time_us", self.row_time_us), ("camera row_time_us", self.camera_row_time_us)];
        for (field, value) in times {
            if !(value.is_finite() && value > 0.0) {
                return Err(PlaneError::OutOfRange { field, value, allowed: "positive: see its data sheet" });
            }
        }
        if !self.first_row_us.is_finite() {
            let allowed = "finite: the time from the trigger edge to the first row, to within 100 us";
            return Err(PlaneError::OutOfRange { field: "first_row_us", value: self.first_row_us, allowed });
        }
        if !(self.projector_rows > 0 && self.period_us >= self.projector_rows as f64 * self.row_time_us) {
            let allowed = "at least the projector's rows times row_time_us, of at least one row";
            return Err(PlaneError::OutOfRange { field: "period_us", value: self.period_us, allowed });
        }
        Ok(())
    }

    /// Nominal start of a row, or of a fraction of it.
    pub(super) fn start_us(&self, row: f64) -> f64 {
        self.first_row_us + row * self.row_time_us
    }

    /// How far the light of a row may be from its nominal time: the latency is known to within 100 us, and a sweep may
    /// be early by 2 % of itself in its middle.
    pub(super) fn error_us(&self) -> f64 {
        100.0 + 0.02 * self.projector_rows as f64 * self.row_time_us
    }
}

/// The 24 global settings that show when the rows in `seen_rows` are lit: 4 that open before the first of them, 4 that
/// close after the last, and 16 exposures that open and close while they are lit.
///
/// # Errors
/// Those of [`Nominal::check`]; [`PlaneError::OutOfRange`] if fewer than 64 rows are seen, [`PlaneError::Window`] for
/// rows that do not exist.
pub fn sweep_settings(nominal: &Nominal, seen_rows: Range<usize>) -> Result<Vec<BoardSetting>, PlaneError> {
    nominal.check()?;
    let Nominal { projector_rows, row_time_us, period_us, .. } = *nominal;
    if seen_rows.len() < LEAST_SEEN {
        let (field, value) = ("number of projector rows that the image sees", seen_rows.len() as f64);
        let allowed =
            "at least 64 for a calibration: take more camera rows, or let the image see more of the board";
        return Err(PlaneError::OutOfRange { field, value, allowed });
    }
    if seen_rows.end > projector_rows {
        return Err(PlaneError::Window { first_row: seen_rows.start, end: seen_rows.end, projector_rows });
    }
    let start_us = nominal.start_us(seen_rows.start as f64);
    let lit_us = seen_rows.len() as f64 * row_time_us;
    // An exposure that begins before the first row must not reach back into the previous period's light, nor one that
    // ends after the last row into the next.
    let margin_us = (nominal.error_us() + BEAM_ROWS * row_time_us).min((period_us - lit_us) / 2.0);
    let setting = |from_us: f64, exposure_us: f64| BoardSetting {
        shutter: ExposureMode::Global,
        delay_us: start_us + from_us,
        exposure_us,
    };
    let edge_us = |index: usize| lit_us * (0.2 + 0.2 * index as f64);
    let opens_before = (0..4).map(|index| setting(-margin_us, edge_us(index) + margin_us));
    let closes_after = (0..4).map(|index| setting(edge_us(index), lit_us - edge_us(index) + margin_us));
    let inside = (0..16).map(|index| {
        let share = [0.025, 0.075, 0.19, 0.375, 0.56, 0.75][index % 6];
        // Of a short window, 3/4 would leave no room for the error of the nominal times.
        let exposure_us = (share * lit_us).min(lit_us - 2.0 * margin_us).max(8.0 * row_time_us);
        let free_us = lit_us - exposure_us;
        let edge_us = margin_us.min(free_us / 3.0);
        setting(edge_us + (free_us - 2.0 * edge_us) * (index as f64 * GOLDEN).fract(), exposure_us)
    });
    Ok(opens_before.chain(closes_after).chain(inside).collect())
}

/// The rolling settings that show when the light of each camera row arrives: exposures of three row times, with `delays`
/// delays over the range in which `rolling` expects arrivals, 3.5 rows and its error to either side.
///
/// A first pass, as [`RollingSweep::foreseen`] has it, finds the range in which light arrives. Each frame with an edge
/// on the light shows the common offset to within the jitter; take about 130 of them.
///
/// # Errors
/// Those of [`Nominal::check`].
pub fn arrival_settings(
    columns: &Columns,
    rolling: &RollingSweep,
    nominal: &Nominal,
    delays: usize,
) -> Result<Vec<BoardSetting>, PlaneError> {
    nominal.check()?;
    let row_us = nominal.row_time_us;
    let exposure_us = ARRIVAL_ROWS * row_us;
    let margin_us = ARRIVAL_MARGIN_ROWS * row_us + rolling.error_us();
    let (first_us, last_us) = arrivals_range_us(columns, rolling);
    let step_us = (last_us - first_us + 2.0 * margin_us) / (delays.max(2) - 1) as f64;
    let first_us = first_us - exposure_us / 2.0 - margin_us;
    Ok((0..delays)
        .map(|step| first_us + step as f64 * step_us)
        .map(|delay_us| BoardSetting { shutter: ExposureMode::Rolling, delay_us, exposure_us })
        .collect())
}

/// The rolling settings that check the length of longer exposures: 600 and 1200 us, 6 delays each with the opening and
/// with the closing edge on the light.
///
/// # Errors
/// Those of [`Nominal::check`].
pub fn check_settings(
    columns: &Columns,
    rolling: &RollingSweep,
    nominal: &Nominal,
) -> Result<Vec<BoardSetting>, PlaneError> {
    nominal.check()?;
    let (first_us, last_us) = arrivals_range_us(columns, rolling);
    let edge_us = |step: usize| first_us + (last_us - first_us) * (step as f64 + 0.5) / CHECK_DELAYS as f64;
    let settings = CHECK_EXPOSURES_US.iter().flat_map(|&exposure_us| {
        (0..CHECK_DELAYS).flat_map(move |step| {
            [edge_us(step), edge_us(step) - exposure_us].map(|delay_us| BoardSetting {
                shutter: ExposureMode::Rolling,
                delay_us,
                exposure_us,
            })
        })
    });
    Ok(settings.collect())
}

/// First and last time at which light arrives, counted from the start of each camera row.
fn arrivals_range_us(columns: &Columns, rolling: &RollingSweep) -> (f64, f64) {
    let cells = (0..columns.rows()).flat_map(|row| (0..columns.groups()).map(move |group| (row, group)));
    cells
        .map(|(row, group)| (row, columns.cell(row, group)))
        .filter(|(_, cell)| cell.pixels > 0)
        .map(|(row, cell)| rolling.time_us(row, cell.place + 0.5))
        .fold((f64::MAX, f64::MIN), |(first, last), time| (first.min(time), last.max(time)))
}
