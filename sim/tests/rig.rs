//! The simulated devices through the traits that real ones implement, on a scene with known values.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::path::Path;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use ndarray::Array3;
use raysweep_config::sim::SimConfig;
use raysweep_config::sim::{
    FlickerPhase, RowTable, SimAmbient, SimBeam, SimBoard, SimProjector, SimSensor, SimSpot, SimTruth,
    SimVsync,
};
use raysweep_core::{
    Camera, CameraSettings, DeviceErrorKind, Edge, FirstFrame, FramePool, FrameStamp, Pattern, PixelFormat,
    Raster, SettingsId, Shutter, Subject,
};
use raysweep_sim::{PlaneDevices, PlaneRig, PlaneSetup, SimError, SubjectSwitch};

const ROWS: usize = 8;
const COLUMNS: usize = 4;
const TAU_US: f64 = 20.0;
const WHITE: f64 = 1000.0;
const RASTER: Raster = Raster { rows: ROWS, row_time_us: TAU_US, first_row_us: 500.0, period_us: 16_000.0 };

/// Row v lights camera row v with 1 and the row below it with 1/4.
fn scene(folder: &Path) -> std::path::PathBuf {
    let transport = Array3::<f32>::from_shape_fn((ROWS, ROWS, COLUMNS), |(v, t, _)| match t.checked_sub(v) {
        Some(0) => 1.0,
        Some(1) => 0.25,
        _ => 0.0,
    });
    let path = folder.join("steps.npz");
    let mut npz = ndarray_npy::NpzWriter::new(std::fs::File::create(&path).unwrap());
    npz.add_array("T", &transport).unwrap();
    npz.finish().unwrap();
    path
}

fn rig(change: impl FnOnce(&mut SimConfig)) -> PlaneRig {
    rig_of(RASTER, change).unwrap()
}

/// The scene in the middle of a taller frame, from projector row 8 on.
fn tall_rig(change: impl FnOnce(&mut SimConfig)) -> Result<PlaneRig, SimError> {
    rig_of(Raster { rows: 24, ..RASTER }, change)
}

fn rig_of(raster: Raster, change: impl FnOnce(&mut SimConfig)) -> Result<PlaneRig, SimError> {
    let folder = tempfile::tempdir().unwrap();
    let mut config = SimConfig {
        scene: scene(folder.path()),
        sensor: SimSensor { noise: false, ..SimSensor::default() },
        vsync: SimVsync { jitter_us: 0.0, ..SimVsync::default() },
        ..SimConfig::default()
    };
    config.camera.trigger_latency_us = 0.0;
    change(&mut config);
    let setup = PlaneSetup {
        raster,
        camera_row_time_us: TAU_US,
        row_pitch: 1.0,
        white_dn: WHITE,
        black_dn: 0.0,
        format: PixelFormat::Mono12,
        first_row: None,
    };
    PlaneRig::new(config, setup, Path::new(""))
}

/// A running rig, with its VSYNC monitored on a separate thread because virtual time waits for every device.
struct Bench {
    camera: Option<Box<dyn Camera>>,
    edges: Receiver<Edge>,
    pool: FramePool,
    subject: SubjectSwitch,
}

impl Bench {
    /// Shows a pattern (`None`: dark) and waits until the light shows it.
    fn lit(rig: &PlaneRig, pattern: Option<&Pattern>) -> Self {
        Self::lit_before(rig, Subject::Scene, pattern)
    }

    /// The same with this subject before the camera.
    fn lit_before(rig: &PlaneRig, before: Subject, pattern: Option<&Pattern>) -> Self {
        let PlaneDevices { mut camera, mut vsync, mut projector, subject, .. } = rig.open();
        subject.place(before).unwrap();
        let (seen, edges) = channel();
        std::thread::spawn(move || {
            while let Ok(edge) = vsync.next_edge(Duration::from_secs(1)) {
                if edge.is_some_and(|edge| seen.send(edge).is_err()) {
                    break;
                }
            }
        });
        camera.arm().unwrap();
        let shown = match pattern {
            Some(pattern) => projector.show(pattern).unwrap(),
            None => projector.blank().unwrap(),
        };
        let pool = FramePool::new(1, ROWS * COLUMNS * 2);
        let mut bench = Self { camera: Some(camera), edges, pool, subject };
        while bench.frame().1.exposure_start_ns < shown.not_before_ns {}
        bench
    }

    fn camera(&mut self) -> &mut dyn Camera {
        &mut **self.camera.as_mut().unwrap()
    }

    /// Light of each pixel, `[row][column]`, of the next frame, with the frame's stamp.
    fn frame(&mut self) -> (Vec<Vec<f64>>, FrameStamp) {
        let mut data = self.pool.take();
        let mut pixels = [0; ROWS * COLUMNS];
        let stamp = self.camera().next_frame(&mut data, Duration::from_secs(1)).unwrap().expect("a frame");
        PixelFormat::Mono12.unpack_into(&data, &mut pixels).unwrap();
        let rows = pixels.chunks(COLUMNS).map(|row| row.iter().map(|&dn| f64::from(dn) / WHITE).collect());
        (rows.collect(), stamp)
    }

    /// The light of the first frame under new settings.
    fn expose(&mut self, settings: CameraSettings) -> Vec<Vec<f64>> {
        self.camera().configure(SettingsId { point: 0, attempt: 0 }, &settings).unwrap();
        self.frame().0
    }
}

impl Drop for Bench {
    fn drop(&mut self) {
        // Without the camera the clock continues to run for the monitor, which then finds its receiver gone.
        self.camera = None;
    }
}

fn rolling(start_us: f64, exposure_us: f64) -> CameraSettings {
    CameraSettings { shutter: Shutter::Rolling, exposure_us, trigger_delay_us: start_us }
}

fn only(row: usize) -> Pattern {
    Pattern::Rows((0..ROWS).map(|v| if v == row { 1.0 } else { 0.0 }).collect())
}

#[test]
fn a_rolling_shutter_follows_the_projector_row_by_row() {
    let rig = rig(|_| {});
    let mut bench = Bench::lit(&rig, Some(&Pattern::White));
    // Each row is exposed exactly while its own projector row is lit.
    let settings = rolling(500.0, TAU_US);
    bench.camera().configure(SettingsId { point: 0, attempt: 0 }, &settings).unwrap();
    let (own, stamp) = bench.frame();
    assert!(own.iter().flatten().all(|&light| light == 1.0), "{own:?}");
    assert_eq!(stamp.exposure_us, Some(TAU_US));
    assert_eq!(
        stamp.host_ns - stamp.exposure_start_ns,
        20_000 + 8 * 20_000,
        "exposure, then the rows' readout"
    );
    // One row earlier, each camera row receives the row above its own: a quarter, and nothing for the top row.
    let above = bench.expose(rolling(480.0, TAU_US));
    assert!(
        above[0].iter().all(|&light| light == 0.0) && above[1..].iter().flatten().all(|&light| light == 0.25)
    );
    // Half a row early: half of each.
    let between = bench.expose(rolling(490.0, TAU_US));
    assert!(between[1..].iter().flatten().all(|&light| (light - 0.625).abs() <= 0.0005), "{between:?}");
}

#[test]
fn a_global_shutter_sees_the_rows_of_one_moment() {
    let rig = rig(|_| {});
    let mut bench = Bench::lit(&rig, Some(&Pattern::White));
    let settings = CameraSettings { shutter: Shutter::Global, ..rolling(500.0 + 2.0 * TAU_US, 2.0 * TAU_US) };
    let rows = bench.expose(settings);
    let first: Vec<f64> = rows.iter().map(|row| row[0]).collect();
    assert_eq!(first, [0.0, 0.0, 1.0, 1.25, 0.25, 0.0, 0.0, 0.0]);
}

#[test]
fn a_single_row_lights_what_the_scene_says_and_a_dark_projector_nothing() {
    let rig = rig(|_| {});
    let mut bench = Bench::lit(&rig, Some(&only(3)));
    let long = rolling(0.0, 16_000.0);
    let rows = bench.expose(long);
    let first: Vec<f64> = rows.iter().map(|row| row[0]).collect();
    assert_eq!(first, [0.0, 0.0, 0.0, 1.0, 0.25, 0.0, 0.0, 0.0]);
    let dark = Bench::lit(&rig, None).expose(long);
    assert!(dark.iter().flatten().all(|&light| light == 0.0));
}

#[test]
fn a_beam_spreads_a_row_and_keeps_its_light() {
    for (beam, expected) in [
        (SimBeam::FlatTop { up_rows: 0.5, down_rows: 1.5 }, [0.0, 0.0, 0.5, 0.5, 0.0]),
        (SimBeam::Gaussian { sigma_rows: 0.5 }, [0.0002, 0.1065, 0.7866, 0.1065, 0.0002]),
    ] {
        let rig = rig(|config| config.projector.beam = beam);
        let mut bench = Bench::lit(&rig, Some(&only(3)));
        let rows = bench.expose(rolling(0.0, 16_000.0));
        // The quarter that each lit row sends to the row below belongs to the scene, not to the beam.
        let mut seen = [0.0; 5];
        for (k, share) in seen.iter_mut().enumerate() {
            *share = rows[k + 1][0] - 0.25 * expected.get(k.wrapping_sub(1)).copied().unwrap_or(0.0);
        }
        for (seen, expected) in seen.iter().zip(expected) {
            assert!((seen - expected).abs() < 0.002, "{seen} is not {expected}");
        }
    }
}

#[test]
fn a_flying_spot_lights_each_column_at_its_own_moment() {
    // The spot passes the columns at 2.5, 7.5, 12.5 and 17.5 us of a row's 20; an exposure of the first half sees two.
    let halves = |spot| {
        let rig = rig(|config| config.projector = SimProjector { spot, ..SimProjector::default() });
        let mut bench = Bench::lit(&rig, Some(&Pattern::White));
        bench.expose(rolling(500.0, TAU_US / 2.0))
    };
    let one_way = halves(SimSpot::OneWay);
    assert!(one_way.iter().all(|row| row[..] == [1.0, 1.0, 0.0, 0.0]), "{one_way:?}");
    let both_ways = halves(SimSpot::Bidirectional);
    assert_eq!(
        (&both_ways[2][..], &both_ways[3][..]),
        (&[1.0, 1.0, 0.0, 0.0][..], &[0.0, 0.0, 1.0, 1.0][..])
    );
    let uniform = halves(SimSpot::Uniform);
    assert!(uniform.iter().flatten().all(|&light| light == 0.5), "{uniform:?}");
}

#[test]
fn row_tables_bend_the_sweep_and_keep_its_ends() {
    for table in [
        RowTable::Quadratic { percent: 5.0 },
        RowTable::Kinked { pieces: 3, amplitude_us: 12.0, percent: 0.0 },
    ] {
        let rig = rig(|config| config.projector.row_table = table.clone());
        let mut bench = Bench::lit(&rig, Some(&Pattern::White));
        let global = |start_us, exposure_us| CameraSettings {
            shutter: Shutter::Global,
            ..rolling(start_us, exposure_us)
        };
        let total = |rows: Vec<Vec<f64>>| rows.iter().map(|row| row[0]).sum::<f64>();
        let all = total(bench.expose(global(500.0, 160.0)));
        assert_eq!(all, 8.0 + 7.0 * 0.25, "the whole sweep takes as long as before: {table:?}");
        let half = total(bench.expose(global(500.0, 80.0)));
        assert!((half - 5.0).abs() > 0.1, "half the time is not half the rows: {half}, {table:?}");
    }
    assert!(
        std::panic::catch_unwind(|| rig(|config| {
            config.projector.row_table = RowTable::Kinked { pieces: 8, amplitude_us: 500.0, percent: 0.0 };
        }))
        .is_err()
    );
}

#[test]
fn settings_take_effect_as_late_as_they_are_said_to() {
    let rig = rig(|config| (config.camera.late_frames_min, config.camera.late_frames_max) = (2, 2));
    let mut bench = Bench::lit(&rig, Some(&Pattern::White));
    let settings = rolling(500.0, 123.0);
    let applied = bench.camera().configure(SettingsId { point: 0, attempt: 0 }, &settings).unwrap();
    let frames: Vec<_> = (0..4).map(|_| bench.frame().1).collect();
    let first = frames.iter().find(|stamp| stamp.exposure_us == Some(123.0)).unwrap();
    let promised = FirstFrame::Within { earliest: frames[0].seq, certain: frames[2].seq };
    assert_eq!((applied.first_frame, first.seq), (promised, frames[2].seq));
}

#[test]
fn the_light_of_the_next_edge_is_seen_by_an_exposure_that_begins_before_it() {
    let rig = rig(|_| {});
    let mut bench = Bench::lit(&rig, Some(&Pattern::White));
    let settings = rolling(16_000.0 - 200.0, 200.0 + 500.0 + TAU_US);
    bench.camera().configure(SettingsId { point: 0, attempt: 0 }, &settings).unwrap();
    let (rows, stamp) = bench.frame();
    assert!(rows.iter().flatten().all(|&light| light >= 1.0), "{rows:?}");
    let edge = bench.edges.recv().unwrap();
    assert_eq!((stamp.exposure_start_ns - edge.host_ns).rem_euclid(16_000_000), 15_800_000);
}

#[test]
fn what_a_camera_cannot_do_is_refused_by_field_and_value() {
    let rig = rig(|_| {});
    let mut devices = rig.open();
    let id = SettingsId { point: 0, attempt: 0 };
    for (settings, field) in [
        (rolling(0.0, 0.0), "exposure_us"),
        (rolling(0.0, f64::NAN), "exposure_us"),
        (rolling(-1.0, 10.0), "trigger_delay_us"),
    ] {
        let error = devices.camera.configure(id, &settings).unwrap_err();
        assert_eq!((error.device, error.kind), ("camera", DeviceErrorKind::OutOfRange));
        assert!(error.to_string().contains(field), "{error}");
    }
    let mut data = FramePool::new(1, ROWS * COLUMNS * 2).take();
    let error = devices.camera.next_frame(&mut data, Duration::ZERO).unwrap_err();
    assert_eq!(error.kind, DeviceErrorKind::NotReady);
    assert!(devices.projector.show(&Pattern::Rows(vec![1.0; 3])).unwrap_err().to_string().contains("3 rows"));
    let board = Pattern::Checkerboard { cell_px: 8, shift_px: (0, 0) };
    assert_eq!(devices.projector.show(&board).unwrap_err().kind, DeviceErrorKind::Unsupported);
}

#[test]
fn a_wait_ends_when_its_time_is_up() {
    let rig = rig(|_| {});
    let mut devices = rig.open();
    devices.camera.disarm().unwrap();
    let before_ns = devices.clock.now_ns();
    // No edge lies within the first millisecond of a line with a period of 16 ms.
    drop(devices.camera);
    assert!(devices.vsync.next_edge(Duration::from_millis(1)).unwrap().is_none());
    assert_eq!(devices.clock.now_ns() - before_ns, 1_000_000);
}

#[test]
fn rows_beside_the_scenes_window_shine_into_it() {
    // A long exposure of the scene's first row; with the beam of sigma 0.5, the rows above it contribute 0.1065 +
    // 0.0003.
    let first_row = |projector_rows: usize, first_row: usize| {
        let folder = tempfile::tempdir().unwrap();
        let config = SimConfig {
            scene: scene(folder.path()),
            projector: SimProjector {
                beam: SimBeam::Gaussian { sigma_rows: 0.5 },
                ..SimProjector::default()
            },
            ..SimConfig::default()
        };
        let setup = PlaneSetup {
            raster: Raster { rows: projector_rows, ..RASTER },
            camera_row_time_us: TAU_US,
            row_pitch: 1.0,
            white_dn: WHITE,
            black_dn: 0.0,
            format: PixelFormat::Mono12,
            first_row: Some(first_row),
        };
        let rig = PlaneRig::new(config, setup, Path::new("")).unwrap();
        rig.noise_free(0.0, 4000.0).unwrap()[[0, 0]]
    };
    assert!((first_row(ROWS, 0) - (1.0 - 0.1068)).abs() < 1e-3, "nothing is drawn above the frame");
    assert!((first_row(20, 6) - 1.0).abs() < 1e-3, "rows above the window are drawn");
}

/// A long exposure of all rows under a pattern.
fn pass(rig: &PlaneRig, before: Subject, pattern: &Pattern) -> Vec<Vec<f64>> {
    Bench::lit_before(rig, before, Some(pattern)).expose(rolling(0.0, 16_000.0))
}

fn assert_near(seen: &[f64], expected: &[f64]) {
    let is_near = seen.len() == expected.len()
        && seen.iter().zip(expected).all(|(seen, expected)| (seen - expected).abs() <= 0.002);
    assert!(is_near, "{seen:?} is not {expected:?}");
}

#[test]
fn the_true_latency_moves_the_exposure_and_not_its_stamp() {
    let rig = rig(|config| config.truth.trigger_latency_us = Some(10.0));
    let mut bench = Bench::lit(&rig, Some(&Pattern::White));
    let own = bench.expose(rolling(490.0, TAU_US));
    assert!(own.iter().flatten().all(|&light| light == 1.0), "{own:?}");
    let (_, stamp) = bench.frame();
    let edge = bench.edges.recv().unwrap();
    assert_eq!((stamp.exposure_start_ns - edge.host_ns).rem_euclid(16_000_000), 490_000);
    assert_eq!(bench.camera().capabilities().trigger_latency_us, 0.0);
}

#[test]
fn true_row_times_and_counts_are_the_simulators_alone() {
    let rig = rig(|config| {
        config.truth = SimTruth {
            first_row_us: Some(400.0),
            row_time_us: Some(21.0),
            camera_row_time_us: Some(21.0),
            white_dn: Some(500.0),
            black_dn: Some(100.0),
            ..SimTruth::default()
        };
    });
    let mut bench = Bench::lit(&rig, Some(&Pattern::White));
    let own = bench.expose(rolling(400.0, 21.0));
    assert!(own.iter().flatten().all(|&light| light == 0.6), "100 and 500 of {WHITE} counts: {own:?}");
    assert_eq!(bench.camera().capabilities().row_time_us, TAU_US);
    assert_eq!((rig.row_starts_us().unwrap()[8], rig.truth().raster.row_time_us), (568.0, 21.0));
}

#[test]
fn all_light_of_a_pixel_comes_from_rows_about_its_true_place() {
    let moved = |truth: SimTruth| tall_rig(|config| config.truth = truth).unwrap();
    let under_row_11 = |rig: &PlaneRig| {
        let line = Pattern::Line { row: 11 };
        pass(rig, Subject::Scene, &line).iter().map(|row| row[0]).collect::<Vec<_>>()
    };
    assert_near(&under_row_11(&moved(SimTruth::default())), &[0.0, 0.0, 0.0, 1.0, 0.25, 0.0, 0.0, 0.0]);
    let quarter = moved(SimTruth { row_offset_rows: 0.25, ..SimTruth::default() });
    // Camera row 2 looks at 10.25 and camera row 3 at 11.25; a quarter of each row goes to the camera row below.
    let expected = [0.0, 0.0, 0.25, 0.75 + 0.25 * 0.25, 0.25 * 0.75, 0.0, 0.0, 0.0];
    assert_near(&under_row_11(&quarter), &expected);
    let up = moved(SimTruth { row_offset_rows: -2.0, ..SimTruth::default() });
    assert_near(&under_row_11(&up), &[0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.25, 0.0]);
    let first = moved(SimTruth { first_projector_row: Some(6), ..SimTruth::default() });
    assert_near(&under_row_11(&first), &[0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 0.25, 0.0]);
    assert_eq!((first.first_row(), first.truth().first_row), (8, 6), "the rig file knows nothing of it");

    let turned = moved(SimTruth { rotation_deg: 0.5_f64.atan().to_degrees(), ..SimTruth::default() });
    let rows = pass(&turned, Subject::Board, &Pattern::Line { row: 11 });
    // The columns look 0.75 and 0.25 rows above and below.
    assert_near(&rows[3], &[0.25, 0.75, 0.75, 0.25]);
    assert!((turned.truth().place(3, 0) - 10.25).abs() < 1e-9);
    let larger = moved(SimTruth { magnification: 1.2, ..SimTruth::default() });
    assert!((larger.truth().place(7, 0) - larger.truth().place(0, 0) - 8.4).abs() < 1e-9);
    let rows = pass(&larger, Subject::Board, &Pattern::White);
    assert!(rows.iter().flatten().all(|&light| (light - 1.0).abs() <= 0.002), "{rows:?}");
}

#[test]
fn a_flying_spot_and_a_fractional_place_go_together() {
    let rig = tall_rig(|config| {
        config.projector.spot = SimSpot::OneWay;
        config.truth.row_offset_rows = 0.5;
    })
    .unwrap();
    for before in [Subject::Scene, Subject::Board] {
        let mut bench = Bench::lit_before(&rig, before, Some(&Pattern::Line { row: 11 }));
        // Row 11 is lit from 720 us on, and camera row 3 begins 60 us late: its first half has the first two columns.
        let rows = bench.expose(rolling(660.0, TAU_US / 2.0));
        // Half of the quarter from the scene row above, for half of the row's time.
        let steady = if before == Subject::Scene { 0.25 * 0.5 * 0.5 } else { 0.0 };
        assert_near(&rows[3], &[0.5 + steady, 0.5 + steady, steady, steady]);
    }
}

#[test]
fn truths_that_do_not_fit_are_refused_by_name() {
    let refused = |truth: SimTruth| {
        let Err(error) = tall_rig(|config| config.truth = truth.clone()) else {
            panic!("{truth:?} is taken")
        };
        assert!(error.to_string().contains(&format!("sim.{}", error.key())), "{error}");
        error.key()
    };
    let none = SimTruth::default;
    assert_eq!(refused(SimTruth { row_time_us: Some(700.0), ..none() }), "truth.row_time_us");
    assert_eq!(refused(SimTruth { first_row_us: Some(15_900.0), ..none() }), "truth.first_row_us");
    assert_eq!(refused(SimTruth { first_projector_row: Some(17), ..none() }), "truth.first_projector_row");
    assert_eq!(refused(SimTruth { row_offset_rows: 8.5, ..none() }), "truth.row_offset_rows");
    assert_eq!(refused(SimTruth { rotation_deg: 45.1, ..none() }), "truth.rotation_deg");
    assert_eq!(refused(SimTruth { magnification: 4.0, ..none() }), "truth.magnification");
    assert_eq!(refused(SimTruth { row_pitch: Some(3.0), ..none() }), "truth.row_pitch");
    assert_eq!(
        refused(SimTruth { trigger_latency_us: Some(f64::NAN), ..none() }),
        "truth.trigger_latency_us"
    );
}

#[test]
fn a_kernel_is_drawn_as_it_is_given_and_changes_down_the_frame() {
    let kernel = |to: Option<Vec<f64>>| SimBeam::Kernel {
        rows: vec![-1, 0, 1, 2],
        weights: vec![1.0, 5.0, 3.0, 1.0],
        to,
    };
    let under = |beam: SimBeam, row| {
        let rig = tall_rig(|config| config.projector.beam = beam).unwrap();
        pass(&rig, Subject::Board, &Pattern::Line { row }).iter().map(|row| row[0]).collect::<Vec<_>>()
    };
    assert_near(&under(kernel(None), 11), &[0.0, 0.0, 0.1, 0.5, 0.3, 0.1, 0.0, 0.0]);
    // Row 11.5 of 0 to 23 is the middle.
    let to = Some(vec![0.0, 1.0, 0.0, 0.0]);
    let down = 11.0 / 23.0;
    let expected = [0.1 - 0.1 * down, 0.5 + 0.5 * down, 0.3 - 0.3 * down, 0.1 - 0.1 * down];
    assert_near(&under(kernel(to), 11)[2..6], &expected);
    for (rows, weights) in [(vec![0, 0], vec![1.0; 2]), (vec![0], vec![0.0]), (vec![0, 1], vec![1.0, -1.0])] {
        let beam = SimBeam::Kernel { rows, weights, to: None };
        let Err(error) = tall_rig(|config| config.projector.beam = beam.clone()) else { panic!("{beam:?}") };
        assert!(error.to_string().contains("kernel"), "{error}");
    }
}

#[test]
fn board_and_cap_stand_before_the_camera_at_once() {
    let rig = tall_rig(|config| config.ambient.level = 0.001).unwrap();
    let mut bench = Bench::lit(&rig, Some(&Pattern::Line { row: 11 }));
    let ambient = 0.001 * 16_000.0 / TAU_US;
    let column = |rows: Vec<Vec<f64>>| rows.iter().map(|row| row[0] - ambient).collect::<Vec<_>>();
    let long = rolling(0.0, 16_000.0);
    assert_near(&column(bench.expose(long)), &[0.0, 0.0, 0.0, 1.0, 0.25, 0.0, 0.0, 0.0]);
    bench.subject.place(Subject::Board).unwrap();
    assert_near(&column(bench.expose(long)), &[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0]);
    bench.subject.place(Subject::Cap).unwrap();
    assert!(bench.expose(long).iter().flatten().all(|&light| light == 0.0));
    bench.subject.place(Subject::Scene).unwrap();
    assert_near(&column(bench.expose(long))[4..5], &[0.25]);
    let error = bench.subject.place(Subject::Diffuser).unwrap_err();
    assert_eq!((error.device, error.kind), ("subject", DeviceErrorKind::OutOfRange));
}

#[test]
fn a_board_scatters_as_much_as_it_is_said_to() {
    let raster = Raster { rows: 64, ..RASTER };
    let board = SimBoard { scatter_rows: 1.5, scatter_share: 0.15, ..SimBoard::default() };
    let rig = rig_of(raster, |config| {
        config.board = board;
        config.truth.white_dn = Some(4.0 * WHITE);
    })
    .unwrap();
    // Camera row 3 looks at row 31.
    let share = |row| pass(&rig, Subject::Board, &Pattern::Line { row })[3][0] / 4.0;
    let shares: Vec<f64> = (24..39).map(share).collect();
    let total: f64 = shares.iter().sum();
    let variance: f64 = (24..39).zip(&shares).map(|(row, share)| f64::from(row - 31).powi(2) * share).sum();
    assert!((total - 1.0).abs() < 0.005, "{shares:?}");
    assert!((variance / (0.15 * 1.5 * 1.5) - 1.0).abs() < 0.1, "{variance}");
}

#[test]
fn columns_are_shown_to_the_board_and_to_built_in_scenes() {
    let code = |bit, inverse| Pattern::GrayColumns { bit, inverse, block: 160 };
    let rig = tall_rig(|_| {}).unwrap();
    // Each of four columns sees two blocks, whose Gray codes are 0 1, 3 2, 6 7 and 5 4.
    let seen = |bit| pass(&rig, Subject::Board, &code(bit, false))[2].clone();
    assert_near(&seen(2), &[0.0, 0.0, 1.0, 1.0]);
    assert_near(&seen(1), &[0.0, 1.0, 1.0, 0.0]);
    assert_near(&seen(0), &[0.5, 0.5, 0.5, 0.5]);
    let checkerboard = Pattern::Checkerboard { cell_px: 320, shift_px: (0, 0) };
    assert_near(&pass(&rig, Subject::Board, &checkerboard)[2], &[1.0, 0.0, 1.0, 0.0]);

    let mut devices = rig.open();
    let error = devices.projector.show(&code(0, false)).unwrap_err();
    assert!(error.to_string().contains("put the board"), "{error}");
    devices.subject.place(Subject::Board).unwrap();
    devices.projector.show(&code(0, false)).unwrap();
    assert!(
        devices.subject.place(Subject::Scene).is_err(),
        "the scene cannot be simulated under what is shown"
    );
    let image = devices.projector.show(&Pattern::Image("a.png".into())).unwrap_err();
    assert!(image.to_string().contains("files"), "{image}");

    let built_in = tall_rig(|config| {
        (config.scene, config.scene_rows, config.scene_columns) = ("v-groove".into(), ROWS, 8);
    })
    .unwrap();
    let image = |pattern: &Pattern| {
        let PlaneDevices { mut camera, vsync, mut projector, .. } = built_in.open();
        drop(vsync);
        camera.arm().unwrap();
        let shown = projector.show(pattern).unwrap();
        let mut data = FramePool::new(1, ROWS * 8 * 2).take();
        camera.configure(SettingsId { point: 0, attempt: 0 }, &rolling(0.0, 16_000.0)).unwrap();
        let mut pixels = [0; ROWS * 8];
        while camera.next_frame(&mut data, Duration::from_secs(1)).unwrap().unwrap().exposure_start_ns
            < shown.not_before_ns
        {}
        PixelFormat::Mono12.unpack_into(&data, &mut pixels).unwrap();
        pixels.map(f64::from)
    };
    let (some, rest, white) = (image(&code(1, false)), image(&code(1, true)), image(&Pattern::White));
    for ((some, rest), white) in some.iter().zip(rest).zip(white) {
        assert!((some + rest - white).abs() <= 2.0, "{some} and {rest} are not {white}");
    }
    assert!(some.iter().any(|&dn| dn > 100.0) && rest.iter().any(|&dn| dn > 100.0));
}

#[test]
fn a_continuous_lamp_is_seen_by_each_row_at_its_own_time() {
    let rig = rig(|config| {
        config.ambient =
            SimAmbient { level: 0.5, flicker: 1.0, flicker_hz: 1000.0, phase: FlickerPhase::Continuous };
    });
    let mut bench = Bench::lit(&rig, None);
    // Row 0 of frames at different delays sees what the rows of one frame see.
    let rows = bench.expose(rolling(0.0, TAU_US));
    let (_, stamp) = bench.frame();
    let later = bench.expose(rolling(5.0 * TAU_US, TAU_US));
    assert!((later[0][0] - rows[5][0]).abs() < 0.002, "{later:?} {rows:?}");
    let levels = || rows.iter().map(|row| row[0]);
    assert!(levels().fold(0.0, f64::max) - levels().fold(1.0, f64::min) > 0.02, "{rows:?}");
    assert_eq!(stamp.exposure_start_ns % 1_000_000, 0, "frames begin at whole periods of the lamp");
}
