//! A plan of batches on a dot rig: its path, stages and products.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use raysweep_config::{BatchesPlan, ConfigError, DotRigFile, Places, Plan, StageTable};
use raysweep_core::{
    CameraSettings, MechanicalDeg, MirrorPath, PathError, PixelFormat, Shutter, decoding_message,
};
use raysweep_pipeline::dots::{ColumnStage, DotScan, column_stage};
use raysweep_session::pattern::PatternFile;
use raysweep_session::stack::Contents;
use raysweep_transport::dots::{Correction, FrameShape, Region, Sampling};
use serde::Deserialize;
use serde_json::Value;

use super::product::DotSpec;
use crate::mirror_response::Predistortion;
use crate::saturation::saturation_dn;

/// Memory for one value of an image while it is drawn and written: the image, its holes being filled, its copies as
/// NPY and EXR. A generous estimate: the code holds about 24 bytes for a value of `dual`, which needs most.
const DRAWN_BYTES: u64 = 40;
/// Disk space of one value of a video: NPY, EXR and PNG.
const STORED_BYTES: u64 = 12;
/// Memory of a video's pictures in the report.
const STRIP_BYTES: u64 = (6 * 3) << 20;
/// Memory for each pair of dots in the confusion matrix while it is written: its image, and its copies as NPY and EXR.
const CONFUSION_BYTES: u64 = 24;

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
    /// Direction of the beam in the middle of each frame's exposure, as tangents, if the mirror goes where the plan
    /// wants it; `None` for frames that do not show the scene.
    pub(super) directions: Vec<Option<[f64; 2]>>,
    /// Model that the path was predistorted with, if any.
    pub predistortion: Option<Predistortion>,
    /// The products to make.
    pub specs: Vec<DotSpec>,
    /// Corrections of single pixels.
    pub correct: CorrectOptions,
    /// Folders whose files the plan may name.
    pub(super) folders: Vec<PathBuf>,
    denoise: StageTable,
    stages: Vec<StageTable>,
    places: Places,
}

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
        let directions = directions(&batches, &wanted, rig.incidence());
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
            directions,
            predistortion,
            specs,
            correct,
            folders: rig.plan_folders.clone(),
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
    pub fn scan(&self, batches: u32) -> DotScan {
        scan(&self.batches, self.shape, batches)
    }

    /// Memory that making the products takes at most, in bytes. Reads the headers of the plan's pattern files.
    ///
    /// # Errors
    /// For a pattern file that is not allowed, or none.
    pub fn products_bytes(&self) -> Result<u64, ConfigError> {
        let mut patterns = 0;
        for (index, spec) in self.specs.iter().enumerate() {
            let of_place = |message| self.refuse(&["product", &index.to_string(), "image"], message);
            if let Some(pattern) = self.open_pattern(spec).map_err(of_place)? {
                patterns += pattern.bytes();
            }
        }
        let drawn = self.specs.iter().map(|spec| spec.values(self) * DRAWN_BYTES).max().unwrap_or(0);
        let shown = self.specs.iter().map(|spec| spec.videos().len() as u64).sum::<u64>() * STRIP_BYTES;
        let dots = u64::from(self.batches.dots);
        let confusion = if self.batches.calibration.is_empty() { 0 } else { CONFUSION_BYTES * dots * dots };
        // While a pattern is read, its file is in memory as well.
        Ok(3 * patterns + drawn + shown + confusion)
    }

    /// Disk space of the products, in bytes.
    pub fn products_disk_bytes(&self) -> u64 {
        let values = self.specs.iter().map(|spec| spec.values(self)).sum::<u64>();
        u64::from(self.batches.count) * values * STORED_BYTES
    }

    /// Opens the pattern file of a product, if it has one.
    ///
    /// # Errors
    /// What is wrong with the file, or where it must be.
    pub(super) fn open_pattern(&self, spec: &DotSpec) -> Result<Option<PatternFile>, String> {
        let Some(path) = spec.pattern_file() else { return Ok(None) };
        let opened = PatternFile::open_below(&self.folders, path);
        let folders = self.folders.iter().map(|folder| folder.display().to_string()).collect::<Vec<_>>();
        let allowed = if folders.is_empty() { "none".into() } else { folders.join(", ") };
        opened.map(Some).map_err(|error| {
            format!(
                "product {}: image = {:?}: {error}; the folders that a plan may name files in are those of `plan_folders` in the rig file: {allowed}",
                spec.name,
                path.display().to_string()
            )
        })
    }

    /// An error about a value of the plan.
    pub fn refuse(&self, path: &[&str], message: impl Into<String>) -> ConfigError {
        self.places.error(path, message)
    }

    /// An error about a key of the plan's stage of this name.
    pub fn refuse_stage(&self, name: &str, key: &str, message: impl Into<String>) -> ConfigError {
        let index = self.stages.iter().position(|stage| stage.name == name).unwrap_or(0);
        self.refuse(&["stage", &index.to_string(), key], message)
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
        saturation_dn(self.format) as u16
    }

    /// The sensor's colour sampling.
    pub fn sampling(&self) -> Sampling {
        sampling(self.format)
    }

    /// The stage that makes columns from frames.
    ///
    /// # Errors
    /// For an unknown stage, or options that it does not take.
    pub fn stage(&self, correction: &Correction) -> Result<Arc<dyn ColumnStage>, ConfigError> {
        let StageTable { name, options } = &self.denoise;
        column_stage(name, Value::Object(options.clone()), correction).map_err(|error| {
            let is_in_plan = |key: &&str| self.stages.iter().any(|stage| stage.options.contains_key(*key));
            self.refuse_stage(name, error.key().filter(is_in_plan).unwrap_or("name"), error.to_string())
        })
    }
}

/// Direction of the beam in the middle of each frame's exposure, which begins with the frame.
fn directions(plan: &BatchesPlan, path: &MirrorPath, incidence: MechanicalDeg) -> Vec<Option<[f64; 2]>> {
    let points = path.points();
    let is_dark = |index: u32| index == plan.trailing_index() || plan.background_indices.contains(&index);
    let middle = 0.5e-6 * plan.exposure_us * path.rate_hz();
    let direction = |index: u32| {
        let moment = f64::from(index) * points.len() as f64 / f64::from(plan.dots) + middle;
        let (sample, share) = (moment as usize, moment.fract());
        let [from, to] = [sample, sample + 1].map(|at| points[at % points.len()].tilt.beam(incidence));
        [0, 1].map(|axis| from[axis] + share * (to[axis] - from[axis]))
    };
    (0..plan.dots).map(|index| (!is_dark(index)).then(|| direction(index))).collect()
}

/// What the pipeline extracts from the frames of one pass of `count` batches.
fn scan(plan: &BatchesPlan, shape: FrameShape, count: u32) -> DotScan {
    let [top, bottom, left, right] = plan.trailing_region;
    DotScan {
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
        let refused =
            |key: &str, message: String| plan.places.error(&["stage", &index.to_string(), key], message);
        if stage.name == "correct" {
            correct = serde_json::from_value(Value::Object(stage.options.clone()))
                .map_err(|error| decoding_message(&error.to_string(), "table"))
                .map_err(|what| refused("name", format!("stage correct: {what}")))?;
            let CorrectOptions { hot_sigmas, background_batches, .. } = correct;
            if !(hot_sigmas > 0.0 && hot_sigmas.is_finite()) {
                return Err(refused(
                    "hot_sigmas",
                    format!("stage correct: hot_sigmas = {hot_sigmas}: must be more than 0; 8 is usual"),
                ));
            }
            if background_batches == 0 {
                return Err(refused(
                    "background_batches",
                    "stage correct: background_batches = 0: must be at least 1; 64 is usual".into(),
                ));
            }
            if correct.flat_field.is_some() && batches.flat_frames > 0 {
                return Err(refused(
                    "flat_field",
                    "stage correct: flat_field and batches.flat_frames exclude each other: use an earlier session's flat field, or acquire one".into(),
                ));
            }
        } else if denoise.replace(stage.clone()).is_some() {
            return Err(refused(
                "name",
                format!("{} is the second stage that turns frames into columns: keep one", stage.name),
            ));
        }
    }
    let default = || StageTable { name: "denoise".into(), options: serde_json::Map::new() };
    Ok((correct, denoise.unwrap_or_else(default)))
}
