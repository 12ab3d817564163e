//! `dots.zarr`: the sparse columns of a flying dot, a Zarr v3 group with one subgroup `bNNNN` per batch.
//!
//! | array | type | axes | what |
//! | --- | --- | --- | --- |
//! | `word_offsets` | uint64 | `[dot + 1]` | where each dot's words begin |
//! | `words` | uint32 | `[word]` | pixel / 32 of 32 consecutive pixels of the frame, ascending within each dot |
//! | `masks` | uint32 | `[word]` | which of these pixels the dot has: bit `b` is pixel `32 word + b` |
//! | `values` | float32 | `[pixel]` | their light, in the order of dots, words and bits |
//! | `residual` | float32 | `[dot, block row, block column]` | mean light of the other pixels of each block; a block has `width / block columns` rows and columns |
//! | `discs` | uint32 | `[dot]` | discs used by the denoising; 0: nothing above the background |
//! | `capped` | bool | `[dot]` | whether the denoising stopped at the maximum number of discs |
//! | `seen` | bool | `[dot]` | whether the dot has a frame that shows the scene; the others have no light |
//!
//! Light is in camera counts above the background, times the flat field's gain; signed. A pixel is
//! `row * width + column`. If the run had a flat field, `flat` contains it: `gain`, float32, and `repaired`,
//! bool, `[t, s]`. A batch is written atomically: its folder is written next to its final place, synced, and
//! renamed. A batch without a line in the ledger is not stored.

mod flat;

use std::fs::{self, File};
use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use serde_json::{Map, Value, json};
use zarrs::array::{ArrayBuilder, DataType, Element, ElementOwned, FillValue, data_type};

use crate::durable::{self, DraftDir};
use crate::stack::StackShape;
use crate::zarr::{self, DurableStore};
use crate::{Error, Result};

pub use self::flat::FlatArrays;

/// The columns of one batch; the fields are the arrays of its group.
#[derive(Debug, Clone, Default, PartialEq)]
#[allow(missing_docs, reason = "the table at the head of the module says what each is")]
pub struct BatchColumns {
    pub word_offsets: Vec<u64>,
    pub words: Vec<u32>,
    pub masks: Vec<u32>,
    pub values: Vec<f32>,
    pub residual: Vec<f32>,
    /// Number of rows and columns of a residual's block; no array of its own, but in the shape of `residual`.
    pub block_px: usize,
    pub discs: Vec<u32>,
    pub capped: Vec<bool>,
    pub seen: Vec<bool>,
}

impl BatchColumns {
    /// CRC-32 (as in zip and PNG) of all arrays, little-endian, in the order of the fields.
    pub fn crc32(&self) -> u32 {
        let mut hasher = crc32fast::Hasher::new();
        self.word_offsets.iter().for_each(|value| hasher.update(&value.to_le_bytes()));
        for values in [&self.words, &self.masks] {
            values.iter().for_each(|value| hasher.update(&value.to_le_bytes()));
        }
        for values in [&self.values, &self.residual] {
            values.iter().for_each(|value| hasher.update(&value.to_le_bytes()));
        }
        self.discs.iter().for_each(|value| hasher.update(&value.to_le_bytes()));
        for flags in [&self.capped, &self.seen] {
            flags.iter().for_each(|&flag| hasher.update(&[u8::from(flag)]));
        }
        hasher.finalize()
    }
}

/// A stored batch, as recorded in the ledger.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BatchEntry {
    /// Its index in `dots.zarr`.
    pub batch: usize,
    /// The calibration plane that it shows, counted from 0; `None` for the scene.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub plane: Option<usize>,
    /// Start of its first exposure, in seconds after that of the run's first batch.
    pub start_s: f64,
    /// Dots of the scene without a frame.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub missing: Vec<usize>,
    /// Dots of the scene whose frames show nothing above the background.
    pub empty: usize,
    /// Dots whose denoising stopped at the maximum number of discs.
    pub capped: usize,
    /// Frames received twice.
    pub duplicates: u64,
    /// What became of its triggers.
    pub counts: raysweep_core::Counts,
    /// See [`BatchColumns::crc32`].
    pub crc32: u32,
}

/// `dots.zarr` of a session.
pub struct Dots {
    dir: PathBuf,
    /// Frames per batch.
    dots: usize,
    /// Rows and columns of a frame.
    size: [usize; 2],
}

impl Dots {
    /// Creates the group at `dir`, without batches.
    ///
    /// # Errors
    /// [`Error::Zarr`] if the file system refuses.
    pub fn create(dir: &Path, shape: &StackShape) -> Result<Self> {
        let attributes = json!({
            "height": shape.rows,
            "width": shape.columns,
            "dots": shape.dots(),
            "units": "camera counts (DN) above the background, times the flat field's gain",
        });
        zarr::create_group(&DurableStore::new(dir)?, into_map(attributes))?;
        Ok(Self::open(dir, shape))
    }

    /// Uses the existing group at `dir`.
    pub fn open(dir: &Path, shape: &StackShape) -> Self {
        Self { dir: dir.to_owned(), dots: shape.dots(), size: [shape.rows, shape.columns] }
    }

    fn path_of(&self, batch: usize) -> PathBuf {
        self.dir.join(format!("b{batch:04}"))
    }

    /// Writes a batch, replacing any existing one; when this returns, it is durable. `attributes` become its
    /// group's.
    ///
    /// # Errors
    /// [`Error::Shape`] if the arrays do not match the number of dots and blocks; [`Error::Io`] or
    /// [`Error::Zarr`] if the file system refuses.
    pub fn write(&self, batch: usize, columns: &BatchColumns, attributes: Map<String, Value>) -> Result<()> {
        let dots = self.dots;
        let [rows, across] = self.size.map(|side| side.div_ceil(columns.block_px.max(1)));
        let lengths = [
            ("word_offsets", columns.word_offsets.len(), dots + 1),
            ("masks", columns.masks.len(), columns.words.len()),
            ("residual", columns.residual.len(), dots * rows * across),
            ("discs", columns.discs.len(), dots),
            ("capped", columns.capped.len(), dots),
            ("seen", columns.seen.len(), dots),
        ];
        if let Some((name, found, allowed)) = lengths.into_iter().find(|(_, found, allowed)| found != allowed)
        {
            let what = format!("{name} of batch {batch}");
            return Err(Error::Shape { what, found: vec![found], allowed: format!("[{allowed}]") });
        }
        let draft = DraftDir::create(&self.path_of(batch))?;
        let store = DurableStore::draft(draft.path())?;
        zarr::create_group(&store, attributes)?;
        let put = Put { store: &store };
        let words = columns.words.len();
        let offsets = [("dot", dots + 1)];
        put.array("word_offsets", &offsets, data_type::uint64(), 0u64.into(), &columns.word_offsets)?;
        put.array("words", &[("word", words)], data_type::uint32(), 0u32.into(), &columns.words)?;
        put.array("masks", &[("word", words)], data_type::uint32(), 0u32.into(), &columns.masks)?;
        let pixels = [("pixel", columns.values.len())];
        put.array("values", &pixels, data_type::float32(), 0f32.into(), &columns.values)?;
        let blocks = [("dot", dots), ("block_row", rows), ("block_column", across)];
        put.array("residual", &blocks, data_type::float32(), 0f32.into(), &columns.residual)?;
        put.array("discs", &[("dot", dots)], data_type::uint32(), 0u32.into(), &columns.discs)?;
        put.array("capped", &[("dot", dots)], data_type::bool(), false.into(), &columns.capped)?;
        put.array("seen", &[("dot", dots)], data_type::bool(), false.into(), &columns.seen)?;
        sync_all(draft.path())?;
        draft.commit()
    }

    /// Reads a batch; the caller has to check that its arrays are consistent.
    ///
    /// # Errors
    /// [`Error::Zarr`] if it is missing or damaged.
    pub fn read(&self, batch: usize) -> Result<BatchColumns> {
        let path = self.path_of(batch);
        if !path.is_dir() {
            let missing = std::io::Error::from(std::io::ErrorKind::NotFound);
            return Err(Error::io("read", &path)(missing));
        }
        let get = Get { store: DurableStore::new(&path)? };
        let residual = get.shape("residual", 3)?;
        let width = self.size[1];
        let Some(block_px) = width.checked_div(residual[2]).filter(|side| side * residual[2] == width) else {
            return Err(Error::Shape {
                what: format!("residual of batch {batch}"),
                found: residual,
                allowed: format!("[dots, block rows, block columns], of which {width} is a multiple"),
            });
        };
        Ok(BatchColumns {
            word_offsets: get.array("word_offsets", 1)?,
            words: get.array("words", 1)?,
            masks: get.array("masks", 1)?,
            values: get.array("values", 1)?,
            residual: get.array("residual", 3)?,
            block_px,
            discs: get.array("discs", 1)?,
            capped: get.array("capped", 1)?,
            seen: get.array("seen", 1)?,
        })
    }
}

/// `raw.npy` and `raw.csv`: the raw frames of a flying dot in order of arrival, uint16 `[frame, t, s]`, and
/// one line per frame with its number in the file, the camera's id, and its batch and dot, both empty if it
/// belongs to none. Lines are written once that is certain, so they are not strictly in order. A batch that a pause cut
/// short is taken again: of several frames of a dot, the last is in the batch. The header of
/// a file that a crash cut short states 0 frames; its length tells how many there are.
pub struct RawFrames {
    path: PathBuf,
    frames: BufWriter<File>,
    lines: BufWriter<File>,
    size: [usize; 2],
    count: u64,
    /// The frame that is written.
    bytes: Vec<u8>,
}

/// Bytes of the header of `raw.npy`, for any number of frames.
const HEADER_BYTES: usize = 128;

impl RawFrames {
    /// Creates both files, without frames; `path` is that of `raw.npy`.
    ///
    /// # Errors
    /// [`Error::Io`] if the file system refuses.
    pub fn create(path: &Path, rows: usize, columns: usize) -> Result<Self> {
        let make = |path: &Path| File::create(path).map_err(Error::io("create", path));
        let table = path.with_extension("csv");
        let size = [rows, columns];
        // A frame has room in the buffer, so that a disk that is full refuses it whole.
        let buffer_bytes = 2 * rows * columns + HEADER_BYTES;
        let mut frames = BufWriter::with_capacity(buffer_bytes, make(path)?);
        let mut lines = BufWriter::new(make(&table)?);
        frames.write_all(&header(0, size)).map_err(Error::io("write", path))?;
        lines.write_all(b"frame,id,batch,dot\n").map_err(Error::io("write", &table))?;
        let bytes = Vec::with_capacity(2 * rows * columns);
        Ok(Self { path: path.to_owned(), frames, lines, size, count: 0, bytes })
    }

    /// Number of frames so far.
    pub fn len(&self) -> u64 {
        self.count
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Appends a frame, row by row. What the file system refuses can be tried again.
    ///
    /// # Errors
    /// [`Error::Shape`] for a frame of another size, [`Error::Io`] if the file system refuses.
    pub fn push(&mut self, frame: &[u16]) -> Result<()> {
        let [rows, columns] = self.size;
        if frame.len() != rows * columns {
            let what = "a raw frame".to_owned();
            return Err(Error::Shape {
                what,
                found: vec![frame.len()],
                allowed: format!("[{}]", rows * columns),
            });
        }
        self.bytes.clear();
        self.bytes.extend(frame.iter().flat_map(|counts| counts.to_le_bytes()));
        self.frames.write_all(&self.bytes).map_err(Error::io("write", &self.path))?;
        self.count += 1;
        Ok(())
    }

    /// Records which dot of which batch a frame shows. What the file system refuses can be tried again.
    ///
    /// # Errors
    /// [`Error::Io`] if the file system refuses.
    pub fn note(&mut self, frame: u64, id: u64, place: Option<(usize, usize)>) -> Result<()> {
        let line = match place {
            Some((batch, dot)) => format!("{frame},{id},{batch},{dot}\n"),
            None => format!("{frame},{id},,\n"),
        };
        self.lines.write_all(line.as_bytes()).map_err(Error::io("write", &self.path.with_extension("csv")))
    }

    /// Hands everything to the file system. What it refuses can be tried again.
    ///
    /// # Errors
    /// [`Error::Io`] if it refuses.
    pub fn flush(&mut self) -> Result<()> {
        let flushed = self.frames.flush().and_then(|()| self.lines.flush());
        flushed.map_err(Error::io("write", &self.path))
    }

    /// Completes the files; when this returns, they are durable.
    ///
    /// # Errors
    /// [`Error::Io`] if the file system refuses.
    pub fn finish(self) -> Result<()> {
        let Self { path, frames, lines, size, count, .. } = self;
        for (file, header) in [(frames, Some(header(count, size))), (lines, None)] {
            let mut file =
                file.into_inner().map_err(|error| Error::io("write", &path)(error.into_error()))?;
            let written = match header {
                Some(header) => file.seek(SeekFrom::Start(0)).and_then(|_| file.write_all(&header)),
                None => Ok(()),
            };
            written.and_then(|()| file.sync_all()).map_err(Error::io("write", &path))?;
        }
        path.parent().map_or(Ok(()), durable::sync_dir)
    }
}

/// The header of an NPY file, version 1.0.
fn header(count: u64, [rows, columns]: [usize; 2]) -> [u8; HEADER_BYTES] {
    let text = format!("{{'descr': '<u2', 'fortran_order': False, 'shape': ({count}, {rows}, {columns}), }}");
    let mut header = [b' '; HEADER_BYTES];
    header[..10].copy_from_slice(b"\x93NUMPY\x01\x00\x76\x00");
    // A length has at most 20 digits, so the text always fits.
    header[10..10 + text.len()].copy_from_slice(text.as_bytes());
    header[HEADER_BYTES - 1] = b'\n';
    header
}

struct Put<'a> {
    store: &'a Arc<DurableStore>,
}

impl Put<'_> {
    /// Writes an array, given the names and lengths of its axes, as a single chunk.
    fn array<T: Element>(
        &self,
        name: &str,
        axes: &[(&str, usize)],
        data_type: DataType,
        fill: FillValue,
        values: &[T],
    ) -> Result<()> {
        let lengths = |least: usize| axes.iter().map(|&(_, len)| len.max(least) as u64).collect::<Vec<_>>();
        let mut builder = ArrayBuilder::new(lengths(0), lengths(1), data_type, fill);
        zarr::with_codecs(&mut builder).dimension_names(Some(axes.iter().map(|&(axis, _)| axis)));
        let array = zarr::create_array(self.store, name, &builder)?;
        if values.is_empty() {
            return Ok(());
        }
        let path = self.store.root().join(name);
        // One thread only: the next frames arrive while batches are written, and need the other threads.
        let options = zarr::codec_options().with_concurrent_target(1);
        array.store_chunk_opt(&vec![0; axes.len()], values, &options).map_err(Error::zarr("write", &path))
    }
}

struct Get {
    store: Arc<DurableStore>,
}

impl Get {
    fn shape(&self, name: &str, axes: usize) -> Result<Vec<usize>> {
        let array = zarr::open_array(&self.store, name, axes)?;
        Ok(zarr::shape_of(&array))
    }

    fn array<T: ElementOwned>(&self, name: &str, axes: usize) -> Result<Vec<T>> {
        let array = zarr::open_array(&self.store, name, axes)?;
        if zarr::shape_of(&array).contains(&0) {
            return Ok(Vec::new());
        }
        let path = self.store.root().join(name);
        array
            .retrieve_array_subset_opt(&array.subset_all(), &zarr::codec_options())
            .map_err(Error::zarr("read", &path))
    }
}

/// Makes all files and subfolders of a folder durable at once.
fn sync_all(dir: &Path) -> Result<()> {
    for entry in fs::read_dir(dir).map_err(Error::io("list", dir))? {
        let path = entry.map_err(Error::io("list", dir))?.path();
        match path.is_dir() {
            true => sync_all(&path)?,
            false => File::open(&path).and_then(|file| file.sync_all()).map_err(Error::io("sync", &path))?,
        }
    }
    durable::sync_dir(dir)
}

fn into_map(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::stack::Contents;

    fn shape() -> StackShape {
        StackShape { contents: Contents::Batches { batches: 4, dots: 3 }, rows: 40, columns: 64 }
    }

    fn columns(seed: u32) -> BatchColumns {
        BatchColumns {
            word_offsets: vec![0, 2, 2, 3],
            words: vec![seed, seed + 4, 7],
            masks: vec![1, u32::MAX, 1 << 31],
            values: (0..34).map(|value| value as f32 - 3.5).collect(),
            residual: (0..12).map(|block| block as f32 / 8.0).collect(),
            block_px: 32,
            discs: vec![2, 0, 1],
            capped: vec![true, false, false],
            seen: vec![true, false, true],
        }
    }

    #[test]
    fn batches_read_back_and_replace_what_was_there() {
        let dir = tempfile::tempdir().unwrap();
        let dots = Dots::create(dir.path(), &shape()).unwrap();
        dots.write(1, &columns(5), Map::new()).unwrap();
        dots.write(1, &columns(0), Map::new()).unwrap();
        let dots = Dots::open(dir.path(), &shape());
        let finer = BatchColumns { block_px: 16, residual: vec![0.5; 36], ..columns(3) };
        dots.write(2, &finer, Map::new()).unwrap();
        assert_eq!(dots.read(2).unwrap(), finer);
        let read = dots.read(1).unwrap();
        assert_eq!((&read, read.crc32()), (&columns(0), columns(0).crc32()));
        assert!(read.crc32() != columns(5).crc32());
        assert!(dots.read(0).is_err());
        let names = fs::read_dir(dir.path()).unwrap().map(|entry| entry.unwrap().file_name());
        let mut names: Vec<_> = names.map(|name| name.into_string().unwrap()).collect();
        names.sort();
        assert_eq!(names, ["b0001", "b0002", "zarr.json"], "nothing else is left");
    }

    #[test]
    fn a_batch_without_any_light_is_stored_too() {
        let dir = tempfile::tempdir().unwrap();
        let dots = Dots::create(dir.path(), &shape()).unwrap();
        let dark = BatchColumns {
            word_offsets: vec![0; 4],
            words: Vec::new(),
            masks: Vec::new(),
            values: Vec::new(),
            residual: vec![0.0; 12],
            block_px: 32,
            discs: vec![0; 3],
            capped: vec![false; 3],
            seen: vec![false; 3],
        };
        dots.write(0, &dark, Map::new()).unwrap();
        assert_eq!(dots.read(0).unwrap(), dark);
    }

    #[test]
    fn raw_frames_are_a_file_that_numpy_reads() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("raw.npy");
        let mut raw = RawFrames::create(&path, 3, 5).unwrap();
        let frame = |seed: u16| (0..15).map(|pixel| seed * 1000 + pixel).collect::<Vec<u16>>();
        raw.push(&frame(1)).unwrap();
        raw.push(&frame(2)).unwrap();
        raw.note(0, 17, Some((3, 4))).unwrap();
        raw.note(1, 18, None).unwrap();
        assert!(raw.push(&[0; 14]).is_err());
        raw.finish().unwrap();
        let read: ndarray::Array3<u16> = ndarray_npy::read_npy(&path).unwrap();
        assert_eq!(
            (read.dim(), read.into_raw_vec_and_offset().0),
            ((2, 3, 5), [frame(1), frame(2)].concat())
        );
        let table = fs::read_to_string(path.with_extension("csv")).unwrap();
        assert_eq!(table, "frame,id,batch,dot\n0,17,3,4\n1,18,,\n");
    }

    #[test]
    fn arrays_that_do_not_fit_are_refused_and_damage_is_noticed() {
        let dir = tempfile::tempdir().unwrap();
        let dots = Dots::create(dir.path(), &shape()).unwrap();
        let torn = BatchColumns { seen: vec![true; 2], ..columns(0) };
        let finer = BatchColumns { block_px: 16, ..columns(0) };
        assert!(dots.write(0, &finer, Map::new()).is_err(), "12 means are not those of 16 x 16 pixels");
        let error = dots.write(0, &torn, Map::new()).unwrap_err();
        assert!(
            matches!(&error, Error::Shape { found, allowed, .. } if found == &[2] && allowed == "[3]"),
            "{error}"
        );
        dots.write(0, &columns(0), Map::new()).unwrap();
        let chunk = dir.path().join("b0000/values/c.0");
        let mut bytes = fs::read(&chunk).unwrap();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 0x40;
        fs::write(&chunk, bytes).unwrap();
        assert!(dots.read(0).is_err() || dots.read(0).unwrap().crc32() != columns(0).crc32());
    }
}
