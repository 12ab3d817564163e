//! Runs through the daemon's core: recomputed results, failing stages, pause and cancel, and files that other programs
//! read.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::collections::BTreeMap;
use std::path::Path;
use std::process::Command;
use std::sync::Arc;

use ndarray::Array2;
use raysweep::Probes;
use raysweep::control::Control;
use raysweep_core::LossCause;
use raysweep_pipeline::{Stage, StageError, Unit};
use raysweep_processing as process;
use raysweep_proto::{ErrorCode, Event, RunParams, RunState};
use raysweep_session::stack::ArrayName;
use raysweep_tests::{Bench, PRODUCTS, data, end_of, next_event, rig_text, wait_until, with_products};

const PLAN: &str = "kind = \"sweep\"\nname = \"flow\"\n[sweep]\naverage = 3\n\
                    delay_us = { start = -200, stop = 200, count = 5 }\nexposure_us = [100, 250]\n";

fn small_rig(more: &str) -> String {
    rig_text(24, "scene = \"mix\"\nscene_rows = 24\nscene_columns = 16\nseed = 9", more)
}

/// All files of a session that contain no times, with their bytes.
fn lasting_files(session: &Path) -> BTreeMap<String, Vec<u8>> {
    fn walk(folder: &Path, root: &Path, files: &mut BTreeMap<String, Vec<u8>>) {
        for entry in std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
            let name = entry.strip_prefix(root).unwrap().display().to_string();
            match entry.is_dir() {
                true => walk(&entry, root, files),
                false if ["ledger.jsonl", "manifest.json", "report.html"].contains(&name.as_str()) => {}
                false => drop(files.insert(name, std::fs::read(&entry).unwrap())),
            }
        }
    }
    let mut files = BTreeMap::new();
    walk(session, session, &mut files);
    assert!(files.keys().any(|name| name.starts_with("products/")) && files.len() > 20, "{:?}", files.keys());
    files
}

#[test]
fn processing_again_gives_the_same_bits() {
    let bench = Bench::new(&small_rig(""));
    let ended = bench.run(&with_products(&PRODUCTS, PLAN));
    let before = lasting_files(&ended.session);
    let report = std::fs::read(ended.session.join("report.html")).unwrap();
    for name in ["products", "transport.zarr", "report.html", "manifest.json"] {
        let path = ended.session.join(name);
        let removed =
            if path.is_dir() { std::fs::remove_dir_all(&path) } else { std::fs::remove_file(&path) };
        removed.unwrap();
    }
    let processed = process::process(&ended.session).unwrap();
    assert_eq!((processed.stored, processed.points), (10, 10));
    assert_eq!(lasting_files(&ended.session), before);
    assert!(std::fs::read(ended.session.join("report.html")).unwrap() == report, "the report differs");
}

/// Fails on one point with an error and on another with a panic.
struct Clumsy;

impl Stage for Clumsy {
    fn name(&self) -> &str {
        "clumsy"
    }

    fn apply(&self, unit: &Unit, image: Array2<f32>) -> Result<Array2<f32>, StageError> {
        match unit.id.point {
            8 => Err(StageError { stage: "clumsy".into(), what: "would not".into() }),
            9 => panic!("could not"),
            _ => Ok(image),
        }
    }
}

#[test]
fn a_stage_that_fails_or_panics_costs_its_unit_only() {
    let probes = Probes { stages: vec![Arc::new(Clumsy)], ..Probes::default() };
    let bench = Bench::with_probes(&small_rig(""), probes);
    let ended = bench.run(PLAN);
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let (_, state) = ended.open();
    assert_eq!(state.stored(ArrayName::Sum).count(), 10, "the raw images are stored all the same");
    let ledger = std::fs::read_to_string(ended.session.join("ledger.jsonl")).unwrap();
    let failures: Vec<&str> = ledger.lines().filter(|line| line.contains("stage_failed")).collect();
    assert_eq!(failures.len(), 2);
    assert!(failures[0].contains("would not") && failures[1].contains("could not"), "{failures:?}");
    let report = std::fs::read_to_string(ended.session.join("report.html")).unwrap();
    assert!(report.contains("images demultiplexed"), "the other points have their results");
}

/// Replaces the stack's folder with a file, so that nothing can be stored from point 9 on.
struct Saboteur(std::path::PathBuf);

impl Stage for Saboteur {
    fn name(&self) -> &str {
        "saboteur"
    }

    fn apply(&self, unit: &Unit, image: Array2<f32>) -> Result<Array2<f32>, StageError> {
        if unit.id.point == 9 {
            for session in std::fs::read_dir(&self.0).unwrap() {
                let sum = session.unwrap().path().join("stack.zarr/sum");
                std::fs::rename(&sum, sum.with_extension("away")).unwrap();
                std::fs::write(&sum, "in the way").unwrap();
            }
        }
        Ok(image)
    }
}

#[test]
fn a_disk_that_refuses_ends_the_run_at_once_with_its_cause_and_the_rest_can_be_resumed() {
    let mut bench = Bench::new(&small_rig(""));
    let sessions = bench.folder.path().join("sessions");
    bench.restart_with(Probes { stages: vec![Arc::new(Saboteur(sessions))], ..Probes::default() });
    let ended = bench.run(PLAN);
    assert_eq!(ended.state, "faulted");
    assert!(ended.error.as_ref().unwrap().contains("stack.zarr"), "{:?}", ended.error);
    let (session, state) = ended.open();
    assert!(
        state.counts.balanced() && state.counts.lost.contains_key(&LossCause::WriterError),
        "{:?}",
        state.counts
    );
    let stored = state.stored(ArrayName::Sum).count();
    assert!(stored < 10, "what could not be written is not stored");
    let tried_again = (0..10).filter(|&index| state.next_attempt(ArrayName::Sum, index) > 1).count();
    assert_eq!(tried_again, 0, "a disk that has refused is not tried again and again");

    let sum = session.stack_path().join("sum");
    std::fs::remove_file(&sum).unwrap();
    std::fs::rename(sum.with_extension("away"), &sum).unwrap();
    bench.restart_with(Probes::default());
    let resumed = bench.resume(&ended.session);
    assert_eq!(resumed.state, "complete", "{:?}", resumed.error);
    let bits = lasting_files(&ended.session);
    let undisturbed = lasting_files(&bench.run(PLAN).session);
    let differing: Vec<_> =
        bits.iter().filter(|(name, bytes)| undisturbed.get(*name) != Some(bytes)).collect();
    assert!(differing.is_empty(), "{:?}", differing.iter().map(|(name, _)| name).collect::<Vec<_>>());
}

#[test]
fn damaged_data_are_noticed_and_acquired_again() {
    let bench = Bench::new(&small_rig(""));
    let ended = bench.run(PLAN);
    let before = lasting_files(&ended.session);
    let chunk = ended.session.join("stack.zarr/sum/c.3.0.0");
    let mut bytes = std::fs::read(&chunk).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x10;
    std::fs::write(&chunk, bytes).unwrap();
    let refused = process::process(&ended.session).unwrap_err().to_string();
    assert!(refused.contains("sum 3 is damaged") && refused.contains("--accept-damage"), "{refused}");
    let resumed = bench.resume(&ended.session);
    assert_eq!(resumed.state, "complete", "{:?}", resumed.error);
    assert_eq!(resumed.open().1.point(ArrayName::Sum, 3).unwrap().attempt, 0, "its attempt had not failed");
    assert!(lasting_files(&ended.session) == before, "the same attempt gives the same bits");
    assert!(process::process(&ended.session).unwrap().problems.is_empty());
}

#[test]
fn light_beyond_the_cameras_range_is_said_in_the_runs_end() {
    let bench = Bench::new(&small_rig("[sim.ambient]\nlevel = 0.05\n"));
    let mut events = bench.runner.events();
    bench.runner.run(RunParams { plan: PLAN.into(), ..RunParams::default() }).unwrap();
    loop {
        if let Event::Finished { warnings, .. } = next_event(&mut events) {
            assert!(warnings.iter().any(|warning| warning.contains("saturated")), "{warnings:?}");
            break;
        }
    }
}

#[test]
fn a_cancelled_run_keeps_what_it_has_and_resumes() {
    let paced = small_rig("").replace("[sim]\n", "[sim]\nrealtime = true\n");
    let bench = Bench::new(&paced);
    let mut events = bench.runner.events();
    // Seconds of it are left when six points are stored.
    let plan = PLAN.replace("average = 3", "average = 30");
    bench.runner.run(RunParams { plan, ..RunParams::default() }).unwrap();
    wait_until(|| bench.runner.status().progress.is_some_and(|progress| progress.points_stored >= 6));
    bench.runner.pause().unwrap();
    assert_eq!(bench.runner.status().state, RunState::Paused);
    let busy = bench.runner.run(RunParams { plan: PLAN.into(), ..RunParams::default() }).unwrap_err();
    assert_eq!(busy.name(), Some(ErrorCode::Busy));
    bench.runner.go_on().unwrap();
    bench.runner.cancel().unwrap();
    let cancelled = end_of(&mut events);
    assert_eq!(cancelled.state, "cancelled");
    let (_, state) = cancelled.open();
    assert!(state.counts.balanced(), "{:?}", state.counts);
    let ledger = std::fs::read_to_string(cancelled.session.join("ledger.jsonl")).unwrap();
    let burnt = ledger.lines().filter(|line| line.contains("attempt_failed") && line.contains("\"lost\":{}"));
    assert_eq!(burnt.count(), 0, "an attempt that was cut short is begun again, not counted as failed");
    let missing = state.missing(ArrayName::Sum).count();
    assert!(missing > 0 && missing + state.stored(ArrayName::Sum).count() == 10);

    let resumed = bench.resume(&cancelled.session);
    assert_eq!(resumed.state, "complete", "{:?}", resumed.error);
    let (_, state) = resumed.open();
    assert!(state.counts.balanced(), "{:?}", state.counts);
    assert_eq!(state.missing(ArrayName::Sum).count(), 0);
}

#[test]
fn bad_plans_and_sessions_are_refused_and_the_daemon_goes_on() {
    let bench = Bench::new(&small_rig(""));
    let cases = [
        ("kind = ", None),
        ("kind = \"flim\"", Some("kind")),
        ("kind = \"film\"\n[sweep]\naverage = 3", Some("sweep")),
        ("kind = \"film\"\n[film]\ndelay_us = [0, 1e9]", Some("film.delay_us")),
        ("kind = \"sweep\"\n[sweep]\naverag = 3", Some("sweep.averag")),
        ("kind = \"sweep\"\n[sweep]\naverage = \"many\"", Some("sweep.average")),
        ("kind = \"sweep\"\n[sweep]\ndelay_us = [1e9]", Some("sweep.delay_us")),
        ("kind = \"sweep\"\n[sweep]\ndelay_us = [15000]\nexposure_us = [1]", Some("sweep.delay_us")),
        ("kind = \"sweep\"\n[[stage]]\nname = \"denoise\"", Some("stage.0.name")),
        ("kind = \"sweep\"\n[[stage]]\nname = \"demux\"\nprior = \"flat\"", Some("stage.0.prior")),
        ("kind = \"sweep\"\n[[stage]]\nname = \"demux\"\nalpha = -1", Some("stage.0.alpha")),
        ("kind = \"sweep\"\n[[stage]]\nname = \"demux\"\ngamma = 1", Some("stage.0.gamma")),
        ("kind = \"sweep\"\n[[product]]\nkind = \"epipola\"", Some("product.0.kind")),
    ];
    for (plan, field) in cases {
        let error = bench.runner.run(RunParams { plan: plan.into(), ..RunParams::default() }).unwrap_err();
        assert_eq!(error.name(), Some(ErrorCode::InvalidPlan), "{plan:?}: {error}");
        assert_eq!(error.data.as_ref().unwrap().field.as_deref(), field, "{plan:?}: {error}");
    }
    let none = bench.runner.resume(raysweep_proto::ResumeParams { session: "nowhere".into() }).unwrap_err();
    assert_eq!(none.name(), Some(ErrorCode::NoSession));
    assert_eq!(bench.run(PLAN).state, "complete");
    assert_eq!(bench.runner.pause().unwrap_err().name(), Some(ErrorCode::NotRunning));
}

#[test]
fn zarr_numpy_and_openexr_read_every_file() {
    let python = std::env::var_os("RAYSWEEP_PYTHON").expect(
        "RAYSWEEP_PYTHON names a Python with tests/python/requirements.txt: `cargo xtask test` makes one",
    );
    let bench = Bench::new(&small_rig(""));
    let ended = bench.run(&with_products(&PRODUCTS, PLAN));
    let script = data("").join("../python/read_session.py");
    let output = Command::new(python).arg(script).arg(&ended.session).output().unwrap();
    let said =
        format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{said}");
}
