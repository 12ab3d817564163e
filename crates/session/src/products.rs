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
use std::path::{Path, PathBuf};

use ndarray::{Array2, ArrayD, ArrayRef, ArrayView2, ArrayView3, ArrayViewD, Axis, Dimension};
use ndarray_npy::{ViewNpyExt, WritableElement, WriteNpyExt};
use serde_json::{Map, Value};

pub use self::video::{VideoWriter, video_tone_map};
pub use self::volume::VolumeWriter;
use crate::{Error, Result, durable, exr_file, input};

mod video;
mod volume;

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

    /// [`Products::image`] with a mask `[t, s]`, which is the EXR file's channel `mask` and `name_mask.npy` (uint8);
    /// `metadata` should name its bits.
    ///
    /// # Errors
    /// [`Error::Shape`] if the mask is not as large as the image; otherwise as [`Products::image`].
    pub fn masked_image(
        &self,
        name: &str,
        values: ArrayView2<f32>,
        mask: ArrayView2<u8>,
        metadata: &Map<String, Value>,
    ) -> Result<()> {
        let shown = self.write_mask(name, mask, values.shape())?;
        let channels = [("Y", values), ("mask", shown.view())];
        self.write(name, "exr", &exr_file::encode(&channels, metadata)?)?;
        self.write_array(name, &values, metadata)
    }

    /// Writes a colour image `[t, s, 3]` (R, G, B) as `name.exr`, `name.npy` and `name.json`.
    ///
    /// # Errors
    /// [`Error::Shape`] if the last axis is not 3; otherwise as [`Products::image`].
    pub fn rgb(&self, name: &str, values: ArrayView3<f32>, metadata: &Map<String, Value>) -> Result<()> {
        let channels: Vec<_> = ["R", "G", "B"].into_iter().zip(values.axis_iter(Axis(2))).collect();
        if values.shape()[2] != 3 {
            let found = values.shape().to_vec();
            return Err(Error::Shape { what: format!("image `{name}`"), found, allowed: "[t, s, 3]".into() });
        }
        self.write(name, "exr", &exr_file::encode(&channels, metadata)?)?;
        self.write_array(name, &values, metadata)
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
        self.layers(name, values, layers, None, metadata)
    }

    fn layers(
        &self,
        name: &str,
        values: ArrayView3<f32>,
        layers: &[String],
        mask: Option<ArrayView2<f32>>,
        metadata: &Map<String, Value>,
    ) -> Result<()> {
        if values.shape()[0] != layers.len() {
            let (found, allowed) = (values.shape().to_vec(), format!("[{}, t, s]", layers.len()));
            return Err(Error::Shape { what: format!("sequence `{name}`"), found, allowed });
        }
        let names: Vec<String> = layers.iter().map(|layer| format!("{layer}.Y")).collect();
        let mut channels: Vec<_> = names.iter().map(String::as_str).zip(values.outer_iter()).collect();
        channels.extend(mask.map(|mask| ("mask", mask)));
        self.write(name, "exr", &exr_file::encode(&channels, metadata)?)?;
        self.write_array(name, &values, metadata)
    }

    /// [`Products::sequence`] with one mask for all images, as in [`Products::masked_image`].
    ///
    /// # Errors
    /// As [`Products::sequence`] and [`Products::masked_image`].
    pub fn masked_sequence(
        &self,
        name: &str,
        values: ArrayView3<f32>,
        layers: &[String],
        mask: ArrayView2<u8>,
        metadata: &Map<String, Value>,
    ) -> Result<()> {
        let shown = self.write_mask(name, mask, &values.shape()[1..])?;
        self.layers(name, values, layers, Some(shown.view()), metadata)
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
        self.with_array(name, |array| Ok(array.to_owned()))
    }

    /// Reads back image `k` of a sequence or video, `[t, s]` or `[t, s, rgb]`, and how many images there are.
    ///
    /// # Errors
    /// As [`Products::read_array`], and [`Error::Shape`] if there is no such image.
    pub fn read_image_of(&self, name: &str, k: usize) -> Result<(ArrayD<f32>, usize)> {
        self.with_array(name, |array| match array.shape() {
            [images, _, _, ..] if k < *images => Ok((array.index_axis(Axis(0), k).to_owned(), *images)),
            shape => Err(Error::Shape {
                what: format!("product `{name}`, of which image {k} is wanted, counted from 0"),
                found: shape.to_vec(),
                allowed: format!("[{} or more, t, s] or [.., t, s, rgb]", k.saturating_add(1)),
            }),
        })
    }

    fn with_array<T>(&self, name: &str, read: impl FnOnce(ArrayViewD<'_, f32>) -> Result<T>) -> Result<T> {
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
        read(ArrayViewD::<f32>::view_npy(bytes).map_err(Error::codec("read", path.display()))?)
    }

    /// The files of all products, by path; those of a video are in a folder of their own. Symbolic links are left out.
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
        let plain = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_');
        if name.is_empty() || !name.chars().all(plain) {
            return Err(Error::codec("write", format!("product `{name}`"))(
                "a name must have only letters, digits, `-` and `_`",
            ));
        }
        Ok(self.dir.join(format!("{name}.{extension}")))
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
