use std::ops::Range;

use ndarray::{Array2, s};

use super::super::error::check_shape;
use super::super::model::FlyingSpot;
use super::super::{CameraRows, FIRST_RESPONSE_ROW, NoiseModel, PixelResponse, PlaneError, RowTiming};
use super::{CalibrationCovariance, Estimate};

/// What images of a board have shown of a rig, in the form in which sweeps and films use it.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardCalibration {
    /// Start of each projector row and end of the last, after the trigger edge, for a rolling exposure that opens the
    /// camera's row 0 at its trigger delay and stated latency: the projector's latency less what the camera's is more
    /// than stated.
    pub row_starts_us: Vec<f64>,
    /// Time from one row of the camera to the next.
    pub camera_row_time_us: Estimate,
    /// What exposures have more than their nominal length.
    pub exposure_offset_us: Estimate,
    /// Jitter of the light of a frame that the time stamps of the VSYNC edges do not show: the standard deviation.
    pub jitter_us: f64,
    /// Errors that all pixels and images of a run share.
    pub covariance: CalibrationCovariance,
    /// Where each pixel looks and how rows share its direct light. `[t, s]` are the camera's rows and columns.
    pub response: PixelResponse,
    /// How the projector draws a row; `None` if it was not measured.
    pub drawing: Option<RowDrawing>,
    /// Counts above black that a pixel collects in one pass of a white picture, `[t, s]`; NaN where the board was not
    /// lit.
    pub white_dn: Array2<f32>,
    /// Counts of each pixel at an exposure of 0, `[t, s]`.
    pub dark_offset_dn: Array2<f32>,
    /// `a` of the camera's curve: `DN (1 + a DN)` is proportional to the light, DN counting from `dark_offset_dn`; `None`
    /// for a camera that is taken as linear.
    pub linearity_per_dn: Option<f64>,
    /// Counts from which on a pixel is overexposed; `None` if it was not measured.
    pub saturation_dn: Option<f64>,
    /// Noise of one frame, in shares of white.
    pub noise: NoiseModel,
    /// Where the board stays in view during runs, if it does.
    pub strip: Option<BoardStrip>,
    /// A lamp that flickered in the room; `None` if none did, or it was not measured.
    pub lamp: Option<FlickeringLamp>,
}

/// How a projector draws a row.
#[derive(Debug, Clone, PartialEq)]
pub enum RowDrawing {
    /// The whole row is lit at once, evenly over its time.
    Even,
    /// By a spot, with the columns at which pixels see the board. A scene at another distance is seen at others.
    Spot(FlyingSpot),
}

/// The columns of the image in which the white board stays in view while a scene is measured.
#[derive(Debug, Clone, PartialEq)]
pub struct BoardStrip {
    /// The columns.
    pub columns: Range<usize>,
    /// Standard deviation of the lateness of a frame's light, before it is measured.
    pub jitter_us: f64,
}

/// A lamp that flickers.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlickeringLamp {
    /// Frequency.
    pub frequency_hz: f64,
    /// Amplitude, of white in the time of one projector row.
    pub amplitude: f64,
}

impl BoardCalibration {
    /// Mean time, over the columns of camera row `t`, at which direct light reaches a pixel: from the trigger edge to
    /// the middle of the rows that light it, each weighted with its share.
    ///
    /// # Panics
    /// If the calibration has no camera row `t`, or no projector row.
    pub fn direct_light_us(&self, t: usize) -> f64 {
        let (_, columns) = self.response.size();
        let last_row = self.row_starts_us.len().saturating_sub(2) as i64;
        let centre_us = |row: i64| {
            let row = row.clamp(0, last_row) as usize;
            (self.row_starts_us[row] + self.row_starts_us[row + 1]) / 2.0
        };
        let shares = self.response.shares();
        let of_column = |(s, own_row): (usize, i64)| -> f64 {
            (i64::from(FIRST_RESPONSE_ROW)..)
                .zip(shares.slice(s![.., t, s]))
                .map(|(d, &share)| f64::from(share) * centre_us(own_row + d))
                .sum()
        };
        self.response.own_rows(t, columns).enumerate().map(of_column).sum::<f64>() / columns as f64
    }

    /// The timing of a sweep on the calibrated rig. `nominal` is that of the rig file, without a beam; `first_row_us`
    /// is its time from the trigger edge to the start of row 0, to which delays refer.
    ///
    /// # Errors
    /// [`PlaneError::Shape`] if the calibration is of a camera with other rows, or its white level of another size;
    /// [`PlaneError::OutOfRange`] for a table of row starts that does not have the projector's rows or does not
    /// increase.
    pub fn timing(&self, nominal: RowTiming, first_row_us: f64) -> Result<RowTiming, PlaneError> {
        let (rows, columns) = self.response.size();
        check_shape("white_dn", "[camera rows, columns]", self.white_dn.shape(), &[rows, columns])?;
        let camera = CameraRows { row_time_us: self.camera_row_time_us.value, ..nominal.camera() };
        let starts_us: Vec<f64> = self.row_starts_us.iter().map(|start_us| start_us - first_row_us).collect();
        nominal.with_camera(camera)?.with_row_table(&starts_us)?.with_response(self.response.clone())
    }
}
