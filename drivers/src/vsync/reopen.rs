//! A watcher whose device may be unplugged and plugged in again during use.

use std::time::{Duration, Instant};

use raysweep_core::{ClockQuality, DeviceError, DeviceErrorKind, DeviceState, Edge, Vsync};

/// Interval of checking whether the device is back.
const LOOK: Duration = Duration::from_millis(250);

/// Opens a device again.
pub type Opener<V> = Box<dyn FnMut() -> Result<V, DeviceError> + Send>;

/// A watcher that is opened again when its device comes back. The numbering of edges continues; it skips at least one
/// number if edges may have been lost.
pub struct Reopened<V> {
    open: Opener<V>,
    patience: Duration,
    device: Option<V>,
    /// Set when the device was lost, until it reports an edge again.
    lost: Option<Lost>,
    /// Added to the device's own edge numbers.
    base: u64,
    last_seq: u64,
}

#[derive(Clone, Copy)]
struct Lost {
    since: Instant,
    looked: Instant,
}

impl<V: Vsync> Reopened<V> {
    /// Watches with `device`. If it is lost, `open` opens it again, for up to `patience`.
    pub fn new(device: V, open: Opener<V>, patience: Duration) -> Self {
        Self { open, patience, device: Some(device), lost: None, base: 0, last_seq: 0 }
    }

    /// Checks whether the device is back.
    fn look(&mut self, timeout: Duration) -> Result<(), DeviceError> {
        let Some(lost) = &mut self.lost else { return Ok(()) };
        std::thread::sleep(timeout.min(LOOK.saturating_sub(lost.looked.elapsed())));
        if lost.looked.elapsed() < LOOK {
            return Ok(());
        }
        lost.looked = Instant::now();
        match (self.open)() {
            Ok(device) => {
                tracing::info!("the VSYNC line's watcher is back");
                self.device = Some(device);
                self.base = self.last_seq + 1;
                Ok(())
            }
            Err(_) if lost.since.elapsed() < self.patience => Ok(()),
            Err(error) => Err(error),
        }
    }

    /// Closes the device after an error that reopening may fix; returns the error when `patience` is exhausted.
    fn lose(&mut self, error: DeviceError) -> Result<(), DeviceError> {
        let now = Instant::now();
        // A device that can be opened but reports no edge is still lost.
        let since = self.lost.map_or(now, |lost| lost.since);
        let passing = matches!(
            error.kind,
            DeviceErrorKind::Disconnected | DeviceErrorKind::Timeout | DeviceErrorKind::Protocol
        );
        if !passing || now - since > self.patience {
            return Err(error);
        }
        tracing::warn!(%error, "the VSYNC line's watcher is lost");
        self.device = None;
        self.lost = Some(Lost { since, looked: now });
        Ok(())
    }
}

impl<V: Vsync> Vsync for Reopened<V> {
    fn next_edge(&mut self, timeout: Duration) -> Result<Option<Edge>, DeviceError> {
        let Some(device) = &mut self.device else {
            self.look(timeout)?;
            return Ok(None);
        };
        match device.next_edge(timeout) {
            Ok(Some(edge)) => {
                self.lost = None;
                self.last_seq = self.base + edge.seq;
                Ok(Some(Edge { seq: self.last_seq, ..edge }))
            }
            Ok(None) => Ok(None),
            Err(error) => self.lose(error).map(|()| None),
        }
    }

    fn state(&self) -> DeviceState {
        if self.lost.is_some() { DeviceState::Lost } else { DeviceState::Streaming }
    }

    fn clock(&self) -> Option<ClockQuality> {
        self.device.as_ref().and_then(Vsync::clock)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU32, Ordering};

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
        let error = loop {
            if let Err(error) = vsync.next_edge(Duration::from_millis(1)) {
                break error;
            }
        };
        assert_eq!(error.kind, DeviceErrorKind::Disconnected);
    }

    #[test]
    fn a_device_that_opens_and_fails_before_its_first_edge_is_given_up() {
        let mut vsync = Reopened::new(Brief(9), Box::new(|| Ok(Brief(9))), 2 * LOOK);
        let began = Instant::now();
        let error = loop {
            if let Err(error) = vsync.next_edge(LOOK) {
                break error;
            }
        };
        assert_eq!(error.kind, DeviceErrorKind::Disconnected);
        assert!(began.elapsed() > 2 * LOOK, "it was opened again meanwhile");
    }
}
