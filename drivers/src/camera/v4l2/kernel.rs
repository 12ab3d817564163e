//! A node of the kernel, based on the ioctls of the crate `v4l`. Its streams are not used: they queue a buffer twice
//! after a timeout and panic if the kernel reports an error during cleanup. Its queries are not used either: they
//! panic on names that are not UTF-8 and on kinds of controls that they do not know.

// SAFETY of the module: the kernel writes into the argument of an ioctl and into the mapped memory. `ioctl` allows
// only structures of the size that the request itself states, and a `Mapping` is only read within its bounds.
#![allow(unsafe_code)]

use std::io;
use std::mem::{size_of, zeroed};
use std::path::Path;
use std::ptr::{copy_nonoverlapping, null_mut};
use std::sync::Arc;
use std::time::Duration;

use nix::libc::{EAGAIN, EINTR, EINVAL, ENODEV, MAP_SHARED, POLLIN, PROT_READ};
use v4l::Device;
use v4l::control::{Type as ControlType, Value};
use v4l::device::Handle;
use v4l::v4l_sys::{
    v4l2_buffer, v4l2_capability, v4l2_control, v4l2_format, v4l2_query_ext_ctrl, v4l2_requestbuffers,
    v4l2_streamparm,
};
use v4l::v4l2::{self, vidioc};

use super::node::{ControlKind, Filled, Format, Identity, Node, NodeControl, NodeOpener};

const VIDEO_CAPTURE: u32 = 1;
const MEMORY_MMAP: u32 = 1;
const FIELD_NONE: u32 = 1;
const CAP_VIDEO_CAPTURE: u32 = 0x1;
const CAP_STREAMING: u32 = 0x0400_0000;
const CAP_DEVICE_CAPS: u32 = 0x8000_0000;
const CTRL_DISABLED: u32 = 0x1;
const CTRL_NEXT: u32 = 0x8000_0000;

/// Opens nodes of this machine's kernel.
pub struct Kernel;

impl NodeOpener for Kernel {
    fn open(&mut self, path: &Path) -> io::Result<Box<dyn Node>> {
        let device = Device::with_path(path)?;
        let handle = device.handle();
        Ok(Box::new(KernelNode { mappings: Vec::new(), streaming: false, handle, device }))
    }
}

struct KernelNode {
    // Dropped first: the mapped buffers must not outlive the handle.
    mappings: Vec<Mapping>,
    streaming: bool,
    handle: Arc<Handle>,
    device: Device,
}

/// A structure of `linux/videodev2.h` without pointers.
///
/// # Safety
/// Every bit pattern, including all zeros, is a valid value.
unsafe trait Argument: Copy {}

macro_rules! arguments {
    ($($name:ty),*) => {
        $(
            // SAFETY: integers, arrays of them, unions of these; pointers within unions are never dereferenced.
            unsafe impl Argument for $name {}
        )*
    };
}
arguments!(
    i32,
    v4l2_buffer,
    v4l2_capability,
    v4l2_control,
    v4l2_format,
    v4l2_query_ext_ctrl,
    v4l2_requestbuffers,
    v4l2_streamparm
);

fn blank<T: Argument>() -> T {
    // SAFETY: all zeros is a valid value, by the trait's contract.
    unsafe { zeroed() }
}

impl KernelNode {
    fn ioctl<T: Argument>(&self, request: vidioc::_IOC_TYPE, argument: &mut T) -> io::Result<()> {
        // Bits 16 to 29 of a request are the size of its argument (linux/ioctl.h).
        let stated = (request >> 16 & 0x3FFF) as usize;
        if stated != size_of::<T>() {
            return Err(io::Error::from_raw_os_error(EINVAL));
        }
        // SAFETY: the kernel reads and writes at most the size stated in the request, which is that of the argument,
        // and every bit pattern that it leaves is a valid value.
        unsafe { v4l2::ioctl(self.handle.fd(), request, (&raw mut *argument).cast()) }
    }

    fn buffer(index: u32) -> v4l2_buffer {
        v4l2_buffer { index, type_: VIDEO_CAPTURE, memory: MEMORY_MMAP, ..blank() }
    }

    fn map(&self, index: u32) -> io::Result<Mapping> {
        let mut buffer = Self::buffer(index);
        self.ioctl(vidioc::VIDIOC_QUERYBUF, &mut buffer)?;
        // SAFETY: for memory-mapped buffers, the union contains the offset; any bits are a valid integer.
        let offset = unsafe { buffer.m.offset };
        let length = buffer.length as usize;
        // SAFETY: a new mapping at an address chosen by the kernel does not overlap memory in use.
        let start = unsafe {
            v4l2::mmap(null_mut(), length, PROT_READ, MAP_SHARED, self.handle.fd(), offset.into())?
        };
        Ok(Mapping { start: start.cast(), length })
    }
}

impl Node for KernelNode {
    fn identity(&self) -> io::Result<Identity> {
        let mut found: v4l2_capability = blank();
        self.ioctl(vidioc::VIDIOC_QUERYCAP, &mut found)?;
        // A device with several nodes reports its own capabilities and those of each node.
        let has_own = found.capabilities & CAP_DEVICE_CAPS != 0;
        let capabilities = if has_own { found.device_caps } else { found.capabilities };
        let needed = CAP_VIDEO_CAPTURE | CAP_STREAMING;
        Ok(Identity {
            driver: text(&found.driver),
            card: text(&found.card),
            bus: text(&found.bus_info),
            captures: capabilities & needed == needed,
        })
    }

    fn controls(&self) -> io::Result<Vec<NodeControl>> {
        let mut controls = Vec::new();
        let mut found: v4l2_query_ext_ctrl = blank();
        loop {
            found.id |= CTRL_NEXT;
            match self.ioctl(vidioc::VIDIOC_QUERY_EXT_CTRL, &mut found) {
                Ok(()) => {}
                // The end of the list, or a driver without controls.
                Err(error) if error.raw_os_error() != Some(ENODEV) => return Ok(controls),
                Err(error) => return Err(error),
            }
            let is = |kind: ControlType| found.type_ == kind as u32;
            let kind = if is(ControlType::Integer64) {
                ControlKind::Wide
            } else if is(ControlType::Button) {
                ControlKind::Button
            } else if [
                ControlType::Integer,
                ControlType::Boolean,
                ControlType::Menu,
                ControlType::Bitmask,
                ControlType::IntegerMenu,
            ]
            .into_iter()
            .any(is)
            {
                ControlKind::Number
            } else {
                continue;
            };
            // Arrays have several values.
            if found.flags & CTRL_DISABLED == 0 && found.elems <= 1 {
                controls.push(NodeControl {
                    id: found.id,
                    name: text(&found.name.map(|character| character as u8)),
                    kind,
                    minimum: found.minimum,
                    maximum: found.maximum,
                    step: i64::try_from(found.step).unwrap_or(i64::MAX).max(1),
                });
            }
        }
    }

    fn control(&self, control: &NodeControl) -> io::Result<i64> {
        if control.kind == ControlKind::Wide {
            return match self.device.control(control.id)?.value {
                Value::Integer(value) => Ok(value),
                _ => Err(io::Error::from_raw_os_error(EINVAL)),
            };
        }
        let mut value = v4l2_control { id: control.id, value: 0 };
        self.ioctl(vidioc::VIDIOC_G_CTRL, &mut value)?;
        Ok(value.value.into())
    }

    fn set_control(&mut self, control: &NodeControl, value: i64) -> io::Result<()> {
        if control.kind == ControlKind::Wide {
            return self.device.set_control(v4l::Control { id: control.id, value: Value::Integer(value) });
        }
        let value = i32::try_from(value).map_err(io::Error::other)?;
        self.ioctl(vidioc::VIDIOC_S_CTRL, &mut v4l2_control { id: control.id, value })
    }

    fn set_format(&mut self, wanted: Format) -> io::Result<Format> {
        let mut format: v4l2_format = blank();
        format.type_ = VIDEO_CAPTURE;
        // Accessing the union's `pix` is sound: any bits are valid for every member.
        format.fmt.pix.width = wanted.width;
        format.fmt.pix.height = wanted.height;
        format.fmt.pix.pixelformat = u32::from_le_bytes(wanted.fourcc);
        format.fmt.pix.field = FIELD_NONE;
        format.fmt.pix.bytesperline = wanted.bytes_per_line;
        self.ioctl(vidioc::VIDIOC_S_FMT, &mut format)?;
        // SAFETY: for a capture format, the kernel has filled `pix`; any bits are valid integers.
        let pix = unsafe { format.fmt.pix };
        Ok(Format {
            fourcc: pix.pixelformat.to_le_bytes(),
            width: pix.width,
            height: pix.height,
            bytes_per_line: pix.bytesperline,
        })
    }

    fn set_frame_rate(&mut self, frames_per_s: f64) -> io::Result<f64> {
        let mut parameters: v4l2_streamparm = blank();
        parameters.type_ = VIDEO_CAPTURE;
        parameters.parm.capture.timeperframe.numerator = 1000;
        parameters.parm.capture.timeperframe.denominator = (frames_per_s * 1000.0).round() as u32;
        self.ioctl(vidioc::VIDIOC_S_PARM, &mut parameters)?;
        // SAFETY: for a capture stream, the kernel has filled this member; any bits are valid integers.
        let interval = unsafe { parameters.parm.capture }.timeperframe;
        Ok(f64::from(interval.denominator) / f64::from(interval.numerator))
    }

    fn map_buffers(&mut self, count: u32) -> io::Result<u32> {
        let mut request = v4l2_requestbuffers { count, type_: VIDEO_CAPTURE, memory: MEMORY_MMAP, ..blank() };
        self.ioctl(vidioc::VIDIOC_REQBUFS, &mut request)?;
        self.mappings = (0..request.count).map(|index| self.map(index)).collect::<io::Result<_>>()?;
        Ok(request.count)
    }

    fn queue(&mut self, index: u32) -> io::Result<()> {
        self.ioctl(vidioc::VIDIOC_QBUF, &mut Self::buffer(index))
    }

    fn dequeue(&mut self) -> io::Result<Option<Filled>> {
        let mut buffer = Self::buffer(0);
        match self.ioctl(vidioc::VIDIOC_DQBUF, &mut buffer) {
            Ok(()) => {}
            Err(error) if matches!(error.raw_os_error(), Some(EAGAIN | EINTR)) => return Ok(None),
            Err(error) => return Err(error),
        }
        Ok(Some(Filled {
            index: buffer.index,
            bytes_used: buffer.bytesused,
            flags: buffer.flags,
            timestamp_ns: buffer.timestamp.tv_sec * 1_000_000_000 + buffer.timestamp.tv_usec * 1000,
            sequence: buffer.sequence,
        }))
    }

    fn wait(&mut self, timeout: Duration) -> io::Result<()> {
        let timeout_ms = timeout.as_micros().div_ceil(1000).try_into().unwrap_or(i32::MAX);
        match self.handle.poll(POLLIN, timeout_ms) {
            Err(error) if error.kind() != io::ErrorKind::Interrupted => Err(error),
            _ => Ok(()),
        }
    }

    fn copy(&self, index: u32, offset: usize, into: &mut [u8]) -> io::Result<()> {
        let mapping =
            self.mappings.get(index as usize).ok_or_else(|| io::Error::from_raw_os_error(EINVAL))?;
        mapping.copy(offset, into)
    }

    fn start(&mut self) -> io::Result<()> {
        self.ioctl(vidioc::VIDIOC_STREAMON, &mut (VIDEO_CAPTURE as i32))?;
        self.streaming = true;
        Ok(())
    }

    fn stop(&mut self) -> io::Result<()> {
        self.streaming = false;
        self.ioctl(vidioc::VIDIOC_STREAMOFF, &mut (VIDEO_CAPTURE as i32))
    }
}

impl Drop for KernelNode {
    fn drop(&mut self) {
        if self.streaming {
            // A device that is gone has stopped by itself.
            let _ = self.stop();
        }
    }
}

/// A buffer of the driver, mapped for reading.
struct Mapping {
    start: *const u8,
    length: usize,
}

// SAFETY: a mapping belongs to the process, not to a thread.
unsafe impl Send for Mapping {}

impl Mapping {
    /// Fills `into` from `offset` on.
    fn copy(&self, offset: usize, into: &mut [u8]) -> io::Result<()> {
        if offset.checked_add(into.len()).is_none_or(|end| end > self.length) {
            return Err(io::Error::from_raw_os_error(EINVAL));
        }
        // SAFETY: source and target are in bounds and do not overlap, as no slice refers to the mapping. If the
        // device writes at the same time, only the picture is affected: bytes have no invalid values. Copying
        // directly from the mapping means one copy per frame.
        unsafe { copy_nonoverlapping(self.start.add(offset), into.as_mut_ptr(), into.len()) };
        Ok(())
    }
}

impl Drop for Mapping {
    fn drop(&mut self) {
        // SAFETY: start and length are those returned by `mmap`, and nothing refers to the memory. It can only fail
        // for other arguments.
        let _ = unsafe { v4l2::munmap(self.start.cast_mut().cast(), self.length) };
    }
}

/// The text before the first zero byte.
fn text(bytes: &[u8]) -> String {
    let end = bytes.iter().position(|&byte| byte == 0).unwrap_or(bytes.len());
    String::from_utf8_lossy(&bytes[..end]).into_owned()
}
