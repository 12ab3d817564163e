//! Videos: images of one size, written one after the other.

use std::io;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use ndarray::{Array2, ArrayView2, ArrayView3, Axis, IxDyn};
use ndarray_npy::{WritableElement, write_zeroed_npy};
use serde_json::{Map, Value};

use super::{Products, sidecar};
use crate::durable::{self, DraftDir, DraftFile};
use crate::report::{Picture, ToneMap};
use crate::{Error, Result, exr_file};

/// White level: this percentile of the first image's pixels, times some headroom for the other images.
const PERCENTILE: f64 = 99.5;
const HEADROOM: f32 = 1.25;

/// Writes a video `NAME`: `NAME.npy` (float32 `[k, t, s]`, or `[k, t, s, 3]`), a folder `NAME` with
/// `0000.exr` (linear), `0000.png` (all with one tone map, sRGB transfer function) and so on, and
/// `NAME.json`; if its images have masks, `NAME_mask.npy` (uint8 `[k, t, s]`). Nothing is visible before [`VideoWriter::commit`], and nothing is kept without it.
pub struct VideoWriter {
    npy: DraftFile,
    /// The masks and the length of their file's header, once there is one.
    masks: Option<(DraftFile, u64)>,
    masks_path: PathBuf,
    frames: DraftDir,
    sidecar: PathBuf,
    name: String,
    metadata: Map<String, Value>,
    /// Shape, `[images, rows, columns, channels]`.
    shape: [usize; 4],
    header_bytes: u64,
    next: usize,
    tone_map: Option<ToneMap>,
}

impl Products {
    /// Begins a video of `images` images of size `[t, s, channels]`, with one or three channels.
    ///
    /// # Errors
    /// [`Error::Shape`] for another number of channels or no images; otherwise as [`Products::image`].
    pub fn video(
        &self,
        name: &str,
        images: usize,
        size: [usize; 3],
        metadata: &Map<String, Value>,
    ) -> Result<VideoWriter> {
        let [rows, columns, channels] = size;
        if ![1, 3].contains(&channels) || images * rows * columns == 0 {
            return Err(Error::Shape {
                what: format!("video `{name}`"),
                found: vec![images, rows, columns, channels],
                allowed: "[k, t, s, 1] or [k, t, s, 3], none empty".into(),
            });
        }
        let (path, sidecar) = (self.path(name, "npy")?, self.path(name, "json")?);
        durable::create_dir_within(self.dir())?;
        let axes = [images, rows, columns, channels];
        let (npy, header_bytes) = begun_npy::<f32>(&path, if channels == 1 { &axes[..3] } else { &axes })?;
        Ok(VideoWriter {
            npy,
            masks: None,
            masks_path: self.path(&format!("{name}_mask"), "npy")?,
            frames: DraftDir::create(&self.dir().join(name))?,
            sidecar,
            name: name.to_owned(),
            metadata: metadata.clone(),
            shape: [images, rows, columns, channels],
            header_bytes,
            next: 0,
            tone_map: None,
        })
    }
}

impl VideoWriter {
    /// Writes the next image; returns its picture's tone map.
    ///
    /// # Errors
    /// [`Error::Shape`] for an image of another size, or too many; [`Error::Io`].
    pub fn append(&mut self, image: ArrayView3<f32>) -> Result<ToneMap> {
        self.append_with(image, None)
    }

    /// Writes the next image of a video that has masks, with its mask `[t, s]`: its EXR file has the channel `mask`.
    ///
    /// # Errors
    /// As [`Self::append`].
    pub fn append_masked(&mut self, image: ArrayView3<f32>, mask: ArrayView2<u8>) -> Result<ToneMap> {
        let [images, rows, columns, _] = self.shape;
        if mask.dim() != (rows, columns) || self.next == images {
            let (what, found) = (format!("a mask of video `{}`", self.name), mask.shape().to_vec());
            return Err(Error::Shape { what, found, allowed: format!("{images} of {:?}", [rows, columns]) });
        }
        let (file, header_bytes) = match self.masks.take() {
            Some(masks) => masks,
            None => begun_npy::<u8>(&self.masks_path, &[images, rows, columns])?,
        };
        let bytes: Vec<u8> = mask.iter().copied().collect();
        let at = header_bytes + (self.next * bytes.len()) as u64;
        file.file().write_all_at(&bytes, at).map_err(file.failed())?;
        self.masks = Some((file, header_bytes));
        self.append_with(image, Some(mask.mapv(f32::from)))
    }

    fn append_with(&mut self, image: ArrayView3<f32>, mask: Option<Array2<f32>>) -> Result<ToneMap> {
        let [images, rows, columns, channels] = self.shape;
        if image.dim() != (rows, columns, channels) || self.next == images {
            let mut found = vec![self.next];
            found.extend(image.shape());
            let what = format!("an image of video `{}`", self.name);
            return Err(Error::Shape { what, found, allowed: format!("{:?}", self.shape) });
        }
        let bytes: Vec<u8> = image.iter().flat_map(|value| value.to_le_bytes()).collect();
        let at = self.header_bytes + (self.next * bytes.len()) as u64;
        self.npy.file().write_all_at(&bytes, at).map_err(self.npy.failed())?;
        let planes: Vec<_> = image.axis_iter(Axis(2)).collect();
        let tone_map = *self.tone_map.get_or_insert_with(|| video_tone_map(&planes));
        let names: &[&str] = if channels == 1 { &["Y"] } else { &["R", "G", "B"] };
        let mut exr: Vec<_> = names.iter().copied().zip(planes.iter().map(|plane| plane.view())).collect();
        exr.extend(mask.as_ref().map(|mask| ("mask", mask.view())));
        let picture = match channels {
            1 => Picture::grey(planes[0], tone_map),
            _ => Picture::rgb(image, tone_map),
        };
        let path = |extension: &str| self.frames.path().join(format!("{:04}.{extension}", self.next));
        durable::write(&path("exr"), &exr_file::encode(&exr, &self.metadata)?)?;
        durable::write(&path("png"), &picture.to_png()?)?;
        self.next += 1;
        Ok(tone_map)
    }

    /// Moves the video to its final place.
    ///
    /// # Errors
    /// [`Error::Shape`] if images are missing; [`Error::Io`].
    pub fn commit(self) -> Result<()> {
        let [images, ..] = self.shape;
        if self.next < images {
            let what = format!("video `{}`", self.name);
            return Err(Error::Shape { what, found: vec![self.next], allowed: format!("[{images}]") });
        }
        self.npy.commit()?;
        self.masks.map_or(Ok(()), |(masks, _)| masks.commit())?;
        self.frames.commit()?;
        let mut metadata = self.metadata;
        metadata.insert("png_white".into(), self.tone_map.map_or(Value::Null, |map| map.white.into()));
        durable::write(&self.sidecar, &sidecar(&self.name, &metadata)?)
    }
}

/// An NPY file of zeros that is not in place yet, and the length of its header.
fn begun_npy<T: WritableElement>(path: &Path, axes: &[usize]) -> Result<(DraftFile, u64)> {
    let npy = DraftFile::create(path)?;
    write_zeroed_npy::<T, _>(npy.file(), IxDyn(axes)).map_err(io::Error::other).map_err(npy.failed())?;
    let file_bytes = npy.file().metadata().map_err(npy.failed())?.len();
    let data_bytes = axes.iter().product::<usize>() * size_of::<T>();
    Ok((npy, file_bytes - data_bytes as u64))
}

/// The tone map of a video whose first image has these planes.
pub fn video_tone_map(planes: &[ArrayView2<f32>]) -> ToneMap {
    let ToneMap { white } = ToneMap::percentile(planes, PERCENTILE);
    ToneMap { white: white * HEADROOM }
}

#[cfg(test)]
mod tests {
    use ndarray::{Array3, Array4};

    use super::*;

    fn image(channels: usize, seed: f32) -> Array3<f32> {
        Array3::from_shape_fn((4, 6, channels), |(t, s, c)| seed + (t * 18 + s * 3 + c) as f32)
    }

    #[test]
    fn a_video_is_there_when_it_is_whole_as_npy_exr_and_png() {
        let dir = tempfile::tempdir().unwrap();
        let products = Products::new(dir.path());
        let mut video = products.video("relit", 2, [4, 6, 3], &Map::new()).unwrap();
        video.append(image(3, 1.0).view()).unwrap();
        assert!(video.append(image(1, 0.0).view()).is_err());
        assert!(!dir.path().join("relit.npy").exists());
        video.append(image(3, 9.0).view()).unwrap();
        assert!(video.append(image(3, 9.0).view()).is_err(), "there are two");
        video.commit().unwrap();
        let read: Array4<f32> = ndarray_npy::read_npy(dir.path().join("relit.npy")).unwrap();
        assert_eq!(read.index_axis(Axis(0), 1), image(3, 9.0));
        for name in ["relit/0000.exr", "relit/0001.png", "relit.json"] {
            assert!(dir.path().join(name).exists(), "{name}");
        }
        let decoder = png::Decoder::new(io::BufReader::new(
            std::fs::File::open(dir.path().join("relit/0001.png")).unwrap(),
        ));
        assert_eq!(decoder.read_info().unwrap().info().size(), (6, 4));
    }

    #[test]
    fn a_video_that_is_not_finished_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let products = Products::new(dir.path());
        let mut video = products.video("grey", 2, [4, 6, 1], &Map::new()).unwrap();
        video.append(image(1, 1.0).view()).unwrap();
        assert!(video.commit().is_err());
        assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0);
        assert!(products.video("grey", 2, [4, 6, 2], &Map::new()).is_err());
    }
}
