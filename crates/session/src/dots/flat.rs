//! `flat` in `dots.zarr`: the flat field applied to a run's columns.

use std::path::Path;
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
    /// As [`FlatArrays::read`].
    pub fn read_flat(&self, size: [usize; 2]) -> Result<FlatArrays> {
        FlatArrays::read(&self.dir, size)
    }
}

impl FlatArrays {
    /// Reads the flat field of a camera of `size` (rows, columns) from the `dots.zarr` of any session. Nothing is
    /// unpacked before it is known to have this size.
    ///
    /// # Errors
    /// [`Error::Io`] if it is missing, [`Error::Shape`] if its size differs, [`Error::Zarr`] or [`Error::Codec`] if it
    /// is damaged.
    pub fn read(dots: &Path, size: [usize; 2]) -> Result<FlatArrays> {
        let path = dots.join("flat");
        if !path.is_dir() {
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
            let path = store.root().join(name);
            zarr::check_metadata_file(&path)?;
            let array = zarr::open_array(store, name, 2)?;
            let found = zarr::shape_of(&array);
            if found != size {
                let what = format!("the flat field {}", path.display());
                let allowed = format!("{size:?}, the camera's rows and columns");
                return Err(Error::Shape { what, found, allowed });
            }
            zarr::check_only_chunk(&array, size_of::<T>())?;
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

    #[test]
    fn a_chunk_that_does_not_say_truly_how_long_it_becomes_is_not_unpacked() {
        let dir = tempfile::tempdir().unwrap();
        let shape = StackShape { contents: Contents::Batches { batches: 4, dots: 3 }, rows: 2, columns: 32 };
        let dots = Dots::create(dir.path(), &shape).unwrap();
        let (gain, repaired) = (Array2::ones((2, 32)), Array2::from_elem((2, 32), false));
        dots.write_flat(&FlatArrays { gain, repaired }).unwrap();
        let chunk = dir.path().join("flat/gain/c.0.0");
        let sound = std::fs::read(&chunk).unwrap();
        let packed = |bytes: usize| zstd::bulk::compress(&vec![0; bytes], 1).unwrap();
        // A frame whose header alone claims 2^60 bytes, and one that does not say (RFC 8878).
        let claims = [&[0x28, 0xb5, 0x2f, 0xfd, 0xe0][..], &(1u64 << 60).to_le_bytes()].concat();
        let silent = zstd::stream::encode_all(&vec![0u8; 64 << 20][..], 1).unwrap();
        let two = [sound.clone(), packed(1 << 20)].concat();
        for bomb in [packed(64 << 20), claims, silent, two, packed(255), Vec::new(), vec![1; 4096]] {
            std::fs::write(&chunk, &bomb).unwrap();
            let error = dots.read_flat([2, 32]).unwrap_err();
            assert!(matches!(error, Error::Codec { .. } | Error::Io { .. }), "{} bytes: {error}", bomb.len());
        }
        std::fs::write(&chunk, &sound).unwrap();
        dots.read_flat([2, 32]).unwrap();
        let metadata = dir.path().join("flat/gain/zarr.json");
        let text = std::fs::read_to_string(&metadata).unwrap();
        for (from, to) in [
            ("\"zstd\"", "\"crc32c\""),
            ("\"chunk_shape\": [\n        2", "\"chunk_shape\": [\n        4000000"),
        ] {
            assert!(text.contains(from), "{text}");
            std::fs::write(&metadata, text.replace(from, to)).unwrap();
            assert!(dots.read_flat([2, 32]).is_err(), "{to}");
        }
        std::fs::remove_file(&metadata).unwrap();
        nix::unistd::mkfifo(&metadata, nix::sys::stat::Mode::S_IRWXU).unwrap();
        assert!(matches!(dots.read_flat([2, 32]), Err(Error::Io { .. })));
    }
}
