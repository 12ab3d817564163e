//! `transport.zarr`: the light transport of a plane rig, a Zarr v3 group with the array `transport`.
//!
//! float32 `[u, t, s]`: u = v - t is the projector row relative to the camera row t, s the camera column. The
//! first plane is u = `u_min` of the array's attributes. Values are in the scene's units (1 is a white
//! Lambertian surface at the reference distance). Rows that the projector does not have are 0. Chunks contain
//! all of u for 64 x 64 pixels. The array `mask`, uint8 of the same shape, tells what is known of each value; its
//! attribute `bits` names the bits.

use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use ndarray::{Array1, Array3, ArrayView3, Axis, s};
use rayon::prelude::*;
use serde_json::{Map, Value};
use zarrs::array::{Array, ArrayBuilder, Element, data_type};

use crate::durable::DraftDir;
use crate::zarr::{self, CHUNK_PX, DurableStore};
use crate::{Error, Result};

const NAME: &str = "transport";
const MASK: &str = "mask";

/// Writes `transport [u, t, s]` to the group at `dir`, replacing any existing one atomically. `attributes`
/// become those of the array: `u_min`, `u_max`, `row_time_us`, the prior and how it was computed.
///
/// # Errors
/// [`Error::Shape`] for an axis of length 0; [`Error::Zarr`] or [`Error::Io`] if the file system refuses; the
/// group is then unchanged.
pub fn write(dir: &Path, transport: ArrayView3<f32>, attributes: &Map<String, Value>) -> Result<()> {
    let mut writer = Writer::create(dir, transport.dim(), attributes)?;
    writer.append(transport)?;
    writer.commit()
}

/// Writes a transport in strips of camera rows, from top to bottom: a replacement for [`write()`] if it does
/// not fit in memory. Nothing is visible before [`Writer::commit`], and nothing is kept without it.
pub struct Writer {
    draft: DraftDir,
    store: Arc<DurableStore>,
    array: Array<DurableStore>,
    /// The mask and its next row, once it has been begun.
    mask: Option<(Array<DurableStore>, usize)>,
    /// Shape, `[u, t, s]`.
    shape: (usize, usize, usize),
    next_row: usize,
}

impl Writer {
    /// Begins a transport of shape `[u, t, s]`, with the attributes of [`write()`].
    ///
    /// # Errors
    /// As [`write()`].
    pub fn create(
        dir: &Path,
        shape: (usize, usize, usize),
        attributes: &Map<String, Value>,
    ) -> Result<Writer> {
        let (depth, rows, columns) = shape;
        if depth * rows * columns == 0 {
            return Err(Error::Shape {
                what: "the transport [u, t, s]".into(),
                found: vec![depth, rows, columns],
                allowed: "no empty axis".into(),
            });
        }
        let to_u64 = |axes: [usize; 3]| axes.map(|len| len as u64).to_vec();
        let mut builder = ArrayBuilder::new(
            to_u64([depth, rows, columns]),
            to_u64(chunk_of(shape)),
            data_type::float32(),
            0.0f32,
        );
        zarr::with_codecs(&mut builder).dimension_names(Some(["u", "t", "s"])).attributes(attributes.clone());
        let draft = DraftDir::create(dir)?;
        let store = DurableStore::new(draft.path())?;
        zarr::create_group(&store, Map::new())?;
        let array = zarr::create_array(&store, NAME, &builder)?;
        Ok(Writer { draft, store, array, mask: None, shape, next_row: 0 })
    }

    /// Writes the next camera rows, durably: a multiple of [`STRIP_ROWS`](crate::STRIP_ROWS), or all
    /// remaining ones.
    ///
    /// # Errors
    /// [`Error::Shape`] for other rows; [`Error::Zarr`] if the file system refuses.
    pub fn append(&mut self, strip: ArrayView3<f32>) -> Result<()> {
        self.next_row = append_to(&self.array, self.shape, self.next_row, strip)?;
        Ok(())
    }

    /// Writes the next camera rows of the mask, durably, in strips like those of [`Writer::append`]. `bits` names the
    /// bits. A transport without a mask has none of its rows.
    ///
    /// # Errors
    /// As [`Writer::append`].
    pub fn append_mask(&mut self, strip: ArrayView3<u8>, bits: &Value) -> Result<()> {
        let (array, next_row) = match self.mask.take() {
            Some(begun) => begun,
            None => {
                let to_u64 = |axes: [usize; 3]| axes.map(|len| len as u64).to_vec();
                let (depth, rows, columns) = self.shape;
                let (shape, chunk) = (to_u64([depth, rows, columns]), to_u64(chunk_of(self.shape)));
                let mut builder = ArrayBuilder::new(shape, chunk, data_type::uint8(), 0u8);
                let attributes = Map::from_iter([("bits".to_owned(), bits.clone())]);
                zarr::with_codecs(&mut builder).dimension_names(Some(["u", "t", "s"])).attributes(attributes);
                (zarr::create_array(&self.store, MASK, &builder)?, 0)
            }
        };
        let next_row = append_to(&array, self.shape, next_row, strip)?;
        self.mask = Some((array, next_row));
        Ok(())
    }

    /// Moves the transport to its final place.
    ///
    /// # Errors
    /// [`Error::Shape`] if rows are missing; [`Error::Io`] if the file system refuses.
    pub fn commit(self) -> Result<()> {
        let (depth, rows, columns) = self.shape;
        let written = self.mask.map_or(self.next_row, |(_, next_row)| next_row.min(self.next_row));
        if written < rows {
            return Err(Error::Shape {
                what: "the transport that is to be put in place".into(),
                found: vec![depth, written, columns],
                allowed: format!("{:?}", [depth, rows, columns]),
            });
        }
        self.draft.commit()
    }
}

/// Writes the next rows of an array; returns the row after them.
fn append_to<T: Element + Clone + Default + Sync>(
    array: &Array<DurableStore>,
    shape: (usize, usize, usize),
    first_row: usize,
    strip: ArrayView3<T>,
) -> Result<usize> {
    let (depth, all_rows, columns) = shape;
    let rows = strip.len_of(Axis(1));
    let chunk = chunk_of(shape);
    let end = first_row + rows;
    let whole_chunks = end == all_rows || (end < all_rows && rows.is_multiple_of(chunk[1]));
    if rows == 0 || !whole_chunks || strip.dim() != (depth, rows, columns) {
        return Err(Error::Shape {
            what: format!("a strip of the transport from row {first_row} on"),
            found: strip.shape().to_vec(),
            allowed: format!(
                "[{depth}, a multiple of {} or the last {}, {columns}]",
                chunk[1],
                all_rows - first_row
            ),
        });
    }
    let chunks_across = columns.div_ceil(chunk[2]);
    // While one chunk waits for the disk, others are compressed.
    (0..rows.div_ceil(chunk[1]) * chunks_across).into_par_iter().try_for_each(|index| {
        let (chunk_row, chunk_column) = (index / chunks_across, index % chunks_across);
        let (t, s) = (chunk_row * chunk[1], chunk_column * chunk[2]);
        let part = strip.slice(s![.., t..rows.min(t + chunk[1]), s..columns.min(s + chunk[2])]);
        let chunk_row = first_row / chunk[1] + chunk_row;
        zarr::write_chunk(array, [0, chunk_row as u64, chunk_column as u64], chunk, part)
    })?;
    Ok(end)
}

fn chunk_of((depth, rows, columns): (usize, usize, usize)) -> [usize; 3] {
    [depth, rows.min(CHUNK_PX), columns.min(CHUNK_PX)]
}

/// Reads only the profiles over u of some pixels `[t, s]`.
///
/// # Errors
/// [`Error::Shape`] for pixels outside the image; otherwise as [`read`].
pub fn read_profiles(dir: &Path, pixels: &[[usize; 2]]) -> Result<Vec<Array1<f32>>> {
    let array = zarr::open_array(&DurableStore::new(dir)?, NAME, 3)?;
    let depth = array.shape()[0] as usize;
    let profile = |&[t, s]: &[usize; 2]| {
        zarr::read_part(&array, [0..depth, t..t.saturating_add(1), s..s.saturating_add(1)])
            .map(|part| part.into_flat())
    };
    pixels.iter().map(profile).collect()
}

/// Shape `[u, t, s]` and attributes of the transport, without its values.
///
/// # Errors
/// [`Error::Zarr`] or [`Error::Shape`] if it is missing or damaged.
pub fn describe(dir: &Path) -> Result<([usize; 3], Map<String, Value>)> {
    let array = zarr::open_array(&DurableStore::new(dir)?, NAME, 3)?;
    let length = |axis: usize| array.shape().get(axis).map_or(0, |length| *length as usize);
    Ok(([0, 1, 2].map(length), array.attributes().clone()))
}

/// Reads some camera rows of the transport: `[u, t, s]`.
///
/// # Errors
/// [`Error::Shape`] for rows outside the image; otherwise as [`read`].
pub fn read_rows(dir: &Path, rows: Range<usize>) -> Result<Array3<f32>> {
    let array = zarr::open_array(&DurableStore::new(dir)?, NAME, 3)?;
    let length = |axis: usize| array.shape()[axis] as usize;
    zarr::read_part(&array, [0..length(0), rows, 0..length(2)])
}

/// Reads what is known of some camera rows of the transport, `[u, t, s]`; `None` if it was written without.
///
/// # Errors
/// As [`read_rows`].
pub fn read_mask_rows(dir: &Path, rows: Range<usize>) -> Result<Option<Array3<u8>>> {
    if !dir.join(MASK).is_dir() {
        return Ok(None);
    }
    let array = zarr::open_array(&DurableStore::new(dir)?, MASK, 3)?;
    let length = |axis: usize| array.shape()[axis] as usize;
    zarr::read_part(&array, [0..length(0), rows, 0..length(2)]).map(Some)
}

/// Reads `transport [u, t, s]` and its attributes.
///
/// # Errors
/// [`Error::Zarr`] or [`Error::Shape`] if it is missing or damaged.
pub fn read(dir: &Path) -> Result<(Array3<f32>, Map<String, Value>)> {
    let array = zarr::open_array(&DurableStore::new(dir)?, NAME, 3)?;
    Ok((zarr::read_all(&array)?, array.attributes().clone()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    fn attributes(u_min: i32) -> Map<String, Value> {
        Map::from_iter([("u_min".to_owned(), u_min.into()), ("prior".to_owned(), "split".into())])
    }

    fn volume(shape: (usize, usize, usize)) -> Array3<f32> {
        Array3::from_shape_fn(shape, |(u, t, s)| (u * 10_000 + t * 100 + s) as f32 / 7.0)
    }

    #[test]
    fn a_volume_reads_back_at_sizes_that_are_no_multiple_of_a_chunk() {
        let dir = tempfile::tempdir().unwrap();
        for shape in [(1, 1, 1), (5, 3, 2), (3, 64, 64), (7, 65, 130)] {
            let path = dir.path().join(format!("{shape:?}.zarr"));
            write(&path, volume(shape).view(), &attributes(-3)).unwrap();
            let (back, back_attributes) = read(&path).unwrap();
            assert_eq!(back, volume(shape));
            assert_eq!(back_attributes, attributes(-3));
        }
    }

    #[test]
    fn an_axis_order_in_memory_does_not_matter() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("transport.zarr");
        let stored = volume((4, 5, 6));
        let turned = stored.clone().reversed_axes();
        write(&path, turned.view().reversed_axes(), &attributes(0)).unwrap();
        assert_eq!(read(&path).unwrap().0, stored);
    }

    #[test]
    fn a_second_write_replaces_all_of_the_first() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("transport.zarr");
        write(&path, volume((2, 130, 130)).view(), &attributes(-1)).unwrap();
        write(&path, volume((3, 4, 5)).view(), &attributes(-2)).unwrap();
        assert_eq!(read(&path).unwrap(), (volume((3, 4, 5)), attributes(-2)));
        assert!(!path.join("transport/c.0.2.2").exists());
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    /// All files below a folder, with their content.
    fn files(dir: &Path) -> Vec<(String, Vec<u8>)> {
        let mut files: Vec<_> = ["zarr.json", "transport/zarr.json"].map(str::to_owned).into();
        let chunks = fs::read_dir(dir.join("transport")).unwrap();
        files.extend(
            chunks.map(|entry| format!("transport/{}", entry.unwrap().file_name().to_str().unwrap())),
        );
        files.sort();
        files
            .into_iter()
            .map(|name| {
                let bytes = fs::read(dir.join(&name)).unwrap();
                (name, bytes)
            })
            .collect()
    }

    #[test]
    fn strips_give_the_files_of_the_whole_and_profiles_are_its_columns() {
        let dir = tempfile::tempdir().unwrap();
        for (shape, strips) in
            [((3, 130, 70), vec![64, 64, 2]), ((3, 200, 64), vec![128, 72]), ((2, 5, 7), vec![5])]
        {
            let (whole, in_strips) = (dir.path().join("whole.zarr"), dir.path().join("strips.zarr"));
            let volume = volume(shape);
            write(&whole, volume.view(), &attributes(-3)).unwrap();
            let mut writer = Writer::create(&in_strips, shape, &attributes(-3)).unwrap();
            let mut first = 0;
            for rows in strips {
                writer.append(volume.slice(s![.., first..first + rows, ..])).unwrap();
                first += rows;
                assert!(!in_strips.exists(), "nothing is seen before the end");
            }
            writer.commit().unwrap();
            assert!(files(&in_strips) == files(&whole), "{shape:?}");
            let pixels = [[0, 0], [shape.1 - 1, shape.2 - 1], [shape.1 / 2, 3]];
            for ([t, s], profile) in pixels.into_iter().zip(read_profiles(&in_strips, &pixels).unwrap()) {
                assert_eq!(profile, volume.slice(s![.., t, s]));
            }
            for outside in [[shape.1, 0], [usize::MAX, 0], [0, usize::MAX]] {
                let outside = read_profiles(&in_strips, &[outside]);
                assert!(matches!(outside, Err(Error::Shape { .. })));
            }
            fs::remove_dir_all(&in_strips).unwrap();
        }
    }

    #[test]
    fn what_is_not_whole_is_not_put_in_place_and_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("transport.zarr");
        let volume = volume((2, 130, 5));
        write(&path, volume.view(), &attributes(7)).unwrap();
        let mut writer = Writer::create(&path, (2, 130, 5), &attributes(0)).unwrap();
        for rows in [0..0, 0..63, 0..131, 0..65] {
            let columns = if rows.end > 130 { 0..0 } else { 0..5 };
            let strip = volume.slice(s![.., rows.start..rows.end.min(130), columns]);
            assert!(matches!(writer.append(strip), Err(Error::Shape { .. })), "{rows:?}");
        }
        writer.append(volume.slice(s![.., ..64, ..])).unwrap();
        assert!(matches!(writer.commit(), Err(Error::Shape { .. })));
        assert_eq!(read(&path).unwrap(), (volume, attributes(7)));
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);
    }

    #[test]
    fn an_empty_or_missing_or_damaged_volume_is_an_error() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("transport.zarr");
        assert!(matches!(write(&path, volume((0, 4, 5)).view(), &attributes(0)), Err(Error::Shape { .. })));
        assert!(read(&path).is_err());
        write(&path, volume((2, 4, 5)).view(), &attributes(0)).unwrap();
        fs::write(path.join("transport/c.0.0.0"), "garbage").unwrap();
        assert!(matches!(read(&path), Err(Error::Zarr { .. })));
        fs::write(path.join("transport/zarr.json"), "{}").unwrap();
        assert!(matches!(read(&path), Err(Error::Zarr { .. })));
    }
}
