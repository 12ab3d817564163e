//! The driver with `arv-fake-gv-camera-0.8`, a device that we did not write.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod support;

use std::collections::BTreeMap;
use std::thread;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;

use raysweep_core::{
    Camera, CameraSettings, DeviceErrorKind, DeviceState, FirstFrame, FramePool, FrameStamp, LossCause,
    PixelFormat, SettingsId, Shutter,
};
use raysweep_drivers::camera::aravis::{
    AravisCamera, AravisConfig, RigFacts, SensorRegion, discover, load_features, save_features,
};

use support::{ADDRESS, FakeCamera, own_network};

const FACTS: RigFacts = RigFacts {
    format: PixelFormat::Mono8,
    row_time_us: 22.22,
    trigger_period_us: 16_666.667,
    trigger_margin_us: 500.0,
    reopen: Duration::from_secs(20),
    free_hz: None,
};

/// Runs freely with one frame per `period_us`, set by the camera's register.
fn config(period_us: u32, size: u32) -> AravisConfig {
    AravisConfig {
        address: Some(ADDRESS.into()),
        features: vec![format!("R[0x138]={period_us}")],
        region: Some(SensorRegion { x: 0, y: 0, width: size, height: size }),
        trigger_source: "off".into(),
        packet_size: Some(9000),
        ..AravisConfig::default()
    }
}

const SETTINGS: CameraSettings =
    CameraSettings { shutter: Shutter::Rolling, exposure_us: 10_000.0, trigger_delay_us: 0.0 };

const ID: SettingsId = SettingsId { point: 0, attempt: 0 };

#[test]
fn frames_come_whole_and_in_order_with_their_times() {
    own_network();
    let _device = FakeCamera::start(&[]);
    let mut camera = AravisCamera::open(&config(4_000, 256), FACTS).unwrap();
    let capabilities = camera.capabilities().clone();
    assert_eq!((capabilities.width, capabilities.height), (256, 256));
    assert!(capabilities.model.contains("Fake"), "{}", capabilities.model);
    assert_eq!(capabilities.trigger_delay_us, 0.0..=0.0, "it has no trigger delay");

    let pool = FramePool::new(1, 256 * 256);
    let mut buf = pool.take();
    let too_early = camera.next_frame(&mut buf, Duration::ZERO).unwrap_err();
    assert_eq!(too_early.kind, DeviceErrorKind::NotReady);
    let applied = camera.configure(ID, &SETTINGS).unwrap();
    assert_eq!(
        (applied.actual, applied.first_frame),
        (SETTINGS, FirstFrame::Within { earliest: 1, certain: 4 })
    );
    assert_eq!(camera.state(), DeviceState::Ready);
    camera.arm().unwrap();
    assert_eq!(camera.state(), DeviceState::Streaming);
    let (mut stamps, mut first) = (Vec::new(), None);
    while stamps.len() < 200 {
        let stamp = camera.next_frame(&mut buf, Duration::from_secs(2)).unwrap().expect("a frame every 4 ms");
        // Its picture is a ramp that shifts with the frame number, at full contrast for its default exposure.
        let offset = u64::from(buf[0]);
        let (first_offset, first_seq) = *first.get_or_insert((offset, stamp.seq));
        assert_eq!((offset + 255 - first_offset) % 255, (stamp.seq - first_seq) % 255);
        let picture = (0..256_u64 * 256).map(|pixel| ((pixel % 256 + pixel / 256 + offset) % 255) as u8);
        assert!(picture.eq(buf.iter().copied()), "frame {}", stamp.seq);
        stamps.push(stamp);
    }
    assert!(stamps.is_sorted_by(|a, b| a.seq < b.seq && a.device_ns < b.device_ns));
    // It cannot be asked for its time, and a busy host may receive the first frames late.
    assert!(stamps[100..].is_sorted_by(|a, b| a.exposure_start_ns < b.exposure_start_ns));
    let (first, last) = (stamps[0], stamps[199]);
    let lost: u64 = camera.losses().map(|(_, frames)| frames).sum();
    assert_eq!(last.seq - first.seq + 1, 200 + lost);
    assert!(stamps.iter().all(|stamp| stamp.exposure_us.is_none()), "it has no chunk data");
    camera.disarm().unwrap();
    camera.disarm().unwrap();
    assert_eq!(camera.state(), DeviceState::Ready);

    camera.arm().unwrap();
    let again = camera.next_frame(&mut buf, Duration::from_secs(2)).unwrap().unwrap();
    assert!(again.seq > last.seq, "ids go on rising");
}

#[test]
fn frames_are_not_copied_and_stay_as_they_came_while_they_are_kept() {
    own_network();
    let _device = FakeCamera::start(&[]);
    let mut camera = AravisCamera::open(&config(2_000, 256), FACTS).unwrap();
    camera.configure(ID, &SETTINGS).unwrap();
    camera.arm().unwrap();
    let pool = FramePool::new(8, 256 * 256);
    let mut take = |pool: &FramePool| loop {
        let mut buf = pool.take();
        let own = buf.as_ptr();
        if camera.next_frame(&mut buf, Duration::from_secs(2)).unwrap().is_some() {
            let is_own = buf.as_ptr() == own;
            return (buf, is_own);
        }
    };
    let mut kept = Vec::new();
    for _ in 0..8 {
        let (buf, is_own) = take(&pool);
        assert!(!is_own, "the frame lies where it was received");
        kept.push((buf.to_vec(), buf));
    }
    kept.truncate(4);
    // The others are exchanged back and forth, more often than the driver has buffers.
    for _ in 0..300 {
        take(&pool);
    }
    let (short, is_own) = take(&FramePool::new(1, 256 * 256 - 1));
    assert!(is_own, "memory of another length is not the driver's");
    let slope = short.iter().zip(&short[1..]).filter(|(a, b)| (u16::from(**a) + 1) % 255 == u16::from(**b));
    assert!(slope.count() > 256 * 254);
    drop((camera, pool));
    for (came, buf) in kept {
        assert!(came == buf[..], "it is written to by nobody");
    }
}

#[test]
fn what_it_lacks_or_does_not_take_is_refused_by_name() {
    own_network();
    let _device = FakeCamera::start(&[]);
    let refused = |config: &AravisConfig, format| {
        AravisCamera::open(config, RigFacts { format, ..FACTS }).err().unwrap()
    };
    let error = refused(&config(1000, 256), PixelFormat::Mono12p);
    assert_eq!(error.kind, DeviceErrorKind::OutOfRange, "{error}");
    assert!(error.to_string().contains("PixelFormat") && error.to_string().contains("Mono16"), "{error}");
    let line7 = AravisConfig { trigger_source: "Line7".into(), ..config(1000, 256) };
    let error = refused(&line7, PixelFormat::Mono8);
    assert!(error.to_string().contains("TriggerSource: \"Line7\""), "{error}");
    let error = refused(&config(1000, 4096), PixelFormat::Mono8);
    assert!(error.to_string().contains("Width: 4096 was asked for: must be from 1 to 2048"), "{error}");

    let mut camera = AravisCamera::open(&config(1000, 256), FACTS).unwrap();
    let delayed = CameraSettings { trigger_delay_us: 100.0, ..SETTINGS };
    assert_eq!(camera.configure(ID, &delayed).unwrap_err().kind, DeviceErrorKind::OutOfRange);
    let global = CameraSettings { shutter: Shutter::Global, ..SETTINGS };
    assert_eq!(camera.configure(ID, &global).unwrap_err().kind, DeviceErrorKind::Unsupported);
    camera.configure(ID, &SETTINGS).unwrap();
    drop(camera);

    let nobody = AravisConfig { address: Some("127.0.0.9".into()), ..config(1000, 256) };
    let error = refused(&nobody, PixelFormat::Mono8);
    assert_eq!(error.kind, DeviceErrorKind::Disconnected, "{error}");
    assert!(error.to_string().contains("127.0.0.9") && error.to_string().contains("raysweep devices"));
}

#[test]
fn ten_thousand_frames_and_every_lost_one_has_its_cause() {
    own_network();
    // One packet in a thousand is lost, and the device cannot send it again.
    let _device = FakeCamera::start(&["-r", "1"]);
    let mut camera = AravisCamera::open(&config(1_000, 128), FACTS).unwrap();
    camera.configure(ID, &SETTINGS).unwrap();
    camera.arm().unwrap();
    let pool = FramePool::new(1, 128 * 128);
    let mut buf = pool.take();
    let (mut first, mut newest, mut received) = (None, 0, 0);
    let mut lost = BTreeMap::<LossCause, u64>::new();
    while newest < 10_000 {
        let stamp = camera.next_frame(&mut buf, Duration::from_secs(2)).unwrap().expect("a frame every ms");
        first.get_or_insert(stamp.seq);
        for seq in newest.max(first.unwrap_or(1) - 1) + 1..stamp.seq {
            *lost.entry(camera.loss_of(seq)).or_default() += 1;
        }
        newest = stamp.seq;
        received += 1;
    }
    let lost_total: u64 = lost.values().sum();
    assert_eq!(received + lost_total, newest - first.unwrap() + 1);
    assert!(lost[&LossCause::PacketsLost] > 0, "{lost:?}");
    eprintln!("{received} frames, lost: {lost:?}");
}

/// Takes frames until `enough` returns true; also calls it if there is no frame.
fn watch(camera: &mut AravisCamera, mut enough: impl FnMut(&AravisCamera, Option<FrameStamp>) -> bool) {
    let pool = FramePool::new(1, 128 * 128);
    let mut buf = pool.take();
    let patience = Instant::now() + Duration::from_secs(60);
    loop {
        let stamp = camera.next_frame(&mut buf, Duration::from_millis(100)).unwrap();
        if enough(camera, stamp) {
            return;
        }
        assert!(Instant::now() < patience, "nothing happens: {:?}", camera.state());
    }
}

#[test]
fn a_camera_that_died_is_noticed_and_goes_on_when_it_is_back() {
    own_network();
    let device = FakeCamera::start(&[]);
    let mut camera = AravisCamera::open(&config(16_667, 128), FACTS).unwrap();
    camera.configure(ID, &SETTINGS).unwrap();
    camera.arm().unwrap();
    let mut newest = None;
    watch(&mut camera, |_, stamp| {
        newest = stamp.or(newest);
        stamp.is_some_and(|stamp| stamp.seq >= 30)
    });
    let before = newest.unwrap();
    drop(device);
    let died = Instant::now();
    watch(&mut camera, |camera, stamp| {
        newest = stamp.or(newest);
        camera.state() == DeviceState::Lost
    });
    eprintln!("noticed after {:?}", died.elapsed());
    let error = camera.configure(ID, &SETTINGS).unwrap_err();
    assert_eq!(error.kind, DeviceErrorKind::Disconnected, "{error}");

    let _device = FakeCamera::start(&[]);
    let back = Instant::now();
    let mut after = None;
    watch(&mut camera, |camera, stamp| {
        after = stamp;
        assert_eq!(stamp.is_some(), camera.state() == DeviceState::Streaming);
        stamp.is_some()
    });
    eprintln!("back after {:?}", back.elapsed());
    let applied = camera.configure(ID, &SETTINGS).unwrap();
    let (newest, after) = (newest.unwrap(), after.unwrap());
    assert!(newest.seq >= before.seq);
    // About as many ids have passed as there were triggers; the number around its loss and its return is uncertain, and
    // a busy host may be a second late.
    let away_ns = after.exposure_start_ns - newest.exposure_start_ns;
    let passed = away_ns as f64 / (FACTS.trigger_period_us * 1e3);
    assert!((passed - (after.seq - newest.seq) as f64).abs() <= 60.0, "{passed} {newest:?} {after:?}");
    assert!((newest.seq + 1..after.seq).all(|seq| camera.loss_of(seq) == LossCause::CameraLost));
    assert!(applied.first_frame.certain() > newest.seq);
}

#[test]
fn a_camera_that_waits_for_its_trigger_is_not_lost() {
    own_network();
    let _device = FakeCamera::start(&[]);
    let triggered = AravisConfig { trigger_source: "Line0".into(), ..config(1_000, 128) };
    let mut camera = AravisCamera::open(&triggered, FACTS).unwrap();
    camera.configure(ID, &SETTINGS).unwrap();
    camera.arm().unwrap();
    let begun = Instant::now();
    watch(&mut camera, |camera, stamp| {
        assert_eq!((stamp, camera.state()), (None, DeviceState::Streaming));
        begun.elapsed() > Duration::from_secs(3)
    });
}

#[test]
fn a_camera_that_stays_away_is_given_up() {
    own_network();
    let device = FakeCamera::start(&[]);
    let facts = RigFacts { reopen: Duration::from_secs(2), ..FACTS };
    let mut camera = AravisCamera::open(&config(4_000, 128), facts).unwrap();
    camera.arm().unwrap();
    device.signal(Signal::SIGSTOP);
    let pool = FramePool::new(1, 128 * 128);
    let mut buf = pool.take();
    let error = loop {
        match camera.next_frame(&mut buf, Duration::from_millis(100)) {
            Ok(_) => {}
            Err(error) => break error,
        }
    };
    assert_eq!(error.kind, DeviceErrorKind::Disconnected);
    assert!(error.to_string().contains("camera.reopen_s = 2"), "{error}");
}

#[test]
fn a_camera_that_opens_again_and_then_stays_silent_is_given_up() {
    own_network();
    let device = FakeCamera::start(&[]);
    let triggered = AravisConfig { trigger_source: "Line0".into(), ..config(1_000, 128) };
    let facts = RigFacts { reopen: Duration::from_secs(10), ..FACTS };
    let mut camera = AravisCamera::open(&triggered, facts).unwrap();
    camera.configure(ID, &SETTINGS).unwrap();
    camera.arm().unwrap();
    drop(device);
    watch(&mut camera, |camera, _| camera.state() == DeviceState::Lost);
    let _device = FakeCamera::start(&[]);
    let pool = FramePool::new(1, 128 * 128);
    let mut buf = pool.take();
    let error = loop {
        match camera.next_frame(&mut buf, Duration::from_millis(100)) {
            Ok(stamp) => assert_eq!((stamp, camera.state()), (None, DeviceState::Lost)),
            Err(error) => break error,
        }
    };
    assert_eq!(error.kind, DeviceErrorKind::Disconnected);
    assert!(error.to_string().contains("delivered nothing within camera.reopen_s = 10 s"), "{error}");
}

#[test]
fn cameras_that_open_at_once_do_not_disturb_each_other() {
    thread::scope(|scope| {
        for size in [128, 192, 256, 320] {
            scope.spawn(move || {
                own_network();
                let _device = FakeCamera::start(&[]);
                for _ in 0..20 {
                    let camera = AravisCamera::open(&config(16_667, size), FACTS).unwrap();
                    assert_eq!(camera.capabilities().width, size as usize);
                }
            });
        }
    });
}

#[test]
fn a_camera_is_found_and_its_settings_are_saved_and_restored() {
    own_network();
    let _device = FakeCamera::start(&[]);
    let found = discover();
    assert_eq!(found.len(), 1, "{found:?}");
    assert_eq!((found[0].address.as_str(), found[0].model.as_str()), (ADDRESS, "Fake"));

    let by_name = AravisConfig { address: None, name: Some(found[0].name.clone()), ..config(16_667, 256) };
    let mut camera = AravisCamera::open(&by_name, FACTS).unwrap();
    camera.configure(ID, &CameraSettings { exposure_us: 1234.0, ..SETTINGS }).unwrap();
    let error = save_features(ADDRESS).unwrap_err();
    assert_eq!(error.kind, DeviceErrorKind::Busy, "{error}");
    drop(camera);
    let saved = save_features(ADDRESS).unwrap();
    for line in ["Width=256", "Height=256", "ExposureTimeAbs=1234", "PixelFormat=Mono8", "TriggerMode=Off"] {
        assert!(saved.lines().any(|saved| saved == line), "{line} in\n{saved}");
    }

    drop(AravisCamera::open(&AravisConfig { binning: [2, 2], ..config(16_667, 512) }, FACTS).unwrap());
    assert_ne!(save_features(ADDRESS).unwrap(), saved);
    let text = format!("{saved}NoSuchFeature=1\nWidth=1000000\n");
    let (taken, refused) = load_features(ADDRESS, &text).unwrap();
    let lines: Vec<_> = refused.iter().map(|refused| refused.line.as_str()).collect();
    assert_eq!(lines, ["NoSuchFeature=1", "Width=1000000"], "{refused:?}");
    assert_eq!(taken, saved.lines().count() - 1);
    assert_eq!(save_features(ADDRESS).unwrap(), saved);
}
