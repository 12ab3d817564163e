//! Streaming to a PlayzerX.

use std::fs;
use std::time::Duration;

use raysweep_core::{DeviceErrorKind, Mirror, MirrorLimits, MirrorPath, Tilt};
use raysweep_drivers::mirror::{self, LightGuard, LightState, MirrorReport, PlayzerX};
use raysweep_sim::mirror::{Held, PlayzerXControllerConfig, WireFaults};

use crate::rig::{LIMITS, RATE_HZ, Rig, batch, codes, play};

/// The played path within everything that the controller held: it begins at the first sample with light.
fn played(held: &[Held], samples: usize) -> &[Held] {
    let begin = held.iter().position(|held| held.light > 0).unwrap();
    &held[begin..begin + samples]
}

/// Plays `batches` batches, again if the machine was so busy that the controller's FIFO ran empty: that says nothing about the
/// driver, unless it happens each time. What was played must be the path, bit for bit, and must not overfill the FIFO.
fn plays_bit_for_bit(open: impl Fn() -> Rig, batches: u32) -> (Rig, PlayzerX, f64) {
    let path = batch();
    let codes = codes(&path);
    for _ in 0..5 {
        let rig = open();
        let mut mirror = rig.open();
        let loaded_hz = mirror.load(&path).unwrap();
        mirror.start(batches).unwrap();
        let progress = play(&mut mirror);
        rig.assert_parked();
        let truth = rig.pty.truth();
        assert_eq!(truth.overfills, 0);
        if truth.underruns > 0 {
            println!("{} underruns", truth.underruns);
            continue;
        }
        let samples = 6500 * u64::from(batches);
        assert_eq!((progress.played, progress.total), (samples, samples));
        for (batch, held) in played(&truth.held, samples as usize).chunks(6500).enumerate() {
            assert!(held == codes, "batch {batch} differs");
        }
        let rate_hz = progress.rate_hz.unwrap();
        println!("rate read back: {loaded_hz:.1} Hz on loading, {rate_hz:.2} Hz over the run");
        return (rig, mirror, rate_hz);
    }
    panic!("the FIFO ran empty in each of five runs");
}

#[test]
fn sixty_batches_reach_the_mirror_bit_for_bit() {
    let (rig, _mirror, rate_hz) = plays_bit_for_bit(Rig::good, 60);
    assert!((rate_hz / RATE_HZ - 1.0).abs() < 2e-3, "{rate_hz}");
    assert!(!MirrorReport::read(&rig.state(), &rig.armed()).laser);
}

#[test]
fn garbage_stalls_and_a_wrong_clock_change_no_sample() {
    let config = PlayzerXControllerConfig { clock_error: 0.01, ..PlayzerXControllerConfig::default() };
    let faults = WireFaults { seed: 7, garbage: 0.1, stalls: 0.005, stall_ms: 30 };
    let (_rig, mirror, rate_hz) = plays_bit_for_bit(|| Rig::playzerx(config, faults), 12);
    assert!(mirror.garbage_bytes() > 0, "garbage is counted");
    assert!((rate_hz / (RATE_HZ * 1.01) - 1.0).abs() < 4e-3, "the rate read back is the true one: {rate_hz}");
}

#[test]
fn a_full_fifo_is_not_overfilled_when_the_mirror_is_stopped_and_started_again() {
    let rig = Rig::good();
    let path = batch();
    let mut mirror = rig.open();
    for _ in 0..2 {
        mirror.load(&path).unwrap();
        mirror.start(100).unwrap();
        for _ in 0..200 {
            mirror.feed().unwrap();
            std::thread::sleep(Duration::from_millis(2));
        }
        mirror.park().unwrap();
        rig.assert_parked();
    }
    assert_eq!(mirror.feed().unwrap_err().kind, DeviceErrorKind::NotReady);
    mirror.park().unwrap();
}

#[test]
fn a_rate_that_the_controller_does_not_keep_is_found_out() {
    // Also where most answers are late.
    for stalls in [0.0, 0.5] {
        let slow = PlayzerXControllerConfig { max_rate_hz: 30_000.0, ..Default::default() };
        let faults = WireFaults { stalls, stall_ms: 20, ..WireFaults::default() };
        let rig = Rig::playzerx(slow, faults);
        let mut mirror = rig.open();
        let error = mirror.load(&batch()).unwrap_err();
        assert_eq!(error.kind, DeviceErrorKind::OutOfRange, "{error}");
        rig.assert_parked();
    }
}

#[test]
fn a_rate_is_measured_also_between_rare_answers() {
    for (max_rate_hz, keeps) in [(30_000.0, true), (900.0, false)] {
        let slow = PlayzerXControllerConfig { max_rate_hz, ..Default::default() };
        let rig = Rig::playzerx(slow, WireFaults { stalls: 0.5, stall_ms: 100, ..WireFaults::default() });
        let path = MirrorPath::lissajous(Tilt::new(3.0, 2.0), [1, 1], 1000, 1000.0, &LIMITS).unwrap();
        let mut mirror = rig.open();
        match mirror.load(&path) {
            Ok(rate_hz) => assert!(keeps && (rate_hz / 1000.0 - 1.0).abs() < 0.03, "{rate_hz}"),
            Err(error) => assert!(!keeps && error.kind == DeviceErrorKind::OutOfRange, "{error}"),
        }
        drop(mirror);
        rig.assert_parked();
    }
}

#[test]
fn what_the_link_or_the_limits_forbid_is_refused_before_anything_moves() {
    let rig = Rig::good();
    let uart = mirror::PlayzerXConfig { link: mirror::PlayzerXLink::Uart, ..rig.config() };
    let mut mirror = PlayzerX::open(uart).unwrap();
    let error = mirror.load(&batch()).unwrap_err();
    assert!(error.to_string().contains("10240"), "{error}");
    drop(mirror);
    let mut mirror = rig.open();
    let wide = MirrorLimits { max_tilt: raysweep_core::MechanicalDeg(9.0), ..LIMITS };
    let path = MirrorPath::lissajous(Tilt::new(8.0, 0.0), [10, 0], 6500, RATE_HZ, &wide).unwrap();
    assert_eq!(mirror.load(&path).unwrap_err().kind, DeviceErrorKind::OutOfRange);
    assert_eq!(mirror.start(1).unwrap_err().kind, DeviceErrorKind::NotReady);
    assert!(rig.pty.look(|truth| truth.held.is_empty()));
}

#[test]
fn there_is_no_light_without_an_interlock_or_an_operators_word() {
    let rig = Rig::good();
    let light = LightGuard { armed_file: rig.folder.path().join("nobody"), interlock: None };
    let mut mirror = PlayzerX::open(mirror::PlayzerXConfig { light, ..rig.config() }).unwrap();
    mirror.load(&batch()).unwrap();
    let error = mirror.start(1).unwrap_err();
    assert!(error.kind == DeviceErrorKind::NotReady && error.to_string().contains("arm-light"), "{error}");
    drop(mirror);
    rig.assert_parked();
    let dark = || rig.pty.look(|truth| truth.held.iter().all(|held| held.light == 0));
    assert!(dark());

    // A dark path needs no permission.
    let light = LightGuard { armed_file: rig.folder.path().join("nobody"), interlock: None };
    let mut mirror = PlayzerX::open(mirror::PlayzerXConfig { light, ..rig.config() }).unwrap();
    mirror.load(&batch().with_light(|_| 0)).unwrap();
    mirror.start(1).unwrap();
    play(&mut mirror);
    assert!(dark());
}

#[test]
fn an_interlock_that_opens_switches_the_light_off_and_parks() {
    let rig = Rig::good();
    let interlock = rig.folder.path().join("interlock");
    fs::write(&interlock, "1").unwrap();
    let light = LightGuard { interlock: Some(interlock.clone()), ..rig.armed() };
    let mut mirror = PlayzerX::open(mirror::PlayzerXConfig { light: light.clone(), ..rig.config() }).unwrap();
    mirror.load(&batch()).unwrap();
    mirror.start(60).unwrap();
    (0..200).for_each(|_| {
        mirror.feed().unwrap();
        std::thread::sleep(Duration::from_millis(2));
    });
    let report = MirrorReport::read(&rig.state(), &light);
    assert!(report.laser && !report.parked && report.driven, "{report:?}");
    assert_eq!(report.light, LightState::InterlockClosed);
    fs::write(&interlock, "0").unwrap();
    let since_ns = raysweep_core::Clock::real().now_ns();
    let error = loop {
        if let Err(error) = mirror.feed() {
            break error;
        }
        std::thread::sleep(Duration::from_millis(2));
    };
    assert!(error.to_string().contains("interlock"), "{error}");
    rig.assert_parked().print("interlock", since_ns);
    drop(mirror);
    let report = MirrorReport::read(&rig.state(), &light);
    assert!(!report.laser && report.parked && !report.driven, "{report:?}");
}

#[test]
fn a_mirror_that_confirms_no_motion_is_not_lit() {
    // About 18,000 samples are played before the light: the approach and the rest before the path.
    let config = PlayzerXControllerConfig { freezes_after: Some(40_000), ..Default::default() };
    let rig = Rig::playzerx(config, WireFaults::default());
    let mut mirror = rig.open();
    mirror.load(&batch()).unwrap();
    mirror.start(60).unwrap();
    let error = loop {
        if let Err(error) = mirror.feed() {
            break error;
        }
        std::thread::sleep(Duration::from_millis(2));
    };
    assert!(error.kind == DeviceErrorKind::Timeout && error.to_string().contains("no motion"), "{error}");
    rig.assert_parked();
    let stood_ms = rig.pty.look(|truth| truth.longest_lit_ns) / 1_000_000;
    println!("no motion: one point was lit for {stood_ms} ms");
}

#[test]
fn one_driver_at_a_time() {
    let rig = Rig::good();
    let mirror = rig.open();
    let error = PlayzerX::open(rig.config()).err().unwrap();
    assert_eq!(error.kind, DeviceErrorKind::Busy, "{error}");
    drop(mirror);
    rig.open();
}
