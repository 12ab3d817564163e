//! Lighting patterns from files.

use std::fs::File;
use std::io::{BufReader, Seek};
use std::path::{Path, PathBuf};

use ndarray::{Array4, ArrayViewD, Axis, Ix4};
use ndarray_npy::ViewNpyExt;
use raysweep_core::Size;

use crate::{Error, Result, durable, input};

/// Most bytes of a pattern file, and of its patterns in memory.
const MOST_BYTES: u64 = 256 << 20;

/// An open file with lighting patterns, which are known to fit into memory.
///
/// A PNG file holds one pattern, which is decoded from sRGB to linear light from 0 to 1 (its gamma and
/// transparency are ignored). An NPY file (float32, used as is) holds one (`[row, column]`,
/// `[row, column, 3]`) or a sequence (`[k, row, column, 3]`).
pub struct PatternFile {
    path: PathBuf,
    file: File,
    format: Format,
    bytes: u64,
}

#[derive(Clone, Copy)]
enum Format {
    Png,
    Npy,
}

impl PatternFile {
    /// Opens a file.
    ///
    /// # Errors
    /// [`Error::Io`] unless it is a regular file, [`Error::Codec`] for one that is none of patterns, or too large.
    pub fn open(path: &Path) -> Result<Self> {
        Self::of(path, input::open(path, MOST_BYTES))
    }

    /// Opens a file below one of these folders, without following symbolic links.
    ///
    /// # Errors
    /// As [`PatternFile::open`], and for a file elsewhere.
    pub fn open_below(folders: &[PathBuf], path: &Path) -> Result<Self> {
        Self::of(path, input::open_below(folders, path, MOST_BYTES))
    }

    fn of(path: &Path, file: std::io::Result<File>) -> Result<Self> {
        let format = match path.extension().and_then(|extension| extension.to_str()) {
            Some("png") => Format::Png,
            Some("npy") => Format::Npy,
            _ => return Err(refused(path)("a lighting pattern must be a .png or .npy file")),
        };
        let failed = || Error::io("read", path);
        let mut file = file.map_err(failed())?;
        let bytes = match format {
            Format::Png => {
                let reader = png_reader(&file).map_err(refused(path))?;
                let (columns, rows) = (reader.info().width, reader.info().height);
                u64::from(columns).saturating_mul(rows.into()).saturating_mul(3 * size_of::<f32>() as u64)
            }
            Format::Npy => file.metadata().map_err(failed())?.len(),
        };
        if bytes > MOST_BYTES {
            let what =
                format!("its patterns need {} of memory, and {} are allowed", Size(bytes), Size(MOST_BYTES));
            return Err(refused(path)(what));
        }
        file.rewind().map_err(failed())?;
        Ok(Self { path: path.to_owned(), file, format, bytes })
    }

    /// Memory that its patterns need at most.
    pub fn bytes(&self) -> u64 {
        self.bytes
    }

    /// Reads its patterns, `[k, row, column, channels]` with one or three channels.
    ///
    /// # Errors
    /// [`Error::Io`] if it cannot be read, [`Error::Codec`] for other files, [`Error::Shape`] for other axes.
    pub fn read(self) -> Result<Array4<f32>> {
        let patterns = match self.format {
            Format::Png => self.read_png()?,
            Format::Npy => self.read_npy()?,
        };
        if patterns.is_empty() || patterns.iter().any(|light| !light.is_finite()) {
            return Err(refused(&self.path)("a lighting pattern must have pixels, all of them finite"));
        }
        Ok(patterns)
    }

    fn read_npy(&self) -> Result<Array4<f32>> {
        let bytes = input::read_open(&self.file, MOST_BYTES).map_err(Error::io("read", &self.path))?;
        // Aligned for the view, which compares the header with the length before anything is allocated for it.
        let mut aligned = vec![0f32; bytes.len().div_ceil(size_of::<f32>())];
        let aligned: &mut [u8] = bytemuck::cast_slice_mut(&mut aligned);
        aligned[..bytes.len()].copy_from_slice(&bytes);
        let array = ArrayViewD::<f32>::view_npy(&aligned[..bytes.len()]).map_err(refused(&self.path))?;
        let found = array.shape().to_vec();
        let array = match found.len() {
            2 => array.insert_axis(Axis(0)).insert_axis(Axis(3)),
            3 => array.insert_axis(Axis(0)),
            _ => array,
        };
        let allowed = "[row, column], [row, column, 3] or [k, row, column, 3]".to_owned();
        let what = format!("the lighting pattern {}", self.path.display());
        match array.into_dimensionality::<Ix4>() {
            Ok(array) if [1, 3].contains(&array.shape()[3]) => Ok(array.to_owned()),
            _ => Err(Error::Shape { what, found, allowed }),
        }
    }

    fn read_png(&self) -> Result<Array4<f32>> {
        let failed = |error: png::DecodingError| refused(&self.path)(error);
        let mut reader = png_reader(&self.file).map_err(failed)?;
        let too_large = || refused(&self.path)("it is too large");
        let mut bytes = vec![0; reader.output_buffer_size().ok_or_else(too_large)?];
        let info = reader.next_frame(&mut bytes).map_err(failed)?;
        let samples = info.color_type.samples();
        let channels = if samples < 3 { 1 } else { 3 };
        let (rows, columns) = (info.height as usize, info.width as usize);
        Ok(Array4::from_shape_fn((1, rows, columns, channels), |(_, row, column, channel)| {
            linear(bytes[row * info.line_size + column * samples + channel])
        }))
    }
}

fn refused<E: ToString>(path: &Path) -> impl FnOnce(E) -> Error {
    Error::codec("read", path.display())
}

/// Reads the header.
fn png_reader(file: &File) -> std::result::Result<png::Reader<BufReader<&File>>, png::DecodingError> {
    let mut decoder = png::Decoder::new(BufReader::new(file));
    decoder.set_transformations(png::Transformations::EXPAND | png::Transformations::STRIP_16);
    decoder.read_info()
}

/// Writes patterns so that [`PatternFile::read`] returns them unchanged.
///
/// # Errors
/// [`Error::Io`].
pub fn write(path: &Path, patterns: &Array4<f32>) -> Result<()> {
    use ndarray_npy::WriteNpyExt;
    durable::write_with(path, |file| patterns.write_npy(file).map_err(std::io::Error::other))
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
        let read = PatternFile::open(&path).unwrap().read().unwrap();
        assert_eq!(read.dim(), (1, 3, 5, 3));
        assert!(read.iter().zip(&light).all(|(read, light)| (read - light).abs() < 0.01), "{read}");
    }

    #[test]
    fn sequences_read_back_and_what_is_none_is_refused() {
        let read = |path: &Path| PatternFile::open(path).and_then(PatternFile::read);
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

    #[test]
    fn a_header_that_claims_more_than_there_is_costs_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("pattern.npy");
        let header = "{'descr': '<f4', 'fortran_order': False, 'shape': (100000, 100000, 3), }";
        let mut bytes = b"\x93NUMPY\x01\x00\x76\x00".to_vec();
        bytes.extend(format!("{header:117}\n").bytes());
        assert_eq!(bytes.len(), 128);
        std::fs::write(&path, &bytes).unwrap();
        let error = PatternFile::open(&path).and_then(PatternFile::read).unwrap_err();
        assert!(matches!(error, Error::Codec { .. }), "{error}");

        let path = dir.path().join("pattern.png");
        let mut encoder = png::Encoder::new(File::create(&path).unwrap(), 100_000, 100_000);
        encoder.set_color(png::ColorType::Rgb);
        drop(encoder.write_header().unwrap());
        let Err(error) = PatternFile::open(&path) else { panic!("30 GB of pixels") };
        assert!(matches!(error, Error::Codec { .. }), "{error}");
    }
}
