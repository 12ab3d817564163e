//! The dot rig: what a plan of batches amounts to, and what is made of its columns.

mod calibration;
pub(crate) mod check;
pub(crate) mod flat;
mod product;
mod report;
mod results;

use std::path::{Path, PathBuf};

use raysweep_core::{CameraCapabilities, CameraSettings, MirrorPath, PathError, PixelFormat, Shutter};
use raysweep_pipeline::Registry;
use raysweep_pipeline::dots::ColumnStage;
use raysweep_session::dots::BatchColumns;
use raysweep_session::stack::StackShape;
use raysweep_transport::dots::{Batch, BatchArrays, Correction, DotsError, FrameShape, Sampling};
use serde::Deserialize;
use serde_json::Value;

pub(crate) use self::product::DotSpec;
pub(crate) use self::results::{keep_patterns, make};
use crate::config::{BatchesPlan, ConfigError, DotRigFile, Plan, PlanKind, StageTable};
use crate::processing::SATURATION;
use crate::response::Predistortion;

/// A plan of batches on a dot rig: everything that acquisition and processing have in common.
pub struct DotTask {
    /// The plan.
    pub plan: Plan,
    /// Size of the frames.
    pub shape: FrameShape,
    /// How they are packed.
    pub format: PixelFormat,
    /// What the mirror is told to do in a batch.
    pub path: MirrorPath,
    /// By what that was distorted beforehand.
    pub predistortion: Option<Predistortion>,
    /// What is made of the batches.
    pub specs: Vec<DotSpec>,
    /// What is known and done of single pixels.
    pub correct: CorrectOptions,
    denoise: StageTable,
}

/// Which of a plan's stages has this name.
fn place_of(plan: &Plan, name: &str) -> String {
    plan.stage.iter().position(|stage| stage.name == name).unwrap_or(0).to_string()
}

/// What has no options.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NoOptions {}

/// Options of the stage `correct`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CorrectOptions {
    /// An earlier session whose flat field serves: its folder, or its name within the daemon's data folder.
    pub flat_field: Option<PathBuf>,
    /// Pixels whose dark level or noise lies so many standard deviations beyond the others' are hot.
    pub hot_sigmas: f64,
    /// Batches that the rolling background is worth.
    pub background_batches: u32,
}

impl Default for CorrectOptions {
    fn default() -> Self {
        Self { flat_field: None, hot_sigmas: 8.0, background_batches: 64 }
    }
}

impl DotTask {
    /// A plan on a rig with a camera of this size (rows, columns); `text` is the plan's. `folder` has what was identified
    /// of the rig's mirror, if the rig file wants that: the daemon's data, or the session.
    ///
    /// # Errors
    /// With the place in the plan's text, for what this rig cannot do.
    pub fn new(
        plan: Plan,
        text: &str,
        rig: &DotRigFile,
        format: PixelFormat,
        size: (usize, usize),
        folder: &Path,
    ) -> Result<Self, ConfigError> {
        if plan.kind != PlanKind::Batches {
            let name = plan.kind.name();
            let message =
                format!("kind = \"{name}\": a dot rig runs plans of kind \"batches\" and \"response\"");
            return Err(ConfigError::at(text, &["kind"], message));
        }
        let refused = |path: &[&str], message: String| ConfigError::at(text, path, message);
        let shape = FrameShape::new(size.0, size.1, 1).map_err(|error| {
            refused(&["kind"], format!("the camera's frames: {error}; read out another region of its sensor"))
        })?;
        let scan = plan.batches.scan(shape, plan.batches.count);
        scan.trailing_region.check(shape).map_err(|error| {
            refused(&["batches", "trailing_region"], format!("batches.trailing_region: {error}"))
        })?;
        let broken = |error: PathError| refused(&["batches", "path"], format!("batches.path: {error}"));
        let limits = rig.limits();
        let wanted = plan.batches.mirror_path(&limits).map_err(broken)?;
        let predistortion = Predistortion::of(rig, folder)?;
        let path = match &predistortion {
            Some(Predistortion { responses, .. }) => {
                wanted.predistorted(*responses, &limits).map_err(broken)?
            }
            None => wanted,
        };
        let specs = DotSpec::all(&plan, text)?;
        let (correct, denoise) = stages(&plan, text)?;
        Ok(Self { plan, shape, format, path, predistortion, specs, correct, denoise })
    }

    /// The plan's own table.
    pub fn batches(&self) -> &BatchesPlan {
        &self.plan.batches
    }

    /// Whether a dot shows the scene.
    pub fn is_scene(&self, dot: usize) -> bool {
        self.batches().scan(self.shape, 1).is_scene(dot as u32)
    }

    /// How the camera is set.
    pub fn camera_settings(&self) -> CameraSettings {
        let exposure_us = self.batches().exposure_us;
        CameraSettings { shutter: Shutter::Global, exposure_us, trigger_delay_us: 0.0 }
    }

    /// What the session's folder is made for.
    pub fn stack_shape(&self) -> StackShape {
        StackShape {
            points: self.batches().total(),
            exposures: 0,
            rows: self.shape.height(),
            columns: self.shape.width(),
            settings: 0,
            dots: self.batches().dots as usize,
        }
    }

    /// Counts from which on a pixel is overexposed: wells may be full before the converter is.
    pub fn saturation_dn(&self) -> u16 {
        (SATURATION * f64::from(self.format.max_value())) as u16
    }

    /// How the sensor samples colour.
    pub fn sampling(&self) -> Sampling {
        sampling(self.format)
    }

    /// What makes columns of frames.
    ///
    /// # Errors
    /// For a stage that is unknown, or options that it does not take.
    pub fn stage(
        &self,
        registry: &Registry,
        correction: &Correction,
        text: &str,
    ) -> Result<Box<dyn ColumnStage>, ConfigError> {
        let StageTable { name, options } = &self.denoise;
        let index = place_of(&self.plan, name);
        registry
            .dots
            .make(name, Value::Object(options.clone()), correction)
            .map_err(|error| ConfigError::at(text, &["stage", &index, "name"], error.to_string()))
    }
}

/// How a sensor with this format samples colour.
pub(crate) fn sampling(format: PixelFormat) -> Sampling {
    match format.mosaic.red() {
        None => Sampling::Full,
        Some(_) => Sampling::Bayer,
    }
}

/// The stages of a plan: `correct`, if it is named, and one that makes columns.
fn stages(plan: &Plan, text: &str) -> Result<(CorrectOptions, StageTable), ConfigError> {
    let (mut correct, mut denoise) = (CorrectOptions::default(), None);
    for (index, stage) in plan.stage.iter().enumerate() {
        let refused =
            |message: String| ConfigError::at(text, &["stage", &index.to_string(), "name"], message);
        if stage.name == "correct" {
            correct = serde_json::from_value(Value::Object(stage.options.clone()))
                .map_err(|error| refused(format!("stage correct: {error}")))?;
            let CorrectOptions { hot_sigmas, background_batches, .. } = correct;
            if !(hot_sigmas > 0.0 && hot_sigmas.is_finite()) {
                return Err(refused(format!(
                    "stage correct: hot_sigmas = {hot_sigmas}: give more than 0, as 8"
                )));
            }
            if background_batches == 0 {
                return Err(refused(
                    "stage correct: background_batches = 0: give at least 1; 64 is usual".into(),
                ));
            }
            if correct.flat_field.is_some() && plan.batches.flat_frames > 0 {
                return Err(refused(
                    "stage correct: flat_field beside batches.flat_frames: take a flat field, or use an earlier session's".into(),
                ));
            }
        } else if denoise.replace(stage.clone()).is_some() {
            return Err(refused(format!(
                "{} is a second stage that makes columns of frames: keep one",
                stage.name
            )));
        }
    }
    let default = || StageTable { name: "denoise".into(), options: serde_json::Map::new() };
    Ok((correct, denoise.unwrap_or_else(default)))
}

/// A stored batch as the products take it; which of its dots show the scene.
pub(crate) fn from_stored(shape: FrameShape, columns: BatchColumns) -> Result<(Batch, Vec<bool>), DotsError> {
    let BatchColumns { word_offsets, words, masks, values, residual, discs, capped, seen } = columns;
    let arrays = BatchArrays { word_offsets, words, masks, values, residual, discs, capped };
    Ok((Batch::new(shape, arrays)?, seen))
}

/// The way back.
pub(crate) fn to_stored(arrays: BatchArrays, seen: Vec<bool>) -> BatchColumns {
    let BatchArrays { word_offsets, words, masks, values, residual, discs, capped } = arrays;
    BatchColumns { word_offsets, words, masks, values, residual, discs, capped, seen }
}

/// Checks a camera against a task.
///
/// # Errors
/// What the camera cannot do.
pub(crate) fn allows(task: &DotTask, camera: &CameraCapabilities, text: &str) -> Result<(), ConfigError> {
    camera
        .allows(&task.camera_settings())
        .map_err(|message| ConfigError::at(text, &["batches", "exposure_us"], format!("batches.{message}")))
}

/// Bytes free where a folder is, or will be.
pub(crate) fn free_bytes(data: &Path) -> u64 {
    let existing = data.ancestors().find(|folder| folder.exists()).unwrap_or(Path::new("/"));
    raysweep_session::durable::available_bytes(existing).unwrap_or(u64::MAX)
}
