//! What the devices of a rig must do. The traits are blocking: one named thread owns each device.

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

/// Whether a sensor can expose while it reads out the frame before.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Readout {
    /// Readout follows exposure: a trigger that comes before its end is not answered.
    Sequential,
    /// The next exposure may start during readout, as long as no row is exposed twice at once.
    Overlapped,
}

/// Names one set of camera settings: the point of the plan that they serve and how often it was begun.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub struct SettingsId {
    /// Ordinal of the point in the order of acquisition.
    pub point: u32,
    /// 0 for the first attempt; a film begins each of its points once a cycle, so there it is the cycle's number.
    pub attempt: u32,
}

/// What a sweep changes from point to point.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CameraSettings {
    /// Rolling for epipolar imaging.
    pub shutter: Shutter,
    /// Exposure of each row.
    pub exposure_us: f64,
    /// From the trigger's edge, after the camera's own latency, to the start of row 0's exposure.
    pub trigger_delay_us: f64,
}

/// When new settings take effect, as an id that frames carry ([`crate::FrameStamp::seq`]): no clock can confuse it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FirstFrame {
    /// This frame is the first with the new settings: the camera says so, not the driver's hope.
    Exactly(u64),
    /// The first with the new settings is one from `earliest` to `certain`; which one, the frames' own stamps must tell.
    Within {
        /// The first that may have them: the next to be triggered when they were written.
        earliest: u64,
        /// This one and all later ones have them, however late the camera is by its data sheet or the rig file.
        certain: u64,
    },
}

impl FirstFrame {
    /// The first frame that may have the new settings; those before have the old ones.
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

/// How many frames later than the next one to be triggered settings take effect, as a run's probe found it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct SettingsLatency {
    /// The fewest of all changes.
    pub min_frames: u32,
    /// The most.
    pub max_frames: u32,
}

impl SettingsLatency {
    /// The latency, where it was the same each time.
    pub fn constant(self) -> Option<u32> {
        (self.min_frames == self.max_frames).then_some(self.min_frames)
    }
}

/// What the camera made of the settings that it was given.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Applied {
    /// The settings as the hardware took them.
    pub actual: CameraSettings,
    /// When they take effect.
    pub first_frame: FirstFrame,
}

/// What a camera is and how fast it can be.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraCapabilities {
    /// Maker, model and serial number, for the manifest.
    pub model: String,
    /// Columns of a frame.
    pub width: usize,
    /// Rows of a frame.
    pub height: usize,
    /// How its pixels are packed.
    pub format: PixelFormat,
    /// From the start of one row's exposure to the next row's.
    pub row_time_us: f64,
    /// From the trigger's edge to the start of row 0's exposure, at a trigger delay of zero.
    pub trigger_latency_us: f64,
    /// From the end of row 0's exposure to the camera being ready for the next trigger.
    pub readout_us: f64,
    /// Whether that readout may overlap the next exposure.
    pub readout: Readout,
    /// Exposures that it takes.
    pub exposure_us: RangeInclusive<f64>,
    /// Trigger delays that it takes.
    pub trigger_delay_us: RangeInclusive<f64>,
}

impl CameraCapabilities {
    /// Whether the camera takes these settings.
    ///
    /// # Errors
    /// Field, value and what is allowed.
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

    /// How many VSYNC periods lie between two triggers that the camera can answer under these settings.
    pub fn periods_per_frame(&self, settings: &CameraSettings, period_us: f64) -> u32 {
        self.periods_between(settings, settings, period_us)
    }

    /// How many VSYNC periods after the trigger of a frame under `settings` the camera can answer the trigger of one
    /// under `next`.
    pub fn periods_between(&self, settings: &CameraSettings, next: &CameraSettings, period_us: f64) -> u32 {
        let start_us = self.trigger_latency_us + settings.trigger_delay_us;
        let busy_us = match self.readout {
            Readout::Sequential => start_us + settings.exposure_us + self.readout_us,
            // A trigger may come during the readout, as long as the exposure that it starts comes late enough; the
            // delay of one trigger is over before the next is heard.
            Readout::Overlapped => {
                let next_start_us = self.trigger_latency_us + next.trigger_delay_us;
                (start_us + settings.exposure_us.max(self.readout_us) - next_start_us).max(start_us)
            }
        };
        (busy_us / period_us).ceil().max(1.0) as u32
    }
}

/// Whether a device can be used just now.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum DeviceState {
    /// It is being opened for the first time.
    Connecting,
    /// Open, not armed.
    Ready,
    /// Armed.
    Streaming,
    /// It has stopped answering; its driver is trying to open it again.
    Lost,
}

/// A triggered camera.
pub trait Camera: Send {
    /// What the camera is; constant while it is open.
    fn capabilities(&self) -> &CameraCapabilities;

    /// Whether it can be used just now.
    fn state(&self) -> DeviceState;

    /// Writes settings, also while armed, so that a sweep need not stop the stream.
    ///
    /// # Errors
    /// `OutOfRange` if the camera cannot take a value; the old settings then stay. Any kind while it is
    /// [`DeviceState::Lost`]: write them again when it is back.
    fn configure(&mut self, id: SettingsId, settings: &CameraSettings) -> Result<Applied, DeviceError>;

    /// Has the camera's own sequencer take it through these settings, which all have one exposure and one shutter: a frame
    /// under each, in order and round again, while nothing is written, until [`Camera::configure`] or
    /// [`Camera::disarm`]. Returns them as the hardware took them; `None`, and nothing is changed, where the camera has no
    /// sequencer or one that is too small. Frames that were exposed before may still come. Each frame *exposed* takes
    /// the next settings, lost or not, so ids tell which; from where on they count, [`Camera::active_set`] or the frames'
    /// stamps must tell.
    ///
    /// # Errors
    /// As [`Camera::configure`].
    fn sequence(&mut self, _settings: &[CameraSettings]) -> Result<Option<Vec<CameraSettings>>, DeviceError> {
        Ok(None)
    }

    /// Which of the settings of [`Camera::sequence`] the newest frame of [`Camera::next_frame`] had, counted from 0, by its
    /// own word; `None` where it does not say.
    fn active_set(&self) -> Option<usize> {
        None
    }

    /// From now on triggers are answered.
    ///
    /// # Errors
    /// Any kind; the camera then stays disarmed.
    fn arm(&mut self) -> Result<(), DeviceError>;

    /// Waits for the next frame and puts it into `buf`, by a copy or by [`FrameBuf::exchange`]; `None` when none came within
    /// `timeout`, also while the camera is [`DeviceState::Lost`].
    ///
    /// # Errors
    /// `NotReady` before [`Camera::arm`], `Disconnected` when the device is gone for good.
    fn next_frame(
        &mut self,
        buf: &mut FrameBuf,
        timeout: Duration,
    ) -> Result<Option<FrameStamp>, DeviceError>;

    /// Why a frame is lost whose id [`Camera::next_frame`] left out before the newest one.
    fn loss_of(&self, _seq: u64) -> LossCause {
        LossCause::CameraGap
    }

    /// Answers no further trigger. Idempotent.
    ///
    /// # Errors
    /// `Disconnected` when the device is gone.
    fn disarm(&mut self) -> Result<(), DeviceError>;
}

/// A watcher of the projector's VSYNC line.
pub trait Vsync: Send {
    /// Waits for the next edge; `None` when none came within `timeout`.
    ///
    /// # Errors
    /// `Disconnected` when the device is gone.
    fn next_edge(&mut self, timeout: Duration) -> Result<Option<Edge>, DeviceError>;

    /// [`DeviceState::Lost`] while its driver tries to open it again.
    fn state(&self) -> DeviceState {
        DeviceState::Streaming
    }

    /// How well the device's own clock is known; nothing where edges are stamped by the host's.
    fn clock(&self) -> Option<ClockQuality> {
        None
    }
}

/// From when on a pattern is certain to be in the light.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Shown {
    /// Exposures that start earlier, on the host's clock, may still see the pattern before.
    pub not_before_ns: i64,
}

/// A projector.
pub trait Projector: Send {
    /// Shows a pattern.
    ///
    /// # Errors
    /// `OutOfRange` if the pattern does not fit the projector, `Unsupported` if it cannot show such a pattern at all.
    fn show(&mut self, pattern: &Pattern) -> Result<Shown, DeviceError>;

    /// Light off. Part of every way out.
    ///
    /// # Errors
    /// `Disconnected` when the device is gone.
    fn blank(&mut self) -> Result<Shown, DeviceError>;
}
