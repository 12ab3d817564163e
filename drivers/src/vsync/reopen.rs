//! A watcher whose device may be unplugged and plugged in again while it is used.

use std::time::{Duration, Instant};

use raysweep_core::{ClockQuality, DeviceError, DeviceErrorKind, Edge, Vsync};

/// How often is looked whether the device is back.
const LOOK: Duration = Duration::from_millis(250);

/// Opens a device anew.
pub type Opener<V> = Box<dyn FnMut() -> Result<V, DeviceError> + Send>;

/// A watcher that is opened again when its device comes back. Edges keep on being numbered; at least one number is left
/// out where edges may have been lost.
pub struct Reopened<V> {
    open: Opener<V>,
    patience: Duration,
    device: Result<V, Lost>,
    /// What is added to the device's own numbers.
    base: u64,
    last_seq: u64,
}

struct Lost {
    since: Instant,
    looked: Instant,
    error: DeviceError,
}

impl<V: Vsync> Reopened<V> {
    /// Watches by `device`, which `open` opens again when it is lost, for up to `patience`.
    pub fn new(device: V, open: Opener<V>, patience: Duration) -> Self {
        Self { open, patience, device: Ok(device), base: 0, last_seq: 0 }
    }

    /// Looks whether the device is back.
    fn look(&mut self, timeout: Duration) -> Result<(), DeviceError> {
        let Err(lost) = &mut self.device else { return Ok(()) };
        std::thread::sleep(timeout.min(LOOK.saturating_sub(lost.looked.elapsed())));
        if lost.looked.elapsed() < LOOK {
            return Ok(());
        }
        lost.looked = Instant::now();
        match (self.open)() {
            Ok(device) => {
                tracing::info!("the VSYNC line's watcher is back");
                self.device = Ok(device);
                self.base = self.last_seq + 1;
                Ok(())
            }
            Err(_) if lost.since.elapsed() < self.patience => Ok(()),
            Err(error) => Err(error),
        }
    }
}

impl<V: Vsync> Vsync for Reopened<V> {
    fn next_edge(&mut self, timeout: Duration) -> Result<Option<Edge>, DeviceError> {
        let device = match &mut self.device {
            Ok(device) => device,
            Err(lost) if lost.since.elapsed() > self.patience => {
                let DeviceError { device, kind, source } = &lost.error;
                return Err(DeviceError::new(device, *kind, source.to_string()));
            }
            Err(_) => {
                self.look(timeout)?;
                return Ok(None);
            }
        };
        match device.next_edge(timeout) {
            Ok(edge) => Ok(edge.map(|edge| {
                self.last_seq = self.base + edge.seq;
                Edge { seq: self.last_seq, ..edge }
            })),
            Err(error) if matches!(error.kind, DeviceErrorKind::Disconnected | DeviceErrorKind::Timeout) => {
                tracing::warn!(%error, "the VSYNC line's watcher is lost");
                let now = Instant::now();
                self.device = Err(Lost { since: now, looked: now, error });
                Ok(None)
            }
            Err(error) => Err(error),
        }
    }

    fn clock(&self) -> Option<ClockQuality> {
        self.device.as_ref().ok().and_then(Vsync::clock)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU32, Ordering};

    use super::*;

    /// Tells a few edges and is then unplugged.
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
                // Away at the first two looks.
                if looks.fetch_add(1, Ordering::Relaxed) < 2 { Err(gone()) } else { Ok(Brief(0)) }
            })
        };
        let mut vsync = Reopened::new(Brief(0), opener, Duration::from_secs(60));
        let mut seen = Vec::new();
        while seen.len() < 6 {
            seen.extend(vsync.next_edge(Duration::from_millis(50)).unwrap().map(|edge| edge.seq));
        }
        assert_eq!(seen, [1, 2, 3, 5, 6, 7]);
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
}
