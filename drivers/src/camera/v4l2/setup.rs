//! A V4L2 camera with what the rig file says elsewhere.

use std::time::Duration;

use raysweep_config::rig::v4l2::V4l2Config;
use raysweep_core::PixelFormat;

/// A camera as a rig file describes it.
#[derive(Debug, Clone, PartialEq)]
pub struct V4l2Setup {
    /// `[camera.v4l2]`
    pub config: V4l2Config,
    /// `camera.pixel_format`
    pub format: PixelFormat,
    /// From the start of one row's exposure to the next row's, as the rig needs it.
    pub row_time_us: f64,
    /// From one trigger to the next.
    pub trigger_period_us: f64,
    /// How long a camera that is lost may stay away.
    pub reopen: Duration,
}
