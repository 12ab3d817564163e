//! A watcher whose device may be unplugged and plugged in again during use.

use std::time::Duration;

use raysweep_core::{Clock, ClockQuality, DeviceError, DeviceErrorKind, DeviceState, Edge, Vsync};

use super::DEVICE;
use crate::reopen::Reopening;

/// Opens a device again.
pub type VsyncOpener<V> = Box<dyn FnMut() -> Result<V, DeviceError> + Send>;

/// A watcher that is opened again when its device comes back. The numbering of edges continues; it skips at least one
/// number if edges may have been lost.
pub struct Reopened<V> {
    open: VsyncOpener<V>,
    reopening: Reopening,
    device: Option<V>,
    /// Added to the device's own edge numbers.
    base: u64,
    last_seq: u64,
}

impl<V: Vsync> Reopened<V> {
    /// Watches with `device`. If it is lost, `open` opens it again, for up to `patience`.
    pub fn new(device: V, open: VsyncOpener<V>, patience: Duration) -> Self {
        let reopening = Reopening::new(DEVICE, patience, Clock::real());
        Self { open, reopening, device: Some(device), base: 0, last_seq: 0 }
    }

    /// Tries to open the lost device, if an attempt is due within `timeout`.
    fn reopen(&mut self, timeout: Duration) -> Result<(), DeviceError> {
        self.reopening.sleep(timeout);
        if !self.reopening.is_due() {
            return Ok(());
        }
        match (self.open)() {
            Ok(device) => {
                self.device = Some(device);
                self.base = self.last_seq + 1;
                self.reopening.opened();
                Ok(())
            }
            Err(error) => self.reopening.failed(&error.source),
        }
    }
}

/// Whether opening the device again may help.
fn is_loss(error: &DeviceError) -> bool {
    matches!(error.kind, DeviceErrorKind::Disconnected | DeviceErrorKind::Timeout | DeviceErrorKind::Protocol)
}

impl<V: Vsync> Vsync for Reopened<V> {
    fn next_edge(&mut self, timeout: Duration) -> Result<Option<Edge>, DeviceError> {
        let Some(device) = &mut self.device else {
            return self.reopen(timeout).map(|()| None);
        };
        match device.next_edge(timeout) {
            Ok(Some(edge)) => {
                self.reopening.delivered();
                self.last_seq = self.base + edge.seq;
                Ok(Some(Edge { seq: self.last_seq, ..edge }))
            }
            // A device that can be opened but reports no edge is still lost.
            Ok(None) => self.reopening.check().map(|()| None),
            Err(error) if is_loss(&error) => {
                self.device = None;
                self.reopening.failed(&error.source).map(|()| None)
            }
            Err(error) => Err(error),
        }
    }

    fn state(&self) -> DeviceState {
        if self.reopening.is_lost() { DeviceState::Lost } else { DeviceState::Streaming }
    }

    fn clock(&self) -> Option<ClockQuality> {
        self.device.as_ref().and_then(Vsync::clock)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU32, Ordering};
    use std::time::Instant;

    use super::*;

    /// Reports a few edges and is then unplugged.
    struct Brief(u64);

    impl Vsync for Brief {
        fn next_edge(&mut self, _: Duration) -> Result<Option<Edge>, DeviceError> {
            self.0 += 1;
            if self.0 > 3 {
                return Err(DeviceError::new("vsync", DeviceErrorKind::Disconnected, "unplugged"));
            }
            Ok(Some(Edge { seq: self.0, host_ns: 0 }))
        }
    }

    fn gone() -> DeviceError {
        DeviceError::new("vsync", DeviceErrorKind::Disconnected, "not there")
    }

    #[test]
    fn edges_go_on_when_the_device_is_back_and_a_number_is_left_out() {
        let looks = Arc::new(AtomicU32::new(0));
        let opener = {
            let looks = looks.clone();
            Box::new(move || {
                // Missing at the first two attempts.
                if looks.fetch_add(1, Ordering::Relaxed) < 2 { Err(gone()) } else { Ok(Brief(0)) }
            })
        };
        let mut vsync = Reopened::new(Brief(0), opener, Duration::from_secs(60));
        let mut seen = Vec::new();
        let mut was_lost = false;
        while seen.len() < 6 {
            seen.extend(vsync.next_edge(Duration::from_millis(50)).unwrap().map(|edge| edge.seq));
            was_lost |= vsync.state() == DeviceState::Lost;
        }
        assert_eq!(seen, [1, 2, 3, 5, 6, 7]);
        assert!(was_lost && vsync.state() == DeviceState::Streaming);
        assert_eq!(looks.load(Ordering::Relaxed), 3);
    }

    #[test]
    fn a_device_that_stays_away_is_given_up() {
        let mut vsync = Reopened::new(Brief(9), Box::new(|| Err(gone())), Duration::ZERO);
        assert_eq!(vsync.next_edge(Duration::ZERO).unwrap(), None);
        let error = vsync.next_edge(Duration::ZERO).unwrap_err();
        assert_eq!(error.kind, DeviceErrorKind::Disconnected);
        assert!(error.to_string().contains("vsync.reopen_s = 0 s: not there"), "{error}");
    }

    #[test]
    fn a_device_that_opens_and_then_fails_or_is_silent_is_given_up() {
        type Answer = fn() -> Result<Option<Edge>, DeviceError>;

        struct Always(Answer);

        impl Vsync for Always {
            fn next_edge(&mut self, _: Duration) -> Result<Option<Edge>, DeviceError> {
                (self.0)()
            }
        }

        const PATIENCE: Duration = Duration::from_millis(200);
        for again in [(|| Err(gone())) as Answer, || Ok(None)] {
            let opener = Box::new(move || Ok(Always(again)));
            let mut vsync = Reopened::new(Always(|| Err(gone())), opener, PATIENCE);
            let began = Instant::now();
            let error = loop {
                if let Err(error) = vsync.next_edge(Duration::from_millis(1)) {
                    break error;
                }
            };
            assert_eq!(error.kind, DeviceErrorKind::Disconnected);
            assert!(began.elapsed() >= PATIENCE);
        }
    }
}
