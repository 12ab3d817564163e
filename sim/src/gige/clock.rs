//! The camera's own clock: what its stamps are counted on, and how it runs against the host's.

use serde::{Deserialize, Serialize};

/// A clock that ticks beside the host's, from another zero and not quite at the same pace.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DeviceClock {
    /// Ticks a second, 1..=10^10.
    pub tick_frequency_hz: u64,
    /// What it reads at zero of the host's clock, in ns.
    pub offset_ns: i64,
    /// How much faster than the host's clock it runs, in parts per million.
    pub drift_ppm: f64,
}

impl Default for DeviceClock {
    fn default() -> Self {
        // [A] Offset and drift: enough that a host which mistakes one clock for the other cannot miss it.
        Self { tick_frequency_hz: 1_000_000_000, offset_ns: 3_600_000_000_000, drift_ppm: 12.5 }
    }
}

impl DeviceClock {
    /// Ticks at a time of the host's clock.
    pub fn ticks(&self, host_ns: i64) -> u64 {
        let ns = i128::from(host_ns)
            + (host_ns as f64 * self.drift_ppm * 1e-6) as i128
            + i128::from(self.offset_ns);
        u64::try_from(ns.max(0) * i128::from(self.tick_frequency_hz) / 1_000_000_000).unwrap_or(u64::MAX)
    }

    /// The same clock, set to zero at `host_ns`.
    pub fn reset(self, host_ns: i64) -> Self {
        let drift_ns = (host_ns as f64 * self.drift_ppm * 1e-6) as i64;
        Self { offset_ns: -host_ns - drift_ns, ..self }
    }
}
