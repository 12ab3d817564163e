//! The stream of frames, received in memory that goes to the pool without copying.
//!
//! Benefit: copying 1.5 MB that was in the cache of the receiving thread took half as much processor time as
//! receiving it (245 of 520 us per frame, 1024 x 1024 Mono12p).

#![allow(
    unsafe_code,
    reason = "libaravis writes into memory that is lent to it, which its bindings do not allow"
)]

use std::ffi::c_void;
use std::num::NonZeroUsize;
use std::ptr::NonNull;

use aravis::glib::translate::{ToGlibPtr, from_glib_full};
use aravis::prelude::*;
use aravis::{Buffer, Stream};
use raysweep_core::FrameBuf;

/// Minimum number of receive buffers: half a second at 60 frames/s.
const FEWEST: usize = 32;
/// Memory for receive buffers: libaravis waits 100 ms for missing packets and holds back all later frames.
const MEMORY_BYTES: usize = 64 << 20;
pub const MOST_BUFFERS: usize = 128;
/// Maximum number of buffers that wait for their memory to come back from the pool.
const MOST_IDLE: usize = 128;

/// A stream and the memory that it writes to.
pub struct Frames {
    // Dropped first: this ends its thread, so nothing writes to the memory any more.
    stream: Stream,
    lent: Lent,
    /// The library's buffers whose memory is in the pool, each with the address of that memory. Querying the buffers
    /// instead would load each of them into the cache for every frame.
    idle: Vec<(NonZeroUsize, Buffer)>,
    payload_bytes: usize,
}

/// Memory that the stream may write to: each piece was a box and has no other owner.
struct Lent(Vec<NonNull<[u8]>>);

// SAFETY: the pieces are owned exclusively, like the boxes that they were.
unsafe impl Send for Lent {}

impl Frames {
    /// Gives a stream buffers for frames of `payload_bytes`, in pieces of at least `memory_bytes`.
    pub fn new(stream: Stream, payload_bytes: usize, memory_bytes: usize) -> Self {
        let buffers = (MEMORY_BYTES / payload_bytes.max(1)).clamp(FEWEST, MOST_BUFFERS);
        let lent = Lent(Vec::with_capacity(buffers));
        let mut frames = Self { stream, lent, idle: Vec::with_capacity(MOST_IDLE), payload_bytes };
        for _ in 0..buffers {
            // Not zeros: the kernel would allocate their pages only when the first frames arrive.
            frames.lend(vec![u8::MAX; memory_bytes.max(payload_bytes)].into());
        }
        frames
    }

    /// Number of buffers.
    pub fn buffers(&self) -> usize {
        self.lent.0.len()
    }

    /// Whether no buffer is free.
    pub fn is_full(&self) -> bool {
        self.stream.n_buffers().0 == 0
    }

    /// The next frame, complete or not; must be passed to `give_back` or `take`.
    pub fn pop(&self, timeout_us: u64) -> Option<Buffer> {
        self.stream.timeout_pop_buffer(timeout_us)
    }

    /// Returns the buffer of an unneeded frame to the stream.
    pub fn give_back(&self, buffer: Buffer) {
        self.stream.push_buffer(buffer);
    }

    /// Discards all received frames.
    pub fn drain(&self) {
        while let Some(buffer) = self.stream.try_pop_buffer() {
            self.give_back(buffer);
        }
    }

    /// Puts a frame's image into `buf`, which is not longer than it. Exchanges the memory if `buf` has as much as the
    /// frame, otherwise copies.
    pub fn take(&mut self, buffer: Buffer, buf: &mut FrameBuf) {
        let image = image_data(&buffer);
        let at = address(&buffer);
        let place = self.lent.0.iter().position(|lent| lent.cast() == at);
        if let Some(place) = place.filter(|_| image.as_ptr() == at.as_ptr()) {
            // SAFETY: it was a box, see `lend`, and the buffer is not in the stream, so nobody else uses it.
            let memory = unsafe { Box::from_raw(self.lent.0.swap_remove(place).as_ptr()) };
            match buf.exchange(memory) {
                Ok(memory) => {
                    if self.idle.len() == MOST_IDLE {
                        self.idle.clear();
                    }
                    self.idle.push((at.addr(), buffer));
                    self.lend(memory);
                    return;
                }
                Err(memory) => self.lent.0.push(NonNull::from(Box::leak(memory))),
            }
        }
        let bytes = buf.len();
        buf.copy_from_slice(&image_data(&buffer)[..bytes]);
        self.give_back(buffer);
    }

    /// Gives the stream a piece of memory of at least `payload_bytes`.
    fn lend(&mut self, memory: Box<[u8]>) {
        let memory = NonNull::from(Box::leak(memory));
        self.lent.0.push(memory);
        let at = memory.cast::<u8>();
        // All pieces have the same length, so the buffer of any earlier piece at this address fits.
        let known = self.idle.iter().position(|(idle_at, _)| *idle_at == at.addr());
        let buffer = match known {
            Some(place) => self.idle.swap_remove(place).1,
            // SAFETY: the memory has `payload_bytes` and lives as long as it is in `lent`; memory that is not in
            // `lent` is never given to the stream.
            None => unsafe {
                let at = at.as_ptr().cast::<c_void>();
                from_glib_full(aravis_sys::arv_buffer_new(self.payload_bytes, at))
            },
        };
        self.stream.push_buffer(buffer);
    }
}

impl Drop for Lent {
    fn drop(&mut self) {
        for memory in self.0.drain(..) {
            // SAFETY: it was a box, see `Frames::lend`, and the stream that wrote to it is gone, with its thread.
            drop(unsafe { Box::from_raw(memory.as_ptr()) });
        }
    }
}

/// The bytes after the first `image_bytes` of a popped frame; libaravis considers them part of the image.
pub fn behind_image(buffer: &Buffer, image_bytes: usize) -> &[u8] {
    let mut size = 0;
    // SAFETY: as for `image_data`, for all received bytes.
    let data = unsafe {
        let data = aravis_sys::arv_buffer_get_data(buffer.to_glib_none().0, &mut size);
        if data.is_null() { &[] } else { std::slice::from_raw_parts(data, size) }
    };
    data.get(image_bytes..).unwrap_or_default()
}

/// Start address of a buffer's memory.
fn address(buffer: &Buffer) -> NonNull<u8> {
    let mut size = 0;
    // SAFETY: the buffer outlives the call; the address is compared, not dereferenced.
    let at = unsafe { aravis_sys::arv_buffer_get_data(buffer.to_glib_none().0, &mut size) };
    NonNull::new(at).unwrap_or(NonNull::dangling())
}

/// The image of a popped frame, in place.
///
/// Benefit: `Buffer::image_data` of the bindings allocates and copies each frame: 1.9 MB at 1024 x 1024 Mono12p.
pub fn image_data(buffer: &Buffer) -> &[u8] {
    let mut size = 0;
    // SAFETY: pointer and size describe memory that is lent to the buffer, or are null or 0 if it has no image. While
    // the buffer is borrowed it is not in a stream, so nobody writes to it.
    unsafe {
        let data = aravis_sys::arv_buffer_get_image_data(buffer.to_glib_none().0, &mut size);
        if data.is_null() { &[] } else { std::slice::from_raw_parts(data, size) }
    }
}
