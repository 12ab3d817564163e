use std::ops::Range;

use ndarray::{Array2, ArrayView2, s};

use super::super::super::model::FlyingSpot;
use super::super::super::{NoiseModel, PlaneError, Setting};
use super::super::{BoardCalibration, BoardStrip, Estimate, RowDrawing};
use super::columns::Columns;
use super::model::{BoardSamples, Clocks, FrameComparison, Sweep};
use super::settings::{BoardFrame, BoardSetting, ExposureMode};

/// Measures how late the light of an image is against the VSYNC edge, from a strip of the board in view.
///
/// No device measures this jitter, but every edge of an exposure that meets the board's light shows it: rows of the
/// strip whose light the exposure cuts are brighter or darker than the calibration says.
#[derive(Debug, Clone)]
pub struct JitterGauge {
    strip: BoardStrip,
    /// Noise of one frame, in shares of white.
    noise: NoiseModel,
    seen: Columns,
    sweep: Sweep,
    camera_row_us: f64,
    /// Middle of camera row 0's exposure after the VSYNC edge, for a delay of 0.
    centre_us: f64,
}

/// What a strip shows of an image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Lateness {
    /// By how much the light is late. Without an edge on the board's light it is 0, as uncertain as before.
    pub late_us: Estimate,
    /// Squared residuals in units of their variance, per sample with an edge; 0 without one.
    pub chi2_per_sample: f64,
}

impl JitterGauge {
    /// A gauge for a strip on a calibrated rig with this VSYNC period. With a delay of 0, the middle of camera row 0's
    /// exposure is `centre_us` after the VSYNC edge.
    ///
    /// # Errors
    /// [`PlaneError::OutOfRange`] for columns that the image does not have, or in which the board was not lit.
    pub fn new(
        calibration: &BoardCalibration,
        strip: &BoardStrip,
        period_us: f64,
        centre_us: f64,
    ) -> Result<Self, PlaneError> {
        let Range { start, end } = strip.columns;
        let (_, columns) = calibration.response.size();
        if start >= end || end > columns {
            let allowed = "[first column, column after the last] within the image";
            return Err(PlaneError::OutOfRange { field: "strip_columns", value: end as f64, allowed });
        }
        let of_strip = s![.., start..end];
        let mut places = calibration.response.places().slice(of_strip).to_owned();
        places.zip_mut_with(&calibration.white_dn.slice(of_strip), |place, white| {
            if !white.is_finite() {
                *place = f32::NAN;
            }
        });
        let response = calibration.response.shares();
        let spot = match &calibration.drawing {
            Some(RowDrawing::Spot(spot)) => {
                let columns = spot.columns.slice(of_strip).to_owned();
                Some(FlyingSpot { columns, ..*spot })
            }
            Some(RowDrawing::Even) | None => None,
        };
        if let Some(spot) = &spot {
            let unknown = Array2::from_shape_fn(places.dim(), |(t, s)| spot.column(t, s).is_nan());
            places.zip_mut_with(&unknown, |place, unknown| {
                if *unknown {
                    *place = f32::NAN;
                }
            });
        }
        Ok(Self {
            strip: strip.clone(),
            noise: calibration.noise,
            seen: Columns::new(places.view(), response.slice(s![.., .., start..end]), spot.as_ref())?,
            sweep: Sweep::new(calibration.row_starts_us.clone(), period_us),
            camera_row_us: calibration.camera_row_time_us.value,
            centre_us,
        })
    }

    /// The columns of the strip.
    pub fn columns(&self) -> Range<usize> {
        self.strip.columns.clone()
    }

    /// How late the light of an image with this setting is, from its light in the strip as a share of white, `[t, s]`.
    ///
    /// # Errors
    /// Those of [`Columns::average`].
    pub fn lateness(&self, setting: &Setting, light: ArrayView2<f32>) -> Result<Lateness, PlaneError> {
        let frames = setting.delays_us.len().max(1) as f64;
        let NoiseModel { read_variance, gain } = self.noise;
        let clocks =
            Clocks { camera_row_us: self.camera_row_us, mode_offset_us: 0.0, exposure_offset_us: 0.0 };
        let comparison = FrameComparison {
            columns: &self.seen,
            sweep: &self.sweep,
            clocks,
            noise: NoiseModel { read_variance: read_variance / frames, gain: gain / frames },
            variance_scale: 1.0,
        };
        let exposure_us = setting.exposure_us;
        let delay_us = setting.delays_us.iter().sum::<f64>() / frames + self.centre_us - exposure_us / 2.0;
        let setting = BoardSetting { shutter: ExposureMode::Rolling, delay_us, exposure_us };
        let frame = BoardFrame { setting, light: self.seen.average(light)? };
        let late_us = comparison.lateness_us(&frame, 0.0, self.strip.jitter_us / frames.sqrt());
        let (mut chi2, mut samples) = (0.0, 0.0);
        comparison.visit(&frame, (late_us.value, 0.0), BoardSamples::OnEdges, |_, _, _, sums| {
            chi2 += sums.chi2;
            samples += sums.samples;
        });
        Ok(Lateness { late_us, chi2_per_sample: if samples > 0.0 { chi2 / samples } else { 0.0 } })
    }
}
