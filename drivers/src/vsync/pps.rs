//! VSYNC as a pulse-per-second source of the kernel: DCD of a serial port with `ldattach PPS /dev/ttyS0`, or a GPIO.
//! The kernel's interrupt takes the timestamps, so they do not include the wake-up time of a thread.

use std::fs::File;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use nix::errno::Errno;
use nix::time::{ClockId, clock_gettime};
use raysweep_config::rig::vsync::Polarity;
use raysweep_core::{Clock, DeviceError, Edge, Vsync};

use super::ioctl::{self, PpsEvent};
use super::system_error;

/// A source may vanish without waking the waiting thread, so its presence is checked at this interval.
const LOOK: Duration = Duration::from_millis(250);

/// The kernel counts waits in ticks of up to 10 ms and does not wait at all for less than one tick.
const TICK: Duration = Duration::from_millis(10);

/// A VSYNC line that the kernel stamps.
pub struct Pps {
    path: PathBuf,
    source: File,
    edge: Polarity,
    clock: Clock,
    sequence: u32,
    seq: u64,
}

impl Pps {
    /// Opens a source, for example `/dev/pps0`. Edges are numbered from 1.
    ///
    /// # Errors
    /// `Disconnected` if it is missing, `Unsupported` if the file is something else.
    pub fn open(path: &Path, edge: Polarity) -> Result<Self, DeviceError> {
        let source = File::options().read(true).write(true).open(path).map_err(|error| {
            system_error(path, "open", Errno::from_raw(error.raw_os_error().unwrap_or_default()))
        })?;
        let mut pps = Self { path: path.to_owned(), source, edge, clock: Clock::real(), sequence: 0, seq: 0 };
        pps.sequence = pps.fetch(Duration::ZERO)?.map_or(0, |event| event.sequence);
        Ok(pps)
    }

    /// The last edge; with a non-zero timeout, waits for any event first.
    fn fetch(&self, timeout: Duration) -> Result<Option<PpsEvent>, DeviceError> {
        match ioctl::fetch(&self.source, timeout) {
            Ok([assert, clear]) => Ok(Some(if self.edge == Polarity::Assert { assert } else { clear })),
            Err(Errno::ETIMEDOUT | Errno::EINTR) if self.path.exists() => Ok(None),
            Err(Errno::ETIMEDOUT | Errno::EINTR) => Err(system_error(&self.path, "PPS_FETCH", Errno::ENODEV)),
            Err(errno) => Err(system_error(&self.path, "PPS_FETCH", errno)),
        }
    }

    fn take(&mut self, event: PpsEvent) -> Option<Edge> {
        let edges = event.sequence.wrapping_sub(self.sequence);
        self.sequence = event.sequence;
        self.seq += u64::from(edges);
        (edges > 0)
            .then(|| Edge { seq: self.seq, host_ns: event.realtime_ns + self.monotonic_minus_realtime_ns() })
    }

    /// The clock of the timestamps may be set at any time, so the offset is measured for each edge.
    fn monotonic_minus_realtime_ns(&self) -> i64 {
        let before_ns = self.clock.now_ns();
        let realtime = clock_gettime(ClockId::CLOCK_REALTIME);
        let after_ns = self.clock.now_ns();
        // The clock exists on every Linux system.
        realtime.map_or(0, |time| {
            before_ns + (after_ns - before_ns) / 2 - (time.tv_sec() * 1_000_000_000 + time.tv_nsec())
        })
    }
}

impl Vsync for Pps {
    fn next_edge(&mut self, timeout: Duration) -> Result<Option<Edge>, DeviceError> {
        let deadline = Instant::now() + timeout;
        // An edge since the last call is returned without waiting. A wait may end with an event of the other kind.
        let mut wait = Duration::ZERO;
        loop {
            if let Some(edge) = self.fetch(wait)?.and_then(|event| self.take(event)) {
                return Ok(Some(edge));
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            wait = left.clamp(TICK, LOOK);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use raysweep_core::DeviceErrorKind;

    #[test]
    fn what_is_no_source_is_refused() {
        let refused = Pps::open(Path::new("/dev/null"), Polarity::Assert).err().unwrap();
        assert_eq!(refused.kind, DeviceErrorKind::Unsupported, "{refused}");
        let missing = Pps::open(Path::new("/dev/pps-none"), Polarity::Assert).err().unwrap();
        assert_eq!(missing.kind, DeviceErrorKind::Disconnected, "{missing}");
    }
}
