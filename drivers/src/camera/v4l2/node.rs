//! What the driver needs of a device node: a few ioctls, as a trait, so that tests can script a node's answers.

use std::io;
use std::path::Path;
use std::time::Duration;

/// Who a node is.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Identity {
    /// The kernel driver.
    pub driver: String,
    /// The device's name.
    pub card: String,
    /// Where it is plugged in.
    pub bus: String,
    /// Whether it captures video through single-planar, memory-mapped buffers.
    pub captures: bool,
}

/// What a control holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ControlKind {
    /// A number of 32 bits, a switch, a menu's index, or bits.
    Number,
    /// A number of 64 bits.
    Wide,
    /// Something happens when it is written; it cannot be read.
    Button,
}

/// A control of a node.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Control {
    /// The kernel's id. Vendors' ids collide: find controls by name.
    pub id: u32,
    /// The name as the kernel driver spells it.
    pub name: String,
    /// What it holds.
    pub kind: ControlKind,
    /// The smallest value.
    pub minimum: i64,
    /// The largest value.
    pub maximum: i64,
    /// From one value to the next, at least 1.
    pub step: i64,
}

/// A picture format: single-planar, progressive.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Format {
    /// The four characters of its name.
    pub fourcc: [u8; 4],
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Bytes from one row to the next; 0 where the driver does not say.
    pub bytes_per_line: u32,
}

/// A filled buffer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Filled {
    /// Which buffer.
    pub index: u32,
    /// How much of it is filled.
    pub bytes_used: u32,
    /// `V4L2_BUF_FLAG_*`.
    pub flags: u32,
    /// The frame's time stamp, of which clock and moment the flags say.
    pub timestamp_ns: i64,
    /// The driver's count of frames, which wraps.
    pub sequence: u32,
}

/// A device node of the kernel's video API. Errors carry the kernel's number.
pub trait Node: Send {
    /// Who it is (`VIDIOC_QUERYCAP`).
    ///
    /// # Errors
    /// The kernel's.
    fn identity(&self) -> io::Result<Identity>;

    /// Its controls that hold one number (`VIDIOC_QUERY_EXT_CTRL`).
    ///
    /// # Errors
    /// The kernel's.
    fn controls(&self) -> io::Result<Vec<Control>>;

    /// A control's value.
    ///
    /// # Errors
    /// The kernel's.
    fn control(&self, control: &Control) -> io::Result<i64>;

    /// Writes a control. The kernel driver may take another value: read it back.
    ///
    /// # Errors
    /// The kernel's.
    fn set_control(&mut self, control: &Control, value: i64) -> io::Result<()>;

    /// Asks for a format (`VIDIOC_S_FMT`) and says what the driver made of it.
    ///
    /// # Errors
    /// The kernel's; `EBUSY` when another process has buffers.
    fn set_format(&mut self, wanted: Format) -> io::Result<Format>;

    /// Asks for a frame rate (`VIDIOC_S_PARM`), in frames per second, and says what the driver made of it.
    ///
    /// # Errors
    /// The kernel's.
    fn set_frame_rate(&mut self, frames_per_s: f64) -> io::Result<f64>;

    /// Has the driver make buffers (`VIDIOC_REQBUFS`), maps them, and says how many there are.
    ///
    /// # Errors
    /// The kernel's.
    fn map_buffers(&mut self, count: u32) -> io::Result<u32>;

    /// Gives a buffer to the driver to fill (`VIDIOC_QBUF`).
    ///
    /// # Errors
    /// The kernel's.
    fn queue(&mut self, index: u32) -> io::Result<()>;

    /// Takes a filled buffer (`VIDIOC_DQBUF`), if there is one; never waits.
    ///
    /// # Errors
    /// The kernel's.
    fn dequeue(&mut self) -> io::Result<Option<Filled>>;

    /// Waits until a buffer is filled or something has gone wrong, which [`Node::dequeue`] then tells; not much longer
    /// than `timeout`.
    ///
    /// # Errors
    /// The kernel's.
    fn wait(&mut self, timeout: Duration) -> io::Result<()>;

    /// Copies out of a buffer that is not with the driver, from its byte `offset` on, as much as `into` holds.
    ///
    /// # Errors
    /// `InvalidInput` when the buffer ends before.
    fn copy(&self, index: u32, offset: usize, into: &mut [u8]) -> io::Result<()>;

    /// Frames are taken from now on (`VIDIOC_STREAMON`).
    ///
    /// # Errors
    /// The kernel's; `EBUSY` when another process streams.
    fn start(&mut self) -> io::Result<()>;

    /// No further frames; all buffers are back from the driver (`VIDIOC_STREAMOFF`).
    ///
    /// # Errors
    /// The kernel's.
    fn stop(&mut self) -> io::Result<()>;
}

/// Opens nodes, again and again when they go and come back.
pub trait Opener: Send {
    /// Opens the node at a path.
    ///
    /// # Errors
    /// The kernel's.
    fn open(&mut self, path: &Path) -> io::Result<Box<dyn Node>>;
}

/// `V4L2_BUF_FLAG_ERROR`: the frame may be damaged.
pub const FLAG_ERROR: u32 = 0x40;
/// `V4L2_BUF_FLAG_TIMESTAMP_MASK`: what clock a stamp is of.
pub const FLAG_CLOCK_MASK: u32 = 0xE000;
/// `V4L2_BUF_FLAG_TIMESTAMP_MONOTONIC`.
pub const FLAG_CLOCK_MONOTONIC: u32 = 0x2000;
/// `V4L2_BUF_FLAG_TSTAMP_SRC_MASK`: what moment a stamp is of; none of its bits: the frame's end.
pub const FLAG_MOMENT_MASK: u32 = 0x7_0000;
/// `V4L2_BUF_FLAG_TSTAMP_SRC_SOE`: the start of the exposure.
pub const FLAG_MOMENT_START_OF_EXPOSURE: u32 = 0x1_0000;
