//! Mirror response from its identification to the paths of later runs, compared with the simulated mirror.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::path::PathBuf;
use std::sync::Arc;

use ndarray::Array2;
use raysweep::Runner;
use raysweep::control::Control;
use raysweep::rig::DotRig;
use raysweep_processing::{ProcessError, process};
use raysweep_proto::{ErrorCode, RunParams};
use raysweep_session::manifest;
use raysweep_tests::dots::{plan, rig};
use raysweep_tests::{Bench, Ended, end_of};
use serde_json::Value;

/// Resonant frequencies of the simulated mirror, x and y.
const F0_HZ: [f64; 2] = [500.0, 480.0];
const Q: [f64; 2] = [30.0, 22.0];

/// A plan of chirps for the small rig; `more` is appended to its table.
fn chirps(more: &str) -> String {
    format!(
        "kind = \"response\"\n[response]\nchirp_s = 0.5\nrest_s = 0.2\nrate_hz = 30000\ncamera_rate_hz = 4000\n\
         exposure_us = 100\ndark_frames = 64\nregion = [0, 112, 0, 128]\n{more}\n"
    )
}

/// A mirror with these resonances behind a controller with this filter; `more` is appended.
fn mirror(filter_hz: f64, more: &str) -> String {
    format!("[sim.dots.mirror]\nf0_hz = {F0_HZ:?}\nq = {Q:?}\nfilter_hz = {filter_hz}\n{more}")
}

fn kept_path(bench: &Bench) -> PathBuf {
    bench.folder.path().join("sessions/mirror-response.json")
}

fn completed(bench: &Bench, plan: &str) -> Ended {
    let ended = bench.run(plan);
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    ended
}

/// Compares the identified response with the simulated mirror.
fn assert_identified(bench: &Bench) {
    let kept: Value = serde_json::from_slice(&std::fs::read(kept_path(bench)).unwrap()).unwrap();
    for (axis, (f0_hz, q)) in ["x", "y"].into_iter().zip(F0_HZ.into_iter().zip(Q)) {
        let of = |key: &str| kept[axis][key].as_f64().unwrap();
        println!("{axis}: f0 {:.2} of {f0_hz} Hz, Q {:.2} of {q}: {}", of("f0_hz"), of("q"), kept[axis]);
        assert!((of("f0_hz") / f0_hz - 1.0).abs() < 0.01, "{}", kept[axis]);
        assert!((of("q") / q - 1.0).abs() < 0.1, "{}", kept[axis]);
    }
}

#[test]
fn resonances_are_identified_behind_the_controllers_filter() {
    for filter_hz in [200.0, 5000.0] {
        let bench = Bench::dots(&rig(&mirror(filter_hz, "")));
        completed(&bench, &chirps(""));
        assert_identified(&bench);
    }
}

#[test]
fn lost_and_spoilt_frames_leave_gaps_and_shift_nothing() {
    // The axes are coupled by a tenth of their movements, and the mirror drifts and has a repeatability error.
    let faults = "coupling = 0.1\ndrift_deg_per_s = [0.02, -0.01]\nrepeat_deg = 0.0005\n\
                  [sim.dots.camera]\ndropped = 0.05\nduplicated = 0.02\nsaturated = 0.01\n";
    let bench = Bench::dots(&rig(&mirror(1000.0, faults)));
    let ended = completed(&bench, &chirps(""));
    assert_identified(&bench);
    let (session, state) = ended.open();
    for entry in state.axes() {
        let share = |frames: usize| frames as f64 / entry.frames as f64;
        assert!((share(entry.lost) - 0.05).abs() < 0.02, "{entry:?}");
        assert!((share(entry.empty) - 0.01).abs() < 0.01, "{entry:?}");
        let name = format!("chirp_{}", ["x", "y"][entry.axis]);
        let record: Array2<f32> = session.products().read_image(&name).unwrap();
        let gaps = record.column(1).iter().filter(|row| row.is_nan()).count();
        assert_eq!((record.nrows(), gaps), (entry.frames, entry.lost + entry.empty));
    }
    assert!(state.counts.lost_total() > 200, "{:?}", state.counts);
}

#[test]
fn a_session_says_what_was_found_and_gives_it_again() {
    let bench = Bench::dots(&rig(&mirror(5000.0, "")));
    let ended = completed(&bench, &chirps(""));
    let (session, state) = ended.open();
    assert_eq!((state.stored_points(), state.session.kind.as_str()), (2, "response"));
    let kept = std::fs::read(kept_path(&bench)).unwrap();
    assert_eq!(std::fs::read(session.mirror_response_path()).unwrap(), kept);
    assert!(manifest::verify(&session).unwrap().is_empty());
    let report = std::fs::read_to_string(session.report_path()).unwrap();
    for expected in ["Axis x", "Axis y", "quality factor Q", "fitted", "Phase, without the delay"] {
        assert!(report.contains(expected), "the report lacks {expected}");
    }
    let spectrum = session.products_path().join("response_y.csv");
    let before = std::fs::read(&spectrum).unwrap();
    assert!(before.starts_with(b"hz,amplitude,phase_rad,fitted_amplitude,fitted_phase_rad\n"));
    for file in [&spectrum, &session.mirror_response_path(), &kept_path(&bench)] {
        std::fs::remove_file(file).unwrap();
    }
    let made = process(&ended.session).unwrap();
    assert_eq!((made.stored, made.points, made.problems.len()), (2, 2, 0));
    assert!(std::fs::read(&spectrum).unwrap() == before);
    assert_eq!(std::fs::read(session.mirror_response_path()).unwrap(), kept);
    assert!(!kept_path(&bench).exists(), "an old session is not the rig's newest word");
}

/// Column and row at which each dot of a run falls on the plane; `None` for a dot that was not seen.
fn places(ended: &Ended) -> Vec<Option<[f64; 2]>> {
    let dots: Array2<f32> = ended.open().0.products().read_image("dots").unwrap();
    let place = |column: f32, row: f32| (column >= 0.0).then(|| [f64::from(column), f64::from(row)]);
    dots.rows().into_iter().map(|dot| place(dot[1], dot[2])).collect()
}

/// Root mean square distance between the dots and their targets.
fn distance_px(found: &[Option<[f64; 2]>], wanted: &[Option<[f64; 2]>]) -> f64 {
    let both: Vec<f64> = found
        .iter()
        .zip(wanted)
        .filter_map(|(found, wanted)| Some(((*found)?, (*wanted)?)))
        .map(|(found, wanted)| (found[0] - wanted[0]).powi(2) + (found[1] - wanted[1]).powi(2))
        .collect();
    assert!(both.len() > 200, "{} dots", both.len());
    (both.iter().sum::<f64>() / both.len() as f64).sqrt()
}

#[test]
fn paths_distorted_by_what_was_identified_are_followed_closer() {
    // x moves at 180 Hz, a third of its resonant frequency.
    let raster = plan("product = [{ kind = \"floodlit\" }]", 2).replace(
        "shape = \"lissajous\"\ncycles = [7, 1]\namplitude_deg = [2.3, 1.3]",
        "shape = \"raster\"\nlines = 18\namplitude_deg = [1.6, 1.1]\nflyback = 0.15",
    );
    let exact = Bench::dots(&rig("[sim.dots.mirror]\nmechanics = false\n"));
    let wanted = places(&completed(&exact, &raster));
    let mut bench = Bench::dots(&rig(&mirror(20_000.0, "")));
    let plain = completed(&bench, &raster);
    let found = completed(&bench, &chirps(""));
    bench.runner.shut_down();
    let text = rig(&mirror(20_000.0, "")).replace("[mirror]\n", "[mirror]\nresponse = \"identified\"\n");
    let path = bench.folder.path().join("rig.toml");
    std::fs::write(&path, text).unwrap();
    let rig = DotRig::load(&path).unwrap();
    let data = bench.folder.path().join("sessions");
    bench.runner = Arc::new(Runner::new(rig, data).unwrap());
    let distorted = completed(&bench, &raster);
    let [before_px, after_px] = [&plain, &distorted].map(|ended| distance_px(&places(ended), &wanted));
    println!("dots lie {before_px:.2} px from where they should, {after_px:.2} px with the path distorted");
    assert!(before_px > 1.0 && after_px < before_px / 3.0, "{before_px} {after_px}");

    let settings =
        |ended: &Ended| manifest::read(&ended.open().0).unwrap().settings["mirror_response"].clone();
    assert_eq!(settings(&plain), Value::Null);
    let said = settings(&distorted);
    assert_eq!(said["session"].as_str(), found.session.file_name().unwrap().to_str());
    assert!((said["x"]["f0_hz"].as_f64().unwrap() / F0_HZ[0] - 1.0).abs() < 0.01, "{said}");
    // The products can be recomputed when the rig's own file is gone.
    std::fs::remove_file(kept_path(&bench)).unwrap();
    assert_eq!(process(&distorted.session).unwrap().problems, [""; 0]);
    assert_eq!(settings(&distorted), said);
    let refused = bench.runner.check(&raster).unwrap_err();
    assert_eq!(refused.name(), Some(ErrorCode::InvalidPlan), "{refused}");
    assert_eq!(bench.runner.check(&chirps("")).unwrap().points, 2, "and the run that makes it is not");
}

#[test]
fn what_shows_no_resonance_faults_the_run_and_overwrites_nothing() {
    let known = "what was known before";
    for (mirror, more, expected) in [
        // The filter blocks the chirp.
        (mirror(1.0, ""), "", "axis x (its chirp moved the dot by"),
        ("[sim.dots.mirror]\nmechanics = false\n".into(), "", "no resonance between 100 and 900 Hz"),
        (mirror(5000.0, "[sim.dots.camera]\ndropped = 0.2\n"), "", "frames were lost"),
        // The dot is in the centre.
        (mirror(5000.0, ""), "region = [0, 16, 0, 16]", "0 of the"),
    ] {
        let bench = Bench::dots(&rig(&mirror));
        std::fs::create_dir_all(bench.folder.path().join("sessions")).unwrap();
        std::fs::write(kept_path(&bench), known).unwrap();
        let plan = chirps("").replace("region = [0, 112, 0, 128]\n", "") + more;
        let ended = bench.run(&plan);
        let error = ended.error.clone().unwrap_or_default();
        assert!(ended.state == "faulted" && error.contains(expected), "{}: {error}", ended.state);
        assert_eq!(std::fs::read_to_string(kept_path(&bench)).unwrap(), known);
        let (session, state) = ended.open();
        assert!(!session.mirror_response_path().exists());
        assert_eq!(state.stored_points(), 2, "what was recorded is kept");
        let report = std::fs::read_to_string(session.report_path()).unwrap();
        assert!(report.contains(expected), "the report says why");
        let made = process(&ended.session).unwrap();
        assert!(made.problems[0].contains(expected), "{:?}", made.problems);
    }
}

#[test]
fn a_run_that_is_cancelled_knows_no_response() {
    let bench = Bench::dots(&rig(&mirror(5000.0, "")));
    let mut events = bench.runner.events();
    bench
        .runner
        .run(RunParams { plan: chirps("chirp_s = 3").replace("chirp_s = 0.5\n", ""), ..RunParams::default() })
        .unwrap();
    bench.runner.cancel().unwrap();
    let ended = end_of(&mut events);
    assert_eq!(ended.state, "cancelled", "{:?}", ended.error);
    assert!(ended.open().1.counts.balanced() && !kept_path(&bench).exists());
    let error = process(&ended.session).unwrap_err();
    assert!(matches!(error, ProcessError::Config(_)), "{error}");
}

#[test]
fn a_plan_says_what_it_would_do_and_where_it_cannot() {
    let bench = Bench::dots(&rig(""));
    let report = bench.runner.check(&chirps("")).unwrap();
    let response = report.response.clone().unwrap();
    assert_eq!((report.points, response.frames, response.samples), (2, 2800, 21_000));
    assert!((report.light_s - 1.4).abs() < 1e-9 && report.frames == 5664, "{report:?}");
    let run = |plan: String| bench.runner.run(RunParams { plan, ..RunParams::default() }).unwrap_err();
    for (plan, field) in [
        (chirps("").replace("0, 112", "0, 200"), "response.region"),
        (chirps("amplitude_deg = 0.1"), "response.amplitude_deg"),
        (chirps("band_hz = [100, 2000]"), "response.band_hz"),
    ] {
        for error in [bench.runner.check(&plan).unwrap_err(), run(plan)] {
            assert_eq!(error.data.unwrap().field.as_deref(), Some(field));
        }
    }
    let plane = Bench::new(&raysweep_tests::rig_text(128, "scene = \"v-groove\"", ""));
    let error = plane.runner.check(&chirps("")).unwrap_err();
    assert_eq!(error.data.unwrap().field.as_deref(), Some("kind"));
}
