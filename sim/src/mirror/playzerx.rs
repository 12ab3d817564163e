//! A PlayzerX controller, after Mirrorcle's published serial protocol: frames 'p' 'l' command length data 0x0A, a FIFO
//! that starts to drain at the sample rate once it holds a sample, and outputs that hold the last one.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use super::mechanics::MechanicsConfig;
use super::plant::{Held, MirrorTruth, Plant};
use super::pty::Controller;

/// Parameters of a simulated PlayzerX.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlayzerXControllerConfig {
    /// The mirror.
    pub mechanics: MechanicsConfig,
    /// Capacity of its FIFO in samples: 125,000, or 83,333 with RGB.
    pub fifo_samples: usize,
    /// Relative clock error; positive is fast.
    pub clock_error: f64,
    /// Highest sample rate that it actually reaches, whatever is requested.
    pub max_rate_hz: f64,
    /// Number of samples after which it stops moving until its FIFO is cleared.
    pub freezes_after: Option<u64>,
    /// Time for which it ignores input after a reset.
    pub reset_s: f64,
}

impl Default for PlayzerXControllerConfig {
    fn default() -> Self {
        Self {
            mechanics: MechanicsConfig::default(),
            fifo_samples: 125_000,
            clock_error: 0.0,
            max_rate_hz: 50_000.0,
            freezes_after: None,
            reset_s: 2.5,
        }
    }
}

/// Output at the origin.
const ORIGIN: Held = Held { x: 2048.0, y: 2048.0, light: 0 };
const LONGEST_FRAME: usize = 11;

/// A monochrome PlayzerX.
pub struct PlayzerXController {
    config: PlayzerXControllerConfig,
    plant: Plant,
    input: Vec<u8>,
    fifo: VecDeque<Held>,
    rate_hz: f64,
    due_ns: f64,
    /// Whether the FIFO ran empty or was cleared; the next sample is then played at once.
    idle: bool,
    played: u64,
    report_ms: u16,
    report_due_ns: i64,
    deaf_until_ns: i64,
}

impl PlayzerXController {
    /// Power-on state: at the origin, dark, 10,000 samples per second.
    pub fn new(config: PlayzerXControllerConfig) -> Self {
        let rate_hz = 10_000.0;
        let full_scale_deg = config.mechanics.max_tilt.0;
        let plant = Plant::new(config.mechanics, rate_hz, ORIGIN, full_scale_deg, |held| {
            [held.x, held.y].map(|code| (code - 2048.0) / 2047.0)
        });
        Self {
            config,
            plant,
            input: Vec::new(),
            fifo: VecDeque::new(),
            rate_hz,
            due_ns: 0.0,
            idle: true,
            played: 0,
            report_ms: 0,
            report_due_ns: 0,
            deaf_until_ns: 0,
        }
    }

    fn drain(&mut self, now_ns: i64) {
        while !self.idle && self.due_ns <= now_ns as f64 {
            if self.config.freezes_after.is_some_and(|samples| self.played >= samples) {
                self.due_ns = now_ns as f64;
                break;
            }
            match self.fifo.pop_front() {
                Some(held) => {
                    self.plant.hold(held, self.due_ns as i64);
                    self.played += 1;
                    self.due_ns += 1e9 / (self.rate_hz * (1.0 + self.config.clock_error));
                }
                None => {
                    self.idle = true;
                    let underruns = u64::from(!self.plant.is_still());
                    self.plant.note(|truth| truth.underruns += underruns);
                }
            }
        }
        self.plant.stand(now_ns);
    }

    fn push(&mut self, held: Held, now_ns: i64) {
        if self.fifo.len() >= self.config.fifo_samples {
            self.plant.note(|truth| truth.overfills += 1);
            return;
        }
        self.fifo.push_back(held);
        if self.idle {
            self.idle = false;
            self.due_ns = now_ns as f64;
        }
    }

    /// Whether there is a frame with this command and length.
    fn is_frame(command: u8, length: usize) -> bool {
        matches!(
            (command, length),
            (b'D' | b'r', 8) | (b'd', 9 | 11) | (b'u', 7) | (b'c' | b'p' | b'n' | b'g', 5) | (b'b', 6)
        )
    }

    fn take_frames(&mut self, now_ns: i64, replies: &mut Vec<u8>) {
        let mut used = 0;
        let input = std::mem::take(&mut self.input);
        while let [first, rest @ ..] = &input[used..] {
            let whole = *first == b'p'
                && rest.first().is_none_or(|byte| *byte == b'l')
                && match (rest.get(1), rest.get(2)) {
                    (Some(&command), Some(&length)) => {
                        Self::is_frame(command, usize::from(length))
                            && rest.get(usize::from(length) - 2).is_none_or(|suffix| *suffix == b'\n')
                    }
                    _ => true,
                };
            if !whole {
                used += 1;
                self.plant.note(|truth| truth.garbage_bytes += 1);
                continue;
            }
            let Some(&length) = rest.get(2) else { break };
            let length = usize::from(length);
            if rest.len() + 1 < length {
                break;
            }
            let frame = &input[used..used + length];
            used += length;
            self.obey(frame[2], &frame[4..length - 1], now_ns, replies);
        }
        self.input = input[used..].to_vec();
        debug_assert!(self.input.len() <= LONGEST_FRAME);
    }

    fn obey(&mut self, command: u8, data: &[u8], now_ns: i64, replies: &mut Vec<u8>) {
        match (command, data) {
            (b'D' | b'd', [x_low, mixed, y_high, light @ ..]) => {
                let x = u16::from(*x_low) | (u16::from(*mixed) & 0xF0) << 4;
                let y = (u16::from(*mixed) & 0x0F) | u16::from(*y_high) << 4;
                // "D" carries no light level: full.
                let light = light.iter().copied().max().unwrap_or(255);
                self.push(Held { x: f64::from(x), y: f64::from(y), light }, now_ns);
            }
            (b'r', [low, middle, high]) => {
                let asked = u32::from_le_bytes([*low, *middle, *high, 0]);
                self.rate_hz = f64::from(asked).clamp(50.0, self.config.max_rate_hz);
                self.plant.set_rate(self.rate_hz);
            }
            (b'u', [low, high]) => {
                self.report_ms = u16::from_le_bytes([*low, *high]);
                self.report_due_ns = now_ns;
            }
            (b'c', _) => {
                self.fifo.clear();
                self.idle = true;
                self.config.freezes_after = None;
            }
            (b'p', _) => replies.extend(b"pl-ok\n"),
            (b'n', _) => replies.extend(b"pl-info\nPX1-SIM\nPLX-2.1.0.0\nXYM\n"),
            (b'g', _) => self.report(replies),
            (b'b', [0xEE]) => {
                self.fifo.clear();
                self.idle = true;
                self.plant.reset(now_ns);
                self.deaf_until_ns = now_ns + (self.config.reset_s * 1e9) as i64;
            }
            _ => self.plant.note(|truth| truth.garbage_bytes += 1),
        }
    }

    fn report(&self, replies: &mut Vec<u8>) {
        replies.extend(b"pl-");
        replies.extend(&(self.fifo.len() as u32).to_le_bytes()[..3]);
    }
}

impl Controller for PlayzerXController {
    fn run(&mut self, bytes: &[u8], now_ns: i64, replies: &mut Vec<u8>) {
        self.drain(now_ns);
        if now_ns < self.deaf_until_ns {
            return;
        }
        self.input.extend(bytes);
        self.take_frames(now_ns, replies);
        if self.report_ms > 0 && now_ns >= self.report_due_ns {
            self.report(replies);
            self.report_due_ns = now_ns + i64::from(self.report_ms) * 1_000_000;
        }
    }

    fn truth(&self) -> Arc<Mutex<MirrorTruth>> {
        self.plant.truth()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(x: u16, y: u16, light: u8) -> Vec<u8> {
        let mixed = ((x >> 4) & 0xF0) as u8 | (y & 0x0F) as u8;
        vec![b'p', b'l', b'd', 9, x as u8, mixed, (y >> 4) as u8, light, b'\n']
    }

    fn left(replies: &[u8]) -> u32 {
        assert_eq!(&replies[..3], b"pl-");
        u32::from_le_bytes([replies[3], replies[4], replies[5], 0])
    }

    fn lock_of(truth: &Mutex<MirrorTruth>) -> MirrorTruth {
        truth.lock().unwrap().clone()
    }

    #[test]
    fn the_fifo_drains_by_the_clock_and_runs_dry_once() {
        let mut controller = PlayzerXController::new(PlayzerXControllerConfig::default());
        let truth = controller.truth();
        let mut replies = Vec::new();
        let samples: Vec<u8> = (0..100).flat_map(|n| frame(2048 + n, 2048 - n, 9)).collect();
        controller.run(&samples, 1_000_000, &mut replies);
        controller.run(b"plg\x05\n", 1_000_000 + 4_950_000, &mut replies);
        assert_eq!(left(&replies), 50, "49.5 samples of 100 us, the first at once");
        controller.run(&[], 1_000_000_000, &mut replies);
        controller.run(&[], 2_000_000_000, &mut replies);
        let truth = lock_of(&truth);
        assert_eq!(truth.underruns, 1);
        let codes: Vec<f64> = truth.held.iter().map(|held| held.x).collect();
        assert_eq!(codes, (0..100).map(|n| f64::from(2048 + n)).collect::<Vec<_>>());
        assert!(truth.longest_lit_ns > 1_900_000_000 && truth.parked_since_ns.is_none());
    }

    #[test]
    fn a_torn_frame_padded_with_zeros_moves_nothing() {
        for torn in 1..9 {
            let mut controller = PlayzerXController::new(PlayzerXControllerConfig::default());
            let truth = controller.truth();
            let mut bytes = frame(100, 100, 255)[..torn].to_vec();
            bytes.extend([0; LONGEST_FRAME]);
            bytes.extend(frame(2050, 2050, 1));
            controller.run(&bytes, 1_000_000, &mut Vec::new());
            controller.run(&[], 1_010_000, &mut Vec::new());
            assert_eq!(lock_of(&truth).held, [Held { x: 2050.0, y: 2050.0, light: 1 }], "torn after {torn}");
        }
    }

    #[test]
    fn a_full_fifo_takes_no_more_and_says_so() {
        let mut controller = PlayzerXController::new(PlayzerXControllerConfig {
            fifo_samples: 10,
            ..PlayzerXControllerConfig::default()
        });
        let truth = controller.truth();
        let samples: Vec<u8> = (0..15).flat_map(|_| frame(2048, 2048, 0)).collect();
        controller.run(&samples, 1_000_000, &mut Vec::new());
        assert_eq!(lock_of(&truth).overfills, 5);
    }
}
