//! When a lost device is opened again and when it is given up: one policy for cameras and VSYNC watchers.

use std::fmt::Display;
use std::time::Duration;

use raysweep_core::{Clock, DeviceError, DeviceErrorKind};

/// Pause before the second attempt; the first is made at once. The pause doubles from attempt to attempt.
const FIRST_PAUSE_NS: i64 = 100_000_000;
/// Maximum pause: how long a device that is back may go unnoticed.
const LONGEST_PAUSE_NS: i64 = 1_000_000_000;
/// How long a device that was opened may take to deliver, even if its time is over: after a pause of the run, in which
/// nobody asked for frames, it may be opened only then.
const FIRST_DELIVERY_NS: i64 = 2_000_000_000;

/// Decides when a lost device is opened again. A loss begins with a failure and ends with the next frame or edge: a
/// device that can be opened but fails before it delivers anything is still lost. A loss is logged when it begins and
/// when it ends; failed attempts are logged for debugging only. The last attempt is made when the time that the device
/// may stay away is over.
pub struct Reopening {
    device: &'static str,
    patience: Duration,
    clock: Clock,
    loss: Option<Loss>,
}

struct Loss {
    since_ns: i64,
    /// When the next attempt is due.
    attempt_ns: i64,
    /// Pause before the attempt after that.
    pause_ns: i64,
    /// When it was opened, if it has not failed since.
    opened_ns: Option<i64>,
    /// What failed last.
    cause: String,
}

impl Reopening {
    /// A device that works. If it is lost, it may stay away for `patience`, which the rig file sets as
    /// `<device>.reopen_s`.
    pub fn new(device: &'static str, patience: Duration, clock: Clock) -> Self {
        Self { device, patience, clock, loss: None }
    }

    /// Whether the device is lost and has delivered nothing since.
    pub fn is_lost(&self) -> bool {
        self.loss.is_some()
    }

    /// The device has failed, or an attempt to open it has: schedules the next attempt.
    ///
    /// # Errors
    /// As [`Self::check`].
    pub fn failed(&mut self, cause: &dyn Display) -> Result<(), DeviceError> {
        let now_ns = self.clock.now_ns();
        let Some(loss) = &mut self.loss else {
            let reopen_s = self.patience.as_secs_f64();
            tracing::warn!(%cause, "{0} lost; it may stay away for {0}.reopen_s = {reopen_s} s", self.device);
            self.loss = Some(Loss {
                since_ns: now_ns,
                attempt_ns: now_ns,
                pause_ns: FIRST_PAUSE_NS,
                opened_ns: None,
                cause: cause.to_string(),
            });
            return Ok(());
        };
        tracing::debug!(%cause, "{} still lost", self.device);
        loss.cause = cause.to_string();
        loss.opened_ns = None;
        let last_ns = loss.since_ns.saturating_add(nanoseconds(self.patience));
        loss.attempt_ns = (now_ns + loss.pause_ns).min(last_ns);
        loss.pause_ns = (2 * loss.pause_ns).min(LONGEST_PAUSE_NS);
        self.check()
    }

    /// # Errors
    /// `Disconnected` if the device is lost and the time that it may stay away is over.
    pub fn check(&self) -> Result<(), DeviceError> {
        let Some(loss) = &self.loss else { return Ok(()) };
        let now_ns = self.clock.now_ns();
        if now_ns - loss.since_ns < nanoseconds(self.patience)
            || loss.opened_ns.is_some_and(|opened_ns| now_ns - opened_ns < FIRST_DELIVERY_NS)
        {
            return Ok(());
        }
        let (device, reopen_s, cause) = (self.device, self.patience.as_secs_f64(), &loss.cause);
        let what = match loss.opened_ns {
            None => {
                format!("was lost and did not come back within {device}.reopen_s = {reopen_s} s: {cause}")
            }
            Some(_) => format!(
                "was lost ({cause}) and opened again, but delivered nothing within {device}.reopen_s = {reopen_s} s: check the signal at its input"
            ),
        };
        Err(DeviceError::new(self.device, DeviceErrorKind::Disconnected, what))
    }

    /// Whether the device is lost and an attempt to open it is due.
    pub fn is_due(&self) -> bool {
        self.loss.as_ref().is_some_and(|loss| self.clock.now_ns() >= loss.attempt_ns)
    }

    /// Sleeps until an attempt is due, for at most `timeout`.
    pub fn sleep(&self, timeout: Duration) {
        let until_ns = self.clock.now_ns().saturating_add(nanoseconds(timeout));
        let attempt_ns = self.loss.as_ref().map_or(i64::MAX, |loss| loss.attempt_ns);
        self.clock.register().sleep_until(until_ns.min(attempt_ns));
    }

    /// The device was opened or armed. If it was lost, it still is until it delivers.
    pub fn opened(&mut self) {
        if let Some(loss) = &mut self.loss {
            loss.opened_ns = Some(self.clock.now_ns());
        }
    }

    /// The device has delivered a frame or an edge: it is not lost, or no longer.
    pub fn delivered(&mut self) {
        if let Some(loss) = self.loss.take() {
            let away_s = (self.clock.now_ns() - loss.since_ns) as f64 * 1e-9;
            tracing::info!(away_s, "{} is back", self.device);
        }
    }
}

fn nanoseconds(duration: Duration) -> i64 {
    i64::try_from(duration.as_nanos()).unwrap_or(i64::MAX)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Fails every attempt; returns when they were made, in milliseconds, and the final error.
    fn fail_until_given_up(reopening: &mut Reopening, clock: &Clock) -> (Vec<i64>, DeviceError) {
        let mut attempts_ms = Vec::new();
        loop {
            reopening.sleep(Duration::MAX);
            assert!(reopening.is_due());
            attempts_ms.push(clock.now_ns() / 1_000_000);
            if let Err(error) = reopening.failed(&"not there") {
                return (attempts_ms, error);
            }
        }
    }

    #[test]
    fn a_lost_device_is_tried_at_growing_intervals_until_its_time_is_over_or_it_delivers() {
        let clock = Clock::simulated();
        let mut reopening = Reopening::new("camera", Duration::from_secs(3), clock.clone());
        assert!(!reopening.is_due() && !reopening.is_lost());
        reopening.failed(&"unplugged").unwrap();
        clock.register().sleep_until(50_000_000);
        assert!(reopening.is_due() && reopening.check().is_ok());
        // It can be opened, but fails before the first frame: still the same loss.
        reopening.failed(&"no frame").unwrap();
        assert!(reopening.is_lost() && !reopening.is_due());
        let (attempts_ms, error) = fail_until_given_up(&mut reopening, &clock);
        assert_eq!(attempts_ms, [150, 350, 750, 1550, 2550, 3000]);
        assert_eq!(error.kind, DeviceErrorKind::Disconnected);
        assert_eq!(
            error.to_string(),
            "camera: was lost and did not come back within camera.reopen_s = 3 s: not there"
        );

        reopening.delivered();
        assert!(!reopening.is_lost() && reopening.check().is_ok());
        reopening.failed(&"unplugged").unwrap();
        let (attempts_ms, _) = fail_until_given_up(&mut reopening, &clock);
        assert_eq!(attempts_ms, [3000, 3100, 3300, 3700, 4500, 5500, 6000], "a new loss");
    }

    #[test]
    fn a_device_that_opens_late_has_some_time_to_deliver() {
        let clock = Clock::simulated();
        let mut reopening = Reopening::new("camera", Duration::from_secs(3), clock.clone());
        reopening.failed(&"unplugged").unwrap();
        clock.register().sleep_until(10_000_000_000);
        reopening.opened();
        clock.register().sleep_until(11_999_999_999);
        assert!(reopening.is_lost() && reopening.check().is_ok());
        clock.register().sleep_until(12_000_000_000);
        let silent = reopening.check().unwrap_err().to_string();
        assert!(silent.contains("(unplugged)") && silent.contains("camera.reopen_s = 3 s"), "{silent}");
        reopening.opened();
        assert!(reopening.failed(&"no frame").is_err(), "a device that fails has no such time");
    }

    #[test]
    fn a_device_without_patience_is_tried_once() {
        let clock = Clock::simulated();
        let mut reopening = Reopening::new("vsync", Duration::ZERO, clock.clone());
        reopening.failed(&"unplugged").unwrap();
        assert_eq!(fail_until_given_up(&mut reopening, &clock).0, [0]);
    }
}
