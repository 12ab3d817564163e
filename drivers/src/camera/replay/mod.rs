//! A camera that plays back recorded frames: high-speed cameras record into their own memory first and are downloaded
//! later.

mod recording;

use std::time::{Duration, Instant};

pub use raysweep_config::rig::replay::{RawPacking, ReplayConfig, ReplayPace};
use raysweep_core::{
    Applied, Camera, CameraCapabilities, CameraSettings, Clock, DeviceError, DeviceErrorKind, DeviceState,
    FirstFrame, FrameBuf, FrameStamp, PixelFormat, Readout, SettingsId, ns_from_us,
};

use self::recording::Recording;

/// A recording as a camera. After the last frame, it is [`DeviceState::Ready`] again, although armed.
pub struct ReplayCamera {
    recording: Recording,
    capabilities: CameraCapabilities,
    pace: ReplayPace,
    frame_us: f64,
    clock: Clock,
    armed: bool,
    given: u64,
    /// When frame 0 was exposed, in terms of the playback.
    start_ns: Option<i64>,
}

impl ReplayCamera {
    /// Opens a recording of frames of `format` made at `frame_rate_hz` frames per second.
    ///
    /// # Errors
    /// `OutOfRange` with file and key if a file is truncated or does not match the configuration, `Disconnected` if
    /// one cannot be read.
    pub fn open(config: &ReplayConfig, format: PixelFormat, frame_rate_hz: f64) -> Result<Self, DeviceError> {
        let recording = Recording::open(config, format)?;
        let (height, width) = recording.size();
        let capabilities = CameraCapabilities {
            model: format!("recording of {} frames", recording.frames()),
            width,
            height,
            format,
            row_time_us: 0.0,
            trigger_latency_us: 0.0,
            readout_us: 0.0,
            readout: Readout::Overlapped,
            // Any exposure: the recording does not contain it.
            exposure_us: 0.0..=f64::MAX,
            trigger_delay_us: 0.0..=0.0,
        };
        Ok(Self {
            recording,
            capabilities,
            pace: config.pace,
            frame_us: 1e6 / frame_rate_hz,
            clock: Clock::real(),
            armed: false,
            given: 0,
            start_ns: None,
        })
    }

    /// Number of frames in the recording.
    pub fn frames(&self) -> u64 {
        self.recording.frames()
    }
}

impl Camera for ReplayCamera {
    fn capabilities(&self) -> &CameraCapabilities {
        &self.capabilities
    }

    fn state(&self) -> DeviceState {
        if self.armed && self.given < self.frames() { DeviceState::Streaming } else { DeviceState::Ready }
    }

    fn configure(&mut self, _: SettingsId, settings: &CameraSettings) -> Result<Applied, DeviceError> {
        self.capabilities
            .allows(settings)
            .map_err(|what| DeviceError::new("camera", DeviceErrorKind::OutOfRange, what))?;
        Ok(Applied { actual: *settings, first_frame: FirstFrame::Exactly(self.given) })
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        self.armed = true;
        Ok(())
    }

    fn next_frame(
        &mut self,
        buf: &mut FrameBuf,
        timeout: Duration,
    ) -> Result<Option<FrameStamp>, DeviceError> {
        if !self.armed {
            let what = "next_frame before arm: arm the camera first";
            return Err(DeviceError::new("camera", DeviceErrorKind::NotReady, what));
        }
        let deadline = Instant::now() + timeout;
        if self.given == self.frames() {
            std::thread::sleep(timeout);
            return Ok(None);
        }
        let start_ns = *self.start_ns.get_or_insert_with(|| self.clock.now_ns());
        let exposed_ns = |frame: u64| start_ns + ns_from_us(frame as f64 * self.frame_us);
        let (exposure_start_ns, done_ns) = (exposed_ns(self.given), exposed_ns(self.given + 1));
        if self.pace == ReplayPace::Recorded {
            let wait = Duration::from_nanos(u64::try_from(done_ns - self.clock.now_ns()).unwrap_or(0));
            let left = deadline.saturating_duration_since(Instant::now());
            std::thread::sleep(wait.min(left));
            if wait > left {
                return Ok(None);
            }
        }
        if !self.recording.next(buf)? {
            return Ok(None);
        }
        let stamp = FrameStamp {
            seq: self.given,
            device_ns: exposure_start_ns,
            exposure_start_ns,
            host_ns: done_ns,
            exposure_us: None,
        };
        self.given += 1;
        Ok(Some(stamp))
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        self.armed = false;
        Ok(())
    }
}
