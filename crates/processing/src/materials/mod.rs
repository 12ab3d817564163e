//! Tells materials by how light spreads in them: area-normalised profiles over the distance from the illuminated row
//! (Kubo et al., section 5.3), a support vector machine, and what it does not know.
//!
//! Works on stored sweeps, and changes none of them.

mod labels;
mod model;
mod profiles;
mod report;
mod spread;

use std::path::{Path, PathBuf};

use ndarray::{Array2, Axis, s};
use rayon::prelude::*;
use raysweep_session::durable;
use raysweep_session::products::Products;
use serde::Serialize;
use serde_json::{Map, json};

pub use self::labels::Labels;
use self::model::{FOLDS, LEAST_PIXELS, LabelledPixel, recalls, table};
pub use self::model::{MaterialModel, TrainedOn};
pub use self::profiles::{Bins, DistanceUnit, Transported};
pub use self::spread::{Measured, RegionSpread, SpreadOptions, compare};
use crate::stored::ProcessError;

/// Pixels this close to another label are judged apart: light from beyond the border is in their profiles.
const EDGE_PX: usize = 3;
/// Windows whose mean profile is judged.
const WINDOWS_PX: [usize; 2] = [1, 3];
const LEAST_MATERIALS: usize = 2;

/// A session, and the file that says what its pixels show.
#[derive(Debug, Clone)]
pub struct Labelled {
    /// The session's folder.
    pub session: PathBuf,
    /// Its file of labels.
    pub labels: PathBuf,
}

/// What a pixel was found to be.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Told {
    /// Too little light, or too near to the ends of the projector.
    Dark,
    /// None of the model's materials.
    Unknown,
    /// Its index.
    Material(usize),
}

/// Where each material was found in a session.
#[derive(Debug, Clone, Serialize)]
pub struct MaterialMap {
    /// The folder with the map and its page.
    pub folder: PathBuf,
    /// Name and number of pixels of each material.
    pub materials: Vec<(String, usize)>,
    /// Pixels of no known material.
    pub unknown: usize,
    /// Pixels without enough light.
    pub dark: usize,
}

/// How often a model is right.
#[derive(Debug, Clone, Serialize)]
pub struct Evaluation {
    /// The materials of the model.
    pub materials: Vec<String>,
    /// Labels that the model does not know.
    pub strangers: Vec<String>,
    /// For pixels and windows, inside and at edges.
    pub judged: Vec<Judged>,
}

/// Counts of one kind of pixels.
#[derive(Debug, Clone, Serialize)]
pub struct Judged {
    /// Side of the window whose mean profile was judged.
    pub window_px: usize,
    /// Whether these are the pixels within three of another label, or the others.
    pub at_edges: bool,
    /// `[true label, found]`: rows are the materials, then the strangers; columns the materials, then `unknown`.
    pub counts: Vec<Vec<usize>>,
}

/// Trains a model on labelled sessions and writes it to the file `to`.
///
/// # Errors
/// When a file cannot be read or does not fit, there are too few materials or pixels, or they cannot be told apart.
pub fn train(
    labelled: &[Labelled],
    mm_per_row: Option<f64>,
    to: &Path,
) -> Result<MaterialModel, ProcessError> {
    if to.exists() {
        return Err(ProcessError::Config(format!("{} already exists: give a new file", to.display())));
    }
    let opened = open(labelled, mm_per_row)?;
    let sessions: Vec<_> = opened.iter().map(|(session, _)| session.clone()).collect();
    let bins = Bins::of(&sessions)?;
    let mut materials: Vec<String> = Vec::new();
    for name in opened.iter().flat_map(|(_, labels)| &labels.names) {
        if !materials.contains(name) {
            materials.push(name.clone());
        }
    }
    if materials.len() < LEAST_MATERIALS {
        return Err(ProcessError::Config(format!(
            "only `{}` is labelled: a model tells at least {LEAST_MATERIALS} materials apart",
            materials.join("`, `")
        )));
    }
    let (mut samples, mut trained_on) = (Vec::new(), Vec::new());
    for (group, ((session, labels), files)) in opened.iter().zip(labelled).enumerate() {
        let shares = session.profiles(&bins, 1)?.shares;
        let mut pixels = vec![0; materials.len()];
        for (place, label) in labels.of_pixel.indexed_iter() {
            let profile = shares.slice(s![place.0, place.1, ..]);
            let Some(label) = label.filter(|_| profile.iter().all(|share| share.is_finite())) else {
                continue;
            };
            if labels.is_at_an_edge(place, EDGE_PX) {
                continue;
            }
            let material = materials.iter().position(|name| *name == labels.names[label]).unwrap_or_default();
            pixels[material] += 1;
            samples.push(LabelledPixel { shares: profile.to_vec(), material, group });
        }
        trained_on.push(TrainedOn {
            session: files.session.display().to_string(),
            labels: files.labels.display().to_string(),
            pixels,
        });
    }
    for (material, name) in materials.iter().enumerate() {
        let pixels: usize = trained_on.iter().map(|on| on.pixels[material]).sum();
        if pixels < LEAST_PIXELS {
            return Err(ProcessError::Config(format!(
                "`{name}` has {pixels} pixels that are lit and {EDGE_PX} px away from other labels; at least {LEAST_PIXELS} are needed: label a larger part"
            )));
        }
    }
    let is_by_session =
        trained_on.len() > 1 && trained_on.iter().all(|on| on.pixels.iter().all(|pixels| *pixels > 0));
    if !is_by_session {
        divide(&mut samples, materials.len());
    }
    let model = MaterialModel::train(materials, bins, &samples, trained_on)?;
    durable::write(to, model.to_json()?.as_bytes())?;
    Ok(model)
}

/// Divides the samples of each material into blocks, which are rows that lie together.
fn divide(samples: &mut [LabelledPixel], materials: usize) {
    for material in 0..materials {
        let own: Vec<_> = samples.iter_mut().filter(|sample| sample.material == material).collect();
        let block = own.len().div_ceil(FOLDS).max(1);
        for (at, sample) in own.into_iter().enumerate() {
            sample.group = at / block;
        }
    }
}

fn open(labelled: &[Labelled], mm_per_row: Option<f64>) -> Result<Vec<(Transported, Labels)>, ProcessError> {
    labelled
        .iter()
        .map(|Labelled { session, labels }| {
            let session = Transported::open(session, mm_per_row)?;
            let labels = Labels::read(labels, session.size)?;
            Ok((session, labels))
        })
        .collect()
}

/// What each pixel is, by the mean profile of the window around it.
fn find(
    model: &MaterialModel,
    session: &Transported,
    window_px: usize,
) -> Result<Array2<Told>, ProcessError> {
    let shares = session.profiles(&model.bins, window_px)?.shares;
    let (rows, columns) = session.size;
    let found: Vec<Told> = (0..rows * columns)
        .into_par_iter()
        .map(|at| {
            let profile = shares.slice(s![at / columns, at % columns, ..]);
            match profile.iter().all(|share| share.is_finite()) {
                false => Told::Dark,
                true => model.find(profile).map_or(Told::Unknown, Told::Material),
            }
        })
        .collect();
    Array2::from_shape_vec((rows, columns), found).map_err(|error| ProcessError::Config(error.to_string()))
}

/// Finds a model's materials in a session; writes the map and its page into the new folder `to`.
///
/// # Errors
/// When the model does not fit the session, or `to` exists or cannot be written.
pub fn apply(
    session: &Path,
    model: &Path,
    mm_per_row: Option<f64>,
    window_px: usize,
    to: &Path,
) -> Result<MaterialMap, ProcessError> {
    if window_px.is_multiple_of(2) || window_px > 31 {
        return Err(ProcessError::Config(format!("--window {window_px}: must be odd, from 1 to 31 pixels")));
    }
    let model = MaterialModel::read(model)?;
    let session = Transported::open(session, mm_per_row)?;
    let found = find(&model, &session, window_px)?;
    create_new(to)?;
    let values = found.mapv(|found| match found {
        Told::Dark => f32::NAN,
        Told::Unknown => 0.0,
        Told::Material(material) => (material + 1) as f32,
    });
    let metadata = Map::from_iter([
        ("unit".to_owned(), json!("index")),
        ("axes".to_owned(), json!(["t", "s"])),
        ("materials".to_owned(), json!(model.materials)),
        ("meaning".to_owned(), json!("k: the k-th of `materials`, from 1; 0: unknown; NaN: too dark")),
        ("window_px".to_owned(), json!(window_px)),
        ("session".to_owned(), json!(session.dir)),
    ]);
    Products::new(to).image("materials", values.view(), &metadata)?;
    let count = |wanted| found.iter().filter(|found| **found == wanted).count();
    let applied = MaterialMap {
        folder: to.to_owned(),
        materials: (0..)
            .zip(&model.materials)
            .map(|(at, name)| (name.clone(), count(Told::Material(at))))
            .collect(),
        unknown: count(Told::Unknown),
        dark: count(Told::Dark),
    };
    let map = report::map(&found);
    durable::write(&to.join("materials.png"), &map.to_png()?)?;
    let page = report::applied(&session, &model, &applied, map, window_px);
    durable::write(&to.join("report.html"), page.to_html()?.as_bytes())?;
    Ok(applied)
}

/// Compares what a model finds with what people have labelled; writes tables and a page into the new folder `to`.
///
/// # Errors
/// When a file cannot be read or does not fit, or `to` exists or cannot be written.
pub fn evaluate(
    labelled: &[Labelled],
    model: &Path,
    mm_per_row: Option<f64>,
    to: &Path,
) -> Result<Evaluation, ProcessError> {
    let model = MaterialModel::read(model)?;
    let opened = open(labelled, mm_per_row)?;
    let mut names = model.materials.clone();
    for name in opened.iter().flat_map(|(_, labels)| &labels.names) {
        if !names.contains(name) {
            names.push(name.clone());
        }
    }
    let materials = model.materials.len();
    let mut judged = Vec::new();
    for window_px in WINDOWS_PX {
        let mut counts = [false, true].map(|_| Array2::<usize>::zeros((names.len(), materials + 1)));
        for (session, labels) in &opened {
            let found = find(&model, session, window_px)?;
            for (place, label) in labels.of_pixel.indexed_iter() {
                let Some(label) = label else { continue };
                let truth = names.iter().position(|name| *name == labels.names[*label]).unwrap_or_default();
                let column = match found[place] {
                    Told::Dark => continue,
                    Told::Unknown => materials,
                    Told::Material(material) => material,
                };
                counts[usize::from(labels.is_at_an_edge(place, EDGE_PX))][[truth, column]] += 1;
            }
        }
        for (at_edges, counts) in [false, true].into_iter().zip(counts) {
            let counts = counts.outer_iter().map(|row| row.to_vec()).collect();
            judged.push(Judged { window_px, at_edges, counts });
        }
    }
    let strangers = names.split_off(materials);
    let evaluation = Evaluation { materials: names, strangers, judged };
    create_new(to)?;
    durable::write(&to.join("evaluation.json"), &report::json_bytes(&evaluation)?)?;
    for judged in &evaluation.judged {
        let file = to.join(format!("confusion-{}.csv", judged.name().replace(' ', "-")));
        durable::write(&file, judged.csv(&evaluation).as_bytes())?;
    }
    let page = report::evaluated(&model, &evaluation);
    durable::write(&to.join("report.html"), page.to_html()?.as_bytes())?;
    Ok(evaluation)
}

fn create_new(to: &Path) -> Result<(), ProcessError> {
    if to.exists() {
        return Err(ProcessError::Config(format!("{} already exists: give a new folder", to.display())));
    }
    Ok(durable::create_dir(to)?)
}

impl MaterialModel {
    /// The cross-validated confusion matrix as text.
    pub fn table(&self) -> String {
        table(&self.confusion, &self.materials)
    }

    /// The share of each material's pixels that cross-validation found.
    pub fn recalls(&self) -> Vec<f64> {
        recalls(&self.confusion)
    }
}

impl Judged {
    /// `1 px inside`, for example.
    pub fn name(&self) -> String {
        format!("{} px {}", self.window_px, if self.at_edges { "at edges" } else { "inside" })
    }

    /// Shares of each true label found as each material, or unknown.
    pub fn shares(&self) -> Array2<f64> {
        let columns = self.counts.first().map_or(0, Vec::len);
        let mut shares =
            Array2::from_shape_fn((self.counts.len(), columns), |(t, f)| self.counts[t][f] as f64);
        for mut row in shares.axis_iter_mut(Axis(0)) {
            let all = row.sum().max(1.0);
            row /= all;
        }
        shares
    }

    fn csv(&self, of: &Evaluation) -> String {
        let quoted = |name: &String| format!("\"{}\"", name.replace('"', "\"\""));
        let heads = of.materials.iter().map(quoted).chain(["\"unknown\"".to_owned()]);
        let mut csv = format!("\"true label\",{}\n", heads.collect::<Vec<_>>().join(","));
        for (name, row) in of.materials.iter().chain(&of.strangers).zip(&self.counts) {
            let counts: Vec<_> = row.iter().map(usize::to_string).collect();
            csv.push_str(&format!("{},{}\n", quoted(name), counts.join(",")));
        }
        csv
    }
}
