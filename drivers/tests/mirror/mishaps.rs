//! Controllers that restart, hang or refuse in mid path, and disks that take nothing: whoever does not know where the
//! mirror is switches the drive off, and moves it from nowhere else.

use std::sync::atomic::{AtomicBool, AtomicI64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use raysweep_core::{DeviceErrorKind, Mirror};
use raysweep_drivers::mirror::{Mti, Parked, PlayzerX, park};
use raysweep_sim::mirror::{
    Controller, Held, MirrorPty, MirrorTruth, PlayzerXController, PlayzerXControllerConfig, SerialLink,
    WireFaults,
};
use tempfile::tempdir;

use crate::HUNG;
use crate::points::{circle, mti_config};
use crate::rig::{LIMITS, Rig, batch, error_of, largest_step};
use crate::scripts::{Script, line};

/// A restart, as documented by the maker: `pl`, `b`, length, magic number, end.
const RESTART: &[u8] = b"plb\x06\xEE\n";
const ORIGIN: Held = Held { x: 2048.0, y: 2048.0, light: 0 };

/// What befalls a controller; its port stays.
#[derive(Default)]
struct Mishap {
    restarts: AtomicBool,
    /// Until when it reads and answers nothing, on the host's monotonic clock. Its FIFO plays on.
    hangs_until_ns: AtomicI64,
    /// How often it was reset, by itself or by the driver.
    resets: AtomicUsize,
}

struct Unlucky {
    controller: PlayzerXController,
    mishap: Arc<Mishap>,
    unread: Vec<u8>,
}

impl Controller for Unlucky {
    fn run(&mut self, bytes: &[u8], now_ns: i64, replies: &mut Vec<u8>) {
        if self.mishap.restarts.swap(false, Ordering::Relaxed) {
            self.mishap.resets.fetch_add(1, Ordering::Relaxed);
            self.controller.run(RESTART, now_ns, replies);
        }
        self.unread.extend(bytes);
        let is_hanging = now_ns < self.mishap.hangs_until_ns.load(Ordering::Relaxed);
        let read = if is_hanging { Vec::new() } else { std::mem::take(&mut self.unread) };
        let told = read.windows(RESTART.len()).filter(|bytes| *bytes == RESTART).count();
        self.mishap.resets.fetch_add(told, Ordering::Relaxed);
        self.controller.run(&read, now_ns, replies);
    }

    fn truth(&self) -> Arc<Mutex<MirrorTruth>> {
        self.controller.truth()
    }
}

fn rig(reset_s: f64) -> (Rig, Arc<Mishap>) {
    let mishap = Arc::new(Mishap::default());
    let config = PlayzerXControllerConfig { reset_s, ..PlayzerXControllerConfig::default() };
    let controller =
        Unlucky { controller: PlayzerXController::new(config), mishap: mishap.clone(), unread: Vec::new() };
    let pty = MirrorPty::plug(controller, SerialLink::VirtualCom, WireFaults::default()).unwrap();
    (Rig { pty, folder: tempdir().unwrap() }, mishap)
}

/// A mirror far from its origin, with light.
fn playing(rig: &Rig) -> PlayzerX {
    let mut mirror = rig.open();
    mirror.load(&batch()).unwrap();
    mirror.start(1000).unwrap();
    let began = Instant::now();
    while rig.pty.look(|truth| truth.held.iter().filter(|held| held.light > 0).count()) < 10_000 {
        assert!(began.elapsed() < HUNG, "no light");
        mirror.feed().unwrap();
        std::thread::sleep(Duration::from_millis(2));
    }
    mirror
}

/// No output is a step further than the limits allow, but those of a drive that was switched off; returns how often it
/// was.
fn assert_no_step(rig: &Rig, mishap: &Mishap) -> usize {
    rig.await_parked();
    let held = rig.pty.truth().held;
    let allowed = LIMITS.max_step.0 / 6.5 * 2047.0 + 2.0;
    let steps: Vec<&[Held]> = held.windows(2).filter(|pair| largest_step(pair) > allowed).collect();
    let resets = mishap.resets.load(Ordering::Relaxed);
    assert!(
        steps.iter().all(|pair| pair[1] == ORIGIN) && steps.len() <= resets,
        "{resets} resets, but steps of more than {allowed} codes: {steps:?}"
    );
    resets
}

#[test]
fn a_controller_that_has_restarted_is_not_told_to_be_where_it_was() {
    // As long as a real one: a driver that stands still all the while cannot know.
    let (rig, mishap) = rig(2.5);
    let mut mirror = playing(&rig);
    mishap.restarts.store(true, Ordering::Relaxed);
    let error = error_of(&mut mirror);
    println!("{error}");
    assert!(matches!(error.kind, DeviceErrorKind::Timeout | DeviceErrorKind::Protocol), "{error}");
    drop(mirror);
    assert_no_step(&rig, &mishap);
    assert_eq!(park(&rig.state()).unwrap(), Parked::Already);
}

#[test]
fn a_controller_that_hangs_is_moved_from_nowhere_when_it_reads_again() {
    // It reads again before the driver gives up, after that and is then deaf for as long as a real one, while the driver
    // waits for what it says to the reset, and after that.
    for (hangs_ms, reset_s) in [(300, 0.1), (1750, 2.5), (2000, 0.1), (5000, 0.1), (8000, 0.1)] {
        let (rig, mishap) = rig(reset_s);
        let mut mirror = playing(&rig);
        let until_ns = raysweep_core::Clock::real().now_ns() + hangs_ms * 1_000_000;
        mishap.hangs_until_ns.store(until_ns, Ordering::Relaxed);
        let parked = mirror.park();
        drop(mirror);
        let resets = assert_no_step(&rig, &mishap);
        println!("hangs for {hangs_ms} ms: {parked:?}, {resets} resets");
        if hangs_ms == 300 {
            assert!(parked.is_ok() && resets == 0, "{parked:?}, {resets} resets");
        }
        // Whoever comes next finds either a parked mirror or one of unknown place.
        assert!(matches!(park(&rig.state()).unwrap(), Parked::Already | Parked::ByReset));
        assert_no_step(&rig, &mishap);
    }
}

#[test]
fn a_disk_that_takes_no_state_leaves_none_that_is_wrong() {
    let (rig, mishap) = rig(0.1);
    let mut mirror = rig.open();
    mirror.load(&batch()).unwrap();
    let next = format!("{}.new", rig.state().display());
    std::fs::create_dir(&next).unwrap();
    mirror.start(10).unwrap_err();
    drop(mirror);
    assert_eq!(assert_no_step(&rig, &mishap), 0);
    std::fs::remove_dir(&next).unwrap();
    assert_eq!(park(&rig.state()).unwrap(), Parked::ByReset);
    assert_no_step(&rig, &mishap);
}

#[test]
fn the_high_voltage_of_an_mti_that_cannot_be_parked_goes_off() {
    let mut points = 0;
    let script = Script::with(line, move |message, _| {
        let is_point = message.starts_with(b"MTI+GT");
        points += u32::from(is_point);
        if is_point && points > 100 { b"MTI-ERR Busy\r\n".to_vec() } else { b"MTI-OK\r\n".to_vec() }
    });
    let mut mirror =
        Mti::open(mti_config(script.pty.path().to_owned(), script.state(), script.light())).unwrap();
    mirror.load(&circle(60).with_light(|_| 0)).unwrap();
    mirror.start(10).unwrap();
    let error = error_of(&mut mirror);
    assert_eq!(error.kind, DeviceErrorKind::Protocol, "{error}");
    drop(mirror);
    let lines = script.lines();
    assert_eq!(lines[lines.len() - 2..], ["MTI+DI", "MTI+EX"]);
}
