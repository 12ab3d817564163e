//! The driver's interface to a device node: a few ioctls as a trait, so that tests can script a node's answers.

use std::io;
use std::path::Path;
use std::time::Duration;

/// Identity of a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// The kernel driver.
    pub driver: String,
    /// The device's name.
    pub card: String,
    /// Its location on the bus.
    pub bus: String,
    /// Whether it captures video through single-planar, memory-mapped buffers.
    pub captures: bool,
}

/// Kind of a control's value.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ControlKind {
    /// A 32-bit number, a boolean, a menu index, or a bit mask.
    Number,
    /// A 64-bit number.
    Wide,
    /// An action that is triggered by a write; it cannot be read.
    Button,
}

/// A control of a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct NodeControl {
    /// The kernel's id. Ids of different vendors collide, so find controls by name.
    pub id: u32,
    /// The name as in the kernel driver.
    pub name: String,
    /// Kind of its value.
    pub kind: ControlKind,
    /// Minimum value.
    pub minimum: i64,
    /// Maximum value.
    pub maximum: i64,
    /// Step between values, at least 1.
    pub step: i64,
}

/// A frame format: single-planar, progressive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Format {
    /// Its four-character code.
    pub fourcc: [u8; 4],
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Bytes from one row to the next; 0 if the driver does not report it.
    pub bytes_per_line: u32,
}

/// A filled buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Filled {
    /// Index of the buffer.
    pub index: u32,
    /// Number of bytes filled.
    pub bytes_used: u32,
    /// `V4L2_BUF_FLAG_*`.
    pub flags: u32,
    /// The frame's timestamp; the flags tell its clock and the moment that it refers to.
    pub timestamp_ns: i64,
    /// The driver's count of frames, which wraps.
    pub sequence: u32,
}

/// A device node of the kernel's video API. Errors contain the kernel's error number.
pub trait Node: Send {
    /// The identity of the node (`VIDIOC_QUERYCAP`).
    ///
    /// # Errors
    /// The kernel's error.
    fn identity(&self) -> io::Result<Identity>;

    /// Its controls with a single numeric value (`VIDIOC_QUERY_EXT_CTRL`).
    ///
    /// # Errors
    /// The kernel's error.
    fn controls(&self) -> io::Result<Vec<NodeControl>>;

    /// A control's value.
    ///
    /// # Errors
    /// The kernel's error.
    fn control(&self, control: &NodeControl) -> io::Result<i64>;

    /// Writes a control. The kernel driver may apply another value: read it back.
    ///
    /// # Errors
    /// The kernel's error.
    fn set_control(&mut self, control: &NodeControl, value: i64) -> io::Result<()>;

    /// Requests a format (`VIDIOC_S_FMT`) and returns the one that the driver applied.
    ///
    /// # Errors
    /// The kernel's error; `EBUSY` if another process has buffers.
    fn set_format(&mut self, wanted: Format) -> io::Result<Format>;

    /// Requests a frame rate in frames per second (`VIDIOC_S_PARM`) and returns the one that the driver applied.
    ///
    /// # Errors
    /// The kernel's error.
    fn set_frame_rate(&mut self, frames_per_s: f64) -> io::Result<f64>;

    /// Lets the driver allocate buffers (`VIDIOC_REQBUFS`), maps them, and returns how many there are.
    ///
    /// # Errors
    /// The kernel's error.
    fn map_buffers(&mut self, count: u32) -> io::Result<u32>;

    /// Passes a buffer to the driver for filling (`VIDIOC_QBUF`).
    ///
    /// # Errors
    /// The kernel's error.
    fn queue(&mut self, index: u32) -> io::Result<()>;

    /// Takes a filled buffer (`VIDIOC_DQBUF`), if there is one; never waits.
    ///
    /// # Errors
    /// The kernel's error.
    fn dequeue(&mut self) -> io::Result<Option<Filled>>;

    /// Waits until a buffer is filled or an error has occurred, which [`Node::dequeue`] then returns; not much longer
    /// than `timeout`.
    ///
    /// # Errors
    /// The kernel's error.
    fn wait(&mut self, timeout: Duration) -> io::Result<()>;

    /// Fills `into` from a buffer that the driver does not hold, starting at byte `offset`.
    ///
    /// # Errors
    /// `InvalidInput` if the buffer is too short.
    fn copy(&self, index: u32, offset: usize, into: &mut [u8]) -> io::Result<()>;

    /// Starts streaming (`VIDIOC_STREAMON`).
    ///
    /// # Errors
    /// The kernel's error; `EBUSY` if another process streams.
    fn start(&mut self) -> io::Result<()>;

    /// Stops streaming; the driver returns all buffers (`VIDIOC_STREAMOFF`).
    ///
    /// # Errors
    /// The kernel's error.
    fn stop(&mut self) -> io::Result<()>;
}

/// Opens nodes, also repeatedly when they disappear and come back.
pub trait NodeOpener: Send {
    /// Opens the node at a path.
    ///
    /// # Errors
    /// The kernel's error.
    fn open(&mut self, path: &Path) -> io::Result<Box<dyn Node>>;
}

/// `V4L2_BUF_FLAG_ERROR`: the frame may be damaged.
pub const FLAG_ERROR: u32 = 0x40;
/// `V4L2_BUF_FLAG_TIMESTAMP_MASK`: the clock of a timestamp.
pub const FLAG_CLOCK_MASK: u32 = 0xE000;
/// `V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC`.
pub const FLAG_CLOCK_MONOTONIC: u32 = 0x2000;
/// `V4L2_BUF_FLAG_TSTAMP_SRC_MASK`: the moment of a timestamp; if no bit is set, the end of the frame.
pub const FLAG_MOMENT_MASK: u32 = 0x7_0000;
/// `V4L2_BUF_FLAG_TSTAMP_SRC_SOE`: the start of the exposure.
pub const FLAG_MOMENT_START_OF_EXPOSURE: u32 = 0x1_0000;
