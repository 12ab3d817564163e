//! What a camera offers, read without setting anything.

use std::sync::Arc;

use raysweep_core::{Clock, DeviceError};

use super::features::{Features, first_present};
use super::library::{Device, Health};
use crate::camera::CameraFacts;

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
    let range = |names: &[&'static str]| device.float_range(first_present(&device, names)?).ok();
    let sensor = side(&["SensorHeight", "HeightMax"]).zip(side(&["SensorWidth", "WidthMax"]));
    let names = device.choices("PixelFormat").unwrap_or_default();
    let formats = names.iter().filter_map(|name| name.parse().ok());
    Ok(CameraFacts {
        model: device.model(),
        formats: formats.map(|format| (format, sensor.into_iter().collect())).collect(),
        trigger_sources: device.choices("TriggerSource").unwrap_or_default(),
        exposure_us: range(&["ExposureTime", "ExposureTimeAbs"]),
        trigger_delay_us: range(&["TriggerDelay", "TriggerDelayAbs"])
            .filter(|range| range.end() > range.start()),
        rate_hz: range(&["AcquisitionFrameRate", "AcquisitionFrameRateAbs"]),
    })
}
