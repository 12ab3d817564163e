//! The box's protocol (firmware 14 of github.com/strawlab/triggerbox), 115200 8N1.
//!
//! The host sends `V?`, `P` and a number, `S0`, `S1`, or `T=` with TOP as a little-endian word and the prescaler's
//! key. The box answers `V` and `P` with that letter, the payload's length 7, the payload (version or the request's
//! number, pulses as a little-endian u32, timer as a little-endian u16) and the sum of the payload's bytes.

use crate::serial::wire::Parsed;

/// The supported firmware version.
pub const VERSION: u8 = 14;
/// Bytes of a time request.
pub const QUESTION_BYTES: usize = 2;
/// Bytes of a reply.
pub const REPLY_BYTES: usize = 10;

const PAYLOAD_BYTES: u8 = 7;

/// A command from the host.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TriggerBoxCommand {
    /// Requests the firmware version.
    Version,
    /// Requests the time. The reply repeats the number.
    Time(u8),
    /// Stops the timer and sets time and pulse count to zero.
    Stop,
    /// Starts the timer.
    Start,
    /// Sets the timer's period.
    Period(TriggerBoxTimer),
}

impl TriggerBoxCommand {
    /// The bytes of the command.
    pub fn to_bytes(self) -> Vec<u8> {
        match self {
            Self::Version => b"V?".to_vec(),
            Self::Time(number) => vec![b'P', number],
            Self::Stop => b"S0".to_vec(),
            Self::Start => b"S1".to_vec(),
            Self::Period(TriggerBoxTimer { top, prescaler }) => {
                let [low, high] = top.to_le_bytes();
                vec![b'T', b'=', low, high, prescaler.key()]
            }
        }
    }
}

/// The box's timer: it counts from 0 to `top` and starts again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TriggerBoxTimer {
    /// The last value.
    pub top: u16,
    /// The counting rate.
    pub prescaler: Prescaler,
}

/// Divisor of the box's 16 MHz crystal.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Prescaler {
    /// 0.5 us per tick.
    By8,
    /// 4 us per tick.
    By64,
}

impl Prescaler {
    fn key(self) -> u8 {
        match self {
            Self::By8 => b'1',
            Self::By64 => b'2',
        }
    }

    /// Duration of a tick.
    pub fn tick_ns(self) -> i64 {
        match self {
            Self::By8 => 500,
            Self::By64 => 4000,
        }
    }
}

impl TriggerBoxTimer {
    /// The timer with the nearest period; `None` if the period is too short or too long.
    pub fn with_period_us(period_us: f64) -> Option<Self> {
        let timer = |prescaler: Prescaler| {
            let ticks = (period_us * 1e3 / prescaler.tick_ns() as f64).round();
            // At least four times the pulse, so that most of a period lies after it.
            let allowed = f64::from(4 * PULSE_TICKS)..=65_536.0;
            allowed.contains(&ticks).then_some(Self { top: (ticks - 1.0) as u16, prescaler })
        };
        timer(Prescaler::By8).or_else(|| timer(Prescaler::By64))
    }

    /// Ticks per period.
    pub fn period_ticks(self) -> i64 {
        i64::from(self.top) + 1
    }

    /// A time on the box's clock, from the number of counted pulses (each counted at its end) and the ticks of the
    /// timer.
    pub fn device_ns(self, pulses: i64, ticks: u16) -> i64 {
        (pulses * self.period_ticks() + i64::from(ticks)) * self.prescaler.tick_ns()
    }

    /// Whether the pulse of the current period, counted at its end, is certain to be counted at this tick.
    pub fn is_counted(self, ticks: u16) -> bool {
        i64::from(ticks) > 2 * i64::from(PULSE_TICKS) && ticks <= self.top
    }
}

/// Length of a pulse (`OCR1A`).
const PULSE_TICKS: u16 = 1000;

/// A reply from the box.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TriggerBoxReply {
    /// Its firmware version.
    Version(u8),
    /// Its time.
    Time {
        /// The number of the request.
        number: u8,
        /// Pulses that have ended since the start.
        pulses: u32,
        /// The timer's value.
        ticks: u16,
    },
}

/// Parses the reply at the start of `bytes`.
pub fn parse_reply(bytes: &[u8]) -> Parsed<TriggerBoxReply> {
    let is_head = |bytes: &[u8]| matches!(bytes, [b'P' | b'V', PAYLOAD_BYTES, ..] | [b'P' | b'V'] | []);
    if !is_head(bytes) {
        let used = (1..bytes.len()).find(|&start| is_head(&bytes[start..])).unwrap_or(bytes.len());
        return Parsed::Garbage { used };
    }
    let &[head, _, first, p0, p1, p2, p3, t0, t1, sum, ..] = bytes else { return Parsed::Incomplete };
    let payload = [first, p0, p1, p2, p3, t0, t1];
    if payload.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte)) != sum {
        return Parsed::Garbage { used: 1 };
    }
    let reply = match head {
        b'V' => TriggerBoxReply::Version(first),
        _ => TriggerBoxReply::Time {
            number: first,
            pulses: u32::from_le_bytes([p0, p1, p2, p3]),
            ticks: u16::from_le_bytes([t0, t1]),
        },
    };
    Parsed::Reply { reply, used: REPLY_BYTES }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_the_firmware_s() {
        assert_eq!(TriggerBoxCommand::Version.to_bytes(), b"V?");
        assert_eq!(TriggerBoxCommand::Time(7).to_bytes(), [b'P', 7]);
        assert_eq!(
            (TriggerBoxCommand::Stop.to_bytes(), TriggerBoxCommand::Start.to_bytes()),
            (b"S0".to_vec(), b"S1".to_vec())
        );
        let timer = TriggerBoxTimer { top: 0x3433, prescaler: Prescaler::By64 };
        assert_eq!(TriggerBoxCommand::Period(timer).to_bytes(), b"T=342");
    }

    #[test]
    fn periods_are_counted_as_finely_as_they_can_be() {
        let timer = TriggerBoxTimer::with_period_us(16_666.667).unwrap();
        assert_eq!(timer, TriggerBoxTimer { top: 33_332, prescaler: Prescaler::By8 });
        assert_eq!(timer.device_ns(2, 5), (2 * 33_333 + 5) * 500);
        assert_eq!(
            TriggerBoxTimer::with_period_us(40_000.0).unwrap(),
            TriggerBoxTimer { top: 9999, prescaler: Prescaler::By64 }
        );
        assert_eq!(TriggerBoxTimer::with_period_us(32_768.0).unwrap().top, 65_535);
        assert!([0.0, 1000.0, 1e6, f64::NAN].iter().all(|&us| TriggerBoxTimer::with_period_us(us).is_none()));
    }

    #[test]
    fn replies_are_read_and_all_else_is_garbage() {
        let time = [b'P', 7, 3, 1, 0, 0, 0, 2, 0, 6];
        let reply = TriggerBoxReply::Time { number: 3, pulses: 1, ticks: 2 };
        assert_eq!(parse_reply(&time), Parsed::Reply { reply, used: 10 });
        let version = [b'V', 7, 14, 0, 0, 0, 0, 0, 0, 14];
        assert_eq!(parse_reply(&version), Parsed::Reply { reply: TriggerBoxReply::Version(14), used: 10 });
        for length in 0..10 {
            assert_eq!(parse_reply(&time[..length]), Parsed::Incomplete, "{length}");
        }
        let mut damaged = time;
        damaged[5] = 1;
        assert_eq!(parse_reply(&damaged), Parsed::Garbage { used: 1 });
        assert_eq!(parse_reply(b"xPyP\x07"), Parsed::Garbage { used: 3 });
        assert_eq!(parse_reply(b"xyz"), Parsed::Garbage { used: 3 });
    }
}
