//! Shared by `stack.zarr` and `transport.zarr`: a durable store, and chunks at the edge of an array.

use std::fs::File;
use std::io;
use std::ops::Range;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use ndarray::{Array3, ArrayView3, s};
use serde_json::{Map, Value};
use zarrs::array::codec::{BytesCodec, ShardingCodecOptions, SubchunkWriteOrder, ZstdCodec};
use zarrs::array::{
    Array, ArrayBuilder, ArrayMetadataOptions, ArraySubset, BytesToBytesCodecTraits, CodecOptions,
    CodecSpecificOptions, Element, ElementOwned,
};
use zarrs::filesystem::FilesystemStore;
use zarrs::group::GroupBuilder;
use zarrs::metadata::ChunkKeySeparator;
use zarrs::storage::byte_range::ByteRangeIterator;
use zarrs::storage::{
    Bytes, MaybeBytesIterator, OffsetBytesIterator, ReadableStorageTraits, StorageError, StoreKey,
    StorePrefix, WritableStorageTraits,
};
use zstd::zstd_safe;

use crate::{Error, Result, durable, input};

/// Maximum rows and columns of a chunk.
pub(crate) const CHUNK_PX: usize = 64;

/// A file system store in which every write is durable. zarrs' own store writes in place, and its atomic
/// adapter does not sync the folder.
pub(crate) struct DurableStore {
    root: PathBuf,
    files: FilesystemStore,
    /// Whether the folder is a draft, which is made durable as a whole later.
    draft: bool,
}

impl DurableStore {
    pub(crate) fn new(root: &Path) -> Result<Arc<DurableStore>> {
        if std::fs::symlink_metadata(root).is_ok_and(|found| found.is_symlink()) {
            let why =
                "it is a symbolic link, and a session contains none: put the folder itself in its place";
            return Err(Error::io("open", root)(io::Error::other(why)));
        }
        let files = FilesystemStore::new(root).map_err(Error::zarr("open", root))?;
        Ok(Arc::new(DurableStore { root: root.to_owned(), files, draft: false }))
    }

    /// A store in a folder without readers so far: all its files are made durable when it is moved to its
    /// final place.
    pub(crate) fn draft(root: &Path) -> Result<Arc<DurableStore>> {
        let files = FilesystemStore::new(root).map_err(Error::zarr("open", root))?;
        Ok(Arc::new(DurableStore { root: root.to_owned(), files, draft: true }))
    }

    pub(crate) fn root(&self) -> &Path {
        &self.root
    }
}

impl ReadableStorageTraits for DurableStore {
    fn get_partial_many<'a>(
        &'a self,
        key: &StoreKey,
        byte_ranges: ByteRangeIterator<'a>,
    ) -> std::result::Result<MaybeBytesIterator<'a>, StorageError> {
        // A pipe would block, a link lead out of the session. What is missing, the store says.
        match std::fs::symlink_metadata(self.files.key_to_fspath(key)) {
            Ok(found) if !found.is_file() => Err(StorageError::Other(format!("{key} is not a regular file"))),
            _ => self.files.get_partial_many(key, byte_ranges),
        }
    }

    fn size_key(&self, key: &StoreKey) -> std::result::Result<Option<u64>, StorageError> {
        self.files.size_key(key)
    }

    fn supports_get_partial(&self) -> bool {
        self.files.supports_get_partial()
    }
}

impl WritableStorageTraits for DurableStore {
    fn set(&self, key: &StoreKey, value: Bytes) -> std::result::Result<(), StorageError> {
        let path = self.files.key_to_fspath(key);
        let parent = path.parent().unwrap_or(&self.root);
        if self.draft {
            let written = std::fs::create_dir_all(parent)
                .and_then(|()| File::create(&path))
                .and_then(|mut file| durable::write_in_pieces(&mut file, &value));
            return written.map_err(StorageError::from);
        }
        durable::create_dir_within(parent).and_then(|()| durable::write(&path, &value)).map_err(|error| {
            match &error {
                Error::Io { source, .. } => io::Error::new(source.kind(), error.to_string()).into(),
                _ => StorageError::Other(error.to_string()),
            }
        })
    }

    fn set_partial_many(
        &self,
        key: &StoreKey,
        _: OffsetBytesIterator,
    ) -> std::result::Result<(), StorageError> {
        Err(StorageError::Unsupported(format!("{key} can only be written whole")))
    }

    fn erase(&self, key: &StoreKey) -> std::result::Result<(), StorageError> {
        Err(StorageError::Unsupported(format!("{key} cannot be erased from a session")))
    }

    fn erase_prefix(&self, prefix: &StorePrefix) -> std::result::Result<(), StorageError> {
        Err(StorageError::Unsupported(format!("{prefix} cannot be erased from a session")))
    }

    fn supports_set_partial(&self) -> bool {
        false
    }
}

/// Writes the metadata of the root group.
pub(crate) fn create_group(store: &Arc<DurableStore>, attributes: Map<String, Value>) -> Result<()> {
    durable::create_dir_within(store.root())?;
    GroupBuilder::new()
        .attributes(attributes)
        .build(store.clone(), "/")
        .map_err(Error::zarr("create", store.root()))?
        .store_metadata()
        .map_err(Error::zarr("create", store.root()))
}

/// Codecs of all data: little-endian, Zstandard level 1 with checksum. Chunks are files in one folder
/// (`c.0.0.0`), so that a point costs one fsync of a file and one of a folder.
pub(crate) fn with_codecs(builder: &mut ArrayBuilder) -> &mut ArrayBuilder {
    let zstd: Arc<dyn BytesToBytesCodecTraits> = Arc::new(ZstdCodec::new(1, true));
    builder
        .array_to_bytes_codec(Arc::new(BytesCodec::little()))
        .bytes_to_bytes_codecs(vec![zstd])
        .chunk_key_encoding_default_separator(ChunkKeySeparator::Dot)
}

/// Builds an array and writes its metadata.
pub(crate) fn create_array(
    store: &Arc<DurableStore>,
    name: &str,
    builder: &ArrayBuilder,
) -> Result<Array<DurableStore>> {
    let array = builder
        .build(store.clone(), &format!("/{name}"))
        .map_err(Error::zarr("create", &store.root().join(name)))?
        // The library's version would change the bytes of the metadata with every update.
        .with_metadata_options(ArrayMetadataOptions::default().with_include_zarrs_metadata(false))
        .with_codec_specific_options(&in_fixed_order());
    array.store_metadata().map_err(Error::zarr("create", &store.root().join(name)))?;
    Ok(array)
}

/// Opens an array that must have this number of axes.
pub(crate) fn open_array(store: &Arc<DurableStore>, name: &str, axes: usize) -> Result<Array<DurableStore>> {
    let path = store.root().join(name);
    let array = Array::open(store.clone(), &format!("/{name}")).map_err(Error::zarr("open", &path))?;
    if array.shape().len() != axes {
        let (what, found) = (path.display().to_string(), shape_of(&array));
        return Err(Error::Shape { what, found, allowed: format!("{axes} axes") });
    }
    Ok(array.with_codec_specific_options(&in_fixed_order()))
}

/// Longest `zarr.json` of an array that a client names.
const MOST_METADATA_BYTES: u64 = 1 << 20;

/// Refuses an array, given by its folder, whose metadata are no regular file of a usual length.
pub(crate) fn check_metadata_file(array: &Path) -> Result<()> {
    let path = array.join("zarr.json");
    input::open(&path, MOST_METADATA_BYTES).map(drop).map_err(Error::io("read", &path))
}

/// Refuses an array unless it has a single chunk, packed as ours are, that says truly how long it becomes: the decoder
/// allocates what a chunk claims.
pub(crate) fn check_only_chunk(array: &Array<DurableStore>, element_bytes: usize) -> Result<()> {
    let path = path_of(array);
    let damaged = |why: &str| Error::codec("read", path.display())(why);
    let metadata = serde_json::to_value(array.metadata()).map_err(Error::codec("read", path.display()))?;
    let codecs = metadata["codecs"].as_array().map(Vec::as_slice).unwrap_or_default();
    if !codecs.iter().map(|codec| &codec["name"]).eq(["bytes", "zstd"]) {
        return Err(damaged("its codecs are not those of a session, bytes and zstd"));
    }
    let first = vec![0; array.shape().len()];
    let chunk = array.chunk_shape(&first).map_err(Error::zarr("read", &path))?;
    if chunk.iter().map(|side| side.get()).ne(array.shape().iter().copied()) {
        return Err(damaged("it is not stored as a single chunk"));
    }
    let bytes = array.shape().iter().product::<u64>() * element_bytes as u64;
    let file = array.storage().files.key_to_fspath(&array.chunk_key(&first));
    // Zstandard stores what it cannot pack as it is, with 3 bytes for each block of at least 1 KB and less than 32 around.
    let packed = input::read(&file, bytes + bytes / 256 + 64).map_err(Error::io("read", &file))?;
    let is_whole = zstd_safe::find_frame_compressed_size(&packed) == Ok(packed.len());
    if !is_whole || zstd_safe::get_frame_content_size(&packed).ok().flatten() != Some(bytes) {
        return Err(damaged("its chunk is damaged, or does not unpack to the array's size"));
    }
    Ok(())
}

fn path_of(array: &Array<DurableStore>) -> PathBuf {
    array.storage().root().join(array.path().as_str().trim_start_matches('/'))
}

pub(crate) fn shape_of(array: &Array<DurableStore>) -> Vec<usize> {
    array.shape().iter().map(|&len| usize::try_from(len).unwrap_or(usize::MAX)).collect()
}

/// Writes one chunk; the part beyond the end of the array is filled with zeros.
pub(crate) fn write_chunk<T: Element + Clone + Default>(
    array: &Array<DurableStore>,
    indices: [u64; 3],
    chunk_shape: [usize; 3],
    data: ArrayView3<T>,
) -> Result<()> {
    let mut chunk = Array3::from_elem(chunk_shape, T::default());
    let (depth, rows, columns) = data.dim();
    chunk.slice_mut(s![..depth, ..rows, ..columns]).assign(&data);
    let options = codec_options();
    array.store_chunk_opt(&indices, chunk, &options).map_err(Error::zarr("write", &path_of(array)))
}

/// Reads a part of an array, and only the inner chunks of its shards that contain it. Chunks that were never
/// written read as 0.
pub(crate) fn read_part<T: ElementOwned>(
    array: &Array<DurableStore>,
    part: [Range<usize>; 3],
) -> Result<Array3<T>> {
    let shape = shape_of(array);
    if part.iter().zip(&shape).any(|(range, &len)| range.start >= range.end || range.end > len) {
        return Err(Error::Shape {
            what: format!("a part of {}", path_of(array).display()),
            found: part.iter().map(|range| range.end).collect(),
            allowed: format!("not empty, and within {shape:?}"),
        });
    }
    let subset = ArraySubset::new_with_ranges(&part.map(|range| range.start as u64..range.end as u64));
    array.retrieve_array_subset_opt(&subset, &codec_options()).map_err(Error::zarr("read", &path_of(array)))
}

/// Reads a whole array.
pub(crate) fn read_all<T: ElementOwned>(array: &Array<DurableStore>) -> Result<Array3<T>> {
    array
        .retrieve_array_subset_opt(&array.subset_all(), &codec_options())
        .map_err(Error::zarr("read", &path_of(array)))
}

/// Chunks that are all zeros are stored like any other: every stored point has a file.
pub(crate) fn codec_options() -> CodecOptions {
    CodecOptions::default().with_store_empty_chunks(true)
}

/// Writes shards in a fixed order; otherwise their bytes would depend on the threads. The metadata do not
/// contain this, so it applies to opened arrays as well as to new ones.
fn in_fixed_order() -> CodecSpecificOptions {
    let order = ShardingCodecOptions::default().with_subchunk_write_order(SubchunkWriteOrder::C);
    CodecSpecificOptions::default().with_option(order)
}
