//! Lighting patterns from files.

use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use ndarray::{Array4, ArrayD, Axis, Ix4};

use crate::{Error, Result, durable};

/// Reads lighting patterns `[k, row, column, channels]` with one or three channels.
///
/// A PNG file holds one pattern, which is decoded from sRGB to linear light from 0 to 1 (its gamma and
/// transparency are ignored). An NPY file (float32, used as is) holds one (`[row, column]`,
/// `[row, column, 3]`) or a sequence (`[k, row, column, 3]`).
///
/// # Errors
/// [`Error::Io`] if it cannot be read, [`Error::Codec`] for other files, [`Error::Shape`] for other axes.
pub fn read(path: &Path) -> Result<Array4<f32>> {
    let patterns = match path.extension().and_then(|extension| extension.to_str()) {
        Some("png") => read_png(path)?,
        Some("npy") => read_npy(path)?,
        _ => {
            return Err(Error::codec("read", path.display())(
                "a lighting pattern must be a .png or .npy file",
            ));
        }
    };
    if patterns.is_empty() || patterns.iter().any(|light| !light.is_finite()) {
        return Err(Error::codec("read", path.display())(
            "a lighting pattern must have pixels, all of them finite",
        ));
    }
    Ok(patterns)
}

/// Writes patterns so that [`read`] returns them unchanged.
///
/// # Errors
/// [`Error::Io`].
pub fn write(path: &Path, patterns: &Array4<f32>) -> Result<()> {
    use ndarray_npy::WriteNpyExt;
    durable::write_with(path, |file| patterns.write_npy(file).map_err(std::io::Error::other))
}

fn read_npy(path: &Path) -> Result<Array4<f32>> {
    let file = File::open(path).map_err(Error::io("read", path))?;
    let array: ArrayD<f32> = ndarray_npy::ReadNpyExt::read_npy(BufReader::new(file))
        .map_err(Error::codec("read", path.display()))?;
    let found = array.shape().to_vec();
    let array = match found.len() {
        2 => array.insert_axis(Axis(0)).insert_axis(Axis(3)),
        3 => array.insert_axis(Axis(0)),
        _ => array,
    };
    let allowed = "[row, column], [row, column, 3] or [k, row, column, 3]".to_owned();
    let what = format!("the lighting pattern {}", path.display());
    match array.into_dimensionality::<Ix4>() {
        Ok(array) if [1, 3].contains(&array.shape()[3]) => Ok(array),
        _ => Err(Error::Shape { what, found, allowed }),
    }
}

fn read_png(path: &Path) -> Result<Array4<f32>> {
    let refused = |error: png::DecodingError| Error::codec("read", path.display())(error);
    let file = File::open(path).map_err(Error::io("read", path))?;
    let mut decoder = png::Decoder::new(BufReader::new(file));
    decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::STRIP_16);
    let mut reader = decoder.read_info().map_err(refused)?;
    let too_large = || Error::codec("read", path.display())("it is too large");
    let mut bytes = vec![0; reader.output_buffer_size().ok_or_else(too_large)?];
    let info = reader.next_frame(&mut bytes).map_err(refused)?;
    let samples = info.color_type.samples();
    let channels = if samples < 3 { 1 } else { 3 };
    let (rows, columns) = (info.height as usize, info.width as usize);
    Ok(Array4::from_shape_fn((1, rows, columns, channels), |(_, row, column, channel)| {
        linear(bytes[row * info.line_size + column * samples + channel])
    }))
}

/// The inverse of the transfer function of sRGB (IEC 61966-2-1).
fn linear(level: u8) -> f32 {
    let encoded = f32::from(level) / 255.0;
    if encoded <= 0.04045 { encoded / 12.92 } else { ((encoded + 0.055) / 1.055).powf(2.4) }
}

#[cfg(test)]
mod tests {
    use ndarray::Array3;

    use super::*;
    use crate::report::{Picture, ToneMap};

    #[test]
    fn a_png_gives_back_the_linear_light_that_it_was_made_of() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("pattern.png");
        let light = Array3::from_shape_fn((3, 5, 3), |(t, s, c)| (t * 15 + s * 3 + c) as f32 / 45.0);
        std::fs::write(&path, Picture::rgb(light.view(), ToneMap { white: 1.0 }).to_png().unwrap()).unwrap();
        let read = read(&path).unwrap();
        assert_eq!(read.dim(), (1, 3, 5, 3));
        assert!(read.iter().zip(&light).all(|(read, light)| (read - light).abs() < 0.01), "{read}");
    }

    #[test]
    fn sequences_read_back_and_what_is_none_is_refused() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("pattern.npy");
        let patterns =
            Array4::from_shape_fn((2, 3, 4, 3), |(k, t, s, c)| (k * 36 + t * 12 + s * 3 + c) as f32);
        write(&path, &patterns).unwrap();
        assert_eq!(read(&path).unwrap(), patterns);
        write(&path, &Array4::zeros((2, 3, 4, 2))).unwrap();
        assert!(matches!(read(&path), Err(Error::Shape { .. })));
        write(&path, &Array4::from_elem((1, 1, 1, 1), f32::NAN)).unwrap();
        assert!(matches!(read(&path), Err(Error::Codec { .. })));
        assert!(matches!(read(Path::new("pattern.gif")), Err(Error::Codec { .. })));
    }
}
