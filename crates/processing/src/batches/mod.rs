//! Batches of a flying dot: checks a plan and processes the columns.

mod calibration;
pub mod flat;
mod product;
mod report;
mod results;

use std::path::{Path, PathBuf};

use raysweep_config::{BatchesPlan, ConfigError, DotRigFile, Places, Plan, StageTable};
use raysweep_core::{CameraSettings, MirrorPath, PathError, PixelFormat, Shutter, decoding_message};
use raysweep_pipeline::Registry;
use raysweep_pipeline::dots::{ColumnStage, Scan};
use raysweep_session::dots::BatchColumns;
use raysweep_session::stack::Contents;
use raysweep_transport::dots::{Batch, BatchArrays, Correction, DotsError, FrameShape, Region, Sampling};
use serde::Deserialize;
use serde_json::Value;

pub use self::product::DotSpec;
pub use self::results::{keep_patterns, make};
use crate::mirror_response::Predistortion;
use crate::stored::{Asked, ProcessError, Processed, Stored};

/// A plan of batches on a dot rig: everything that acquisition and processing share.
pub struct DotTask {
    /// The plan's name.
    pub name: String,
    /// The plan's own table.
    pub batches: BatchesPlan,
    /// Size of the frames.
    pub shape: FrameShape,
    /// Pixel format of the frames.
    pub format: PixelFormat,
    /// The commanded mirror path of a batch.
    pub path: MirrorPath,
    /// Model that the path was predistorted with, if any.
    pub predistortion: Option<Predistortion>,
    /// The products to make.
    pub specs: Vec<DotSpec>,
    /// Corrections of single pixels.
    pub correct: CorrectOptions,
    denoise: StageTable,
    stages: Vec<StageTable>,
    places: Places,
}

/// For stages without options.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoOptions {}

/// Options of the stage `correct`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CorrectOptions {
    /// Earlier session whose flat field is used: its folder, or its name within the daemon's data folder.
    pub flat_field: Option<PathBuf>,
    /// Pixels whose dark level or noise lies more than this many standard deviations beyond the others' are hot.
    pub hot_sigmas: f64,
    /// Number of batches that the rolling background averages over.
    pub background_batches: u32,
}

impl Default for CorrectOptions {
    fn default() -> Self {
        Self { flat_field: None, hot_sigmas: 8.0, background_batches: 64 }
    }
}

impl DotTask {
    /// A plan on a rig with a camera of this size (rows, columns). `folder`, the daemon's data folder or the session,
    /// holds the identified mirror response, if the rig file uses it.
    ///
    /// # Errors
    /// With the position in the plan's text, for what this rig cannot do.
    pub fn new(
        plan: &Plan,
        batches: BatchesPlan,
        rig: &DotRigFile,
        format: PixelFormat,
        size: (usize, usize),
        folder: &Path,
    ) -> Result<Self, ConfigError> {
        let refused = |path: &[&str], message: String| plan.places.error(path, message);
        let shape = FrameShape::new(size.0, size.1, 1).map_err(|error| {
            refused(&["kind"], format!("the camera's frames: {error}; read out another region of its sensor"))
        })?;
        let region = scan(&batches, shape, batches.count).trailing_region;
        region.check(shape).map_err(|error| {
            refused(&["batches", "trailing_region"], format!("batches.trailing_region: {error}"))
        })?;
        let broken = |error: PathError| refused(&["batches", "path"], format!("batches.path: {error}"));
        let limits = rig.limits();
        let wanted = batches.mirror_path(&limits).map_err(broken)?;
        let predistortion = Predistortion::of(rig, folder)?;
        let path = match &predistortion {
            Some(Predistortion { responses, .. }) => {
                wanted.predistorted(*responses, &limits).map_err(broken)?
            }
            None => wanted,
        };
        let specs = DotSpec::all(plan, &batches)?;
        let (correct, denoise) = stages(plan, &batches)?;
        let (name, stages, places) = (plan.name.clone(), plan.stages.clone(), plan.places.clone());
        Ok(Self {
            name,
            batches,
            shape,
            format,
            path,
            predistortion,
            specs,
            correct,
            denoise,
            stages,
            places,
        })
    }

    /// What its session stores.
    pub fn contents(&self) -> Contents {
        Contents::Batches { batches: self.batches.total(), dots: self.batches.dots as usize }
    }

    /// What the pipeline extracts from the frames of one pass of `batches` batches.
    pub fn scan(&self, batches: u32) -> Scan {
        scan(&self.batches, self.shape, batches)
    }

    /// An error about a value of the plan.
    pub fn refuse(&self, path: &[&str], message: impl Into<String>) -> ConfigError {
        self.places.error(path, message)
    }

    /// An error about the plan's stage of this name.
    pub fn refuse_stage(&self, name: &str, message: impl Into<String>) -> ConfigError {
        let index = self.stages.iter().position(|stage| stage.name == name).unwrap_or(0);
        self.refuse(&["stage", &index.to_string(), "name"], message)
    }

    /// Whether a dot shows the scene.
    pub fn is_scene(&self, dot: usize) -> bool {
        self.scan(1).is_scene(dot as u32)
    }

    /// Camera settings for the batches.
    pub fn camera_settings(&self) -> CameraSettings {
        let exposure_us = self.batches.exposure_us;
        CameraSettings { shutter: Shutter::Global, exposure_us, trigger_delay_us: 0.0 }
    }

    /// Counts from which on a pixel is overexposed.
    pub fn saturation_dn(&self) -> u16 {
        crate::saturation_dn(self.format) as u16
    }

    /// The sensor's colour sampling.
    pub fn sampling(&self) -> Sampling {
        sampling(self.format)
    }

    /// The stage that makes columns from frames.
    ///
    /// # Errors
    /// For an unknown stage, or options that it does not take.
    pub fn stage(
        &self,
        registry: &Registry,
        correction: &Correction,
    ) -> Result<Box<dyn ColumnStage>, ConfigError> {
        let StageTable { name, options } = &self.denoise;
        registry
            .dots
            .make(name, Value::Object(options.clone()), correction)
            .map_err(|error| self.refuse_stage(name, error.to_string()))
    }
}

/// What the pipeline extracts from the frames of one pass of `count` batches.
fn scan(plan: &BatchesPlan, shape: FrameShape, count: u32) -> Scan {
    let [top, bottom, left, right] = plan.trailing_region;
    Scan {
        shape,
        dots: plan.dots,
        trailing_index: plan.trailing_index(),
        trailing_region: Region { rows: top..bottom, columns: left..right },
        background_indices: plan.background_indices.clone(),
        batches: count,
    }
}

/// Colour sampling of a sensor with this format.
pub fn sampling(format: PixelFormat) -> Sampling {
    match format.mosaic.red() {
        None => Sampling::Full,
        Some(_) => Sampling::Bayer,
    }
}

/// The stages of a plan: `correct`, if the plan has it, and the one that makes columns.
fn stages(plan: &Plan, batches: &BatchesPlan) -> Result<(CorrectOptions, StageTable), ConfigError> {
    let (mut correct, mut denoise) = (CorrectOptions::default(), None);
    for (index, stage) in plan.stages.iter().enumerate() {
        let refused = |message: String| plan.places.error(&["stage", &index.to_string(), "name"], message);
        if stage.name == "correct" {
            correct = serde_json::from_value(Value::Object(stage.options.clone()))
                .map_err(|error| decoding_message(&error.to_string(), "table"))
                .map_err(|what| refused(format!("stage correct: {what}")))?;
            let CorrectOptions { hot_sigmas, background_batches, .. } = correct;
            if !(hot_sigmas > 0.0 && hot_sigmas.is_finite()) {
                return Err(refused(format!(
                    "stage correct: hot_sigmas = {hot_sigmas}: must be more than 0; 8 is usual"
                )));
            }
            if background_batches == 0 {
                return Err(refused(
                    "stage correct: background_batches = 0: must be at least 1; 64 is usual".into(),
                ));
            }
            if correct.flat_field.is_some() && batches.flat_frames > 0 {
                return Err(refused(
                    "stage correct: flat_field and batches.flat_frames exclude each other: use an earlier session's flat field, or acquire one".into(),
                ));
            }
        } else if denoise.replace(stage.clone()).is_some() {
            return Err(refused(format!(
                "{} is the second stage that turns frames into columns: keep one",
                stage.name
            )));
        }
    }
    let default = || StageTable { name: "denoise".into(), options: serde_json::Map::new() };
    Ok((correct, denoise.unwrap_or_else(default)))
}

/// Converts a stored batch for the products; also returns which of its dots show the scene.
pub fn from_stored(shape: FrameShape, columns: BatchColumns) -> Result<(Batch, Vec<bool>), DotsError> {
    let BatchColumns { word_offsets, words, masks, values, residual, discs, capped, seen } = columns;
    let arrays = BatchArrays { word_offsets, words, masks, values, residual, discs, capped };
    Ok((Batch::new(shape, arrays)?, seen))
}

/// The inverse of [`from_stored`].
pub fn to_stored(arrays: BatchArrays, seen: Vec<bool>) -> BatchColumns {
    let BatchArrays { word_offsets, words, masks, values, residual, discs, capped } = arrays;
    BatchColumns { word_offsets, words, masks, values, residual, discs, capped, seen }
}

/// Reprocesses stored batches.
///
/// # Errors
/// When a product cannot be made from them, before anything is written; when the session cannot be written.
pub fn process(stored: &Stored<'_>, batches: BatchesPlan, asked: &Asked) -> Result<Processed, ProcessError> {
    let Stored { session, state, plan, .. } = stored;
    let rig = stored.dot_rig()?;
    let shape = state.session.shape;
    let size = (shape.rows, shape.columns);
    let task = DotTask::new(plan, batches, &rig, rig.camera.pixel_format, size, session.dir())
        .map_err(|error| ProcessError::Config(error.to_string()))?;
    stored.check_contents(task.contents())?;
    let mut specs = if asked.only { Vec::new() } else { task.specs.clone() };
    for argument in &asked.products {
        for spec in DotSpec::of_argument(argument).map_err(ProcessError::Product)? {
            specs.retain(|other| other.name != spec.name);
            specs.push(spec);
        }
    }
    let problems = make(session, state, &task, &rig, &specs, Vec::new(), &|| true)?;
    Ok(Processed {
        report: session.report_path(),
        stored: state.stored_points(),
        points: shape.points(),
        problems,
    })
}
