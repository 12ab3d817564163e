//! A PlayzerX behind the kernel's `ftdi_sio`: the suite for all mirror drivers, a stream of batches bit for bit, and
//! a cable that is unplugged while the mirror plays. The simulated controller runs at the far end of the line, a port
//! of the guest itself.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod guest;
#[path = "suite/mirror.rs"]
mod suite;

use std::fs::File;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use guest::{Monitor, PATIENCE, PATIENCE as HUNG, wait_for};
use nix::fcntl::OFlag;
use raysweep_core::{DeviceErrorKind, Mirror, MirrorLimits, MirrorPath, Tilt};
use raysweep_drivers::mirror::playzerx::protocol::MirrorSample;
use raysweep_drivers::mirror::{LightGuard, MirrorReport, PlayzerX, PlayzerXConfig, PlayzerXLink, arm_light};
use raysweep_sim::mirror::{Held, MechanicsConfig, MirrorPty, PlayzerXController, PlayzerXControllerConfig};
use suite::{BATCHES, mirror_conforms};
use tempfile::TempDir;

const PIPE: &str = "serial";
const PORT: &str = "/dev/ttyUSB0";
const LIMITS: MirrorLimits = MirrorLimits::A7B2_3_3600AL;
/// The line, in software emulation like the controller, carries a hundred times as much where the host is idle: on a
/// busy one, it stands still for tens of milliseconds.
const RATE_HZ: f64 = 500.0;
const SAMPLES: usize = 100;

/// The plugged-in converter, the controller behind it, and a folder for the driver's state.
struct Lab {
    monitor: Monitor,
    controller: MirrorPty,
    folder: TempDir,
}

impl Lab {
    fn new() -> Self {
        let mut options = File::options();
        options.read(true).write(true).custom_flags(OFlag::O_NONBLOCK.bits());
        let end = options.open(format!("/dev/virtio-ports/{PIPE}")).unwrap();
        let controller = PlayzerXController::new(PlayzerXControllerConfig::default());
        let mut lab = Self {
            monitor: Monitor::open(),
            controller: MirrorPty::attach(end, PORT.into(), controller).unwrap(),
            folder: tempfile::tempdir().unwrap(),
        };
        lab.plug();
        lab
    }

    fn plug(&mut self) {
        self.monitor.plug_serial(PIPE);
        wait_for(PORT, || Path::new(PORT).exists().then_some(()));
    }

    fn state(&self) -> PathBuf {
        self.folder.path().join("mirror.json")
    }

    fn light(&self) -> LightGuard {
        let armed_file = self.folder.path().join("armed");
        arm_light(&armed_file).unwrap();
        LightGuard { armed_file, interlock: None }
    }

    fn open(&self) -> PlayzerX {
        let config = || PlayzerXConfig {
            port: PORT.into(),
            link: PlayzerXLink::VirtualCom,
            full_scale: MechanicsConfig::default().max_tilt,
            limits: LIMITS,
            state: self.state(),
            light: self.light(),
        };
        // The node appears a moment before it can be opened.
        wait_for("the controller", || PlayzerX::open(config()).map_err(|error| println!("{error}")).ok())
    }

    fn await_parked(&self) {
        wait_for("the mirror's origin", || {
            self.controller.look(|truth| truth.parked_since_ns.zip(truth.dark_since_ns))
        });
    }
}

impl Drop for Lab {
    fn drop(&mut self) {
        self.monitor.unplug_serial(PIPE);
        let began = Instant::now();
        while Path::new(PORT).exists() && began.elapsed() < PATIENCE {
            std::thread::sleep(Duration::from_millis(10));
        }
    }
}

/// A batch with light.
fn batch() -> MirrorPath {
    MirrorPath::lissajous(Tilt::new(2.3, 1.3), [3, 2], SAMPLES, RATE_HZ, &LIMITS).unwrap()
}

fn codes(path: &MirrorPath) -> Vec<Held> {
    let full_scale = MechanicsConfig::default().max_tilt;
    let held = |MirrorSample { x, y, light }| Held { x: f64::from(x), y: f64::from(y), light };
    path.points().iter().map(|point| held(MirrorSample::of(*point, full_scale))).collect()
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn a_playzerx_conforms() {
    let lab = Lab::new();
    let mut mirror = lab.open();
    let path = mirror_conforms(&mut mirror, RATE_HZ);
    drop(mirror);
    lab.await_parked();
    let truth = lab.controller.truth();
    assert_eq!((truth.underruns, truth.overfills), (0, 0));
    assert!(truth.held.iter().all(|held| held.light == 0));
    let codes = codes(&path).repeat(BATCHES as usize);
    assert!(truth.held.windows(codes.len()).any(|window| window == codes), "the path is not what was played");
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn batches_reach_the_mirror_bit_for_bit() {
    let lab = Lab::new();
    let mut mirror = lab.open();
    mirror.load(&batch()).unwrap();
    mirror.start(20).unwrap();
    let total = 20 * SAMPLES;
    let began = Instant::now();
    let mut sent_after = None;
    let progress = loop {
        let progress = mirror.feed().unwrap();
        if progress.sent == total as u64 {
            sent_after.get_or_insert(began.elapsed());
        }
        if progress.parked {
            break progress;
        }
        std::thread::sleep(Duration::from_millis(1));
    };
    println!(
        "{total} samples: {sent_after:?} until the last was sent, {:?} until it was played",
        began.elapsed()
    );
    assert_eq!(progress.played, total as u64);
    lab.await_parked();
    let truth = lab.controller.truth();
    assert_eq!((truth.underruns, truth.overfills), (0, 0));
    let first = truth.held.iter().position(|held| held.light > 0).unwrap();
    let codes = codes(&batch());
    for (index, held) in truth.held[first..first + total].chunks(SAMPLES).enumerate() {
        assert!(held == codes, "batch {index} differs");
    }
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn a_cable_pulled_out_within_a_path_is_told_and_the_next_driver_parks_the_mirror() {
    let mut lab = Lab::new();
    let mut mirror = lab.open();
    mirror.load(&batch()).unwrap();
    mirror.start(100).unwrap();
    let lit =
        |lab: &Lab| lab.controller.look(|truth| truth.held.iter().filter(|held| held.light > 0).count());
    let began = Instant::now();
    while lit(&lab) < SAMPLES {
        mirror.feed().unwrap();
        assert!(began.elapsed() < PATIENCE, "no light");
        std::thread::sleep(Duration::from_millis(1));
    }
    lab.monitor.unplug_serial(PIPE);
    let began = Instant::now();
    let error = loop {
        match mirror.feed() {
            Ok(progress) => assert!(began.elapsed() < PATIENCE, "nothing noticed: {progress:?}"),
            Err(error) => break error,
        }
        std::thread::sleep(Duration::from_millis(1));
    };
    println!("{error}");
    assert_eq!(error.kind, DeviceErrorKind::Disconnected);
    assert!(error.to_string().contains(PORT) && error.to_string().contains("cable"), "{error}");
    drop(mirror);
    // The controller has its own power supply and plays on: the report says so, and what to do.
    let report = MirrorReport::read(&lab.state(), &lab.light());
    assert!(report.laser && !report.parked, "{report:?}");

    // The samples on the wire are lost, so the mirror's position is unknown: light and drive are switched off.
    lab.plug();
    let mut mirror = lab.open();
    lab.await_parked();
    let report = MirrorReport::read(&lab.state(), &lab.light());
    assert!(!report.laser && report.parked, "{report:?}");
    mirror.load(&batch()).unwrap();
    mirror.park().unwrap();
}
