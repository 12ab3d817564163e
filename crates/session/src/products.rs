//! `products/`: the results, as files that other programs can open.
//!
//! An image `NAME` is `NAME.exr` (channel Y, or R, G, B; metadata as text attributes `raysweep.KEY`) and
//! `NAME.npy` (float32 `[t, s]`, or `[t, s, 3]`); a volume is only `NAME.npy`. A sequence of images is
//! `NAME.npy` (`[k, t, s]`) and one `NAME.exr` with a layer per image; a table is `NAME.npy`
//! (`[row, column]`) and `NAME.csv`. Each has a `NAME.json` with its metadata. For videos see
//! [`VideoWriter`].
//!
//! Values are linear. Every file is written durably, and the same input gives the same bytes.

use std::fs::File;
use std::io::{self, BufWriter};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use ndarray::{Array2, ArrayD, ArrayRef, ArrayView2, ArrayView3, ArrayView4, ArrayViewD, Axis, Dimension};
use ndarray_npy::{ViewNpyExt, WritableElement, WriteNpyExt};
use raysweep_core::{NpyHeader, io_text};
use serde_json::{Map, Value};

pub use self::video::{VideoWriter, video_tone_map};
pub use self::volume::VolumeWriter;
use crate::{Error, Result, durable, exr_file, input};

mod pictures;
mod video;
mod volume;

/// Most values of an image that is read by itself: 4096 x 4096 pixels.
const MOST_IMAGE_VALUES: usize = 1 << 24;

/// The EXR channels of an image in colour.
const RGB: [&str; 3] = ["R", "G", "B"];

/// The folder of the products.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Products {
    dir: PathBuf,
}

impl Products {
    /// The products in `dir`, which is created if it is missing.
    pub fn new(dir: impl Into<PathBuf>) -> Products {
        Products { dir: dir.into() }
    }

    /// Whether a product may have this name: it then needs no escaping in files and addresses.
    pub fn is_name(name: &str) -> bool {
        let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_');
        !name.is_empty() && name.chars().all(plain)
    }

    /// The folder.
    pub fn dir(&self) -> &Path {
        &self.dir
    }

    /// Writes a monochrome image `[t, s]` as `name.exr`, `name.npy` and `name.json`.
    ///
    /// # Errors
    /// [`Error::Codec`] for an empty image or a name that is not a plain file name, [`Error::Io`].
    pub fn image(&self, name: &str, values: ArrayView2<f32>, metadata: &Map<String, Value>) -> Result<()> {
        self.write(name, "exr", &exr_file::encode(&[("Y", values)], metadata)?)?;
        self.write_array(name, &values, metadata)
    }

    /// Writes an image `[t, s, channels]` with one or three channels as [`Products::image`] or [`Products::rgb`], with a
    /// mask `[t, s]`, which is the EXR file's channel `mask` and `name_mask.npy` (uint8); `metadata` should name its bits.
    ///
    /// # Errors
    /// [`Error::Shape`] if the mask is not as large as the image; otherwise as [`Products::image`].
    pub fn masked_image(
        &self,
        name: &str,
        values: ArrayView3<f32>,
        mask: ArrayView2<u8>,
        metadata: &Map<String, Value>,
    ) -> Result<()> {
        let names = channels(name, values.shape())?;
        let shown = self.write_mask(name, mask, &values.shape()[..2])?;
        let mut planes: Vec<_> = names.iter().copied().zip(values.axis_iter(Axis(2))).collect();
        planes.push(("mask", shown.view()));
        self.write(name, "exr", &exr_file::encode(&planes, metadata)?)?;
        match names {
            [_] => self.write_array(name, &values.index_axis(Axis(2), 0), metadata),
            _ => self.write_array(name, &values, metadata),
        }
    }

    /// Writes a colour image `[t, s, 3]` (R, G, B) as `name.exr`, `name.npy` and `name.json`.
    ///
    /// # Errors
    /// [`Error::Shape`] if the last axis is not 3; otherwise as [`Products::image`].
    pub fn rgb(&self, name: &str, values: ArrayView3<f32>, metadata: &Map<String, Value>) -> Result<()> {
        if values.shape()[2] != 3 {
            let found = values.shape().to_vec();
            return Err(Error::Shape { what: format!("image `{name}`"), found, allowed: "[t, s, 3]".into() });
        }
        let planes: Vec<_> = RGB.into_iter().zip(values.axis_iter(Axis(2))).collect();
        self.write(name, "exr", &exr_file::encode(&planes, metadata)?)?;
        self.write_array(name, &values, metadata)
    }

    /// Removes what an earlier product of this name and of another kind has left: its files with other endings than these,
    /// of which `_mask.npy` and the empty one of a folder count as such.
    ///
    /// # Errors
    /// [`Error::Codec`] for a name that is not a plain file name, [`Error::Io`].
    pub fn remove_others(&self, name: &str, kept: &[&str]) -> Result<()> {
        let path = self.path(name, "npy")?;
        for ending in [".exr", ".csv", ".mp4", "_mask.npy", ""] {
            if !kept.contains(&ending) {
                durable::remove(&path.with_file_name(format!("{name}{ending}")))?;
            }
        }
        Ok(())
    }

    /// Writes a volume as `name.npy` (C order) and `name.json`, which should name the axes.
    ///
    /// # Errors
    /// As [`Products::image`].
    pub fn volume(&self, name: &str, values: ArrayView3<f32>, metadata: &Map<String, Value>) -> Result<()> {
        let mut writer = self.volume_writer(name, values.dim(), metadata)?;
        writer.append(values)?;
        writer.commit()
    }

    /// Begins a volume of shape `[u, t, s]` that is written in strips of its middle axis, from top to bottom:
    /// a replacement for [`Products::volume`] if it does not fit in memory.
    ///
    /// # Errors
    /// As [`Products::image`].
    pub fn volume_writer(
        &self,
        name: &str,
        shape: (usize, usize, usize),
        metadata: &Map<String, Value>,
    ) -> Result<VolumeWriter> {
        let path = self.path(name, "npy")?;
        durable::create_dir_within(&self.dir)?;
        VolumeWriter::create(&path, shape, (self.path(name, "json")?, sidecar(name, metadata)?))
    }

    /// Writes images `[k, t, s]` as `name.npy`, `name.json` and one `name.exr` whose layer `k` has the
    /// channel `layers[k].Y`; layer names should ascend.
    ///
    /// # Errors
    /// [`Error::Shape`] if the numbers of layers and images differ; otherwise as [`Products::image`].
    pub fn sequence(
        &self,
        name: &str,
        values: ArrayView3<f32>,
        layers: &[String],
        metadata: &Map<String, Value>,
    ) -> Result<()> {
        self.layers(name, values.insert_axis(Axis(3)), layers, None, metadata)
    }

    fn layers(
        &self,
        name: &str,
        values: ArrayView4<f32>,
        layers: &[String],
        mask: Option<ArrayView2<f32>>,
        metadata: &Map<String, Value>,
    ) -> Result<()> {
        let names = channels(name, values.shape())?;
        if values.shape()[0] != layers.len() {
            let (found, allowed) = (values.shape().to_vec(), format!("[{}, t, s]", layers.len()));
            return Err(Error::Shape { what: format!("sequence `{name}`"), found, allowed });
        }
        let layered = layers.iter().flat_map(|layer| names.iter().map(move |name| format!("{layer}.{name}")));
        let layered: Vec<String> = layered.collect();
        let images = values.outer_iter().flat_map(|image| {
            (0..names.len()).map(move |channel| image.index_axis_move(Axis(2), channel)).collect::<Vec<_>>()
        });
        let mut planes: Vec<_> = layered.iter().map(String::as_str).zip(images).collect();
        planes.extend(mask.map(|mask| ("mask", mask)));
        self.write(name, "exr", &exr_file::encode(&planes, metadata)?)?;
        match names {
            [_] => self.write_array(name, &values.index_axis(Axis(3), 0), metadata),
            _ => self.write_array(name, &values, metadata),
        }
    }

    /// Writes images `[k, t, s, channels]` as [`Products::sequence`] does, of three channels as layers with R, G, B and
    /// `[k, t, s, 3]`; with one mask for all images, as in [`Products::masked_image`], and with pictures: `NAME/0000.png`
    /// and so on, and `NAME/contact_sheet.png`.
    ///
    /// # Errors
    /// As [`Products::sequence`] and [`Products::masked_image`].
    pub fn masked_sequence(
        &self,
        name: &str,
        values: ArrayView4<f32>,
        layers: &[String],
        mask: ArrayView2<u8>,
        metadata: &Map<String, Value>,
    ) -> Result<()> {
        let shown = self.write_mask(name, mask, &values.shape()[1..3])?;
        self.layers(name, values, layers, Some(shown.view()), metadata)?;
        self.write_pictures(name, values)
    }

    /// Writes columns of equal length as `name.csv`, `name.npy` (`[row, column]`) and `name.json`. The first
    /// line of the CSV file contains the headers.
    ///
    /// # Errors
    /// [`Error::Shape`] if the columns differ in length; otherwise as [`Products::image`].
    pub fn table(
        &self,
        name: &str,
        columns: &[(&str, Vec<f64>)],
        metadata: &Map<String, Value>,
    ) -> Result<()> {
        let rows = columns.first().map_or(0, |(_, values)| values.len());
        if let Some((header, values)) = columns.iter().find(|(_, values)| values.len() != rows) {
            return Err(Error::Shape {
                what: format!("column `{header}` of table `{name}`"),
                found: vec![values.len()],
                allowed: format!("[{rows}]"),
            });
        }
        let line = |cells: Vec<String>| cells.join(",") + "\n";
        let mut csv = line(columns.iter().map(|(header, _)| (*header).to_owned()).collect());
        for row in 0..rows {
            csv.push_str(&line(columns.iter().map(|(_, values)| values[row].to_string()).collect()));
        }
        self.write(name, "csv", csv.as_bytes())?;
        let values =
            Array2::from_shape_fn((rows, columns.len()), |(row, column)| columns[column].1[row] as f32);
        self.write_array(name, &values.view(), metadata)
    }

    /// Reads back an image written by [`Products::image`].
    ///
    /// # Errors
    /// As [`Products::read_array`], and [`Error::Shape`] if it has other axes.
    pub fn read_image(&self, name: &str) -> Result<Array2<f32>> {
        let array = self.read_array(name)?;
        let found = array.shape().to_vec();
        array.into_dimensionality().map_err(|_other_axes| Error::Shape {
            what: format!("product `{name}`"),
            found,
            allowed: "[t, s]".into(),
        })
    }

    /// Reads back the array of a product, with any number of axes.
    ///
    /// # Errors
    /// [`Error::Io`] if it is missing or too large for the memory, [`Error::Codec`] if it is damaged.
    pub fn read_array(&self, name: &str) -> Result<ArrayD<f32>> {
        let path = self.path(name, "npy")?;
        let failed = || Error::io("read", &path);
        let mut file = self.open(&path)?;
        let length = usize::try_from(file.metadata().map_err(failed())?.len()).unwrap_or(usize::MAX);
        // Aligned for the view, which compares the header with the length before anything is allocated for it.
        let mut aligned: Vec<f32> = Vec::new();
        let values = length.div_ceil(size_of::<f32>());
        aligned.try_reserve_exact(values).map_err(|_full| failed()(io::ErrorKind::OutOfMemory.into()))?;
        aligned.resize(values, 0.0);
        let bytes: &mut [u8] = &mut bytemuck::cast_slice_mut(&mut aligned)[..length];
        io::Read::read_exact(&mut file, bytes).map_err(failed())?;
        let view = ArrayViewD::<f32>::view_npy(bytes).map_err(Error::codec("read", path.display()))?;
        Ok(view.to_owned())
    }

    /// Reads back image `k` of a sequence or video, `[t, s]` or `[t, s, rgb]`, and how many images there are. Only this
    /// image is read.
    ///
    /// # Errors
    /// As [`Products::read_array`], and [`Error::Shape`] if there is no such image, or it is too large.
    pub fn read_image_of(&self, name: &str, k: usize) -> Result<(ArrayD<f32>, usize)> {
        let path = self.path(name, "npy")?;
        let damaged = |what: String| Error::codec("read", path.display())(io::Error::other(what));
        let mut file = self.open(&path)?;
        let length = file.metadata().map_err(Error::io("read", &path))?.len();
        let NpyHeader { dtype, shape, data_at } =
            NpyHeader::read(&mut file).map_err(|error| damaged(io_text(&error)))?;
        let misfit = |allowed: String| Error::Shape {
            what: format!("product `{name}`"),
            found: shape.clone(),
            allowed,
        };
        let ([images, size @ ..], 3..=4) = (&shape[..], shape.len()) else {
            return Err(misfit("[k, t, s] or [k, t, s, rgb]".into()));
        };
        if k >= *images {
            return Err(misfit(format!("[k, t, s] with an image {k}, counted from 0")));
        }
        let values = size.iter().try_fold(1_usize, |values, &axis| values.checked_mul(axis));
        let Some(values) = values.filter(|values| *values <= MOST_IMAGE_VALUES) else {
            return Err(misfit(format!("images of at most {MOST_IMAGE_VALUES} values")));
        };
        let image_bytes = (values * size_of::<f32>()) as u64;
        let stated = image_bytes.checked_mul(*images as u64).and_then(|bytes| bytes.checked_add(data_at));
        if dtype != "<f4" || stated != Some(length) {
            return Err(damaged(format!(
                "{length} bytes are not {shape:?} values of type `{dtype}`; allowed: `<f4`"
            )));
        }
        let mut bytes = vec![0; values * size_of::<f32>()];
        let at = data_at + k as u64 * image_bytes;
        file.read_exact_at(&mut bytes, at).map_err(Error::io("read", &path))?;
        let (numbers, _) = bytes.as_chunks();
        let image = numbers.iter().map(|&bytes| f32::from_le_bytes(bytes)).collect();
        let image = ArrayD::from_shape_vec(size, image).map_err(|error| damaged(error.to_string()))?;
        Ok((image, *images))
    }

    /// The files of all products, by path; those of a video and the pictures of a sequence are in a
    /// folder of their own. Symbolic links are left out.
    pub fn files(&self) -> Vec<PathBuf> {
        fn below(dir: &Path, files: &mut Vec<PathBuf>) {
            for entry in std::fs::read_dir(dir).into_iter().flatten().flatten() {
                match entry.file_type() {
                    Ok(kind) if kind.is_dir() => below(&entry.path(), files),
                    Ok(kind) if kind.is_file() => files.push(entry.path()),
                    _ => {}
                }
            }
        }
        let mut files = Vec::new();
        if std::fs::symlink_metadata(&self.dir).is_ok_and(|dir| dir.is_dir()) {
            below(&self.dir, &mut files);
        }
        files.sort();
        files
    }

    /// Opens a file of the folder; neither the folder nor the file may be a symbolic link.
    fn open(&self, path: &Path) -> Result<File> {
        if std::fs::symlink_metadata(&self.dir).is_ok_and(|dir| dir.is_symlink()) {
            let why = "it is a symbolic link, and a session contains none";
            return Err(Error::io("open folder", &self.dir)(io::Error::other(why)));
        }
        input::open_itself(path, u64::MAX).map_err(Error::io("read", path))
    }

    /// Writes a product's mask; returns it as a channel.
    fn write_mask(&self, name: &str, mask: ArrayView2<u8>, size: &[usize]) -> Result<Array2<f32>> {
        if mask.shape() != size {
            let (found, allowed) = (mask.shape().to_vec(), format!("{size:?}"));
            return Err(Error::Shape { what: format!("the mask of `{name}`"), found, allowed });
        }
        self.write_npy(&format!("{name}_mask"), &mask)?;
        Ok(mask.mapv(f32::from))
    }

    fn write_array<D: Dimension>(
        &self,
        name: &str,
        values: &ArrayRef<f32, D>,
        metadata: &Map<String, Value>,
    ) -> Result<()> {
        self.write_npy(name, values)?;
        self.write(name, "json", &sidecar(name, metadata)?)
    }

    fn write_npy<T: WritableElement + Clone, D: Dimension>(
        &self,
        name: &str,
        values: &ArrayRef<T, D>,
    ) -> Result<()> {
        let path = self.path(name, "npy")?;
        durable::create_dir_within(&self.dir)?;
        durable::write_with(&path, |file| {
            // Without this, an array in Fortran order would be written in that order.
            values.as_standard_layout().write_npy(BufWriter::new(file)).map_err(io::Error::other)
        })
    }

    fn write(&self, name: &str, extension: &str, bytes: &[u8]) -> Result<()> {
        let path = self.path(name, extension)?;
        durable::create_dir_within(&self.dir)?;
        durable::write(&path, bytes)
    }

    fn path(&self, name: &str, extension: &str) -> Result<PathBuf> {
        if !Self::is_name(name) {
            return Err(Error::codec("name", format!("product `{name}`"))(
                "a name must have only letters, digits, `-` and `_`",
            ));
        }
        Ok(self.dir.join(format!("{name}.{extension}")))
    }
}

/// The EXR channels of images whose last axis has this length.
fn channels(name: &str, shape: &[usize]) -> Result<&'static [&'static str]> {
    match shape.last() {
        Some(1) => Ok(&["Y"]),
        Some(3) => Ok(&RGB),
        _ => Err(Error::Shape {
            what: format!("product `{name}`"),
            found: shape.to_vec(),
            allowed: "a last axis of one or three channels".into(),
        }),
    }
}

fn sidecar(name: &str, metadata: &Map<String, Value>) -> Result<Vec<u8>> {
    let mut text =
        serde_json::to_vec_pretty(metadata).map_err(Error::codec("encode", format!("{name}.json")))?;
    text.push(b'\n');
    Ok(text)
}

#[cfg(test)]
mod tests;
