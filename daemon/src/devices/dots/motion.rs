//! The mirror's part: the only place that drives it, and that parks it on every way out.

use std::time::Duration;

use raysweep_core::{Clock, DeviceError, DeviceErrorKind, Mirror, MirrorPath, ns_from_us};

/// Interval at which a mirror that plays a path is served.
const FEED: Duration = Duration::from_millis(4);

/// Tolerance of the controller's sample rate, as a share of the path's rate. Drivers measure the rate while the
/// mirror goes to the start of the path, and no more precisely than this. Every batch is synchronised anew.
const RATE_TOLERANCE: f64 = 0.03;

/// The mirror of a run, if the rig has one: parked with the light off when it goes out of scope, on every way out.
pub struct Motion(Option<Box<dyn Mirror>>);

impl Motion {
    /// Takes over a mirror that is at rest.
    pub fn new(mirror: Option<Box<dyn Mirror>>) -> Self {
        Self(mirror)
    }

    /// Whether there is a mirror.
    pub fn is_driven(&self) -> bool {
        self.0.is_some()
    }

    /// Moves the mirror to the path's first point and starts to play the path; parks it instead if `go_on` returns false.
    /// Returns whether the path is played.
    ///
    /// # Errors
    /// An error of the mirror's driver, or a sample rate that would not match the frames.
    pub fn start(
        &mut self,
        path: &MirrorPath,
        rounds: u32,
        go_on: &dyn Fn() -> bool,
    ) -> Result<bool, DeviceError> {
        let Some(mirror) = &mut self.0 else { return Ok(true) };
        if !go_on() {
            return Ok(false);
        }
        let rate_hz = mirror.load(path)?;
        let wanted_hz = path.rate_hz();
        if (rate_hz - wanted_hz).abs() > RATE_TOLERANCE * wanted_hz {
            let what = format!(
                "the controller plays {rate_hz} samples per second, but the plan's rate_hz (in [batches.path], [response] or [viewfinder]) is {wanted_hz}: set it to the controller's rate"
            );
            return Err(DeviceError::new("mirror", DeviceErrorKind::OutOfRange, what));
        }
        if !go_on() {
            mirror.park()?;
            return Ok(false);
        }
        mirror.start(rounds)?;
        Ok(true)
    }

    /// Feeds the mirror until its path is over, or parks it as soon as `go_on` returns false.
    ///
    /// # Errors
    /// An error of the mirror's driver.
    pub fn play(&mut self, clock: &Clock, go_on: &dyn Fn() -> bool) -> Result<(), DeviceError> {
        let Some(mirror) = &mut self.0 else { return Ok(()) };
        let clock = clock.register();
        while go_on() {
            if mirror.feed()?.parked {
                return Ok(());
            }
            clock.sleep_until(clock.now_ns() + ns_from_us(FEED.as_secs_f64() * 1e6));
        }
        mirror.park()
    }
}

impl Drop for Motion {
    fn drop(&mut self) {
        if let Some(Err(error)) = self.0.as_mut().map(|mirror| mirror.park()) {
            tracing::error!(%error, "mirror not parked");
        }
    }
}
