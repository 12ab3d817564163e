//! The scene as a sweep's transport relights it, beside captures of it under the same pictures (Kubo et al., Figure 9).
//!
//! Works on stored sessions, and changes none of them.

use std::path::{Path, PathBuf};

use ndarray::{Array1, Array2, ArrayView2, Axis, concatenate, s};
use raysweep_config::Procedure;
use raysweep_pipeline::SweepGeometry;
use raysweep_session::integrity::damaged_files;
use raysweep_session::products::Products;
use raysweep_session::report::{Picture, ToneMap};
use raysweep_session::{STRIP_ROWS, Session, durable, transport};
use raysweep_transport::plane::{RelitBeam, Transport, relight_rows};
use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::materials::create_new;
use crate::patterns::{LitImage, PatternsTask, PictureImages};
use crate::stored::{ProcessError, Stored};
use crate::sweep::SweepTask;

/// White in pictures: this percentile of the reference.
const PERCENTILE: f64 = 99.5;
/// What a session is read by.
const INPUTS: [&str; 2] = ["plan.toml", "rig.toml"];
/// Columns between the images of a picture.
const GAP_PX: usize = 4;

/// The scene under one picture.
#[derive(Debug, Clone, Serialize)]
pub struct RelitPicture {
    /// The names of its files.
    pub name: String,
    /// What the projector showed.
    pub shows: String,
    /// The capture of most light, with which the others are compared.
    pub reference: PathBuf,
    /// Light time of the reference.
    pub reference_s: f64,
    /// The relit image first, then the other captures.
    pub images: Vec<RelitImage>,
}

/// An image, and how much it differs from the reference.
#[derive(Debug, Clone, Serialize)]
pub struct RelitImage {
    /// The session that it is of.
    pub session: PathBuf,
    /// Whether it is relit, or captured.
    pub relit: bool,
    /// Light time of a capture.
    pub light_s: Option<f64>,
    /// Mean square of the reference over that of the difference, in dB.
    pub snr_db: f64,
    /// Square of the reference's largest value over the mean square of the difference, in dB.
    pub psnr_db: f64,
}

/// The transport of a sweep, and the rows that it belongs to.
struct Sweep {
    session: Session,
    geometry: SweepGeometry,
    u_min: i32,
}

/// An image captured under a picture.
struct Capture {
    session: PathBuf,
    shows: String,
    weights: Array1<f64>,
    light: Array2<f32>,
    /// Where a frame saturated.
    is_clipped: Array2<bool>,
    light_s: f64,
}

/// Relights a sweep by each picture of rows in the captures, sessions of kind `patterns` with regular images, and compares
/// both. Captures of the same picture are compared with the one that had most light. Images and pictures are written into
/// the new folder `to`.
///
/// # Errors
/// When a session cannot be read, is of another kind or another size, or has no picture of rows.
pub fn relit(sweep: &Path, captures: &[PathBuf], to: &Path) -> Result<Vec<RelitPicture>, ProcessError> {
    let sweep = Sweep::open(sweep)?;
    let mut groups: Vec<Vec<Capture>> = Vec::new();
    for session in captures {
        for capture in captured(session, &sweep.geometry)? {
            match groups.iter_mut().find(|group| group[0].weights == capture.weights) {
                Some(group) => group.push(capture),
                None => groups.push(vec![capture]),
            }
        }
    }
    for group in &mut groups {
        // The reference first; of equal ones, the first given.
        group.sort_by(|a, b| b.light_s.total_cmp(&a.light_s));
    }
    let relit: Vec<Array2<f32>> =
        groups.iter().map(|group| sweep.relit(&group[0].weights)).collect::<Result<_, _>>()?;
    create_new(to)?;
    let products = Products::new(to);
    let mut pictures = Vec::new();
    for (k, (group, relit)) in groups.iter().zip(relit).enumerate() {
        let name = format!("picture_{k}");
        let (reference, others) = (&group[0], &group[1..]);
        let is_known = |[t, s]: [usize; 2]| !group.iter().any(|capture| capture.is_clipped[[t, s]]);
        let compared = |session: &Path, light_s: Option<f64>, image: &Array2<f32>| {
            let (snr_db, psnr_db) = ratios_db(reference.light.view(), image.view(), is_known);
            RelitImage { session: session.to_owned(), relit: light_s.is_none(), light_s, snr_db, psnr_db }
        };
        let images = std::iter::once(compared(sweep.session.dir(), None, &relit))
            .chain(others.iter().map(|other| compared(&other.session, Some(other.light_s), &other.light)))
            .collect();
        let metadata = Map::from_iter([
            ("axes".to_owned(), json!(["t", "s"])),
            ("units".to_owned(), json!("1 is a white pixel under its own row")),
            ("about".to_owned(), json!(format!("relit by the transport under {}", reference.shows))),
            ("session".to_owned(), json!(sweep.session.dir())),
        ]);
        products.image(&name, relit.view(), &metadata)?;
        let captures = group.iter().rev().map(|capture| capture.light.view());
        let shown: Vec<ArrayView2<f32>> = std::iter::once(relit.view()).chain(captures).collect();
        let white = ToneMap::percentile(&[reference.light.view()], PERCENTILE);
        durable::write(&to.join(format!("{name}.png")), &side_by_side(&shown, white)?)?;
        pictures.push(RelitPicture {
            name,
            shows: reference.shows.clone(),
            reference: reference.session.clone(),
            reference_s: reference.light_s,
            images,
        });
    }
    let table = serde_json::to_vec_pretty(&pictures).map_err(|error| wrong(to, error))?;
    durable::write(&to.join("relit.json"), &table)?;
    Ok(pictures)
}

fn wrong(dir: &Path, what: impl std::fmt::Display) -> ProcessError {
    ProcessError::Config(format!("{}: {what}", dir.display()))
}

/// Opens a session of which plan and rig file are sound, and calls `read` with it.
fn with_stored<T>(
    dir: &Path,
    read: impl FnOnce(&Stored<'_>) -> Result<T, ProcessError>,
) -> Result<T, ProcessError> {
    let session = Session::open(dir)?;
    let state = session.state()?;
    let damage = damaged_files(&session, &state, &INPUTS.map(String::from))?;
    if !damage.is_empty() {
        let damage = damage.iter().map(ToString::to_string).collect();
        return Err(ProcessError::Damaged { dir: dir.to_owned(), damage, is_edited: false });
    }
    Stored::with(&session, &state, read)
}

impl Sweep {
    fn open(dir: &Path) -> Result<Self, ProcessError> {
        let mut geometry = with_stored(dir, |stored| {
            let Procedure::Sweep(own) = stored.plan.procedure.clone() else {
                return Err(wrong(
                    dir,
                    "is no sweep: a scene is relit by the transport of one (kind = \"sweep\")",
                ));
            };
            let rig = stored.plane_rig()?;
            let task = SweepTask::new(stored.plan, own, &stored.known(&rig)?);
            Ok(task.task.geometry.clone())
        })?;
        let session = Session::open(dir)?;
        let path = session.transport_path();
        if !path.is_dir() {
            let what = "has no transport.zarr; `raysweep process` makes it once the sweep is complete";
            return Err(wrong(dir, what));
        }
        let (_, attributes) = transport::describe(&path)?;
        let u_min = attributes.get("u_min").and_then(Value::as_i64).and_then(|u| i32::try_from(u).ok());
        let u_min = u_min.ok_or_else(|| {
            wrong(dir, "transport.zarr does not say its u_min; `raysweep process` makes it again")
        })?;
        // As the sweep found it, if the rig file does not state it.
        let found_rows = attributes.get("beam_sigma_rows").and_then(Value::as_f64);
        geometry.beam_sigma_rows = found_rows.or(geometry.beam_sigma_rows);
        Ok(Self { session, geometry, u_min })
    }

    /// The scene under these weights of the projector's rows, `[t, s]`.
    fn relit(&self, weights: &Array1<f64>) -> Result<Array2<f32>, ProcessError> {
        let dir = self.session.dir();
        let timing = self.geometry.timing().map_err(|error| wrong(dir, error))?;
        let (height, width) = (self.geometry.height, self.geometry.width);
        let mut image = Array2::zeros((height, width));
        for first in (0..height).step_by(STRIP_ROWS) {
            let end = (first + STRIP_ROWS).min(height);
            let t = transport::read_rows(&self.session.transport_path(), first..end)?;
            let exists = Array2::from_elem((t.len_of(Axis(0)), end - first), true);
            let transport = Transport::measured(t, self.u_min, exists);
            let part = relight_rows(&timing, first, &transport, weights.view(), RelitBeam::AsLit);
            image.slice_mut(s![first..end, ..]).assign(&part.map_err(|error| wrong(dir, error))?);
        }
        Ok(image)
    }
}

/// The regular images of a session that were taken under pictures of rows.
fn captured(dir: &Path, sweep: &SweepGeometry) -> Result<Vec<Capture>, ProcessError> {
    with_stored(dir, |stored| {
        let Procedure::Patterns(own) = stored.plan.procedure.clone() else {
            return Err(wrong(dir, "has no captures under pictures: give sessions of kind \"patterns\""));
        };
        if !own.regular {
            return Err(wrong(dir, "has no regular images: set patterns.regular = true in its plan"));
        }
        let rig = stored.plane_rig()?;
        let task = PatternsTask::new(stored.plan, own, &stored.known(&rig)?)
            .map_err(|error| stored.in_plan(&error))?;
        let geometry = &task.task.geometry;
        let size = |geometry: &SweepGeometry| [geometry.raster.rows, geometry.height, geometry.width];
        if size(geometry) != size(sweep) {
            let what = format!(
                "has {:?} projector rows, camera rows and columns, the sweep {:?}: take both with the same rig and region",
                size(geometry),
                size(sweep)
            );
            return Err(wrong(dir, what));
        }
        let (rows, stack) = (geometry.raster.rows, stored.session.stack()?);
        let images = PictureImages::new(&task, stored.state, &stack);
        let mut captures = Vec::new();
        for (picture, pattern) in task.pictures.iter().enumerate() {
            let weights = pattern.row_weights(rows).map_err(|error| wrong(dir, error))?;
            // Black shows nothing to compare.
            let Some(weights) = weights.filter(|weights| weights.iter().any(|weight| *weight > 0.0)) else {
                continue;
            };
            // The regular images come first.
            let LitImage { light, clipped, frames } =
                images.image(picture, 0).map_err(|problem| wrong(dir, problem))?;
            captures.push(Capture {
                session: dir.to_owned(),
                shows: pattern.to_string(),
                weights: weights.into_iter().map(f64::from).collect(),
                is_clipped: clipped.map_or_else(
                    || Array2::from_elem(light.dim(), false),
                    |clipped| clipped.mapv(|frames| frames > 0),
                ),
                light,
                light_s: f64::from(frames) * geometry.raster.period_us * 1e-6,
            });
        }
        match captures.is_empty() {
            true => Err(wrong(dir, "has no picture of rows, such as line, rows, or stripes of rows")),
            false => Ok(captures),
        }
    })
}

/// SNR and PSNR of an image in dB, against a reference; over the pixels that are known.
fn ratios_db(
    reference: ArrayView2<f32>,
    image: ArrayView2<f32>,
    is_known: impl Fn([usize; 2]) -> bool,
) -> (f64, f64) {
    let (mut signal, mut error, mut peak, mut pixels) = (0.0, 0.0, 0.0_f64, 0.0);
    for ((place, &reference), &image) in reference.indexed_iter().zip(&image) {
        let (reference, image) = (f64::from(reference), f64::from(image));
        if is_known(place.into()) && reference.is_finite() && image.is_finite() {
            signal += reference * reference;
            error += (image - reference).powi(2);
            peak = peak.max(reference);
            pixels += 1.0;
        }
    }
    (10.0 * (signal / error).log10(), 10.0 * (peak * peak * pixels / error).log10())
}

/// A PNG file of images of one size.
fn side_by_side(images: &[ArrayView2<f32>], white: ToneMap) -> Result<Vec<u8>, ProcessError> {
    let rows = images.first().map_or(0, |image| image.nrows());
    let gap = Array2::<f32>::zeros((rows, GAP_PX));
    let mut parts = Vec::new();
    for image in images {
        parts.extend([image.view(), gap.view()]);
    }
    parts.pop();
    let all = concatenate(Axis(1), &parts).map_err(|error| ProcessError::Config(error.to_string()))?;
    Ok(Picture::unreduced(all.view().insert_axis(Axis(2)), white).to_png()?)
}

#[cfg(test)]
mod tests {
    use ndarray::arr2;

    use super::*;

    #[test]
    fn ratios_are_those_of_the_definitions() {
        let reference = arr2(&[[3.0, 4.0], [0.0, 9.0]]);
        let image = arr2(&[[3.1, 4.0], [-0.1, 1.0]]);
        let (snr_db, psnr_db) = ratios_db(reference.view(), image.view(), |[t, s]| (t, s) != (1, 1));
        // 25 over 0.02, and 16 times three pixels over 0.02.
        assert!((snr_db - 30.969).abs() < 1e-3 && (psnr_db - 33.802).abs() < 1e-3, "{snr_db} {psnr_db}");
    }
}
