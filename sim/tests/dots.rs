//! The simulated dot rig checked against independent references: the scene's own images, a separate run of the mirror
//! mechanics, and a count of all frames.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::collections::HashMap;
use std::path::Path;
use std::time::Duration;

use ndarray::{Array2, Array3, Array4};
use ndarray_npy::{NpzWriter, write_npy};
use raysweep_config::sim::{DotsConfig, SimDot, SimDotCamera, SimDotSensor, SimMirror};
use raysweep_core::{
    CameraSettings, FramePool, FrameStamp, MechanicalDeg, MirrorLimits, MirrorPath, MirrorPoint, PixelFormat,
    RasterScan, SettingsId, Shutter, Subject, Tilt,
};
use raysweep_sim::dots::{DotsDevices, DotsRig, DotsRigError, DotsSetup, FrameFate};
use raysweep_sim::mirror::{Mechanics, MechanicsConfig};

const EXPOSURE_US: f64 = 70.0;
const WHITE_DN: f64 = 2500.0;
const BLACK_DN: f64 = 64.0;

/// Permissive limits: these paths are chosen for what they test, not to protect a mirror.
fn boundless() -> MirrorLimits {
    MirrorLimits {
        max_tilt: MechanicalDeg(40.0),
        max_step: MechanicalDeg(80.0),
        max_slew_deg_per_s: 1e9,
        bandwidth_hz: 1e5,
        out_of_band: MechanicalDeg(80.0),
    }
}

fn setup(format: PixelFormat) -> DotsSetup {
    DotsSetup {
        format,
        white_dn: WHITE_DN,
        white_exposure_us: EXPOSURE_US,
        black_dn: BLACK_DN,
        incidence: MechanicalDeg(0.0),
        limits: boundless(),
    }
}

fn exact() -> DotsConfig {
    DotsConfig {
        dot: SimDot { ghost: 0.0, ..SimDot::default() },
        mirror: SimMirror { mechanics: false, ..SimMirror::default() },
        sensor: SimDotSensor { noise: false, ..SimDotSensor::default() },
        dump_indices: vec![],
        ..DotsConfig::default()
    }
}

fn rig(config: DotsConfig) -> DotsRig {
    DotsRig::new(config, setup(PixelFormat::Mono12), Path::new("")).unwrap()
}

/// A path that stays for `samples` samples at each position in the field of view.
fn visit(places: &[[f64; 2]], samples: usize, rate_hz: f64, config: &DotsConfig) -> MirrorPath {
    let tilt = |uv: &[f64; 2]| {
        let [x, y] = [0, 1].map(|axis| {
            let half = (config.fov_deg[axis] / 2.0).to_radians().tan();
            (half * (2.0 * uv[axis] - 1.0)).atan().to_degrees() / 2.0
        });
        Tilt::new(x, y)
    };
    let points = places.iter().flat_map(|uv| vec![MirrorPoint { tilt: tilt(uv), light: 255 }; samples]);
    MirrorPath::new(points.collect(), rate_hz, &boundless()).unwrap()
}

/// A received frame: its stamp and its counts.
struct Seen {
    stamp: FrameStamp,
    counts: Vec<u16>,
}

/// Plays a path and collects all frames.
fn record(devices: &mut DotsDevices, path: &MirrorPath, batches: u32) -> Vec<Seen> {
    let DotsDevices { camera, mirror, .. } = devices;
    let capabilities = camera.capabilities().clone();
    let pixels = capabilities.width * capabilities.height;
    let settings =
        CameraSettings { shutter: Shutter::Global, exposure_us: EXPOSURE_US, trigger_delay_us: 0.0 };
    camera.configure(SettingsId { point: 0, attempt: 0 }, &settings).unwrap();
    camera.arm().unwrap();
    mirror.load(path).unwrap();
    mirror.start(batches).unwrap();
    let pool = FramePool::new(1, capabilities.format.frame_bytes(pixels));
    let mut seen = Vec::new();
    while !mirror.feed().unwrap().parked {
        let mut buffer = pool.take();
        while let Some(stamp) = camera.next_frame(&mut buffer, Duration::from_millis(5)).unwrap() {
            let mut counts = vec![0; pixels];
            capabilities.format.unpack_into(&buffer, &mut counts).unwrap();
            seen.push(Seen { stamp, counts });
        }
    }
    camera.disarm().unwrap();
    seen
}

fn dn(light: f32) -> f64 {
    (BLACK_DN + f64::from(light) * WHITE_DN).min(4095.0)
}

#[test]
fn each_frame_of_a_scene_from_a_file_is_the_image_of_its_dot() {
    let folder = tempfile::tempdir().unwrap();
    let (dots, rows, columns) = (12, 10, 32);
    let light = |dot: usize, y: usize, x: usize| ((dot * 7 + y * 3 + x) % 11) as f32 / 11.0;
    // On a grid in row order, and at irregular positions.
    let grid: Vec<[f64; 2]> =
        (0..dots).map(|dot| [0.125 + 0.25 * (dot % 4) as f64, 0.2 + 0.3 * (dot / 4) as f64]).collect();
    let strewn: Vec<[f64; 2]> =
        (0..dots).map(|dot| [(dot * 5 % 12) as f64 / 12.0, (dot * 7 % 12) as f64 / 11.0]).collect();
    for uv in [grid, strewn] {
        let path = folder.path().join("scene.npz");
        let mut npz = NpzWriter::new(std::fs::File::create(&path).unwrap());
        let images = Array3::from_shape_fn((dots, rows, columns), |(dot, y, x)| light(dot, y, x));
        npz.add_array("T", &images).unwrap();
        npz.add_array("uv", &Array2::from_shape_fn((dots, 2), |(dot, axis)| uv[dot][axis])).unwrap();
        npz.finish().unwrap();
        let config = DotsConfig { scene: path, trailing_index: Some(99), ..exact() };
        let mirror_path = visit(&uv, 4, 40_000.0, &config);
        let rig = rig(config);
        assert_eq!((rig.size(), rig.scene_rows()), ((rows + 16, columns), rows));
        let mut devices = rig.open(10_000.0, None);
        let frames = record(&mut devices, &mirror_path, 2);
        assert_eq!(frames.len(), 2 * dots);
        for (number, frame) in frames.iter().enumerate() {
            let truth = devices.truth.frame(frame.stamp.seq).unwrap();
            assert_eq!((truth.batch, truth.index), ((number / dots) as u64, (number % dots) as u64));
            for (pixel, &count) in frame.counts[..rows * columns].iter().enumerate() {
                let expected = dn(light(number % dots, pixel / columns, pixel % columns));
                assert!((f64::from(count) - expected).abs() <= 1.0, "frame {number}, pixel {pixel}");
            }
        }
    }
}

#[test]
fn between_the_dots_of_a_grid_images_are_mixed_and_beside_it_is_none() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("grid.npy");
    let images = Array3::from_shape_fn((4, 8, 32), |(dot, _, _)| [0.0_f32, 0.4, 0.8, 0.2][dot]);
    write_npy(&path, &images).unwrap();
    let config = DotsConfig { scene: path, trailing_index: Some(99), ..exact() };
    let places = [[0.5, 0.25], [0.25, 0.5], [0.5, 0.5], [0.25, 0.25], [3.0, 0.5]];
    let mirror_path = visit(&places, 4, 40_000.0, &config);
    let frames = record(&mut rig(config).open(10_000.0, None), &mirror_path, 1);
    for (frame, expected) in frames.iter().zip([0.2, 0.4, 0.35, 0.0, 0.0]) {
        assert!(
            (f64::from(frame.counts[40]) - dn(expected)).abs() <= 1.0,
            "{}: {expected}",
            frame.counts[40]
        );
    }
}

#[test]
fn a_coloured_scene_is_seen_through_the_mosaic_and_by_a_monochrome_camera_as_its_mean() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("rgb.npz");
    let mut npz = NpzWriter::new(std::fs::File::create(&path).unwrap());
    let colours = [0.9_f32, 0.6, 0.3];
    npz.add_array("T", &Array4::from_shape_fn((1, 8, 32, 3), |(_, _, _, c)| colours[c])).unwrap();
    npz.add_array("uv", &Array2::from_elem((1, 2), 0.5_f64)).unwrap();
    npz.finish().unwrap();
    let config = DotsConfig { scene: path, trailing_index: Some(99), ..exact() };
    let mirror_path = visit(&[[0.5, 0.5]], 4, 40_000.0, &config);
    for (format, expected) in
        [(PixelFormat::Mono12, [[0.6, 0.6], [0.6, 0.6]]), (PixelFormat::BayerRG12, [[0.9, 0.6], [0.6, 0.3]])]
    {
        let rig = DotsRig::new(config.clone(), setup(format), Path::new("")).unwrap();
        let frames = record(&mut rig.open(10_000.0, None), &mirror_path, 1);
        for (y, x) in [(0, 0), (0, 1), (1, 0), (1, 1)] {
            let count = f64::from(frames[0].counts[32 * y + x]);
            assert!((count - dn(expected[y][x])).abs() <= 1.0, "{format:?} {y} {x}: {count}");
        }
    }
}

/// Centroid of a frame's light in the scene, (row, column).
fn centroid(counts: &[u16], rows: usize, columns: usize) -> [f64; 2] {
    let (mut sum, mut y, mut x) = (0.0, 0.0, 0.0);
    for (pixel, &count) in counts[..rows * columns].iter().enumerate() {
        let light = f64::from(count) - BLACK_DN;
        sum += light;
        y += light * ((pixel / columns) as f64 + 0.5);
        x += light * ((pixel % columns) as f64 + 0.5);
    }
    [y / sum, x / sum]
}

#[test]
fn dots_are_where_the_mechanics_take_the_beam() {
    let config = DotsConfig {
        mirror: SimMirror::default(),
        dot: SimDot { uneven: 0.0, ghost: 0.0, ..SimDot::default() },
        plane_depths: vec![1.0],
        trailing_index: Some(9999),
        ..exact()
    };
    let scan = RasterScan { amplitude: Tilt::new(1.4, 0.7), lines: 12, flyback: 0.2 };
    let path = MirrorPath::raster(&scan, 2600, 39_000.0, &MirrorLimits::A7B2_3_3600AL).unwrap();
    let rig = rig(config.clone());
    let (rows, columns) = (rig.scene_rows(), rig.size().1);
    let mut devices = rig.open(13_500.0, None);
    devices.subject.place(Subject::Plane(0)).unwrap();
    let frames = record(&mut devices, &path, 2);
    assert_eq!(frames.len(), 1800, "26/9 samples a frame");

    // The same motion without the rig's code: each sample held, starting at rest on the first point.
    let mut mechanics = Mechanics::new(MechanicsConfig { seed: config.seed, ..Default::default() }, 39_000.0);
    (0..19_500).for_each(|_| _ = mechanics.hold(path.at(0).tilt));
    let places: Vec<[f64; 2]> = (0..5200).map(|sample| mechanics.hold(path.at(sample).tilt).deg()).collect();
    let px_per_tangent = columns as f64 / (2.0 * (config.fov_deg[0] / 2.0).to_radians().tan());
    let mut furthest = 0.0_f64;
    for number in (1..1800).step_by(7) {
        // Mirror position at the middle of the exposure.
        let moment = number as f64 * 26.0 / 9.0 + EXPOSURE_US * 1e-6 * 39_000.0 / 2.0;
        let (before, share) = (moment as usize - 1, moment.fract());
        let place = [0, 1]
            .map(|axis| places[before][axis] + share * (places[before + 1][axis] - places[before][axis]));
        let [column, row] = place.map(|deg| (2.0 * deg).to_radians().tan() * px_per_tangent);
        let found = centroid(&frames[number].counts, rows, columns);
        let expected = [row + rows as f64 / 2.0, column + columns as f64 / 2.0];
        furthest = furthest.max((found[0] - expected[0]).abs()).max((found[1] - expected[1]).abs());
    }
    println!("dots are up to {furthest:.3} px from where the mechanics take them");
    // The camera sees a plane at the scene's distance pixel by pixel; the remaining error is rounding of counts.
    assert!(furthest < 0.15, "{furthest}");
}

#[test]
fn a_mirror_drifts_on_from_pass_to_pass() {
    const DRIFT_DEG_PER_S: f64 = 0.05;
    let config = DotsConfig {
        mirror: SimMirror { drift_deg_per_s: [DRIFT_DEG_PER_S, 0.0], ..SimMirror::default() },
        trailing_index: Some(9999),
        ..exact()
    };
    let rate_hz = 10_000.0;
    let path = visit(&[[0.5, 0.5]], 1000, rate_hz, &config);
    let rig = rig(config.clone());
    let mut devices = rig.open(1000.0, None);
    devices.subject.place(Subject::Plane(0)).unwrap();
    let mut first = || {
        let frames = record(&mut devices, &path, 2);
        centroid(&frames[0].counts, rig.scene_rows(), rig.size().1)
    };
    let places = [first(), first(), first()];
    // Half a second of rest on the first point, and two rounds.
    let deg = DRIFT_DEG_PER_S * (0.5 + 0.2);
    let px_per_tangent = rig.size().1 as f64 / (2.0 * (config.fov_deg[0] / 2.0).to_radians().tan());
    let expected_px = (2.0 * deg).to_radians().tan() * px_per_tangent;
    for pass in 1..3 {
        let [down, right] = [0, 1].map(|axis| places[pass][axis] - places[pass - 1][axis]);
        assert!(
            (right - expected_px).abs() < 0.1 && down.abs() < 0.1,
            "{pass}: {right}, {expected_px}, {down}"
        );
    }
}

#[test]
fn the_same_dot_lies_elsewhere_on_a_plane_at_another_depth() {
    let config = exact();
    let path = visit(&[[0.3, 0.4], [0.7, 0.6], [0.5, 0.5]], 4, 40_000.0, &config);
    let rig = rig(config);
    let mut at = Vec::new();
    for plane in 0..2 {
        let mut devices = rig.open(10_000.0, None);
        devices.subject.place(Subject::Plane(plane)).unwrap();
        let frames = record(&mut devices, &path, 1);
        at.push(centroid(&frames[0].counts, rig.scene_rows(), 256));
        let truth = devices.truth.frame(frames[0].stamp.seq).unwrap();
        assert_eq!(truth.subject, Subject::Plane(plane));
    }
    let moved = (at[0][0] - at[1][0]).hypot(at[0][1] - at[1][1]);
    assert!(moved > 8.0, "{at:?}");
    assert!(rig.open(10_000.0, None).subject.place(Subject::Plane(2)).is_err());
}

#[test]
fn the_trailing_dot_is_lit_once_a_batch_and_the_dump_takes_all_light() {
    let config = DotsConfig { trailing_index: Some(6), dump_indices: vec![2], ..exact() };
    let places: Vec<[f64; 2]> = (0..9).map(|dot| [0.2 + 0.07 * f64::from(dot), 0.5]).collect();
    let path = visit(&places, 3, 30_000.0, &config);
    let rig = rig(config);
    let scene = rig.scene_rows() * 256;
    let (rows, columns) = rig.trailing_region();
    let frames = record(&mut rig.open(10_000.0, None), &path, 3);
    assert_eq!(frames.len(), 27);
    for (number, Seen { counts, .. }) in frames.iter().enumerate() {
        let most = |counts: &[u16]| f64::from(counts.iter().copied().max().unwrap()) - BLACK_DN;
        let (scene, margin) = (most(&counts[..scene]), most(&counts[scene..]));
        let (lit, trailing) = match number % 9 {
            2 => (false, false),
            6 => (false, true),
            _ => (true, false),
        };
        assert_eq!((scene > 500.0, margin > 2000.0), (lit, trailing), "frame {number}: {scene} {margin}");
        assert!(lit || scene < 1.0);
        assert!(trailing || margin < 1.0);
        if trailing {
            let lit = |region: &mut dyn Iterator<Item = usize>| {
                region.map(|pixel| f64::from(counts[pixel]) - BLACK_DN).sum::<f64>()
            };
            let within =
                lit(&mut rows.clone().flat_map(|row| columns.clone().map(move |column| 256 * row + column)));
            assert!(within > 0.999 * lit(&mut (0..counts.len())), "frame {number}: the dot is in its region");
        }
    }
}

#[test]
fn every_fault_is_in_the_frames_and_in_the_truth() {
    let camera = SimDotCamera {
        dropped: 0.05,
        duplicated: 0.05,
        saturated: 0.05,
        late_frames: 5,
        ..SimDotCamera::default()
    };
    let config = DotsConfig { camera, rows: 16, columns: 32, margin_rows: 4, ..exact() };
    let places: Vec<[f64; 2]> = (0..50).map(|dot| [f64::from(dot) / 50.0, 0.5]).collect();
    let path = visit(&places, 3, 30_000.0, &config);
    let mut devices = rig(config).open(10_000.0, None);
    let frames = record(&mut devices, &path, 20);
    assert_eq!(devices.truth.frames(), 995, "five were over before it began");
    let mut came: HashMap<u64, Vec<&Seen>> = HashMap::new();
    frames.iter().for_each(|frame| came.entry(frame.stamp.seq).or_default().push(frame));
    let mut fates: HashMap<String, u64> = HashMap::new();
    for seq in 0..995 {
        let truth = devices.truth.frame(seq).unwrap();
        assert_eq!(truth.batch * 50 + truth.index, seq + 5);
        *fates.entry(format!("{:?}", truth.fate)).or_default() += 1;
        let copies = came.get(&seq).map_or(&[] as &[_], Vec::as_slice);
        let expected = match truth.fate {
            FrameFate::Dropped => 0,
            FrameFate::Duplicated => 2,
            FrameFate::Delivered | FrameFate::Saturated => 1,
        };
        assert_eq!(copies.len(), expected, "frame {seq} was {:?}", truth.fate);
        assert!(copies.windows(2).all(|pair| pair[0].counts == pair[1].counts));
        let full = copies.iter().all(|frame| frame.counts.iter().all(|&count| count >= 4000));
        assert!(copies.is_empty() || full == (truth.fate == FrameFate::Saturated));
    }
    assert!(devices.truth.frame(995).is_none());
    assert!(
        ["Dropped", "Duplicated", "Saturated"].iter().all(|fate| (20..90).contains(&fates[*fate])),
        "{fates:?}"
    );
}

#[test]
fn a_camera_whose_clock_runs_fast_slips_by_a_frame_in_time() {
    let camera = SimDotCamera { clock_error: 0.002, ..SimDotCamera::default() };
    let config = DotsConfig { camera, rows: 8, columns: 32, ..exact() };
    let places: Vec<[f64; 2]> = (0..100).map(|dot| [f64::from(dot) / 100.0, 0.5]).collect();
    let path = visit(&places, 3, 30_000.0, &config);
    let mut devices = rig(config).open(10_000.0, None);
    let frames = record(&mut devices, &path, 20);
    assert_eq!(frames.len(), 2004);
    let index = |seq| devices.truth.frame(seq).unwrap().index;
    assert_eq!((index(10), index(1010), index(1990)), (10, 8, 86));
}

#[test]
fn the_same_seed_gives_the_same_bits_however_many_threads_and_other_noise_in_each_frame() {
    let config = DotsConfig { rows: 24, columns: 64, ..DotsConfig::default() };
    let path = visit(&[[0.4, 0.5], [0.4, 0.5], [0.6, 0.5]], 3, 30_000.0, &config);
    let run = |threads: usize, seed: u64| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let rig = rig(DotsConfig { seed, ..config.clone() });
            let frames = record(&mut rig.open(10_000.0, None), &path, 2);
            frames.into_iter().map(|frame| frame.counts).collect::<Vec<_>>()
        })
    };
    let one = run(1, 7);
    assert_eq!(one, run(3, 7));
    assert_ne!(one, run(1, 8));
    assert_ne!(one[0], one[3], "the same dot in another batch has other noise");
}

#[test]
fn built_in_scenes_move_and_have_light_of_both_kinds() {
    for name in raysweep_sim::dots::BUILTIN_NAMES {
        let config = DotsConfig {
            scene: name.into(),
            rows: 72,
            columns: 128,
            motion_period_s: 0.1,
            trailing_index: Some(99),
            ..exact()
        };
        let path = visit(&[[0.5, 0.55], [0.42, 0.5], [0.56, 0.5]], 300, 12_000.0, &config);
        let mut devices = rig(config).open(40.0, None);
        let frames = record(&mut devices, &path, 2);
        assert_eq!(frames.len(), 6, "{name}");
        let sums: Vec<[f64; 2]> = (0..6)
            .map(|seq| {
                let (direct, global) = devices.truth.light(seq, EXPOSURE_US).unwrap();
                assert!(direct.iter().chain(&global).all(|&light| light >= 0.0 && light.is_finite()));
                [direct, global].map(|light| light.iter().map(|&light| f64::from(light)).sum())
            })
            .collect();
        println!("{name}: direct and global light {sums:.1?}");
        assert!(
            sums.iter().all(|sum| sum[0] > 0.0) && sums.iter().any(|sum| sum[1] > 0.02 * sum[0]),
            "{name}: {sums:?}"
        );
        assert_ne!(frames[1].counts, frames[4].counts, "{name} moves");
        // The camera's counts match the light given by the ground truth.
        let (direct, global) = devices.truth.light(0, EXPOSURE_US).unwrap();
        for (pixel, &count) in frames[0].counts[..72 * 128].iter().enumerate() {
            assert!((f64::from(count) - dn(direct[pixel] + global[pixel])).abs() <= 1.0, "{name}: {pixel}");
        }
    }
}

#[test]
fn by_the_hosts_clock_frames_come_at_their_time_and_late_hosts_lose_some() {
    let config = DotsConfig { realtime: true, rows: 8, columns: 32, margin_rows: 4, ..exact() };
    let places: Vec<[f64; 2]> = (0..20).map(|dot| [f64::from(dot) / 20.0, 0.5]).collect();
    let path = visit(&places, 10, 10_000.0, &config);
    let DotsDevices { mut camera, mut mirror, clock, truth, .. } = rig(config).open(1000.0, None);
    camera.arm().unwrap();
    mirror.load(&path).unwrap();
    // 40 s, more than any host stands still.
    mirror.start(2000).unwrap();
    let mut buffer = FramePool::new(1, 2 * 12 * 32).take();
    let mut next = || {
        let stamp = camera.next_frame(&mut buffer, Duration::from_secs(1)).unwrap().unwrap();
        assert!(stamp.host_ns <= clock.now_ns(), "before its time");
        stamp
    };
    let before = next();
    std::thread::sleep(Duration::from_millis(150));
    let after = next();
    assert!(after.seq > before.seq + 50, "the camera holds 64 frames; {} came late", after.seq - before.seq);
    let since_ns = after.exposure_start_ns - before.exposure_start_ns;
    assert_eq!(since_ns, (after.seq - before.seq) as i64 * 1_000_000, "ids count what was lost");
    mirror.park().unwrap();
    // Frames triggered earlier still arrive; then there are no more.
    while let Some(stamp) = camera.next_frame(&mut buffer, Duration::from_millis(20)).unwrap() {
        assert!(truth.frame(stamp.seq).is_some());
    }
    assert!(truth.frames() < 40_000);
    assert!(mirror.feed().is_err());
}

#[test]
fn what_cannot_be_is_refused_by_its_key() {
    let refused =
        |config: DotsConfig| DotsRig::new(config, setup(PixelFormat::Mono12), Path::new("")).err().unwrap();
    let error = refused(DotsConfig { plane_depths: vec![9.0], ..exact() });
    assert_eq!((error.key(), error.to_string().contains("0.5 to 2")), ("plane_depths", true));
    let error = refused(DotsConfig { scene: "teapot".into(), ..exact() });
    assert!(matches!(error, DotsRigError::Scene(_)) && error.to_string().contains("v-groove"), "{error}");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.npy");
    write_npy(&path, &Array3::<f32>::zeros((5, 8, 8))).unwrap();
    let error = refused(DotsConfig { scene: path.clone(), ..exact() });
    assert!(error.to_string().contains("5 dots"), "{error}");
    write_npy(&path, &Array3::from_elem((4, 8, 8), -1.0_f32)).unwrap();
    let error = refused(DotsConfig { scene: path.clone(), ..exact() });
    assert!(error.to_string().contains("T[0] holds -1"), "{error}");
    std::fs::write(&path, b"\x93NUMPY").unwrap();
    assert!(refused(DotsConfig { scene: path, ..exact() }).to_string().contains("copy the file again"));
}
