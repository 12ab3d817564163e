//! A path being played: the beam's position at each sample, and what its light falls on.

use std::collections::VecDeque;

use raysweep_config::sim::{DotsConfig, SimMirror};
use raysweep_core::{MechanicalDeg, MirrorPath, Tilt};

use crate::mirror::{Mechanics, MechanicsConfig};

/// Number of stored positions behind the newest one: more than a frame needs.
const REMEMBERED: usize = 64;
/// Time for which the mirror rests on the path's first point before the path begins.
const SETTLE_S: f64 = 0.5;
/// Maximum number of points in time at which an exposure is evaluated.
const MOST_MOMENTS: usize = 8;

/// Where the light falls at one point in time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Lit {
    /// On the scene: direction (as tangents) and fraction of full light.
    Scene([f64; 2], f64),
    /// On the trailing dot's plane: fraction of full light.
    Trailing(f64),
    /// Nowhere: off, or in the beam dump.
    Nowhere,
}

/// A path, how often it is played, and how it is divided into frames.
#[derive(Clone)]
pub struct MirrorScan {
    path: MirrorPath,
    incidence: MechanicalDeg,
    samples: u64,
    samples_per_frame: f64,
    /// Samples per dot by the mirror's sample clock, without the camera's clock error.
    samples_per_dot: f64,
    trailing_index: u64,
    dump_indices: Vec<u64>,
    motion: Option<Motion>,
}

/// The mirror's motion, sample by sample.
#[derive(Clone)]
struct Motion {
    at_rest: Mechanics,
    mechanics: Mechanics,
    /// Positions at the end of the most recent samples; `next` is the number of the following sample.
    places: VecDeque<Tilt>,
    next: u64,
}

impl MirrorScan {
    /// Plays a path `batches` times, with frames at `frame_rate_hz`, `begins_s` after the mirror's first movement.
    pub fn new(
        path: MirrorPath,
        batches: u32,
        frame_rate_hz: f64,
        incidence: MechanicalDeg,
        begins_s: f64,
        config: &DotsConfig,
    ) -> Self {
        let rate_hz = path.rate_hz();
        let samples_per_dot = rate_hz / frame_rate_hz;
        let dots = (path.points().len() as f64 / samples_per_dot).round() as u64;
        let motion = config.mirror.mechanics.then(|| {
            let mut mechanics = Mechanics::new(mechanics(&config.mirror, config.seed, begins_s), rate_hz);
            let first = path.at(0).tilt;
            let mut place = first;
            for _ in 0..(SETTLE_S * rate_hz) as u32 {
                place = mechanics.hold(first);
            }
            let places = VecDeque::from([place]);
            Motion { at_rest: mechanics.clone(), mechanics, places, next: 0 }
        });
        Self {
            incidence,
            samples: path.points().len() as u64 * u64::from(batches),
            samples_per_frame: samples_per_dot / (1.0 + config.camera.clock_error),
            samples_per_dot,
            trailing_index: config.trailing_index.map_or(dots.saturating_sub(1), u64::from),
            dump_indices: config.dump_indices.iter().copied().map(u64::from).collect(),
            path,
            motion,
        }
    }

    /// The path's sample rate.
    pub fn rate_hz(&self) -> f64 {
        self.path.rate_hz()
    }

    /// Number of samples per batch.
    pub fn samples_per_batch(&self) -> u64 {
        self.path.points().len() as u64
    }

    /// Number of samples in all batches.
    pub fn samples(&self) -> u64 {
        self.samples
    }

    /// Time that it takes with what comes before it, as planned: a pass that is ended early counts as whole, so that
    /// frames do not depend on when.
    pub fn planned_s(&self) -> f64 {
        SETTLE_S + self.samples as f64 / self.rate_hz()
    }

    /// Number of frames triggered during all batches.
    pub fn frames(&self) -> u64 {
        // Exclude a frame that starts exactly at the end of the last sample, despite rounding.
        (self.samples as f64 / self.samples_per_frame - 1e-6).ceil() as u64
    }

    /// Trigger time of a frame, in samples.
    pub fn trigger(&self, frame: u64) -> f64 {
        frame as f64 * self.samples_per_frame
    }

    /// Batch and index of the dot at a time in samples.
    pub fn dot_at(&self, moment: f64) -> (u64, u64) {
        let samples_per_batch = self.path.points().len() as f64;
        let batch = (moment / samples_per_batch).floor();
        let index = ((moment - batch * samples_per_batch) / self.samples_per_dot).floor();
        (batch as u64, index as u64)
    }

    /// Batch and index of the dot at the middle of a frame.
    pub fn dot_of(&self, frame: u64) -> (u64, u64) {
        self.dot_at((frame as f64 + 0.5) * self.samples_per_frame)
    }

    /// Where the light falls during an exposure that starts at a frame's trigger: equally weighted points in time.
    pub fn exposure(&mut self, frame: u64, exposure_us: f64) -> Vec<Lit> {
        let length = exposure_us * 1e-6 * self.rate_hz();
        let moments = (length.ceil() as usize).clamp(1, MOST_MOMENTS);
        let begin = self.trigger(frame);
        (0..moments).map(|moment| self.lit(begin + length * (moment as f64 + 0.5) / moments as f64)).collect()
    }

    fn lit(&mut self, moment: f64) -> Lit {
        let sample = moment as u64;
        let light = f64::from(self.path.at(sample).light) / 255.0;
        let (_, index) = self.dot_at(moment);
        if sample >= self.samples || light == 0.0 || self.dump_indices.contains(&index) {
            return Lit::Nowhere;
        }
        if index == self.trailing_index {
            return Lit::Trailing(light);
        }
        Lit::Scene(self.tilt(moment).beam(self.incidence), light)
    }

    fn tilt(&mut self, moment: f64) -> Tilt {
        let sample = moment as u64;
        let Some(motion) = &mut self.motion else { return self.path.at(sample).tilt };
        let [[x0, y0], [x1, y1]] = motion.around(sample, &self.path).map(Tilt::deg);
        let share = moment - sample as f64;
        Tilt::new(x0 + share * (x1 - x0), y0 + share * (y1 - y0))
    }
}

impl Motion {
    /// Mirror positions at the beginning and at the end of a sample.
    fn around(&mut self, sample: u64, path: &MirrorPath) -> [Tilt; 2] {
        // The sample is no longer stored: restart the motion, which is deterministic.
        if sample + (self.places.len() as u64) < self.next + 1 {
            self.mechanics = self.at_rest.clone();
            self.places = VecDeque::from([path.at(0).tilt]);
            self.next = 0;
        }
        while self.next <= sample {
            self.places.push_back(self.mechanics.hold(path.at(self.next).tilt));
            self.next += 1;
            if self.places.len() > REMEMBERED {
                self.places.pop_front();
            }
        }
        let end = self.places.len() - 1 - (self.next - 1 - sample) as usize;
        [self.places[end.saturating_sub(1)], self.places[end]]
    }
}

/// The mechanics of a mirror as the rig file describes it.
fn mechanics(mirror: &SimMirror, seed: u64, begins_s: f64) -> MechanicsConfig {
    MechanicsConfig {
        f0_hz: mirror.f0_hz,
        q: mirror.q,
        filter_hz: mirror.filter_hz,
        coupling: mirror.coupling,
        drift_deg_per_s: mirror.drift_deg_per_s,
        repeat_deg: mirror.repeat_deg,
        seed,
        begins_s,
        ..MechanicsConfig::default()
    }
}
