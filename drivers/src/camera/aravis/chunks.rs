//! What frames say of themselves: chunk data, read without the allocations of libaravis' Rust bindings.

#![allow(unsafe_code, reason = "the bindings allocate each chunk's name anew for each frame")]

use std::ffi::CStr;

use aravis::glib::translate::{ToGlibPtr, from_glib_full};
use aravis::{Buffer, ChunkParser, glib};

use super::setup::ChunksOn;

const EXPOSURE_TIME: &CStr = c"ChunkExposureTime";
const SEQUENCER_SET_ACTIVE: &CStr = c"ChunkSequencerSetActive";

/// Reads the chunk data that a camera sends.
pub struct Chunks {
    parser: ChunkParser,
    on: ChunksOn,
}

impl Chunks {
    /// `parser` must be of the camera whose frames are read.
    pub fn new(parser: ChunkParser, on: ChunksOn) -> Self {
        Self { parser, on }
    }

    /// The exposure of a frame.
    pub fn exposure_us(&self, buffer: &Buffer) -> Option<f64> {
        if self.on.exposure {
            self.read(buffer, EXPOSURE_TIME, aravis_sys::arv_chunk_parser_get_float_value)
        } else {
            None
        }
    }

    /// The set of the camera's sequencer that a frame had.
    pub fn sequencer_set(&self, buffer: &Buffer) -> Option<i64> {
        if self.on.sequencer_set {
            self.read(buffer, SEQUENCER_SET_ACTIVE, aravis_sys::arv_chunk_parser_get_integer_value)
        } else {
            None
        }
    }

    /// A number of a frame's chunk data, where it has it.
    ///
    /// Benefit: the readers of the bindings allocate the name anew for each frame.
    fn read<T>(&self, buffer: &Buffer, name: &CStr, reader: Reader<T>) -> Option<T> {
        let mut error = std::ptr::null_mut();
        // SAFETY: parser, buffer and name live through the call, which keeps none of them; the error, if there is one, is
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
