//! Recorded frames in files: finding the files, their formats, and reading frame by frame.

use std::fs::{self, File};
use std::io::{self, BufReader, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

use png::{BitDepth, ColorType};
use raysweep_core::{DeviceError, DeviceErrorKind, NpyHeader, Packing, PixelFormat};

use raysweep_config::rig::replay::{RawPacking, ReplayConfig};

/// Format of the files of a recording.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Kind {
    Raw,
    Npy,
    Png,
}

impl Kind {
    fn of(path: &Path) -> Option<Self> {
        match path.extension()?.to_str()?.to_ascii_lowercase().as_str() {
            "raw" | "bin" | "mraw" => Some(Self::Raw),
            "npy" => Some(Self::Npy),
            "png" => Some(Self::Png),
            _ => None,
        }
    }
}

/// One file of a recording.
#[derive(Debug)]
struct Part {
    path: PathBuf,
    frames: u64,
    /// Offset of its first frame.
    data_at: u64,
}

/// A recording and the reading position.
pub struct Recording {
    kind: Kind,
    parts: Vec<Part>,
    /// Rows and columns.
    size: (usize, usize),
    format: PixelFormat,
    mraw: bool,
    /// The part being read, its file if open, and the number of its frames read.
    part: usize,
    open: Option<File>,
    read: u64,
    packed: Vec<u8>,
    counts: Vec<u16>,
}

fn refused(path: &Path, what: impl std::fmt::Display) -> DeviceError {
    let what = format!("{}: {what}", path.display());
    DeviceError::new("camera", DeviceErrorKind::OutOfRange, what)
}

fn unreadable(path: &Path, error: &io::Error) -> DeviceError {
    let kind = match error.kind() {
        io::ErrorKind::InvalidData | io::ErrorKind::UnexpectedEof => DeviceErrorKind::OutOfRange,
        io::ErrorKind::PermissionDenied => DeviceErrorKind::NotReady,
        _ => DeviceErrorKind::Disconnected,
    };
    let what =
        format!("cannot read {}: {error}: check camera.replay.path, or copy the file again", path.display());
    DeviceError::new("camera", kind, what)
}

impl Recording {
    /// Finds the files and verifies that each is complete.
    pub fn open(config: &ReplayConfig, format: PixelFormat) -> Result<Self, DeviceError> {
        let (kind, paths) = files(&config.path)?;
        let mraw = config.packing == RawPacking::Mraw12;
        if mraw && (kind != Kind::Raw || format.packing != Packing::Bits12) {
            let what = "camera.replay.packing = \"mraw12\" is for raw files and camera.pixel_format = \"Mono12\" or Bayer 12";
            return Err(refused(&config.path, what));
        }
        let unpacked =
            matches!(format.packing, Packing::Bits8 | Packing::Bits10 | Packing::Bits12 | Packing::Bits16);
        if kind != Kind::Raw && !unpacked {
            let what = format!(
                "its numbers are not packed: camera.pixel_format = {format} is; take Mono12 or another without p"
            );
            return Err(refused(&config.path, what));
        }
        let mut size = config.height.zip(config.width);
        let mut parts = Vec::with_capacity(paths.len());
        for path in paths {
            let (part, found) = match kind {
                Kind::Raw => raw_part(path, config, format, mraw)?,
                Kind::Npy => npy_part(path, format)?,
                Kind::Png => png_part(path)?,
            };
            if *size.get_or_insert(found) != found {
                let (rows, columns) = size.unwrap_or_default();
                let what = format!(
                    "{} rows x {} columns, expected {rows} x {columns}: all frames must be of one size",
                    found.0, found.1
                );
                return Err(refused(&part.path, what));
            }
            parts.push(part);
        }
        let size = size.unwrap_or_default();
        let pixels = size.0 * size.1;
        if pixels == 0 {
            return Err(refused(&config.path, "its frames have no pixels"));
        }
        let packed = if mraw { vec![0; mraw_bytes(pixels)] } else { Vec::new() };
        let counts = if mraw { vec![0; pixels] } else { Vec::new() };
        Ok(Self { kind, parts, size, format, mraw, part: 0, open: None, read: 0, packed, counts })
    }

    /// Rows and columns.
    pub fn size(&self) -> (usize, usize) {
        self.size
    }

    /// Total number of frames.
    pub fn frames(&self) -> u64 {
        self.parts.iter().map(|part| part.frames).sum()
    }

    /// Reads the next frame into `out`; `false` after the last.
    pub fn next(&mut self, out: &mut [u8]) -> Result<bool, DeviceError> {
        while self.parts.get(self.part).is_some_and(|part| self.read == part.frames) {
            (self.part, self.open, self.read) = (self.part + 1, None, 0);
        }
        let Some(part) = self.parts.get(self.part) else { return Ok(false) };
        let failed = |error: io::Error| unreadable(&part.path, &error);
        let frame_bytes = self.format.frame_bytes(self.size.0 * self.size.1);
        let Some(out) = out.get_mut(..frame_bytes) else {
            let what = format!("a frame of {frame_bytes} bytes does not fit a buffer of {}", out.len());
            return Err(DeviceError::new("camera", DeviceErrorKind::OutOfRange, what));
        };
        if self.kind == Kind::Png {
            read_png(&part.path, self.size, self.format, out)?;
        } else {
            let mut file = match self.open.take() {
                Some(file) => file,
                None => {
                    let mut file = File::open(&part.path).map_err(failed)?;
                    file.seek(SeekFrom::Start(part.data_at)).map_err(failed)?;
                    file
                }
            };
            if self.mraw {
                file.read_exact(&mut self.packed).map_err(failed)?;
                unpack_mraw(&self.packed, &mut self.counts);
                let packed = self.format.pack_into(&self.counts, out);
                packed.map_err(|error| DeviceError::new("camera", DeviceErrorKind::Protocol, error))?;
            } else {
                file.read_exact(out).map_err(failed)?;
            }
            self.open = Some(file);
        }
        self.read += 1;
        Ok(true)
    }
}

/// The files of a recording, in order, and their format.
fn files(path: &Path) -> Result<(Kind, Vec<PathBuf>), DeviceError> {
    if !path.is_dir() {
        // A single file with any other extension is raw.
        return Ok((Kind::of(path).unwrap_or(Kind::Raw), vec![path.to_owned()]));
    }
    let entries = fs::read_dir(path).and_then(Iterator::collect::<io::Result<Vec<_>>>);
    let entries = entries.map_err(|error| unreadable(path, &error))?;
    let mut found: Vec<(Kind, PathBuf)> =
        entries.into_iter().filter_map(|entry| Some((Kind::of(&entry.path())?, entry.path()))).collect();
    let Some(&(kind, _)) = found.first() else {
        return Err(refused(path, "no .raw, .bin, .mraw, .npy or .png file is in this folder"));
    };
    if found.iter().any(|(other, _)| *other != kind) {
        return Err(refused(
            path,
            "this folder holds frames of several kinds: keep one of raw, .npy and .png",
        ));
    }
    found.sort_by_cached_key(|(_, path)| natural(&path.file_name().unwrap_or_default().to_string_lossy()));
    Ok((kind, found.into_iter().map(|(_, path)| path).collect()))
}

/// Splits a name into text and numbers, so that `frame10` sorts after `frame9`.
fn natural(name: &str) -> Vec<(String, u64)> {
    let mut parts = vec![(String::new(), 0_u64)];
    let mut in_number = false;
    for c in name.chars() {
        if let Some(digit) = c.to_digit(10) {
            in_number = true;
            if let Some((_, number)) = parts.last_mut() {
                *number = number.saturating_mul(10).saturating_add(digit.into());
            }
            continue;
        }
        if in_number {
            parts.push((String::new(), 0));
            in_number = false;
        }
        if let Some((text, _)) = parts.last_mut() {
            text.push(c);
        }
    }
    parts
}

type Found = (Part, (usize, usize));

fn raw_part(
    path: PathBuf,
    config: &ReplayConfig,
    format: PixelFormat,
    mraw: bool,
) -> Result<Found, DeviceError> {
    let Some((rows, columns)) = config.height.zip(config.width) else {
        return Err(refused(&path, "raw frames do not say their size: give camera.replay.width and height"));
    };
    let pixels = rows.saturating_mul(columns);
    let frame_bytes = if mraw { mraw_bytes(pixels) } else { format.frame_bytes(pixels) } as u64;
    let bytes = fs::metadata(&path).map_err(|error| unreadable(&path, &error))?.len();
    let data_bytes = bytes.saturating_sub(config.header_bytes);
    let frames = data_bytes.checked_div(frame_bytes).unwrap_or(0);
    if frames == 0 || frames * frame_bytes != data_bytes {
        let what = format!(
            "{bytes} bytes are {} of header, {frames} frames of {frame_bytes} bytes and {} more: it is cut short, or camera.pixel_format, camera.replay.width, height, packing or header_bytes are others",
            config.header_bytes.min(bytes),
            data_bytes - frames * frame_bytes
        );
        return Err(refused(&path, what));
    }
    Ok((Part { path, frames, data_at: config.header_bytes }, (rows, columns)))
}

fn npy_part(path: PathBuf, format: PixelFormat) -> Result<Found, DeviceError> {
    let file = File::open(&path).map_err(|error| unreadable(&path, &error))?;
    let bytes = file.metadata().map_err(|error| unreadable(&path, &error))?.len();
    let header = NpyHeader::read(BufReader::new(file)).map_err(|error| unreadable(&path, &error))?;
    let dtypes: &[&str] = if format.packing == Packing::Bits8 { &["|u1", "<u1", "u1"] } else { &["<u2"] };
    if !dtypes.contains(&header.dtype.as_str()) {
        let what = format!(
            "its elements are {}, those of camera.pixel_format = {format} are {}: save it so, or name another pixel format",
            header.dtype, dtypes[0]
        );
        return Err(refused(&path, what));
    }
    let (frames, rows, columns) = match *header.shape.as_slice() {
        [frames, rows, columns] => (frames, rows, columns),
        [rows, columns] => (1, rows, columns),
        _ => {
            let what = format!(
                "its shape is {:?}: [frames, rows, columns] or [rows, columns] is needed",
                header.shape
            );
            return Err(refused(&path, what));
        }
    };
    let pixels = rows.checked_mul(columns).and_then(|pixels| pixels.checked_mul(frames));
    let data_bytes =
        pixels.and_then(|pixels| pixels.checked_mul(if format.packing == Packing::Bits8 { 1 } else { 2 }));
    let needed = data_bytes.map_or(u64::MAX, |data| header.data_at.saturating_add(data as u64));
    if bytes < needed {
        let what = format!(
            "its header says {:?}, {needed} bytes, it has {bytes}: it is cut short; copy it again",
            header.shape
        );
        return Err(refused(&path, what));
    }
    Ok((Part { path, frames: frames as u64, data_at: header.data_at }, (rows, columns)))
}

fn decoder(path: &Path) -> Result<png::Reader<BufReader<File>>, DeviceError> {
    let file = File::open(path).map_err(|error| unreadable(path, &error))?;
    png::Decoder::new(BufReader::new(file))
        .read_info()
        .map_err(|error| refused(path, format!("no sound PNG picture: {error}: copy it again")))
}

fn png_part(path: PathBuf) -> Result<Found, DeviceError> {
    let reader = decoder(&path)?;
    let size = (reader.info().height as usize, reader.info().width as usize);
    Ok((Part { path, frames: 1, data_at: 0 }, size))
}

fn read_png(
    path: &Path,
    size: (usize, usize),
    format: PixelFormat,
    out: &mut [u8],
) -> Result<(), DeviceError> {
    let mut reader = decoder(path)?;
    let wanted = if format.packing == Packing::Bits8 { BitDepth::Eight } else { BitDepth::Sixteen };
    let info = reader.info();
    if (info.color_type, info.bit_depth) != (ColorType::Grayscale, wanted) {
        let what = format!(
            "a {:?} picture of {:?} bits: camera.pixel_format = {format} needs Grayscale of {wanted:?}",
            info.color_type, info.bit_depth
        );
        return Err(refused(path, what));
    }
    if (info.height as usize, info.width as usize) != size {
        return Err(refused(path, "its size has changed since the recording was opened"));
    }
    reader.next_frame(out).map_err(|error| refused(path, format!("it is cut short or damaged: {error}")))?;
    if wanted == BitDepth::Sixteen {
        // PNG stores the high byte first.
        out.as_chunks_mut::<2>().0.iter_mut().for_each(|bytes| bytes.swap(0, 1));
    }
    let most = format.max_value();
    let beyond = wanted == BitDepth::Sixteen
        && out.as_chunks::<2>().0.iter().any(|bytes| u16::from_le_bytes(*bytes) > most);
    if beyond {
        let what = format!(
            "it holds more than {most}, the most of camera.pixel_format = {format}: name the format with its bits"
        );
        return Err(refused(path, what));
    }
    Ok(())
}

fn mraw_bytes(pixels: usize) -> usize {
    pixels.div_ceil(2) * 3
}

/// Two pixels in three bytes, most significant bits first.
fn unpack_mraw(bytes: &[u8], counts: &mut [u16]) {
    for (bytes, counts) in bytes.as_chunks::<3>().0.iter().zip(counts.chunks_mut(2)) {
        let [first, middle, last] = bytes.map(u16::from);
        let pair = [first << 4 | middle >> 4, (middle & 0x0F) << 8 | last];
        counts.iter_mut().zip(pair).for_each(|(count, value)| *count = value);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_ordered_by_their_numbers() {
        let mut names = ["f10.raw", "f9.raw", "f09b.raw", "e100.raw", "f1_2.raw", "f1_11.raw"];
        names.sort_by_cached_key(|name| natural(name));
        assert_eq!(names, ["e100.raw", "f1_2.raw", "f1_11.raw", "f9.raw", "f09b.raw", "f10.raw"]);
    }

    #[test]
    fn mraw_is_most_significant_bits_first() {
        let mut counts = [0; 3];
        unpack_mraw(&[0xAB, 0xC1, 0x23, 0x45, 0x60, 0x00], &mut counts);
        assert_eq!(counts, [0xABC, 0x123, 0x456]);
    }
}
