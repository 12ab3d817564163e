//! A projector on a display output, driven through the kernel (DRM/KMS) without a desktop: nothing else draws, scales or
//! corrects what is shown.
//!
//! Two dumb buffers are flipped in turn; the kernel tells when a flip was done. The video timing is forced, since an engine
//! whose rows are tied to it must not be given another one by what a cable reports; gamma tables are set linear.

mod screen;
mod timing;

use std::path::PathBuf;

use raysweep_core::{Clock, DeviceError, DeviceErrorKind, Pattern, Projector, Shown};

use super::DEVICE;
use super::picture::{PictureError, render};
use screen::Screen;
pub use timing::Timing;

/// Which output, and how it is driven.
#[derive(Debug, Clone, PartialEq)]
pub struct DrmConfig {
    /// The graphics card: `/dev/dri/card0`.
    pub card: PathBuf,
    /// The output by the kernel's name, `HDMI-A-1`; then it is driven whether or not it reports a display. `None`: the
    /// first with a display.
    pub connector: Option<String>,
    /// The video timing that is forced.
    pub timing: Timing,
    /// Video frames from a flip until the picture is certain to be in the light: the engine's own latency, plus one.
    pub settle_frames: u32,
}

/// The projector. Who opens it holds the card: no desktop can run on it.
pub struct DrmProjector {
    screen: Screen,
    clock: Clock,
    settle_ns: i64,
}

impl DrmProjector {
    /// Takes the output and shows black.
    ///
    /// # Errors
    /// `Busy` while a desktop runs on the card, `Disconnected` without card or display, `Unsupported` if the output cannot
    /// have that timing.
    pub fn open(config: &DrmConfig) -> Result<Self, DeviceError> {
        let screen = Screen::open(config).map_err(screen::Error::into_device_error)?;
        let settle_ns = (f64::from(config.settle_frames) * config.timing.period_us() * 1e3).ceil() as i64;
        Ok(Self { screen, clock: Clock::real(), settle_ns })
    }
}

impl Projector for DrmProjector {
    fn show(&mut self, pattern: &Pattern) -> Result<Shown, DeviceError> {
        let picture = render(pattern, self.screen.size())
            .map_err(|error: PictureError| DeviceError::new(DEVICE, DeviceErrorKind::OutOfRange, error))?;
        let asked_ns = self.clock.now_ns();
        let flipped_ns = self.screen.flip(&picture).map_err(screen::Error::into_device_error)?;
        // Cards without vertical blanking stamp as they like.
        Ok(Shown { not_before_ns: flipped_ns.max(asked_ns) + self.settle_ns })
    }

    fn blank(&mut self) -> Result<Shown, DeviceError> {
        self.show(&Pattern::Black)
    }
}

impl Drop for DrmProjector {
    fn drop(&mut self) {
        // The card may be gone, and with it the light.
        let _ = self.blank();
    }
}
