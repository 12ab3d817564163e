//! The products of a session that are pictures or several (sequences and videos), and small PNG files of them.

use std::fs;
use std::path::{Path, PathBuf};

use ndarray::{ArrayD, Axis, Ix3};
use raysweep_session::products::Products;
use raysweep_session::report::{Picture, ToneMap};
use raysweep_session::{Error, Session, input};
use serde_json::Value;

use super::failure::CommandFailure;
use super::picture_file;

/// Largest picture, in bytes: 4096 x 4096 values and the header of their file.
const MOST_PICTURE_BYTES: u64 = (4 << 24) + (1 << 16);
/// Largest description of a product.
const MOST_ABOUT_BYTES: u64 = 1 << 24;
/// Pictures that say most of a session, best first.
const BEST: [&str; 4] = ["epipolar", "regular", "floodlit", "direct"];
/// Names of those that say least begin so: the projector was black.
const LEAST: &str = "black-";
/// The brightest half per cent of the pixels is white.
const WHITE_PERCENT: f64 = 99.5;

/// Names of the products that are pictures or several: those that say most, then the others, sorted.
pub(super) fn pictures(session: &Session) -> Vec<String> {
    let files = session.products().files();
    let mut names: Vec<String> = files
        .iter()
        .filter(|path| path.parent() == Some(&session.products_path()))
        .filter(|path| path.extension().is_some_and(|ending| ending == "npy"))
        .filter(|path| {
            let most = most_bytes(&about(path));
            path.metadata().is_ok_and(|it| it.is_file() && most.is_some_and(|most| it.len() <= most))
        })
        .filter_map(|path| Some(path.file_stem()?.to_str()?.to_owned()))
        .filter(|name| Products::is_name(name))
        .collect();
    names.sort();
    names.sort_by_key(|name| rank(name));
    names
}

/// Small for pictures that say much.
fn rank(name: &str) -> usize {
    let best = BEST.iter().position(|best| *best == name);
    best.unwrap_or(BEST.len() + usize::from(name.starts_with(LEAST)))
}

/// What is known of a product; null if nothing is.
pub(super) fn about(product: &Path) -> Value {
    let text = input::read_itself(&product.with_extension("json"), MOST_ABOUT_BYTES).ok();
    text.and_then(|text| serde_json::from_slice(&text).ok()).unwrap_or_default()
}

/// Largest file of a product that is shown, by its axes; none for what is no picture.
fn most_bytes(about: &Value) -> Option<u64> {
    let axes: Vec<&str> = about["axes"].as_array()?.iter().filter_map(Value::as_str).collect();
    match axes[..] {
        ["t", "s"] | ["t", "s", "rgb"] => Some(MOST_PICTURE_BYTES),
        // One image is read at a time.
        ["k", "t", "s"] | ["k", "t", "s", "rgb"] => Some(u64::MAX),
        _ => None,
    }
}

/// Image `k` of a product, `[t, s]` or `[t, s, rgb]`, and how many it has; a picture has one.
///
/// # Errors
/// If its file cannot be read, holds no pictures, or there is no such image.
pub(super) fn image(
    session: &Session,
    name: &str,
    k: usize,
) -> raysweep_session::Result<(ArrayD<f32>, usize)> {
    let products = session.products();
    let is_several = about(&products.dir().join(format!("{name}.npy")))["axes"][0] == "k";
    let (image, of) = match is_several {
        true => products.read_image_of(name, k)?,
        false => (products.read_array(name)?, 1),
    };
    // The dimensions in the file may contradict the names of the axes beside it.
    match image.shape() {
        [_, _] | [_, _, 3] if !image.is_empty() && k < of => Ok((image, of)),
        shape => Err(Error::Shape {
            what: format!("picture {k} of product `{name}`, counted from 0 of {of},"),
            found: shape.to_vec(),
            allowed: "[t, s] or [t, s, 3], not empty, and a picture that there is".into(),
        }),
    }
}

/// A picture of a session, or the first of several, as a small PNG file, with its own white.
///
/// # Errors
/// As [`image`].
pub(super) fn small(session: &Session, name: &str) -> raysweep_session::Result<Vec<u8>> {
    let (image, _) = image(session, name, 0)?;
    let image = if image.ndim() == 2 { image.insert_axis(Axis(2)) } else { image };
    let image = image.into_dimensionality::<Ix3>().map_err(|error| Error::Codec {
        action: "draw",
        what: format!("product `{name}`"),
        why: error.to_string(),
    })?;
    let planes: Vec<_> = image.axis_iter(Axis(2)).collect();
    let white = ToneMap::percentile(&planes, WHITE_PERCENT);
    Picture::small(image.view(), white).to_png()
}

/// Writes a small PNG file of each picture of a session into `folder`; returns their paths. What cannot be read is left out:
/// it is shown as damaged.
pub(super) fn write(session: &Session, folder: &Path) -> Result<Vec<PathBuf>, CommandFailure> {
    let paths: Vec<(String, PathBuf)> = pictures(session)
        .into_iter()
        .map(|name| (name.clone(), folder.join(format!("{name}.png"))))
        .collect();
    // All of them, before a folder is made or a picture written where none is wanted.
    paths.iter().try_for_each(|(_, path)| picture_file::check(path))?;
    fs::create_dir_all(folder).map_err(|source| CommandFailure::Write { path: folder.to_owned(), source })?;
    let mut written = Vec::new();
    for (name, path) in paths {
        let Ok(png) = small(session, &name) else { continue };
        picture_file::write(&path, &png)?;
        written.push(path);
    }
    Ok(written)
}

#[cfg(test)]
mod tests {
    use super::rank;

    #[test]
    fn pictures_without_light_come_last() {
        let mut names = ["black-regular", "direct", "gray-code-rows-regular"];
        names.sort_by_key(|name| rank(name));
        assert_eq!(names, ["direct", "gray-code-rows-regular", "black-regular"]);
    }
}
