//! What is true of a simulated plane rig, which its rig file need not say.

use raysweep_config::sim::{SimConfig, SimTruth};
use raysweep_core::Raster;

use crate::error::SimError;

/// What is true of a simulated plane rig: the rig file's values, or those of its `[sim.truth]`.
#[derive(Debug, Clone)]
pub struct PlaneTruth {
    /// Raster timing of the projector, without its row table.
    pub raster: Raster,
    /// Row time of the camera.
    pub camera_row_time_us: f64,
    /// Projector rows from one camera row to the next, before magnification.
    pub row_pitch: f64,
    /// Projector row of the scene's first row.
    pub first_row: usize,
    /// Time from the trigger edge to the start of row 0's exposure, at a trigger delay of zero.
    pub trigger_latency_us: f64,
    /// Counts, above black, of a white pixel in the time of one projector row.
    pub white_dn: f64,
    /// Counts without light.
    pub black_dn: f64,
    /// The row pitch that the scene was made for.
    scene_pitch: f64,
    row_offset_rows: f64,
    rotation_tan: f64,
    magnification: f64,
    /// Camera rows and columns.
    size: (usize, usize),
}

/// What the rig file says.
pub(crate) struct Stated {
    pub raster: Raster,
    pub camera_row_time_us: f64,
    pub row_pitch: f64,
    /// Projector row of the scene's first row.
    pub first_row: usize,
    pub white_dn: f64,
    pub black_dn: f64,
}

impl PlaneTruth {
    /// The truth of a rig whose camera has `size` rows and columns and whose scene has `scene_rows` rows.
    ///
    /// # Errors
    /// When rows end after the period, or pixels look beyond the projector.
    pub(crate) fn new(
        config: &SimConfig,
        stated: Stated,
        size: (usize, usize),
        scene_rows: usize,
    ) -> Result<Self, SimError> {
        let told = &config.truth;
        let truth = Self {
            raster: Raster {
                row_time_us: told.row_time_us.unwrap_or(stated.raster.row_time_us),
                first_row_us: told.first_row_us.unwrap_or(stated.raster.first_row_us),
                ..stated.raster
            },
            camera_row_time_us: told.camera_row_time_us.unwrap_or(stated.camera_row_time_us),
            row_pitch: told.row_pitch.unwrap_or(stated.row_pitch),
            first_row: told.first_projector_row.unwrap_or(stated.first_row),
            trigger_latency_us: told.trigger_latency_us.unwrap_or(config.camera.trigger_latency_us),
            white_dn: told.white_dn.unwrap_or(stated.white_dn),
            black_dn: told.black_dn.unwrap_or(stated.black_dn),
            scene_pitch: stated.row_pitch,
            row_offset_rows: told.row_offset_rows,
            rotation_tan: told.rotation_deg.to_radians().tan(),
            magnification: told.magnification,
            size,
        };
        truth.check(told, scene_rows)?;
        Ok(truth)
    }

    fn check(&self, told: &SimTruth, scene_rows: usize) -> Result<(), SimError> {
        let end_us = self.raster.first_row_us + self.raster.rows as f64 * self.raster.row_time_us;
        let timed = [
            ("truth.row_time_us", told.row_time_us.is_some()),
            ("truth.first_row_us", told.first_row_us.is_some()),
        ];
        if let Some((key, _)) = timed.iter().find(|(_, is_told)| *is_told)
            && end_us > self.raster.period_us
        {
            return Err(SimError::TruthPeriod { key, end_us, period_us: self.raster.period_us });
        }
        let placed = [
            ("truth.first_projector_row", told.first_projector_row.is_some()),
            ("truth.row_offset_rows", told.row_offset_rows != 0.0),
            ("truth.rotation_deg", told.rotation_deg != 0.0),
            ("truth.magnification", told.magnification != 1.0),
            ("truth.row_pitch", told.row_pitch.is_some()),
        ];
        let Some((key, _)) = placed.iter().find(|(_, is_told)| *is_told) else { return Ok(()) };
        // Places change linearly over the image, so the corners are the extremes.
        let (mut from_row, mut to_row) = (f64::INFINITY, f64::NEG_INFINITY);
        for t in [0, self.size.0 - 1] {
            for s in [0, self.size.1 - 1] {
                let (place, scene) = (self.place(t, s), self.first_row as f64 + self.shift_rows(t, s));
                from_row = from_row.min(place).min(scene);
                to_row = to_row.max(place + 1.0).max(scene + scene_rows as f64);
            }
        }
        if from_row < 0.0 || to_row > self.raster.rows as f64 {
            return Err(SimError::TruthRows { key, from_row, to_row, projector_rows: self.raster.rows });
        }
        Ok(())
    }

    /// Projector row, with its fraction, at which a camera pixel looks; whole numbers are the centres of rows.
    pub fn place(&self, t: usize, s: usize) -> f64 {
        self.first_row as f64 + self.scene_pitch * t as f64 + self.shift_rows(t, s)
    }

    /// By how many projector rows a pixel looks further down than in the scene.
    pub(crate) fn shift_rows(&self, t: usize, s: usize) -> f64 {
        let from_middle = |at: usize, count: usize| at as f64 - (count as f64 - 1.0) / 2.0;
        let (t_middle, s_middle) = (from_middle(t, self.size.0), from_middle(s, self.size.1));
        self.row_offset_rows
            + (self.row_pitch - self.scene_pitch) * t as f64
            + self.rotation_tan * s_middle * self.row_pitch
            + (self.magnification - 1.0) * t_middle * self.row_pitch
    }

    /// Camera rows and columns.
    pub(crate) fn size(&self) -> (usize, usize) {
        self.size
    }
}
