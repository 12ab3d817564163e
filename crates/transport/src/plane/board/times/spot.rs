use ndarray::Array2;

use super::super::super::error::check_shape;
use super::super::Estimate;
use super::coarse::CoarseSweep;
use super::columns::Columns;
use super::error::TimesError;
use super::settings::BoardFrame;

/// How far a row's light arrives later at the right side of the projector's image than at the left, in row times.
///
/// Rows that are lit evenly have slopes of 0 and 0, a spot that draws all rows in one direction 1 and 1, and one that
/// returns on odd rows 1 and -1.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SpotSlopes {
    /// Slope of even rows.
    pub even: Estimate,
    /// Slope of odd rows.
    pub odd: Estimate,
}

/// Smallest share of the projector's width.
const MIN_SPAN: f64 = 0.2;
/// Camera rows whose errors are taken as common.
const BLOCK_ROWS: usize = 21;

/// The slopes of even and odd rows, from rolling frames of pictures with the even and with the odd rows white, with the
/// delays of the arrivals. Light is a share of white with all rows. `projector_columns` is the map of projector columns
/// (0 to 1), averaged by [`Columns::average`].
///
/// The jitter of frames adds errors of a few hundredths for a whole raster, and of up to 0.2 for a window of 128 rows,
/// all of which see the same frames; the standard deviations do not contain the latter.
///
/// # Errors
/// [`TimesError::Narrow`]; [`super::super::super::PlaneError::Shape`] for arrays that were averaged otherwise.
pub fn spot_slopes(
    columns: &Columns,
    coarse: &CoarseSweep,
    projector_columns: &Array2<f32>,
    even: &[BoardFrame],
    odd: &[BoardFrame],
) -> Result<SpotSlopes, TimesError> {
    let expected = [columns.rows(), columns.groups()];
    check_shape("projector_columns", "[row, group]", projector_columns.shape(), &expected)?;
    for frame in even.iter().chain(odd) {
        check_shape("light of a frame", "[row, group]", frame.light.shape(), &expected)?;
    }
    let slope = |frames, parity| slope(columns, coarse, projector_columns, frames, parity);
    Ok(SpotSlopes { even: slope(even, 0)?, odd: slope(odd, 1)? })
}

/// A group of columns in a camera row, relative to the mean of the row.
struct Point {
    row: usize,
    column: f64,
    late_us: f64,
    weight: f64,
}

impl Point {
    /// Weighted product of the column and another quantity.
    fn moment(&self, quantity: f64) -> f64 {
        self.weight * self.column * quantity
    }
}

fn slope(
    columns: &Columns,
    coarse: &CoarseSweep,
    projector_columns: &Array2<f32>,
    frames: &[BoardFrame],
    parity: usize,
) -> Result<Estimate, TimesError> {
    let mut frames: Vec<&BoardFrame> = frames.iter().collect();
    frames.sort_by(|a, b| a.setting.delay_us.total_cmp(&b.setting.delay_us));
    // Deviations from their means over each camera row, so that neither the jitter of frames nor an error of the sweep
    // enters where all columns see the light of the same frames.
    let mut points: Vec<Point> = Vec::new();
    let (mut left, mut right) = (f64::MAX, f64::MIN);
    for row in 0..columns.rows() {
        let cells: Vec<(f64, f64, f64)> = (0..columns.groups())
            .filter_map(|group| {
                let column = f64::from(projector_columns[[row, group]]);
                let (late_us, weight) = lateness_us(columns, coarse, &frames, parity, (row, group))?;
                Some((column, late_us, weight))
            })
            .collect();
        let sum: f64 = cells.iter().map(|cell| cell.2).sum();
        let column: f64 = cells.iter().map(|cell| cell.0 * cell.2).sum::<f64>() / sum;
        let late_us: f64 = cells.iter().map(|cell| cell.1 * cell.2).sum::<f64>() / sum;
        for cell in cells {
            (left, right) = (left.min(cell.0), right.max(cell.0));
            points.push(Point { row, column: cell.0 - column, late_us: cell.1 - late_us, weight: cell.2 });
        }
    }
    let span = (right - left).max(0.0);
    if span < MIN_SPAN {
        return Err(TimesError::Narrow { span_percent: span * 100.0, needed_percent: MIN_SPAN * 100.0 });
    }
    let square: f64 = points.iter().map(|point| point.moment(point.column)).sum();
    let slope_us = points.iter().map(|point| point.moment(point.late_us)).sum::<f64>() / square;
    // Camera rows near each other have the errors of the same frames.
    let scatter: f64 = points
        .chunk_by(|a, b| a.row / BLOCK_ROWS == b.row / BLOCK_ROWS)
        .map(|block| block.iter().map(|point| point.moment(point.late_us - slope_us * point.column)).sum())
        .map(|sum: f64| sum * sum)
        .sum();
    let seen = columns.seen_rows();
    let (first, end) = (seen.start as f64, seen.end as f64);
    let row_us = (coarse.time_us(end) - coarse.time_us(first)) / (end - first);
    Ok(Estimate { value: slope_us / row_us, sd: scatter.sqrt() / square / row_us })
}

/// How much later the light of one parity arrives in a cell than sweep and response say, apart from a constant of each
/// camera row, and the cell's light.
fn lateness_us(
    columns: &Columns,
    coarse: &CoarseSweep,
    frames: &[&BoardFrame],
    parity: usize,
    (row, group): (usize, usize),
) -> Option<(f64, f64)> {
    let cell = columns.cell(row, group);
    if cell.pixels == 0 {
        return None;
    }
    let near = (cell.place as usize).saturating_sub(12)..cell.place as usize + 13;
    let (mut share, mut expected_us) = (0.0, 0.0);
    for drawn in near.filter(|drawn| drawn % 2 == parity) {
        let (_, light) = columns.light_before(row, group, drawn as f64 + 0.5);
        share += light;
        expected_us += light * coarse.time_us(drawn as f64 + 0.5);
    }
    let (mut sum, mut moment_us) = (0.0, 0.0);
    for (index, frame) in frames.iter().enumerate() {
        let next_us = frames[(index + 1).min(frames.len() - 1)].setting.delay_us;
        let step_us = next_us - frames[index.saturating_sub(1)].setting.delay_us;
        let light = f64::from(frame.light[[row, group]]) * step_us;
        sum += light;
        moment_us += light * (frame.setting.delay_us + frame.setting.exposure_us / 2.0);
    }
    (share > 0.2 && sum > 0.0).then(|| (moment_us / sum - expected_us / share, share))
}
