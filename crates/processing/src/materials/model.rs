//! A support vector machine that tells materials by their profiles, and its file.

use std::path::Path;

use libsvm_rs::predict::predict_values;
use libsvm_rs::train::svm_train;
use libsvm_rs::{KernelType, LoadOptions, SvmModel, SvmNode, SvmParameterBuilder, SvmProblem, SvmType};
use ndarray::{Array2, ArrayView1};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::profiles::Bins;
use crate::stored::ProcessError;

/// Values of C and gamma among which cross-validation chooses. The features have unit variance, so these suit any data.
const COSTS: [f64; 3] = [1.0, 10.0, 100.0];
const GAMMAS: [f64; 3] = [0.02, 0.1, 0.5];
/// Of the machines that know what is known.
const NOVELTY_GAMMA: f64 = 0.1;
const NOVELTY_NU: f64 = 0.05;
/// Share of known pixels that are rejected in cross-validation. Other containers and distances than those of the training
/// make it up to twice as much.
const FALSE_REJECTS: f64 = 0.02;
/// More pixels of a material make training slow and not better.
const MOST_PIXELS: usize = 600;
/// Fewer pixels of a material cannot be divided for cross-validation.
pub(super) const LEAST_PIXELS: usize = 40;
/// Folds of the cross-validation, if it is not by session.
pub(super) const FOLDS: usize = 5;
/// Materials that are confused more often than this cannot be told apart.
const WORST_RECALL: f64 = 0.5;
const FORMAT: u32 = 1;
const LARGEST_FILE_BYTES: u64 = 64 << 20;

/// A labelled pixel.
#[derive(Debug, Clone)]
pub(super) struct LabelledPixel {
    pub shares: Vec<f32>,
    pub material: usize,
    /// Pixels of a group are left out together in cross-validation, because neighbours resemble each other.
    pub group: usize,
}

/// What a model was trained on.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainedOn {
    /// The session's folder.
    pub session: String,
    /// Its file of labels.
    pub labels: String,
    /// Labelled pixels of each material that were bright enough.
    pub pixels: Vec<usize>,
}

/// The file of a model, JSON.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct ModelFile {
    raysweep_materials: u32,
    software: String,
    materials: Vec<String>,
    bins: Bins,
    mean: Vec<f64>,
    deviation: Vec<f64>,
    c: f64,
    gamma: f64,
    confusion: Vec<Vec<usize>>,
    trained_on: Vec<TrainedOn>,
    /// LIBSVM's text format, labels 0, 1, ... in the order of `materials`.
    svm: String,
    /// One-class machines in the same format; a pixel is unknown if its material's one says less than `level`.
    novelty: Vec<NoveltyFile>,
}

#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct NoveltyFile {
    svm: String,
    level: f64,
}

/// A trained model.
#[derive(Debug)]
pub struct MaterialModel {
    /// Names of the materials.
    pub materials: Vec<String>,
    /// Of the profiles that it compares.
    pub bins: Bins,
    /// Cross-validated counts `[true material, found material]`.
    pub confusion: Array2<usize>,
    /// The chosen cost of an error.
    pub c: f64,
    /// The chosen inverse squared width of the kernel.
    pub gamma: f64,
    /// What it was trained on.
    pub trained_on: Vec<TrainedOn>,
    scale: Scale,
    svm: SvmModel,
    novelty: Vec<Novelty>,
}

#[derive(Debug)]
struct Novelty {
    svm: SvmModel,
    level: f64,
}

/// Mean and standard deviation of the features.
#[derive(Debug, Clone)]
struct Scale {
    mean: Vec<f64>,
    deviation: Vec<f64>,
}

impl Scale {
    fn of(samples: &[LabelledPixel]) -> Self {
        let features = samples.first().map_or(0, |sample| sample.shares.len());
        let count = samples.len() as f64;
        let mean_of = |f: &dyn Fn(f64) -> f64, k: usize| {
            samples.iter().map(|sample| f(f64::from(sample.shares[k]))).sum::<f64>() / count
        };
        let mean: Vec<f64> = (0..features).map(|k| mean_of(&|share| share, k)).collect();
        let deviation = (0..features)
            .map(|k| mean_of(&|share| (share - mean[k]).powi(2), k).sqrt().max(f64::MIN_POSITIVE))
            .collect();
        Self { mean, deviation }
    }

    fn nodes<'a>(&self, shares: impl Iterator<Item = &'a f32>) -> Vec<SvmNode> {
        let scaled = shares.zip(&self.mean).zip(&self.deviation);
        let values = scaled.map(|((share, mean), deviation)| (f64::from(*share) - mean) / deviation);
        values.zip(1..).map(|(value, index)| SvmNode { index, value }).collect()
    }
}

/// Trains a machine on some samples.
fn fit(
    samples: &[&LabelledPixel],
    scale: &Scale,
    parameters: SvmParameterBuilder,
) -> Result<SvmModel, ProcessError> {
    let problem = SvmProblem {
        labels: samples.iter().map(|sample| sample.material as f64).collect(),
        instances: samples.iter().map(|sample| scale.nodes(sample.shares.iter())).collect(),
    };
    let parameters = parameters.kernel_type(KernelType::Rbf).build().map_err(not_trained)?;
    Ok(svm_train(&problem, &parameters))
}

fn not_trained(error: libsvm_rs::SvmError) -> ProcessError {
    ProcessError::Config(format!("the model cannot be trained: {error}"))
}

fn classifier(c: f64, gamma: f64) -> SvmParameterBuilder {
    SvmParameterBuilder::new().svm_type(SvmType::CSvc).c(c).gamma(gamma)
}

fn one_class() -> SvmParameterBuilder {
    SvmParameterBuilder::new().svm_type(SvmType::OneClass).nu(NOVELTY_NU).gamma(NOVELTY_GAMMA)
}

fn decide(svm: &SvmModel, nodes: &[SvmNode]) -> usize {
    let mut values = vec![0.0; svm.class_count() * svm.class_count().saturating_sub(1) / 2];
    predict_values(svm, nodes, &mut values).max(0.0) as usize
}

fn novelty(svm: &SvmModel, nodes: &[SvmNode]) -> f64 {
    let mut value = [0.0];
    predict_values(svm, nodes, &mut value);
    value[0]
}

/// At most [`MOST_PIXELS`] samples of each material, evenly chosen.
fn thinned(samples: &[LabelledPixel], materials: usize) -> Vec<&LabelledPixel> {
    let of_material = |material| -> Vec<&LabelledPixel> {
        let all: Vec<_> = samples.iter().filter(|sample| sample.material == material).collect();
        let step = all.len().div_ceil(MOST_PIXELS).max(1);
        all.into_iter().step_by(step).collect()
    };
    (0..materials).flat_map(of_material).collect()
}

/// Counts `[true, found]` of samples that a model trained without their group has judged.
fn cross_validate(
    samples: &[&LabelledPixel],
    materials: usize,
    scale: &Scale,
    (c, gamma): (f64, f64),
) -> Result<Array2<usize>, ProcessError> {
    let groups = samples.iter().map(|sample| sample.group).max().map_or(0, |last| last + 1);
    let mut confusion = Array2::zeros((materials, materials));
    for group in 0..groups {
        let (out, kept): (Vec<_>, Vec<_>) = samples.iter().copied().partition(|sample| sample.group == group);
        let svm = fit(&kept, scale, classifier(c, gamma))?;
        for sample in out {
            confusion[[sample.material, decide(&svm, &scale.nodes(sample.shares.iter()))]] += 1;
        }
    }
    Ok(confusion)
}

/// Share of each material's samples that were found.
pub(super) fn recalls(confusion: &Array2<usize>) -> Vec<f64> {
    let recall = |(material, row): (usize, ArrayView1<usize>)| row[material] as f64 / row.sum().max(1) as f64;
    confusion.outer_iter().enumerate().map(recall).collect()
}

/// The novelty that [`FALSE_REJECTS`] of samples held out have less of.
fn level(samples: &[&LabelledPixel], material: usize, scale: &Scale) -> Result<f64, ProcessError> {
    let own: Vec<_> = samples.iter().copied().filter(|sample| sample.material == material).collect();
    let groups = own.iter().map(|sample| sample.group).max().map_or(0, |last| last + 1);
    let mut held_out = Vec::new();
    for group in 0..groups {
        let (out, kept): (Vec<_>, Vec<_>) = own.iter().copied().partition(|sample| sample.group == group);
        if kept.is_empty() || out.is_empty() {
            continue;
        }
        let svm = fit(&kept, scale, one_class())?;
        held_out.extend(out.iter().map(|sample| novelty(&svm, &scale.nodes(sample.shares.iter()))));
    }
    held_out.sort_by(f64::total_cmp);
    let rank = (FALSE_REJECTS * held_out.len() as f64) as usize;
    Ok(held_out.get(rank).copied().unwrap_or(0.0).min(0.0))
}

impl MaterialModel {
    /// Trains on labelled pixels. C and gamma are those with the best mean recall in cross-validation.
    ///
    /// # Errors
    /// When the materials cannot be told apart.
    pub(super) fn train(
        materials: Vec<String>,
        bins: Bins,
        samples: &[LabelledPixel],
        trained_on: Vec<TrainedOn>,
    ) -> Result<Self, ProcessError> {
        libsvm_rs::set_quiet(true);
        let scale = Scale::of(samples);
        let samples = thinned(samples, materials.len());
        let grid: Vec<(f64, f64)> =
            COSTS.iter().flat_map(|&c| GAMMAS.iter().map(move |&gamma| (c, gamma))).collect();
        let tried: Vec<_> = grid
            .into_par_iter()
            .map(|at| Ok((at, cross_validate(&samples, materials.len(), &scale, at)?)))
            .collect::<Result<_, ProcessError>>()?;
        let mean =
            |confusion: &Array2<usize>| recalls(confusion).iter().sum::<f64>() / materials.len() as f64;
        // The first of equals is the smoothest.
        let best =
            tried.into_iter().reduce(|best, other| if mean(&other.1) > mean(&best.1) { other } else { best });
        let Some(((c, gamma), confusion)) = best else {
            return Err(ProcessError::Config("nothing is labelled".into()));
        };
        let worst = recalls(&confusion).into_iter().zip(&materials).min_by(|a, b| a.0.total_cmp(&b.0));
        if let Some((recall, name)) = worst.filter(|(recall, _)| *recall < WORST_RECALL) {
            return Err(ProcessError::Config(format!(
                "`{name}` cannot be told from the others: in cross-validation only {:.0} % of its pixels were found.\n{}\nLabel pixels away from edges, give materials that look alike one label, or sweep with less noise",
                100.0 * recall,
                table(&confusion, &materials)
            )));
        }
        let svm = fit(&samples, &scale, classifier(c, gamma))?;
        let novelty = (0..materials.len())
            .into_par_iter()
            .map(|material| {
                let level = level(&samples, material, &scale)?;
                let own: Vec<_> =
                    samples.iter().copied().filter(|sample| sample.material == material).collect();
                Ok(Novelty { svm: fit(&own, &scale, one_class())?, level })
            })
            .collect::<Result<_, ProcessError>>()?;
        Ok(Self { materials, bins, confusion, c, gamma, trained_on, scale, svm, novelty })
    }

    /// The material with this profile, if it is a known one.
    pub(super) fn find(&self, shares: ArrayView1<f32>) -> Option<usize> {
        let nodes = self.scale.nodes(shares.iter());
        let material = decide(&self.svm, &nodes).min(self.materials.len() - 1);
        let known = &self.novelty[material];
        (novelty(&known.svm, &nodes) >= known.level).then_some(material)
    }

    /// Reads a model's file.
    ///
    /// # Errors
    /// When it is no such file, or damaged.
    pub fn read(path: &Path) -> Result<Self, ProcessError> {
        let wrong = |what: String| ProcessError::Config(format!("{}: {what}", path.display()));
        let text = raysweep_session::input::read_text(path, LARGEST_FILE_BYTES)
            .map_err(|error| wrong(format!("{error}; `raysweep materials train` makes a model")))?;
        let file: ModelFile = serde_json::from_str(&text)
            .map_err(|error| wrong(format!("is no model of `raysweep materials train`: {error}")))?;
        if file.raysweep_materials != FORMAT {
            return Err(wrong(format!(
                "raysweep_materials = {}: this version reads {FORMAT}; train the model again",
                file.raysweep_materials
            )));
        }
        let materials = file.materials.len();
        let features = file.bins.edges.len().saturating_sub(1);
        let lengths = [file.mean.len(), file.deviation.len()];
        let is_square =
            file.confusion.len() == materials && file.confusion.iter().all(|row| row.len() == materials);
        if materials < 2 || features == 0 || lengths != [features; 2] || !file.bins.are_sound() || !is_square
        {
            return Err(wrong(
                "its materials, bins, mean, deviation and confusion do not fit each other".into(),
            ));
        }
        if file.novelty.len() != materials || !file.deviation.iter().all(|deviation| *deviation > 0.0) {
            return Err(wrong(
                "it needs one entry of novelty for each material, and deviations above 0".into(),
            ));
        }
        let machine = |text: &str| {
            libsvm_rs::io::load_model_from_reader_with_options(text.as_bytes(), &LoadOptions::default())
                .map_err(|error| wrong(format!("svm: {error}")))
        };
        let svm = machine(&file.svm)?;
        if svm.svm_type() != SvmType::CSvc
            || svm.class_count() != materials
            || svm
                .labels()
                .iter()
                .any(|label| usize::try_from(*label).map_or(true, |label| label >= materials))
        {
            return Err(wrong("svm: it is no classifier of these materials".into()));
        }
        let novelty = file
            .novelty
            .iter()
            .map(|NoveltyFile { svm, level }| {
                let svm = machine(svm)?;
                match svm.svm_type() {
                    SvmType::OneClass => Ok(Novelty { svm, level: *level }),
                    _ => Err(wrong("novelty.svm: is no one-class machine".into())),
                }
            })
            .collect::<Result<_, _>>()?;
        let confusion = Array2::from_shape_vec((materials, materials), file.confusion.concat())
            .map_err(|error| wrong(error.to_string()))?;
        Ok(Self {
            materials: file.materials,
            bins: file.bins,
            confusion,
            c: file.c,
            gamma: file.gamma,
            trained_on: file.trained_on,
            scale: Scale { mean: file.mean, deviation: file.deviation },
            svm,
            novelty,
        })
    }

    /// Its file.
    ///
    /// # Errors
    /// When it cannot be written down, which nothing should cause.
    pub(super) fn to_json(&self) -> Result<String, ProcessError> {
        let text = |svm: &SvmModel| {
            let mut text = Vec::new();
            libsvm_rs::io::save_model_to_writer(&mut text, svm).map_err(not_trained)?;
            Ok::<_, ProcessError>(String::from_utf8_lossy(&text).into_owned())
        };
        let novelty = self.novelty.iter().map(|novelty| {
            Ok::<_, ProcessError>(NoveltyFile { svm: text(&novelty.svm)?, level: novelty.level })
        });
        let file = ModelFile {
            raysweep_materials: FORMAT,
            software: crate::SOFTWARE.to_owned(),
            materials: self.materials.clone(),
            bins: self.bins.clone(),
            mean: self.scale.mean.clone(),
            deviation: self.scale.deviation.clone(),
            c: self.c,
            gamma: self.gamma,
            confusion: self.confusion.outer_iter().map(|row| row.to_vec()).collect(),
            trained_on: self.trained_on.clone(),
            svm: text(&self.svm)?,
            novelty: novelty.collect::<Result<_, _>>()?,
        };
        let mut json = serde_json::to_string_pretty(&file)
            .map_err(|error| ProcessError::Config(format!("the model cannot be written: {error}")))?;
        json.push('\n');
        Ok(json)
    }
}

/// A confusion matrix as text: a line for each true material, its share found as each.
pub(super) fn table(confusion: &Array2<usize>, names: &[String]) -> String {
    let width = names.iter().map(|name| name.chars().count()).max().unwrap_or(0);
    let line = |(row, name): (ArrayView1<usize>, &String)| {
        let all = row.sum().max(1) as f64;
        let shares: Vec<_> = row.iter().map(|count| format!("{:5.2}", *count as f64 / all)).collect();
        format!("  {name:width$} {}", shares.join(" "))
    };
    confusion.outer_iter().zip(names).map(line).collect::<Vec<_>>().join("\n")
}
