//! The points that a sweep acquires, in the order of acquisition.

use std::sync::Arc;

use ndarray::{Array2, Axis};
use raysweep_core::{CameraSettings, Raster, Shutter};
use raysweep_transport::plane::board::{BoardCalibration, Estimate, RowDrawing};
use raysweep_transport::plane::calibrate::{FlyingSpot, Scan};
use raysweep_transport::plane::{Beam, CameraRows, PlaneError, RowTiming, Setting};
use serde::Deserialize;

use crate::scale::{CameraCurve, LightScale};

/// The purpose of a point's image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum PointRole {
    /// Projector dark; the index counts the exposures, shortest first.
    Dark(u32),
    /// One whole VSYNC period of exposure: every row is lit once.
    Regular,
    /// A point of the plan's sweep: `exposure_index * delays + delay_index` in its grid, then the extra settings.
    Sweep(u32),
    /// The image under less light for pixels that saturate; its place among the stored images, after the sweep's.
    Bracket(u32),
}

/// One point: frames with the same setting that are averaged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// Purpose of its image.
    pub role: PointRole,
    /// Wanted delay t_d.
    pub delay_us: f64,
    /// Wanted exposure t_e.
    pub exposure_us: f64,
    /// Frames to average.
    pub frames: u32,
}

/// All points of a run. A point's ordinal is its index in `points`.
#[derive(Debug, Clone, PartialEq)]
pub struct Schedule {
    /// In the order of acquisition: dark frames, the regular image, the sweep, then its bracket.
    pub points: Vec<Point>,
}

impl Schedule {
    /// Number of points in the plan's sweep.
    pub fn sweep_len(&self) -> usize {
        self.points.iter().filter(|point| matches!(point.role, PointRole::Sweep(_))).count()
    }

    /// The point under less light, if there is one.
    pub fn bracket(&self) -> Option<&Point> {
        self.points.iter().find(|point| matches!(point.role, PointRole::Bracket(_)))
    }

    /// Number of dark points.
    pub fn dark_len(&self) -> usize {
        self.points.iter().filter(|point| matches!(point.role, PointRole::Dark(_))).count()
    }

    /// The dark point of an exposure.
    pub fn dark_of(&self, exposure_us: f64) -> Option<PointRole> {
        let dark =
            |point: &&Point| matches!(point.role, PointRole::Dark(_)) && point.exposure_us == exposure_us;
        self.points.iter().find(dark).map(|point| point.role)
    }
}

/// Share of the median white level below which a pixel does not count as measured: there the board was not lit.
const LEAST_WHITE: f64 = 0.05;

/// The properties of the rig that convert counts and times into light transport: those of the rig file, or of a
/// calibration where [`Self::calibrated`] has put them in their place.
#[derive(Debug, Clone, PartialEq)]
pub struct SweepGeometry {
    /// Nominal timing of the projector's rows, to which delays refer.
    pub raster: Raster,
    /// True timing of the rows: start of each row and end of the last, relative to the nominal start of row 0; `None`
    /// if no table was measured.
    pub row_table_us: Option<Arc<[f64]>>,
    /// Standard deviation of the beam in projector rows, 0 for the ideal beam; `None` if unknown.
    pub beam_sigma_rows: Option<f64>,
    /// Determines when within its row a pixel's direct light arrives.
    pub spot: Spot,
    /// Projector columns, in 0..=1 over its width, seen by the image's left and right edges; `None` if unknown.
    pub projector_columns: Option<[f64; 2]>,
    /// Projector row that camera row 0 sees.
    pub first_row: usize,
    /// Projector rows from one camera row to the next.
    pub row_pitch: f64,
    /// Time from the start of one camera row's exposure to the start of the next row's.
    pub camera_row_time_us: f64,
    /// Number of camera rows.
    pub height: usize,
    /// Number of camera columns.
    pub width: usize,
    /// Counts above black that a white pixel collects in the time of one projector row; with a calibration, the median
    /// of its pixels.
    pub white_dn: f64,
    /// Counts without light, as the rig file says.
    pub black_dn: f64,
    /// Counts from which a pixel is saturated.
    pub saturation_dn: f64,
    /// What a calibration measured, in place of row table, beam, white and black level.
    pub calibration: Option<Arc<BoardCalibration>>,
}

/// How the light of a row is drawn, which determines when within its row a pixel's direct light arrives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Spot {
    /// The whole row at once: evenly over the row's time.
    Uniform,
    /// By a spot that flies along the row: at the time when it passes the projector column that the pixel sees.
    Flying(SpotScan),
}

/// Direction of a flying spot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum SpotScan {
    /// Unknown.
    Unknown,
    /// Every row from the first column to the last.
    OneWay,
    /// Odd rows from the last column to the first.
    Bidirectional,
}

/// The camera's configuration for a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shot {
    /// Its settings.
    pub settings: CameraSettings,
    /// The edge whose light is measured, in edges after the trigger's own (0).
    pub light_edges_later: u32,
}

impl SweepGeometry {
    /// The same rig as a calibration found it. Delays then refer to the direct light of the middle camera row, as it
    /// was measured. [`Self::timing`] refuses a calibration of another camera or projector.
    #[must_use]
    pub fn calibrated(self, calibration: Arc<BoardCalibration>) -> Self {
        let (height, width) = calibration.response.size();
        let (t, camera_row_time_us) = (height / 2, calibration.camera_row_time_us.value);
        let own_row = calibration.response.own_rows(t, width).nth(width / 2).unwrap_or_default();
        let above = (t as f64 * self.row_pitch).round() as i64;
        let below = (self.height.saturating_sub(1) as f64 * self.row_pitch).ceil() as i64;
        let first_row = (own_row - above).clamp(0, (self.raster.rows as i64 - 1 - below).max(0)) as usize;
        let first_light_us = calibration.direct_light_us(t) - t as f64 * camera_row_time_us;
        let mut raster = self.raster;
        raster.first_row_us += first_light_us - raster.row_centre_us(first_row);
        let mut white_dn: Vec<f32> = calibration.white_dn.iter().copied().filter(|dn| *dn > 0.0).collect();
        white_dn.sort_by(f32::total_cmp);
        let spot = match &calibration.drawing {
            None => self.spot,
            Some(RowDrawing::Even) => Spot::Uniform,
            Some(RowDrawing::Spot(FlyingSpot { scan: Scan::OneWay, .. })) => Spot::Flying(SpotScan::OneWay),
            Some(RowDrawing::Spot(FlyingSpot { scan: Scan::Bidirectional, .. })) => {
                Spot::Flying(SpotScan::Bidirectional)
            }
        };
        Self {
            raster,
            row_table_us: None,
            beam_sigma_rows: None,
            spot,
            first_row,
            camera_row_time_us,
            white_dn: white_dn.get(white_dn.len() / 2).map_or(self.white_dn, |&dn| f64::from(dn)),
            saturation_dn: calibration
                .saturation_dn
                .map_or(self.saturation_dn, |dn| dn.min(self.saturation_dn)),
            calibration: Some(calibration),
            ..self
        }
    }

    /// The mean time from one projector row to the next: as calibrated, or as the rig file has it.
    pub fn row_time_us(&self) -> f64 {
        let calibrated = self.calibration.as_deref().map(|calibration| &calibration.row_starts_us[..]);
        match calibrated.or(self.row_table_us.as_deref()) {
            Some([first, .., last]) => (last - first) / self.raster.rows as f64,
            _ => self.raster.row_time_us,
        }
    }

    /// When the light of projector row 0 begins after the VSYNC edge: as calibrated, or as the rig file has it.
    pub fn first_row_us(&self) -> f64 {
        let calibrated = self.calibration.as_deref().and_then(|it| it.row_starts_us.first().copied());
        calibrated.unwrap_or(self.raster.first_row_us)
    }

    /// The model's setting for images taken with these delays and this exposure, as the camera states them: a
    /// calibrated camera exposes longer or shorter, from the same beginning.
    pub fn setting(&self, delays_us: &[f64], exposure_us: f64) -> Setting {
        let longer_us =
            self.calibration.as_ref().map_or(0.0, |calibration| calibration.exposure_offset_us.value);
        Setting {
            delays_us: delays_us.iter().map(|delay_us| delay_us + longer_us / 2.0).collect(),
            exposure_us: exposure_us + longer_us,
        }
    }

    /// How late the light of an image is of which no strip of the board shows it: not known better than the jitter of
    /// its frames.
    pub fn unseen_jitter(&self, setting: &Setting) -> Estimate {
        let jitter_us = self.calibration.as_ref().map_or(0.0, |calibration| calibration.jitter_us);
        Estimate { value: 0.0, sd: jitter_us / (setting.delays_us.len().max(1) as f64).sqrt() }
    }

    /// Counts above black that a white pixel collects in the time of one projector row, `[t, s]` of these camera rows;
    /// infinite where a calibration has not measured it, so that no light is found there.
    pub fn white_of(&self, rows: &[usize]) -> Array2<f64> {
        let Some(calibration) = &self.calibration else {
            return Array2::from_elem((rows.len(), self.width), self.white_dn);
        };
        let is_measured = |dn: f64| dn >= LEAST_WHITE * self.white_dn;
        let white = |dn: f32| Some(f64::from(dn)).filter(|dn| is_measured(*dn)).unwrap_or(f64::INFINITY);
        calibration.white_dn.select(Axis(0), rows).mapv(white)
    }

    /// Counts of each pixel at an exposure of 0, `[t, s]`.
    pub fn dark_offset_dn(&self) -> Array2<f32> {
        match &self.calibration {
            Some(calibration) => calibration.dark_offset_dn.clone(),
            None => Array2::from_elem((self.height, self.width), self.black_dn as f32),
        }
    }

    /// What converts the counts of these camera rows to light.
    pub fn scale_of(&self, rows: &[usize]) -> LightScale {
        let curve = self.calibration.as_ref().and_then(|calibration| {
            let zero_dn = || calibration.dark_offset_dn.select(Axis(0), rows);
            calibration.linearity_per_dn.map(|per_dn| CameraCurve { per_dn, zero_dn: zero_dn() })
        });
        LightScale::new(&self.white_of(rows), curve)
    }

    /// The timing of projector and camera rows for the model. An unknown beam counts as ideal.
    ///
    /// # Errors
    /// If table, beam or camera rows do not fit the raster, or a calibration does not fit the rig.
    pub fn timing(&self) -> Result<RowTiming, PlaneError> {
        let raster = &self.raster;
        let mut timing = RowTiming::new(raster.rows, raster.row_time_us, raster.period_us)?;
        if let Some(table) = &self.row_table_us {
            timing = timing.with_row_table(table)?;
        }
        let camera = CameraRows {
            first_row: self.first_row,
            rows: self.height,
            pitch: self.row_pitch,
            row_time_us: self.camera_row_time_us,
        };
        let timing = timing.with_camera(camera)?;
        match &self.calibration {
            Some(calibration) => {
                let (rows, columns) = calibration.response.size();
                if (rows, columns) != (self.height, self.width) {
                    return Err(PlaneError::Shape {
                        array: "calibration",
                        axes: "[camera rows, columns]",
                        actual: vec![rows, columns],
                        expected: vec![self.height, self.width],
                    });
                }
                calibration.timing(timing, raster.first_row_us)
            }
            None => timing.with_beam(Beam::of_sigma(self.beam_sigma_rows.unwrap_or(0.0))),
        }
    }

    /// The path of a flying spot over the scene, if the rig file gives it and an ideal beam, which the model requires. A
    /// calibration knows the path over the board alone.
    pub fn modelled_spot(&self) -> Option<FlyingSpot> {
        let scan = match self.spot {
            Spot::Uniform | Spot::Flying(SpotScan::Unknown) => return None,
            Spot::Flying(SpotScan::OneWay) => Scan::OneWay,
            Spot::Flying(SpotScan::Bidirectional) => Scan::Bidirectional,
        };
        let is_ideal = self.calibration.is_none() && self.beam_sigma_rows == Some(0.0);
        let [left, right] = self.projector_columns.filter(|_| is_ideal)?;
        let column = |s: usize| (left + (right - left) * (s as f64 + 0.5) / self.width as f64) as f32;
        let columns = Array2::from_shape_fn((1, self.width), |(_, s)| column(s));
        Some(FlyingSpot { scan, columns })
    }

    /// The configuration for a point on a camera with this trigger latency.
    pub fn shot(&self, point: &Point, trigger_latency_us: f64) -> Shot {
        let trigger =
            self.raster.trigger(self.first_row, point.delay_us, point.exposure_us, trigger_latency_us);
        Shot {
            settings: CameraSettings {
                shutter: Shutter::Rolling,
                exposure_us: point.exposure_us,
                trigger_delay_us: trigger.trigger_delay_us,
            },
            light_edges_later: trigger.light_edges_later,
        }
    }
}
