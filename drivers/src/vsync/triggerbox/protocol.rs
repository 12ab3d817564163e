//! The box's words (firmware 14 of github.com/strawlab/triggerbox), 115200 8N1.
//!
//! The host says `V?`, `P` and a number, `S0`, `S1`, or `T=` with TOP as a little-endian word and the prescaler's key. The box
//! answers `V` and `P` with that letter, the payload's length 7, the payload (version or the question's number, pulses as a
//! little-endian u32, timer as a little-endian u16) and the sum of the payload's bytes.

use crate::mirror::wire::Parsed;

/// The version of the firmware that is spoken to.
pub const VERSION: u8 = 14;
/// Bytes of a question for the time.
pub const QUESTION_BYTES: usize = 2;
/// Bytes of an answer.
pub const REPLY_BYTES: usize = 10;

const PAYLOAD_BYTES: u8 = 7;

/// What the host says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Command {
    /// Which firmware?
    Version,
    /// What time is it? The number comes back with the answer.
    Time(u8),
    /// Stop the timer; time and count of pulses are zero.
    Stop,
    /// Start the timer.
    Start,
    /// Count so far in each period.
    Period(Timer),
}

impl Command {
    /// The command's bytes.
    pub fn to_bytes(self) -> Vec<u8> {
        match self {
            Self::Version => b"V?".to_vec(),
            Self::Time(number) => vec![b'P', number],
            Self::Stop => b"S0".to_vec(),
            Self::Start => b"S1".to_vec(),
            Self::Period(Timer { top, prescaler }) => {
                let [low, high] = top.to_le_bytes();
                vec![b'T', b'=', low, high, prescaler.key()]
            }
        }
    }
}

/// How the box's timer counts: from 0 to `top`, then again.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Timer {
    /// The last value.
    pub top: u16,
    /// How fast it counts.
    pub prescaler: Prescaler,
}

/// By what the 16 MHz of the box's crystal are divided.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Prescaler {
    /// 0.5 us a tick.
    By8,
    /// 4 us a tick.
    By64,
}

impl Prescaler {
    fn key(self) -> u8 {
        match self {
            Self::By8 => b'1',
            Self::By64 => b'2',
        }
    }

    /// What a tick takes.
    pub fn tick_ns(self) -> i64 {
        match self {
            Self::By8 => 500,
            Self::By64 => 4000,
        }
    }
}

impl Timer {
    /// The timer whose period is nearest; `None` if it cannot be so short or so long.
    pub fn with_period_us(period_us: f64) -> Option<Self> {
        let timer = |prescaler: Prescaler| {
            let ticks = (period_us * 1e3 / prescaler.tick_ns() as f64).round();
            // Four times the pulse at least, so that most of a period lies after it.
            let allowed = f64::from(4 * PULSE_TICKS)..=65_536.0;
            allowed.contains(&ticks).then_some(Self { top: (ticks - 1.0) as u16, prescaler })
        };
        timer(Prescaler::By8).or_else(|| timer(Prescaler::By64))
    }

    /// Ticks of a period.
    pub fn period_ticks(self) -> i64 {
        i64::from(self.top) + 1
    }

    /// A moment of the box's clock: ticks since pulse `pulses` began, which was counted at its end.
    pub fn device_ns(self, pulses: i64, ticks: u16) -> i64 {
        (pulses * self.period_ticks() + i64::from(ticks)) * self.prescaler.tick_ns()
    }

    /// Whether a pulse, counted at its end, is certain to be counted at this moment of its period.
    pub fn is_counted(self, ticks: u16) -> bool {
        i64::from(ticks) > 2 * i64::from(PULSE_TICKS) && ticks <= self.top
    }
}

/// How long a pulse is (`OCR1A`).
const PULSE_TICKS: u16 = 1000;

/// What the box answers.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reply {
    /// Its firmware's version.
    Version(u8),
    /// What time it was.
    Time {
        /// The question's number.
        number: u8,
        /// Pulses that have ended since the start.
        pulses: u32,
        /// The timer.
        ticks: u16,
    },
}

/// What the bytes begin with.
pub fn parse_reply(bytes: &[u8]) -> Parsed<Reply> {
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
        b'V' => Reply::Version(first),
        _ => Reply::Time {
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
        assert_eq!(Command::Version.to_bytes(), b"V?");
        assert_eq!(Command::Time(7).to_bytes(), [b'P', 7]);
        assert_eq!((Command::Stop.to_bytes(), Command::Start.to_bytes()), (b"S0".to_vec(), b"S1".to_vec()));
        let timer = Timer { top: 0x3433, prescaler: Prescaler::By64 };
        assert_eq!(Command::Period(timer).to_bytes(), b"T=342");
    }

    #[test]
    fn periods_are_counted_as_finely_as_they_can_be() {
        let timer = Timer::with_period_us(16_666.667).unwrap();
        assert_eq!(timer, Timer { top: 33_332, prescaler: Prescaler::By8 });
        assert_eq!(timer.device_ns(2, 5), (2 * 33_333 + 5) * 500);
        assert_eq!(Timer::with_period_us(40_000.0).unwrap(), Timer { top: 9999, prescaler: Prescaler::By64 });
        assert_eq!(Timer::with_period_us(32_768.0).unwrap().top, 65_535);
        assert!([0.0, 1000.0, 1e6, f64::NAN].iter().all(|&us| Timer::with_period_us(us).is_none()));
    }

    #[test]
    fn replies_are_read_and_all_else_is_garbage() {
        let time = [b'P', 7, 3, 1, 0, 0, 0, 2, 0, 6];
        let reply = Reply::Time { number: 3, pulses: 1, ticks: 2 };
        assert_eq!(parse_reply(&time), Parsed::Reply { reply, used: 10 });
        let version = [b'V', 7, 14, 0, 0, 0, 0, 0, 0, 14];
        assert_eq!(parse_reply(&version), Parsed::Reply { reply: Reply::Version(14), used: 10 });
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
