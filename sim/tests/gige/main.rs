//! The simulated camera on real sockets: bit-exact pictures, faults, and the bench socket.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod client;
mod tools;

use std::net::Ipv4Addr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::Duration;

use raysweep_config::sim::SimConfig;
use raysweep_config::sim::{SimProjector, SimSensor, SimVsync};
use raysweep_core::{
    CameraSettings, Clock, FramePool, Pattern, PixelFormat, Projector, Raster, SettingsId, Shutter, Subject,
    Vsync,
};
use raysweep_sim::bench::{BenchProbe, BenchServer, RemoteProjector, RemoteVsync, remote_subject};
use raysweep_sim::gige::{CameraClock, Faults, GigeCamera, GigeSetup, Look, test_pixel};
use raysweep_sim::{BenchDevices, PlaneRig, PlaneSetup, WireDevices};

use self::client::Client;

const ROWS: usize = 24;
const COLUMNS: usize = 20;
const ROW_TIME_US: f64 = 20.0;
const LATENCY_US: f64 = 8.0;
const SECOND: Duration = Duration::from_secs(1);

/// A camera at an address of its own, so that tests can run in parallel.
fn setup(faults: Faults) -> GigeSetup {
    static NEXT: AtomicU8 = AtomicU8::new(1);
    let camera = NEXT.fetch_add(1, Ordering::Relaxed);
    GigeSetup {
        address: Ipv4Addr::new(127, 40, std::process::id() as u8, camera),
        serial: format!("T{camera}"),
        clock: CameraClock::default(),
        faults,
        zipped: false,
    }
}

/// A rig whose pictures depend only on settings: no noise, no jitter.
fn rig(change: impl FnOnce(&mut SimConfig)) -> PlaneRig {
    let mut config = SimConfig {
        scene: PathBuf::from("mix"),
        scene_rows: ROWS,
        scene_columns: COLUMNS,
        sensor: SimSensor { noise: false, ..SimSensor::default() },
        vsync: SimVsync { jitter_us: 0.0, ..SimVsync::default() },
        projector: SimProjector { phase_jitter_us: 0.0, ..SimProjector::default() },
        ..SimConfig::default()
    };
    config.camera.trigger_latency_us = LATENCY_US;
    change(&mut config);
    let raster = Raster { rows: ROWS, row_time_us: ROW_TIME_US, first_row_us: 500.0, period_us: 16_000.0 };
    let setup = PlaneSetup {
        raster,
        camera_row_time_us: ROW_TIME_US,
        row_pitch: 1.0,
        white_dn: 2500.0,
        black_dn: 64.0,
        format: PixelFormat::Mono12,
        first_row: None,
    };
    PlaneRig::new(config, setup, Path::new("")).unwrap()
}

/// Counts of a picture taken in virtual time through the devices of a simulated run.
fn expected(settings: CameraSettings) -> Vec<u16> {
    let devices = rig(|_| {}).open();
    let (mut camera, mut projector, mut vsync) = (devices.camera, devices.projector, devices.vsync);
    // Virtual time waits for every open device.
    let watcher = std::thread::spawn(move || {
        while vsync.next_edge(SECOND).is_ok_and(|edge| edge.is_some_and(|edge| edge.seq < 20)) {}
    });
    projector.show(&Pattern::White).unwrap();
    camera.configure(SettingsId { point: 0, attempt: 0 }, &settings).unwrap();
    camera.arm().unwrap();
    let mut buf = FramePool::new(1, PixelFormat::Mono12.frame_bytes(ROWS * COLUMNS)).take();
    for _ in 0..4 {
        assert!(camera.next_frame(&mut buf, SECOND).unwrap().is_some());
    }
    drop(camera);
    watcher.join().unwrap();
    let mut counts = vec![0; ROWS * COLUMNS];
    PixelFormat::Mono12.unpack_into(&buf, &mut counts).unwrap();
    counts
}

/// Starts the rig's camera, triggered by VSYNC, with the projector lit.
fn lit(rig: &PlaneRig, faults: Faults) -> (GigeCamera, Client, Box<dyn Vsync>) {
    let WireDevices { camera, bench: BenchDevices { vsync, mut projector, .. } } = rig.open_for_wire();
    let setup = setup(faults);
    let camera = GigeCamera::start(&setup, camera).unwrap();
    let shown = projector.show(&Pattern::White).unwrap();
    while Clock::real().now_ns() < shown.not_before_ns {
        std::thread::sleep(Duration::from_millis(5));
    }
    let mut client = Client::open(setup.address);
    client.set("TriggerMode", 1);
    (camera, client, vsync)
}

#[test]
fn pictures_are_those_of_the_simulation_to_the_bit() {
    let settings = CameraSettings { shutter: Shutter::Rolling, exposure_us: 310.0, trigger_delay_us: 620.5 };
    let counts = expected(settings);
    assert!(counts.iter().max() > counts.iter().min(), "a picture without content would prove nothing");
    let (_camera, mut client, _vsync) = lit(&rig(|_| {}), Faults::default());
    client.set_float("ExposureTime", settings.exposure_us);
    client.set_float("TriggerDelay", settings.trigger_delay_us);
    for format in [
        PixelFormat::Mono12,
        PixelFormat::Mono12p,
        PixelFormat::Mono12Packed,
        PixelFormat::Mono8,
        PixelFormat::Mono10p,
        PixelFormat::Mono16,
    ] {
        client.set("PixelFormat", format.pfnc().unwrap());
        client.set("AcquisitionStart", 1);
        let frame = client.frame().unwrap();
        client.set("AcquisitionStop", 1);
        while client.packet().is_some() {}
        let scaled: Vec<u16> =
            counts.iter().map(|count| (u32::from(*count) << format.bits() >> 12) as u16).collect();
        let mut packed = vec![0; format.frame_bytes(scaled.len())];
        format.pack_into(&scaled, &mut packed).unwrap();
        assert_eq!((frame.size, frame.block), ((ROWS, COLUMNS), 1), "{format:?}");
        assert!(frame.payload == packed, "{format:?}");
    }
}

#[test]
fn a_region_exposes_its_first_row_at_the_trigger() {
    let (y, height) = (6, 9);
    // Rows above a region take no time: equivalent to an earlier trigger.
    let delay_us = 400.0 - y as f64 * ROW_TIME_US;
    let counts = expected(CameraSettings {
        shutter: Shutter::Rolling,
        exposure_us: 200.0,
        trigger_delay_us: delay_us,
    });
    let (_camera, mut client, _vsync) = lit(&rig(|_| {}), Faults::default());
    client.set_float("ExposureTime", 200.0);
    client.set_float("TriggerDelay", 400.0);
    for (feature, value) in [("Width", 5), ("Height", height), ("OffsetX", 3), ("OffsetY", y)] {
        client.set(feature, value as u32);
    }
    client.set("AcquisitionStart", 1);
    let frame = client.frame().unwrap();
    let region: Vec<u16> =
        (y..y + height).flat_map(|row| counts[row * COLUMNS + 3..row * COLUMNS + 8].to_vec()).collect();
    let mut pixels = vec![0; region.len()];
    PixelFormat::Mono12.unpack_into(&frame.payload, &mut pixels).unwrap();
    assert_eq!(frame.size, (height, 5));
    assert_eq!(pixels, region);
}

#[test]
fn stamps_tell_the_start_of_the_exposure_on_the_cameras_own_clock() {
    let rig = rig(|config| config.vsync.jitter_us = 30.0);
    let (_camera, mut client, mut vsync) = lit(&rig, Faults::default());
    client.set_float("TriggerDelay", 321.0);
    client.set("ChunkModeActive", 1);
    (0..3).for_each(|chunk| client.set_entry("ChunkEnable", chunk, 1));
    client.set("AcquisitionStart", 1);
    let frames: Vec<_> = (0..5).map(|_| client.frame().unwrap()).collect();
    let mut edges = Vec::new();
    while let Some(edge) = vsync.next_edge(Duration::ZERO).unwrap() {
        edges.push(edge);
    }
    let clock = CameraClock::default();
    for frame in frames {
        let starts = edges.iter().map(|edge| clock.ticks(edge.host_ns + (LATENCY_US * 1e3) as i64 + 321_000));
        let nearest = starts.map(|start| start.abs_diff(frame.ticks)).min();
        assert_eq!(nearest, Some(0), "block {}", frame.block);
        assert_eq!(frame.chunk(0x1001), frame.ticks);
        assert_eq!(f64::from_bits(frame.chunk(0x1000)), 1000.0);
        assert_eq!(frame.chunk(0x1002), u64::from(frame.block) - 1);
    }
    // Latching reads the same clock.
    let before = clock.ticks(Clock::real().now_ns());
    client.set("TimestampLatch", 1);
    let after = clock.ticks(Clock::real().now_ns());
    assert!((before..=after).contains(&client.long("GevTimestampValue")));
}

#[test]
fn settings_can_be_late_and_chunks_later_still() {
    let faults = Faults { late_frames: Some(2), ..Faults::default() };
    let (camera, mut client, _vsync) = lit(&rig(|_| {}), faults);
    client.set("TriggerSource", 1);
    client.set("ChunkModeActive", 1);
    client.set_entry("ChunkEnable", 0, 1);
    client.set("AcquisitionStart", 1);
    let exposures = |client: &mut Client, set_us: f64| -> Vec<f64> {
        client.set_float("ExposureTime", set_us);
        let mut told_us = || {
            client.set("TriggerSoftware", 1);
            f64::from_bits(client.frame().unwrap().chunk(0x1000))
        };
        (0..4).map(|_| told_us()).collect()
    };
    assert_eq!(exposures(&mut client, 500.0), [1000.0, 1000.0, 500.0, 500.0]);
    assert_eq!(exposures(&mut client, 900.0), [500.0, 500.0, 900.0, 900.0]);
    camera.set_faults(Faults { late_chunk: true, ..faults });
    assert_eq!(exposures(&mut client, 700.0), [900.0, 900.0, 900.0, 700.0], "told one frame later");
}

#[test]
fn the_sequencer_takes_a_set_with_every_frame() {
    let (camera, mut client, _vsync) = lit(&rig(|_| {}), Faults::default());
    client.set("TriggerSource", 1);
    client.set("ChunkModeActive", 1);
    client.set_entry("ChunkEnable", 0, 1);
    let load = |client: &mut Client, enabled: u32, sets: &[(u32, f64, u32)]| {
        client.set("SequencerMode", 0);
        client.set("SequencerConfigurationMode", 1);
        client.set_entry("SequencerFeatureEnable", 0, enabled);
        for &(set, exposure_us, next) in sets {
            client.set("SequencerSetSelector", set);
            client.set_float("ExposureTime", exposure_us);
            client.set("SequencerSetNext", next);
            client.set("SequencerTriggerSource", 1);
            client.set("SequencerSetSave", 1);
        }
        client.set("SequencerSetStart", sets[0].0);
        client.set("SequencerConfigurationMode", 0);
        client.set("SequencerMode", 1);
    };
    let exposures = |client: &mut Client, frames: u32| -> Vec<f64> {
        let mut told_us = |_| {
            client.set("TriggerSoftware", 1);
            f64::from_bits(client.frame().unwrap().chunk(0x1000))
        };
        (0..frames).map(&mut told_us).collect()
    };
    client.set_entry("ChunkEnable", 3, 1);
    client.set("AcquisitionStart", 1);
    load(&mut client, 1, &[(3, 300.0, 5), (5, 500.0, 9), (9, 900.0, 3)]);
    let written = camera.truth().settings_written;
    assert_eq!(exposures(&mut client, 5), [300.0, 500.0, 900.0, 300.0, 500.0]);
    assert_eq!(client.number("SequencerSetActive"), 5);
    client.set("TriggerSoftware", 1);
    assert_eq!(client.frame().unwrap().chunk(0x1003), 9);
    assert_eq!(camera.truth().settings_written, written);
    client.set("SequencerMode", 0);
    assert_eq!(exposures(&mut client, 2), [900.0; 2], "what the registers have");
    load(&mut client, 0, &[(0, 310.0, 1), (1, 320.0, 0)]);
    assert_eq!(exposures(&mut client, 2), [320.0; 2], "a feature that is no part of the sets stays");
}

#[test]
fn what_is_lost_doubled_and_overtaken_on_the_way_arrives_in_the_end() {
    let faults =
        Faults { packet_loss: 0.05, duplication: 0.05, reordering: 0.05, seed: 3, ..Faults::default() };
    let size = (120, 160);
    let setup = setup(faults);
    let camera = GigeCamera::start(&setup, Look::at_test_pictures(size)).unwrap();
    let mut client = Client::open(setup.address);
    client.resend = true;
    client.set("AcquisitionStart", 1);
    for _ in 0..30 {
        let frame = client.frame().unwrap();
        let picture = (usize::from(frame.block) - 1) % 16;
        let pixel =
            |index: usize| test_pixel(index % size.1, index / size.1, picture, PixelFormat::Mono8) as u8;
        assert!(
            (0..size.0 * size.1).all(|index| frame.payload[index] == pixel(index)),
            "block {}",
            frame.block
        );
    }
    let truth = camera.truth();
    assert!(truth.packets_lost > 0 && truth.packets_resent > 0, "{truth:?}");
    assert!(truth.packets_duplicated > 0 && truth.packets_reordered > 0, "{truth:?}");
    assert!(client.received.values().any(|times| *times > 1));
}

#[test]
fn lost_frames_leave_gaps_and_packets_cannot_be_had_for_ever() {
    let faults = Faults { frame_loss: 0.3, ..Faults::default() };
    let setup = setup(faults);
    let camera = GigeCamera::start(&setup, Look::at_test_pictures((16, 16))).unwrap();
    let mut client = Client::open(setup.address);
    client.set_float("AcquisitionFrameRate", 200.0);
    client.set("AcquisitionStart", 1);
    let blocks: Vec<u16> = (0..40).map(|_| client.frame().unwrap().block).collect();
    client.set("AcquisitionStop", 1);
    assert!(blocks.is_sorted());
    let gaps: u64 = u64::from(blocks[39] - blocks[0] - 39);
    assert!(gaps > 0 && camera.truth().frames_lost >= gaps, "{gaps} {:?}", camera.truth());
    while client.packet().is_some() {}
    // The first frame is no longer stored.
    client.set("AcquisitionStart", 1);
    let block = (0..40).map(|_| client.frame().unwrap().block).last().unwrap();
    assert!(block > 16 + 1);
    client.ask_again(1, 0, 0);
    let refusal = std::iter::repeat_with(|| client.packet()).flatten().find(|packet| packet.0 != 0).unwrap();
    assert_eq!((refusal.0, refusal.1), (0x800C, 1));
}

#[test]
fn a_camera_that_died_comes_back_as_nobodys() {
    let setup = setup(Faults::default());
    let camera = GigeCamera::start(&setup, Look::at_test_pictures((16, 16))).unwrap();
    let mut client = Client::open(setup.address);
    client.set("Width", 9);
    client.set("AcquisitionStart", 1);
    assert!(client.frame().is_some());
    camera.set_faults(Faults { dead: true, ..Faults::default() });
    // Frames in transit still arrive; then there are no more.
    while client.frame_within(SECOND).is_some() {}
    assert!(!client.is_answered(Duration::from_millis(500)));
    camera.set_faults(Faults::default());
    let mut again = Client::open(setup.address);
    assert_eq!(again.number("Width"), 16, "the factory's settings");
}

#[test]
fn vsync_and_projector_reach_another_process() {
    let rig = rig(|_| {});
    let WireDevices { camera, bench } = rig.open_for_wire();
    let setup = setup(Faults::default());
    let camera = Arc::new(GigeCamera::start(&setup, camera).unwrap());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bench.sock");
    assert!(RemoteVsync::open(&path).is_err());
    let server = BenchServer::start(&path, bench, camera.clone()).unwrap();
    let mut edges = RemoteVsync::open(&path).unwrap();
    let mut light = RemoteProjector::open(&path).unwrap();
    let mut probe = BenchProbe::open(&path).unwrap();

    let (first, second) =
        (edges.next_edge(SECOND).unwrap().unwrap(), edges.next_edge(SECOND).unwrap().unwrap());
    assert_eq!((second.seq - first.seq, second.host_ns - first.host_ns), (1, 16_000_000));
    let mut client = Client::open(setup.address);
    client.set("TriggerMode", 1);
    client.set_float("TriggerDelay", 300.0);
    client.set("AcquisitionStart", 1);
    let mut brightest_after = |shown: raysweep_core::Shown| {
        let clock = CameraClock::default();
        loop {
            let frame = client.frame().unwrap();
            if frame.ticks >= clock.ticks(shown.not_before_ns) {
                let mut pixels = vec![0; ROWS * COLUMNS];
                PixelFormat::Mono12.unpack_into(&frame.payload, &mut pixels).unwrap();
                return pixels.into_iter().max().unwrap();
            }
        }
    };
    let white = brightest_after(light.show(&Pattern::White).unwrap());
    let half = brightest_after(light.show(&Pattern::Rows(vec![0.5; ROWS])).unwrap());
    let dark = brightest_after(light.blank().unwrap());
    assert_eq!(dark, 64, "black level");
    assert!(half > dark && white > half, "{white} {half} {dark}");
    let subject = remote_subject(&path).unwrap();
    subject.place(Subject::Cap).unwrap();
    assert_eq!(brightest_after(light.show(&Pattern::White).unwrap()), 64, "a cap lets no light through");
    subject.place(Subject::Scene).unwrap();
    assert!(brightest_after(light.show(&Pattern::White).unwrap()) > half);
    let error = subject.place(Subject::Diffuser).unwrap_err();
    assert!(error.to_string().contains("a plane rig has"), "{error}");

    let error = light.show(&Pattern::Rows(vec![1.0; 3])).unwrap_err();
    assert!(error.to_string().contains("3 rows"), "{error}");

    probe.set_faults(Faults { frame_loss: 1.0, ..Faults::default() }).unwrap();
    assert_eq!(camera.faults().frame_loss, 1.0);
    assert_eq!(probe.faults().unwrap(), camera.faults());
    let truth = probe.truth().unwrap();
    assert!(truth.line.exposures > 0 && truth.wire.frames > 0, "{truth:?}");
    drop(server);
    let gone = std::iter::repeat_with(|| edges.next_edge(SECOND)).find_map(Result::err).unwrap();
    assert!(gone.to_string().contains("bench"), "{gone}");
    assert!(!path.exists());
}
