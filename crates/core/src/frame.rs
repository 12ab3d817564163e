//! Frames, their timestamps, and the bounded pool of buffers to which dropped buffers return automatically.

use std::ops::{Deref, DerefMut};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use crate::PixelFormat;

/// One VSYNC edge as reported by the device that watches the line.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Edge {
    /// The device's own count of edges, which reveals edges lost on the way.
    pub seq: u64,
    /// Time of the edge on the host's clock.
    pub host_ns: i64,
}

/// The metadata that a camera reports with a frame. Everything here is available on a real camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameStamp {
    /// The device's frame id. It counts every exposure, even if the frame is lost on the way.
    pub seq: u64,
    /// Start of the exposure of row 0 on the device's own clock.
    pub device_ns: i64,
    /// Start of the exposure of row 0 on the host's clock: `device_ns` through the driver's clock model.
    pub exposure_start_ns: i64,
    /// When the frame was complete on the host.
    pub host_ns: i64,
    /// The exposure reported in the frame itself (chunk data), if the camera offers it.
    pub exposure_us: Option<f64>,
}

/// A frame as delivered by the device: packed pixels, row by row, top row first.
pub struct Frame {
    /// The pixels. The buffer returns to its pool when the frame is dropped.
    pub data: FrameBuf,
    /// How they are packed.
    pub format: PixelFormat,
    /// When and how the frame was exposed.
    pub stamp: FrameStamp,
}

/// Space in each buffer after the frame, for what cameras append: chunk data, padding.
const TAIL_BYTES: usize = 4096;

struct Shelf {
    free: Mutex<Vec<Box<[u8]>>>,
    returned: Condvar,
}

impl Shelf {
    fn lock(&self) -> MutexGuard<'_, Vec<Box<[u8]>>> {
        // A push or pop cannot be left half done, so the list stays valid after a panic elsewhere.
        self.free.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// A fixed number of buffers of one size, allocated once. A clone is the same pool.
#[derive(Clone)]
pub struct FramePool {
    shelf: Arc<Shelf>,
    buffer_bytes: usize,
}

impl FramePool {
    /// A pool of `buffers` buffers of `buffer_bytes` bytes each.
    pub fn new(buffers: usize, buffer_bytes: usize) -> Self {
        let free = (0..buffers).map(|_| memory(buffer_bytes)).collect();
        Self { shelf: Arc::new(Shelf { free: Mutex::new(free), returned: Condvar::new() }), buffer_bytes }
    }

    /// A buffer, if one is free.
    pub fn try_take(&self) -> Option<FrameBuf> {
        let data = self.shelf.lock().pop()?;
        Some(self.lend(data))
    }

    /// Waits until a buffer is free and takes it.
    pub fn take(&self) -> FrameBuf {
        let mut free = self.shelf.lock();
        loop {
            if let Some(data) = free.pop() {
                return self.lend(data);
            }
            free = self.shelf.returned.wait(free).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// As [`Self::take`], but gives up after `timeout`.
    pub fn take_within(&self, timeout: Duration) -> Option<FrameBuf> {
        let free = self.shelf.lock();
        let waited = self.shelf.returned.wait_timeout_while(free, timeout, |free| free.is_empty());
        let (mut free, _) = waited.unwrap_or_else(PoisonError::into_inner);
        Some(self.lend(free.pop()?))
    }

    /// A buffer of the pool's size that does not belong to the pool: for a frame that has to be received but cannot
    /// be kept.
    pub fn spare(&self) -> FrameBuf {
        FrameBuf { data: memory(self.buffer_bytes), bytes: self.buffer_bytes, home: None }
    }

    fn lend(&self, data: Box<[u8]>) -> FrameBuf {
        FrameBuf { data, bytes: self.buffer_bytes, home: Some(self.shelf.clone()) }
    }
}

fn memory(buffer_bytes: usize) -> Box<[u8]> {
    // Not zeros: the system maps zeroed pages only on first use, which would slow down the first frames.
    vec![u8::MAX; FrameBuf::memory_bytes(buffer_bytes)].into()
}

/// A buffer borrowed from a [`FramePool`], to which it returns when dropped.
pub struct FrameBuf {
    /// The frame and its tail.
    data: Box<[u8]>,
    /// Bytes of the frame.
    bytes: usize,
    home: Option<Arc<Shelf>>,
}

impl FrameBuf {
    /// Bytes of memory in a buffer for a frame of `frame_bytes` bytes.
    pub fn memory_bytes(frame_bytes: usize) -> usize {
        frame_bytes + TAIL_BYTES
    }

    /// Replaces the buffer's memory by `memory` and returns the old memory: for a device that has written its frame
    /// at the start of `memory` without knowing of the pool.
    ///
    /// # Errors
    /// Returns `memory` if it is not as long as the buffer's own.
    pub fn exchange(&mut self, memory: Box<[u8]>) -> Result<Box<[u8]>, Box<[u8]>> {
        if memory.len() == self.data.len() {
            Ok(std::mem::replace(&mut self.data, memory))
        } else {
            Err(memory)
        }
    }
}

impl Deref for FrameBuf {
    type Target = [u8];
    fn deref(&self) -> &[u8] {
        &self.data[..self.bytes]
    }
}

impl DerefMut for FrameBuf {
    fn deref_mut(&mut self) -> &mut [u8] {
        &mut self.data[..self.bytes]
    }
}

impl Drop for FrameBuf {
    fn drop(&mut self) {
        if let Some(shelf) = self.home.take() {
            shelf.lock().push(std::mem::take(&mut self.data));
            shelf.returned.notify_one();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_pool_lends_each_buffer_once_and_takes_it_back() {
        let pool = FramePool::new(2, 16);
        let (a, b) = (pool.try_take().unwrap(), pool.try_take().unwrap());
        assert!(pool.try_take().is_none());
        let address = a.as_ptr();
        drop(a);
        assert_eq!(pool.take().as_ptr(), address, "the same memory, not a new allocation");
        drop((b, pool.spare()));
        assert_eq!(pool.shelf.lock().len(), 2, "a spare buffer never joins the pool");
    }

    #[test]
    fn memory_of_the_same_length_takes_the_place_of_a_buffers_own() {
        let pool = FramePool::new(1, 16);
        let mut lent = pool.take();
        let foreign: Box<[u8]> = (0..FrameBuf::memory_bytes(16)).map(|at| at as u8).collect();
        let own = lent.exchange(foreign).unwrap();
        assert!(own.iter().all(|byte| *byte == u8::MAX) && own.len() == FrameBuf::memory_bytes(16));
        assert!(lent.iter().copied().eq(0..16));
        assert_eq!(lent.exchange(vec![1; 16].into()), Err(vec![1; 16].into()), "shorter");
        drop(lent);
        assert!(pool.take().iter().copied().eq(0..16), "it is the pool's now");
    }

    #[test]
    fn a_waiting_taker_gets_the_buffer_that_another_thread_returns() {
        let pool = FramePool::new(1, 1);
        let lent = pool.take();
        let waiter = std::thread::spawn({
            let pool = pool.clone();
            move || pool.take().len()
        });
        assert!(pool.take_within(Duration::ZERO).is_none());
        drop(lent);
        assert_eq!(waiter.join().unwrap(), 1);
        assert!(pool.take_within(Duration::ZERO).is_some());
    }
}
