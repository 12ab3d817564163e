//! The analyser's protocol (sigrok's firmware fx2lafw 1.x): vendor requests on endpoint 0, samples on bulk endpoint
//! 0x82, one byte per sample, bit k for input k.

/// Requests the firmware version: two bytes, major and minor.
pub const VERSION: u8 = 0xB0;
/// Starts sampling; the data are [`SampleRate::start_command`].
pub const START: u8 = 0xB1;
/// Endpoint of the samples.
pub const SAMPLES: u8 = 0x82;
/// Writes to the address in `wValue` (request of the chip's own loader).
pub const WRITE_RAM: u8 = 0xA0;
/// The register that holds the chip's processor in reset.
pub const CPUCS: u16 = 0xE600;
/// The supported major version.
pub const MAJOR: u8 = 1;
/// Maximum bytes per write to the chip's memory.
pub const WRITE_BYTES: usize = 4096;
/// Maximum size of a firmware: the chip's program memory.
pub const FIRMWARE_BYTES: usize = 16 * 1024;

/// Maximum delay between samples, in clock periods.
const MAX_DELAY: u32 = 6 * 256;

/// A sample rate: one of the analyser's two clocks, divided.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SampleRate {
    hz: u32,
    flags: u8,
    delay: u16,
}

impl SampleRate {
    /// The rate, if the analyser supports it exactly: 48 or 30 MHz divided by an integer, up to 24 MHz.
    pub fn from_hz(hz: u32) -> Option<Self> {
        let clocks = [(48_000_000, 0x40), (30_000_000, 0)];
        clocks.into_iter().find_map(|(clock_hz, flags): (u32, u8)| {
            let fits = (1..=24_000_000).contains(&hz) && clock_hz % hz == 0;
            let delay = fits.then(|| clock_hz / hz - 1).filter(|delay| *delay <= MAX_DELAY)?;
            Some(Self { hz, flags, delay: delay as u16 })
        })
    }

    /// Samples per second.
    pub fn hz(self) -> u32 {
        self.hz
    }

    /// Time in ns, on the analyser's clock, from the first sample to the sample with this number.
    pub fn device_ns(self, sample: u64) -> i64 {
        (i128::from(sample) * 1_000_000_000 / i128::from(self.hz)) as i64
    }

    /// The data of [`START`]: flags, and the delay, high byte first.
    pub fn start_command(self) -> [u8; 3] {
        let [high, low] = self.delay.to_be_bytes();
        [self.flags, high, low]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rates_are_those_of_the_clocks() {
        let command = |hz| SampleRate::from_hz(hz).map(SampleRate::start_command);
        assert_eq!(command(1_000_000), Some([0x40, 0, 47]));
        assert_eq!(command(24_000_000), Some([0x40, 0, 1]));
        assert_eq!(command(15_000_000), Some([0, 0, 1]));
        assert_eq!(command(20_000), Some([0, 5, 219]), "48 MHz would take 2399 clocks");
        assert!(
            [0, 7, 1_000_001, 48_000_000, 10_000].into_iter().all(|hz| SampleRate::from_hz(hz).is_none())
        );
        assert_eq!(SampleRate::from_hz(24_000_000).unwrap().device_ns(3), 125);
    }
}
