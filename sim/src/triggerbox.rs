//! A simulated triggerbox (firmware 14) on a pseudo-terminal. Its pulses are the edges of the simulated VSYNC line:
//! both lie on multiples of the period on the host's clock.

use std::io;
use std::path::Path;

use crate::mirror::{Pty, SerialLink, WireFaults};

/// Pulse length in ticks; a pulse is counted at its end.
const PULSE_TICKS: i64 = 1000;
/// Firmware version.
const VERSION: u8 = 14;

/// A plugged-in triggerbox. Dropping it unplugs it.
pub struct TriggerBoxPty(Pty);

impl TriggerBoxPty {
    /// Plugs in a box whose true period is `period_ns`, whatever its crystal measures.
    ///
    /// # Errors
    /// When a pseudo-terminal or a thread cannot be created.
    pub fn plug(period_ns: i64, link: SerialLink, faults: WireFaults) -> io::Result<Self> {
        let mut timer = Timer { period_ns, top: 0x2710, started: Some(0), buffer: Vec::new() };
        let run = move |bytes: &[u8], now_ns, replies: &mut Vec<u8>| timer.run(bytes, now_ns, replies);
        Pty::plug(Box::new(run), link, faults).map(Self)
    }

    /// The port for the driver to open.
    pub fn path(&self) -> &Path {
        self.0.path()
    }

    /// Unplugs the box.
    pub fn unplug(&mut self) {
        self.0.unplug();
    }
}

struct Timer {
    period_ns: i64,
    top: u16,
    /// The period in which the timer was started.
    started: Option<i64>,
    buffer: Vec<u8>,
}

impl Timer {
    fn run(&mut self, bytes: &[u8], now_ns: i64, replies: &mut Vec<u8>) {
        self.buffer.extend(bytes);
        loop {
            // Bytes that are not a command are discarded in pairs, as the firmware does.
            let used = match *self.buffer {
                [b'P', number, ..] => {
                    replies.extend(self.answer(b'P', number, now_ns));
                    2
                }
                [b'V', _, ..] => {
                    replies.extend(self.answer(b'V', VERSION, now_ns));
                    2
                }
                [b'S', state, ..] => {
                    // The timer runs on the grid of the line: it counts as started at the beginning of the current
                    // period.
                    self.started = (state == b'1').then_some(now_ns.div_euclid(self.period_ns));
                    2
                }
                [b'T', b'=', low, high, _, ..] => {
                    self.top = u16::from_le_bytes([low, high]);
                    5
                }
                [b'T', b'=', ..] => return,
                [_, _, ..] => 2,
                _ => return,
            };
            self.buffer.drain(..used);
        }
    }

    fn answer(&self, head: u8, first: u8, now_ns: i64) -> [u8; 10] {
        let ticks = self.started.map_or(0, |_| {
            let elapsed_ns = now_ns.rem_euclid(self.period_ns);
            elapsed_ns * (i64::from(self.top) + 1) / self.period_ns
        });
        let begun = self.started.map_or(0, |started| now_ns.div_euclid(self.period_ns) - started + 1);
        let pulses = begun - i64::from(self.started.is_some() && ticks < PULSE_TICKS);
        let [p0, p1, p2, p3] = (pulses as u32).to_le_bytes();
        let [t0, t1] = (ticks as u16).to_le_bytes();
        let payload = [first, p0, p1, p2, p3, t0, t1];
        let sum = payload.iter().fold(0_u8, |sum, byte| sum.wrapping_add(*byte));
        [head, 7, first, p0, p1, p2, p3, t0, t1, sum]
    }
}
