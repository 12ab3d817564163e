//! `kind = "calibration"` on the simulated rig: from a cap and a white board to the model of a rig that nobody knows, and
//! to the transport of a scene on it.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::fs;
use std::path::Path;

use ndarray::{Array2, Array3, Axis, s};
use raysweep::control::Control;
use raysweep::rig::Rig;
use raysweep_config::plan::CalibrationPlan;
use raysweep_config::{Plan, Procedure};
use raysweep_pipeline::mask;
use raysweep_processing::calibration::{
    CalibratedLight, CalibrationTask, KeptCalibration, ResponseOf, current_in,
};
use raysweep_processing::plane::KnownRig;
use raysweep_proto::{Event, RunParams};
use raysweep_session::Session;
use raysweep_session::film::TransportFilm;
use raysweep_session::stack::{ArrayName, Contents};
use raysweep_sim::PlaneRig;
use raysweep_tests::{Bench, Ended, end_of, half_corner_rig, next_event, rig_text};
use raysweep_transport::plane::relative_rows;
use raysweep_transport::quality::median_profile_error;

const PLAN: &str = "kind = \"calibration\"\n";
/// Of products, one that costs nothing.
const SWEEP: &str = "product = [{ kind = \"regular\" }]\nkind = \"sweep\"\n[sweep]\ndelay_us = { start = -1500, stop = 1500, count = 15 }\n\
                     exposure_us = { start = 600, stop = 1200, count = 5 }\naverage = 8\n";
/// A rig that its file does not describe.
const UNKNOWN: &str = "[sim.projector]\nbeam = { kind = \"flat-top\", up_rows = 0.5, down_rows = 1.2 }\n\
                       phase_jitter_us = 5.0\nrow_table = { kind = \"quadratic\", percent = 1.0 }\n\
                       [sim.sensor]\nvignetting_percent = 20.0\n\
                       [sim.truth]\ncamera_row_time_us = 22.6\nrow_offset_rows = 0.4\nrotation_deg = 0.2\n\
                       trigger_latency_us = 30.0\n";

/// A small window of a rig, for tests that need no good calibration.
fn small(more: &str) -> String {
    rig_text(720, "scene_rows = 96\nscene_columns = 48", more)
}

fn quick() -> String {
    format!("{PLAN}[calibration]\nframes = 8\npicture_frames = 2\ndelays = 40\n")
}

/// Times by the trigger edge at which the simulator lights the rows, for an exposure as the camera states it.
fn true_starts_us(sim: &PlaneRig) -> Vec<f64> {
    // The stamps of frames hold the stated latency.
    let late_us = sim.truth().trigger_latency_us - 8.0;
    sim.row_starts_us().unwrap().iter().map(|start_us| start_us - late_us).collect()
}

/// Rows far from all others of the plan are seen by few settings.
const SEEN: std::ops::RangeInclusive<i32> = -94..=94;

/// A sweep's transport in the rows of [`SEEN`], and the scene's.
fn transports(ended: &Ended, sim: &PlaneRig) -> [Array3<f32>; 2] {
    let (session, _) = ended.open();
    let file = session.products().dir().join("transport.npy");
    let found: Array3<f32> = ndarray_npy::read_npy(file).unwrap();
    let text = fs::read_to_string(session.products().dir().join("transport.json")).unwrap();
    let metadata: serde_json::Value = serde_json::from_str(&text).unwrap();
    let u_min = metadata["u_min"].as_i64().unwrap();
    let found = found.slice(s![(-94 - u_min) as usize..=(94 - u_min) as usize, .., ..]).to_owned();
    let scene = sim.scene().transport.index_axis(Axis(3), 0).to_owned();
    [found, relative_rows(scene.view(), &SEEN)]
}

/// Median relative error of a sweep's transport.
fn error(ended: &Ended, sim: &PlaneRig) -> f64 {
    let [found, scene] = transports(ended, sim);
    median_profile_error(found.view(), scene.view())
}

fn kept(folder: &Path) -> KeptCalibration {
    KeptCalibration::read(folder).unwrap().expect("a calibration")
}

fn message(ended: &Ended) -> &str {
    ended.error.as_deref().unwrap_or_default()
}

#[test]
fn a_rig_that_nobody_knows_is_calibrated_and_swept() {
    let bench = Bench::new(&half_corner_rig(720, UNKNOWN));
    let rig = Rig::load(&bench.folder.path().join("rig.toml")).unwrap();
    let sim = rig.simulated().unwrap();
    let uncalibrated = error(&bench.run(SWEEP), sim);
    let calibrated = bench.run(PLAN);
    assert_eq!(calibrated.state, "complete", "{:?}", calibrated.error);
    let swept = bench.run(SWEEP);
    let error = error(&swept, sim);
    println!("error of T: {uncalibrated:.4} uncalibrated, {error:.4} calibrated");
    assert!(error < 0.03 && uncalibrated > 0.2);

    let found = kept(&calibrated.session);
    assert_eq!(found, kept(&current_in(&bench.folder.path().join("sessions"))));
    assert_eq!(found, kept(&swept.session));
    let (seen, truth) = (found.header.timing.seen_rows, true_starts_us(sim));
    let differences: Vec<f64> =
        (seen[0]..seen[1]).map(|row| found.arrays.row_starts_us[row] - truth[row]).collect();
    let mean_us = differences.iter().sum::<f64>() / differences.len() as f64;
    let from_mean = || differences.iter().map(|difference| difference - mean_us);
    let rms_us = (from_mean().map(|us| us * us).sum::<f64>() / differences.len() as f64).sqrt();
    let most_us = from_mean().fold(0.0, |most: f64, us| most.max(us.abs()));
    println!("rows: {mean_us:.3} us off, {rms_us:.3} us rms, {most_us:.3} us at most");
    assert!(rms_us < 0.02 * 22.22 && most_us < 0.05 * 22.22);
    // The mean of the jitter of some hundred frames.
    assert!(mean_us.abs() < 1.5 && mean_us.abs() < 4.0 * found.header.timing.latency_sd_us);
    let [camera_row_time_us, _] = found.header.timing.camera_row_time_us;
    assert!((camera_row_time_us / 22.6 - 1.0).abs() < 2e-4, "{camera_row_time_us}");
    // Response and place may be shifted against each other: the place of the whole image is the beam's centroid.
    let places = found.arrays.place.indexed_iter();
    let differences: Vec<f64> =
        places.map(|((t, s), &place)| f64::from(place) - sim.truth().place(t, s)).collect();
    let mean_rows = differences.iter().sum::<f64>() / differences.len() as f64;
    let squares: f64 = differences.iter().map(|rows| (rows - mean_rows).powi(2)).sum();
    let rms_rows = (squares / differences.len() as f64).sqrt();
    println!("places: {mean_rows:.3} rows off, {rms_rows:.3} rows rms");
    assert!(mean_rows.abs() < 0.5 && rms_rows < 0.05);
    let [gain, gain_sd] = found.header.light.electrons_per_dn;
    assert!((gain / 1.66 - 1.0).abs() < 0.03 && gain_sd < 0.05, "{gain} +- {gain_sd}");

    // A session is processed with its own calibration, whatever is in use by then.
    let transport = fs::read(swept.session.join("products/transport.npy")).unwrap();
    fs::remove_dir_all(current_in(&bench.folder.path().join("sessions"))).unwrap();
    raysweep_processing::process(&swept.session).unwrap();
    assert!(fs::read(swept.session.join("products/transport.npy")).unwrap() == transport);
    let before = fs::read(calibrated.session.join("calibration.npz")).unwrap();
    raysweep_processing::process(&calibrated.session).unwrap();
    assert!(fs::read(calibrated.session.join("calibration.npz")).unwrap() == before);
    let page = fs::read_to_string(calibrated.session.join("report.html")).unwrap();
    for section in ["When rows are lit", "Where pixels look", "Photon transfer", "Checks"] {
        assert!(page.contains(section), "{section}");
    }
}

#[test]
fn a_strip_of_the_board_cancels_jitter_that_no_device_measures() {
    let film = "kind = \"film\"\n[film]\ncycles = 6\nexposure_us = 600\ndelay_us = [-1500, -1000, -640, -420, \
                -333, -311, -289, 0, 289, 311, 333, 420, 640, 1000, 1500]\n";
    let columns = "strip_columns = [0, 8]\n";
    let rig = |of_rig: &str, of_sim: &str| {
        half_corner_rig(
            720,
            &UNKNOWN.replace("[sim.truth]", &format!("{of_rig}[sim.board]\n{of_sim}[sim.truth]")),
        )
    };
    let in_rig = format!("[calibration]\n{columns}");
    let error = |rig: &str| {
        let bench = Bench::new(rig);
        assert_eq!(bench.run(PLAN).state, "complete");
        let ended = bench.run(film);
        assert_eq!(ended.state, "complete", "{:?}", ended.error);
        let rig = Rig::load(&bench.folder.path().join("rig.toml")).unwrap();
        let transports = TransportFilm::open(&ended.session.join("transport_film.zarr")).unwrap();
        let u_min = transports.attributes()["u_min"].as_i64().unwrap() as i32;
        let found = transports.read(5).unwrap().unwrap().t;
        let scene = rig.simulated().unwrap().scene().transport.index_axis(Axis(3), 0).to_owned();
        let found = found.slice(s![(-80 - u_min) as usize..=(80 - u_min) as usize, .., ..]);
        median_profile_error(found, relative_rows(scene.view(), &(-80..=80)).view())
    };
    // Columns of the scene, which the rig file takes for the board, are not used.
    let [with, without, wrong] =
        [rig(&in_rig, columns), rig("", columns), rig(&in_rig, "")].map(|rig| error(&rig));
    println!("{with:.4} with a strip, {without:.4} without, {wrong:.4} with a scene in its place");
    assert!(with < 0.045 && without > 0.08 && wrong < 1.3 * without);
}

#[test]
fn an_interrupted_calibration_is_resumed_to_the_same_bits() {
    let bench = Bench::new(&small(""));
    let whole = bench.run(&quick());
    assert_eq!(whole.state, "complete", "{:?}", whole.error);
    let ledger = whole.session.join("ledger.jsonl");
    let arrays = fs::read(whole.session.join("calibration.npz")).unwrap();
    let header = kept(&whole.session).header;
    let lines: Vec<String> = fs::read_to_string(&ledger).unwrap().lines().map(Into::into).collect();
    // In the dark images, in the black pictures of both exposures, in the other pictures, between the two steps whose
    // settings depend on them.
    let black = lines.iter().position(|line| line.contains("\"sum\"")).unwrap();
    for end in [20, black + 9, black + 20, lines.len() / 3, lines.len() - 150, lines.len() - 60] {
        fs::write(&ledger, lines[..end].join("\n") + "\n").unwrap();
        fs::remove_file(whole.session.join("calibration.npz")).unwrap();
        let resumed = bench.resume(&whole.session);
        assert_eq!(resumed.state, "complete", "after line {end}: {:?}", resumed.error);
        assert!(fs::read(whole.session.join("calibration.npz")).unwrap() == arrays, "after line {end}");
        // Where no run has taken eight black pictures of both exposures, the report says so.
        let page = fs::read_to_string(whole.session.join("report.html")).unwrap();
        let is_unseen = [black + 9, black + 20].contains(&end);
        assert_eq!(page.contains("flickers was not looked for"), is_unseen, "after line {end}");
        let again = kept(&whole.session).header;
        assert_eq!((again.light, again.timing), (header.light.clone(), header.timing.clone()));
    }
}

#[test]
fn a_calibration_that_was_interrupted_at_its_second_board_is_resumed_to_the_same_bits() {
    let bench = Bench::new(&small("[sim.board]\nsecond_scatter_rows = 0.7\nsecond_scatter_share = 1.0\n"));
    let whole = bench.run(&format!("{}boards = 2\n", quick()));
    assert_eq!(whole.state, "complete", "{:?}", whole.error);
    // The first board scatters nothing, so that it is taken.
    let alone = kept(&bench.run(&quick()).session);
    let [with_two, with_one] = [kept(&whole.session), alone].map(|kept| (kept.header.light, kept.arrays));
    let of = |light: &CalibratedLight| light.response_of.unwrap();
    assert_eq!([of(&with_two.0), of(&with_one.0)], [ResponseOf::Beam, ResponseOf::BeamAndBoard]);
    let widths = [&with_two.1, &with_one.1].map(|arrays| arrays.response.mapv(|share| share * share).sum());
    assert!((widths[0] / widths[1] - 1.0).abs() < 0.01, "{widths:?}");
    let page = fs::read_to_string(whole.session.join("report.html")).unwrap();
    assert!(page.contains("the second board scatters light"), "the report names the board");

    let ledger = whole.session.join("ledger.jsonl");
    let arrays = fs::read(whole.session.join("calibration.npz")).unwrap();
    let lines: Vec<String> = fs::read_to_string(&ledger).unwrap().lines().map(Into::into).collect();
    fs::write(&ledger, lines[..lines.len() - 12].join("\n") + "\n").unwrap();
    fs::remove_file(whole.session.join("calibration.npz")).unwrap();
    let resumed = bench.resume(&whole.session);
    assert_eq!(resumed.state, "complete", "{:?}", resumed.error);
    assert!(fs::read(whole.session.join("calibration.npz")).unwrap() == arrays);
}

#[test]
fn two_boards_that_respond_alike_prove_less_than_two_that_differ() {
    let bench = Bench::new(&small(""));
    let [alone, alike] = ["", "boards = 2\n"].map(|boards| {
        let ended = bench.run(&format!("{}{boards}", quick()));
        assert_eq!(ended.state, "complete", "{:?}", ended.error);
        kept(&ended.session).header.light
    });
    assert_eq!(alike.response_of, Some(ResponseOf::BoardsAlike));
    assert!(alike.response_width_sd >= alone.response_width_sd.map(|sd| 0.99 * sd));
}

#[test]
fn what_a_lamp_leaves_is_not_taken_for_a_board() {
    let bench = Bench::new(&small("[sim.ambient]\nlevel = 0.0002\nflicker = 0.3\n"));
    let ended = bench.run(&format!("{}boards = 2\n", quick()));
    assert_eq!(ended.state, "faulted");
    assert!(message(&ended).contains("the room's light flickers"), "{}", message(&ended));
    assert!(message(&ended).contains("calibration.boards = 1"), "{}", message(&ended));
    let (_, state) = ended.open();
    assert!(state.missing_points() > 62, "the second board was not asked for");
}

#[test]
fn sessions_of_earlier_versions_have_fewer_images_and_are_known_by_them() {
    let bench = Bench::new(&small(""));
    let rig = Rig::load(&bench.folder.path().join("rig.toml")).unwrap();
    let known = KnownRig { file: &rig.file, first_row: 0, size: (96, 48), calibration: None };
    let plan = Plan::parse(PLAN).unwrap();
    let own = CalibrationPlan::default();
    let stored = |contents| CalibrationTask::stored(&plan, own.clone(), &known, contents);
    let now = CalibrationTask::new(&plan, own.clone(), &known).contents();
    let Contents::Board { images, capped } = now else { panic!("{now:?}") };
    let saturated = 4;
    let columns = saturated + 2 * 7;
    let passes = columns + 3 * 8;
    let black = passes + 2 * own.frames as usize;
    for fewer in [0, saturated, columns, passes, black] {
        let contents = Contents::Board { images: images - fewer, capped };
        assert_eq!(stored(contents).contents(), contents);
    }
    // Others are of no version.
    assert_eq!(stored(Contents::Board { images: images - 1, capped }).contents(), now);
}

#[test]
fn a_cancelled_calibration_leaves_the_one_in_use() {
    let bench = Bench::new(&small(""));
    let first = bench.run(&quick());
    let mut events = bench.runner.events();
    let params = RunParams { plan: PLAN.into(), ..Default::default() };
    Control::run(&*bench.runner, params).unwrap();
    let _ = Control::cancel(&*bench.runner);
    let cancelled = end_of(&mut events);
    assert_eq!(cancelled.state, "cancelled");
    assert!(!cancelled.open().1.end.unwrap().is_final);
    assert!(!cancelled.session.join("calibration.toml").exists());
    let current = current_in(&bench.folder.path().join("sessions"));
    assert_eq!(kept(&current), kept(&first.session));
    // It stays in use, and is said to, where the session that measured it is gone.
    let in_use = || {
        let found = Control::calibrations(&*bench.runner).unwrap().into_iter().filter(|info| info.in_use);
        found.map(|info| info.session).collect::<Vec<_>>()
    };
    assert_eq!(in_use(), std::slice::from_ref(&first.session));
    std::fs::remove_dir_all(&first.session).unwrap();
    assert_eq!(in_use(), [current]);
}

#[test]
fn a_board_or_light_of_no_use_is_refused_with_the_reason() {
    for (more, expected) in [
        ("[sim.truth]\nwhite_dn = 300\n", "open the aperture"),
        ("[sim.truth]\nwhite_dn = 6000\n", "close the aperture"),
        ("[sim.truth]\nwhite_dn = 0.2\n", "sees no light of the board"),
    ] {
        let bench = Bench::new(&small(more));
        let ended = bench.run(&quick());
        assert_eq!(ended.state, "faulted", "{more}");
        let message = message(&ended);
        assert!(message.contains("not calibrated") && message.contains(expected), "{message}");
        assert!(!current_in(&bench.folder.path().join("sessions")).exists());
        // What was taken is kept, and would be refused again.
        let (_, state) = ended.open();
        assert!(state.stored(ArrayName::Sum).count() > 0 && state.missing_points() > 0);
        assert!(state.end.unwrap().is_final, "{more}");
    }
}

#[test]
fn a_camera_that_is_not_linear_is_straightened_or_refused() {
    // The simulator shortens counts by a parabola; the calibration lengthens them by one: they differ at second order.
    let camera = |percent: f64| {
        UNKNOWN.replace("[sim.sensor]\n", &format!("[sim.sensor]\ncompression_percent = {percent}\n"))
    };
    let bench = Bench::new(&half_corner_rig(720, &camera(2.0)));
    let rig = Rig::load(&bench.folder.path().join("rig.toml")).unwrap();
    let calibrated = bench.run(&quick());
    assert_eq!(calibrated.state, "complete", "{:?}", calibrated.error);
    let found = kept(&calibrated.session);
    let [per_dn, sd] = found.header.light.linearity_per_dn.unwrap();
    let expected = 0.02 / (4095.0 - 64.0);
    println!("curve: {per_dn:.3e} +- {sd:.1e}, {expected:.3e} was simulated");
    assert!((per_dn / expected - 1.0).abs() < 0.1 && sd < 0.02 * expected);
    assert_eq!(found.header.checks["bend"][1], 0.03);

    // Dim pixels are compared with white, whose counts fall short by more.
    let sim = rig.simulated().unwrap();
    let brightness = |ended: &Ended| {
        let [found, truth] = transports(ended, sim).map(|transport| transport.sum_axis(Axis(0)));
        let dim = found.iter().zip(&truth).filter(|(_, truth)| (0.1..0.3).contains(*truth));
        let mut ratios: Vec<f32> = dim.map(|(found, truth)| found / truth).collect();
        ratios.sort_by(f32::total_cmp);
        ratios[ratios.len() / 2]
    };
    let straightened = bench.run(SWEEP);
    // The same rig, whose curve is not measured.
    let ended = bench.run(&format!("{}passes = 0\n", quick()));
    assert_eq!(kept(&ended.session).header.light.linearity_per_dn, None);
    let bent = bench.run(SWEEP);
    let (straight_error, straightened, bent) =
        (error(&straightened, sim), brightness(&straightened), brightness(&bent));
    println!(
        "error of T: {straight_error:.4}; light of dim pixels: {straightened:.4} straightened, {bent:.4} as counted"
    );
    assert!(straight_error < 0.025);
    assert!((straightened - 1.0).abs() < 0.004 && bent - straightened > 0.006);

    let bench = Bench::new(&small("[sim.sensor]\ncompression_percent = 5.0\n"));
    let ended = bench.run(&quick());
    assert_eq!(ended.state, "faulted");
    assert!(message(&ended).contains("gamma"), "{}", message(&ended));
}

#[test]
fn a_calibration_of_other_devices_or_a_damaged_one_is_refused_unless_overridden() {
    let mut bench = Bench::new(&small(""));
    let first = bench.run(&quick());
    assert_eq!(first.state, "complete", "{:?}", first.error);
    let current = current_in(&bench.folder.path().join("sessions"));
    let npz = fs::read(current.join("calibration.npz")).unwrap();
    let refusal = |bench: &Bench| Control::check(&*bench.runner, SWEEP).unwrap_err().message;
    let mut damaged = npz.clone();
    damaged[npz.len() / 2] ^= 1;
    fs::write(current.join("calibration.npz"), damaged).unwrap();
    let message = refusal(&bench);
    assert!(message.contains("SHA-256") && message.contains("raysweep calibrate"), "{message}");
    for (text, named) in
        [("schema = 9\n", "missing"), ("schema = \"\u{0}\"", "calibration.toml"), ("", "missing")]
    {
        fs::write(current.join("calibration.toml"), text).unwrap();
        let message = refusal(&bench);
        assert!(message.contains("calibration.toml") && message.contains(named), "{message}");
    }
    let text = fs::read_to_string(first.session.join("calibration.toml")).unwrap();
    let seen = text.lines().find(|line| line.starts_with("seen_rows")).unwrap();
    for (rows, size) in [("[296, 99999]", "[96, 48]"), ("[5, 5]", "[96, 48]"), ("[296, 392]", "[9, 48]")] {
        let text = text
            .replace(seen, &format!("seen_rows = {rows}"))
            .replace("size = [96, 48]", &format!("size = {size}"));
        fs::write(current.join("calibration.toml"), text).unwrap();
        fs::write(current.join("calibration.npz"), &npz).unwrap();
        let message = refusal(&bench);
        assert!(message.contains("seen_rows") || message.contains("has shape"), "{message}");
    }
    let curve = text.lines().find(|line| line.starts_with("linearity_per_dn")).unwrap();
    for wrong in ["[nan, 0.0]", "[inf, 0.0]", "[0.01, 0.0]", "[0.0, -1.0]"] {
        let text = text.replace(curve, &format!("linearity_per_dn = {wrong}"));
        fs::write(current.join("calibration.toml"), text).unwrap();
        let message = refusal(&bench);
        assert!(message.contains("calibration.toml: light.linearity_per_dn"), "{message}");
    }
    for (key, wrong) in [
        ("row_time_us", "[nan, 0.0]"),
        ("camera_row_time_us", "[-22.0, 0.0]"),
        ("jitter_us", "[inf, 0.0]"),
        ("response_width_sd", "-1.0"),
    ] {
        let line = text.lines().find(|line| line.starts_with(&format!("{key} = "))).unwrap();
        let text = text.replace(&format!("\n{line}\n"), &format!("\n{key} = {wrong}\n"));
        fs::write(current.join("calibration.toml"), text).unwrap();
        let message = refusal(&bench);
        assert!(message.contains(&format!(".{key} = ")), "{message}");
    }
    fs::copy(first.session.join("calibration.toml"), current.join("calibration.toml")).unwrap();
    fs::remove_file(current.join("calibration.npz")).unwrap();
    std::os::unix::fs::symlink(first.session.join("calibration.npz"), current.join("calibration.npz"))
        .unwrap();
    let message = refusal(&bench);
    assert!(message.contains("link"), "{message}");
    fs::remove_file(current.join("calibration.npz")).unwrap();
    fs::write(current.join("calibration.npz"), npz).unwrap();
    Control::check(&*bench.runner, SWEEP).unwrap();

    let rig = bench.folder.path().join("rig.toml");
    fs::write(&rig, rig_text(720, "scene_rows = 96\nscene_columns = 40", "")).unwrap();
    bench.restart_with(raysweep::Probes::default());
    let message = refusal(&bench);
    assert!(message.contains("48 x 96") && message.contains("40 x 96"), "{message}");
    let overridden = rig_text(720, "scene_rows = 96\nscene_columns = 40", "[calibration]\noverride = true\n");
    fs::write(&rig, overridden).unwrap();
    bench.restart_with(raysweep::Probes::default());
    let report = Control::check(&*bench.runner, SWEEP).unwrap();
    assert!(!report.warnings.iter().any(|warning| warning.contains("calibration")), "{:?}", report.warnings);

    fs::write(&rig, small("# changed\n")).unwrap();
    bench.restart_with(raysweep::Probes::default());
    let warnings = Control::check(&*bench.runner, SWEEP).unwrap().warnings;
    assert!(warnings.iter().any(|warning| warning.contains("the rig file was changed")), "{warnings:?}");
}

#[test]
fn calibrations_are_listed_and_chosen() {
    let bench = Bench::new(&small(""));
    let control: &dyn Control = &*bench.runner;
    assert_eq!(control.calibrations().unwrap(), []);
    let (first, second) = (bench.run(&quick()), bench.run(&quick()));
    let in_use = || -> Vec<bool> { control.calibrations().unwrap().iter().map(|info| info.in_use).collect() };
    assert_eq!(in_use(), [false, true]);
    control.use_calibration(&first.session).unwrap();
    assert_eq!(in_use(), [true, false]);
    control.use_calibration(Path::new(second.session.file_name().unwrap())).unwrap();
    assert_eq!(in_use(), [false, true]);
    let sweep =
        bench.run("kind = \"sweep\"\n[sweep]\ndelay_us = [0, 20]\nexposure_us = [600]\naverage = 1\n");
    let refused = control.use_calibration(Path::new("none")).unwrap_err();
    assert!(refused.message.contains("`raysweep sessions` lists the names"), "{}", refused.message);
    assert!(sweep.session.join("calibration.toml").exists());
}

#[test]
fn a_plan_without_settings_gets_those_that_suit_the_calibration() {
    let settings = |jitter_us: f64, plan: &str| {
        let bench = Bench::new(&small(&format!("[sim.projector]\nphase_jitter_us = {jitter_us}\n")));
        let uncalibrated = bench.runner.check(plan).unwrap();
        assert_eq!(uncalibrated.settings, None);
        assert_eq!(bench.run(&quick()).state, "complete");
        let report = bench.runner.check(plan).unwrap();
        let advice = report.advice.unwrap();
        assert!(report.settings.is_none() || advice.better.is_none(), "what was just chosen");
        let ended = bench.run(plan);
        assert_eq!(ended.state, "complete", "{:?}", ended.error);
        let stated = fs::read_to_string(ended.session.join("plan.toml")).unwrap();
        (report.settings, stated, (bench, ended))
    };
    let sweep = "kind = \"sweep\" # mine\n[sweep]\naverage = 1\n";
    let (chosen, stated, (bench, ended)) = settings(0.0, sweep);
    assert!(stated.contains("# mine") && stated.contains("[[sweep.extra]]"), "{stated}");
    assert!(stated.ends_with(&chosen.unwrap()));
    // A later version may choose others: the session has its own.
    let transport = fs::read(ended.session.join("products/transport.npy")).unwrap();
    raysweep_processing::process(&ended.session).unwrap();
    assert!(fs::read(ended.session.join("products/transport.npy")).unwrap() == transport);
    drop(bench);
    let (chosen, stated, _) = settings(5.0, sweep);
    assert_eq!((chosen, stated.as_str()), (None, sweep));
    let film = "kind = \"film\"\n[film]\ncycles = 1\n";
    let delays = |jitter_us| {
        let (chosen, stated, _) = settings(jitter_us, film);
        let film = |text: &str| {
            let Procedure::Film(film) = Plan::parse(text).unwrap().procedure else { panic!("{text}") };
            film
        };
        assert_eq!(film(&stated), film(&format!("kind = \"film\"\n{}", chosen.unwrap())));
        film(&stated).delay_us.values()
    };
    let near_rows = |delays: Vec<f64>| {
        let edges = delays.into_iter().map(|delay_us| (delay_us.abs() - 300.0).abs() / 22.22);
        edges.fold(f64::INFINITY, f64::min)
    };
    assert!(near_rows(delays(0.0)) < 0.51 && near_rows(delays(5.0)) > 3.0);
}

#[test]
fn settings_that_the_rig_cannot_take_are_replaced_and_the_run_says_so() {
    let bench = Bench::new(&small(""));
    assert_eq!(bench.run(&quick()).state, "complete");
    let header = current_in(&bench.folder.path().join("sessions")).join("calibration.toml");
    let text = fs::read_to_string(&header).unwrap();
    let row_time = text.lines().find(|line| line.starts_with("row_time_us")).unwrap();
    fs::write(&header, text.replace(row_time, "row_time_us = [5000.0, 0.001]")).unwrap();
    let plan = "kind = \"sweep\"\n[sweep]\naverage = 1\n";
    let report = bench.runner.check(plan).unwrap();
    assert_eq!((report.settings, report.points), (None, 75));
    let why = report.settings_refused.unwrap();
    assert!(why.contains("the settings that suit the calibration in use cannot be taken"), "{why}");
    let mut events = bench.runner.events();
    bench.runner.run(RunParams { plan: plan.into(), ..RunParams::default() }).unwrap();
    let (session, state, warnings) = loop {
        if let Event::Finished { session, state, warnings, .. } = next_event(&mut events) {
            break (session, state, warnings);
        }
    };
    assert_eq!((state.as_str(), &warnings[0]), ("complete", &why));
    assert_eq!(Session::open(&session).unwrap().state().unwrap().end.unwrap().warnings, warnings);
    // Known before the run, and so in no section of the report's own.
    let page = fs::read_to_string(session.join("report.html")).unwrap();
    assert!(page.contains("Warnings of the run") && page.contains("cannot be taken"));
}

/// A sensor whose wells are full at three quarters of the converter's range: samples beyond that are bounds, not light.
#[test]
fn wells_that_are_full_before_the_converter_are_found_and_what_fills_them_is_marked() {
    const FULL_DN: f64 = 3000.0;
    let sensor = format!("[sim.sensor]\nfull_well_e = {}\n", FULL_DN * 1.66);
    let bench = Bench::new(&half_corner_rig(720, &sensor));
    let rig = Rig::load(&bench.folder.path().join("rig.toml")).unwrap();
    let calibrated = bench.run(PLAN);
    assert_eq!(calibrated.state, "complete", "{:?}", calibrated.error);
    let light = kept(&calibrated.session).header.light;
    let saturation_dn = light.saturation_dn.unwrap();
    println!("pixels saturate from {saturation_dn} DN");
    // Black is 64, and the limit a few standard deviations of the read noise below the well.
    assert!((FULL_DN..FULL_DN + 64.0).contains(&saturation_dn), "{saturation_dn}");
    let swept = bench.run(&SWEEP.replace("regular", "epipolar"));
    assert_eq!(swept.state, "complete", "{:?}", swept.error);
    let [found, truth] = transports(&swept, rig.simulated().unwrap());
    let mask: Array2<u8> = ndarray_npy::read_npy(swept.session.join("products/epipolar_mask.npy")).unwrap();
    let is_bound = mask.mapv(|bits| bits & mask::BOUND_ONLY != 0);
    let bounds = is_bound.iter().filter(|bound| **bound).count();
    let direct = -*SEEN.start() as usize;
    let (mut off, mut unmarked) = (0, 0);
    for ((t, s), is_bound) in is_bound.indexed_iter() {
        let [found, truth] = [found[[direct, t, s]], truth[[direct, t, s]]];
        if f64::from(truth) * light.white_dn[0] > FULL_DN && (found / truth - 1.0).abs() > 0.05 {
            off += 1;
            unmarked += usize::from(!is_bound);
        }
    }
    println!("{bounds} pixels are bounds, {off} full ones are off by 5 %, {unmarked} of them not marked");
    assert!(bounds > 0 && unmarked == 0);
}
