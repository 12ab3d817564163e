use ndarray::Array2;

use super::super::{CameraRows, PixelResponse, PlaneError, RowTiming};
use super::Estimate;

/// What images of a board have shown of a rig, in the form in which sweeps and films use it.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardCalibration {
    /// Start of each projector row and end of the last, after the trigger edge, for a rolling exposure that opens the
    /// camera's row 0 at its trigger delay: the projector's latency less the camera's.
    pub row_starts_us: Vec<f64>,
    /// Time from one row of the camera to the next.
    pub camera_row_time_us: Estimate,
    /// What exposures have more than their nominal length.
    pub exposure_offset_us: Estimate,
    /// Standard deviation of the time of all rows together.
    pub latency_sd_us: f64,
    /// Where each pixel looks and how rows share its direct light. `[t, s]` are the camera's rows and columns.
    pub response: PixelResponse,
    /// Standard deviation of the place of a pixel, in projector rows.
    pub place_sd_rows: f64,
    /// Counts above black that a pixel collects in one pass of a white picture, `[t, s]`; NaN where the board was not
    /// lit.
    pub white_dn: Array2<f32>,
    /// Standard deviation of the white level relative to itself.
    pub white_relative_sd: f64,
}

impl BoardCalibration {
    /// The timing of a sweep on the calibrated rig. `nominal` is that of the rig file, without a beam; `first_row_us`
    /// is its time from the trigger edge to the start of row 0, to which delays refer.
    ///
    /// # Errors
    /// [`PlaneError::Shape`] if the calibration is of a camera with other rows; [`PlaneError::OutOfRange`] for a
    /// table of row starts that does not have the projector's rows or does not increase.
    pub fn timing(&self, nominal: RowTiming, first_row_us: f64) -> Result<RowTiming, PlaneError> {
        let camera = CameraRows { row_time_us: self.camera_row_time_us.value, ..nominal.camera() };
        let starts_us: Vec<f64> = self.row_starts_us.iter().map(|start_us| start_us - first_row_us).collect();
        nominal.with_camera(camera)?.with_row_table(&starts_us)?.with_response(self.response.clone())
    }
}
