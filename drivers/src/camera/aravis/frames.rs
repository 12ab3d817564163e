//! The stream of frames, received in memory that goes to the pool as it is: no frame is copied.
//!
//! Benefit: a copy of 1.5 MB, which the thread that received it has in its own cache, took half as much processor time
//! as receiving it did (245 of 520 us a frame, 1024 x 1024 Mono12p).

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

/// Fewest buffers that frames arrive in: half a second at 60 frames/s.
const FEWEST: usize = 32;
/// As many as lie in so much memory: libaravis waits 100 ms for packets that are missing, and keeps all frames behind.
const MEMORY_BYTES: usize = 64 << 20;
pub const MOST_BUFFERS: usize = 128;
/// Buffers that wait for their memory to come back from the pool.
const MOST_IDLE: usize = 128;

/// A stream and the memory that it writes to.
pub struct Frames {
    // Dropped first: its thread ends, and nobody writes any more.
    stream: Stream,
    lent: Lent,
    /// Buffers of the library whose memory is the pool's at present, each with the address of that memory: asking all of
    /// them for it would fetch each from memory anew, frame by frame.
    idle: Vec<(NonZeroUsize, Buffer)>,
    payload_bytes: usize,
}

/// Memory that the stream may write to: each piece was a box, and nobody else has it.
struct Lent(Vec<NonNull<[u8]>>);

// SAFETY: the pieces are owned like the boxes that they were.
unsafe impl Send for Lent {}

impl Frames {
    /// Gives a stream buffers for frames of `payload_bytes`, in pieces of `memory_bytes` or more.
    pub fn new(stream: Stream, payload_bytes: usize, memory_bytes: usize) -> Self {
        let buffers = (MEMORY_BYTES / payload_bytes.max(1)).clamp(FEWEST, MOST_BUFFERS);
        let lent = Lent(Vec::with_capacity(buffers));
        let mut frames = Self { stream, lent, idle: Vec::with_capacity(MOST_IDLE), payload_bytes };
        for _ in 0..buffers {
            // Not zeros, whose pages would be made when the first frames come.
            frames.lend(vec![u8::MAX; memory_bytes.max(payload_bytes)].into());
        }
        frames
    }

    /// How many buffers there are.
    pub fn buffers(&self) -> usize {
        self.lent.0.len()
    }

    /// Whether none is free.
    pub fn is_full(&self) -> bool {
        self.stream.n_buffers().0 == 0
    }

    /// The next frame, whole or not; give it back or have it taken.
    pub fn pop(&self, timeout_us: u64) -> Option<Buffer> {
        self.stream.timeout_pop_buffer(timeout_us)
    }

    /// A frame that nobody wants.
    pub fn give_back(&self, buffer: Buffer) {
        self.stream.push_buffer(buffer);
    }

    /// Throws away what has come.
    pub fn drain(&self) {
        while let Some(buffer) = self.stream.try_pop_buffer() {
            self.give_back(buffer);
        }
    }

    /// Puts a frame's image into `buf`, which is no longer than it: where it has as much memory as the frame, by exchange.
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

    /// Gives the stream memory, of `payload_bytes` at least.
    fn lend(&mut self, memory: Box<[u8]>) {
        let memory = NonNull::from(Box::leak(memory));
        self.lent.0.push(memory);
        let at = memory.cast::<u8>();
        // All memory is of one length, so whichever had this address before, the buffer fits.
        let known = self.idle.iter().position(|(idle_at, _)| *idle_at == at.addr());
        let buffer = match known {
            Some(place) => self.idle.swap_remove(place).1,
            // SAFETY: the memory has `payload_bytes` and lives as long as it is in `lent`; what is not there is never
            // given to the stream.
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

/// What lies behind the first `image_bytes` of a frame that was popped; libaravis takes it for a part of the image.
pub fn behind_image(buffer: &Buffer, image_bytes: usize) -> &[u8] {
    let mut size = 0;
    // SAFETY: as for `image_data`, of all that was received.
    let data = unsafe {
        let data = aravis_sys::arv_buffer_get_data(buffer.to_glib_none().0, &mut size);
        if data.is_null() { &[] } else { std::slice::from_raw_parts(data, size) }
    };
    data.get(image_bytes..).unwrap_or_default()
}

/// Where a buffer's memory begins.
fn address(buffer: &Buffer) -> NonNull<u8> {
    let mut size = 0;
    // SAFETY: the buffer lives through the call; the address is compared, not followed.
    let at = unsafe { aravis_sys::arv_buffer_get_data(buffer.to_glib_none().0, &mut size) };
    NonNull::new(at).unwrap_or(NonNull::dangling())
}

/// The image of a frame that was popped, where it lies.
///
/// Benefit: `Buffer::image_data` of the bindings allocates and copies each frame: 1.9 MB at 1024 x 1024 Mono12p.
pub fn image_data(buffer: &Buffer) -> &[u8] {
    let mut size = 0;
    // SAFETY: the pointer and size describe memory that is lent to the buffer, and null or 0 where it has no image. While
    // the buffer is borrowed it is not in a stream, so that nobody writes to it.
    unsafe {
        let data = aravis_sys::arv_buffer_get_image_data(buffer.to_glib_none().0, &mut size);
        if data.is_null() { &[] } else { std::slice::from_raw_parts(data, size) }
    }
}
