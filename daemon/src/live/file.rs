//! The writer of the live file. [`raysweep_proto::live`] has its layout.

use std::fs::{self, File, OpenOptions, TryLockError};
use std::io::{self, Read};
use std::os::unix::fs::{FileExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use crc32fast::Hasher;
use ndarray::{ArrayD, ArrayViewD, Axis};
use nix::time::{ClockId, clock_gettime};
use raysweep_proto::live::{
    DTYPE, HEADER_BYTES, MAGIC, MAX_AXES, METADATA_BYTES, NAME_BYTES, SLOT_HEADER_BYTES, VERSION,
};
use serde_json::{Map, Value, json};

use super::LiveError;

/// Owner may write, group may read.
const MODE: u32 = 0o640;
/// Slots of the file: so many names less one may be in it at once.
const SLOTS: usize = 8;
/// Pixels of a slot; larger images are reduced.
const SLOT_PIXELS: usize = 1 << 20;
/// Where slots start, a page, so that they can be mapped one by one.
const FIRST_SLOT: u64 = 4096;

/// A file of fixed size with the newest images by name. Written with plain positioned writes: in the page cache they
/// are seen at once by whoever reads or maps the file. Removed when dropped.
pub struct LiveFile {
    path: PathBuf,
    file: File,
    slot_pixels: usize,
    /// Held while an image is copied into the page cache: its publishers are worker threads, never a device's.
    slots: Mutex<Slots>,
}

#[derive(Default)]
struct Slots {
    /// Images published so far.
    sequence: u64,
    /// What each slot holds: its lock, the image's sequence (0: none) and name.
    held: [Held; SLOTS],
    /// Metadata and pixels on their way to the file.
    bytes: Vec<u8>,
}

#[derive(Default)]
struct Held {
    lock: u64,
    sequence: u64,
    name: String,
}

impl Slots {
    /// The slot to write next: the oldest that is not the newest of its name, so that a reader of any name has the time
    /// of a whole image; with more names than slots, the oldest of all.
    fn next(&self) -> usize {
        let newest_of_its_name = |held: &Held| {
            held.sequence > 0
                && self.held.iter().all(|other| other.name != held.name || other.sequence <= held.sequence)
        };
        let oldest = self.held.iter().enumerate();
        let oldest = oldest.min_by_key(|(_, held)| (newest_of_its_name(held), held.sequence));
        oldest.map_or(0, |(index, _)| index)
    }
}

impl LiveFile {
    /// Makes the file, readable for the owner's group. One that a dead daemon left is replaced.
    ///
    /// # Errors
    /// [`LiveError::Taken`], [`LiveError::NotLive`] where something else has this name, [`LiveError::Io`].
    pub fn create(path: &Path) -> Result<Self, LiveError> {
        Self::with_slots_of(SLOT_PIXELS, path)
    }

    fn with_slots_of(slot_pixels: usize, path: &Path) -> Result<Self, LiveError> {
        remove_stale(path)?;
        let failed = || |source| LiveError::Make { path: path.to_owned(), source };
        let file = OpenOptions::new()
            .read(true)
            .write(true)
            .create_new(true)
            .mode(MODE)
            .open(path)
            .map_err(failed())?;
        let live = Self { path: path.to_owned(), file, slot_pixels, slots: Mutex::new(Slots::default()) };
        // The lock tells the next daemon that this one lives; the mode must not hang on the umask.
        live.file.try_lock().map_err(|error| failed()(error.into()))?;
        live.file.set_permissions(fs::Permissions::from_mode(MODE)).map_err(failed())?;
        live.file.set_len(live.offset_of(SLOTS)).map_err(failed())?;
        let mut header = [0; HEADER_BYTES];
        header[..8].copy_from_slice(&MAGIC);
        header[8..12].copy_from_slice(&VERSION.to_le_bytes());
        header[12..16].copy_from_slice(&(SLOTS as u32).to_le_bytes());
        header[16..24].copy_from_slice(&FIRST_SLOT.to_le_bytes());
        header[24..32].copy_from_slice(&live.slot_bytes().to_le_bytes());
        live.file.write_all_at(&header, 0).map_err(failed())?;
        Ok(live)
    }

    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.path
    }

    fn slot_bytes(&self) -> u64 {
        (SLOT_HEADER_BYTES + METADATA_BYTES + self.slot_pixels * size_of::<f32>()) as u64
    }

    fn offset_of(&self, slot: usize) -> u64 {
        FIRST_SLOT + slot as u64 * self.slot_bytes()
    }

    /// Shows an image of one to four axes, the last two of which are rows and columns, under a name; returns its
    /// sequence number. Never waits for readers. One that is too large for a slot is averaged over blocks of its rows
    /// and columns; the metadata then have `reduced_by`, the blocks' side in pixels.
    ///
    /// # Errors
    /// [`LiveError::Refused`] for a name, metadata or a shape that the file has no room for; [`LiveError::Io`].
    pub fn publish(
        &self,
        name: &str,
        image: ArrayViewD<f32>,
        metadata: &Map<String, Value>,
    ) -> Result<u64, LiveError> {
        let refused = |why: String| LiveError::Refused { name: name.into(), why };
        if name.is_empty() || name.len() > NAME_BYTES || name.contains('\0') {
            return Err(refused(format!("a name is 1 to {NAME_BYTES} bytes long, without NUL")));
        }
        if image.is_empty() || !(1..=MAX_AXES).contains(&image.ndim()) {
            return Err(refused(format!(
                "shape {:?}: 1 to {MAX_AXES} axes are allowed, none of length 0",
                image.shape()
            )));
        }
        let side = reduction(image.shape(), self.slot_pixels);
        let reduced = (side > 1).then(|| averaged(image.view(), side));
        let image = reduced.as_ref().map_or(image, |reduced| reduced.view());
        if image.len() > self.slot_pixels {
            return Err(refused(format!(
                "{} planes do not fit {} pixels",
                image.shape()[0],
                self.slot_pixels
            )));
        }
        let mut metadata = metadata.clone();
        if side > 1 {
            metadata.insert("reduced_by".into(), json!(side));
        }
        let metadata = Value::Object(metadata).to_string();
        if metadata.len() > METADATA_BYTES {
            return Err(refused(format!(
                "metadata of {} bytes: {METADATA_BYTES} are allowed",
                metadata.len()
            )));
        }

        let mut slots = self.slots.lock().unwrap_or_else(PoisonError::into_inner);
        slots.bytes.clear();
        slots.bytes.extend_from_slice(metadata.as_bytes());
        slots.bytes.resize(METADATA_BYTES, 0);
        slots.bytes.extend(image.iter().flat_map(|pixel| pixel.to_le_bytes()));
        let (index, sequence) = (slots.next(), slots.sequence + 1);
        let lock = slots.held[index].lock + 2;
        let header =
            header(name, image.shape(), lock, sequence, metadata.len(), &slots.bytes, self.offset_of(index));
        self.write_slot(index, &header, &slots.bytes).map_err(LiveError::io("write", &self.path))?;
        slots.sequence = sequence;
        slots.held[index] = Held { lock, sequence, name: name.into() };
        Ok(sequence)
    }

    /// Takes all images away: they are those of another run.
    ///
    /// # Errors
    /// [`LiveError::Io`].
    pub fn clear(&self) -> Result<(), LiveError> {
        let mut slots = self.slots.lock().unwrap_or_else(PoisonError::into_inner);
        for index in 0..SLOTS {
            let lock = slots.held[index].lock + 2;
            let mut header = [0; SLOT_HEADER_BYTES];
            header[..8].copy_from_slice(&lock.to_le_bytes());
            self.write_slot(index, &header, &[]).map_err(LiveError::io("write", &self.path))?;
            slots.held[index] = Held { lock, ..Held::default() };
        }
        Ok(())
    }

    /// The order is what readers rely on: lock odd, everything, lock even.
    fn write_slot(&self, index: usize, header: &[u8; SLOT_HEADER_BYTES], bytes: &[u8]) -> io::Result<()> {
        let at = self.offset_of(index);
        let (even, rest) = header.split_at(8);
        let mut odd = [0; 8];
        odd.copy_from_slice(even);
        self.file.write_all_at(&(u64::from_le_bytes(odd) - 1).to_le_bytes(), at)?;
        self.file.write_all_at(rest, at + 8)?;
        self.file.write_all_at(bytes, at + SLOT_HEADER_BYTES as u64)?;
        self.file.write_all_at(even, at)
    }
}

impl Drop for LiveFile {
    fn drop(&mut self) {
        if let Err(error) = fs::remove_file(&self.path) {
            tracing::warn!(%error, path = %self.path.display(), "cannot remove the live file");
        }
    }
}

/// Removes the file of a daemon that lives no more.
fn remove_stale(path: &Path) -> Result<(), LiveError> {
    let failed = || LiveError::io("replace", path);
    match fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(failed()(error)),
        Ok(metadata) if !metadata.is_file() => {
            let why = "it is no plain file; remove it, or choose another --live".into();
            return Err(LiveError::NotLive { path: path.to_owned(), why });
        }
        Ok(_) => {}
    }
    let mut file = File::open(path).map_err(failed())?;
    let mut magic = [0; MAGIC.len()];
    if file.read_exact(&mut magic).is_err() || magic != MAGIC {
        let why = "it begins otherwise; remove it, or choose another --live".into();
        return Err(LiveError::NotLive { path: path.to_owned(), why });
    }
    match file.try_lock() {
        Ok(()) => fs::remove_file(path).map_err(failed()),
        Err(TryLockError::WouldBlock) => Err(LiveError::Taken(path.to_owned())),
        Err(TryLockError::Error(error)) => Err(failed()(error)),
    }
}

/// A slot's header; `bytes` are metadata, padding and pixels, `at` is where the slot starts.
fn header(
    name: &str,
    shape: &[usize],
    lock: u64,
    sequence: u64,
    metadata_bytes: usize,
    bytes: &[u8],
    at: u64,
) -> [u8; SLOT_HEADER_BYTES] {
    let metadata_at = at + SLOT_HEADER_BYTES as u64;
    let mut checksum = Hasher::new();
    checksum.update(&bytes[..metadata_bytes]);
    checksum.update(&bytes[METADATA_BYTES..]);
    let mut header = [0; SLOT_HEADER_BYTES];
    let mut put = |offset: usize, field: &[u8]| header[offset..offset + field.len()].copy_from_slice(field);
    put(0, &lock.to_le_bytes());
    put(8, &sequence.to_le_bytes());
    put(16, &host_ns().to_le_bytes());
    put(24, &(metadata_at + METADATA_BYTES as u64).to_le_bytes());
    put(32, &metadata_at.to_le_bytes());
    put(40, &(metadata_bytes as u32).to_le_bytes());
    put(44, &checksum.finalize().to_le_bytes());
    put(48, &DTYPE);
    put(52, &(shape.len() as u32).to_le_bytes());
    shape.iter().enumerate().for_each(|(axis, &len)| put(56 + 8 * axis, &(len as u64).to_le_bytes()));
    put(88, name.as_bytes());
    header
}

/// The side of the blocks that an image must be averaged over to have so many pixels.
fn reduction(shape: &[usize], pixels: usize) -> usize {
    let (planes, image) = shape.split_at(shape.len().saturating_sub(2));
    let len = |side: usize| {
        planes.iter().product::<usize>() * image.iter().map(|len| len.div_ceil(side)).product::<usize>()
    };
    let longest = image.iter().copied().max().unwrap_or(1);
    (1..longest).find(|&side| len(side) <= pixels).unwrap_or(longest)
}

/// The means of blocks of `side` x `side` over the last two axes; blocks at the end may be smaller.
fn averaged(image: ArrayViewD<f32>, side: usize) -> ArrayD<f32> {
    let along = |image: ArrayViewD<f32>, axis: Axis| {
        let blocks: Vec<_> =
            image.axis_chunks_iter(axis, side).filter_map(|block| block.mean_axis(axis)).collect();
        let views: Vec<_> = blocks.iter().map(|block| block.view()).collect();
        ndarray::stack(axis, &views).unwrap_or_else(|_| image.to_owned())
    };
    let last = image.ndim() - 1;
    let narrow = along(image, Axis(last));
    if last == 0 { narrow } else { along(narrow.view(), Axis(last - 1)) }
}

/// `CLOCK_MONOTONIC`, which the stamps of frames are on; 0 if the system has none.
fn host_ns() -> i64 {
    clock_gettime(ClockId::CLOCK_MONOTONIC).map_or(0, |now| now.tv_sec() * 1_000_000_000 + now.tv_nsec())
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicBool, Ordering};

    use ndarray::{Array2, Array3, ArrayD, IxDyn};

    use super::super::LiveReader;
    use super::*;

    fn folder() -> (tempfile::TempDir, PathBuf) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("live");
        (folder, path)
    }

    fn flat(value: f32, rows: usize, columns: usize) -> ArrayD<f32> {
        ArrayD::from_elem(IxDyn(&[rows, columns]), value)
    }

    fn show(live: &LiveFile, name: &str, image: &ArrayD<f32>) -> u64 {
        let metadata = Map::from_iter([("mean".to_owned(), json!(image.mean()))]);
        live.publish(name, image.view(), &metadata).unwrap()
    }

    #[test]
    fn an_image_reads_back_from_a_file_of_fixed_size_for_the_group_that_is_removed_at_the_end() {
        let (_folder, path) = folder();
        let live = LiveFile::create(&path).unwrap();
        let bytes = fs::metadata(&path).unwrap().len();
        assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o640);
        let reader = LiveReader::open(&path).unwrap();
        assert_eq!(reader.newest("epipolar").unwrap(), None);
        let image = Array3::from_shape_fn((2, 3, 5), |(k, t, s)| (k * 100 + t * 10 + s) as f32).into_dyn();
        let before_ns = host_ns();
        assert_eq!(show(&live, "epipolar", &flat(1.0, 4, 4)), 1);
        assert_eq!(show(&live, "epipolar", &image), 2);
        let found = reader.newest("epipolar").unwrap().unwrap();
        assert_eq!((found.sequence, &found.image), (2, &image));
        assert_eq!(found.metadata, Map::from_iter([("mean".to_owned(), json!(image.mean()))]));
        assert!((before_ns..=host_ns()).contains(&found.host_ns) && before_ns > 0);
        assert_eq!(fs::metadata(&path).unwrap().len(), bytes);
        live.clear().unwrap();
        assert_eq!(reader.newest("epipolar").unwrap(), None);
        assert_eq!(
            show(&live, "epipolar", &image),
            3,
            "numbers go on, so that nobody takes the new for the old"
        );
        drop(live);
        assert!(!path.exists());
    }

    #[test]
    fn a_name_that_is_seldom_written_outlasts_one_that_often_is() {
        let (_folder, path) = folder();
        let live = LiveFile::with_slots_of(64, &path).unwrap();
        let reader = LiveReader::open(&path).unwrap();
        let rare: Vec<String> = (0..SLOTS - 2).map(|index| format!("rare-{index}")).collect();
        for name in &rare {
            show(&live, name, &flat(7.0, 2, 2));
        }
        for value in 0..100 {
            show(&live, "often", &flat(value as f32, 8, 8));
        }
        assert!(rare.iter().all(|name| reader.newest(name).unwrap().unwrap().image == flat(7.0, 2, 2)));
        assert_eq!(reader.newest("often").unwrap().unwrap().image, flat(99.0, 8, 8));
    }

    #[test]
    fn what_is_too_large_is_averaged_over_blocks() {
        let (_folder, path) = folder();
        let live = LiveFile::with_slots_of(6, &path).unwrap();
        let image = Array2::from_shape_fn((3, 5), |(t, s)| (10 * t + s) as f32).into_dyn();
        show(&live, "large", &image);
        let found = LiveReader::open(&path).unwrap().newest("large").unwrap().unwrap();
        let means = [5.5, 7.5, 9.0, 20.5, 22.5, 24.0];
        assert_eq!(found.image, ArrayD::from_shape_vec(IxDyn(&[2, 3]), means.to_vec()).unwrap());
        assert_eq!(found.metadata["reduced_by"], 2);
    }

    #[test]
    fn what_has_no_place_is_refused_by_name() {
        let (_folder, path) = folder();
        let live = LiveFile::with_slots_of(6, &path).unwrap();
        let try_to = |name: &str, shape: &[usize], metadata: &Map<String, Value>| {
            live.publish(name, ArrayD::zeros(IxDyn(shape)).view(), metadata).unwrap_err().to_string()
        };
        let none = Map::new();
        assert!(try_to("", &[2, 2], &none).contains("1 to 40 bytes"));
        assert!(try_to(&"n".repeat(41), &[2, 2], &none).contains("1 to 40 bytes"));
        assert!(try_to("a", &[2, 0], &none).contains("[2, 0]"));
        assert!(try_to("a", &[1; 5], &none).contains("1 to 4 axes"));
        assert!(try_to("a", &[7, 2, 2], &none).contains("7 planes"));
        let long = Map::from_iter([("note".to_owned(), json!("x".repeat(5000)))]);
        assert!(try_to("a", &[2, 2], &long).contains("metadata of"));
        assert_eq!(LiveReader::open(&path).unwrap().newest("a").unwrap(), None);
    }

    #[test]
    fn a_living_daemons_file_and_what_is_no_live_file_are_left_alone() {
        let (_folder, path) = folder();
        let living = LiveFile::create(&path).unwrap();
        show(&living, "a", &flat(1.0, 1, 1));
        assert!(matches!(LiveFile::create(&path), Err(LiveError::Taken(_))));
        assert!(LiveReader::open(&path).unwrap().newest("a").unwrap().is_some());
        // A daemon that is killed removes nothing.
        let left = fs::read(&path).unwrap();
        drop(living);
        fs::write(&path, left).unwrap();
        let next = LiveFile::create(&path).unwrap();
        assert_eq!(LiveReader::open(&path).unwrap().newest("a").unwrap(), None);
        drop(next);
        fs::write(&path, "precious").unwrap();
        assert!(matches!(LiveFile::create(&path), Err(LiveError::NotLive { .. })));
        assert!(matches!(LiveReader::open(&path), Err(LiveError::Io { .. } | LiveError::NotLive { .. })));
        assert_eq!(fs::read(&path).unwrap(), b"precious");
        assert!(matches!(LiveFile::create(&path.join("no/folder")), Err(LiveError::Io { .. })));
    }

    #[test]
    fn readers_that_race_the_writer_see_whole_images_only() {
        const IMAGES: u64 = 600;
        let (_folder, path) = folder();
        let live = LiveFile::with_slots_of(1 << 14, &path).unwrap();
        show(&live, "image", &flat(0.0, 1, 1));
        let done = AtomicBool::new(false);
        let read = || {
            let reader = LiveReader::open(&path).unwrap();
            let (mut last, mut read) = (0, 0);
            while !done.load(Ordering::Relaxed) {
                match reader.newest("image") {
                    Ok(image) => {
                        let image = image.expect("one is always there");
                        let value = (image.sequence - 1) as f32;
                        assert!(image.image.iter().all(|&pixel| pixel == value), "torn at {value}");
                        assert_eq!(image.metadata["mean"], json!(value));
                        assert!(image.sequence >= last, "older than before");
                        last = image.sequence;
                        read += 1;
                    }
                    Err(error) => assert!(matches!(error, LiveError::Outrun(_)), "{error}"),
                }
            }
            read
        };
        let images: Vec<u64> = std::thread::scope(|scope| {
            let readers = [scope.spawn(read), scope.spawn(read)];
            for value in 1..IMAGES {
                show(&live, "image", &flat(value as f32, 1 + value as usize % 128, 128));
            }
            done.store(true, Ordering::Relaxed);
            readers.into_iter().map(|reader| reader.join().unwrap()).collect()
        });
        assert!(images.iter().all(|&images| images > 0), "{images:?}");
    }

    #[test]
    fn the_layout_that_is_described_is_the_one_that_is_written() {
        let (_folder, path) = folder();
        let live = LiveFile::with_slots_of(64, &path).unwrap();
        show(&live, "n", &flat(2.0, 3, 4));
        let file = fs::read(&path).unwrap();
        let layout = raysweep_proto::describe("").live;
        let number = |fields: &[raysweep_proto::live::LiveField], start: usize, name: &str, index: usize| {
            let field = fields.iter().find(|field| field.name == name).unwrap();
            let bytes: usize = field.dtype[2..].parse().unwrap();
            let at = start + field.offset + index * bytes;
            file[at..at + bytes].iter().rev().fold(0_u64, |number, &byte| number << 8 | u64::from(byte))
        };
        let first = number(&layout.header, 0, "first_slot", 0) as usize;
        assert_eq!(number(&layout.header, 0, "slots", 0), SLOTS as u64);
        assert_eq!(
            first as u64 + SLOTS as u64 * number(&layout.header, 0, "slot_bytes", 0),
            file.len() as u64
        );
        let slot = |name: &str, index: usize| number(&layout.slot, first, name, index) as usize;
        assert_eq!((slot("lock", 0), slot("sequence", 0), slot("ndim", 0)), (2, 1, 2));
        assert_eq!([slot("shape", 0), slot("shape", 1), slot("shape", 2)], [3, 4, 0]);
        let at = slot("data_offset", 0);
        assert!(file[at..at + 48].chunks(4).all(|pixel| pixel == 2.0_f32.to_le_bytes()));
        let at = slot("metadata_offset", 0);
        let metadata = &file[at..at + slot("metadata_bytes", 0)];
        assert_eq!(serde_json::from_slice::<Value>(metadata).unwrap(), json!({ "mean": 2.0 }));
    }
}
