use super::PlaneError;

/// When each projector row is lit, and which projector rows the camera's rows look along.
///
/// Rows are lit for `row_time_us` each, one after the other, once per VSYNC period; the rest of the period is the
/// retrace, in which nothing is lit. Camera row `t` lies on the epipolar plane of projector row `first_row + t`, and
/// its exposure keeps pace with the rows, so that a delay means the same for every row. A scene with fewer rows than
/// the projector is a window in the middle of its frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RowTiming {
    projector_rows: usize,
    row_time_us: f64,
    period_us: f64,
    first_row: usize,
    camera_rows: usize,
}

impl RowTiming {
    /// A projector of `projector_rows` rows of `row_time_us` every `period_us`, seen by as many camera rows.
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
        // Rows that end within rounding of the period leave a retrace of zero.
        let lit_us = projector_rows as f64 * row_time_us;
        if !(period_us.is_finite() && period_us >= lit_us * (1.0 - 1e-9)) {
            return Err(PlaneError::OutOfRange {
                field: "period_us",
                value: period_us,
                allowed: "at least the projector's rows times row_time_us: check both against the VSYNC rate",
            });
        }
        let timing =
            Self { projector_rows, row_time_us, period_us, first_row: 0, camera_rows: projector_rows };
        timing.window(0, projector_rows)
    }

    /// The same projector, seen by `camera_rows` rows that start on projector row `first_row`.
    ///
    /// # Errors
    /// [`PlaneError::Window`] if the window is empty or leaves the projector.
    pub fn window(self, first_row: usize, camera_rows: usize) -> Result<Self, PlaneError> {
        let end = first_row.saturating_add(camera_rows);
        if camera_rows == 0 || end > self.projector_rows {
            return Err(PlaneError::Window { first_row, end, projector_rows: self.projector_rows });
        }
        Ok(Self { first_row, camera_rows, ..self })
    }

    /// The same projector, seen by `camera_rows` rows in the middle of its frame.
    ///
    /// # Errors
    /// [`PlaneError::Window`] if there are no camera rows, or more than projector rows.
    pub fn centred(self, camera_rows: usize) -> Result<Self, PlaneError> {
        self.window(self.projector_rows.saturating_sub(camera_rows) / 2, camera_rows)
    }

    /// Rows of the projector.
    pub fn projector_rows(&self) -> usize {
        self.projector_rows
    }

    /// Time per projector row (`tau`), which is also the time a row is lit (`t_p`).
    pub fn row_time_us(&self) -> f64 {
        self.row_time_us
    }

    /// Time from one VSYNC edge to the next; not necessarily a whole number of row times.
    pub fn period_us(&self) -> f64 {
        self.period_us
    }

    /// Projector row on the epipolar plane of camera row 0.
    pub fn first_row(&self) -> usize {
        self.first_row
    }

    /// Rows of the camera's window.
    pub fn camera_rows(&self) -> usize {
        self.camera_rows
    }

    /// Relative row of projector row `v` seen from camera row `t`: `v - (first_row + t)`.
    pub fn relative_row(&self, v: usize, t: usize) -> i32 {
        v as i32 - (self.first_row + t) as i32
    }

    /// Whether relative row `u` of camera row `t` is a row of the projector.
    pub fn row_exists(&self, u: i32, t: usize) -> bool {
        let v = i64::from(u) + (self.first_row + t) as i64;
        (0..self.projector_rows as i64).contains(&v)
    }

    /// Share of the dwell of relative row `u` that falls inside the exposure: a box with fractional ends, averaged
    /// over the delays of the setting.
    ///
    /// `frame` says which lighting of the row is meant: 0 in the frame that the delay is measured against, 1 in the
    /// next VSYNC period, -1 in the one before.
    pub fn weight_in_frame(&self, u: i32, frame: i32, setting: &Setting) -> f64 {
        let lit_centre_us = f64::from(u) * self.row_time_us + f64::from(frame) * self.period_us;
        let half_lit_us = self.row_time_us / 2.0;
        let half_exposure_us = setting.exposure_us / 2.0;
        let overlap_us = |delay_us: f64| {
            let start_us = (lit_centre_us - half_lit_us).max(delay_us - half_exposure_us);
            let end_us = (lit_centre_us + half_lit_us).min(delay_us + half_exposure_us);
            (end_us - start_us).max(0.0)
        };
        let sum_us: f64 = setting.delays_us.iter().map(|&delay_us| overlap_us(delay_us)).sum();
        sum_us / (setting.delays_us.len() as f64 * self.row_time_us)
    }

    /// [`Self::weight_in_frame`] summed over all frames: what the exposure collects of row `u` in all. Above 1 only
    /// where an exposure is longer than a period and sees the row more than once.
    pub fn weight(&self, u: i32, setting: &Setting) -> f64 {
        let margin_us = (setting.exposure_us + self.row_time_us) / 2.0;
        let relative_us = f64::from(u) * self.row_time_us;
        let earliest_us = setting.delays_us.iter().fold(f64::INFINITY, |a, &b| a.min(b)) - margin_us;
        let latest_us = setting.delays_us.iter().fold(f64::NEG_INFINITY, |a, &b| a.max(b)) + margin_us;
        let first = ((earliest_us - relative_us) / self.period_us).ceil() as i32;
        let last = ((latest_us - relative_us) / self.period_us).floor() as i32;
        (first..=last).map(|frame| self.weight_in_frame(u, frame, setting)).sum()
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

/// How one image of a stack was exposed: the mean of one frame per delay, all with the same exposure.
#[derive(Debug, Clone, PartialEq)]
pub struct Setting {
    /// True delay `t_d` of each averaged frame: centre of a row's exposure minus centre of its illumination, measured
    /// against the VSYNC edge of that frame. Positive: the camera row sees rows below its own (`u > 0`).
    pub delays_us: Vec<f64>,
    /// Exposure of a camera row, `t_e`.
    pub exposure_us: f64,
}

impl Setting {
    /// A setting whose frames all have the same delay.
    pub fn new(delay_us: f64, exposure_us: f64) -> Self {
        Self { delays_us: vec![delay_us], exposure_us }
    }
}

/// Delay `t_d` from the offset `t'_o` between the start of a row's exposure and the start of its illumination.
///
/// `t_d = (t_e - t_p)/2 - t'_o`. The paper's Eq. 1 prints `(t_e - t'_o)/2`, which contradicts its own text: light in
/// the middle of the exposure must give 0. For `t_e` = 600 us and `t_p` = 20 us, light centred in the exposure starts
/// at `t'_o` = 290 us and gives 0; light at the very start gives +290 us.
pub fn delay_us(exposure_us: f64, offset_us: f64, lit_us: f64) -> f64 {
    (exposure_us - lit_us) / 2.0 - offset_us
}

/// The offset `t'_o` that yields the delay `t_d`; the inverse of [`delay_us`].
pub fn offset_us(exposure_us: f64, delay_us: f64, lit_us: f64) -> f64 {
    (exposure_us - lit_us) / 2.0 - delay_us
}

#[cfg(test)]
mod tests {
    use super::*;

    const TAU_US: f64 = 22.22;

    fn timing() -> RowTiming {
        RowTiming::new(720, TAU_US, 50_000.0 / 3.0).unwrap()
    }

    fn close(a: f64, b: f64) {
        assert!((a - b).abs() < 1e-9, "{a} is not {b}");
    }

    #[test]
    fn eq_1_by_hand() {
        close(delay_us(600.0, 290.0, 20.0), 0.0);
        close(delay_us(600.0, 0.0, 20.0), 290.0);
        close(delay_us(600.0, 580.0, 20.0), -290.0);
        close(offset_us(600.0, delay_us(600.0, 123.0, 20.0), 20.0), 123.0);
    }

    #[test]
    fn ends_are_fractional() {
        // 100 us around the row's own light: rows 0, ±1 whole (66.66 us), and 16.67 us of each of rows ±2.
        let setting = Setting::new(0.0, 100.0);
        let expected = [(0, 1.0), (1, 1.0), (2, 16.67 / 22.22), (3, 0.0)];
        for (u, weight) in expected {
            close(timing().weight(u, &setting), weight);
            close(timing().weight(-u, &setting), weight);
        }
    }

    #[test]
    fn an_exposure_shorter_than_a_row_sees_part_of_it() {
        close(timing().weight(0, &Setting::new(2.0, 5.0)), 5.0 / TAU_US);
        close(timing().weight(0, &Setting::new(TAU_US / 2.0, 6.0)), 3.0 / TAU_US);
    }

    #[test]
    fn a_positive_delay_sees_lower_rows() {
        let setting = Setting::new(375.0, 600.0);
        // Light of u = 20 is centred at 444.4 us, inside 75..675 us; u = -20 is not.
        close(timing().weight(20, &setting), 1.0);
        close(timing().weight(-20, &setting), 0.0);
    }

    #[test]
    fn weights_sum_to_exposure_over_row_time() {
        for (delay_us, exposure_us) in [(0.0, 600.0), (-1500.0, 1200.0), (777.7, 3.0), (12.3, 611.1)] {
            let setting = Setting::new(delay_us, exposure_us);
            let sum: f64 = (-300..=300).map(|u| timing().weight_in_frame(u, 0, &setting)).sum();
            close(sum, exposure_us / TAU_US);
        }
    }

    #[test]
    fn weights_are_the_mean_over_the_frames_averaged() {
        let delays_us = [371.0, 378.5, 390.0];
        let mean = Setting { delays_us: delays_us.to_vec(), exposure_us: 600.0 };
        for u in -40..=40 {
            let each = delays_us.map(|delay_us| timing().weight(u, &Setting::new(delay_us, 600.0)));
            close(timing().weight(u, &mean), each.iter().sum::<f64>() / 3.0);
        }
    }

    #[test]
    fn neighbouring_frames_are_a_period_away() {
        // From row 700 the next frame's row 0 is lit (16666.67 - 700 * 22.22) us = 1112.67 us later.
        let late = Setting::new(1112.67, 10.0);
        close(timing().weight_in_frame(-700, 0, &late), 0.0);
        close(timing().weight_in_frame(-700, 1, &late), 10.0 / TAU_US);
        close(timing().weight(-700, &late), 10.0 / TAU_US);
        // From row 10 the previous frame's row 719 was lit (16666.67 - 709 * 22.22) us = 912.69 us earlier.
        close(timing().weight(709, &Setting::new(-912.69, 10.0)), 10.0 / TAU_US);
    }

    #[test]
    fn an_exposure_of_whole_periods_sees_every_row_as_often() {
        for periods in [1.0, 3.0] {
            let setting = Setting::new(1234.5, periods * timing().period_us());
            for u in [-719, -1, 0, 350, 719] {
                close(timing().weight(u, &setting), periods);
            }
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
