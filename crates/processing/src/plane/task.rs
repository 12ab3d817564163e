//! The points of a plan on the plane rig, and the model that turns counts into light.

use std::sync::Arc;

use ndarray::Array2;
use raysweep_config::rig::plane::{ScanKind, SpotKind};
use raysweep_config::{ConfigError, Places, Plan, RigFile, StageTable};
use raysweep_core::{Mosaic, PixelFormat, SettingsId, decoding_message};
use raysweep_pipeline::{
    DEMUX, DemuxFold, DemuxOptions, HOT_PIXELS, PlaneStage, Point, PointRole, Schedule, Spot, SpotScan,
    StageRefused, Stages, SweepGeometry, Unit,
};
use raysweep_session::ledger::{PointEntry, State};
use raysweep_session::stack::ArrayName;
use raysweep_transport::plane::board::BoardCalibration;
use serde_json::{Map, Value, json};

use crate::saturation::saturation_dn;
use crate::software::SOFTWARE;

/// The points of a plan on a plane rig: everything that acquisition and processing share.
#[derive(Clone)]
pub struct PlaneTask {
    /// The plan's name.
    pub name: String,
    /// Stages that process each image.
    pub stages: Vec<StageTable>,
    /// Frames whose measured delay deviates by more than this are dropped.
    pub max_jitter_us: f64,
    /// The points to acquire.
    pub schedule: Schedule,
    /// The model that turns counts into light transport.
    pub geometry: SweepGeometry,
    /// What the camera's pixels see.
    pub mosaic: Mosaic,
    /// When the calibration was made that the model uses, as its file says it; `None` without one.
    pub calibration_made: Option<String>,
    /// What is damaged and is left out of the results.
    pub left_out: Vec<String>,
    /// The kind of the plan, which is also the name of its table.
    table: &'static str,
    places: Places,
}

/// A plane rig, as far as it is known before a plan runs on it.
#[derive(Debug, Clone)]
pub struct KnownRig<'a> {
    /// Its file.
    pub file: &'a RigFile,
    /// The projector row that camera row 0 sees, according to the file.
    pub first_row: usize,
    /// Rows and columns of the camera's images.
    pub size: (usize, usize),
    /// What a calibration of this rig says of it, if there is one.
    pub calibration: Option<KnownCalibration>,
}

/// A calibration, and when it was made.
#[derive(Debug, Clone)]
pub struct KnownCalibration {
    /// Date and time, as reports and metadata should give it.
    pub made: String,
    /// What it measured.
    pub board: Arc<BoardCalibration>,
}

impl PlaneTask {
    /// The points of `plan` on a rig.
    pub fn new(plan: &Plan, schedule: Schedule, max_jitter_us: f64, rig: &KnownRig<'_>) -> Self {
        let &KnownRig { file: rig, first_row, size, ref calibration } = rig;
        let stated = SweepGeometry {
            raster: rig.raster(),
            row_table_us: rig.projector.row_table.as_deref().map(Into::into),
            beam_sigma_rows: rig.projector.beam_sigma_rows,
            spot: spot(rig.projector.spot, rig.projector.scan),
            projector_columns: rig.camera.projector_columns,
            first_row,
            row_pitch: rig.camera.row_pitch,
            camera_row_time_us: rig.camera_row_time_us(),
            height: size.0,
            width: size.1,
            white_dn: rig.camera.white_dn(),
            black_dn: rig.camera.black_dn(),
            saturation_dn: saturation_dn(rig.camera.pixel_format),
            calibration: None,
        };
        let (geometry, calibration_made) = match calibration {
            Some(KnownCalibration { made, board }) => (stated.calibrated(board.clone()), Some(made.clone())),
            None => (stated, None),
        };
        let (name, stages, places) = (plan.name.clone(), plan.stages.clone(), plan.places.clone());
        let table = plan.procedure.kind();
        let left_out = Vec::new();
        let mosaic = rig.camera.pixel_format.mosaic;
        Self {
            name,
            stages,
            max_jitter_us,
            schedule,
            geometry,
            mosaic,
            calibration_made,
            left_out,
            table,
            places,
        }
    }

    /// The points of the sweep, or the settings of the film's cycle, with their ordinals.
    pub fn settings(&self) -> impl Iterator<Item = (u32, &Point)> {
        (0..).zip(&self.schedule.points).filter(|(_, point)| matches!(point.role, PointRole::Sweep(_)))
    }

    /// What of a session's ledger was not acquired with these settings, if anything.
    pub fn unlike(&self, state: &State) -> Option<String> {
        self.schedule.points.iter().find_map(|point| {
            let (array, index) = place(point.role);
            let stored = state.point(array, index).filter(|stored| stored.delay_us != point.delay_us)?;
            let (planned_us, stored_us) = (point.delay_us, stored.delay_us);
            let name = array.as_str();
            Some(format!(
                "{name} {index} was acquired at a delay of {stored_us} us, and the plan says {planned_us}"
            ))
        })
    }

    /// An error about a value of the plan.
    pub fn refuse(&self, path: &[&str], message: impl Into<String>) -> ConfigError {
        self.places.error(path, message)
    }

    /// The plan's stage `demux`.
    pub(crate) fn demux_table(&self) -> Option<&StageTable> {
        self.stages.iter().find(|stage| stage.name == DEMUX)
    }

    /// The options of `demux` in the plan.
    ///
    /// # Errors
    /// When the plan has options that `demux` does not know.
    pub fn demux_options(&self) -> Result<DemuxOptions, ConfigError> {
        let Some(stage) = self.demux_table() else { return Ok(DemuxOptions::default()) };
        serde_json::from_value(Value::Object(stage.options.clone())).map_err(|error| {
            let what = decoding_message(&error.to_string(), "table");
            self.refuse(&["stage"], format!("stage demux: {what}"))
        })
    }

    /// The stages that the plan names, and what demultiplexes their images.
    ///
    /// # Errors
    /// With the position in the plan of a stage that cannot be made, or of a second `demux`.
    pub(crate) fn made_stages(&self) -> Result<(Stages, Option<DemuxFold>), ConfigError> {
        let (mut stages, mut demux) = (Vec::new(), None);
        for (index, table) in self.stages.iter().enumerate() {
            let place = index.to_string();
            let refuse = |message: String| self.refuse(&["stage", &place, "name"], message);
            let made = PlaneStage::new(&table.name, Value::Object(table.options.clone()));
            match made.map_err(|error| self.refuse_stage(&place, &error))? {
                PlaneStage::Image(stage) => stages.push(stage),
                PlaneStage::Demux(options) => {
                    let fold = DemuxFold::new(options, &self.schedule, &self.geometry)
                        .map_err(|error| self.no_model(&place, &error))?;
                    if demux.replace(fold).is_some() {
                        return Err(refuse(format!(
                            "{DEMUX} is named twice, and its products would overwrite each other: keep one"
                        )));
                    }
                }
            }
        }
        Ok((stages.into(), demux))
    }

    /// An error about an option of the stage at an index of the plan.
    fn refuse_stage(&self, index: &str, error: &StageRefused) -> ConfigError {
        let key = error.key().filter(|key| self.places.has(&["stage", index, key])).unwrap_or("name");
        self.refuse(&["stage", index, key], error.to_string())
    }

    /// An error of `demux`: about one of its options, or about settings that give no model.
    fn no_model(&self, index: &str, error: &StageRefused) -> ConfigError {
        if error.key().is_some_and(|key| self.places.has(&["stage", index, key])) {
            return self.refuse_stage(index, error);
        }
        let (first_us, last_us) = self.delays_with_light();
        let message = format!(
            "{}.delay_us{}: {}; exposures see the projector's rows at delays from {first_us:.0} to {last_us:.0} us",
            self.table,
            self.delays_text(),
            error.what()
        );
        self.refuse(&[self.table, "delay_us"], message)
    }

    /// The smallest and the largest delay at which the shortest exposure sees a row of the projector from some camera
    /// row.
    fn delays_with_light(&self) -> (f64, f64) {
        let shortest = self.settings().map(|(_, point)| point.exposure_us).fold(f64::INFINITY, f64::min);
        self.delays_with_light_at(if shortest.is_finite() { shortest } else { 0.0 })
    }

    fn delays_with_light_at(&self, exposure_us: f64) -> (f64, f64) {
        let geometry = &self.geometry;
        let row_us = geometry.raster.row_time_us;
        let last = geometry.height.saturating_sub(1) as f64;
        let seen = geometry.first_row as f64 + geometry.row_pitch * last;
        let below = geometry.raster.rows as f64 - geometry.first_row as f64 - 0.5;
        let half_us = exposure_us / 2.0;
        (-(seen + 0.5) * row_us - half_us, below * row_us + half_us)
    }

    /// The number of settings whose exposures see no row of the projector, and the delays between which they would.
    pub fn without_light(&self) -> (usize, (f64, f64)) {
        let blind = self.settings().filter(|(_, point)| {
            let (first_us, last_us) = self.delays_with_light_at(point.exposure_us);
            !(first_us < point.delay_us && point.delay_us < last_us)
        });
        (blind.count(), self.delays_with_light())
    }

    fn delays_text(&self) -> String {
        let delays = || self.settings().map(|(_, point)| point.delay_us);
        let (low, high) =
            (delays().fold(f64::INFINITY, f64::min), delays().fold(f64::NEG_INFINITY, f64::max));
        if low == high { format!(" = {low}") } else { format!(" from {low} to {high}") }
    }

    /// Metadata that all products share.
    pub(crate) fn metadata(&self) -> Map<String, Value> {
        let geometry = &self.geometry;
        let mut entries = vec![
            ("units", json!("1 = a white pixel lit by its own projector row")),
            ("plan", json!(self.name)),
            (DEMUX, json!(self.demux_table().map(|stage| &stage.options))),
            ("row_time_us", json!(geometry.row_time_us())),
            ("first_row", json!(geometry.first_row)),
            ("row_pitch", json!(geometry.row_pitch)),
            ("camera_row_time_us", json!(geometry.camera_row_time_us)),
            ("software", json!(SOFTWARE)),
        ];
        if !self.left_out.is_empty() {
            entries.push(("left_out", json!(self.left_out)));
        }
        match &self.calibration_made {
            Some(made) => entries.push(("calibration", json!({ "made": made }))),
            None => entries.extend([
                ("row_table", json!(geometry.row_table_us.is_some())),
                ("beam_sigma_rows", json!(geometry.beam_sigma_rows)),
                ("white_dn", json!(geometry.white_dn)),
            ]),
        }
        entries.into_iter().map(|(key, value)| (key.to_owned(), value)).collect()
    }
}

/// Checks that the stages of a plan for a new run compare pixels of one colour: those that are two apart, if and only if
/// the camera's pixels have a mosaic.
///
/// # Errors
/// With the position of the option in the plan.
pub fn check_mosaic(plan: &Plan, format: PixelFormat) -> Result<(), ConfigError> {
    let step_px = |stage: &StageTable| match stage.options.get("step_px") {
        None if stage.name == HOT_PIXELS => Some(1),
        value => value.and_then(Value::as_u64),
    };
    let (wanted_px, why) = match format.mosaic.red() {
        None => (1, "has no Bayer mosaic"),
        Some(_) => (2, "has a Bayer mosaic, where neighbours see other colours"),
    };
    let wrong = plan.stages.iter().enumerate().find_map(|(index, stage)| {
        let step_px = step_px(stage).filter(|step_px| [1, 2].contains(step_px) && *step_px != wanted_px)?;
        Some((index, &stage.name, step_px))
    });
    match wrong {
        None => Ok(()),
        Some((index, name, step_px)) => {
            let message = format!(
                "stage {name}: step_px = {step_px}: must be {wanted_px}, because camera.pixel_format = \"{format}\" {why}"
            );
            Err(plan.places.error(&["stage", &index.to_string(), "step_px"], message))
        }
    }
}

/// Distribution over time of a pixel's direct light within its row.
fn spot(kind: SpotKind, scan: Option<ScanKind>) -> Spot {
    match (kind, scan) {
        (SpotKind::Uniform, _) => Spot::Uniform,
        (SpotKind::Flying, None | Some(ScanKind::Unknown)) => Spot::Flying(SpotScan::Unknown),
        (SpotKind::Flying, Some(ScanKind::OneWay)) => Spot::Flying(SpotScan::OneWay),
        (SpotKind::Flying, Some(ScanKind::Bidirectional)) => Spot::Flying(SpotScan::Bidirectional),
    }
}

/// Position of a point in the stack.
pub fn place(role: PointRole) -> (ArrayName, usize) {
    match role {
        PointRole::Sweep(index) | PointRole::Bracket(index) => (ArrayName::Sum, index as usize),
        PointRole::Dark(index) => (ArrayName::Dark, index as usize),
        PointRole::Regular => (ArrayName::Regular, 0),
    }
}

/// A stored point, in the form in which the pipeline delivered it.
pub(crate) fn unit_of(
    ordinal: u32,
    entry: &PointEntry,
    sum: Array2<u32>,
    clipped: Option<Array2<u32>>,
) -> Unit {
    Unit {
        id: SettingsId { point: ordinal, attempt: entry.attempt },
        frames: entry.frames,
        delay_us: entry.delay_us,
        exposure_us: entry.exposure_us,
        delays_us: entry.delays_us.clone(),
        run: entry.exposed.as_ref().map_or(0, |exposed| exposed.run),
        starts_ns: entry.exposed.as_ref().map_or_else(Vec::new, |exposed| exposed.starts_ns.clone()),
        sum: Arc::new(sum),
        clipped: clipped.map(Arc::new),
        counts: entry.counts.clone(),
    }
}
