mod checks;
mod covariance;
mod normal;

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::super::super::NoiseModel;
use super::super::super::error::check_shape;
use super::super::Estimate;
use super::coarse::{Arrivals, CoarseSweep, arrivals, clocks};
use super::columns::Columns;
use super::error::TimesError;
use super::model::{BoardSamples, Clocks, ExposureEdge, FrameComparison, Sweep};
use super::result::{Dropped, FrameJitter, Residual, RowTimes};
use super::settings::{BoardFrame, ExposureMode, Nominal};
use super::table::SplineTable;
use normal::{FrameNormal, Normal, Sparse, add_third_differences};

/// What each frame's light may be late, before it is measured.
const JITTER_PRIOR_US: f64 = 8.0;
/// How far coefficients may be from their start, which only matters where no light is seen.
const COEFFICIENT_PRIOR_US: f64 = 30.0;
/// Weight of the squares of third differences of coefficients, per square microsecond.
const SMOOTHNESS: f64 = 0.003;
/// Largest step of a coefficient or of a frame's jitter.
const STEP_US: f64 = 8.0;
/// Shorter steps end the fit. The standard deviations are those of independent residuals, several times smaller than the
/// stated ones.
const CONVERGED_SDS: f64 = 0.07;
const MAX_STEPS: usize = 20;
/// Frames whose share in the normal equations is summed on one core. The same on every machine, as are the sums.
const FRAMES_TOGETHER: usize = 16;
/// The parts of a row's time that a spot is first taken to need to pass a group of columns: steps would be lost among the
/// moments at which a narrow one passes.
const BLURS: [f64; 3] = [0.25, 0.125, 0.0625];
/// Smallest jitter; smaller ones cannot be told from the noise.
const LEAST_JITTER_US: f64 = 0.05;
/// What single exposures may differ from the others, while it is fixed and while it is fitted.
const FIXED_US: f64 = 1e-4;
const FREE_US: f64 = 20.0;

impl RowTimes {
    /// Fits the times of rows to single frames of the board. `noise` is that of a single pixel, in shares of white.
    ///
    /// # Errors
    /// Any [`TimesError`] but [`TimesError::Direction`]; [`TimesError::Misfit`] if rows are not lit as `columns` has it.
    pub fn fit(
        columns: &Columns,
        frames: &[BoardFrame],
        nominal: &Nominal,
        noise: NoiseModel,
    ) -> Result<Self, TimesError> {
        noise.check()?;
        let expected = [columns.rows(), columns.groups()];
        for frame in frames {
            check_shape("light of a frame", "[row, group]", frame.light.shape(), &expected)?;
        }
        let coarse = CoarseSweep::from_borders(columns, frames, nominal)?;
        let arrivals = arrivals(columns, frames)?;
        let blurred = BLURS.map(|dwell| columns.blurred(dwell));
        let mut fit = Fit::start(columns, frames, nominal, noise, &coarse, &arrivals)?;
        for blurred in blurred.iter().flatten().chain([columns]) {
            fit.columns = blurred;
            fit.scan_jitters();
            fit.steps(3, false)?;
        }
        fit.scan_jitters();
        fit.steps(MAX_STEPS, false)?;
        fit.drop_outliers();
        fit.steps(MAX_STEPS, false)?;
        let jitter_us = fit.check_jitter()?;
        let residuals = fit.check_residuals()?;
        fit.check_order()?;
        // From now on, samples and jitters weigh as much as they have turned out to scatter.
        fit.jitter_prior_us = jitter_us.value.max(LEAST_JITTER_US);
        fit.variance_scale = fit.chi2_per_sample();
        fit.steps(MAX_STEPS, false)?;
        fit.check_exposures()?;
        fit.result(jitter_us, residuals)
    }
}

/// A joint fit of the table, the clocks and the jitter of each frame, by Gauss-Newton steps.
///
/// Unknowns are the table's coefficients, then the camera's row time, the offset of the global mode, what exposures
/// have more than nominal, and what each exposure other than the shortest rolling one has more than that.
#[derive(Clone)]
struct Fit<'a> {
    columns: &'a Columns,
    frames: &'a [BoardFrame],
    nominal: &'a Nominal,
    noise: NoiseModel,
    table: SplineTable,
    /// Different exposures; the first is that of the arrivals.
    exposures_us: Vec<f64>,
    start: Vec<f64>,
    unknowns: Vec<f64>,
    late_us: Vec<f64>,
    /// Inverse variance of each frame's jitter from its own light.
    jitter_weight: Vec<f64>,
    dropped: Vec<Option<Dropped>>,
    jitter_prior_us: f64,
    variance_scale: f64,
}

impl<'a> Fit<'a> {
    fn start(
        columns: &'a Columns,
        frames: &'a [BoardFrame],
        nominal: &'a Nominal,
        noise: NoiseModel,
        coarse: &CoarseSweep,
        arrivals: &Arrivals,
    ) -> Result<Self, TimesError> {
        let points = arrivals.points(columns);
        let (camera_row_us, later_us) = clocks(coarse, &points);
        let clocks = [camera_row_us, later_us, arrivals.exposure_offset_us];
        let table = SplineTable::new(nominal.projector_rows, &columns.seen_rows());
        // The table through the arrivals; where there are none, through the sweep seen by global frames.
        let count = table.coefficients;
        let mut matrix = DMatrix::zeros(count, count);
        let mut right = DVector::zeros(count);
        let mut add = |row: f64, time_us: f64, weight: f64| {
            let weights = DVector::from_vec(table.weights_at(row));
            matrix.ger(weight, &weights, &weights, 1.0);
            right.axpy(weight * time_us, &weights, 1.0);
        };
        points.iter().for_each(|&(row, place, time_us)| add(place, time_us + row * camera_row_us, 1.0));
        for row in columns.seen_rows() {
            add(row as f64, coarse.time_us(row as f64) + clocks[1], 1e-3);
        }
        add_third_differences(&mut matrix, &mut right, None, SMOOTHNESS);
        let coefficients = matrix.cholesky().ok_or(TimesError::Undetermined)?.solve(&right);
        let mut exposures_us = vec![arrivals.exposure_us];
        for frame in frames {
            if !exposures_us.contains(&frame.setting.exposure_us) {
                exposures_us.push(frame.setting.exposure_us);
            }
        }
        let mut unknowns: Vec<f64> = coefficients.iter().copied().chain(clocks).collect();
        unknowns.resize(count + 2 + exposures_us.len(), 0.0);
        Ok(Self {
            columns,
            frames,
            nominal,
            noise,
            table,
            exposures_us,
            start: coefficients.as_slice().to_vec(),
            unknowns,
            late_us: vec![0.0; frames.len()],
            jitter_weight: vec![0.0; frames.len()],
            dropped: vec![None; frames.len()],
            jitter_prior_us: JITTER_PRIOR_US,
            variance_scale: 1.0,
        })
    }

    fn coefficients(&self) -> &[f64] {
        &self.unknowns[..self.table.coefficients]
    }

    fn starts_us(&self) -> Vec<f64> {
        self.table.starts_us(self.coefficients(), self.nominal.period_us)
    }

    fn sweep(&self) -> Sweep {
        Sweep::new(self.starts_us(), self.nominal.period_us)
    }

    fn comparison<'b>(&'b self, sweep: &'b Sweep) -> FrameComparison<'b> {
        let clocks = &self.unknowns[self.table.coefficients..];
        let clocks =
            Clocks { camera_row_us: clocks[0], mode_offset_us: clocks[1], exposure_offset_us: clocks[2] };
        let (columns, noise, variance_scale) = (self.columns, self.noise, self.variance_scale);
        FrameComparison { columns, sweep, clocks, noise, variance_scale }
    }

    /// The unknown that says what a frame's exposure has more than that of the arrivals, unless it is the same.
    fn own_exposure(&self, frame: usize) -> Option<usize> {
        let exposure_us = self.frames[frame].setting.exposure_us;
        let index = self.exposures_us.iter().position(|&other_us| other_us == exposure_us);
        index.filter(|&index| index > 0).map(|index| self.table.coefficients + 2 + index)
    }

    fn longer_us(&self, frame: usize) -> f64 {
        self.own_exposure(frame).map_or(0.0, |unknown| self.unknowns[unknown])
    }

    fn used(&self) -> impl Iterator<Item = usize> {
        (0..self.frames.len()).filter(|&frame| self.dropped[frame].is_none())
    }

    /// Finds the jitter of each frame alone: the best of equally spaced values, then a few steps.
    fn scan_jitters(&mut self) {
        let sweep = self.sweep();
        let comparison = self.comparison(&sweep);
        let alone = |frame: usize| {
            let longer_us = self.longer_us(frame);
            comparison.lateness_us(&self.frames[frame], longer_us, self.jitter_prior_us).value
        };
        let used: Vec<usize> = self.used().collect();
        let late_us: Vec<(usize, f64)> = used.into_par_iter().map(|frame| (frame, alone(frame))).collect();
        late_us.into_iter().for_each(|(frame, late_us)| self.late_us[frame] = late_us);
    }

    /// Derivatives of the times of a frame's opening and closing edge.
    fn edges(&self, frame: usize, row: usize, opening: &ExposureEdge, closing: &ExposureEdge) -> [Sparse; 2] {
        let coefficients = self.table.coefficients;
        let mut edges = [opening, closing].map(|place| {
            let mut edge = Sparse::default();
            edge.add_table(&self.table, place);
            match self.frames[frame].setting.shutter {
                ExposureMode::Rolling => edge.push(coefficients, row as f64),
                ExposureMode::Global => edge.push(coefficients + 1, 1.0),
            }
            edge
        });
        edges[1].push(coefficients + 2, 1.0);
        if let Some(unknown) = self.own_exposure(frame) {
            edges[1].push(unknown, 1.0);
        }
        edges
    }

    /// The normal equations at the present values. `free` frees the differences between exposures.
    fn normal(&self, free: bool) -> Normal {
        let sweep = self.sweep();
        let comparison = self.comparison(&sweep);
        let count = self.unknowns.len();
        let of_frames = |used: &[usize]| {
            let mut normal = Normal {
                matrix: DMatrix::zeros(count, count),
                right: DVector::zeros(count),
                frames: Vec::new(),
            };
            for &frame in used {
                let prior = self.jitter_prior_us.powi(-2);
                let mut own = FrameNormal {
                    frame,
                    mixed: DVector::zeros(count),
                    weight: prior,
                    right: -self.late_us[frame] * prior,
                };
                let late = (self.late_us[frame], self.longer_us(frame));
                comparison.visit(
                    &self.frames[frame],
                    late,
                    BoardSamples::OnEdges,
                    |row, opening, closing, sums| {
                        let edges = self.edges(frame, row, opening, closing);
                        own.add(&edges, sums, &mut normal.matrix, &mut normal.right);
                    },
                );
                normal.matrix.ger(-own.weight.recip(), &own.mixed, &own.mixed, 1.0);
                normal.right.axpy(-own.right / own.weight, &own.mixed, 1.0);
                normal.frames.push(own);
            }
            normal
        };
        let used: Vec<usize> = self.used().collect();
        let parts: Vec<Normal> = used.par_chunks(FRAMES_TOGETHER).map(of_frames).collect();
        let (mut matrix, mut right) = (DMatrix::zeros(count, count), DVector::zeros(count));
        let mut frames = Vec::new();
        for part in parts {
            matrix += part.matrix;
            right += part.right;
            frames.extend(part.frames);
        }
        self.add_priors(&mut matrix, &mut right, free);
        Normal { matrix, right, frames }
    }

    fn add_priors(&self, matrix: &mut DMatrix<f64>, right: &mut DVector<f64>, free: bool) {
        let coefficients = self.table.coefficients;
        for index in 0..coefficients {
            let weight = COEFFICIENT_PRIOR_US.powi(-2);
            matrix[(index, index)] += weight;
            right[index] += weight * (self.start[index] - self.unknowns[index]);
        }
        add_third_differences(matrix, right, Some(self.coefficients()), SMOOTHNESS);
        let weight = if free { FREE_US } else { FIXED_US }.powi(-2);
        for index in coefficients + 3..self.unknowns.len() {
            matrix[(index, index)] += weight;
            right[index] -= weight * self.unknowns[index];
        }
    }

    /// Joint steps until they are short, at most `limit`.
    fn steps(&mut self, limit: usize, free: bool) -> Result<(), TimesError> {
        let (mut part, mut last) = (1.0, None::<(DVector<f64>, f64)>);
        for _ in 0..limit {
            let Normal { matrix, right, frames } = self.normal(free);
            let mut step = matrix.cholesky().ok_or(TimesError::Undetermined)?.solve(&right);
            if step.iter().any(|step| !step.is_finite()) {
                return Err(TimesError::Undetermined);
            }
            // The root of the Newton decrement: no unknown, and no sum of them, moves by more of its standard deviations.
            let length_sds = right.dot(&step).sqrt();
            let mut coefficients = step.rows_mut(0, self.table.coefficients);
            // Derivatives jump where an edge passes from row to row, and whole steps may lead to and fro across one.
            let is_whole = coefficients.amax() < STEP_US;
            let turns =
                |(last, last_sds): &(DVector<f64>, f64)| right.dot(last) < 0.0 && length_sds > last_sds / 2.0;
            if is_whole && last.as_ref().is_some_and(turns) {
                part /= 2.0;
            }
            coefficients.apply(|step| *step = step.clamp(-STEP_US, STEP_US));
            self.unknowns.iter_mut().zip(&step).for_each(|(unknown, step)| *unknown += part * step);
            for FrameNormal { frame, mixed, weight, right } in &frames {
                let late_us = (right - mixed.dot(&step)) / weight;
                self.late_us[*frame] += part * late_us.clamp(-STEP_US, STEP_US);
                self.jitter_weight[*frame] = weight - self.jitter_prior_us.powi(-2);
            }
            if part * length_sds < CONVERGED_SDS {
                break;
            }
            last = Some((step, length_sds));
        }
        Ok(())
    }

    /// The frames of a shutter mode that are used, with their jitters.
    fn jitters_of(&self, shutter: ExposureMode) -> Vec<(usize, f64)> {
        self.used()
            .filter(|&frame| self.frames[frame].setting.shutter == shutter)
            .map(|frame| (frame, self.late_us[frame]))
            .collect()
    }

    fn result(&self, jitter_us: Estimate, residuals: Vec<Residual>) -> Result<RowTimes, TimesError> {
        let covariance = self.covariance(false)?;
        let coefficients = self.table.coefficients;
        let seen_rows = self.columns.seen_rows();
        let unknown = |index: usize| {
            let mut weights = DVector::zeros(self.unknowns.len());
            weights[index] = 1.0;
            weights
        };
        let start_of = |row: f64| {
            let mut weights = DVector::zeros(self.unknowns.len());
            weights.rows_mut(0, coefficients).copy_from_slice(&self.table.weights_at(row));
            weights
        };
        let (first, end) = (seen_rows.start as f64, seen_rows.end as f64);
        let row_time = (start_of(end) - start_of(first)) / (end - first);
        let (camera_row, mode, exposure) =
            (unknown(coefficients), unknown(coefficients + 1), unknown(coefficients + 2));
        let lit: Vec<usize> =
            (0..self.columns.rows()).filter(|&row| self.columns.row_place(row).is_some()).collect();
        let middle = lit[lit.len() / 2];
        let place = self.columns.row_place(middle).unwrap_or(first);
        let latency = start_of(place + 0.5) - &camera_row * middle as f64;
        let values = DVector::from_column_slice(&self.unknowns);
        let measured = |weights: &DVector<f64>| Estimate {
            value: weights.dot(&values),
            sd: weights.dot(&(&covariance * weights)).sqrt(),
        };
        let quantities = [&latency, &exposure, &camera_row, &row_time];
        let products = quantities.map(|a| quantities.map(|b| a.dot(&(&covariance * b))));
        let (row_starts_modes, row_starts_sd_us) = self.modes(&covariance)?;
        let late_us = |shutter| {
            let jitters = self.jitters_of(shutter);
            jitters.iter().map(|jitter| jitter.1).sum::<f64>() / jitters.len() as f64
        };
        let means_us = (late_us(ExposureMode::Global), late_us(ExposureMode::Rolling));
        let jitter = |frame: usize| {
            let mean_us = match self.frames[frame].setting.shutter {
                ExposureMode::Global => means_us.0,
                ExposureMode::Rolling => means_us.1,
            };
            self.dropped[frame].is_none().then(|| FrameJitter {
                late_us: self.late_us[frame] - mean_us,
                sd_us: self.jitter_weight[frame].sqrt().recip(),
            })
        };
        Ok(RowTimes {
            row_starts_us: self.starts_us(),
            row_starts_sd_us,
            row_starts_modes,
            row_time_us: measured(&row_time),
            camera_row_time_us: measured(&camera_row),
            exposure_offset_us: measured(&exposure),
            mode_offset_us: measured(&mode),
            latency_sd_us: measured(&latency).sd,
            covariance: products,
            jitter_us,
            jitters: (0..self.frames.len()).map(jitter).collect(),
            useful_frames: self.jitters_of(ExposureMode::Rolling).len(),
            residuals,
            dropped: self
                .dropped
                .iter()
                .enumerate()
                .filter_map(|(frame, dropped)| Some((frame, (*dropped)?)))
                .collect(),
            seen_rows,
        })
    }
}
