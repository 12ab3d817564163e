//! Cameras supported by the Linux kernel: Video4Linux2 with single-planar, memory-mapped buffers.
//!
//! All calls return at once, even if the device is gone, so the thread that asks for frames owns the device. Any
//! streaming error is handled by closing the device and opening it again, whether its node disappeared or its stream
//! has to be set up again.

mod controls;
mod formats;
#[cfg(feature = "v4l2")]
mod kernel;
mod node;
mod open_node;
#[cfg(feature = "v4l2")]
mod search;
mod setup;
mod timing;

use std::collections::VecDeque;
use std::io;
use std::ops::Range;
use std::time::Duration;

use nix::libc::{EACCES, EBUSY, EINVAL, EIO, ENODEV, ENOENT, ENOTTY, ENXIO, EPERM, ERANGE};
use raysweep_core::{
    Applied, Camera, CameraCapabilities, CameraSettings, Clock, DeviceError, DeviceErrorKind, DeviceState,
    FirstFrame, FrameBuf, FrameStamp, LossCause, SettingsId, Shutter, us_from_ns,
};

pub use self::formats::fourcc;
pub use self::node::{ControlKind, Filled, Format, Identity, Node, NodeControl, NodeOpener};
use self::open_node::{Layout, OpenNode};
#[cfg(feature = "v4l2")]
pub use self::search::{FoundNode, nodes};
pub use self::setup::V4l2Setup;
use self::timing::{ExposureTimes, Ids, exposure_start_ns, is_monotonic};
use crate::reopen::Reopening;
pub use raysweep_config::rig::v4l2::{TimeControl, V4l2Config};

/// Opens a camera of this machine's kernel.
///
/// # Errors
/// `Busy` if another process streams from it, `Disconnected` if there is none, `OutOfRange` or `Unsupported` if it
/// cannot do what the rig file requires.
#[cfg(feature = "v4l2")]
pub fn open(setup: V4l2Setup) -> Result<V4l2Camera, DeviceError> {
    V4l2Camera::open(setup, Box::new(kernel::Kernel), Clock::real())
}

/// Reports that this build cannot open V4L2 cameras.
///
/// # Errors
/// Always `Unsupported`.
#[cfg(not(feature = "v4l2"))]
pub fn open(_setup: V4l2Setup) -> Result<V4l2Camera, DeviceError> {
    let what = "camera.driver = \"v4l2\": this program was built without it; build it with the feature `v4l2` (cargo build --features v4l2, which needs libclang)";
    Err(error(DeviceErrorKind::Unsupported, what))
}

/// A V4L2 camera.
pub struct V4l2Camera {
    setup: V4l2Setup,
    opener: Box<dyn NodeOpener>,
    clock: Clock,
    capabilities: CameraCapabilities,
    layout: Layout,
    armed: bool,
    /// The connection to the device; `None` while it is lost.
    open_node: Option<Box<OpenNode>>,
    reopening: Reopening,
    /// The settings written last: requested and applied.
    settings: (CameraSettings, CameraSettings),
    /// The first frame that is certain to have them.
    certain: u64,
    ids: Ids,
    /// Start of the newest frame's exposure.
    newest_ns: Option<i64>,
    /// Frames missed while the camera was lost.
    away: Range<u64>,
    exposures: ExposureTimes,
    /// Frames that were already complete when settings were written, oldest first.
    waiting: VecDeque<(u64, Filled, i64)>,
    warned_of_clock: bool,
}

impl V4l2Camera {
    /// Opens a camera with any opener and any clock.
    ///
    /// # Errors
    /// As [`open`].
    pub fn open(
        setup: V4l2Setup,
        mut opener: Box<dyn NodeOpener>,
        clock: Clock,
    ) -> Result<Self, DeviceError> {
        if let Some(fault) = setup.config.faults().into_iter().next() {
            return Err(error(DeviceErrorKind::OutOfRange, format!("camera.v4l2.{fault}")));
        }
        let open_node = OpenNode::open(opener.as_mut(), &setup)?;
        let capabilities = open_node.capabilities(&setup);
        let settings = open_node.settings().map_err(kernel_error)?;
        Ok(Self {
            layout: open_node.layout(),
            exposures: ExposureTimes::new(settings.exposure_us),
            waiting: VecDeque::with_capacity(setup.config.buffers as usize),
            reopening: Reopening::new("camera", setup.reopen, clock.clone()),
            opener,
            clock,
            capabilities,
            armed: false,
            open_node: Some(open_node),
            settings: (settings, settings),
            certain: 0,
            ids: Ids::default(),
            newest_ns: None,
            away: 0..0,
            warned_of_clock: false,
            setup,
        })
    }

    /// Closes the failed device, to be opened again, unless it is given up.
    fn lose(&mut self, cause: &io::Error) -> Result<(), DeviceError> {
        self.waiting.clear();
        self.open_node = None;
        self.reopening.failed(&format!("{}: {cause}", self.setup.config.device.display()))
    }

    /// Opens the device in its earlier state: same formats, same settings, and streaming if it was.
    fn reopened(&mut self) -> Result<Box<OpenNode>, DeviceError> {
        let mut open_node = OpenNode::open(self.opener.as_mut(), &self.setup)?;
        let found = open_node.capabilities(&self.setup);
        if found != self.capabilities || open_node.layout() != self.layout {
            let what = format!(
                "at {} there is now {}, with other abilities than {}: plug the camera in again that the run began with",
                self.setup.config.device.display(),
                found.model,
                self.capabilities.model
            );
            return Err(error(DeviceErrorKind::Unsupported, what));
        }
        open_node.write(&self.settings.0).map_err(kernel_error)?;
        if self.armed {
            open_node.start().map_err(kernel_error)?;
        }
        Ok(open_node)
    }

    /// Tries to open a lost device if an attempt is due.
    fn reopen(&mut self) -> Result<(), DeviceError> {
        if self.open_node.is_some() || !self.reopening.is_due() {
            return Ok(());
        }
        match self.reopened() {
            Ok(open_node) => {
                self.resume_ids();
                self.open_node = Some(open_node);
                self.reopening.opened();
                Ok(())
            }
            Err(error) => self.reopening.failed(&error.source),
        }
    }

    /// Continues the ids as if the camera had counted the triggers that it missed.
    fn resume_ids(&mut self) {
        let next = self.ids.next();
        let missed = self.newest_ns.map_or(0, |newest_ns| {
            let period_us = self.setup.trigger_period_us;
            let periods = self.capabilities.periods_per_frame(&self.settings.1, period_us);
            let away_us = us_from_ns(self.clock.now_ns() - newest_ns);
            (away_us / (f64::from(periods) * period_us)) as u64
        });
        self.away = next..next + missed;
        self.ids.stream_begins(self.away.end);
    }

    /// Takes a filled buffer from the kernel, with its id and the time of taking it.
    fn dequeue(&mut self) -> io::Result<Option<(u64, Filled, i64)>> {
        let Some(open_node) = &mut self.open_node else { return Ok(None) };
        let Some(filled) = open_node.node.dequeue()? else { return Ok(None) };
        Ok(Some((self.ids.take(filled.sequence), filled, self.clock.now_ns())))
    }

    /// Takes all filled buffers, so that the newest frame's id is known.
    fn drain(&mut self) -> io::Result<()> {
        if !self.armed {
            return Ok(());
        }
        while let Some(frame) = self.dequeue()? {
            self.waiting.push_back(frame);
        }
        Ok(())
    }

    /// Copies the next frame into `into`; `None` if there is none, or if it is damaged.
    fn take(&mut self, into: &mut [u8]) -> io::Result<Option<FrameStamp>> {
        let frame = match self.waiting.pop_front() {
            Some(frame) => Some(frame),
            None => self.dequeue()?,
        };
        let (Some((id, filled, dequeued_ns)), Some(open_node)) = (frame, &mut self.open_node) else {
            return Ok(None);
        };
        let sound = open_node.copy(&filled, into)?;
        open_node.node.queue(filled.index)?;
        if !sound {
            // Its id is skipped, so it is counted as lost.
            tracing::debug!(id, flags = filled.flags, bytes = filled.bytes_used, "damaged frame");
            return Ok(None);
        }
        self.reopening.delivered();
        if !is_monotonic(&filled) && !self.warned_of_clock {
            tracing::warn!(
                flags = filled.flags,
                "this camera's time stamps are not of the monotonic clock: frames are timed by their arrival, to milliseconds"
            );
            self.warned_of_clock = true;
        }
        let exposure_us = self.exposures.of(id);
        let start_ns = exposure_start_ns(&filled, exposure_us, self.capabilities.readout_us, dequeued_ns);
        self.newest_ns = Some(start_ns);
        Ok(Some(FrameStamp {
            seq: id,
            // The kernel and the host use the same clock.
            device_ns: start_ns,
            exposure_start_ns: start_ns,
            host_ns: dequeued_ns,
            exposure_us: None,
        }))
    }

    /// Waits for a buffer or the deadline; if the device is lost, for the next attempt to open it.
    fn wait(&mut self, now_ns: i64, deadline_ns: i64) -> io::Result<()> {
        let left = Duration::from_nanos((deadline_ns - now_ns).unsigned_abs());
        match &mut self.open_node {
            Some(open_node) => open_node.node.wait(left),
            None => {
                self.reopening.sleep(left);
                Ok(())
            }
        }
    }

    /// Writes settings; if the camera refuses them, the old ones are kept.
    fn write(&mut self, wanted: &CameraSettings) -> Result<CameraSettings, DeviceError> {
        let Some(open_node) = &mut self.open_node else { return Err(lost()) };
        let cause = match open_node.write(wanted) {
            Ok(actual) => return Ok(actual),
            Err(cause) => cause,
        };
        if !matches!(cause.raw_os_error(), Some(EACCES | EBUSY | EINVAL | ERANGE)) {
            self.lose(&cause)?;
            return Err(kernel_error(cause));
        }
        // The exposure may have been written before the delay was refused. If this fails too, the first error is more
        // useful.
        let _ = open_node.write(&self.settings.0);
        let what = format!(
            "exposure_us = {}, trigger_delay_us = {}: the camera's driver refuses them{}: {cause}",
            wanted.exposure_us,
            wanted.trigger_delay_us,
            if self.armed { " while it streams" } else { "" }
        );
        Err(error(DeviceErrorKind::OutOfRange, what))
    }

    /// The settings that the camera will apply.
    fn nearest(&self, settings: &CameraSettings) -> Result<CameraSettings, DeviceError> {
        if settings.shutter != Shutter::Rolling {
            let what = "shutter = Global: V4L2 has no control for it; a rig of this camera is swept with a rolling shutter";
            return Err(error(DeviceErrorKind::Unsupported, what));
        }
        self.capabilities.allows(settings).map_err(|what| error(DeviceErrorKind::OutOfRange, what))?;
        self.open_node.as_ref().map(|open_node| open_node.nearest(settings)).ok_or_else(lost)
    }
}

impl Camera for V4l2Camera {
    fn capabilities(&self) -> &CameraCapabilities {
        &self.capabilities
    }

    fn state(&self) -> DeviceState {
        match self.armed {
            // Also if it is open again but has delivered nothing.
            _ if self.reopening.is_lost() => DeviceState::Lost,
            true => DeviceState::Streaming,
            false => DeviceState::Ready,
        }
    }

    fn configure(&mut self, _id: SettingsId, settings: &CameraSettings) -> Result<Applied, DeviceError> {
        let wanted = self.nearest(settings)?;
        if let Err(cause) = self.drain() {
            self.lose(&cause)?;
            return Err(kernel_error(cause));
        }
        if wanted != self.settings.0 {
            let actual = self.write(&wanted)?;
            self.settings = (wanted, actual);
            // V4L2 does not tell when a control takes effect: the frame in progress and some after it may have the
            // old settings.
            self.certain = self.ids.next() + u64::from(self.setup.config.late_frames);
            self.exposures.set(self.certain, actual.exposure_us);
        }
        let earliest = self.ids.next();
        let first_frame = FirstFrame::Within { earliest, certain: self.certain.max(earliest) };
        Ok(Applied { actual: self.settings.1, first_frame })
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        if self.armed {
            return Ok(());
        }
        if let Some(open_node) = &mut self.open_node {
            open_node.start().map_err(kernel_error)?;
        } else {
            let mut open_node = self.reopened()?;
            open_node.start().map_err(kernel_error)?;
            self.open_node = Some(open_node);
        }
        self.ids.stream_begins(self.ids.next());
        self.newest_ns = None;
        self.armed = true;
        self.reopening.opened();
        Ok(())
    }

    fn next_frame(
        &mut self,
        buf: &mut FrameBuf,
        timeout: Duration,
    ) -> Result<Option<FrameStamp>, DeviceError> {
        if !self.armed {
            return Err(error(DeviceErrorKind::NotReady, "next_frame before arm: arm the camera first"));
        }
        if buf.len() != self.layout.frame_bytes() {
            let what = format!(
                "a buffer of {} bytes for frames of {}: make the pool for the camera's format and size",
                buf.len(),
                self.layout.frame_bytes()
            );
            return Err(error(DeviceErrorKind::OutOfRange, what));
        }
        let timeout_ns = i64::try_from(timeout.as_nanos()).unwrap_or(i64::MAX);
        let deadline_ns = self.clock.now_ns().saturating_add(timeout_ns);
        loop {
            self.reopen()?;
            let now_ns = self.clock.now_ns();
            match self.take(buf) {
                Ok(Some(stamp)) => return Ok(Some(stamp)),
                Ok(None) if now_ns >= deadline_ns => return self.reopening.check().map(|()| None),
                Ok(None) => {
                    if let Err(cause) = self.wait(now_ns, deadline_ns) {
                        self.lose(&cause)?;
                    }
                }
                Err(cause) => self.lose(&cause)?,
            }
        }
    }

    fn loss_of(&self, seq: u64) -> LossCause {
        if self.away.contains(&seq) { LossCause::CameraLost } else { LossCause::CameraGap }
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        self.waiting.clear();
        if !std::mem::replace(&mut self.armed, false) {
            return Ok(());
        }
        let Some(open_node) = &mut self.open_node else { return Ok(()) };
        if let Err(cause) = open_node.node.stop() {
            self.lose(&cause)?;
            return Err(kernel_error(cause));
        }
        Ok(())
    }
}

fn lost() -> DeviceError {
    error(DeviceErrorKind::Disconnected, "it is lost and being opened again")
}

fn error(kind: DeviceErrorKind, what: impl Into<String>) -> DeviceError {
    DeviceError::new("camera", kind, what.into())
}

/// Maps the kernel's error number to a kind that the caller can act on.
fn kernel_error(cause: io::Error) -> DeviceError {
    kernel_error_at("", cause)
}

fn kernel_error_at(what: &str, cause: io::Error) -> DeviceError {
    let (kind, advice) = match cause.raw_os_error().unwrap_or_default() {
        EBUSY => (DeviceErrorKind::Busy, "; another program uses the camera (fuser shows which): end it"),
        ENODEV | ENXIO | ENOENT => {
            (DeviceErrorKind::Disconnected, "; is it plugged in, and is camera.v4l2.device its node?")
        }
        EACCES | EPERM => {
            (DeviceErrorKind::NotReady, "; may this user open it? It has to be in the group video")
        }
        EIO => (DeviceErrorKind::Disconnected, "; the stream has failed"),
        EINVAL | ENOTTY => (DeviceErrorKind::Unsupported, "; the camera's driver does not know the request"),
        ERANGE => (DeviceErrorKind::OutOfRange, ""),
        _ => (DeviceErrorKind::Protocol, ""),
    };
    let at = if what.is_empty() { String::new() } else { format!("{what}: ") };
    error(kind, format!("{at}{cause}{advice}"))
}

#[cfg(test)]
mod scripted;
#[cfg(test)]
mod tests;
