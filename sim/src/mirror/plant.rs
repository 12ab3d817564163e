//! What hangs on a controller's outputs: the mirror, its light, and the record of both.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use raysweep_core::Tilt;

use super::mechanics::{Mechanics, MechanicsConfig};

/// What a controller's outputs hold: the numbers of its own wire.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Held {
    /// As the wire has it: a code of 0..=4095, or -1..=1.
    pub x: f64,
    /// The same of the other axis.
    pub y: f64,
    /// 0: off, 255: full.
    pub light: u8,
}

/// What a controller and its mirror did, in truth. A real rig knows nothing of this.
#[derive(Debug, Clone)]
pub struct MirrorTruth {
    /// Every output in order.
    pub held: Vec<Held>,
    /// Where the mirror is.
    pub tilt: Tilt,
    /// Times that the controller ran dry with the light on or the mirror in motion.
    pub underruns: u64,
    /// Samples that found no room.
    pub overfills: u64,
    /// Bytes that made no command.
    pub garbage_bytes: u64,
    /// Longest time that one output stayed lit.
    pub longest_lit_ns: i64,
    /// Since when the light is off, on the host's monotonic clock.
    pub dark_since_ns: Option<i64>,
    /// Since when the outputs are at the origin, with the light off.
    pub parked_since_ns: Option<i64>,
}

/// Most samples that the mirror is moved on after a pause: more than any ringing lasts.
const SETTLE_S: f64 = 1.0;

/// The mirror and its light behind a controller's outputs.
pub struct Plant {
    mechanics: Mechanics,
    to_tilt: fn(Held) -> [f64; 2],
    full_scale_deg: f64,
    origin: Held,
    before: Held,
    now: Held,
    since_ns: i64,
    truth: Arc<Mutex<MirrorTruth>>,
}

impl Plant {
    /// At rest and dark. `to_tilt` makes parts of the full scale of what the wire says.
    pub fn new(
        config: MechanicsConfig,
        rate_hz: f64,
        origin: Held,
        full_scale_deg: f64,
        to_tilt: fn(Held) -> [f64; 2],
    ) -> Self {
        let truth = MirrorTruth {
            held: Vec::new(),
            tilt: Tilt::ORIGIN,
            underruns: 0,
            overfills: 0,
            garbage_bytes: 0,
            longest_lit_ns: 0,
            dark_since_ns: Some(0),
            parked_since_ns: Some(0),
        };
        Self {
            mechanics: Mechanics::new(config, rate_hz),
            to_tilt,
            full_scale_deg,
            origin,
            before: origin,
            now: origin,
            since_ns: 0,
            truth: Arc::new(Mutex::new(truth)),
        }
    }

    /// What it did so far.
    pub fn truth(&self) -> Arc<Mutex<MirrorTruth>> {
        self.truth.clone()
    }

    /// Changes the rate at which outputs are held.
    pub fn set_rate(&mut self, rate_hz: f64) {
        self.mechanics.set_rate(rate_hz);
    }

    /// Whether the outputs are dark and the last one was where the one before it was.
    pub fn is_still(&self) -> bool {
        self.now.light == 0 && (self.now.x, self.now.y) == (self.before.x, self.before.y)
    }

    /// Puts the outputs at rest, as a controller does that starts anew.
    pub fn reset(&mut self, at_ns: i64) {
        self.hold(self.origin, at_ns);
    }

    /// Holds a new output from `at_ns` on.
    pub fn hold(&mut self, next: Held, at_ns: i64) {
        let truth = self.truth.clone();
        let mut truth = lock(&truth);
        self.note_light(&mut truth, at_ns);
        if self.since_ns > 0 {
            let seconds = ((at_ns - self.since_ns) as f64 / 1e9).clamp(0.0, SETTLE_S);
            let [x, y] = (self.to_tilt)(self.now).map(|part| part * self.full_scale_deg);
            for _ in 0..(seconds * self.mechanics.rate_hz()).round() as u64 {
                truth.tilt = self.mechanics.hold(Tilt::new(x, y));
            }
        }
        (self.before, self.now, self.since_ns) = (self.now, next, at_ns);
        truth.held.push(next);
        if next.light > 0 {
            truth.dark_since_ns = None;
        } else if truth.dark_since_ns.is_none() {
            truth.dark_since_ns = Some(at_ns);
        }
        if next != self.origin {
            truth.parked_since_ns = None;
        } else if truth.parked_since_ns.is_none() {
            truth.parked_since_ns = Some(at_ns);
        }
    }

    /// Takes time into account in which nothing changed.
    pub fn stand(&mut self, at_ns: i64) {
        self.note_light(&mut lock(&self.truth), at_ns);
    }

    /// Writes to the record.
    pub fn note(&self, write: impl FnOnce(&mut MirrorTruth)) {
        write(&mut lock(&self.truth));
    }

    fn note_light(&self, truth: &mut MirrorTruth, at_ns: i64) {
        if self.now.light > 0 {
            truth.longest_lit_ns = truth.longest_lit_ns.max(at_ns - self.since_ns);
        }
    }
}

/// No code panics between changing two fields, so a poisoned record is still one.
pub(super) fn lock(truth: &Mutex<MirrorTruth>) -> MutexGuard<'_, MirrorTruth> {
    truth.lock().unwrap_or_else(PoisonError::into_inner)
}
