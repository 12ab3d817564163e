//! What a camera offers, read without setting anything.

use std::ops::RangeInclusive;
use std::sync::Arc;

use raysweep_core::{Clock, DeviceError, PixelFormat};

use super::features::{Features, first_present};
use super::library::{Device, Health};

/// What a GenICam camera offers.
#[derive(Debug, Clone, PartialEq)]
pub struct CameraFacts {
    /// Manufacturer, model and serial number.
    pub model: String,
    /// Rows and columns of the sensor.
    pub sensor: Option<(u32, u32)>,
    /// Pixel formats that this project unpacks.
    pub pixel_formats: Vec<PixelFormat>,
    /// Inputs of the trigger.
    pub trigger_sources: Vec<String>,
    /// Exposures.
    pub exposure_us: Option<RangeInclusive<f64>>,
    /// Trigger delays; `None` if it cannot delay its trigger.
    pub trigger_delay_us: Option<RangeInclusive<f64>>,
}

/// Reads what the camera with this address or name offers.
///
/// # Errors
/// `Disconnected` if it does not answer, `Busy` if another program holds it.
pub fn facts(camera: &str) -> Result<CameraFacts, DeviceError> {
    let device = Device::open(camera, Arc::new(Health::new(Clock::real())))?;
    let side = |names: &[&'static str]| {
        let name = first_present(&device, names)?;
        device.integer(name).ok().and_then(|pixels| u32::try_from(pixels).ok())
    };
    let names = device.choices("PixelFormat").unwrap_or_default();
    Ok(CameraFacts {
        model: device.model(),
        sensor: side(&["SensorHeight", "HeightMax"]).zip(side(&["SensorWidth", "WidthMax"])),
        pixel_formats: names.iter().filter_map(|name| name.parse().ok()).collect(),
        trigger_sources: device.choices("TriggerSource").unwrap_or_default(),
        exposure_us: device.float_range("ExposureTime").ok(),
        trigger_delay_us: device.float_range("TriggerDelay").ok().filter(|range| range.end() > range.start()),
    })
}
