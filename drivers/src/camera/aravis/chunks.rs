//! Chunk data, the metadata in frames, read without the allocations of libaravis' Rust bindings.

#![allow(unsafe_code, reason = "the bindings allocate each chunk's name anew for each frame")]

use std::ffi::CStr;

use aravis::glib::translate::{ToGlibPtr, from_glib_full};
use aravis::{Buffer, ChunkParser, glib};

use super::frames::behind_image;
use super::setup::ChunksOn;

const EXPOSURE_TIME: &CStr = c"ChunkExposureTime";
const SEQUENCER_SET_ACTIVE: &CStr = c"ChunkSequencerSetActive";

/// Reads the chunk data that a camera sends.
pub struct Chunks {
    parser: ChunkParser,
    on: ChunksOn,
    /// The latest chunk data and the values parsed from them.
    bytes: Vec<u8>,
    said: Said,
}

/// Metadata of a frame.
#[derive(Debug, Clone, Copy, Default)]
pub struct Said {
    /// Its exposure time.
    pub exposure_us: Option<f64>,
    /// Its sequencer set.
    pub sequencer_set: Option<i64>,
}

/// Longer chunk data are not cached.
const MOST_BYTES: usize = 256;

impl Chunks {
    /// `parser` must belong to the camera whose frames are read.
    pub fn new(parser: ChunkParser, on: ChunksOn) -> Self {
        Self { parser, on, bytes: Vec::with_capacity(MOST_BYTES), said: Said::default() }
    }

    /// Reads the chunk data after the `image_bytes` of a frame's image. If they equal those of the previous frame,
    /// they are not parsed again; parsing would take a tenth of the processor time of a small frame.
    pub fn read(&mut self, buffer: &Buffer, image_bytes: usize) -> Said {
        let bytes = behind_image(buffer, image_bytes);
        if bytes.is_empty() || bytes != self.bytes {
            let exposure = self.on.exposure.then_some(EXPOSURE_TIME);
            let set = self.on.sequencer_set.then_some(SEQUENCER_SET_ACTIVE);
            self.said = Said {
                exposure_us: exposure
                    .and_then(|name| self.parse(buffer, name, aravis_sys::arv_chunk_parser_get_float_value)),
                sequencer_set: set.and_then(|name| {
                    self.parse(buffer, name, aravis_sys::arv_chunk_parser_get_integer_value)
                }),
            };
            self.bytes.clear();
            self.bytes.extend_from_slice(if bytes.len() > MOST_BYTES { &[] } else { bytes });
        }
        self.said
    }

    /// A number in a frame's chunk data, if it is there.
    ///
    /// Benefit: the bindings' functions allocate the name for each frame.
    fn parse<T>(&self, buffer: &Buffer, name: &CStr, reader: Reader<T>) -> Option<T> {
        let mut error = std::ptr::null_mut();
        // SAFETY: parser, buffer and name outlive the call, which keeps none of them; the error, if there is one, is
        // ours to free.
        unsafe {
            let value =
                reader(self.parser.to_glib_none().0, buffer.to_glib_none().0, name.as_ptr(), &mut error);
            if error.is_null() {
                return Some(value);
            }
            drop::<glib::Error>(from_glib_full(error));
        }
        None
    }
}

/// A function of libaravis that reads a number from chunk data.
type Reader<T> = unsafe extern "C" fn(
    *mut aravis_sys::ArvChunkParser,
    *mut aravis_sys::ArvBuffer,
    *const std::ffi::c_char,
    *mut *mut glib::ffi::GError,
) -> T;
