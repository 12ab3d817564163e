//! The vocabulary of a light-transport rig: units, pixel formats, frames and their pool, clocks, device traits,
//! the accounting of frames, and errors.
//!
//! Nothing here opens a device, starts a thread or touches a file. Times are nanoseconds of `CLOCK_MONOTONIC` as
//! `i64` (`_ns`) or microseconds as `f64` (`_us`); the unit stands in every name.

mod clock;
mod counts;
mod device;
mod error;
mod film;
mod frame;
mod pattern;
mod pixel;
mod raster;
mod units;

pub use clock::{Clock, ClockHandle};
pub use counts::{Counts, LossCause, VsyncStats};
pub use device::{
    Applied, Camera, CameraCapabilities, CameraSettings, FirstFrame, Projector, Readout, SettingsId, Shown,
    Shutter, Vsync,
};
pub use error::{DeviceError, DeviceErrorKind};
pub use film::{FilmSummary, Percentiles};
pub use frame::{Edge, Frame, FrameBuf, FramePool, FrameStamp};
pub use pattern::{Pattern, PatternError};
pub use pixel::{PixelError, PixelFormat};
pub use raster::{Raster, Trigger};
pub use units::{ns_from_us, us_from_ns};
