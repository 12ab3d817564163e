//! Controllers that take one point at a time: MTI and MR-E-2.

use std::path::PathBuf;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use raysweep_core::{DeviceError, DeviceErrorKind, Mirror, MirrorPath, Tilt};
use raysweep_drivers::mirror::{
    Laser, LightGuard, Mti, MtiConfig, MtiDrive, Optotune, OptotuneConfig, Parked, park,
};
use raysweep_sim::mirror::{
    Held, MechanicsConfig, MirrorPty, MtiController, OptotuneController, SerialLink, WireFaults,
    run_as_soon_as_awake,
};

use crate::rig::{LIMITS, Rig, play};

/// The calling thread gets real-time priority: a host that is late by 100 ms ends a path with light.
pub fn rig(pty: MirrorPty) -> Rig {
    run_as_soon_as_awake();
    Rig { pty, folder: tempfile::tempdir().unwrap() }
}

pub fn mti_rig(faults: WireFaults) -> Rig {
    let link = SerialLink::Uart { baud: 115_200 };
    rig(MirrorPty::plug(MtiController::new(MechanicsConfig::default()), link, faults).unwrap())
}

pub fn mti_config(port: PathBuf, state: PathBuf, light: LightGuard) -> MtiConfig {
    let drive = MtiDrive::A7B2_3_3600AL;
    MtiConfig { port, drive, most: drive, full_scale: LIMITS.max_tilt, limits: LIMITS, state, light }
}

fn config_of(rig: &Rig) -> MtiConfig {
    mti_config(rig.pty.path().to_owned(), rig.state(), rig.armed())
}

pub fn circle(points: usize) -> MirrorPath {
    MirrorPath::lissajous(Tilt::new(3.0, 2.0), [1, 1], points, 100.0, &LIMITS).unwrap()
}

/// Rounded as on the wire.
fn rounded(value: f64) -> f64 {
    (value * 1e5).round() / 1e5
}

pub fn assert_points(held: &[Held], path: &MirrorPath, batches: usize, of: impl Fn(f64) -> f64, lit: u8) {
    let points: Vec<Held> = path
        .points()
        .iter()
        .map(|point| {
            let [x, y] = point.tilt.deg().map(&of).map(rounded);
            Held { x, y, light: lit }
        })
        .collect();
    let close =
        |a: &Held, b: &Held| (a.x - b.x).abs() < 1.1e-5 && (a.y - b.y).abs() < 1.1e-5 && a.light == b.light;
    let wanted: Vec<Held> = points.iter().cycle().take(points.len() * batches).copied().collect();
    let found = held.windows(wanted.len()).any(|window| window.iter().zip(&wanted).all(|(a, b)| close(a, b)));
    assert!(found, "the path's points are not among those that the controller held");
}

#[test]
fn mti_plays_a_path_and_switches_the_high_voltage_off() {
    let rig = mti_rig(WireFaults { garbage: 0.05, ..WireFaults::default() });
    let path = circle(60);
    let mut mirror = Mti::open(config_of(&rig)).unwrap();
    mirror.load(&path).unwrap();
    mirror.start(2).unwrap();
    assert_eq!(play(&mut mirror).played, 120);
    drop(mirror);
    rig.assert_parked();
    assert_points(&rig.pty.truth().held, &path, 2, |deg| deg / 6.5, 255);
    // It starts from the state in which it was left: out of the command mode, high voltage off.
    drop(Mti::open(config_of(&rig)).unwrap());
}

#[test]
fn mti_refuses_what_would_destroy_the_mirror() {
    let rig = mti_rig(WireFaults::default());
    let drive = MtiDrive { bias_v: 90, ..MtiDrive::A7B2_3_3600AL };
    let error = Mti::open(MtiConfig { drive, ..config_of(&rig) }).err().unwrap();
    assert_eq!(error.kind, DeviceErrorKind::OutOfRange, "{error}");
    assert!(rig.pty.look(|truth| truth.held.is_empty()));
}

#[derive(Clone, Default)]
pub struct Lamp {
    lit: Arc<AtomicBool>,
    was_lit: Arc<AtomicBool>,
}

impl Lamp {
    pub fn was_lit(&self) -> bool {
        self.was_lit.load(Ordering::Relaxed)
    }

    fn is_lit(&self) -> bool {
        self.lit.load(Ordering::Relaxed)
    }
}

impl Laser for Lamp {
    fn switch(&mut self, on: bool) -> Result<(), DeviceError> {
        self.lit.store(on, Ordering::Relaxed);
        self.was_lit.fetch_or(on, Ordering::Relaxed);
        Ok(())
    }
}

fn optotune_rig(faults: WireFaults) -> Rig {
    let mechanics = MechanicsConfig { max_tilt: raysweep_core::MechanicalDeg(25.0), ..Default::default() };
    let link = SerialLink::Uart { baud: 256_000 };
    rig(MirrorPty::plug(OptotuneController::new(mechanics), link, faults).unwrap())
}

#[test]
fn optotune_plays_a_path_with_a_light_of_its_own() {
    let rig = optotune_rig(WireFaults { garbage: 0.05, ..WireFaults::default() });
    let config = OptotuneConfig {
        port: rig.pty.path().to_owned(),
        laser_port: None,
        limits: LIMITS,
        state: rig.state(),
        light: rig.armed(),
    };
    let lamp = Lamp::default();
    let path = circle(60).with_light(|_| 1);
    let mut mirror = Optotune::open(config.clone(), Box::new(lamp.clone())).unwrap();
    mirror.load(&path).unwrap();
    assert!(!lamp.is_lit());
    mirror.start(2).unwrap();
    let mut seen = false;
    while !mirror.feed().unwrap().parked {
        seen |= lamp.is_lit();
        std::thread::sleep(Duration::from_millis(1));
    }
    assert!(seen && !lamp.is_lit());
    let coordinate = |deg: f64| (2.0 * deg).to_radians().tan() / 50.0_f64.to_radians().tan();
    assert_points(&rig.pty.truth().held, &path, 2, coordinate, 0);
    mirror.load(&path).unwrap();
    mirror.start(2).unwrap();
    while mirror.feed().unwrap().played < 30 {
        std::thread::sleep(Duration::from_millis(1));
    }
    assert!(lamp.is_lit());
    drop(mirror);
    assert!(!lamp.is_lit());
    rig.assert_parked();
}

#[test]
fn an_optotune_that_was_plugged_in_again_is_not_told_to_be_where_it_was_left() {
    let mut rig = optotune_rig(WireFaults::default());
    let name = rig.folder.path().join("by-id");
    std::os::unix::fs::symlink(rig.pty.path(), &name).unwrap();
    let config = OptotuneConfig {
        port: name.clone(),
        laser_port: None,
        limits: LIMITS,
        state: rig.state(),
        light: rig.armed(),
    };
    let mut mirror = Optotune::open(config, Box::new(Lamp::default())).unwrap();
    mirror.load(&circle(60)).unwrap();
    mirror.start(2).unwrap();
    while mirror.feed().unwrap().played < 15 {
        std::thread::sleep(Duration::from_millis(1));
    }
    // When the power is back, it is at rest. Commanded to its last position, it would jump.
    let again = optotune_rig(WireFaults::default());
    rig.pty.unplug();
    while mirror.feed().is_ok() {
        std::thread::sleep(Duration::from_millis(1));
    }
    drop(mirror);
    std::fs::remove_file(&name).unwrap();
    std::os::unix::fs::symlink(again.pty.path(), &name).unwrap();
    assert_eq!(park(&rig.state()).unwrap(), Parked::ByReset);
    let origin = Held { x: 0.0, y: 0.0, light: 0 };
    assert_eq!(again.pty.truth().held, [origin]);
    assert_eq!(park(&rig.state()).unwrap(), Parked::Already);
}
