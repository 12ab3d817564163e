//! The camera's own clock, which its timestamps refer to, and its relation to the host's clock.

use serde::{Deserialize, Serialize};

/// A clock with an offset and a drift relative to the host's clock.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CameraClock {
    /// Ticks per second, 1..=10^10.
    pub tick_frequency_hz: u64,
    /// Reading at zero of the host's clock, in ns.
    pub offset_ns: i64,
    /// Rate error relative to the host's clock, in parts per million; positive is fast.
    pub drift_ppm: f64,
}

impl Default for CameraClock {
    fn default() -> Self {
        // [A] Offset and drift are large enough to expose a host that confuses the two clocks.
        Self { tick_frequency_hz: 1_000_000_000, offset_ns: 3_600_000_000_000, drift_ppm: 12.5 }
    }
}

impl CameraClock {
    /// Converts a time of the host's clock to ticks.
    pub fn ticks(&self, host_ns: i64) -> u64 {
        let ns = i128::from(host_ns)
            + (host_ns as f64 * self.drift_ppm * 1e-6) as i128
            + i128::from(self.offset_ns);
        u64::try_from(ns.max(0) * i128::from(self.tick_frequency_hz) / 1_000_000_000).unwrap_or(u64::MAX)
    }

    /// The same clock, reset to zero at `host_ns`.
    pub fn reset(self, host_ns: i64) -> Self {
        let drift_ns = (host_ns as f64 * self.drift_ppm * 1e-6) as i64;
        Self { offset_ns: -host_ns - drift_ns, ..self }
    }
}
