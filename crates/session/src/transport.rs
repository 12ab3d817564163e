//! `transport.zarr`: the light transport of a plane rig, a Zarr v3 group with the array `transport`.
//!
//! float32 `[u, t, s]`: u = v - t is the projector row relative to the camera row t, s the camera column; the first
//! plane is u = `u_min` of the array's attributes. Values are in the scene's units (1 is a white Lambertian at the
//! reference distance). Rows that do not exist on the projector are 0. Chunks hold all of u for 64 x 64 pixels.

use std::path::Path;

use ndarray::{Array3, ArrayView3, s};
use rayon::prelude::*;
use serde_json::{Map, Value};
use zarrs::array::{ArrayBuilder, data_type};

use crate::zarr::{self, CHUNK_PX, DurableStore};
use crate::{Error, Result, durable};

const NAME: &str = "transport";

/// Writes `transport [u, t, s]` to the group at `dir`, replacing the one that is there in one step. `attributes`
/// become the array's: `u_min`, `u_max`, `row_time_us`, the prior and whatever made it.
///
/// # Errors
/// [`Error::Shape`] for an axis of length 0; [`Error::Zarr`] or [`Error::Io`] where the file system refuses, and then
/// the group is as before.
pub fn write(dir: &Path, transport: ArrayView3<f32>, attributes: &Map<String, Value>) -> Result<()> {
    let (depth, rows, columns) = transport.dim();
    if transport.is_empty() {
        let found = transport.shape().to_vec();
        return Err(Error::Shape {
            what: "the transport [u, t, s]".into(),
            found,
            allowed: "no empty axis".into(),
        });
    }
    let chunk = [depth, rows.min(CHUNK_PX), columns.min(CHUNK_PX)];
    let to_u64 = |axes: [usize; 3]| axes.map(|len| len as u64).to_vec();
    let mut builder =
        ArrayBuilder::new(to_u64([depth, rows, columns]), to_u64(chunk), data_type::float32(), 0.0f32);
    zarr::with_codecs(&mut builder).dimension_names(Some(["u", "t", "s"])).attributes(attributes.clone());

    durable::replace_dir(dir, |fresh| {
        let store = DurableStore::new(fresh)?;
        zarr::create_group(&store, Map::new())?;
        let array = zarr::create_array(&store, NAME, &builder)?;
        let chunks_across = columns.div_ceil(chunk[2]);
        // While one chunk waits for the disk, others are compressed.
        (0..rows.div_ceil(chunk[1]) * chunks_across).into_par_iter().try_for_each(|index| {
            let (chunk_row, chunk_column) = (index / chunks_across, index % chunks_across);
            let (t, s) = (chunk_row * chunk[1], chunk_column * chunk[2]);
            let part = transport.slice(s![.., t..rows.min(t + chunk[1]), s..columns.min(s + chunk[2])]);
            zarr::write_chunk(&array, [0, chunk_row as u64, chunk_column as u64], chunk, part)
        })
    })
}

/// Reads `transport [u, t, s]` and its attributes.
///
/// # Errors
/// [`Error::Zarr`] or [`Error::Shape`] where there is none or it is damaged.
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
