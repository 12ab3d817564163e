//! A node with scripted answers for tests. It enforces the kernel's rules, so that violations by the driver are
//! detected.

use std::collections::VecDeque;
use std::io;
use std::path::Path;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::Duration;

use nix::libc::{EINVAL, ENODEV};
use raysweep_core::Clock;

use super::node::*;

/// Result of a dequeue.
#[derive(Debug, Clone, Copy)]
pub enum Step {
    /// A frame with this count, timestamp and flags; all its bytes are the lowest byte of the count.
    Frame { sequence: u32, timestamp_ns: i64, flags: u32 },
    /// A frame with fewer bytes than expected.
    Short { sequence: u32 },
    /// No frame for a while.
    Nothing,
    /// An error, once.
    Error(i32),
    /// The device disappears: every call returns `ENODEV` until it is opened again.
    Gone,
}

/// Duration of one `Nothing`.
const NOTHING: Duration = Duration::from_millis(1);

/// The device behind all nodes that are opened in turn.
pub struct Device {
    pub steps: VecDeque<Step>,
    /// Errors of the next open calls.
    pub refusals: VecDeque<i32>,
    pub identity: Identity,
    pub controls: Vec<(NodeControl, i64)>,
    /// How the device changes a requested format.
    pub format: fn(Format) -> Format,
    pub frame_rate_max: f64,
    pub buffers_max: u32,
    /// Errors of the next calls, by the name of the call.
    pub failures: Vec<(&'static str, i32)>,
    /// All calls except those made for each frame.
    pub calls: Vec<String>,
    pub opened: u32,
    /// Offset of a frame's first row; rows are `stride` apart, with `0xEE` in between.
    pub row_bytes: usize,
}

#[derive(Clone)]
pub struct Script {
    device: Arc<Mutex<Device>>,
    pub clock: Clock,
}

pub fn control(name: &str, minimum: i64, maximum: i64, step: i64, value: i64) -> (NodeControl, i64) {
    // Ids of different vendors collide: here all of them do.
    let kind = if name == "Pixel Rate" { ControlKind::Wide } else { ControlKind::Number };
    (NodeControl { id: 1, name: name.into(), kind, minimum, maximum, step }, value)
}

impl Script {
    pub fn new(steps: impl IntoIterator<Item = Step>) -> Self {
        let device = Device {
            steps: steps.into_iter().collect(),
            refusals: VecDeque::new(),
            identity: Identity {
                driver: "scripted".into(),
                card: "Camera".into(),
                bus: "bench".into(),
                captures: true,
            },
            controls: vec![
                control("Exposure Time, Absolute", 1, 100, 1, 10),
                control("Gain", 0, 255, 1, 0),
                control("trigger_mode", 0, 7, 1, 0),
            ],
            format: |wanted| wanted,
            frame_rate_max: 1000.0,
            buffers_max: 32,
            failures: Vec::new(),
            calls: Vec::new(),
            opened: 0,
            row_bytes: 8,
        };
        Self { device: Arc::new(Mutex::new(device)), clock: Clock::simulated() }
    }

    pub fn device(&self) -> MutexGuard<'_, Device> {
        self.device.lock().unwrap()
    }
}

impl NodeOpener for Script {
    fn open(&mut self, _path: &Path) -> io::Result<Box<dyn Node>> {
        let mut device = self.device();
        device.calls.push("open".into());
        if let Some(errno) = device.refusals.pop_front() {
            return Err(io::Error::from_raw_os_error(errno));
        }
        device.opened += 1;
        let opening = device.opened;
        drop(device);
        Ok(Box::new(ScriptedNode {
            script: self.clone(),
            opening,
            gone: false,
            format: None,
            buffers: Vec::new(),
            streaming: false,
        }))
    }
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Buffer {
    Ours(u8),
    Queued,
}

struct ScriptedNode {
    script: Script,
    opening: u32,
    gone: bool,
    format: Option<Format>,
    buffers: Vec<Buffer>,
    streaming: bool,
}

impl ScriptedNode {
    fn call(&self, what: String) -> io::Result<MutexGuard<'_, Device>> {
        let mut device = self.script.device();
        assert_eq!(device.opened, self.opening, "{what} on a node that should have been closed");
        let name = what.split(' ').next().unwrap_or_default().to_owned();
        if !["dequeue", "queue", "copy", "wait"].contains(&name.as_str()) {
            device.calls.push(what);
        }
        if self.gone {
            return Err(io::Error::from_raw_os_error(ENODEV));
        }
        if let Some(found) = device.failures.iter().position(|(call, _)| *call == name) {
            return Err(io::Error::from_raw_os_error(device.failures.remove(found).1));
        }
        Ok(device)
    }

    fn rule(kept: bool, what: &str) -> io::Result<()> {
        // The kernel returns EINVAL; a test that does not expect the error should show the reason.
        if kept { Ok(()) } else { Err(io::Error::other(format!("against the kernel's rules: {what}"))) }
    }
}

impl Node for ScriptedNode {
    fn identity(&self) -> io::Result<Identity> {
        Ok(self.call("identity".into())?.identity.clone())
    }

    fn controls(&self) -> io::Result<Vec<NodeControl>> {
        Ok(self.call("controls".into())?.controls.iter().map(|(control, _)| control.clone()).collect())
    }

    fn control(&self, control: &NodeControl) -> io::Result<i64> {
        let device = self.call(format!("control {}", control.name))?;
        let found = device.controls.iter().find(|(known, _)| known.name == control.name);
        found.map(|(_, value)| *value).ok_or_else(|| io::Error::from_raw_os_error(EINVAL))
    }

    fn set_control(&mut self, control: &NodeControl, value: i64) -> io::Result<()> {
        let mut device = self.call(format!("set_control {} {value}", control.name))?;
        let found = device.controls.iter_mut().find(|(known, _)| known.name == control.name);
        let (_, held) = found.ok_or_else(|| io::Error::from_raw_os_error(EINVAL))?;
        // A control with steps that the driver does not know about rounds down by itself.
        *held = if control.name == "Coarse" { value / 4 * 4 } else { value };
        Ok(())
    }

    fn set_format(&mut self, wanted: Format) -> io::Result<Format> {
        let found = (self.call("set_format".into())?.format)(wanted);
        self.format = Some(found);
        Ok(found)
    }

    fn set_frame_rate(&mut self, frames_per_s: f64) -> io::Result<f64> {
        Ok(frames_per_s.min(self.call(format!("set_frame_rate {frames_per_s}"))?.frame_rate_max))
    }

    fn map_buffers(&mut self, count: u32) -> io::Result<u32> {
        let count = count.min(self.call(format!("map_buffers {count}"))?.buffers_max);
        self.buffers = vec![Buffer::Ours(0); count as usize];
        Ok(count)
    }

    fn queue(&mut self, index: u32) -> io::Result<()> {
        drop(self.call("queue".into())?);
        let buffer = &mut self.buffers[index as usize];
        Self::rule(*buffer != Buffer::Queued, "a buffer is queued twice")?;
        *buffer = Buffer::Queued;
        Ok(())
    }

    fn dequeue(&mut self) -> io::Result<Option<Filled>> {
        drop(self.call("dequeue".into())?);
        Self::rule(self.streaming, "dequeue without streaming")?;
        let step = {
            let mut device = self.script.device();
            // Time passes only in waits.
            if matches!(device.steps.front(), Some(Step::Nothing)) { None } else { device.steps.pop_front() }
        };
        let filled = |sequence: u32, timestamp_ns, flags, bytes_used| Filled {
            index: 0,
            bytes_used,
            flags,
            timestamp_ns,
            sequence,
        };
        let format = self.format.expect("a format is set before streaming");
        let stride = if format.bytes_per_line == 0 {
            self.script.device().row_bytes as u32
        } else {
            format.bytes_per_line
        };
        let size = stride * format.height;
        let frame = match step {
            None | Some(Step::Nothing) => return Ok(None),
            Some(Step::Error(errno)) => return Err(io::Error::from_raw_os_error(errno)),
            Some(Step::Gone) => {
                self.gone = true;
                return Err(io::Error::from_raw_os_error(ENODEV));
            }
            Some(Step::Short { sequence }) => filled(sequence, 0, FLAG_CLOCK_MONOTONIC, size - 9),
            Some(Step::Frame { sequence, timestamp_ns, flags }) => {
                filled(sequence, timestamp_ns, flags, size)
            }
        };
        // Fills the queued buffer with the highest number, so that buffers are not filled in order of their numbers.
        let queued = self.buffers.iter().rposition(|buffer| *buffer == Buffer::Queued);
        let index = queued.expect("the driver starves: no buffer is queued");
        self.buffers[index] = Buffer::Ours(frame.sequence as u8);
        Ok(Some(Filled { index: index as u32, ..frame }))
    }

    fn wait(&mut self, timeout: Duration) -> io::Result<()> {
        if self.gone {
            // For a missing device, poll returns at once.
            return Ok(());
        }
        let lasts = {
            let mut device = self.call("wait".into())?;
            match device.steps.front() {
                Some(Step::Nothing) => {
                    device.steps.pop_front();
                    NOTHING.min(timeout)
                }
                Some(_) => Duration::ZERO,
                None => timeout,
            }
        };
        let clock = &self.script.clock;
        clock.register().sleep_until(clock.now_ns() + lasts.as_nanos() as i64);
        Ok(())
    }

    fn copy(&self, index: u32, offset: usize, into: &mut [u8]) -> io::Result<()> {
        let row_bytes = self.call("copy".into())?.row_bytes;
        let Buffer::Ours(value) = self.buffers[index as usize] else {
            return Self::rule(false, "copy from a buffer that is with the driver");
        };
        let stride = match self.format.map_or(0, |format| format.bytes_per_line as usize) {
            0 => row_bytes,
            stride => stride,
        };
        for (at, byte) in into.iter_mut().enumerate() {
            *byte = if (offset + at) % stride < row_bytes { value } else { 0xEE };
        }
        Ok(())
    }

    fn start(&mut self) -> io::Result<()> {
        drop(self.call("start".into())?);
        self.streaming = true;
        Ok(())
    }

    fn stop(&mut self) -> io::Result<()> {
        drop(self.call("stop".into())?);
        self.streaming = false;
        for buffer in &mut self.buffers {
            *buffer = Buffer::Ours(0);
        }
        Ok(())
    }
}
