//! The points that a sweep acquires, in the order of acquisition.

use std::sync::Arc;

use raysweep_core::{CameraSettings, Raster, Shutter};
use raysweep_transport::plane::calibrate::{self, FlyingSpot};
use raysweep_transport::plane::{Beam, CameraRows, PlaneError, RowTiming};
use serde::Deserialize;

/// The purpose of a point's image.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum PointRole {
    /// Projector dark; the index counts the exposures, shortest first.
    Dark(u32),
    /// One whole VSYNC period of exposure: every row is lit once.
    Regular,
    /// A point of the plan's sweep: `exposure_index * delays + delay_index` in its grid, then the extra settings.
    Sweep(u32),
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
    /// In the order of acquisition: dark frames, the regular image, then the sweep.
    pub points: Vec<Point>,
}

impl Schedule {
    /// Number of points in the plan's sweep.
    pub fn sweep_len(&self) -> usize {
        self.points.iter().filter(|point| matches!(point.role, PointRole::Sweep(_))).count()
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

/// The properties of the rig that convert counts and times into light transport, from the rig file.
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
    /// Counts above black that a white pixel collects in the time of one projector row.
    pub white_dn: f64,
    /// Counts from which a pixel is saturated.
    pub saturation_dn: f64,
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
    /// The timing of projector and camera rows for the model. An unknown beam counts as ideal.
    ///
    /// # Errors
    /// If table, beam or camera rows do not fit the raster.
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
        timing.with_camera(camera)?.with_beam(Beam::of_sigma(self.beam_sigma_rows.unwrap_or(0.0)))
    }

    /// The path of a flying spot over the camera's columns, if the rig file gives it.
    pub fn flying_spot(&self) -> Option<FlyingSpot> {
        let scan = match self.spot {
            Spot::Uniform | Spot::Flying(SpotScan::Unknown) => return None,
            Spot::Flying(SpotScan::OneWay) => calibrate::Scan::OneWay,
            Spot::Flying(SpotScan::Bidirectional) => calibrate::Scan::Bidirectional,
        };
        let [left, right] = self.projector_columns?;
        let column = |s: usize| left + (right - left) * (s as f64 + 0.5) / self.width as f64;
        Some(FlyingSpot { scan, columns: (0..self.width).map(column).collect() })
    }

    /// The same, but only with an ideal beam, which the model requires.
    pub fn modelled_spot(&self) -> Option<FlyingSpot> {
        self.flying_spot().filter(|_| self.beam_sigma_rows == Some(0.0))
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
