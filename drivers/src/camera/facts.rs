//! What a camera offers, read without setting anything.

use std::ops::RangeInclusive;

use raysweep_core::PixelFormat;
use serde::Serialize;

/// What a camera offers, as far as it says.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct CameraFacts {
    /// Manufacturer, model and serial number.
    pub model: String,
    /// Pixel formats that this project unpacks, each with its sizes (rows, columns), the default one first.
    pub formats: Vec<(PixelFormat, Vec<(u32, u32)>)>,
    /// Inputs of the trigger.
    pub trigger_sources: Vec<String>,
    /// Exposures.
    pub exposure_us: Option<RangeInclusive<f64>>,
    /// Trigger delays; `None` if it cannot delay its trigger, or does not say so.
    pub trigger_delay_us: Option<RangeInclusive<f64>>,
    /// Frames per second when it runs freely.
    pub rate_hz: Option<RangeInclusive<f64>>,
}
