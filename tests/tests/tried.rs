//! Faults that were found by trying a release as its users do.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;

use raysweep::control::Control;
use raysweep_processing::{Asked, ExportScope, copy_acquired, export, process, process_asked};
use raysweep_session::Session;
use raysweep_session::stack::ArrayName;
use raysweep_tests::{Bench, Ended, rig_text};
use serde_json::Value;

const PLAN: &str = "kind = \"sweep\"\n[sweep]\naverage = 2\n\
                    delay_us = { start = -200, stop = 200, count = 5 }\nexposure_us = [100, 250]\n";

fn completed(bench: &Bench) -> Ended {
    let ended = bench.run(PLAN);
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    ended
}

fn bench() -> Bench {
    Bench::new(&rig_text(24, "scene = \"mix\"\nscene_rows = 24\nscene_columns = 16\nseed = 4", ""))
}

/// All files below a folder with their bytes, by their paths in it.
fn files(folder: &Path) -> BTreeMap<String, Vec<u8>> {
    fn walk(folder: &Path, root: &Path, found: &mut BTreeMap<String, Vec<u8>>) {
        for path in fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
            match path.is_dir() {
                true => walk(&path, root, found),
                false => {
                    let name = path.strip_prefix(root).unwrap().display().to_string();
                    found.insert(name, fs::read(&path).unwrap());
                }
            }
        }
    }
    let mut found = BTreeMap::new();
    walk(folder, folder, &mut found);
    found
}

#[test]
fn a_session_is_processed_into_another_folder_and_stays_as_it_is() {
    let bench = bench();
    let ended = completed(&bench);
    let before = files(&ended.session);
    let to = bench.folder.path().join("again");
    copy_acquired(&ended.session, &to).unwrap();
    assert!(
        !files(&to).keys().any(|name| name.starts_with("products/") || name.starts_with("transport.zarr"))
    );
    let asked = Asked { products: vec!["kind = \"epipolar\", width_rows = 3".into()], ..Asked::default() };
    process_asked(&to, &asked).unwrap();
    assert!(files(&ended.session) == before, "the session is as it was");
    let after = files(&to);
    for (name, bytes) in before.iter().filter(|(name, _)| name.starts_with("products/")) {
        assert!(after[name] == *bytes, "{name} differs");
    }
    assert!(after.contains_key("products/epipolar_3.npy"));
    let refused = copy_acquired(&ended.session, &to).unwrap_err().to_string();
    assert!(refused.contains("already exists"), "{refused}");
    // What is acquired again in one of them does not change the other, although they share files.
    let chunk = |folder: &Path| folder.join("stack.zarr/sum/c.3.0.0");
    let shared = fs::read(chunk(&to)).unwrap();
    fs::remove_file(chunk(&ended.session)).unwrap();
    assert_eq!(bench.resume(&ended.session).state, "complete");
    assert!(fs::read(chunk(&to)).unwrap() == shared);
}

#[test]
fn an_export_can_take_the_arrays_along() {
    let bench = bench();
    let ended = completed(&bench);
    let [without, with] = ["without", "with"].map(|name| bench.folder.path().join(name));
    export(&ended.session, &without, false, ExportScope::Results).unwrap();
    assert!(!without.join("stack.zarr").exists());
    let copied = export(&ended.session, &with, false, ExportScope::ResultsAndArrays).unwrap();
    assert_eq!(files(&with).len(), copied);
    let exported = Session::open(&with).unwrap().stack().unwrap().read_point(ArrayName::Sum, 2).unwrap();
    assert_eq!(exported, ended.open().0.stack().unwrap().read_point(ArrayName::Sum, 2).unwrap());
    assert!(with.join("transport.zarr").is_dir());
}

#[test]
fn the_width_of_the_beam_is_the_same_in_every_file() {
    let bench = bench();
    let ended = completed(&bench);
    let beam = |name: &str| {
        let text = fs::read(ended.session.join("products").join(name)).unwrap();
        serde_json::from_slice::<Value>(&text).unwrap()["beam_sigma_rows"].clone()
    };
    assert!(beam("transport.json").is_number(), "{}", beam("transport.json"));
    for name in ["epipolar.json", "long_range.json", "regular.json"] {
        assert_eq!(beam(name), beam("transport.json"), "{name}");
    }
}

#[test]
fn one_more_product_does_not_take_the_others_out_of_the_report() {
    let bench = bench();
    let ended = completed(&bench);
    let before = files(&ended.session.join("products"));
    let product = "kind = \"epipolar\", width_rows = 3".into();
    process_asked(&ended.session, &Asked { products: vec![product], only: true, ..Asked::default() })
        .unwrap();
    let report = fs::read_to_string(ended.session.join("report.html")).unwrap();
    for name in ["epipolar_3", "short_range", "long_range"] {
        assert!(report.contains(name), "{name} is not in the report");
    }
    let after = files(&ended.session.join("products"));
    assert!(before.iter().all(|(name, bytes)| after[name] == *bytes));
}

#[test]
fn a_film_whose_transports_were_made_later_says_nothing_of_missing_ones() {
    let sim = "scene = \"pendulum\"\nscene_rows = 24\nscene_columns = 16\nseed = 5";
    let bench = Bench::new(&rig_text(720, sim, ""));
    let ended = bench.run("kind = \"film\"\n[film]\ncycles = 3\n");
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let (session, state) = ended.open();
    let complaint = |missing| raysweep_processing::film::shortcomings(&state, missing).concat();
    assert!(complaint(2).contains("2 stored cycles have no transport"), "{}", complaint(2));
    assert_eq!(complaint(0), "");
    fs::remove_file(session.transport_film_path().join("transport/c.1.0.0.0")).unwrap();
    process(&ended.session).unwrap();
    let report = fs::read_to_string(session.report_path()).unwrap();
    assert!(!report.contains("have no transport"));
}

#[test]
fn a_sessions_own_rig_file_finds_what_the_rig_refers_to() {
    let folder = tempfile::TempDir::new().unwrap();
    let rigs = folder.path().join("rigs");
    fs::create_dir(&rigs).unwrap();
    fs::create_dir(folder.path().join("scenes")).unwrap();
    fs::copy(raysweep_tests::data("p2r_corner.npz"), folder.path().join("scenes/corner.npz")).unwrap();
    let rig = rig_text(128, "scene = \"../scenes/corner.npz\" # by others", "");
    fs::write(rigs.join("rig.toml"), &rig).unwrap();
    let start = |rig: &Path| {
        let rig = raysweep::rig::Rig::load(rig).unwrap_or_else(|error| panic!("{error}"));
        raysweep::Runner::new(rig, folder.path().join("sessions")).unwrap()
    };
    let plan = "kind = \"sweep\"\n[sweep]\naverage = 1\ndelay_us = [-300, 0, 300]\nexposure_us = [600]\n";
    let runner = start(&rigs.join("rig.toml"));
    let mut events = runner.events();
    runner.run(raysweep_proto::RunParams { plan: plan.into(), ..Default::default() }).unwrap();
    let session = raysweep_tests::end_of(&mut events).session;
    runner.shut_down();
    drop(runner);
    let stored = fs::read_to_string(session.join("rig.toml")).unwrap();
    let scene = folder.path().canonicalize().unwrap().join("scenes/corner.npz");
    assert_eq!(
        stored,
        rig.replace("\"../scenes/corner.npz\"", &format!("{scene:?}")),
        "nothing else changes"
    );

    // Both files resume the session; so does the original one, if an earlier version stored it as it was.
    let resumed = |rig: &Path| {
        let runner = start(rig);
        let mut events = runner.events();
        let ledger = session.join("ledger.jsonl");
        let lines: Vec<String> = fs::read_to_string(&ledger).unwrap().lines().map(str::to_owned).collect();
        fs::write(&ledger, lines[..lines.len() - 3].join("\n") + "\n").unwrap();
        runner.resume(raysweep_proto::ResumeParams { session: session.clone() }).unwrap();
        raysweep_tests::end_of(&mut events).state
    };
    assert_eq!(resumed(&session.join("rig.toml")), "complete");
    assert_eq!(resumed(&rigs.join("rig.toml")), "complete");
}
