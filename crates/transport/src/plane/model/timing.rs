use std::cmp::Ordering::Less;
use std::sync::Arc;

use ndarray::{Array1, Array2, ArrayView2};

use super::super::PlaneError;
use super::super::error::check_shape;
use super::response::{PLACE_STEPS, ResponseClass, collected_rows};
use super::{Beam, PixelResponse, Setting};

/// When each projector row is lit, how its light spreads, and which projector rows the camera's rows see.
///
/// Nominally, each row is lit for `row_time_us`, one after the other, once per VSYNC period. The rest of the period
/// is the retrace, in which nothing is lit. [`Self::with_row_table`] sets the real times. A row emits the same light
/// whatever its dwell, evenly over it: `T` is the light of one whole row.
///
/// Camera row `t` lies on the epipolar plane of the projector position `first_row + pitch t`, and its exposure begins
/// `row_time_us` of the camera after that of row `t - 1`. Relative rows count from the projector row nearest to that
/// position. Delays refer to camera row 0 and the nominal raster: centre of its exposure minus nominal centre of row
/// `first_row`. If the camera's row time is `pitch` times the projector's, this is the delay of every row relative to
/// its own position. Otherwise the delay drifts by the difference from row to row, and the weights follow.
///
/// A scene with fewer rows than the projector is a window in the middle of its frame.
#[derive(Debug, Clone, PartialEq)]
pub struct RowTiming {
    row_time_us: f64,
    period_us: f64,
    /// Row `v` is lit from entry `v` to entry `v + 1`, relative to the nominal start of row 0.
    row_starts_us: Arc<[f64]>,
    camera: CameraRows,
    beam: Beam,
    response: Response,
}

/// How pixels respond to the rows drawn around their own.
#[derive(Debug, Clone, PartialEq)]
enum Response {
    /// As the beam spreads each row; every pixel looks at the middle of its own row.
    Beam,
    /// The same, but camera rows look between projector rows.
    BetweenRows(Arc<PixelResponse>),
    /// As measured.
    Measured(Arc<PixelResponse>),
}

/// Which positions of the projector the camera's rows see, and when they are exposed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraRows {
    /// Projector row on whose epipolar plane camera row 0 lies.
    pub first_row: usize,
    /// Number of camera rows.
    pub rows: usize,
    /// Projector rows from one camera row to the next.
    pub pitch: f64,
    /// Time from the start of one camera row's exposure to the start of the next row's.
    pub row_time_us: f64,
}

impl CameraRows {
    /// Position, in projector rows, on whose epipolar plane camera row `t` lies. It is between two rows if the pitch
    /// is not an integer.
    pub fn place(&self, t: usize) -> f64 {
        self.first_row as f64 + self.pitch * t as f64
    }

    /// The projector row nearest to [`Self::place`], from which relative rows count; of two equally near rows, the
    /// lower on the screen.
    pub fn own_row(&self, t: usize) -> usize {
        self.place(t).round() as usize
    }
}

impl RowTiming {
    /// A projector of `projector_rows` rows of `row_time_us` every `period_us`, seen by the same number of camera
    /// rows.
    ///
    /// # Errors
    /// [`PlaneError::OutOfRange`] for a row time that is not positive, or rows that do not fit into the period;
    /// [`PlaneError::Window`] for a projector without rows.
    pub fn new(projector_rows: usize, row_time_us: f64, period_us: f64) -> Result<Self, PlaneError> {
        if !(row_time_us.is_finite() && row_time_us > 0.0) {
            return Err(PlaneError::OutOfRange {
                field: "row_time_us",
                value: row_time_us,
                allowed: "positive: calibrate it as the slope of lit lines over exposure",
            });
        }
        // If rows end at the period to within rounding, the retrace is zero.
        let lit_us = projector_rows as f64 * row_time_us;
        if !(period_us.is_finite() && period_us >= lit_us * (1.0 - 1e-9)) {
            return Err(PlaneError::OutOfRange {
                field: "period_us",
                value: period_us,
                allowed: "at least the projector's rows times row_time_us: check both against the VSYNC rate",
            });
        }
        let row_starts_us = (0..=projector_rows).map(|v| v as f64 * row_time_us).collect();
        let camera = CameraRows { first_row: 0, rows: projector_rows, pitch: 1.0, row_time_us };
        Self { row_time_us, period_us, row_starts_us, camera, beam: Beam::Ideal, response: Response::Beam }
            .with_camera(camera)
    }

    /// The same projector with each row `v` lit from `starts_us[v]` to `starts_us[v + 1]`, relative to the nominal
    /// start of row 0. The camera, and with it the delays, still refer to the nominal raster.
    ///
    /// # Errors
    /// [`PlaneError::OutOfRange`] for a table that does not have exactly one entry more than the projector has rows,
    /// is not strictly increasing, or begins or lasts longer than a VSYNC period.
    pub fn with_row_table(self, starts_us: &[f64]) -> Result<Self, PlaneError> {
        let refused = |value, allowed| Err(PlaneError::OutOfRange { field: "row_table", value, allowed });
        if starts_us.len() != self.projector_rows() + 1 {
            let allowed = "as many entries as the projector has rows, and one more for the end of the last";
            return refused(starts_us.len() as f64, allowed);
        }
        let falling = starts_us.windows(2).find(|pair| pair[0].partial_cmp(&pair[1]) != Some(Less));
        if let Some(&[_, start_us]) = falling {
            return refused(
                start_us,
                "finite, and later than the entry before: rows are lit one after the other",
            );
        }
        let (start_us, end_us) = (starts_us[0], starts_us[starts_us.len() - 1]);
        if start_us.abs() >= self.period_us || end_us - start_us > self.period_us * (1.0 + 1e-9) {
            return refused(end_us, "in microseconds, with all rows within one VSYNC period");
        }
        Ok(Self { row_starts_us: starts_us.into(), ..self })
    }

    /// The same projector with a beam that spreads its rows.
    ///
    /// # Errors
    /// Those of [`Beam::check`].
    pub fn with_beam(self, beam: Beam) -> Result<Self, PlaneError> {
        beam.check()?;
        Self { beam, ..self }.between_rows()
    }

    /// The same projector, seen by pixels whose places and responses were measured. They replace the beam, and the
    /// camera's rows serve to count delays only.
    ///
    /// # Errors
    /// [`PlaneError::Shape`] if the response does not have the camera's rows.
    pub fn with_response(self, response: PixelResponse) -> Result<Self, PlaneError> {
        let (rows, _) = response.size();
        check_shape("response", "[camera rows]", &[rows], &[self.camera.rows])?;
        Ok(Self { response: Response::Measured(Arc::new(response)), ..self })
    }

    /// The response that follows from the beam, if the camera's rows look between projector rows. Wider beams than a
    /// response can hold are left as they are: they blur what lies between rows.
    fn between_rows(self) -> Result<Self, PlaneError> {
        let camera = self.camera;
        let is_between = (0..camera.rows).any(|t| camera.place(t).fract() != 0.0);
        let response = match (self.response, self.beam.shares().filter(|_| is_between)) {
            (Response::Measured(response), _) => Response::Measured(response),
            (_, Some(shares)) => {
                let places = Array2::from_shape_fn((camera.rows, 1), |(t, _)| camera.place(t) as f32);
                Response::BetweenRows(Arc::new(PixelResponse::with_beam(places, &shares)?))
            }
            (_, None) => Response::Beam,
        };
        Ok(Self { response, ..self })
    }

    /// The same projector, seen by `camera`.
    ///
    /// # Errors
    /// [`PlaneError::OutOfRange`] for a pitch or a row time that is not positive; [`PlaneError::Window`] if there are
    /// no camera rows, or they extend beyond the projector; [`PlaneError::Shape`] if a response was measured with other
    /// camera rows.
    pub fn with_camera(self, camera: CameraRows) -> Result<Self, PlaneError> {
        for (field, value) in [("row_pitch", camera.pitch), ("camera row_time_us", camera.row_time_us)] {
            if !(value.is_finite() && value > 0.0) {
                let allowed =
                    "positive: 1 and the projector's row time for rectified rows of the same height";
                return Err(PlaneError::OutOfRange { field, value, allowed });
            }
        }
        let projector_rows = self.projector_rows();
        let end = camera
            .rows
            .checked_sub(1)
            .map_or(camera.first_row, |last| camera.own_row(last).saturating_add(1));
        if camera.rows == 0 || end > projector_rows {
            return Err(PlaneError::Window { first_row: camera.first_row, end, projector_rows });
        }
        if let Some(measured) = self.measured_response() {
            check_shape("response", "[camera rows]", &[measured.size().0], &[camera.rows])?;
        }
        Self { camera, ..self }.between_rows()
    }

    /// The same projector, seen by `camera_rows` rows with the projector's pitch and row time, starting at projector
    /// row `first_row`.
    ///
    /// # Errors
    /// [`PlaneError::Window`] if the window is empty or extends beyond the projector.
    pub fn window(self, first_row: usize, camera_rows: usize) -> Result<Self, PlaneError> {
        let row_time_us = self.row_time_us;
        self.with_camera(CameraRows { first_row, rows: camera_rows, pitch: 1.0, row_time_us })
    }

    /// The same projector, seen by `camera_rows` rows in the middle of its frame.
    ///
    /// # Errors
    /// [`PlaneError::Window`] if there are no camera rows, or more than projector rows.
    pub fn centred(self, camera_rows: usize) -> Result<Self, PlaneError> {
        let first_row = self.projector_rows().saturating_sub(camera_rows) / 2;
        self.window(first_row, camera_rows)
    }

    /// Number of projector rows.
    pub fn projector_rows(&self) -> usize {
        self.row_starts_us.len() - 1
    }

    /// Nominal time per projector row (`tau`), which is also the time a row is lit (`t_p`) without a row table.
    pub fn row_time_us(&self) -> f64 {
        self.row_time_us
    }

    /// Time from one VSYNC edge to the next; not necessarily an integer number of row times.
    pub fn period_us(&self) -> f64 {
        self.period_us
    }

    /// Start of each row's light and end of the last row's, relative to the nominal start of row 0,
    /// `[projector_rows + 1]`.
    pub fn row_starts_us(&self) -> &[f64] {
        &self.row_starts_us
    }

    /// The spread of the projector's light over rows.
    pub fn beam(&self) -> Beam {
        self.beam
    }

    /// Where each pixel looks and how it responds, if that was measured, or if the camera's rows look between projector
    /// rows.
    pub fn response(&self) -> Option<&PixelResponse> {
        match &self.response {
            Response::Beam => None,
            Response::BetweenRows(response) | Response::Measured(response) => Some(response),
        }
    }

    /// The same timing for pixels whose direct light lies `u0_rows[t, s]` rows below their own row, if the camera's
    /// rows look between projector rows; `None` if they do not.
    pub(in super::super) fn displaced(&self, u0_rows: ArrayView2<f32>) -> Result<Option<Self>, PlaneError> {
        let Response::BetweenRows(response) = &self.response else { return Ok(None) };
        let Some(shares) = self.beam.shares() else { return Ok(None) };
        check_shape("u0_rows", "[camera rows]", &[u0_rows.nrows()], &[response.places().nrows()])?;
        let displaced = PixelResponse::with_beam(&response.places() + &u0_rows, &shares)?;
        Ok(Some(Self { response: Response::BetweenRows(Arc::new(displaced)), ..self.clone() }))
    }

    /// [`Self::weights`] of the pixels of camera row `t`: one entry for all, unless they have responses.
    pub(super) fn pixel_weights(
        &self,
        t: usize,
        columns: usize,
        setting: &Setting,
    ) -> Vec<(Vec<f64>, Vec<usize>)> {
        let Some(response) = self.response() else {
            return vec![(self.weights(t, setting), (0..columns).collect())];
        };
        let drawn = Array1::from(self.drawn(t, setting));
        let weights = |class: ResponseClass| {
            (collected_rows(drawn.view(), &class.shares, 0, drawn.len()).to_vec(), class.columns)
        };
        response.classes(t, 0..columns, PLACE_STEPS).into_iter().map(weights).collect()
    }

    /// The weights of the pixel in the middle of camera row `t`, `[projector_rows]`, and its own row.
    pub(in super::super) fn typical_weights(&self, t: usize, setting: &Setting) -> (Vec<f64>, usize) {
        let columns = self.response().map_or(1, |response| response.size().1);
        let own_row = self.response().and_then(|response| response.own_rows(t, columns).nth(columns / 2));
        let own_row = own_row.map_or(self.camera.own_row(t), |row| row.max(0) as usize);
        let mut by_class = self.pixel_weights(t, columns, setting);
        by_class.retain(|(_, alike)| alike.contains(&(columns / 2)));
        let weights = by_class.pop().map_or_else(|| self.weights(t, setting), |(weights, _)| weights);
        (weights, own_row.min(self.projector_rows() - 1))
    }

    /// The response, if it was measured.
    pub fn measured_response(&self) -> Option<&PixelResponse> {
        match &self.response {
            Response::Measured(response) => Some(response),
            Response::Beam | Response::BetweenRows(_) => None,
        }
    }

    /// Checks that a stack has as many columns as the measured response, if there is one.
    pub(in super::super) fn check_columns(&self, columns: usize) -> Result<(), PlaneError> {
        self.measured_response().map_or(Ok(()), |response| {
            check_shape("stack", "[columns of the response]", &[columns], &[response.size().1])
        })
    }

    /// Which positions of the projector the camera's rows see, and when they are exposed.
    pub fn camera(&self) -> CameraRows {
        self.camera
    }

    /// Projector row on the epipolar plane of camera row 0.
    pub fn first_row(&self) -> usize {
        self.camera.first_row
    }

    /// Number of rows in the camera's window.
    pub fn camera_rows(&self) -> usize {
        self.camera.rows
    }

    /// Relative row of projector row `v` as seen from camera row `t`: `v` minus the row nearest to the camera row's
    /// position.
    pub fn relative_row(&self, v: usize, t: usize) -> i32 {
        v as i32 - self.camera.own_row(t) as i32
    }

    /// Whether relative row `u` of camera row `t` exists in the projector.
    pub fn row_exists(&self, u: i32, t: usize) -> bool {
        let v = i64::from(u) + self.camera.own_row(t) as i64;
        (0..self.projector_rows() as i64).contains(&v)
    }

    /// The light that camera row `t` collects from each projector row with a setting: one row of `A' = A B`,
    /// `[projector_rows]`.
    ///
    /// `A` is the share of the row's dwell that falls inside the exposure, averaged over the delays of the setting: a
    /// box with fractional ends. An exposure that extends over the retrace also collects light of the neighbouring
    /// VSYNC periods; shares exceed 1 only if it is longer than a period and sees the row more than once. `B` is the
    /// beam.
    pub fn weights(&self, t: usize, setting: &Setting) -> Vec<f64> {
        self.beam.spread(self.drawn(t, setting))
    }

    /// The share of each projector row's dwell that falls inside the exposure of camera row `t`, `[projector_rows]`:
    /// [`Self::weights`] without the beam.
    pub(super) fn drawn(&self, t: usize, setting: &Setting) -> Vec<f64> {
        let rows = self.projector_rows();
        let (from_us, to_us) = self.exposed_us(t, setting);
        let first = ((from_us - self.row_starts_us[rows]) / self.period_us).ceil() as i32;
        let last = ((to_us - self.row_starts_us[0]) / self.period_us).floor() as i32;
        let mut drawn = vec![0.0; rows];
        for frame in first..=last {
            self.shares_in_frame(t, frame, setting).for_each(|(v, share)| drawn[v] += share);
        }
        drawn
    }

    /// The share of each projector row's dwell that falls inside the exposure of camera row `t`, for rows that may be
    /// seen at all; averaged over the delays of the setting, without the beam.
    ///
    /// `frame` selects the frame in which the rows are lit: 0 for the one that the delay refers to, 1 for the next
    /// VSYNC period, -1 for the previous one.
    pub(super) fn shares_in_frame(
        &self,
        t: usize,
        frame: i32,
        setting: &Setting,
    ) -> impl Iterator<Item = (usize, f64)> {
        let own = self.camera.own_row(t) as f64;
        let frame_us = f64::from(frame) * self.period_us;
        let exposure_shift_us = self.exposure_shift_us(t);
        let half_exposure_us = setting.exposure_us / 2.0;
        let half_row_us = self.row_time_us / 2.0;
        let (from_us, to_us) = self.exposed_us(t, setting);
        let first = self.row_starts_us.partition_point(|&start_us| start_us + frame_us < from_us);
        let end = self.row_starts_us.partition_point(|&start_us| start_us + frame_us < to_us);
        (first.saturating_sub(1)..end.min(self.projector_rows())).map(move |v| {
            // Relative to the nominal centre of the camera row's own row, so that rows with the same timing have the
            // same weights, to the bit.
            let centre_us = (v as f64 - own) * self.row_time_us + frame_us;
            let (late_us, next_late_us) = (self.late_us(v), self.late_us(v + 1));
            let overlap_us = |delay_us: f64| {
                let start_us = (centre_us - half_row_us + late_us).max(delay_us - half_exposure_us);
                let end_us = (centre_us + half_row_us + next_late_us).min(delay_us + half_exposure_us);
                (end_us - start_us).max(0.0)
            };
            let sum_us: f64 =
                setting.delays_us.iter().map(|&delay_us| overlap_us(delay_us + exposure_shift_us)).sum();
            let dwell_us = self.row_time_us + (next_late_us - late_us);
            (v, sum_us / (setting.delays_us.len() as f64 * dwell_us))
        })
    }

    /// Start and end of the exposure of camera row `t` at a delay of the setting, relative to the nominal start of
    /// row 0.
    fn exposed_us(&self, t: usize, setting: &Setting) -> (f64, f64) {
        let own_centre_us =
            (self.camera.own_row(t) as f64 + 0.5) * self.row_time_us + self.exposure_shift_us(t);
        let earliest_us = setting.delays_us.iter().fold(f64::INFINITY, |a, &b| a.min(b));
        let latest_us = setting.delays_us.iter().fold(f64::NEG_INFINITY, |a, &b| a.max(b));
        let half_exposure_us = setting.exposure_us / 2.0;
        (own_centre_us + earliest_us - half_exposure_us, own_centre_us + latest_us + half_exposure_us)
    }

    /// By how much the exposure of camera row `t` is later than its setting's delay, relative to the nominal centre
    /// of its own row: zero for rows with the projector's pitch and row time.
    pub(super) fn exposure_shift_us(&self, t: usize) -> f64 {
        let rows = self.camera.own_row(t) - self.camera.first_row;
        t as f64 * self.camera.row_time_us - rows as f64 * self.row_time_us
    }

    /// By how much row `v` begins later than nominally.
    pub(super) fn late_us(&self, v: usize) -> f64 {
        self.row_starts_us[v] - v as f64 * self.row_time_us
    }

    /// Checks that the settings can be used with this timing.
    ///
    /// # Errors
    /// [`PlaneError::NoDelays`]; [`PlaneError::OutOfRange`] for an exposure that is not positive or longer than
    /// 1000 periods, and for a delay of a period or more.
    pub fn check(&self, settings: &[Setting]) -> Result<(), PlaneError> {
        if settings.is_empty() {
            return Err(PlaneError::NoDelays { index: 0 });
        }
        for (index, setting) in settings.iter().enumerate() {
            if setting.delays_us.is_empty() {
                return Err(PlaneError::NoDelays { index });
            }
            let exposure_us = setting.exposure_us;
            if !(exposure_us > 0.0 && exposure_us <= 1000.0 * self.period_us) {
                return Err(PlaneError::OutOfRange {
                    field: "exposure_us",
                    value: exposure_us,
                    allowed: "positive and at most 1000 VSYNC periods: give the exposure in microseconds",
                });
            }
            let too_far = |delay_us: &&f64| !delay_us.is_finite() || delay_us.abs() >= self.period_us;
            if let Some(&delay_us) = setting.delays_us.iter().find(too_far) {
                return Err(PlaneError::OutOfRange {
                    field: "delays_us",
                    value: delay_us,
                    allowed: "shorter than the VSYNC period: measure it against the edge that started the frame",
                });
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const TAU_US: f64 = 22.22;

    fn timing() -> RowTiming {
        RowTiming::new(720, TAU_US, 50_000.0 / 3.0).unwrap()
    }

    /// Weight of relative row `u` as seen from camera row `t`.
    fn weight(timing: &RowTiming, t: usize, u: i32, setting: &Setting) -> f64 {
        timing.weights(t, setting)[(timing.camera().own_row(t) as i32 + u) as usize]
    }

    fn close(a: f64, b: f64) {
        assert!((a - b).abs() < 1e-9, "{a} is not {b}");
    }

    #[test]
    fn ends_are_fractional() {
        // 100 us around the row's own light: rows 0, ±1 completely (66.66 us), and 16.67 us of each of rows ±2.
        let setting = Setting::new(0.0, 100.0);
        let expected = [(0, 1.0), (1, 1.0), (2, 16.67 / 22.22), (3, 0.0)];
        for (u, share) in expected {
            close(weight(&timing(), 360, u, &setting), share);
            close(weight(&timing(), 360, -u, &setting), share);
        }
    }

    #[test]
    fn an_exposure_shorter_than_a_row_sees_part_of_it() {
        close(weight(&timing(), 360, 0, &Setting::new(2.0, 5.0)), 5.0 / TAU_US);
        close(weight(&timing(), 360, 0, &Setting::new(TAU_US / 2.0, 6.0)), 3.0 / TAU_US);
    }

    #[test]
    fn a_positive_delay_sees_lower_rows() {
        let setting = Setting::new(375.0, 600.0);
        // Light of u = 20 is centred at 444.4 us, inside 75..675 us; u = -20 is not.
        close(weight(&timing(), 360, 20, &setting), 1.0);
        close(weight(&timing(), 360, -20, &setting), 0.0);
    }

    #[test]
    fn weights_sum_to_exposure_over_row_time() {
        for (delay_us, exposure_us) in [(0.0, 600.0), (-1500.0, 1200.0), (777.7, 3.0), (12.3, 611.1)] {
            let setting = Setting::new(delay_us, exposure_us);
            close(timing().weights(360, &setting).iter().sum(), exposure_us / TAU_US);
        }
    }

    #[test]
    fn weights_are_the_mean_over_the_frames_averaged() {
        let delays_us = [371.0, 378.5, 390.0];
        let mean = Setting { delays_us: delays_us.to_vec(), exposure_us: 600.0 };
        let each = delays_us.map(|delay_us| timing().weights(360, &Setting::new(delay_us, 600.0)));
        for (v, share) in timing().weights(360, &mean).into_iter().enumerate() {
            close(share, each.iter().map(|shares| shares[v]).sum::<f64>() / 3.0);
        }
    }

    #[test]
    fn neighbouring_frames_are_a_period_away() {
        // From row 700 the next frame's row 0 is lit (16666.67 - 700 * 22.22) us = 1112.67 us later.
        let late = Setting::new(1112.67, 10.0);
        assert_eq!(timing().shares_in_frame(700, 0, &late).filter(|(_, share)| *share > 0.0).count(), 0);
        let next: Vec<usize> = timing()
            .shares_in_frame(700, 1, &late)
            .filter(|(_, share)| *share > 0.0)
            .map(|(v, _)| v)
            .collect();
        assert_eq!(next, [0]);
        close(weight(&timing(), 700, -700, &late), 10.0 / TAU_US);
        // From row 10 the previous frame's row 719 was lit (16666.67 - 709 * 22.22) us = 912.69 us earlier.
        close(weight(&timing(), 10, 709, &Setting::new(-912.69, 10.0)), 10.0 / TAU_US);
    }

    #[test]
    fn an_exposure_of_whole_periods_sees_every_row_as_often() {
        for periods in [1.0, 3.0] {
            let setting = Setting::new(1234.5, periods * timing().period_us());
            timing().weights(360, &setting).into_iter().for_each(|share| close(share, periods));
        }
    }

    #[test]
    fn a_window_sits_in_the_middle() {
        let window = timing().centred(128).unwrap();
        assert_eq!(window.first_row(), 296);
        assert_eq!(window.relative_row(296, 0), 0);
        assert!(window.row_exists(-296, 0) && !window.row_exists(-297, 0));
        assert!(window.row_exists(296, 127) && !window.row_exists(297, 127));
    }

    #[test]
    fn rows_of_unequal_dwell_send_the_same_light() {
        // Rows 0..720, lit twice as fast as nominally in the first half of the sweep, and slower after it.
        let starts_us: Vec<f64> = (0..=720)
            .map(f64::from)
            .map(|v| if v <= 360.0 { v / 2.0 * TAU_US } else { (180.0 + (v - 360.0) * 1.5) * TAU_US })
            .collect();
        let bent = timing().with_row_table(&starts_us).unwrap();
        // Row 100 is lit from 50 tau on for tau/2. Camera row 100 follows the nominal raster: its own light comes
        // 100.5 - 50.25 rows early.
        let own = Setting::new(-50.25 * TAU_US, 0.5 * TAU_US);
        close(weight(&bent, 100, 0, &own), 1.0);
        close(bent.weights(100, &own).iter().sum(), 1.0);
        // A tenth of a nominal row time is a fifth of row 100's dwell and a fifteenth of row 500's.
        close(weight(&bent, 100, 0, &Setting::new(-50.25 * TAU_US, 0.1 * TAU_US)), 0.2);
        // Row 500 is lit from 390 tau to 391.5 tau; its nominal centre is at 500.5 tau.
        close(weight(&bent, 500, 0, &Setting::new((390.75 - 500.5) * TAU_US, 0.1 * TAU_US)), 0.1 / 1.5);
        // Each row is lit once per period, whatever its dwell.
        let period = Setting::new(0.0, timing().period_us());
        bent.weights(300, &period).into_iter().for_each(|share| close(share, 1.0));
    }

    #[test]
    fn a_table_of_equal_rows_changes_no_bit() {
        let starts_us: Vec<f64> = (0..=720).map(|v| f64::from(v) * TAU_US).collect();
        assert_eq!(timing().with_row_table(&starts_us), Ok(timing()));
        let setting = Setting::new(371.0, 611.1);
        for t in [0, 17, 360, 719] {
            let (shares, middle) = (timing().weights(t, &setting), timing().weights(360, &setting));
            for u in -40..40_i32 {
                let Ok(v) = usize::try_from(t as i32 + u) else { continue };
                assert!(v >= 720 || shares[v].to_bits() == middle[(360 + u) as usize].to_bits());
            }
        }
    }

    #[test]
    fn a_camera_of_another_pitch_looks_between_rows() {
        let pitch = 1.5;
        let camera = CameraRows { first_row: 10, rows: 200, pitch, row_time_us: pitch * TAU_US };
        let timing = timing().with_camera(camera).unwrap();
        // Camera row 3 sees position 14.5, half a row above the centre of row 15, its own.
        assert_eq!((camera.place(3), camera.own_row(3), timing.relative_row(15, 3)), (14.5, 15, 0));
        // An exposure of one row time around the position contains half of each row next to it.
        let short = Setting::new(0.0, TAU_US);
        close(weight(&timing, 3, -1, &short), 0.5);
        close(weight(&timing, 3, 0, &short), 0.5);
        // The delay refers to the position: half a row later, it is row 15 alone.
        close(weight(&timing, 3, 0, &Setting::new(TAU_US / 2.0, TAU_US)), 1.0);
    }

    #[test]
    fn a_camera_of_another_row_time_drifts() {
        let camera = CameraRows { first_row: 0, rows: 500, pitch: 1.0, row_time_us: 1.01 * TAU_US };
        let timing = timing().with_camera(camera).unwrap();
        // After 400 rows its exposures are four rows late.
        let setting = Setting::new(0.0, TAU_US);
        close(weight(&timing, 0, 0, &setting), 1.0);
        close(weight(&timing, 400, 4, &setting), 1.0);
        close(weight(&timing, 250, 2, &setting), 0.5);
    }

    #[test]
    fn a_beam_weighs_rows_by_the_rows_drawn_near_them() {
        let setting = Setting::new(0.0, 10.0 * TAU_US);
        let beam = Beam::Gaussian { sigma_rows: 1.5 };
        let (sharp, wide) =
            (timing().weights(360, &setting), timing().with_beam(beam).unwrap().weights(360, &setting));
        close(sharp.iter().sum(), wide.iter().sum());
        // Rows -4..=4 and half of ±5 are drawn: the edge is the integral of a Gaussian, the middle is unchanged.
        assert!(
            (wide[360] - 0.9987).abs() < 1e-3 && (wide[365] - 0.5).abs() < 1e-3,
            "{} {}",
            wide[360],
            wide[365]
        );
        assert_eq!(sharp[366], 0.0);
        // g = 0.2130, 0.1093, 0.0360, 0.0076, 0.0010, 0.0001 at 1.. rows; half of the first and all of the others.
        assert!((wide[366] - 0.2605).abs() < 2e-4, "{}", wide[366]);
    }

    #[test]
    fn bad_values_are_refused_by_name() {
        let field = |result: Result<RowTiming, PlaneError>| match result {
            Err(PlaneError::OutOfRange { field, .. }) => field,
            other => panic!("{other:?}"),
        };
        assert_eq!(field(RowTiming::new(720, f64::NAN, 16_667.0)), "row_time_us");
        assert_eq!(field(RowTiming::new(720, 22.22, 15_000.0)), "period_us");
        assert!(matches!(RowTiming::new(0, 22.22, 16_667.0), Err(PlaneError::Window { .. })));
        assert!(matches!(timing().centred(721), Err(PlaneError::Window { .. })));
        assert!(matches!(timing().window(usize::MAX, 2), Err(PlaneError::Window { .. })));

        let table = |change: fn(&mut Vec<f64>)| {
            let mut starts_us: Vec<f64> = (0..=720).map(|v| f64::from(v) * TAU_US).collect();
            change(&mut starts_us);
            field(timing().with_row_table(&starts_us))
        };
        assert_eq!(table(|starts| starts.truncate(720)), "row_table");
        assert_eq!(table(|starts| starts[7] = starts[6]), "row_table");
        assert_eq!(table(|starts| starts[7] = f64::NAN), "row_table");
        assert_eq!(table(|starts| starts[720] = 17_000.0), "row_table");
        assert_eq!(table(|starts| starts.iter_mut().for_each(|start| *start -= 17_000.0)), "row_table");
        let camera = |pitch, row_time_us| {
            timing().with_camera(CameraRows { first_row: 0, rows: 2, pitch, row_time_us })
        };
        assert_eq!(field(camera(0.0, 22.22)), "row_pitch");
        assert_eq!(field(camera(1.0, f64::INFINITY)), "camera row_time_us");
        assert!(matches!(camera(720.0, 22.22), Err(PlaneError::Window { end: 721, .. })));
        assert!(timing().with_beam(Beam::Gaussian { sigma_rows: 0.0 }).is_err());

        let check = |setting: Setting| timing().check(&[setting]);
        assert_eq!(check(Setting::new(0.0, 600.0)), Ok(()));
        assert!(matches!(timing().check(&[]), Err(PlaneError::NoDelays { index: 0 })));
        assert!(check(Setting { delays_us: vec![], exposure_us: 600.0 }).is_err());
        for bad in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e9] {
            assert!(check(Setting::new(0.0, bad)).is_err(), "exposure {bad}");
        }
        for bad in [17_000.0, f64::NAN, f64::NEG_INFINITY] {
            assert!(check(Setting::new(bad, 600.0)).is_err(), "delay {bad}");
        }
    }
}
