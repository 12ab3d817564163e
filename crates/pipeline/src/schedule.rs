//! What a sweep acquires, point by point, in the order of acquisition.

use std::sync::Arc;

use raysweep_core::{CameraSettings, Raster, Shutter};
use raysweep_transport::plane::calibrate::{self, FlyingSpot};
use raysweep_transport::plane::{Beam, CameraRows, PlaneError, RowTiming};
use serde::Deserialize;

/// What a point's image is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Role {
    /// Projector dark; the index counts the exposures, shortest first.
    Dark(u32),
    /// One whole VSYNC period of exposure: every row lit once.
    Regular,
    /// The plan's point: `exposure_index * delays + delay_index`.
    Sweep(u32),
}

/// One point: frames under one setting that are averaged.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Point {
    /// What it is for.
    pub role: Role,
    /// Wanted t_d.
    pub delay_us: f64,
    /// Wanted t_e.
    pub exposure_us: f64,
    /// Frames to average.
    pub frames: u32,
}

/// All points of a run. A point's ordinal is its place in `points`.
#[derive(Debug, Clone, PartialEq)]
pub struct Schedule {
    /// In the order of acquisition: dark frames, the regular image, then the sweep.
    pub points: Vec<Point>,
}

impl Schedule {
    /// How many points the plan's sweep has.
    pub fn sweep_len(&self) -> usize {
        self.points.iter().filter(|point| matches!(point.role, Role::Sweep(_))).count()
    }

    /// How many dark points belong to it.
    pub fn dark_len(&self) -> usize {
        self.points.iter().filter(|point| matches!(point.role, Role::Dark(_))).count()
    }

    /// The dark point of an exposure.
    pub fn dark_of(&self, exposure_us: f64) -> Option<Role> {
        let dark = |point: &&Point| matches!(point.role, Role::Dark(_)) && point.exposure_us == exposure_us;
        self.points.iter().find(dark).map(|point| point.role)
    }
}

/// What turns counts and times into light transport: the rig, as the rig file states it.
#[derive(Debug, Clone, PartialEq)]
pub struct SweepGeometry {
    /// When the projector lights its rows, nominally: delays are measured against it.
    pub raster: Raster,
    /// When it lights them in truth: start of each row and end of the last, from the nominal start of row 0; none if no
    /// table was measured.
    pub row_table_us: Option<Arc<[f64]>>,
    /// Standard deviation of the beam over projector rows, 0 for the ideal beam; none if it is not known.
    pub beam_sigma_rows: Option<f64>,
    /// When within its row a pixel's direct light arrives.
    pub spot: Spot,
    /// Projector columns, 0 to 1 over its width, that the image's left and right edges see; none: not known.
    pub projector_columns: Option<[f64; 2]>,
    /// Projector row that camera row 0 sees.
    pub first_row: usize,
    /// Projector rows from one camera row to the next.
    pub row_pitch: f64,
    /// From the start of one camera row's exposure to the next row's.
    pub camera_row_time_us: f64,
    /// Camera rows.
    pub height: usize,
    /// Camera columns.
    pub width: usize,
    /// Counts, above black, of a white pixel in the time of one projector row.
    pub white_dn: f64,
    /// Counts from which on a pixel counts as saturated.
    pub saturation_dn: f64,
}

/// How the light of a row is drawn, which decides when within its row a pixel's direct light arrives.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Spot {
    /// The whole row at once: evenly over the row's time.
    Uniform,
    /// By a spot that flies along the row: at the moment when it passes the projector column that the pixel sees.
    Flying(Scan),
}

/// Which way a flying spot runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Scan {
    /// Nobody knows.
    Unknown,
    /// Every row from the first column to the last.
    OneWay,
    /// Odd rows backwards.
    Bidirectional,
}

/// How a camera must be set for a point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Shot {
    /// Its settings.
    pub settings: CameraSettings,
    /// Which edge's light is measured: the trigger's own (0) or a later one.
    pub light_edges_later: u32,
}

impl SweepGeometry {
    /// When rows are lit and exposed, as the model takes it. A beam that is not known counts as ideal.
    ///
    /// # Errors
    /// When table, beam or camera rows do not fit the raster.
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

    /// The way of a flying spot over the camera's columns, where the rig knows it.
    pub fn flying_spot(&self) -> Option<FlyingSpot> {
        let scan = match self.spot {
            Spot::Uniform | Spot::Flying(Scan::Unknown) => return None,
            Spot::Flying(Scan::OneWay) => calibrate::Scan::OneWay,
            Spot::Flying(Scan::Bidirectional) => calibrate::Scan::Bidirectional,
        };
        let [left, right] = self.projector_columns?;
        let column = |s: usize| left + (right - left) * (s as f64 + 0.5) / self.width as f64;
        Some(FlyingSpot { scan, columns: (0..self.width).map(column).collect() })
    }

    /// The same, where the model can take it into account: with an ideal beam.
    pub fn modelled_spot(&self) -> Option<FlyingSpot> {
        self.flying_spot().filter(|_| self.beam_sigma_rows == Some(0.0))
    }

    /// The settings for a point on a camera with this trigger latency.
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
