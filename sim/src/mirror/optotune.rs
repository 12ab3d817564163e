//! An Optotune MR-E-2 controller in simple mode: one line per command, answered by `OK`, `NO`, `OL` or `OU`. It
//! controls no light.

use std::sync::{Arc, Mutex};

use super::mechanics::MechanicsConfig;
use super::plant::{Held, MirrorTruth, Plant};
use super::pty::Controller;

const ORIGIN: Held = Held { x: 0.0, y: 0.0, light: 0 };
const MECHANICS_RATE_HZ: f64 = 10_000.0;
const LONGEST_LINE: usize = 64;

/// An MR-E-2 controller.
pub struct OptotuneController {
    plant: Plant,
    line: Vec<u8>,
    at: Held,
}

impl OptotuneController {
    /// Power-on state, at the origin.
    pub fn new(mechanics: MechanicsConfig) -> Self {
        // x = tan(optical angle) / tan 50 degrees; the optical angle is twice the mechanical angle.
        let to_tilt = |held: Held| {
            [held.x, held.y].map(|x| (x * 50.0_f64.to_radians().tan()).atan().to_degrees() / 2.0)
        };
        Self {
            plant: Plant::new(mechanics, MECHANICS_RATE_HZ, ORIGIN, 1.0, to_tilt),
            line: Vec::new(),
            at: ORIGIN,
        }
    }

    fn answer(&mut self, line: &str, now_ns: i64) -> &'static str {
        let line = line.to_ascii_uppercase().replace(' ', "");
        let number = |text: &str| text.parse::<f64>().ok().filter(|value| value.is_finite());
        let next = match line.split_once('=') {
            None if ["START", "STATUS"].contains(&line.as_str()) => return "OK",
            Some(("X", x)) => number(x).map(|x| Held { x, ..self.at }),
            Some(("Y", y)) => number(y).map(|y| Held { y, ..self.at }),
            Some(("XY", both)) => both.split_once(';').and_then(|(x, y)| {
                let (x, y) = (number(x)?, number(y)?);
                Some(Held { x, y, ..self.at })
            }),
            _ => None,
        };
        match next {
            None => "NO",
            Some(held) if held.x.min(held.y) < -1.0 => "OL",
            Some(held) if held.x.max(held.y) > 1.0 => "OU",
            Some(held) => {
                self.at = held;
                self.plant.hold(held, now_ns);
                "OK"
            }
        }
    }
}

impl Controller for OptotuneController {
    fn run(&mut self, bytes: &[u8], now_ns: i64, replies: &mut Vec<u8>) {
        for &byte in bytes {
            if byte != b'\n' {
                self.line.push(byte);
                if self.line.len() > LONGEST_LINE {
                    let garbage = self.line.len() as u64;
                    self.plant.note(|truth| truth.garbage_bytes += garbage);
                    self.line.clear();
                }
                continue;
            }
            let line = String::from_utf8_lossy(&std::mem::take(&mut self.line)).trim_end().to_owned();
            replies.extend(self.answer(&line, now_ns).as_bytes());
            replies.extend(b"\r\n");
        }
    }

    fn truth(&self) -> Arc<Mutex<MirrorTruth>> {
        self.plant.truth()
    }
}
