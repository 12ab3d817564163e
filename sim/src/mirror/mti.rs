//! A Mirrorcle MTI controller in ASCII mode: one line per command, one line per answer.

use std::sync::{Arc, Mutex};

use super::mechanics::MechanicsConfig;
use super::plant::{Held, MirrorTruth, Plant};
use super::pty::Controller;

const ORIGIN: Held = Held { x: 0.0, y: 0.0, light: 0 };
/// Rate at which the mirror's motion is computed between commands.
const MECHANICS_RATE_HZ: f64 = 10_000.0;
const LONGEST_LINE: usize = 64;

/// An MTI controller.
pub struct MtiController {
    plant: Plant,
    line: Vec<u8>,
    in_command_mode: bool,
    bias_v: Option<f64>,
    difference_v: Option<f64>,
    bandwidth_hz: Option<f64>,
    enabled: bool,
}

impl MtiController {
    /// Power-on state: high voltage off, not in command mode.
    pub fn new(mechanics: MechanicsConfig) -> Self {
        let plant =
            Plant::new(mechanics, MECHANICS_RATE_HZ, ORIGIN, mechanics.max_tilt.0, |held| [held.x, held.y]);
        Self {
            plant,
            line: Vec::new(),
            in_command_mode: false,
            bias_v: None,
            difference_v: None,
            bandwidth_hz: None,
            enabled: false,
        }
    }

    /// Answers one line; `None` if the line is ignored.
    fn answer(&mut self, line: &str, now_ns: i64) -> Option<&'static str> {
        if line == "$MTI$" && !self.in_command_mode {
            self.in_command_mode = true;
            return Some("MTI-Device MTI-MZ-2.3.113:USB Ready in Command Mode");
        }
        if !self.in_command_mode {
            return None;
        }
        let mut words = line.split(' ');
        let command = words.next().unwrap_or_default();
        let numbers: Option<Vec<f64>> = words.map(|word| word.parse().ok()).collect();
        let Some(numbers) = numbers else { return Some("MTI-ERR InvalidParameter") };
        let within = |low: f64, high: f64| match numbers[..] {
            [value] if (low..=high).contains(&value) => Some(value),
            _ => None,
        };
        let setting = match command {
            "MTI+VB" => Some((&mut self.bias_v, within(0.0, 100.0))),
            "MTI+VD" => Some((&mut self.difference_v, within(0.0, 200.0))),
            "MTI+BW" => Some((&mut self.bandwidth_hz, within(50.0, 15_000.0))),
            _ => None,
        };
        if let Some((setting, value)) = setting {
            if self.enabled {
                return Some("MTI-ERR DeviceEnabled");
            }
            *setting = value;
            return Some(if value.is_some() { "MTI-OK" } else { "MTI-ERR InvalidParameter" });
        }
        match (command, &numbers[..]) {
            ("MTI+EN", []) if self.bias_v.and(self.difference_v).and(self.bandwidth_hz).is_none() => {
                return Some("MTI-ERR InvalidState");
            }
            ("MTI+EN", []) => self.enabled = true,
            ("MTI+DI", []) => {
                self.enabled = false;
                self.plant.hold(ORIGIN, now_ns);
            }
            ("MTI+GT", [x, y, light]) if self.enabled => {
                if ![x, y].iter().all(|part| (-1.0..=1.0).contains(*part)) || !(0.0..=255.0).contains(light) {
                    return Some("MTI-ERR InvalidParameter");
                }
                self.plant.hold(Held { x: *x, y: *y, light: *light as u8 }, now_ns);
            }
            ("MTI+GT", [_, _, _]) => return Some("MTI-ERR DeviceDisabled"),
            ("MTI+EC", []) => {}
            ("MTI+EX", []) => {
                self.in_command_mode = false;
                return Some("MTI-Device Exit Command Mode");
            }
            _ => return Some("MTI-ERR InvalidCommand"),
        }
        Some("MTI-OK")
    }
}

impl Controller for MtiController {
    fn run(&mut self, bytes: &[u8], now_ns: i64, replies: &mut Vec<u8>) {
        self.plant.stand(now_ns);
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
            if let Some(answer) = self.answer(&line, now_ns) {
                replies.extend(answer.as_bytes());
                replies.extend(b"\r\n");
            }
        }
    }

    fn truth(&self) -> Arc<Mutex<MirrorTruth>> {
        self.plant.truth()
    }
}
