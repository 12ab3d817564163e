//! What the devices of a rig must do. The traits are blocking: one named thread owns each device.

use std::ops::RangeInclusive;
use std::time::Duration;

use crate::{DeviceError, Edge, FrameBuf, FrameStamp, Pattern, PixelFormat};

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
    /// This frame is the first with the new settings.
    Exactly(u64),
    /// This frame and all later ones have the new settings; some before it may have them already.
    Within(u64),
}

impl FirstFrame {
    /// The first frame that is certain to have the new settings.
    pub fn certain(self) -> u64 {
        match self {
            Self::Exactly(seq) | Self::Within(seq) => seq,
        }
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

/// A triggered camera.
pub trait Camera: Send {
    /// What the camera is; constant while it is open.
    fn capabilities(&self) -> &CameraCapabilities;

    /// Writes settings, also while armed, so that a sweep need not stop the stream.
    ///
    /// # Errors
    /// `OutOfRange` if the camera cannot take a value; the old settings then stay.
    fn configure(&mut self, id: SettingsId, settings: &CameraSettings) -> Result<Applied, DeviceError>;

    /// From now on triggers are answered.
    ///
    /// # Errors
    /// Any kind; the camera then stays disarmed.
    fn arm(&mut self) -> Result<(), DeviceError>;

    /// Waits for the next frame and copies it into `buf`; `None` when none came within `timeout`.
    ///
    /// # Errors
    /// `NotReady` before [`Camera::arm`], `Disconnected` when the device is gone.
    fn next_frame(
        &mut self,
        buf: &mut FrameBuf,
        timeout: Duration,
    ) -> Result<Option<FrameStamp>, DeviceError>;

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
