//! Runs that measure nothing: a covered lens, a dot that is not seen, a transport that does not describe the scene. Each
//! says so, and leaves nothing that looks like a result.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::fs::{self, File};
use std::path::Path;

use ndarray::Array3;
use ndarray_npy::NpzWriter;
use raysweep::control::Control;
use raysweep_proto::{Event, RunParams, RunState};
use raysweep_session::Session;
use raysweep_session::stack::ArrayName;
use raysweep_tests::{Bench, dots, next_event, rig_text};

const ROWS: usize = 24;
const COLUMNS: usize = 16;
const SWEEP: &str = "kind = \"sweep\"\n[sweep]\naverage = 2\n\
                     delay_us = { start = -200, stop = 200, count = 5 }\nexposure_us = [100, 250]\n";
const FILM: &str = "kind = \"film\"\n[film]\ncycles = 5\n";

/// A diffuse scene with some indirect light, under a light of this strength.
fn write_scene(path: &Path, light: f32) {
    write_scene_of(path, ROWS, COLUMNS, light);
}

fn write_scene_of(path: &Path, rows: usize, columns: usize, light: f32) {
    let scene = Array3::from_shape_fn((rows, rows, columns), |(v, t, s)| {
        light * if v == t { 0.3 + 0.02 * s as f32 } else { 0.01 }
    });
    let mut npz = NpzWriter::new(File::create(path).unwrap());
    npz.add_array("T", &scene).unwrap();
    npz.finish().unwrap();
}

/// A rig with this scene, and the path of its scene, by which a test can cover the lens.
fn bench(light: f32) -> (Bench, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().join("scene.npz");
    write_scene(&scene, light);
    (Bench::new(&rig_text(720, &format!("scene = {scene:?}\nseed = 4"), "")), folder)
}

fn set_light(bench: &mut Bench, folder: &tempfile::TempDir, light: f32) {
    write_scene(&folder.path().join("scene.npz"), light);
    bench.restart_with(raysweep::Probes::default());
}

/// The sums of a sweep's points.
fn sums(ended: &raysweep_tests::Ended) -> Vec<ndarray::Array2<f64>> {
    (0..10).map(|index| ended.mean(ArrayName::Sum, index)).collect()
}

#[test]
fn a_sweep_with_a_covered_lens_is_faulted_before_its_first_point_and_resumes_without_the_cover() {
    let (mut bench, folder) = bench(0.0);
    let covered = bench.run(SWEEP);
    assert_eq!(covered.state, "faulted");
    let error = covered.error.clone().unwrap();
    for part in ["sees no light", "lens cap", "projector is off", "counts more with light", "raysweep resume"]
    {
        assert!(error.contains(part), "{part} in {error}");
    }
    let status = bench.runner.status();
    assert_eq!((status.state, status.ended.as_deref()), (RunState::Faulted, Some("faulted")));
    let (_, state) = covered.open();
    assert!(state.point(ArrayName::Regular, 0).is_none(), "a dark regular image would never be taken again");
    assert_eq!(state.stored(ArrayName::Sum).count(), 0);
    assert_eq!(state.stored(ArrayName::Dark).count(), 3);

    set_light(&mut bench, &folder, 1.0);
    let resumed = bench.resume(&covered.session);
    assert_eq!((resumed.state.as_str(), &resumed.error), ("complete", &None));
    // The same bits as those of a run that was never covered.
    let whole = bench.run(SWEEP);
    assert_eq!(sums(&resumed), sums(&whole));
}

#[test]
fn a_covered_lens_is_noticed_within_a_second_of_frames_before_any_image() {
    const SIDE: usize = 96;
    let folder = tempfile::tempdir().unwrap();
    let scene = folder.path().join("scene.npz");
    write_scene_of(&scene, SIDE, SIDE, 0.0);
    let mut bench = Bench::new(&rig_text(720, &format!("scene = {scene:?}\nseed = 4"), ""));
    let paper = include_str!("../../deploy/plans/paper.toml");
    for plan in ["kind = \"patterns\"\n", paper] {
        let covered = bench.run(plan);
        let error = covered.error.clone().unwrap_or_default();
        assert!(covered.state == "faulted" && error.contains("sees no light"), "{error}");
        let (_, state) = covered.open();
        let edges = state.end.as_ref().unwrap().vsync.unwrap().edges;
        println!("faulted after {edges} periods");
        assert!(edges <= 60, "{edges} periods of 1/60 s");
        assert_eq!(state.stored(ArrayName::Dark).count(), 0, "it looks before it takes dark images");
        assert!(state.counts.balanced(), "{:?}", state.counts);
        if plan == paper {
            write_scene_of(&scene, SIDE, SIDE, 1.0);
            bench.restart_with(raysweep::Probes::default());
            let resumed = bench.resume(&covered.session);
            assert_eq!((resumed.state.as_str(), &resumed.error), ("complete", &None));
        }
    }
}

#[test]
fn a_resumed_sweep_looks_for_light_again() {
    let (mut bench, folder) = bench(1.0);
    let whole = bench.run(SWEEP);
    assert_eq!(whole.state, "complete", "{:?}", whole.error);
    let expected = sums(&whole);
    let ledger = whole.session.join("ledger.jsonl");
    let text = fs::read_to_string(&ledger).unwrap();
    // As if the daemon had been killed after the second point of the sweep, whose regular image is stored.
    let stored = text.lines().filter(|line| line.contains("\"sum\"")).nth(1).unwrap();
    let cut = text.find(stored).unwrap() + stored.len() + 1;
    fs::write(&ledger, &text[..cut]).unwrap();

    set_light(&mut bench, &folder, 0.0);
    let covered = bench.resume(&whole.session);
    assert_eq!(covered.state, "faulted");
    assert!(covered.error.as_ref().unwrap().contains("sees no light"), "{:?}", covered.error);
    assert_eq!(covered.open().1.stored(ArrayName::Sum).count(), 2, "nothing is stored in the dark");

    set_light(&mut bench, &folder, 1.0);
    let resumed = bench.resume(&whole.session);
    assert_eq!((resumed.state.as_str(), &resumed.error), ("complete", &None));
    assert_eq!(sums(&resumed), expected);
}

#[test]
fn a_film_with_a_covered_lens_is_faulted_by_its_first_cycle() {
    let (bench, _folder) = bench(0.0);
    let ended = bench.run(FILM);
    assert_eq!(ended.state, "faulted");
    let error = ended.error.clone().unwrap();
    for part in ["sees no light", "lens cap", "film.delay_us", "run the plan again"] {
        assert!(error.contains(part), "{part} in {error}");
    }
    assert_eq!(ended.open().1.cycles().count(), 0);
}

#[test]
fn a_dim_film_goes_on() {
    let (bench, _folder) = bench(0.01);
    let ended = bench.run(FILM);
    assert_eq!(ended.state, "complete", "a dim scene is a scene: {:?}", ended.error);
    assert_eq!(ended.open().1.cycles().count(), 5);
}

#[test]
fn batches_without_a_trailing_dot_are_faulted_with_the_likely_causes() {
    let bench = Bench::dots(&dots::rig(""));
    let beside = dots::plan("", 4).replace("[112, 128, 48, 80]", "[112, 128, 0, 16]");
    let ended = bench.run(&beside);
    assert_eq!(ended.state, "faulted");
    let error = ended.error.clone().unwrap();
    for part in ["trailing dot is not seen", "of 601 frames", "lens cap", "trailing_region"] {
        assert!(error.contains(part), "{part} in {error}");
    }
    assert_eq!(ended.open().1.batches().count(), 0);
}

#[test]
fn a_transport_that_does_not_explain_the_regular_image_is_warned_of_in_capitals() {
    let (bench, _folder) = bench(1.0);
    let shifted = fs::read_to_string(bench.folder.path().join("rig.toml")).unwrap()
        + "[sim.truth]\nfirst_row_us = 100\n";
    let bench = Bench::new(&shifted);
    let mut events = bench.runner.events();
    bench.runner.run(RunParams { plan: SWEEP.into(), ..RunParams::default() }).unwrap();
    let (session, warnings) = loop {
        if let Event::Finished { session, warnings, .. } = next_event(&mut events) {
            break (session, warnings);
        }
    };
    let capitals = "THE TRANSPORT DOES NOT EXPLAIN WHAT THE CAMERA SAW";
    assert!(warnings.iter().any(|warning| warning.starts_with(capitals)), "{warnings:?}");
    assert!(fs::read_to_string(session.join("report.html")).unwrap().contains(capitals));
    assert_eq!(bench.runner.status().warnings, warnings);
    assert_eq!(Session::open(&session).unwrap().state().unwrap().end.unwrap().warnings, warnings);
    assert_eq!(bench.runner.sessions().unwrap()[0].warnings, warnings);
}
