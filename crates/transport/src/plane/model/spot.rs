use ndarray::{Array2, ArrayView1, s};

use super::super::PlaneError;
use super::super::error::check_shape;
use super::{FIRST_RESPONSE_ROW, RESPONSE_ROWS, RowTiming, Setting};

/// The direction in which a flying spot draws its rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Scan {
    /// Every row starting at column 0.
    OneWay,
    /// Even rows of the projector starting at column 0, odd rows in the opposite direction.
    Bidirectional,
}

/// A flying spot with a known path over the scene.
#[derive(Debug, Clone, PartialEq)]
pub struct FlyingSpot {
    /// The direction of its rows.
    pub scan: Scan,
    /// The projector column that each pixel sees, `[t, s]`, in 0..=1 over the projector's width; one row stands for
    /// all. NaN where it is unknown.
    pub columns: Array2<f32>,
}

/// Rows that send less of a pixel's direct light may be cut by the edge of an exposure.
const LEAST_SHARE: f32 = 0.02;
/// Number of distinguished parts of the projector's width; more would cost more time than they reduce the error.
const SPOT_PARTS: usize = 64;

impl FlyingSpot {
    /// Checks that the columns are those of an image with this number of rows and columns.
    ///
    /// # Errors
    /// [`PlaneError::Shape`]; [`PlaneError::OutOfRange`] for a column outside 0..=1.
    pub(in super::super) fn check(&self, (rows, columns): (usize, usize)) -> Result<(), PlaneError> {
        let rows = if self.columns.nrows() == 1 { 1 } else { rows };
        check_shape("columns of the spot", "[camera rows, columns]", self.columns.shape(), &[rows, columns])?;
        match self.columns.iter().find(|column| !(column.is_nan() || (0.0..=1.0).contains(*column))) {
            Some(&value) => {
                let allowed = "from 0 to 1: divide the projector's column by its width";
                Err(PlaneError::OutOfRange { field: "columns", value: value.into(), allowed })
            }
            None => Ok(()),
        }
    }

    /// The projector column that pixel `[t, s]` sees; NaN if it is unknown.
    pub(in super::super) fn column(&self, t: usize, s: usize) -> f64 {
        f64::from(self.columns[[t.min(self.columns.nrows() - 1), s]])
    }

    /// The part of the projector's width that pixel `[t, s]` sees.
    pub(in super::super) fn part(&self, t: usize, s: usize) -> usize {
        ((self.column(t, s) * SPOT_PARTS as f64) as usize).min(SPOT_PARTS - 1)
    }

    /// Weights of direct light in each setting for the pixels of camera row `t` that see each part, if they differ
    /// from `even`, those of an evenly lit row.
    pub(in super::super) fn weights(
        &self,
        timing: &RowTiming,
        settings: &[Setting],
        t: usize,
        even: ArrayView1<f64>,
    ) -> Result<Vec<Option<Vec<f64>>>, PlaneError> {
        let of_part = |part: usize| {
            let column = (part as f64 + 0.5) / SPOT_PARTS as f64;
            let weights = spike_weights(timing, settings, t, column, self.scan)?;
            let differ = weights.iter().zip(&even).any(|(a, b)| (a - b).abs() > 1e-9);
            Ok(differ.then_some(weights))
        };
        (0..SPOT_PARTS).map(of_part).collect()
    }
}

/// When a row is drawn, relative to a delay of 0 of a camera row.
struct DrawnRow {
    start_us: f64,
    dwell_us: f64,
}

impl DrawnRow {
    /// Row `v` of the projector, relative to camera row `t`.
    fn at(timing: &RowTiming, t: usize, v: usize) -> Self {
        let (late_us, next_late_us) = (timing.late_us(v), timing.late_us(v + 1));
        let row_time_us = timing.row_time_us();
        let from_own = v as f64 - timing.camera().own_row(t) as f64;
        Self {
            start_us: (from_own - 0.5) * row_time_us + late_us - timing.exposure_shift_us(t),
            dwell_us: row_time_us + (next_late_us - late_us),
        }
    }

    /// The rows that send at least [`LEAST_SHARE`] of the direct light of some pixel of camera row `t`.
    fn all(timing: &RowTiming, t: usize) -> Vec<Self> {
        let Some(response) = timing.response() else {
            return vec![Self::at(timing, t, timing.camera().own_row(t))];
        };
        let (_, columns) = response.size();
        let (first, last) = response
            .own_rows(t, columns)
            .fold((i64::MAX, i64::MIN), |(first, last), own_row| (first.min(own_row), last.max(own_row)));
        let mut sends = vec![false; (last - first) as usize + RESPONSE_ROWS];
        let shares = response.shares();
        for (d, shares) in shares.slice(s![.., t, ..]).rows().into_iter().enumerate() {
            for (own_row, &share) in response.own_rows(t, columns).zip(shares) {
                sends[(own_row - first) as usize + d] |= share >= LEAST_SHARE;
            }
        }
        let first = first + i64::from(FIRST_RESPONSE_ROW);
        let lit = (first..).zip(sends).filter_map(|(row, sends)| usize::try_from(row).ok().filter(|_| sends));
        lit.filter(|v| *v < timing.projector_rows()).map(|v| Self::at(timing, t, v)).collect()
    }
}

/// Settings that a flying spot makes unreliable if a pixel's projector column is unknown: those with an edge within
/// half a row time plus half the jitter of the centre of the direct row of any camera row, where the spot may or may
/// not have passed. With a measured response, all rows that send 2 % of some pixel's direct light are direct rows.
/// Indices in ascending order.
///
/// With a projector that lights its rows uniformly, no settings need to be dropped.
///
/// # Errors
/// Those of [`RowTiming::check`]; [`PlaneError::OutOfRange`] if the jitter is negative or not finite.
pub fn settings_on_direct_row(
    timing: &RowTiming,
    settings: &[Setting],
    jitter_us: f64,
) -> Result<Vec<usize>, PlaneError> {
    timing.check(settings)?;
    if !(jitter_us.is_finite() && jitter_us >= 0.0) {
        let allowed = "finite and not negative: give the spread of the measured delays, in microseconds";
        return Err(PlaneError::OutOfRange { field: "jitter_us", value: jitter_us, allowed });
    }
    let rows: Vec<DrawnRow> = (0..timing.camera_rows()).flat_map(|t| DrawnRow::all(timing, t)).collect();
    let period_us = timing.period_us();
    let is_on = |row: &DrawnRow, edge_us: f64| {
        // The direct row is drawn again in each period, and long exposures reach it.
        let from_centre_us = edge_us - row.start_us - row.dwell_us / 2.0;
        let distance_us = (from_centre_us - period_us * (from_centre_us / period_us).round()).abs();
        distance_us < (row.dwell_us + jitter_us) / 2.0
    };
    let on_row = |setting: &Setting| {
        let half_us = setting.exposure_us / 2.0;
        setting.delays_us.iter().any(|delay_us| {
            [delay_us - half_us, delay_us + half_us]
                .iter()
                .any(|&edge_us| rows.iter().any(|row| is_on(row, edge_us)))
        })
    };
    Ok((0..settings.len()).filter(|&n| on_row(&settings[n])).collect())
}

/// Weight of the direct light of a pixel in camera row `t` in each setting, for a flying spot: the share of the
/// averaged frames whose exposure contains the moment when the spot passes the pixel's projector column, counted once
/// per period. It replaces the column of `A` at `u = 0`.
///
/// `projector_column` is the column that the pixel sees, in 0..1 over the projector's width. Direct light arrives
/// after this share of its row's dwell, or as long before the row's end if the row is drawn backwards.
///
/// # Errors
/// Those of [`RowTiming::check`]; [`PlaneError::OutOfRange`] for a column outside 0..=1.
pub fn spike_weights(
    timing: &RowTiming,
    settings: &[Setting],
    t: usize,
    projector_column: f64,
    scan: Scan,
) -> Result<Vec<f64>, PlaneError> {
    timing.check(settings)?;
    if !(0.0..=1.0).contains(&projector_column) {
        let allowed = "from 0 to 1: divide the projector's column by its width";
        return Err(PlaneError::OutOfRange { field: "projector_column", value: projector_column, allowed });
    }
    let own_row = timing.camera().own_row(t);
    let backwards = scan == Scan::Bidirectional && own_row % 2 == 1;
    let column = if backwards { 1.0 - projector_column } else { projector_column };
    let row = DrawnRow::at(timing, t, own_row);
    let moment_us = row.start_us + row.dwell_us * column;
    let weight = |setting: &Setting| {
        let passes = setting.delays_us.iter().map(|delay_us| {
            // The moments are a period apart: count those after the start, minus those after the end.
            let periods_to = |edge_us: f64| ((edge_us - moment_us) / timing.period_us()).ceil();
            periods_to(delay_us + setting.exposure_us / 2.0)
                - periods_to(delay_us - setting.exposure_us / 2.0)
        });
        passes.sum::<f64>() / setting.delays_us.len() as f64
    };
    Ok(settings.iter().map(weight).collect())
}

#[cfg(test)]
mod tests {
    use super::super::{CameraRows, PixelResponse};
    use super::*;

    fn timing() -> RowTiming {
        RowTiming::new(128, 20.0, 16_000.0).unwrap()
    }

    #[test]
    fn edges_on_the_row_are_found() {
        let settings = [
            Setting::new(300.0, 600.0),  // starts at 0
            Setting::new(-309.0, 600.0), // ends at -9
            Setting::new(311.0, 600.0),  // starts at 11: only with jitter
            Setting::new(0.0, 600.0),    // contains the whole row
            Setting::new(600.0, 600.0),  // starts after it
            Setting::new(0.0, 32_000.0), // ends one period later, on the row of the next frame
            Setting { delays_us: vec![320.0, 330.0, 305.0], exposure_us: 600.0 },
        ];
        assert_eq!(settings_on_direct_row(&timing(), &settings, 0.0), Ok(vec![0, 1, 5, 6]));
        assert_eq!(settings_on_direct_row(&timing(), &settings, 4.0), Ok(vec![0, 1, 2, 5, 6]));
        assert!(settings_on_direct_row(&timing(), &settings, f64::NAN).is_err());
    }

    #[test]
    fn the_spot_passes_at_its_column() {
        // Column 0.75 is passed 5 us after the row's centre, or before it where the row is drawn backwards.
        let settings = [
            Setting::new(304.0, 600.0), // from 4 us on
            Setting::new(306.0, 600.0), // from 6 us on
            Setting::new(294.0, 600.0), // from -6 us on
            Setting { delays_us: vec![304.0, 304.5, 306.0, 290.0], exposure_us: 600.0 },
            Setting::new(0.0, 48_000.0), // three periods
        ];
        let weights = |t, scan| spike_weights(&timing(), &settings, t, 0.75, scan).unwrap();
        assert_eq!(weights(0, Scan::OneWay), [1.0, 0.0, 1.0, 0.75, 3.0]);
        assert_eq!(weights(1, Scan::OneWay), weights(0, Scan::OneWay));
        assert_eq!(weights(0, Scan::Bidirectional), weights(0, Scan::OneWay));
        assert_eq!(weights(1, Scan::Bidirectional), [0.0, 0.0, 1.0, 0.25, 3.0]);
        assert!(spike_weights(&timing(), &settings, 0, 1.5, Scan::OneWay).is_err());
    }

    #[test]
    fn a_measured_table_and_a_slower_camera_move_the_spot() {
        // Row 10 begins 7 us late and lasts 26 us; camera row 10 begins 10 * 0.5 us after the projector's row 10.
        let mut starts_us: Vec<f64> = (0..=128).map(|v| f64::from(v) * 20.0).collect();
        (starts_us[10], starts_us[11]) = (207.0, 233.0);
        let camera = CameraRows { first_row: 0, rows: 128, pitch: 1.0, row_time_us: 20.5 };
        let timing = timing().with_row_table(&starts_us).unwrap().with_camera(camera).unwrap();
        // Nominally the row is drawn from -10 to 10 us; here from -10 + 7 - 5 = -8 to 18 us: column 0.75 at 11.5 us.
        let settings = [310.0, 313.0].map(|delay_us| Setting::new(delay_us, 600.0));
        assert_eq!(spike_weights(&timing, &settings, 10, 0.75, Scan::OneWay), Ok(vec![1.0, 0.0]));
        assert_eq!(spike_weights(&timing, &settings, 10, 0.9, Scan::OneWay), Ok(vec![1.0, 1.0]));
        // An edge at 15 us cuts this row, and no other: their rows are drawn from -10 - t / 2 to 10 - t / 2 us.
        let cut = [315.0, 319.0].map(|delay_us| Setting::new(delay_us, 600.0));
        assert_eq!(settings_on_direct_row(&timing, &cut, 0.0), Ok(vec![0]));
    }

    #[test]
    fn averaged_over_all_columns_it_is_the_uniform_rows_weight() {
        let settings: Vec<Setting> =
            (-40..40).map(|step| Setting::new(300.0 + f64::from(step), 600.0)).collect();
        let columns = 1000;
        let mut mean = vec![0.0; settings.len()];
        for column in 0..columns {
            let column = (f64::from(column) + 0.5) / f64::from(columns);
            let weights = spike_weights(&timing(), &settings, 7, column, Scan::Bidirectional).unwrap();
            mean.iter_mut().zip(weights).for_each(|(mean, weight)| *mean += weight / f64::from(columns));
        }
        for (mean, setting) in mean.iter().zip(&settings) {
            assert!((mean - timing().weights(7, setting)[7]).abs() < 1e-3);
        }
    }

    #[test]
    fn all_rows_that_light_a_pixel_directly_are_cut() {
        // Camera row 7 sees row 8 by a half, 9 and 10 by a quarter each.
        let mut shares = [0.0; RESPONSE_ROWS];
        (shares[6], shares[7], shares[8]) = (0.5, 0.25, 0.25);
        let places = Array2::from_shape_fn((128, 1), |(t, _)| t as f32 + 2.0);
        let response = PixelResponse::with_beam(places, &shares).unwrap();
        let timing = timing().with_response(response).unwrap();
        let settings: Vec<Setting> =
            (-60..100).map(|step| Setting::new(300.0 + f64::from(step), 600.0)).collect();
        // They are drawn from 10 to 70 us after the middle of row 7; exposures between two of them cut none.
        let opening = |us: i32| (us + 60) as usize;
        let expected: Vec<usize> = (11..70).filter(|us| ![30, 50].contains(us)).map(opening).collect();
        assert_eq!(settings_on_direct_row(&timing, &settings, 0.0), Ok(expected));
    }
}
