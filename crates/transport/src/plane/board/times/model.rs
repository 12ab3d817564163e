use std::ops::Range;

use super::super::super::NoiseModel;
use super::super::Estimate;
use super::columns::Columns;
use super::settings::{BoardFrame, ExposureMode};

/// Variance of a share of light that the model does not explain: brightness of single rows, errors of responses.
const MODEL_VARIANCE: f64 = 0.006 * 0.006;
/// Residuals beyond this many standard deviations count less.
const ROBUST_SDS: f64 = 4.0;
/// Shortest dwell of a row in a table that folds back while it is being fitted, as a share of the mean.
const LEAST_DWELL: f64 = 0.02;

/// First range of the search for a frame's jitter, the one used if the best value lies at its end, and its step.
const SCAN_US: [f64; 2] = [40.0, 160.0];
const SCAN_STEP_US: f64 = 4.0;
/// Only every fourth camera row is compared in the search.
const SCAN_ROWS: usize = 4;
/// Largest step towards the best value.
const LATENESS_STEP_US: f64 = 8.0;

/// Times that all frames share, besides the table.
#[derive(Debug, Clone, Copy)]
pub(super) struct Clocks {
    pub camera_row_us: f64,
    pub mode_offset_us: f64,
    pub exposure_offset_us: f64,
}

/// A table of row starts, repeated every period, in which edges are looked up.
#[derive(Debug, Clone)]
pub(super) struct Sweep {
    starts_us: Vec<f64>,
    period_us: f64,
}

/// Where the drawing stands at an edge of an exposure.
#[derive(Debug, Clone, Copy)]
pub(super) struct ExposureEdge {
    /// The row being drawn, and the fraction of it that has been drawn.
    pub row: usize,
    pub fraction: f64,
    /// Rows drawn per microsecond; 0 while nothing is drawn.
    rows_per_us: f64,
    /// Whole periods drawn before.
    periods: f64,
}

/// Sums over the samples of a camera row in one frame, for the normal equations. Derivatives are those to the times of
/// the opening edge (which takes light away) and the closing edge.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Sums {
    pub chi2: f64,
    pub samples: f64,
    pub opening_square: f64,
    pub mixed: f64,
    pub closing_square: f64,
    pub opening_residual: f64,
    pub closing_residual: f64,
    /// What residuals of 1 would add to those.
    pub opening: f64,
    pub closing: f64,
}

/// Which samples of a frame are compared.
#[derive(Debug, Clone, Copy)]
pub(super) enum BoardSamples {
    /// Those that an edge meets.
    OnEdges,
    /// All of every so many camera rows.
    EveryRow(usize),
}

impl ExposureEdge {
    /// Rows drawn, with the fraction.
    pub fn drawn(&self) -> f64 {
        self.row as f64 + self.fraction
    }
}

impl Sweep {
    pub fn new(mut starts_us: Vec<f64>, period_us: f64) -> Self {
        let rows = starts_us.len() - 1;
        let least_us = LEAST_DWELL * (starts_us[rows] - starts_us[0]).max(0.0) / rows as f64 + 1e-9;
        for row in 0..rows {
            starts_us[row + 1] = starts_us[row + 1].max(starts_us[row] + least_us);
        }
        Self { starts_us, period_us }
    }

    /// The edge at a time. `near` is a row at which to begin the search.
    fn edge(&self, time_us: f64, near: usize) -> ExposureEdge {
        let rows = self.starts_us.len() - 1;
        let periods = ((time_us - self.starts_us[0]) / self.period_us).floor();
        let time_us = time_us - periods * self.period_us;
        if time_us >= self.starts_us[rows] {
            return ExposureEdge { row: rows - 1, fraction: 1.0, rows_per_us: 0.0, periods };
        }
        let mut row = near.min(rows - 1);
        while row > 0 && self.starts_us[row] > time_us {
            row -= 1;
        }
        while row + 1 < rows && self.starts_us[row + 1] <= time_us {
            row += 1;
        }
        let rows_per_us = (self.starts_us[row + 1] - self.starts_us[row]).recip();
        ExposureEdge { row, fraction: (time_us - self.starts_us[row]) * rows_per_us, rows_per_us, periods }
    }
}

/// Compares frames with the light that a sweep sends.
pub(super) struct FrameComparison<'a> {
    pub columns: &'a Columns,
    pub sweep: &'a Sweep,
    pub clocks: Clocks,
    pub noise: NoiseModel,
    /// Factor on the variances of samples.
    pub variance_scale: f64,
}

impl FrameComparison<'_> {
    /// How late the light of a frame is whose exposure is `longer_us` longer than that of other frames: the best of
    /// equally spaced values, then a few steps. Before it is measured, it is 0 with the standard deviation `prior_us`.
    pub fn lateness_us(&self, frame: &BoardFrame, longer_us: f64, prior_us: f64) -> Estimate {
        let prior = prior_us.powi(-2);
        let objective = |late_us: f64| {
            let mut chi2 = late_us * late_us * prior;
            self.visit(frame, (late_us, longer_us), BoardSamples::EveryRow(SCAN_ROWS), |_, _, _, sums| {
                chi2 += sums.chi2;
            });
            chi2
        };
        let mut best_us = 0.0;
        for range_us in SCAN_US {
            let steps = (range_us / SCAN_STEP_US) as i32;
            let values = (-steps..=steps).map(|step| f64::from(step) * SCAN_STEP_US);
            let best = values
                .map(|late_us| (late_us, objective(late_us)))
                .fold((0.0, f64::MAX), |best, value| if value.1 < best.1 { value } else { best });
            best_us = best.0;
            if best_us.abs() < range_us - SCAN_STEP_US / 2.0 {
                break;
            }
        }
        let step = |late_us: f64| {
            let (mut weight, mut right) = (prior, -late_us * prior);
            self.visit(frame, (late_us, longer_us), BoardSamples::OnEdges, |_, _, _, sums| {
                weight += sums.opening_square - 2.0 * sums.mixed + sums.closing_square;
                right += sums.opening_residual - sums.closing_residual;
            });
            (weight, right)
        };
        for _ in 0..4 {
            let (weight, right) = step(best_us);
            best_us += (right / weight).clamp(-LATENESS_STEP_US, LATENESS_STEP_US);
        }
        let (weight, _) = step(best_us);
        Estimate { value: best_us, sd: weight.sqrt().recip() }
    }

    /// Visits the camera rows of a frame whose light is late by `late_us` and whose exposure is `longer_us`
    /// longer than that of other frames.
    pub fn visit(
        &self,
        frame: &BoardFrame,
        (late_us, longer_us): (f64, f64),
        samples: BoardSamples,
        mut visitor: impl FnMut(usize, &ExposureEdge, &ExposureEdge, &Sums),
    ) {
        let (step, everywhere) = match samples {
            BoardSamples::OnEdges => (1, false),
            BoardSamples::EveryRow(step) => (step, true),
        };
        let setting = frame.setting;
        let exposure_us = setting.exposure_us + self.clocks.exposure_offset_us + longer_us;
        let (mut opening, mut closing) = (self.sweep.edge(-late_us, 0), self.sweep.edge(-late_us, 0));
        for row in (0..self.columns.rows()).step_by(step) {
            let starts_us = match setting.shutter {
                ExposureMode::Global => self.clocks.mode_offset_us,
                ExposureMode::Rolling => row as f64 * self.clocks.camera_row_us,
            };
            let from_us = setting.delay_us + starts_us - late_us;
            opening = self.sweep.edge(from_us, opening.row);
            closing = self.sweep.edge(from_us + exposure_us, closing.row);
            let reached =
                |edge: &ExposureEdge| edge.rows_per_us > 0.0 && self.columns.reached(row, edge.drawn());
            if !everywhere && !reached(&opening) && !reached(&closing) {
                continue;
            }
            let groups = 0..self.columns.groups();
            let sums = self.compare(frame, row, groups, (&opening, &closing), everywhere);
            if sums.samples > 0.0 {
                visitor(row, &opening, &closing, &sums);
            }
        }
    }

    /// Compares some groups of a camera row.
    pub fn compare(
        &self,
        frame: &BoardFrame,
        row: usize,
        groups: Range<usize>,
        (opening, closing): (&ExposureEdge, &ExposureEdge),
        everywhere: bool,
    ) -> Sums {
        let mut sums = Sums::default();
        let (opening_row, closing_row) = (opening.drawn(), closing.drawn());
        for group in groups {
            let pixels = self.columns.cell(row, group).pixels;
            if pixels == 0 {
                continue;
            }
            let before = self.columns.light_before(row, group, opening_row);
            let until = self.columns.light_before(row, group, closing_row);
            let (a, b) = (before.sending * opening.rows_per_us, until.sending * closing.rows_per_us);
            if !everywhere && a == 0.0 && b == 0.0 {
                continue;
            }
            let light = until.sent - before.sent + closing.periods - opening.periods;
            let step_variance = before.sd * before.sd + until.sd * until.sd;
            let residual = f64::from(frame.light[[row, group]]) - light;
            let noise = self.noise.variance(light, pixels);
            let variance = (noise + MODEL_VARIANCE + step_variance) * self.variance_scale;
            let chi2 = residual * residual / variance;
            let weight = (ROBUST_SDS / chi2.sqrt().max(ROBUST_SDS)) / variance;
            sums.chi2 += chi2;
            sums.samples += 1.0;
            sums.opening_square += weight * a * a;
            sums.mixed += weight * a * b;
            sums.closing_square += weight * b * b;
            sums.opening_residual += weight * a * residual;
            sums.closing_residual += weight * b * residual;
            sums.opening += weight * a;
            sums.closing += weight * b;
        }
        sums
    }
}
