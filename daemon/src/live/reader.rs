//! Reads the live file; clients in other languages can be written in the same way.

use std::collections::BTreeMap;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::thread;

use crc32fast::Hasher;
use ndarray::ArrayD;
use raysweep_proto::live::{DTYPE, HEADER_BYTES, MAGIC, MAX_AXES, SLOT_HEADER_BYTES, VERSION};
use raysweep_session::input;
use serde_json::{Map, Value};

use super::LiveError;

/// Attempts at reading an image that is being overwritten.
const ATTEMPTS: usize = 100;

/// A published image.
#[derive(Debug, Clone, PartialEq)]
pub struct LiveImage {
    /// Sequence number among all images of the file.
    pub sequence: u64,
    /// When it was written, on `CLOCK_MONOTONIC`.
    pub host_ns: i64,
    /// Its pixels, usually `[t, s]`.
    pub image: ArrayD<f32>,
    /// Metadata from its publisher.
    pub metadata: Map<String, Value>,
}

/// Reads a live file.
pub struct LiveReader {
    path: PathBuf,
    file: File,
    slots: u64,
    first_slot: u64,
    slot_bytes: u64,
}

/// A slot's header.
type Header = [u8; SLOT_HEADER_BYTES];

impl LiveReader {
    /// Opens a live file.
    ///
    /// # Errors
    /// [`LiveError::Io`] if the file cannot be read, [`LiveError::NotLive`] if it has another layout.
    pub fn open(path: &Path) -> Result<Self, LiveError> {
        let file = input::open(path, u64::MAX).map_err(LiveError::io("open", path))?;
        let mut header = [0; HEADER_BYTES];
        file.read_exact_at(&mut header, 0).map_err(LiveError::io("read", path))?;
        let not_live = |why: String| LiveError::NotLive { path: path.to_owned(), why };
        let version = u32_at(&header, 8);
        if header[..8] != MAGIC || version != VERSION {
            return Err(not_live(format!(
                "it begins with {:?}, version {version}; this raysweep reads version {VERSION}",
                String::from_utf8_lossy(&header[..8])
            )));
        }
        let slots = u64::from(u32_at(&header, 12));
        let (first_slot, slot_bytes) = (u64_at(&header, 16), u64_at(&header, 24));
        let file_bytes = file.metadata().map_err(LiveError::io("examine", path))?.len();
        let end = slots.checked_mul(slot_bytes).and_then(|bytes| bytes.checked_add(first_slot));
        if slot_bytes < SLOT_HEADER_BYTES as u64 || end.is_none_or(|end| end > file_bytes) {
            return Err(not_live(format!(
                "its {slots} slots of {slot_bytes} bytes after byte {first_slot} do not fit into its {file_bytes} bytes"
            )));
        }
        Ok(Self { path: path.to_owned(), file, slots, first_slot, slot_bytes })
    }

    /// The newest image of a name, if there is one.
    ///
    /// # Errors
    /// [`LiveError::Io`], [`LiveError::NotLive`], and [`LiveError::Outrun`] if it was overwritten in every attempt.
    pub fn newest(&self, name: &str) -> Result<Option<LiveImage>, LiveError> {
        for _ in 0..ATTEMPTS {
            let mut newest: Option<(u64, Header)> = None;
            for slot in 0..self.slots {
                let at = self.first_slot + slot * self.slot_bytes;
                let header = self.header(at)?;
                let whole = u64_at(&header, 0).is_multiple_of(2) && name_of(&header) == name.as_bytes();
                let sequence = newest.as_ref().map_or(0, |(_, newest)| u64_at(newest, 8));
                if whole && u64_at(&header, 8) > sequence {
                    newest = Some((at, header));
                }
            }
            let Some((at, header)) = newest else { return Ok(None) };
            let image = self.image(at, &header);
            if self.header(at)? == header
                && let Some(image) = image?
            {
                return Ok(Some(image));
            }
            thread::yield_now();
        }
        Err(LiveError::Outrun(self.path.clone()))
    }

    /// The names in the file, each with the sequence number of its newest image.
    ///
    /// # Errors
    /// [`LiveError::Io`].
    pub fn names(&self) -> Result<BTreeMap<String, u64>, LiveError> {
        let mut names = BTreeMap::new();
        for slot in 0..self.slots {
            let header = self.header(self.first_slot + slot * self.slot_bytes)?;
            let (sequence, name) = (u64_at(&header, 8), String::from_utf8_lossy(name_of(&header)));
            if u64_at(&header, 0).is_multiple_of(2) && sequence > 0 {
                let newest = names.entry(name.into_owned()).or_insert(0);
                *newest = sequence.max(*newest);
            }
        }
        Ok(names)
    }

    fn header(&self, at: u64) -> Result<Header, LiveError> {
        let mut header = [0; SLOT_HEADER_BYTES];
        self.file.read_exact_at(&mut header, at).map_err(LiveError::io("read", &self.path))?;
        Ok(header)
    }

    /// The image that belongs to a header; `None` if its checksum does not match.
    fn image(&self, at: u64, header: &Header) -> Result<Option<LiveImage>, LiveError> {
        let not_live = |why: &str| LiveError::NotLive { path: self.path.clone(), why: why.into() };
        let read = |from: u64, bytes: usize| {
            let inside = from >= at && from.saturating_add(bytes as u64) <= at + self.slot_bytes;
            let mut buffer = vec![0; if inside { bytes } else { 0 }];
            self.file.read_exact_at(&mut buffer, from).map_err(LiveError::io("read", &self.path))?;
            if inside { Ok(buffer) } else { Err(not_live("an image lies outside of its slot")) }
        };
        let axes = u32_at(header, 52) as usize;
        if header[48..52] != DTYPE || axes > MAX_AXES {
            return Err(not_live("an image has an unknown type"));
        }
        let shape: Vec<usize> = (0..axes).map(|axis| u64_at(header, 56 + 8 * axis) as usize).collect();
        let pixels = shape.iter().try_fold(size_of::<f32>(), |bytes, &len| bytes.checked_mul(len));
        let metadata = read(u64_at(header, 32), u32_at(header, 40) as usize)?;
        let pixels = read(u64_at(header, 24), pixels.unwrap_or(usize::MAX))?;
        let mut checksum = Hasher::new();
        checksum.update(&metadata);
        checksum.update(&pixels);
        if checksum.finalize() != u32_at(header, 44) {
            return Ok(None);
        }
        let values =
            pixels.chunks_exact(4).map(|bytes| f32::from_le_bytes([bytes[0], bytes[1], bytes[2], bytes[3]]));
        let image =
            ArrayD::from_shape_vec(shape, values.collect()).map_err(|error| not_live(&error.to_string()))?;
        let metadata = serde_json::from_slice(&metadata).map_err(|error| not_live(&error.to_string()))?;
        let host_ns = i64::from_le_bytes(eight(header, 16));
        Ok(Some(LiveImage { sequence: u64_at(header, 8), host_ns, image, metadata }))
    }
}

fn name_of(header: &Header) -> &[u8] {
    let name = &header[88..];
    &name[..name.iter().position(|&byte| byte == 0).unwrap_or(name.len())]
}

fn eight(header: &[u8], offset: usize) -> [u8; 8] {
    std::array::from_fn(|byte| header[offset + byte])
}

fn u64_at(header: &[u8], offset: usize) -> u64 {
    u64::from_le_bytes(eight(header, offset))
}

fn u32_at(header: &[u8], offset: usize) -> u32 {
    u32::from_le_bytes(std::array::from_fn(|byte| header[offset + byte]))
}
