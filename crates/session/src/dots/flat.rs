//! `flat` in `dots.zarr`: the flat field applied to a run's columns.

use std::sync::Arc;

use ndarray::Array2;
use serde_json::json;
use zarrs::array::{ElementOwned, data_type};

use super::{Dots, Put, into_map, sync_all};
use crate::durable::DraftDir;
use crate::zarr::{self, DurableStore};
use crate::{Error, Result};

/// The arrays of `flat`, both `[t, s]`.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct FlatArrays {
    /// Factor for counts above the background.
    pub gain: Array2<f32>,
    /// Pixels, hot or dead, that are replaced by their neighbours.
    pub repaired: Array2<bool>,
}

impl Dots {
    /// Writes the flat field atomically; when this returns, it is durable.
    ///
    /// # Errors
    /// [`Error::Io`] or [`Error::Zarr`] if the file system refuses.
    pub fn write_flat(&self, flat: &FlatArrays) -> Result<()> {
        let draft = DraftDir::create(&self.dir.join("flat"))?;
        let store = DurableStore::draft(draft.path())?;
        let about = "gain: of counts above the background; repaired: hot or dead pixels, which have the mean of their neighbours";
        zarr::create_group(&store, into_map(json!({ "about": about })))?;
        let put = Put { store: &store };
        let axes = |(rows, columns)| [("t", rows), ("s", columns)];
        let gain = flat.gain.iter().copied().collect::<Vec<f32>>();
        put.array("gain", &axes(flat.gain.dim()), data_type::float32(), 0f32.into(), &gain)?;
        let repaired = flat.repaired.iter().copied().collect::<Vec<bool>>();
        put.array("repaired", &axes(flat.repaired.dim()), data_type::bool(), false.into(), &repaired)?;
        sync_all(draft.path())?;
        draft.commit()
    }

    /// Whether there is a flat field.
    pub fn has_flat(&self) -> bool {
        self.dir.join("flat").is_dir()
    }

    /// Reads the flat field of a camera of `size` (rows, columns).
    ///
    /// # Errors
    /// [`Error::Io`] if it is missing, [`Error::Shape`] if its size differs, [`Error::Zarr`] if it is
    /// damaged.
    pub fn read_flat(&self, size: [usize; 2]) -> Result<FlatArrays> {
        let path = self.dir.join("flat");
        if !self.has_flat() {
            let why = "the session has no flat field: give a session whose plan has batches.flat_frames";
            let missing = std::io::Error::new(std::io::ErrorKind::NotFound, why);
            return Err(Error::io("read", &path)(missing));
        }
        let store = DurableStore::new(&path)?;
        fn read<T: ElementOwned>(
            store: &Arc<DurableStore>,
            name: &str,
            size: [usize; 2],
        ) -> Result<Array2<T>> {
            let array = zarr::open_array(store, name, 2)?;
            let (found, path) = (zarr::shape_of(&array), store.root().join(name));
            if found != size {
                let what = format!("the flat field {}", path.display());
                let allowed = format!("{size:?}, the camera's rows and columns");
                return Err(Error::Shape { what, found, allowed });
            }
            array
                .retrieve_array_subset_opt(&array.subset_all(), &zarr::codec_options())
                .map_err(Error::zarr("read", &path))
        }
        Ok(FlatArrays { gain: read(&store, "gain", size)?, repaired: read(&store, "repaired", size)? })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stack::{Contents, StackShape};

    #[test]
    fn a_flat_field_reads_back_and_says_where_there_is_none_or_another() {
        let dir = tempfile::tempdir().unwrap();
        let shape = StackShape { contents: Contents::Batches { batches: 4, dots: 3 }, rows: 2, columns: 32 };
        let dots = Dots::create(dir.path(), &shape).unwrap();
        assert!(!dots.has_flat());
        assert!(matches!(dots.read_flat([2, 32]), Err(Error::Io { .. })));
        let gain = Array2::from_shape_fn((2, 32), |(t, s)| 1.0 + t as f32 / 2.0 + s as f32 / 128.0);
        let flat = FlatArrays { repaired: gain.mapv(|gain| gain > 1.6), gain };
        dots.write_flat(&flat).unwrap();
        assert_eq!(dots.read_flat([2, 32]).unwrap(), flat);
        let error = dots.read_flat([4, 32]).unwrap_err();
        assert!(matches!(&error, Error::Shape { found, .. } if found == &[2, 32]), "{error}");
    }
}
