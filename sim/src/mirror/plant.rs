//! What a controller drives: the mirror, its light, and the record of both.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use raysweep_core::Tilt;

use super::mechanics::{Mechanics, MechanicsConfig};

/// Outputs of a controller, in the units of its own protocol.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Held {
    /// x as sent on the wire: a code 0..=4095, or a value -1..=1.
    pub x: f64,
    /// y, in the same units.
    pub y: f64,
    /// Light level: 0 is off, 255 is full.
    pub light: u8,
}

/// Ground truth about a controller and its mirror; not available on a real rig.
#[derive(Debug, Clone)]
pub struct MirrorTruth {
    /// All outputs so far, in order.
    pub held: Vec<Held>,
    /// Current tilt of the mirror.
    pub tilt: Tilt,
    /// How often the controller ran out of samples with the light on or the mirror moving.
    pub underruns: u64,
    /// Samples lost because the FIFO was full.
    pub overfills: u64,
    /// Bytes that were not part of a command.
    pub garbage_bytes: u64,
    /// Longest time that one output was held with the light on.
    pub longest_lit_ns: i64,
    /// Since when the light has been off, on the host's monotonic clock.
    pub dark_since_ns: Option<i64>,
    /// Since when the outputs have been at the origin with the light off, on the same clock.
    pub parked_since_ns: Option<i64>,
}

/// Maximum time by which the mirror is simulated after a pause: longer than any ringing.
const SETTLE_S: f64 = 1.0;

/// The mirror and its light, driven by a controller's outputs.
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
    /// At rest and dark. `to_tilt` converts outputs to fractions of full scale.
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

    /// The record so far.
    pub fn truth(&self) -> Arc<Mutex<MirrorTruth>> {
        self.truth.clone()
    }

    /// Changes the sample rate at which outputs are held.
    pub fn set_rate(&mut self, rate_hz: f64) {
        self.mechanics.set_rate(rate_hz);
    }

    /// Whether the light is off and the last two outputs have the same position.
    pub fn is_still(&self) -> bool {
        self.now.light == 0 && (self.now.x, self.now.y) == (self.before.x, self.before.y)
    }

    /// Resets the outputs to the origin, as when a controller restarts.
    pub fn reset(&mut self, at_ns: i64) {
        self.hold(self.origin, at_ns);
    }

    /// Sets a new output, held from `at_ns` on.
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

    /// Accounts for time in which the outputs have not changed.
    pub fn stand(&mut self, at_ns: i64) {
        self.note_light(&mut lock(&self.truth), at_ns);
    }

    /// Updates the record.
    pub fn note(&self, write: impl FnOnce(&mut MirrorTruth)) {
        write(&mut lock(&self.truth));
    }

    fn note_light(&self, truth: &mut MirrorTruth, at_ns: i64) {
        if self.now.light > 0 {
            truth.longest_lit_ns = truth.longest_lit_ns.max(at_ns - self.since_ns);
        }
    }
}

/// Locks the record. No code panics between changing two fields, so a poisoned record is still consistent.
pub(super) fn lock(truth: &Mutex<MirrorTruth>) -> MutexGuard<'_, MirrorTruth> {
    truth.lock().unwrap_or_else(PoisonError::into_inner)
}
