//! A simulated mirror on a pseudo-terminal, and a folder for its driver's state.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use raysweep_core::{DeviceError, Mirror, MirrorLimits, MirrorPath, MirrorProgress, Tilt};
use raysweep_drivers::mirror::playzerx::protocol::MirrorSample;
use raysweep_drivers::mirror::{self, LightGuard, PlayzerX, arm_light};
use raysweep_sim::mirror::{
    Held, MechanicsConfig, MirrorPty, PlayzerXController, PlayzerXControllerConfig, SerialLink, WireFaults,
};
use tempfile::TempDir;

use crate::HUNG;

pub const RATE_HZ: f64 = 39_000.0;
pub const LIMITS: MirrorLimits = MirrorLimits::A7B2_3_3600AL;

/// A batch of the flying-dot rig, 6500 samples.
pub fn batch() -> MirrorPath {
    let scan = raysweep_core::RasterScan { amplitude: Tilt::new(2.3, 1.3), lines: 40, flyback: 0.1 };
    MirrorPath::raster(&scan, 6500, RATE_HZ, &LIMITS).unwrap()
}

pub struct Rig {
    pub pty: MirrorPty,
    pub folder: TempDir,
}

impl Rig {
    pub fn playzerx(config: PlayzerXControllerConfig, faults: WireFaults) -> Self {
        let pty = MirrorPty::plug(PlayzerXController::new(config), SerialLink::VirtualCom, faults).unwrap();
        Self { pty, folder: tempfile::tempdir().unwrap() }
    }

    pub fn good() -> Self {
        Self::playzerx(PlayzerXControllerConfig::default(), WireFaults::default())
    }

    pub fn state(&self) -> PathBuf {
        self.folder.path().join("mirror.json")
    }

    /// A guard whose light an operator has armed.
    pub fn armed(&self) -> LightGuard {
        let guard = LightGuard { armed_file: self.folder.path().join("armed"), interlock: None };
        arm_light(&guard.armed_file).unwrap();
        guard
    }

    pub fn config(&self) -> mirror::PlayzerXConfig {
        mirror::PlayzerXConfig {
            port: self.pty.path().to_owned(),
            link: mirror::PlayzerXLink::VirtualCom,
            full_scale: MechanicsConfig::default().max_tilt,
            limits: LIMITS,
            state: self.state(),
            light: self.armed(),
        }
    }

    pub fn open(&self) -> PlayzerX {
        PlayzerX::open(self.config()).unwrap()
    }

    /// Waits until the controller has played this many samples with light.
    pub fn await_light(&self, samples: usize) {
        let began = Instant::now();
        while self.pty.look(|truth| truth.held.iter().filter(|held| held.light > 0).count()) < samples {
            assert!(began.elapsed() < HUNG, "no light");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Waits until the mirror is parked; checks that the light went off first and that there was no step on the way.
    /// Returns when that was.
    pub fn assert_parked(&self) -> Timing {
        self.assert_parked_with_steps(LIMITS.max_step.0 / 6.5 * 2047.0)
    }

    /// The same after the end of a process that played [`batch()`]: if it died within a write, the place from which the
    /// mirror is taken to its origin is known to half a write, or 32 samples.
    pub fn assert_parked_after_kill(&self) -> Timing {
        let half_a_write =
            codes(&batch()).windows(33).map(|held| largest_step(&[held[0], held[32]])).fold(0.0, f64::max);
        self.assert_parked_with_steps(half_a_write.max(LIMITS.max_step.0 / 6.5 * 2047.0))
    }

    /// Waits until the mirror is parked; checks that the light went off first.
    pub fn await_parked(&self) {
        let began = Instant::now();
        loop {
            let parked = self.pty.look(|truth| truth.parked_since_ns.zip(truth.dark_since_ns));
            if let Some((parked_ns, dark_ns)) = parked {
                assert!(dark_ns <= parked_ns);
                break;
            }
            assert!(began.elapsed() < HUNG, "not parked");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    fn assert_parked_with_steps(&self, most_codes: f64) -> Timing {
        self.await_parked();
        let truth = self.pty.truth();
        let step = largest_step(&truth.held);
        // Two codes: rounding at both ends.
        let allowed = most_codes + 2.0;
        assert!(step <= allowed, "a step of {step} codes, {allowed} are allowed");
        assert_eq!(truth.overfills, 0);
        Timing {
            dark_ns: truth.dark_since_ns.unwrap(),
            parked_ns: truth.parked_since_ns.unwrap(),
            largest_step: step,
        }
    }
}

/// Times on the host's monotonic clock.
pub struct Timing {
    pub dark_ns: i64,
    pub parked_ns: i64,
    /// Largest step between two outputs, in the wire's units.
    pub largest_step: f64,
}

impl Timing {
    pub fn print(&self, way: &str, since_ns: i64) -> &Self {
        let ms = |ns: i64| (ns - since_ns) as f64 / 1e6;
        let (dark_ms, parked_ms) = (ms(self.dark_ns), ms(self.parked_ns));
        println!(
            "{way}: light off after {dark_ms:.1} ms, parked after {parked_ms:.1} ms, largest step {}",
            self.largest_step
        );
        self
    }
}

pub fn largest_step(held: &[Held]) -> f64 {
    held.windows(2)
        .map(|pair| (pair[1].x - pair[0].x).abs().max((pair[1].y - pair[0].y).abs()))
        .fold(0.0, f64::max)
}

/// A path's samples as the controller should hold them.
pub fn codes(path: &MirrorPath) -> Vec<Held> {
    path.points()
        .iter()
        .map(|point| MirrorSample::of(*point, MechanicsConfig::default().max_tilt))
        .map(|MirrorSample { x, y, light }| Held { x: f64::from(x), y: f64::from(y), light })
        .collect()
}

/// Feeds until the end of the path.
pub fn play(mirror: &mut dyn Mirror) -> MirrorProgress {
    loop {
        let progress = mirror.feed().unwrap();
        if progress.parked {
            return progress;
        }
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// Feeds a mirror until it refuses.
pub fn error_of(mirror: &mut dyn Mirror) -> DeviceError {
    let began = Instant::now();
    loop {
        if let Err(error) = mirror.feed() {
            return error;
        }
        assert!(began.elapsed() < HUNG, "no error");
        std::thread::sleep(Duration::from_millis(2));
    }
}
