use nalgebra::{Matrix4, Vector4};

use super::columns::Columns;
use super::error::TimesError;
use super::settings::{BoardFrame, ExposureMode, Nominal};

/// The sweep as global frames see it, to within 10 us: a cubic through the borders between dark and light.
///
/// Its times are those of exposures with a global shutter, which differ from those of rolling exposures by a constant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CoarseSweep {
    nominal: Nominal,
    /// Middle and half width of the rows that the borders cover.
    middle_row: f64,
    half_rows: f64,
    /// Lateness against the nominal time as a polynomial over -1..1.
    late_us: Vector4<f64>,
    error_us: f64,
}

/// Smallest number of borders.
const MIN_BORDERS: usize = 12;
/// Rows at the ends of the raster in which borders are not used.
const END_ROWS: f64 = 12.0;
/// Errors beyond this count less.
const BORDER_SCATTER_US: f64 = 10.0;
/// Borders beyond this error are not those of the sweep.
const BORDER_ERROR_US: f64 = 150.0;
/// How much the coefficients may differ from a nominal sweep, which keeps a fit to few rows from oscillating.
const PRIOR_US: [f64; 4] = [1e4, 1e4, 500.0, 200.0];
/// Error of a measured sweep, and how far the shutter modes may be apart.
const MEASURED_ERROR_US: f64 = 20.0;
/// How far the camera's row time may be from its nominal value, as a share of it.
const CAMERA_ROW_ERROR: f64 = 0.04;

impl CoarseSweep {
    /// A sweep of which only the nominal numbers are known.
    pub fn nominal(nominal: &Nominal) -> Self {
        Self {
            nominal: *nominal,
            middle_row: 0.0,
            half_rows: 1.0,
            late_us: Vector4::zeros(),
            error_us: nominal.error_us(),
        }
    }

    /// The sweep from the global frames among `frames`.
    ///
    /// # Errors
    /// Those of [`Nominal::check`]; [`TimesError::TooFewBorders`].
    pub fn from_borders(
        columns: &Columns,
        frames: &[BoardFrame],
        nominal: &Nominal,
    ) -> Result<Self, TimesError> {
        nominal.check()?;
        let global = || frames.iter().filter(|frame| frame.setting.shutter == ExposureMode::Global);
        let points: Vec<(f64, f64)> = global().flat_map(|frame| borders(columns, frame, nominal)).collect();
        let few = |borders: &[(f64, f64)]| {
            let (first, last) = ends(borders);
            let covered = (last - first).max(0.0) / columns.seen_rows().len() as f64;
            (borders.len() < MIN_BORDERS || covered < 0.5).then(|| TimesError::TooFewBorders {
                borders: borders.len(),
                needed: MIN_BORDERS,
                frames: global().count(),
                covered_percent: covered * 100.0,
            })
        };
        if let Some(error) = few(&points) {
            return Err(error);
        }
        let (first, last) = ends(&points);
        let (middle_row, half_rows) = ((first + last) / 2.0, (last - first) / 2.0);
        let mut coarse =
            Self { middle_row, half_rows, error_us: MEASURED_ERROR_US, ..Self::nominal(nominal) };
        // Some rounds of reweighting are enough for a few outliers.
        for _ in 0..20 {
            let mut normal = Matrix4::from_diagonal(&Vector4::from(PRIOR_US).map(|sd| sd.powi(-2)));
            let mut right = Vector4::zeros();
            for &(row, time_us) in &points {
                let powers = coarse.powers(row);
                let late_us = time_us - nominal.start_us(row);
                let error_us = late_us - coarse.late_us.dot(&powers);
                let weight = 1.0 / (BORDER_SCATTER_US * error_us.abs().max(BORDER_SCATTER_US));
                normal += powers * powers.transpose() * weight;
                right += powers * late_us * weight;
            }
            let solution = normal.cholesky().ok_or(TimesError::Undetermined)?.solve(&right);
            coarse.late_us = solution;
        }
        // Borders that a delay does not move lie anywhere.
        let on_sweep = |&(row, time_us): &(f64, f64)| (coarse.time_us(row) - time_us).abs() < BORDER_ERROR_US;
        few(&points.iter().copied().filter(on_sweep).collect::<Vec<_>>()).map_or(Ok(coarse), Err)
    }

    /// When a row, or a fraction of it, begins to be lit, as counted by frames with a global shutter.
    pub fn time_us(&self, row: f64) -> f64 {
        // Beyond the borders, the sweep continues with its outermost slope.
        let inside = row.clamp(self.middle_row - self.half_rows, self.middle_row + self.half_rows);
        let x = (inside - self.middle_row) / self.half_rows;
        let slope = Vector4::new(0.0, 1.0, 2.0 * x, 3.0 * x * x).dot(&self.late_us) / self.half_rows;
        self.nominal.start_us(row) + self.late_us.dot(&self.powers(inside)) + slope * (row - inside)
    }

    fn powers(&self, row: f64) -> Vector4<f64> {
        let x = (row - self.middle_row) / self.half_rows;
        Vector4::new(1.0, x, x * x, x * x * x)
    }
}

/// The sweep as rolling frames see it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RollingSweep {
    coarse: CoarseSweep,
    camera_row_time_us: f64,
    /// By how much later light comes to rolling frames than to global ones.
    later_us: f64,
    error_us: f64,
}

impl RollingSweep {
    /// What global frames tell, before any rolling frame is seen; `camera_rows` are those of the image.
    pub fn foreseen(coarse: &CoarseSweep, nominal: &Nominal, camera_rows: usize) -> Self {
        let image_us = camera_rows as f64 * nominal.camera_row_time_us;
        Self {
            coarse: *coarse,
            camera_row_time_us: nominal.camera_row_time_us,
            later_us: 0.0,
            error_us: coarse.error_us + CAMERA_ROW_ERROR * image_us,
        }
    }

    /// What a first pass of short rolling frames over all delays of [`Self::foreseen`] tells.
    ///
    /// # Errors
    /// [`TimesError::TooFewDelays`], [`TimesError::ArrivalsCut`], [`TimesError::Undetermined`].
    pub fn from_arrivals(
        columns: &Columns,
        frames: &[BoardFrame],
        coarse: &CoarseSweep,
    ) -> Result<Self, TimesError> {
        let points = arrivals(columns, frames)?.points(columns);
        let (camera_row_time_us, later_us) = clocks(coarse, &points);
        if !(camera_row_time_us.is_finite() && later_us.is_finite()) {
            return Err(TimesError::Undetermined);
        }
        Ok(Self { coarse: *coarse, camera_row_time_us, later_us, error_us: MEASURED_ERROR_US })
    }

    /// When light arrives at a place of drawing, counted from the start of a camera row.
    pub(super) fn time_us(&self, camera_row: usize, place: f64) -> f64 {
        self.coarse.time_us(place) + self.later_us - camera_row as f64 * self.camera_row_time_us
    }

    /// How far light may be from [`Self::time_us`].
    pub(super) fn error_us(&self) -> f64 {
        self.error_us
    }
}

/// The camera's row time, and by how much later light comes to rolling frames, from camera rows, their places and their
/// arrivals. Sweep minus arrival = rows * camera row time - lateness.
pub(super) fn clocks(coarse: &CoarseSweep, points: &[(f64, f64, f64)]) -> (f64, f64) {
    let lines: Vec<(f64, f64)> =
        points.iter().map(|&(row, place, time_us)| (row, coarse.time_us(place) - time_us)).collect();
    let (camera_row_us, at_row_0_us) = line(&lines);
    (camera_row_us, -at_row_0_us)
}

/// First and last row of some borders.
fn ends(borders: &[(f64, f64)]) -> (f64, f64) {
    let rows = || borders.iter().map(|border| border.0);
    (rows().fold(f64::MAX, f64::min), rows().fold(f64::MIN, f64::max))
}

/// Places of the opening and closing border of a global frame, with their times. A place is that of drawing: half a
/// row below the centre of the response that is half lit.
fn borders(columns: &Columns, frame: &BoardFrame, nominal: &Nominal) -> Vec<(f64, f64)> {
    let opening_us = frame.setting.delay_us;
    let edges = [(true, opening_us), (false, opening_us + frame.setting.exposure_us)];
    let border = |(opening, time_us): (bool, f64)| {
        let mut rows: Vec<f64> =
            (0..columns.groups()).filter_map(|group| crossing(columns, frame, group, opening)).collect();
        // A border of the light runs through the whole image.
        if rows.len() * 2 < columns.groups() {
            return None;
        }
        let row = median(&mut rows) + 0.5;
        let inside = row >= END_ROWS && row <= nominal.projector_rows as f64 - END_ROWS;
        // The border may belong to the light of another period.
        let periods = ((time_us - nominal.start_us(row)) / nominal.period_us).round();
        inside.then_some((row, time_us - periods * nominal.period_us))
    };
    edges.into_iter().filter_map(border).collect()
}

/// The place at which a group's light, smoothed over three rows, crosses one half upwards (`opening`) or downwards, if
/// there is exactly one.
fn crossing(columns: &Columns, frame: &BoardFrame, group: usize, opening: bool) -> Option<f64> {
    let lit: Vec<usize> = (0..columns.rows()).filter(|&row| columns.cell(row, group).pixels > 0).collect();
    let smooth = |rows: &[usize]| {
        let sum: f64 = rows.iter().map(|&row| f64::from(frame.light[[row, group]])).sum();
        (columns.cell(rows[1], group).place, sum / 3.0 - 0.5)
    };
    let mut found = None;
    for rows in lit.windows(4) {
        let ((place, above), (next_place, below)) = (smooth(&rows[..3]), smooth(&rows[1..]));
        let crosses = if opening { above < 0.0 && below >= 0.0 } else { above >= 0.0 && below < 0.0 };
        if crosses {
            if found.is_some() {
                return None;
            }
            found = Some(place + (next_place - place) * above / (above - below));
        }
    }
    found
}

/// When the light of each camera row arrives, from short rolling exposures.
#[derive(Debug)]
pub(super) struct Arrivals {
    /// Exposure of the frames.
    pub exposure_us: f64,
    /// What exposures have more than their nominal length.
    pub exposure_offset_us: f64,
    /// Centre of each camera row's light, counted from the trigger edge plus the row's own start; `None` if the row is
    /// unlit, or its arrival is not covered.
    pub times_us: Vec<Option<f64>>,
}

impl Arrivals {
    /// Camera rows with their places of drawing and their arrivals.
    pub fn points(&self, columns: &Columns) -> Vec<(f64, f64, f64)> {
        (0..columns.rows())
            .filter_map(|row| Some((row as f64, columns.row_place(row)? + 0.5, self.times_us[row]?)))
            .collect()
    }
}

const MIN_DELAYS: usize = 4;
/// Light at the first or the last delay that tells that an arrival is cut.
const CUT_LIGHT: f64 = 0.1;

/// When the light of each camera row arrives: the centroid of its light over the delays of the shortest rolling
/// exposure.
pub(super) fn arrivals(columns: &Columns, frames: &[BoardFrame]) -> Result<Arrivals, TimesError> {
    let rolling = || frames.iter().filter(|frame| frame.setting.shutter == ExposureMode::Rolling);
    let exposure_us = rolling().map(|frame| frame.setting.exposure_us).fold(f64::MAX, f64::min);
    let mut short: Vec<&BoardFrame> =
        rolling().filter(|frame| frame.setting.exposure_us == exposure_us).collect();
    short.sort_by(|a, b| a.setting.delay_us.total_cmp(&b.setting.delay_us));
    let delays: Vec<&[&BoardFrame]> =
        short.chunk_by(|a, b| b.setting.delay_us - a.setting.delay_us < 0.01).collect();
    if delays.len() < MIN_DELAYS {
        return Err(TimesError::TooFewDelays { delays: delays.len(), needed: MIN_DELAYS });
    }
    let delay_us = |index: usize| delays[index][0].setting.delay_us;
    let last = delays.len() - 1;
    // Rule of trapezoids.
    let step_us = |index: usize| (delay_us((index + 1).min(last)) - delay_us(index.saturating_sub(1))) / 2.0;
    let (mut early, mut late, mut seen) = (0, 0, 0);
    let mut excess_us = Vec::new();
    let mut times_us = Vec::new();
    for row in 0..columns.rows() {
        if columns.row_place(row).is_none() {
            times_us.push(None);
            continue;
        }
        let light: Vec<f64> = delays
            .iter()
            .map(|frames| {
                let sum: f64 = frames.iter().map(|frame| columns.row_mean(&frame.light, row)).sum();
                sum / frames.len() as f64
            })
            .collect();
        let (cut_early, cut_late) = (light[0] > CUT_LIGHT, light[last] > CUT_LIGHT);
        let moments = light.iter().enumerate().map(|(index, light)| {
            let weight = light * step_us(index);
            (weight, weight * (delay_us(index) + exposure_us / 2.0))
        });
        let (sum, moment) = moments.fold((0.0, 0.0), |sums, terms| (sums.0 + terms.0, sums.1 + terms.1));
        let whole = !cut_early && !cut_late && sum > exposure_us / 2.0;
        (seen, early, late) = (seen + 1, early + usize::from(cut_early), late + usize::from(cut_late));
        times_us.push(whole.then(|| {
            excess_us.push(sum - exposure_us);
            moment / sum
        }));
    }
    if excess_us.len() * 2 < seen {
        return Err(TimesError::ArrivalsCut {
            exposure_us,
            from_us: delay_us(0),
            to_us: delay_us(last),
            rows: excess_us.len(),
            seen,
            early,
            late,
        });
    }
    let exposure_offset_us = median(&mut excess_us);
    times_us.iter_mut().flatten().for_each(|time_us| *time_us += exposure_offset_us / 2.0);
    Ok(Arrivals { exposure_us, exposure_offset_us, times_us })
}

/// Slope, and value at 0, of a line through points; robust against outliers.
fn line(points: &[(f64, f64)]) -> (f64, f64) {
    let mut fitted = (0.0, 0.0);
    let mut scatter = f64::MAX;
    for _ in 0..10 {
        let mut sums = [0.0; 5];
        for &(x, y) in points {
            let away = (y - fitted.0 * x - fitted.1).abs();
            let weight = if away > 3.0 * scatter { 0.0 } else { 1.0 };
            let terms = [weight, weight * x, weight * y, weight * x * x, weight * x * y];
            sums.iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
        }
        let [n, x, y, xx, xy] = sums;
        let slope = (n * xy - x * y) / (n * xx - x * x);
        fitted = (slope, (y - slope * x) / n);
        let mut away: Vec<f64> = points.iter().map(|&(x, y)| (y - fitted.0 * x - fitted.1).abs()).collect();
        scatter = 1.4826 * median(&mut away) + 1e-9;
    }
    fitted
}

/// The middle value; 0 without values.
pub(super) fn median(values: &mut [f64]) -> f64 {
    values.sort_by(f64::total_cmp);
    match values.len() {
        0 => 0.0,
        count => (values[(count - 1) / 2] + values[count / 2]) / 2.0,
    }
}
