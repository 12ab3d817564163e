//! What images tell about the calibration that they are demultiplexed with: whether light still comes when and where
//! it was measured.

use ndarray::ArrayView3;
use raysweep_transport::plane::calibrate::{Sample, latency, spike_offset};
use raysweep_transport::plane::{RowTiming, Setting};

/// A latency found further from the calibration's, beyond doubt, causes a warning.
const NEAR_US: f64 = 2.0;
/// Standard errors within which a latency may be off by chance.
const DOUBT: f64 = 2.0;
/// One that is off by more standard errors is adopted however uncertain it is: what it corrects is larger.
const BEYOND_DOUBT: f64 = 5.0;
/// One less certain than this is adopted only if the calibration's own is less certain still, or [`BEYOND_DOUBT`].
const CERTAIN_US: f64 = 0.5;
/// Direct light further from its place causes a warning.
const NEAR_ROWS: f64 = 0.1;

/// How a rig has changed since its calibration.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct CalibrationDrift {
    /// By how much later than calibrated light arrives; 0 if it was not found, or is not to be believed.
    pub late_us: f64,
    /// Standard deviation of that time; `None` if the calibration's own time is kept.
    pub late_sd_us: Option<f64>,
    /// Median distance of direct light from its place, in projector rows; `None` if it was not found.
    pub u0_rows: Option<f64>,
    /// What was found, each as a key and a sentence.
    pub remarks: Vec<(&'static str, String)>,
    /// What is wrong with it.
    pub warnings: Vec<String>,
}

/// Images of some camera rows.
#[derive(Clone, Copy)]
pub(crate) struct Images<'a> {
    /// The camera rows, ascending.
    pub rows: &'a [usize],
    /// `[settings, rows, s]`; 1 = a white pixel lit by its own projector row.
    pub images: ArrayView3<'a, f32>,
    /// Which samples may be used, of the same shape; `None` if all.
    pub valid: Option<ArrayView3<'a, bool>>,
}

impl CalibrationDrift {
    /// Finds it from images with these settings. `known_us` is the standard deviation of the calibration's latency.
    pub(crate) fn of(timing: &RowTiming, settings: &[Setting], images: &Images<'_>, known_us: f64) -> Self {
        let mut drift =
            Self { late_us: 0.0, late_sd_us: None, u0_rows: None, remarks: Vec::new(), warnings: Vec::new() };
        drift.find_latency(timing, settings, images, known_us);
        drift.find_place(timing, settings, images);
        drift
    }

    fn find_latency(&mut self, timing: &RowTiming, settings: &[Setting], images: &Images<'_>, known_us: f64) {
        let &Images { rows, images, valid } = images;
        let said = match latency(timing, settings, rows, images, valid) {
            Err(error) => format!("as calibrated: {error}"),
            Ok(found) => {
                let (late_us, sd_us) = (found.late_us, found.standard_error_us);
                let than = if late_us < 0.0 { "earlier" } else { "later" };
                let comes = format!("light comes {:.2} us {than} than calibrated", late_us.abs());
                let is_certain = sd_us <= known_us.max(CERTAIN_US) || late_us.abs() > BEYOND_DOUBT * sd_us;
                // A rig that has moved is described as well by another latency: both move all light alike.
                if is_certain {
                    self.late_us = late_us;
                    self.late_sd_us = Some(sd_us);
                    if late_us.abs() > NEAR_US + DOUBT * sd_us {
                        self.warnings.push(format!(
                            "{comes}, which is corrected: the rig has moved, or the host was too busy to tell the clocks apart; calibrate again"
                        ));
                    }
                }
                let kept = match (is_certain, self.warnings.is_empty()) {
                    (false, _) => ", too uncertain to be used",
                    (true, true) => ", corrected; so little is no reason to calibrate again",
                    (true, false) => ", corrected; see the warning",
                };
                format!("{comes} (± {sd_us:.2} us), from {} pixels{kept}", found.pixels)
            }
        };
        self.remarks.push(("latency", said));
    }

    /// After the latency, which cannot be told from the same error of all places.
    fn find_place(&mut self, timing: &RowTiming, settings: &[Setting], images: &Images<'_>) {
        let &Images { rows, images, valid } = images;
        let settings = settings.iter().map(|setting| setting.earlier(self.late_us)).collect();
        let sample = Sample::of_rows(timing.clone(), settings, rows, images, valid);
        let said = match sample.and_then(|sample| spike_offset(&sample, 0.0)) {
            Err(error) => format!("taken to lie where it was calibrated: {error}"),
            Ok(map) => {
                let mut places: Vec<f32> = map.u0.iter().copied().collect();
                places.sort_by(f32::total_cmp);
                let median = f64::from(places[places.len() / 2]);
                if median.abs() > NEAR_ROWS {
                    self.warnings.push(format!(
                        "direct light lies {:.2} row from its place: the rig has moved; calibrate again",
                        median.abs()
                    ));
                }
                self.u0_rows = Some(median);
                format!("{median:.3} rows from where it was calibrated (median), from {} pixels", map.pixels)
            }
        };
        self.remarks.push(("direct light", said));
    }
}
