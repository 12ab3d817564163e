//! The traits that the devices of a rig implement. They are blocking: one named thread owns each device.

use std::ops::RangeInclusive;
use std::time::Duration;

use crate::{ClockQuality, DeviceError, Edge, FrameBuf, FrameStamp, LossCause, Pattern, PixelFormat};

/// How a sensor exposes its rows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Shutter {
    /// Each row starts one row time after the row above it.
    Rolling,
    /// All rows together.
    Global,
}

/// Whether a sensor can expose a frame while it reads out the previous one.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Readout {
    /// Readout follows exposure: a trigger before the end of the readout is ignored.
    Sequential,
    /// The next exposure may start during readout, as long as no row's exposures overlap.
    Overlapped,
}

/// Identifies one set of camera settings: the point of the plan that they serve, and the attempt at it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct SettingsId {
    /// Ordinal of the point in the order of acquisition.
    pub point: u32,
    /// 0 for the first attempt. A film begins each of its points once per cycle, so there it is the cycle's number.
    pub attempt: u32,
}

/// The settings that a sweep changes from point to point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraSettings {
    /// A rolling shutter is used for epipolar imaging.
    pub shutter: Shutter,
    /// Exposure of each row.
    pub exposure_us: f64,
    /// Time from the trigger's edge, after the camera's own latency, to the start of row 0's exposure.
    pub trigger_delay_us: f64,
}

/// When new settings take effect, as a frame id ([`crate::FrameStamp::seq`]), which does not depend on any clock.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FirstFrame {
    /// This frame is the first with the new settings. The camera reports it; the driver does not infer it.
    Exactly(u64),
    /// The first frame with the new settings lies between `earliest` and `certain`. The frames' own timestamps must
    /// tell which one it is.
    Within {
        /// The first frame that may have them: the next one to be triggered when they were written.
        earliest: u64,
        /// This frame and all later ones have them: the largest latency by the camera's data sheet or the rig file.
        certain: u64,
    },
}

impl FirstFrame {
    /// The first frame that may have the new settings. All earlier frames have the old ones.
    pub fn earliest(self) -> u64 {
        match self {
            Self::Exactly(seq) | Self::Within { earliest: seq, .. } => seq,
        }
    }

    /// The first frame that is certain to have the new settings.
    pub fn certain(self) -> u64 {
        match self {
            Self::Exactly(seq) | Self::Within { certain: seq, .. } => seq,
        }
    }
}

/// How many frames after the next one to be triggered settings take effect, as measured by a run's probe.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize, schemars::JsonSchema)]
pub struct SettingsLatency {
    /// The minimum over all changes.
    pub min_frames: u32,
    /// The maximum over all changes.
    pub max_frames: u32,
}

impl SettingsLatency {
    /// The latency, if it was the same for all changes.
    pub fn constant(self) -> Option<u32> {
        (self.min_frames == self.max_frames).then_some(self.min_frames)
    }
}

/// The result of applying settings to the camera.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Applied {
    /// The settings as the hardware adopted them.
    pub actual: CameraSettings,
    /// When they take effect.
    pub first_frame: FirstFrame,
}

/// What a camera is and what its limits are.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraCapabilities {
    /// Maker, model and serial number, for the manifest.
    pub model: String,
    /// Columns of a frame.
    pub width: usize,
    /// Rows of a frame.
    pub height: usize,
    /// Its pixel format.
    pub format: PixelFormat,
    /// Time from the start of one row's exposure to the start of the next row's.
    pub row_time_us: f64,
    /// Time from the trigger's edge to the start of row 0's exposure at a trigger delay of zero.
    pub trigger_latency_us: f64,
    /// Time from the end of row 0's exposure until the camera is ready for the next trigger.
    pub readout_us: f64,
    /// Whether this readout may overlap the next exposure.
    pub readout: Readout,
    /// Range of exposures that it accepts.
    pub exposure_us: RangeInclusive<f64>,
    /// Range of trigger delays that it accepts.
    pub trigger_delay_us: RangeInclusive<f64>,
}

impl CameraCapabilities {
    /// Checks whether the camera accepts these settings.
    ///
    /// # Errors
    /// Names the field, its value and the allowed values.
    pub fn allows(&self, settings: &CameraSettings) -> Result<(), String> {
        if self.trigger_delay_us == (0.0..=0.0) && settings.trigger_delay_us != 0.0 {
            return Err(format!(
                "trigger_delay_us = {}: {} cannot delay its trigger, so that delays cannot be swept; if its maker offers a delay, name it in the rig file",
                settings.trigger_delay_us, self.model
            ));
        }
        let rules = [
            ("exposure_us", settings.exposure_us, &self.exposure_us),
            ("trigger_delay_us", settings.trigger_delay_us, &self.trigger_delay_us),
        ];
        rules.into_iter().filter(|(_, value, range)| !range.contains(value)).try_for_each(
            |(field, value, range)| {
                Err(format!("{field} = {value}: {} takes {} to {}", self.model, range.start(), range.end()))
            },
        )
    }

    /// The number of VSYNC periods from one trigger to the next that the camera can answer, with these settings.
    pub fn periods_per_frame(&self, settings: &CameraSettings, period_us: f64) -> u32 {
        self.periods_between(settings, settings, period_us)
    }

    /// The number of VSYNC periods from the trigger of a frame with `settings` to the first trigger that the camera
    /// can answer for a frame with `next`.
    pub fn periods_between(&self, settings: &CameraSettings, next: &CameraSettings, period_us: f64) -> u32 {
        let start_us = self.trigger_latency_us + settings.trigger_delay_us;
        let busy_us = match self.readout {
            Readout::Sequential => start_us + settings.exposure_us + self.readout_us,
            // A trigger may come during the readout, as long as the exposure that it starts comes late enough. The
            // delay of one trigger must be over before the next trigger.
            Readout::Overlapped => {
                let next_start_us = self.trigger_latency_us + next.trigger_delay_us;
                (start_us + settings.exposure_us.max(self.readout_us) - next_start_us).max(start_us)
            }
        };
        (busy_us / period_us).ceil().max(1.0) as u32
    }
}

/// The state of a device's connection.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DeviceState {
    /// Being opened for the first time.
    Connecting,
    /// Open, not armed.
    Ready,
    /// Armed.
    Streaming,
    /// Has stopped answering; its driver is trying to reopen it.
    Lost,
}

/// A triggered camera.
pub trait Camera: Send {
    /// The camera's capabilities; constant while it is open.
    fn capabilities(&self) -> &CameraCapabilities;

    /// The state of its connection.
    fn state(&self) -> DeviceState;

    /// Writes settings. Works while armed too, so that a sweep need not stop the stream.
    ///
    /// # Errors
    /// `OutOfRange` if the camera cannot accept a value; the old settings then stay. `Disconnected` while it is
    /// [`DeviceState::Lost`], or the failure with which it was lost: write the settings again when it is back.
    fn configure(&mut self, id: SettingsId, settings: &CameraSettings) -> Result<Applied, DeviceError>;

    /// Has the camera's own sequencer step through these settings, which all have the same exposure and shutter: one
    /// frame with each, in order and cyclically, as long as nothing is written, until [`Camera::configure`] or
    /// [`Camera::disarm`]. Returns the settings as the hardware adopted them, or `None`, with nothing changed, if the
    /// camera has no sequencer or one that is too small. Frames that were exposed before may still arrive. Each frame
    /// *exposed* takes the next settings, even if it is lost, so frame ids tell the settings. The first frame with
    /// them must be found from [`Camera::active_set`] or from the frames' timestamps.
    ///
    /// # Errors
    /// As [`Camera::configure`].
    fn sequence(&mut self, _settings: &[CameraSettings]) -> Result<Option<Vec<CameraSettings>>, DeviceError> {
        Ok(None)
    }

    /// Which of the settings of [`Camera::sequence`] the newest frame of [`Camera::next_frame`] had, counted from 0,
    /// as reported by the frame; `None` if it does not report it.
    fn active_set(&self) -> Option<usize> {
        None
    }

    /// Starts answering triggers.
    ///
    /// # Errors
    /// Any kind; the camera then stays disarmed.
    fn arm(&mut self) -> Result<(), DeviceError>;

    /// Waits for the next frame and puts it into `buf`, by a copy or by [`FrameBuf::exchange`]. Returns `None` if
    /// none arrives within `timeout`, also while the camera is [`DeviceState::Lost`].
    ///
    /// # Errors
    /// `NotReady` before [`Camera::arm`], `Disconnected` when a lost camera is given up.
    fn next_frame(
        &mut self,
        buf: &mut FrameBuf,
        timeout: Duration,
    ) -> Result<Option<FrameStamp>, DeviceError>;

    /// Why the frame with id `_seq`, which [`Camera::next_frame`] skipped before the newest frame, was lost.
    fn loss_of(&self, _seq: u64) -> LossCause {
        LossCause::CameraGap
    }

    /// Stops answering triggers. Idempotent.
    ///
    /// # Errors
    /// `Disconnected` when the device is gone.
    fn disarm(&mut self) -> Result<(), DeviceError>;
}

/// A device that watches the projector's VSYNC line.
pub trait Vsync: Send {
    /// Waits for the next edge. Returns `None` if none comes within `timeout`, also while the device is
    /// [`DeviceState::Lost`].
    ///
    /// # Errors
    /// `Disconnected` when the device is gone, or given up by a driver that reopens it.
    fn next_edge(&mut self, timeout: Duration) -> Result<Option<Edge>, DeviceError>;

    /// The state of its connection: [`DeviceState::Lost`] while its driver tries to reopen it.
    fn state(&self) -> DeviceState {
        DeviceState::Streaming
    }

    /// How accurately the device's own clock is known; `None` if the host's clock timestamps the edges.
    fn clock(&self) -> Option<ClockQuality> {
        None
    }
}

/// The moment from which a pattern is certain to be displayed.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shown {
    /// Exposures that start earlier, on the host's clock, may still see the previous pattern.
    pub not_before_ns: i64,
}

/// A projector.
pub trait Projector: Send {
    /// Shows a pattern.
    ///
    /// # Errors
    /// `OutOfRange` if the pattern does not fit the projector, `Unsupported` if it cannot show this kind of pattern.
    fn show(&mut self, pattern: &Pattern) -> Result<Shown, DeviceError>;

    /// Turns the light off. Called on every exit path.
    ///
    /// # Errors
    /// `Disconnected` when the device is gone.
    fn blank(&mut self) -> Result<Shown, DeviceError>;
}
