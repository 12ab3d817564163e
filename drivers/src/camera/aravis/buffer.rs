//! What libaravis has of a frame, without the copies and allocations of its Rust bindings.

#![allow(unsafe_code, reason = "the bindings copy each image twice and allocate for each chunk")]

use std::ffi::CStr;

use aravis::glib::translate::ToGlibPtr;
use aravis::{Buffer, ChunkParser};

/// The image of a frame, where it lies.
///
/// Benefit: `Buffer::image_data` of the bindings allocates and copies each frame: 1.9 MB at 1024 x 1024 Mono12p.
pub fn image_data(buffer: &Buffer) -> &[u8] {
    let mut size = 0;
    // SAFETY: the pointer and size describe memory that the buffer owns, and null or 0 where it has no image. While it is
    // borrowed the buffer is not in a stream, so that nobody writes to it, and it outlives the slice.
    unsafe {
        let data = aravis_sys::arv_buffer_get_image_data(buffer.to_glib_none().0, &mut size);
        if data.is_null() { &[] } else { std::slice::from_raw_parts(data, size) }
    }
}

/// A number of a frame's chunk data, where it has it.
///
/// Benefit: `ChunkParser::float_value` of the bindings allocates the name anew for each frame.
pub fn chunk_float(parser: &ChunkParser, buffer: &Buffer, name: &CStr) -> Option<f64> {
    let mut error = std::ptr::null_mut();
    // SAFETY: parser, buffer and name live through the call, which keeps none of them; the error, if there is one, is
    // ours to free.
    unsafe {
        let value = aravis_sys::arv_chunk_parser_get_float_value(
            parser.to_glib_none().0,
            buffer.to_glib_none().0,
            name.as_ptr(),
            &mut error,
        );
        if error.is_null() {
            return Some(value);
        }
        drop::<aravis::glib::Error>(aravis::glib::translate::from_glib_full(error));
    }
    None
}
