//! Writes the live file. Its layout is in [`raysweep_proto::live`].

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
use raysweep_session::input;
use serde_json::{Map, Value, json};

use super::LiveError;

/// All may read: observers see live what a run does. Sessions are for members of the group.
const MODE: u32 = 0o644;
/// Slots of the file: it can hold one name less than this at once.
const SLOTS: usize = 8;
/// Pixels per slot; larger images are downsampled.
const SLOT_PIXELS: usize = 1 << 20;
/// Offset of the first slot: one page, so that slots can be mapped one by one.
const FIRST_SLOT: u64 = 4096;

/// A file of fixed size with the newest image of each name. Written with plain positioned writes: in the page cache,
/// readers and mappings see them at once. Removed when dropped.
pub struct LiveFile {
    path: PathBuf,
    file: File,
    slot_pixels: usize,
    /// Held while an image is copied into the page cache: only worker threads publish, never device threads.
    slots: Mutex<Slots>,
}

#[derive(Default)]
struct Slots {
    /// Images published so far.
    sequence: u64,
    /// Contents of each slot: lock value, sequence number of the image (0: none), and name.
    held: [Held; SLOTS],
    /// Buffer for the metadata and pixels to write.
    bytes: Vec<u8>,
}

#[derive(Default)]
struct Held {
    lock: u64,
    sequence: u64,
    name: String,
}

impl Slots {
    /// The slot to write next: the oldest that is not the newest of its name, so that readers of any name have the
    /// time of a whole image; with more names than slots, the oldest of all.
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
    /// Creates the file, readable for all. A file left by a dead daemon is replaced.
    ///
    /// # Errors
    /// [`LiveError::Taken`], [`LiveError::NotLive`] if something else has this name, [`LiveError::Io`].
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
        // Clients are told the path, and work in other folders.
        let path = std::path::absolute(path).map_err(failed())?;
        let live = Self { path, file, slot_pixels, slots: Mutex::new(Slots::default()) };
        // The lock shows the next daemon that this one is alive; the mode must not depend on the umask.
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

    /// Path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    fn slot_bytes(&self) -> u64 {
        (SLOT_HEADER_BYTES + METADATA_BYTES + self.slot_pixels * size_of::<f32>()) as u64
    }

    fn offset_of(&self, slot: usize) -> u64 {
        FIRST_SLOT + slot as u64 * self.slot_bytes()
    }

    /// The side of the blocks of pixels over which an image of this shape is averaged to fit into a slot.
    pub fn reduction(&self, shape: &[usize]) -> usize {
        reduction(shape, self.slot_pixels)
    }

    /// Publishes an image of one to four axes, the last two of which are rows and columns, under a name; returns its
    /// sequence number. Never waits for readers. An image that is too large for a slot is averaged over blocks of
    /// rows and columns; the metadata then have `reduced_by`, the side of the blocks in pixels.
    ///
    /// # Errors
    /// [`LiveError::Refused`] for a name, metadata or shape that does not fit into the file; [`LiveError::Io`].
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
                "metadata of {} bytes: at most {METADATA_BYTES} are allowed",
                metadata.len()
            )));
        }

        let mut slots = self.slots.lock().unwrap_or_else(PoisonError::into_inner);
        slots.bytes.resize(METADATA_BYTES + size_of::<f32>() * image.len(), 0);
        let (head, bytes) = slots.bytes.split_at_mut(METADATA_BYTES);
        head.fill(0);
        head[..metadata.len()].copy_from_slice(metadata.as_bytes());
        let image = image.as_standard_layout();
        let pixels = bytes.chunks_exact_mut(size_of::<f32>()).zip(image.as_slice().unwrap_or_default());
        pixels.for_each(|(bytes, pixel)| bytes.copy_from_slice(&pixel.to_le_bytes()));
        let (index, sequence) = (slots.next(), slots.sequence + 1);
        let held = Held { lock: slots.held[index].lock + 2, sequence, name: name.into() };
        let header = header(&held, image.shape(), metadata.len(), &slots.bytes, self.offset_of(index));
        self.write_slot(index, &header, &slots.bytes).map_err(LiveError::io("write", &self.path))?;
        slots.sequence = sequence;
        slots.held[index] = held;
        Ok(sequence)
    }

    /// Removes all images, which belong to an earlier run.
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

    /// Readers rely on this order: lock odd, contents, lock even.
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

/// Removes the file of a dead daemon.
fn remove_stale(path: &Path) -> Result<(), LiveError> {
    let failed = || LiveError::io("replace", path);
    match fs::symlink_metadata(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
        Err(error) => return Err(failed()(error)),
        Ok(metadata) if !metadata.is_file() => {
            let why = "it is not a regular file; remove it, or choose another --live".into();
            return Err(LiveError::NotLive { path: path.to_owned(), why });
        }
        Ok(_) => {}
    }
    let mut file = input::open_itself(path, u64::MAX).map_err(failed())?;
    let mut magic = [0; MAGIC.len()];
    if file.read_exact(&mut magic).is_err() || magic != MAGIC {
        let why = "it does not begin like one; remove it, or choose another --live".into();
        return Err(LiveError::NotLive { path: path.to_owned(), why });
    }
    match file.try_lock() {
        Ok(()) => fs::remove_file(path).map_err(failed()),
        Err(TryLockError::WouldBlock) => Err(LiveError::Taken(path.to_owned())),
        Err(TryLockError::Error(error)) => Err(failed()(error)),
    }
}

/// The header of a slot that holds an image of this shape; `bytes` are metadata, padding and pixels, `at` is where the
/// slot starts.
fn header(
    held: &Held,
    shape: &[usize],
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
    put(0, &held.lock.to_le_bytes());
    put(8, &held.sequence.to_le_bytes());
    put(16, &host_ns().to_le_bytes());
    put(24, &(metadata_at + METADATA_BYTES as u64).to_le_bytes());
    put(32, &metadata_at.to_le_bytes());
    put(40, &(metadata_bytes as u32).to_le_bytes());
    put(44, &checksum.finalize().to_le_bytes());
    put(48, &DTYPE);
    put(52, &(shape.len() as u32).to_le_bytes());
    shape.iter().enumerate().for_each(|(axis, &len)| put(56 + 8 * axis, &(len as u64).to_le_bytes()));
    put(88, held.name.as_bytes());
    header
}

/// The side of the blocks that an image must be averaged over to have at most `pixels` pixels.
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

/// `CLOCK_MONOTONIC`, the clock of the frames' timestamps; 0 if the system has none.
fn host_ns() -> i64 {
    clock_gettime(ClockId::CLOCK_MONOTONIC).map_or(0, |now| now.tv_sec() * 1_000_000_000 + now.tv_nsec())
}

#[cfg(test)]
mod tests;
