//! Sweeps that exceed the memory limit: solved in strips of camera rows, with the same files as when solved as a whole.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::atomic::{AtomicUsize, Ordering::Relaxed};
use std::sync::{Arc, OnceLock};

use ndarray::Array2;
use raysweep::control::Control;
use raysweep::{Probes, Runner};
use raysweep_pipeline::{Stage, StageError, Unit};
use raysweep_processing::{self as process, Asked, ProcessError};
use raysweep_proto::{ErrorCode, RunParams};
use raysweep_session::stack::ArrayName;
use raysweep_session::{Session, manifest};
use raysweep_tests::{Bench, Ended, PRODUCTS, rig_text, with_products};

/// Three strips, the last with fewer rows, and pixels that saturate.
fn rig() -> String {
    let rig = rig_text(150, "scene = \"mix\"\nscene_rows = 150\nscene_columns = 70\nseed = 11", "");
    rig.replace("[camera]\n", "[camera]\nwhite_dn = 3800\n")
}

/// A hot-pixel filter, whose pixels depend on rows of adjacent strips, and profiles that span several strips.
fn plan(stages: &[&str]) -> String {
    let sweep = "kind = \"sweep\"\nname = \"strips\"\n[sweep]\naverage = 1\n\
                 delay_us = { start = -300, stop = 300, count = 7 }\nexposure_us = [100, 250]\n";
    let more = [
        r#"kind = "delay-profile", region = [40, 140, 5, 60]"#,
        r#"kind = "delay-profile", pixel = [149, 69]"#,
        r#"kind = "uncertainty", from_rows = 0, to_rows = 0"#,
    ];
    let stages: String = stages.iter().map(|name| format!("[[stage]]\nname = \"{name}\"\n")).collect();
    with_products(&[&PRODUCTS[..], &more].concat(), sweep) + &stages
}

/// Memory needed for a plan's results without strips.
fn whole_bytes(bench: &Bench, plan: &str) -> u64 {
    let report = bench.runner.check(plan).unwrap();
    assert!(report.warnings.iter().all(|warning| !warning.contains("at a time")), "{:?}", report.warnings);
    report.memory_bytes
}

/// SHA-256 of all files except those that contain the time of the run.
fn checksums(session: &Path) -> BTreeMap<String, String> {
    let session = Session::open(session).unwrap();
    assert!(manifest::verify(&session).unwrap().is_empty());
    let mut files = manifest::read(&session).unwrap().files;
    files.retain(|name, _| !["ledger.jsonl", "report.html"].contains(&name.as_str()));
    assert!(files.len() > 40, "{:?}", files.keys());
    files.into_iter().map(|(name, record)| (name, record.sha256)).collect()
}

fn assert_same(found: &Path, expected: &Path) {
    let (found, expected) = (checksums(found), checksums(expected));
    assert!(found.keys().eq(expected.keys()), "{:?} are not {:?}", found.keys(), expected.keys());
    for (name, sha256) in expected {
        assert_eq!(found[&name], sha256, "{name} differs");
    }
}

fn limited(bytes: u64) -> Asked {
    Asked { memory_limit_bytes: Some(bytes), ..Asked::default() }
}

fn report_of(ended: &Ended) -> String {
    std::fs::read_to_string(ended.session.join("report.html")).unwrap()
}

#[test]
fn a_run_and_a_processing_in_strips_give_the_files_of_one_piece() {
    let plan = plan(&["hot-pixels", "demux"]);
    let mut bench = Bench::new(&rig());
    let whole = bench.run(&plan);
    assert_eq!(whole.state, "complete", "{:?}", whole.error);
    let saturates = |index| whole.mean(ArrayName::Sum, index).iter().any(|&counts| counts > 0.97 * 4095.0);
    assert!((0..14).any(saturates), "a pixel of the sweep should saturate");

    let limit_bytes = whole_bytes(&bench, &plan) - 1;
    bench.limit_memory(limit_bytes, Probes::default());
    let foreseen = bench.runner.check(&plan).unwrap();
    assert!(foreseen.memory_bytes < limit_bytes && foreseen.memory_free_bytes == limit_bytes);
    assert!(foreseen.warnings.iter().any(|warning| warning.contains("64 camera rows at a time")));
    let in_strips = bench.run(&plan);
    assert_eq!(in_strips.state, "complete", "{:?}", in_strips.error);
    assert_same(&in_strips.session, &whole.session);

    let before = (checksums(&whole.session), report_of(&whole));
    for folder in ["transport.zarr", "products"] {
        std::fs::remove_dir_all(whole.session.join(folder)).unwrap();
    }
    let made = process::process_asked(&whole.session, &limited(limit_bytes)).unwrap();
    assert_eq!(made.problems, [""; 0]);
    assert!((checksums(&whole.session), report_of(&whole)) == before);
}

/// Subtracts the image's mean, so that every pixel depends on all others.
struct Levelled;

impl Stage for Levelled {
    fn name(&self) -> &str {
        "levelled"
    }

    fn apply(&self, _unit: &Unit, image: Array2<f32>) -> Result<Array2<f32>, StageError> {
        let mean = image.mean().unwrap_or_default();
        Ok(image - 0.1 * mean)
    }
}

#[test]
fn a_stage_that_must_see_the_whole_image_does() {
    let probes = Probes { stages: vec![Arc::new(Levelled)], ..Probes::default() };
    let plan = plan(&["hot-pixels", "demux"]);
    let mut bench = Bench::with_probes(&rig(), probes.clone());
    let whole = bench.run(&plan);
    bench.limit_memory(whole_bytes(&bench, &plan) - 1, probes);
    let in_strips = bench.run(&plan);
    assert_eq!((whole.state.as_str(), in_strips.state.as_str()), ("complete", "complete"));
    assert_same(&in_strips.session, &whole.session);
}

#[test]
fn damaged_data_are_noticed_in_strips_too_and_left_out() {
    let plan = plan(&["demux"]);
    let bench = Bench::new(&rig());
    let ended = bench.run(&plan);
    let chunk = ended.session.join("stack.zarr/sum/c.3.0.0");
    let mut bytes = std::fs::read(&chunk).unwrap();
    let cut = bytes.len() / 2;
    bytes[cut] ^= 0x10;
    std::fs::write(&chunk, bytes).unwrap();
    let limit_bytes = whole_bytes(&bench, &plan) - 1;
    let accepting = |asked: Asked| Asked { accept_damage: true, ..asked };
    let asked = accepting(limited(limit_bytes));
    let in_strips = process::process_asked(&ended.session, &asked).unwrap();
    assert!(in_strips.problems.iter().any(|problem| problem.contains("sum 3 is damaged")));
    let found = checksums(&ended.session);
    let whole = process::process_asked(&ended.session, &accepting(Asked::default())).unwrap();
    assert_eq!(whole.problems, in_strips.problems);
    assert!(checksums(&ended.session) == found);
}

#[test]
fn what_does_not_fit_in_strips_either_is_refused_before_anything_is_written() {
    let plan = plan(&["demux"]);
    let mut bench = Bench::new(&rig());
    let ended = bench.run(&plan);
    let before = checksums(&ended.session);
    let refused = process::process_asked(&ended.session, &limited(1_000)).unwrap_err();
    assert!(matches!(refused, ProcessError::Memory { available_bytes: 1_000, .. }), "{refused}");
    assert!(checksums(&ended.session) == before);
    bench.limit_memory(1_000, Probes::default());
    let refused = bench.runner.run(RunParams { plan, ..RunParams::default() }).unwrap_err();
    assert_eq!(refused.name(), Some(ErrorCode::Storage), "{refused}");
}

/// Cancels the run after a given number of images.
struct Canceller {
    images_left: AtomicUsize,
    runner: Arc<OnceLock<Arc<Runner>>>,
}

impl Stage for Canceller {
    fn name(&self) -> &str {
        "canceller"
    }

    fn apply(&self, _unit: &Unit, image: Array2<f32>) -> Result<Array2<f32>, StageError> {
        let left = self.images_left.fetch_update(Relaxed, Relaxed, |left| left.checked_sub(1));
        if let (Err(_), Some(runner)) = (left, self.runner.get()) {
            runner.cancel().unwrap();
        }
        Ok(image)
    }
}

#[test]
fn a_run_cancelled_between_strips_leaves_no_part_of_a_transport_and_can_be_processed() {
    let plan = plan(&["demux"]);
    let mut bench = Bench::new(&rig());
    let runner = Arc::new(OnceLock::new());
    // 14 points of the sweep, two dark images and the regular image; processed on arrival, for choosing the solver's
    // parameters, and for the first strip.
    let canceller = Canceller { images_left: AtomicUsize::new(3 * 17), runner: runner.clone() };
    let limit_bytes = whole_bytes(&bench, &plan) - 1;
    bench.limit_memory(limit_bytes, Probes { stages: vec![Arc::new(canceller)], ..Probes::default() });
    assert!(runner.set(bench.runner.clone()).is_ok());
    let ended = bench.run(&plan);
    assert_eq!(ended.state, "cancelled", "{:?}", ended.error);
    let names = |folder: &Path| -> Vec<String> {
        let entries = std::fs::read_dir(folder).into_iter().flatten();
        entries.map(|entry| entry.unwrap().file_name().to_str().unwrap().to_owned()).collect()
    };
    assert!(names(&ended.session).iter().all(|name| !name.starts_with("transport")));
    assert_eq!(names(&ended.session.join("products")), [""; 0]);
    let made = process::process_asked(&ended.session, &limited(limit_bytes)).unwrap();
    assert_eq!((made.stored, made.problems.as_slice()), (14, [].as_slice()));
    checksums(&ended.session);
}
