//! A look at what the camera sees, before any point is acquired.

use std::sync::mpsc::Sender;

use raysweep_core::{CameraSettings, DeviceError, DeviceErrorKind};

use super::{Acquisition, POLL, Watchdog};

/// A few frames that belong to no point.
#[derive(Debug, Clone)]
pub struct Glance {
    /// Their settings.
    pub settings: CameraSettings,
    /// Frames exposed earlier may still show the previous image.
    pub not_before_ns: i64,
    /// How many.
    pub frames: u32,
    /// Where their sum goes, row by row, unless the run is told to end before.
    pub seen: Sender<Vec<u32>>,
}

impl Acquisition {
    /// Adds up frames and passes them on as those of no point.
    pub(super) fn glance(&mut self, glance: &Glance) -> Result<(), DeviceError> {
        self.warm_up(glance.not_before_ns)?;
        self.pass_until_due()?;
        self.pass_through(&glance.settings)?;
        self.see_through()?;
        let capabilities = self.camera.capabilities();
        let (format, pixels) = (capabilities.format, capabilities.height * capabilities.width);
        let mut sums = vec![0; pixels];
        let mut left = glance.frames;
        let mut watchdog = Watchdog::default();
        while left > 0 && self.orders.go_on() {
            let Some(received) = self.receive(POLL)? else {
                watchdog.missed(POLL, self.longest_frame_us, self.camera.state())?;
                continue;
            };
            watchdog.feed();
            if let Some(data) = &received.data {
                format
                    .add_to(data, &mut sums)
                    .map_err(|error| DeviceError::new("camera", DeviceErrorKind::Protocol, error))?;
                left -= 1;
            }
            self.pass(received)?;
        }
        if left == 0 {
            // Nobody waits for it any more if the run has failed.
            let _ = glance.seen.send(sums);
        }
        Ok(())
    }
}
