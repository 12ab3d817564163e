//! The scene as a sweep's transport relights it, beside captures of it under the same pictures (Kubo et al., Figure 9).
//!
//! Works on stored sessions, and changes none of them.

use std::path::{Path, PathBuf};

use ndarray::{Array1, Array2, Array3, ArrayView2, Axis, concatenate, s};
use raysweep_config::Procedure;
use raysweep_core::Mosaic;
use raysweep_pipeline::{SweepGeometry, mask};
use raysweep_session::integrity::damaged_files;
use raysweep_session::products::Products;
use raysweep_session::report::{Picture, ToneMap};
use raysweep_session::{STRIP_ROWS, Session, durable, manifest, transport};
use raysweep_transport::plane::{PlaneError, RelitBeam, RelitUnknowns, relight_rows};
use serde::Serialize;
use serde_json::{Map, Value, json};

use crate::patterns::{LitImage, PatternsTask, PictureImages};
use crate::plane::colour::{Values, axes, in_colour, mask_in_colour};
use crate::plane::{PlaneTask, mask_bits};
use crate::stored::{ProcessError, Stored};
use crate::sweep::SweepTask;

/// White in pictures: this percentile of the reference.
const PERCENTILE: f64 = 99.5;
/// What a session is read by.
const INPUTS: [&str; 4] = ["plan.toml", "rig.toml", "calibration.toml", "calibration.npz"];
const TRANSPORT: &str = "transport.zarr/";
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
    /// Pixels that were compared: those that do not saturate, and whose relit light is measured.
    pub compared_px: usize,
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
    /// Mean square of the reference over that of the difference, in dB; `None` without light or a difference.
    pub snr_db: Option<f64>,
    /// Square of the reference's largest value over the mean square of the difference, in dB; `None` as above.
    pub psnr_db: Option<f64>,
}

/// The transport of a sweep, and the rows that it belongs to.
struct Sweep {
    session: Session,
    /// What the camera saw, see [`seen`].
    seen: String,
    mosaic: Mosaic,
    geometry: SweepGeometry,
    u_min: i32,
}

/// The scene under a picture.
struct Relit {
    image: Array2<f32>,
    /// The bits of [`mask`].
    mask: Array2<u8>,
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
    let mut seen = Vec::new();
    let mut groups: Vec<Vec<Capture>> = Vec::new();
    for session in captures {
        let real = std::fs::canonicalize(session).unwrap_or_else(|_| session.clone());
        if seen.contains(&real) {
            return Err(wrong(session, "is given twice"));
        }
        seen.push(real);
        for capture in captured(session, &sweep.seen)? {
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
    let images: Vec<Relit> =
        groups.iter().map(|group| sweep.relit(&group[0].weights)).collect::<Result<_, _>>()?;
    if to.exists() {
        return Err(wrong(to, "already exists: give a new folder"));
    }
    durable::replace_dir(to, |draft| {
        let mut pictures = Vec::new();
        for (k, (group, relit)) in groups.iter().zip(&images).enumerate() {
            pictures.push(write(draft, &format!("picture_{k}"), &sweep, group, relit)?);
        }
        let table = serde_json::to_vec_pretty(&pictures).map_err(|error| wrong(to, error))?;
        durable::write(&draft.join("relit.json"), &table)?;
        Ok(pictures)
    })
}

/// Writes the images of one picture; the first capture is the reference.
fn write(
    folder: &Path,
    name: &str,
    sweep: &Sweep,
    group: &[Capture],
    Relit { image, mask }: &Relit,
) -> Result<RelitPicture, ProcessError> {
    let (reference, others) = (&group[0], &group[1..]);
    let (dir, mosaic) = (sweep.session.dir(), sweep.mosaic);
    let is_known = |place: [usize; 2]| {
        mask[place] & mask::MEASURED != 0 && !group.iter().any(|capture| capture.is_clipped[place])
    };
    let compared = |session: &Path, light_s: Option<f64>, image: &Array2<f32>| {
        let (snr_db, psnr_db) = ratios_db(reference.light.view(), image.view(), is_known);
        RelitImage { session: session.to_owned(), relit: light_s.is_none(), light_s, snr_db, psnr_db }
    };
    let images = std::iter::once(compared(dir, None, image))
        .chain(others.iter().map(|other| compared(&other.session, Some(other.light_s), &other.light)))
        .collect();
    let metadata = Map::from_iter([
        ("axes".to_owned(), json!(axes(mosaic))),
        ("units".to_owned(), json!("1 is a white pixel under its own row")),
        ("about".to_owned(), json!(format!("relit by the transport under {}", reference.shows))),
        ("mask".to_owned(), mask_bits()),
        ("session".to_owned(), json!(dir)),
    ]);
    let (colours, bits) =
        (in_colour(image.view(), mosaic, Values::Light), mask_in_colour(mask.clone(), mosaic));
    Products::new(folder).masked_image(name, colours.view(), bits.view(), &metadata)?;
    // As in the table, and the reference last.
    let shown: Vec<Array3<f32>> = std::iter::once(image)
        .chain(others.iter().map(|other| &other.light))
        .chain([&reference.light])
        .map(|image| in_colour(image.view(), mosaic, Values::Light).into_owned())
        .collect();
    let white = ToneMap::percentile(&[reference.light.view()], PERCENTILE);
    durable::write(&folder.join(format!("{name}.png")), &side_by_side(&shown, white)?)?;
    Ok(RelitPicture {
        name: name.to_owned(),
        shows: reference.shows.clone(),
        reference: reference.session.clone(),
        reference_s: reference.light_s,
        compared_px: (0..image.nrows())
            .flat_map(|t| (0..image.ncols()).map(move |s| [t, s]))
            .filter(|place| is_known(*place))
            .count(),
        images,
    })
}

fn wrong(dir: &Path, what: impl std::fmt::Display) -> ProcessError {
    ProcessError::Config(format!("{}: {what}", dir.display()))
}

/// Opens a session, and calls `read` with it.
///
/// # Errors
/// Those of `read`, and if a file is damaged that is read: plan, rig file, calibration, the transport's.
fn with_stored<T>(
    dir: &Path,
    read: impl FnOnce(&Stored<'_>) -> Result<T, ProcessError>,
) -> Result<T, ProcessError> {
    let session = Session::open(dir)?;
    let state = session.state()?;
    let mut files = INPUTS.map(String::from).to_vec();
    // Only the manifest knows which files a transport has.
    if session.manifest_path().exists() {
        let recorded = manifest::read(&session)?.files.into_keys();
        files.extend(recorded.filter(|file| file.starts_with(TRANSPORT)));
    }
    let damage = damaged_files(&session, &state, &files)?;
    if !damage.is_empty() {
        let damage = damage.iter().map(ToString::to_string).collect();
        return Err(ProcessError::Damaged { dir: dir.to_owned(), damage, is_edited: false });
    }
    Stored::with(&session, &state, read)
}

impl Sweep {
    fn open(dir: &Path) -> Result<Self, ProcessError> {
        let (mut geometry, seen, mosaic) = with_stored(dir, |stored| {
            let Procedure::Sweep(own) = stored.plan.procedure.clone() else {
                return Err(wrong(
                    dir,
                    "is no sweep: a scene is relit by the transport of one (kind = \"sweep\")",
                ));
            };
            let rig = stored.plane_rig()?;
            let task = SweepTask::new(stored.plan, own, &stored.known(&rig)?);
            Ok((task.task.geometry.clone(), seen(stored, &task.task), task.task.mosaic))
        })?;
        let session = Session::open(dir)?;
        let path = session.transport_path();
        if !path.is_dir() {
            let what = "has no transport.zarr; `raysweep process` makes it once the sweep is complete";
            return Err(wrong(dir, what));
        }
        let ([depth, rows, columns], attributes) = transport::describe(&path)?;
        let u_min = attributes.get("u_min").and_then(Value::as_i64).and_then(|u| i32::try_from(u).ok());
        let u_min = u_min.ok_or_else(|| {
            wrong(dir, "transport.zarr does not say its u_min; `raysweep process` makes it again")
        })?;
        // Relative rows are less than the projector has.
        let last = u_min.checked_add(i32::try_from(depth).unwrap_or(i32::MAX));
        let reach = i32::try_from(geometry.raster.rows).unwrap_or(i32::MAX);
        let is_sound = u_min > -reach && last.is_some_and(|last| last <= reach);
        if !is_sound || (rows, columns) != (geometry.height, geometry.width) {
            let what = format!(
                "transport.zarr has {depth} x {rows} x {columns} values from u = {u_min} on, which do not fit the rig; `raysweep process` makes it again"
            );
            return Err(wrong(dir, what));
        }
        // As the sweep found it, if the rig file does not state it.
        let found_rows = attributes.get("beam_sigma_rows").and_then(Value::as_f64);
        geometry.beam_sigma_rows = found_rows.or(geometry.beam_sigma_rows);
        Ok(Self { session, seen, mosaic, geometry, u_min })
    }

    /// The scene under these weights of the projector's rows.
    fn relit(&self, weights: &Array1<f64>) -> Result<Relit, ProcessError> {
        let (dir, path) = (self.session.dir(), self.session.transport_path());
        let refused = |error: PlaneError| wrong(dir, error);
        let timing = self.geometry.timing().map_err(refused)?;
        let (height, width) = (self.geometry.height, self.geometry.width);
        let mut image = Array2::zeros((height, width));
        let mut mask = Array2::from_elem((height, width), mask::MEASURED);
        for first in (0..height).step_by(STRIP_ROWS) {
            let end = (first + STRIP_ROWS).min(height);
            let t = transport::read_rows(&path, first..end)?;
            let bits = transport::read_mask_rows(&path, first..end)?;
            let bits = bits.unwrap_or_else(|| Array3::from_elem(t.dim(), mask::MEASURED));
            let transport = mask::stored_transport(t, self.u_min, bits.view());
            let part = relight_rows(&timing, first, &transport, weights.view(), RelitBeam::AsLit);
            image.slice_mut(s![first..end, ..]).assign(&part.map_err(refused)?);
            let RelitUnknowns { is_bound, is_beyond } =
                RelitUnknowns::of(&timing, first, &transport, weights.view(), RelitBeam::AsLit)
                    .map_err(refused)?;
            for (place, of_pixel) in mask.slice_mut(s![first..end, ..]).indexed_iter_mut() {
                let stored = bits.slice(s![.., place.0, place.1]);
                if stored.iter().all(|bits| bits & (mask::MEASURED | mask::BOUND_ONLY) == 0) {
                    *of_pixel = 0;
                } else if is_bound[place] {
                    *of_pixel = mask::BOUND_ONLY;
                }
                if is_beyond[place] {
                    *of_pixel |= mask::OUTSIDE_REACH;
                }
            }
        }
        Ok(Relit { image, mask })
    }
}

/// What the camera saw of the projector, and in which units: the same in images that can be compared.
fn seen(stored: &Stored<'_>, task: &PlaneTask) -> String {
    let SweepGeometry { raster, height, width, row_pitch, .. } = &task.geometry;
    let made = task.calibration_made.as_deref().unwrap_or("none");
    format!(
        "{} projector rows of {} µs, of which {height} rows and {width} columns of a camera ({:?}) see row {} on, {row_pitch} apart; calibration: {made}",
        raster.rows, raster.row_time_us, task.mosaic, stored.state.session.first_row
    )
}

/// The regular images of a session that were taken under pictures of rows.
fn captured(dir: &Path, of_sweep: &str) -> Result<Vec<Capture>, ProcessError> {
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
        let own = seen(stored, &task.task);
        if own != of_sweep {
            let what = format!(
                "shows {own}, the sweep {of_sweep}: take both with the same rig, region and calibration"
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

/// SNR and PSNR of an image in dB, against a reference; over the pixels that are known. `None` without light or a difference.
fn ratios_db(
    reference: ArrayView2<f32>,
    image: ArrayView2<f32>,
    is_known: impl Fn([usize; 2]) -> bool,
) -> (Option<f64>, Option<f64>) {
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
    let db = |ratio: f64| Some(10.0 * ratio.log10()).filter(|db| db.is_finite());
    (db(signal / error), db(peak * peak * pixels / error))
}

/// A PNG file of images `[t, s, channels]` of one size.
fn side_by_side(images: &[Array3<f32>], white: ToneMap) -> Result<Vec<u8>, ProcessError> {
    let (rows, _, channels) = images.first().map_or((0, 0, 1), Array3::dim);
    let gap = Array3::<f32>::zeros((rows, GAP_PX, channels));
    let mut parts = Vec::new();
    for image in images {
        parts.extend([image.view(), gap.view()]);
    }
    parts.pop();
    let all = concatenate(Axis(1), &parts).map_err(|error| ProcessError::Config(error.to_string()))?;
    Ok(Picture::unreduced(all.view(), white).to_png()?)
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
        let (snr_db, psnr_db) = (snr_db.unwrap(), psnr_db.unwrap());
        // 25 over 0.02, and 16 times three pixels over 0.02.
        assert!((snr_db - 30.969).abs() < 1e-3 && (psnr_db - 33.802).abs() < 1e-3, "{snr_db} {psnr_db}");
    }
}
