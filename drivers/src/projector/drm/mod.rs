//! A projector on a display output, driven through the kernel (DRM/KMS) without a desktop: nothing else
//! draws, scales or corrects the picture.
//!
//! Two dumb buffers are flipped alternately; the kernel reports when a flip was done. The video timing is
//! forced, because a projector whose rows are tied to it must not get another timing from what a cable
//! reports. Gamma tables are set to linear.

mod screen;
mod timing;

use std::path::PathBuf;

use raysweep_core::{Clock, DeviceError, DeviceErrorKind, Pattern, Projector, Shown};

use super::DEVICE;
use super::picture::{PictureError, render};
use screen::Screen;
pub use timing::Timing;

/// Which output to drive, and how.
#[derive(Debug, Clone, PartialEq)]
pub struct DrmConfig {
    /// The graphics card, for example `/dev/dri/card0`.
    pub card: PathBuf,
    /// The output by the kernel's name, for example `HDMI-A-1`; it is driven even if it reports no display.
    /// `None`: the first output with a display.
    pub connector: Option<String>,
    /// The forced video timing.
    pub timing: Timing,
    /// Video frames from a flip until the picture is certain to be in the light: the projector's own latency,
    /// plus one.
    pub settle_frames: u32,
}

/// The projector. It holds the card while open: no desktop can run on the card.
pub struct DrmProjector {
    screen: Screen,
    clock: Clock,
    settle_ns: i64,
}

impl DrmProjector {
    /// Takes control of the output and shows black.
    ///
    /// # Errors
    /// `Busy` while a desktop runs on the card, `Disconnected` without card or display, `Unsupported` if the
    /// output does not support the timing.
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
        // Cards without vertical blanking report arbitrary timestamps.
        Ok(Shown { not_before_ns: flipped_ns.max(asked_ns) + self.settle_ns })
    }

    fn blank(&mut self) -> Result<Shown, DeviceError> {
        self.show(&Pattern::Black)
    }
}

impl Drop for DrmProjector {
    fn drop(&mut self) {
        // The card may be gone, and the light with it.
        let _ = self.blank();
    }
}
