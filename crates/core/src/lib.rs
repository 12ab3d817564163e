//! The vocabulary of a light-transport rig: units, pixel formats, frames and their pool, clocks, device traits,
//! the accounting of frames, the headers of NumPy's files, and errors.
//!
//! Nothing here opens a device, starts a thread or touches a file. Times are nanoseconds of `CLOCK_MONOTONIC` as
//! `i64` (`_ns`) or microseconds as `f64` (`_us`); every name includes the unit.

mod clock;
mod clock_model;
mod counts;
mod decoding;
mod device;
mod error;
mod film;
mod frame;
mod mirror;
mod npy;
mod pattern;
mod pixel;
mod raster;
mod subject;
mod texts;
mod units;
mod viewfinder;

pub use clock::{Clock, ClockHandle};
pub use clock_model::{ClockModel, ClockQuality, RoundTrip};
pub use counts::{Counts, LossCause, PointUnderWay, VsyncStats};
pub use decoding::{decoding_message, decoding_message_beside};
pub use device::{
    Applied, Camera, CameraCapabilities, CameraSettings, DeviceState, FirstFrame, Projector, Readout,
    SettingsId, SettingsLatency, Shown, Shutter, Vsync,
};
pub use error::{DeviceError, DeviceErrorKind};
pub use film::{FilmSummary, Percentiles};
pub use frame::{Edge, Frame, FrameBuf, FramePool, FrameStamp};
pub use mirror::{
    MAX_POINTS, MechanicalDeg, Mirror, MirrorCapabilities, MirrorLimits, MirrorPath, MirrorPoint,
    MirrorProgress, OpticalDeg, PathError, RasterScan, SecondOrder, Tilt,
};
pub use npy::NpyHeader;
pub use pattern::{PROJECTOR_COLUMNS, Pattern, PatternError, PatternLines};
pub use pixel::{Mosaic, Packing, PixelError, PixelFormat, UnknownPixelFormat, UnpackLevel};
pub use raster::{Raster, Trigger};
pub use subject::Subject;
pub use texts::{Size, io_text};
pub use units::{ns_from_us, us_from_ns};
pub use viewfinder::FinderPicture;
