//! `raysweep diff`: what differs between two sessions, their settings and their images.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use ndarray::{Array2, Array3, Axis, concatenate, stack};
use raysweep_config::plan::with_tables;
use raysweep_config::{Plan, Procedure};
use raysweep_core::Counts;
use raysweep_processing::ProcessError;
use raysweep_session::Session;
use raysweep_session::report::{Picture, ToneMap};
use serde::Serialize;

use super::failure::CommandFailure;
use super::picture_file;
use super::sessions::{SessionView, calibration_of, flat, flat_text};
use super::show::block;
use super::thumbnails;

/// Columns between the images of a picture.
const GAP_PX: usize = 4;
/// Percentile of the pixels that maps to white in a picture.
const PERCENTILE: f64 = 99.5;

/// What differs between two sessions.
#[derive(Debug, Serialize)]
pub(super) struct Compared {
    /// What is damaged of the files that were compared, in each session.
    damage: [Vec<String>; 2],
    /// Sentences about plan, rig file, calibration, software, operator and sample; empty if nothing differs.
    settings: Vec<String>,
    /// Points stored, of those planned.
    stored: [[usize; 2]; 2],
    counts: [Counts; 2],
    /// Warnings of each session's latest run that the other's does not have.
    warnings: [Vec<String>; 2],
    /// Products that both have, with the same shape.
    products: BTreeMap<String, Difference>,
    /// Products that only one of them has, or that have another shape.
    unlike: Vec<String>,
    /// The picture, if one was asked for.
    pub picture: Option<PictureOfDifference>,
}

/// The difference of an image, B - A, over the values that are numbers in both.
#[derive(Debug, Serialize, PartialEq)]
struct Difference {
    /// Values that are numbers in both.
    compared: usize,
    /// Values of the image: one for each pixel, or three in colour.
    values: usize,
    /// Root mean square of the first image.
    rms: f64,
    /// Root mean square of the difference.
    rms_difference: f64,
    /// The largest difference of a pixel, with its sign.
    largest: f64,
}

impl Compared {
    /// Compares two sessions.
    pub fn read(folders: [&Path; 2]) -> Result<Self, CommandFailure> {
        let [a, b] = folders;
        let [mut first, mut second] = [SessionView::read(a)?, SessionView::read(b)?];
        let names = |shown: &SessionView| -> BTreeSet<String> {
            let stem = |path: &PathBuf| Some(path.file_stem()?.to_str()?.to_owned());
            shown.products.iter().filter_map(stem).filter(|name| !name.ends_with("_mask")).collect()
        };
        let found = [names(&first), names(&second)];
        for ((dir, view), names) in folders.iter().zip([&mut first, &mut second]).zip(&found) {
            let session = Session::open(dir).map_err(ProcessError::from)?;
            view.check_products(&session, &names.iter().cloned().collect::<Vec<_>>())?;
        }
        let [of_first, of_second] = found;
        let (mut products, mut unlike) = (BTreeMap::new(), Vec::new());
        for name in of_first.union(&of_second) {
            match (image(a, name), image(b, name)) {
                (Some(first), Some(second)) if first.dim() == second.dim() => {
                    products.insert(name.clone(), Difference::of(&first, &second));
                }
                // Arrays of more axes follow from the same stack.
                (None, None) if of_first.contains(name) && of_second.contains(name) => {}
                _ => unlike.push(name.clone()),
            }
        }
        let only = |one: &SessionView, other: &SessionView| {
            one.warnings.iter().filter(|warning| !other.warnings.contains(warning)).cloned().collect()
        };
        let mut settings = changes(a, b)?;
        for (what, a, b) in
            [("operator", &first.operator, &second.operator), ("sample", &first.sample, &second.sample)]
        {
            if a != b {
                let said = |value: &Option<String>| value.clone().unwrap_or_else(|| "none".into());
                settings.push(format!("{what}: {}, was {}", said(b), said(a)));
            }
        }
        Ok(Self {
            warnings: [only(&first, &second), only(&second, &first)],
            damage: [first.damage, second.damage],
            settings,
            picture: None,
            stored: [[first.stored, first.points], [second.stored, second.points]],
            counts: [first.counts, second.counts],
            products,
            unlike,
        })
    }

    /// As text.
    pub fn text(&self) -> String {
        let mut rows = Vec::new();
        let mut title = "settings";
        if self.settings.is_empty() {
            rows.push((title, "the same".to_owned()));
        }
        for said in &self.settings {
            rows.push((title, said.clone()));
            title = "";
        }
        for (which, ([stored, points], counts)) in ["A", "B"].iter().zip(self.stored.iter().zip(&self.counts))
        {
            let Counts { expected, averaged, .. } = counts;
            rows.push((
                which,
                format!(
                    "{stored} of {points} points stored, {averaged} frames used of {expected}, {}",
                    counts.losses()
                ),
            ));
        }
        for (which, warnings) in ["A", "B"].iter().zip(&self.warnings) {
            rows.extend(warnings.iter().map(|warning| ("warning", format!("only in {which}: {warning}"))));
        }
        title = "products";
        for (name, difference) in &self.products {
            rows.push((title, format!("{name}: {}", difference.text())));
            title = "";
        }
        rows.extend(self.unlike.iter().map(|name| ("", format!("{name}: not in both, or of another shape"))));
        for (which, damage) in ["A", "B"].iter().zip(&self.damage) {
            rows.extend(damage.iter().map(|damage| ("DAMAGED", format!("in {which}, {damage}"))));
        }
        rows.extend(self.picture.iter().map(|picture| ("picture", picture.legend())));
        block(&rows)
    }
}

impl Difference {
    fn of(a: &Array3<f32>, b: &Array3<f32>) -> Self {
        let pairs = || {
            let pairs = a.iter().zip(b).map(|(a, b)| (f64::from(*a), f64::from(*b)));
            pairs.filter(|(a, b)| a.is_finite() && b.is_finite())
        };
        let compared = pairs().count();
        let rms = |of: fn((f64, f64)) -> f64| {
            let sum: f64 = pairs().map(|pair| of(pair).powi(2)).sum();
            if compared == 0 { 0.0 } else { (sum / compared as f64).sqrt() }
        };
        let difference = |(a, b)| b - a;
        Self {
            compared,
            values: a.len(),
            rms: rms(|(a, _)| a),
            rms_difference: rms(difference),
            largest: pairs().map(difference).fold(
                0.0,
                |most: f64, value| {
                    if value.abs() > most.abs() { value } else { most }
                },
            ),
        }
    }

    fn text(&self) -> String {
        let Self { compared, values, rms, rms_difference, largest } = self;
        if *compared == 0 {
            return "no value is a number in both".into();
        }
        let share =
            if *rms > 0.0 { format!(" ({:.2} %)", 100.0 * rms_difference / rms) } else { String::new() };
        let of = if compared < values {
            format!("; over the {compared} of {values} values that are numbers in both")
        } else {
            String::new()
        };
        format!("RMS of B - A {rms_difference:.3e}{share}, at most {largest:+.3e}{of}")
    }
}

/// What a picture of a difference shows, from left to right: A, B, and B - A.
#[derive(Debug, Serialize)]
pub(super) struct PictureOfDifference {
    file: PathBuf,
    product: String,
    /// The product's unit; empty if its file does not say it.
    units: String,
    /// The value that is white in A and B.
    white: f32,
    /// The size of the difference at which red and blue are full.
    full_difference: f32,
}

impl PictureOfDifference {
    fn legend(&self) -> String {
        let Self { file, product, units, white, full_difference } = self;
        let units = if units.is_empty() { String::new() } else { format!("\nunit: {units}") };
        format!(
            "{}\n{product} of A, of B, and B - A, from left to right\nA and B: black is 0, white is {white:.3e} or more\nB - A: black is 0, red is B > A, full at +{full_difference:.3e}, blue is B < A, full at -{full_difference:.3e}{units}",
            file.display()
        )
    }
}

/// Writes a picture of a product in two sessions and of their difference, side by side, as a PNG file. The first two have
/// one scale, and the difference its own.
pub(super) fn write_picture_of_difference(
    folders: [&Path; 2],
    product: &str,
    file: PathBuf,
) -> Result<PictureOfDifference, CommandFailure> {
    let [a, b] = folders.map(|folder| {
        image(folder, product).ok_or_else(|| {
            CommandFailure::Sessions(format!(
                "{} has no image {product}: `raysweep show` lists its products",
                folder.display()
            ))
        })
    });
    let (a, b) = (grey(&a?), grey(&b?));
    if a.dim() != b.dim() {
        let message =
            format!("{product} has {:?} pixels in one session and {:?} in the other", a.dim(), b.dim());
        return Err(CommandFailure::Sessions(message));
    }
    let difference = &b - &a;
    let scaled = |image: &Array2<f32>, ToneMap { white }: ToneMap| image.mapv(|light| light / white);
    let common = ToneMap::percentile(&[a.view(), b.view()], PERCENTILE);
    let own = ToneMap::percentile(&[difference.mapv(f32::abs).view()], PERCENTILE);
    let (a, b, difference) = (scaled(&a, common), scaled(&b, common), scaled(&difference, own));
    let gap = Array2::zeros((a.nrows(), GAP_PX));
    let (positive, negative) =
        (difference.mapv(|light| light.max(0.0)), difference.mapv(|light| -light.min(0.0)));
    let none = Array2::zeros(a.dim());
    let failed = |error| CommandFailure::Output(std::io::Error::other(error));
    let channels = [&positive, &none, &negative].map(|shown| {
        concatenate(Axis(1), &[a.view(), gap.view(), b.view(), gap.view(), shown.view()]).map_err(failed)
    });
    let [red, green, blue] = channels;
    let all = stack(Axis(2), &[red?.view(), green?.view(), blue?.view()]).map_err(failed)?;
    let png = Picture::rgb(all.view(), ToneMap { white: 1.0 }).to_png().map_err(ProcessError::from)?;
    picture_file::write(&file, &png)?;
    let about = thumbnails::about(&folders[0].join("products").join(format!("{product}.npy")));
    Ok(PictureOfDifference {
        file,
        product: product.to_owned(),
        units: about["units"].as_str().unwrap_or_default().to_owned(),
        white: common.white,
        full_difference: own.white,
    })
}

/// What differs between the settings of two sessions, in a sentence each.
pub(super) fn changes(before: &Path, after: &Path) -> Result<Vec<String>, CommandFailure> {
    let mut found = Vec::new();
    let open = |dir| Session::open(dir).map_err(ProcessError::from);
    let [first, second] = [open(before)?, open(after)?];
    let plans = (flat_plan(&first)?, flat_plan(&second)?);
    let rigs = (flat(&first, "rig.toml")?, flat(&second, "rig.toml")?);
    for (file, (a, b)) in [("plan.toml", plans), ("rig.toml", rigs)] {
        let keys: BTreeSet<&String> = a.keys().chain(b.keys()).collect();
        for key in keys {
            match (a.get(key), b.get(key)) {
                (Some(a), Some(b)) if a == b => {}
                (Some(a), Some(b)) => found.push(format!("{file}: {key} = {b}, was {a}")),
                (None, Some(b)) => found.push(format!("{file}: {key} = {b}, was not given")),
                (Some(a), None) => found.push(format!("{file}: {key} is not given, was {a}")),
                (None, None) => {}
            }
        }
    }
    let shown = |made: jiff::Timestamp| made.strftime("%Y-%m-%d %H:%M:%S UTC").to_string();
    let made = |dir| calibration_of(dir).map_or_else(|| "none".to_owned(), shown);
    let software = |session: &Session| -> Result<String, CommandFailure> {
        Ok(session.state().map_err(ProcessError::from)?.session.software)
    };
    let others =
        [("calibration", made(before), made(after)), ("software", software(&first)?, software(&second)?)];
    let changed = others.into_iter().filter(|(_, a, b)| a != b);
    found.extend(changed.map(|(what, a, b)| format!("{what}: {b}, was {a}")));
    Ok(found)
}

/// The plan's keys, of a sweep or a film also those that it leaves to their defaults.
fn flat_plan(session: &Session) -> Result<BTreeMap<String, String>, CommandFailure> {
    let path = session.plan_path();
    let text = session.read_text(&path).map_err(ProcessError::from)?;
    let table = Plan::parse(&text).ok().and_then(|plan| match plan.procedure {
        Procedure::Sweep(sweep) => Some(sweep.to_toml()),
        Procedure::Film(film) => Some(film.to_toml()),
        _ => None,
    });
    let whole = table.and_then(|table| with_tables(&text, &table).ok());
    flat_text(&whole.unwrap_or(text), &path)
}

/// An image `[t, s, channels]` with one or three channels among a session's products.
fn image(dir: &Path, name: &str) -> Option<Array3<f32>> {
    let array = Session::open(dir).ok()?.products().read_array(name).ok()?;
    match array.ndim() {
        2 => array.insert_axis(Axis(2)),
        _ => array,
    }
    .into_dimensionality()
    .ok()
    .filter(|image: &Array3<f32>| [1, 3].contains(&image.len_of(Axis(2))))
}

/// An image of which all channels are one.
fn grey(image: &Array3<f32>) -> Array2<f32> {
    image.sum_axis(Axis(2)) / image.len_of(Axis(2)) as f32
}

#[cfg(test)]
mod tests {
    use ndarray::arr3;

    use super::*;

    #[test]
    fn the_difference_of_images_is_that_of_their_pixels() {
        let (a, b) = (arr3(&[[[3.0], [4.0]]]), arr3(&[[[3.0], [1.0]]]));
        let found = Difference::of(&a, &b);
        assert_eq!((found.rms, found.rms_difference, found.largest), (12.5_f64.sqrt(), 4.5_f64.sqrt(), -3.0));
        assert_eq!(found.text(), "RMS of B - A 2.121e0 (60.00 %), at most -3.000e0");
    }

    #[test]
    fn pixels_that_are_no_numbers_are_not_compared() {
        let (a, b) = (arr3(&[[[f32::NAN, 4.0, 1.0]]]), arr3(&[[[3.0, 1.0, f32::INFINITY]]]));
        let found = Difference::of(&a, &b);
        assert_eq!((found.rms, found.rms_difference, found.largest), (4.0, 3.0, -3.0));
        assert!(found.text().ends_with("; over the 1 of 3 values that are numbers in both"));
        let none = Difference::of(&arr3(&[[[f32::NAN]]]), &arr3(&[[[1.0]]]));
        assert_eq!(none.text(), "no value is a number in both");
    }
}
