//! Damaged sessions: single flipped bits in every kind of file, and files that are cut short, missing or swapped, are
//! detected or without effect on the results; and what `process`, `resume` and `export` then do.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use ndarray::Array2;
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use raysweep::Probes;
use raysweep::control::Control;
use raysweep_pipeline::{Stage, StageError, Unit};
use raysweep_processing::{Asked, ExportScope, Processed, export, process, process_asked};
use raysweep_proto::{Event, ResumeParams, RunParams};
use raysweep_session::integrity::{Audit, Damage};
use raysweep_session::ledger::EndState;
use raysweep_session::stack::ArrayName;
use raysweep_session::{Session, list};
use raysweep_tests::{Bench, data, dots, next_event, rig_text};

/// Saturates in places, so that there are counts of clipped frames.
const LIGHT: &str = "[sim.ambient]\nlevel = 0.05\n";
const SWEEP: &str =
    "kind = \"sweep\"\n[sweep]\naverage = 2\ndelay_us = [-60, 0, 60]\nexposure_us = [50, 100, 150]\n";

fn small_bench() -> Bench {
    Bench::new(&rig_text(8, "scene = \"v-groove\"\nscene_rows = 8\nscene_columns = 8\nseed = 11", LIGHT))
}

fn completed(bench: &Bench, plan: &str) -> PathBuf {
    let ended = bench.run(plan);
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    ended.session
}

type Files = BTreeMap<String, Vec<u8>>;

/// All files of a folder, by their paths in it.
fn files_of(folder: &Path) -> Files {
    fn walk(folder: &Path, root: &Path, files: &mut Files) {
        for path in fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
            match path.is_dir() {
                true => walk(&path, root, files),
                false => {
                    let name = path.strip_prefix(root).unwrap().display().to_string();
                    files.insert(name, fs::read(&path).unwrap());
                }
            }
        }
    }
    let mut files = Files::new();
    walk(folder, folder, &mut files);
    files
}

/// Makes a folder with these files.
fn restore_in(folder: &Path, files: &Files) {
    fs::create_dir_all(folder.join("products")).unwrap();
    restore(folder, files);
}

/// Makes a folder's files those of `files` again.
fn restore(folder: &Path, files: &Files) {
    let now = files_of(folder);
    now.keys()
        .filter(|name| !files.contains_key(*name))
        .for_each(|name| fs::remove_file(folder.join(name)).unwrap());
    for (name, bytes) in files.iter().filter(|(name, bytes)| now.get(*name) != Some(bytes)) {
        fs::create_dir_all(folder.join(name).parent().unwrap()).unwrap();
        fs::write(folder.join(name), bytes).unwrap();
    }
}

/// The results among the files. Reports and manifests name what was wrong, and videos depend on ffmpeg.
fn results(files: &Files) -> Files {
    let is_result = |name: &str| {
        let is_made =
            name.starts_with("products/") || name.starts_with("transport") || name.starts_with("calibration");
        is_made && !name.ends_with(".mp4")
    };
    files
        .iter()
        .filter(|(name, _)| is_result(name))
        .map(|(name, bytes)| (name.clone(), bytes.clone()))
        .collect()
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Verdict {
    /// `process` refuses, and has changed nothing.
    Refused,
    /// `verify` names a result, which `process` makes again.
    Result,
    /// `process` makes fewer points of it and says so.
    Said,
    /// `process` makes the same results.
    WithoutEffect,
}

/// What becomes of a session with one damage, whose sound files are given. The session is as before afterwards.
fn verdict(folder: &Path, sound: &Files, what: &str) -> Verdict {
    let damaged = files_of(folder);
    let (before, expected) = (results(&damaged), results(sound));
    let audit = Session::open(folder).and_then(|session| Audit::of(&session));
    let only_results = audit.as_ref().is_ok_and(|(_, audit)| {
        !audit.damage.is_empty() && audit.damage.iter().all(Damage::is_of_results_only)
    });
    let made = process(folder);
    let after = results(&files_of(folder));
    restore(folder, sound);
    let differing = |found: &Files| {
        expected.iter().find(|(name, bytes)| found.get(*name) != Some(bytes)).map(|found| found.0.clone())
    };
    match made {
        Err(_) => {
            assert!(
                audit.is_err() || !audit.unwrap().1.damage.is_empty(),
                "{what}: refused, but verify finds nothing"
            );
            assert!(after == before, "{what}: refused, but results have changed");
            Verdict::Refused
        }
        Ok(_) if only_results => {
            assert_eq!(differing(&after), None, "{what}: not made again");
            Verdict::Result
        }
        Ok(Processed { problems, .. }) if problems.iter().any(|problem| problem.contains("torn")) => {
            Verdict::Said
        }
        Ok(_) => {
            assert_eq!(differing(&after), None, "{what}: a silently wrong result");
            Verdict::WithoutEffect
        }
    }
}

/// Flips single bits of a session, sampled over its files and then over the bits of each; returns the verdicts.
fn flip(folder: &Path, flips: usize, seed: u64) -> BTreeMap<Verdict, usize> {
    let sound = files_of(folder);
    let names: Vec<&String> = sound.keys().filter(|name| !sound[*name].is_empty()).collect();
    let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
    let mut verdicts = BTreeMap::new();
    for round in 0..flips {
        let name = names[round % names.len()];
        let mut bytes = sound[name].clone();
        let (at, bit) = (random.next_u64() as usize % bytes.len(), random.next_u64() % 8);
        bytes[at] ^= 1 << bit;
        fs::write(folder.join(name), bytes).unwrap();
        *verdicts.entry(verdict(folder, &sound, &format!("{name}, byte {at}, bit {bit}"))).or_default() += 1;
    }
    verdicts
}

/// A session as a crash leaves it before its end: without results and manifest.
fn without_results(folder: &Path) {
    let ledger = fs::read_to_string(folder.join("ledger.jsonl")).unwrap();
    let lines: Vec<&str> =
        ledger.split_inclusive('\n').filter(|line| !line.contains("\"event\":\"end\"")).collect();
    fs::write(folder.join("ledger.jsonl"), lines.concat()).unwrap();
    fs::remove_file(folder.join("manifest.json")).unwrap();
}

#[test]
fn two_thousand_flipped_bits_are_detected_or_without_effect() {
    let plane = small_bench();
    let calibrated = Bench::new(&rig_text(720, "scene_rows = 96\nscene_columns = 48", ""));
    let calibration = completed(
        &calibrated,
        "kind = \"calibration\"\n[calibration]\nframes = 8\npicture_frames = 2\ndelays = 40\n",
    );
    let few = "kind = \"sweep\"\n[sweep]\naverage = 2\ndelay_us = [-300, 0, 300]\nexposure_us = [500]\n";
    let mirror = Bench::dots(&dots::rig(""));
    let interrupted = completed(&plane, SWEEP);
    without_results(&interrupted);
    let sessions = [
        ("sweep", completed(&plane, SWEEP), 800),
        ("interrupted sweep", interrupted, 500),
        (
            "film",
            completed(
                &plane,
                "kind = \"film\"\n[film]\ncycles = 4\ndelay_us = [-60, 0, 60]\nexposure_us = 50\n",
            ),
            300,
        ),
        ("darks", completed(&plane, "kind = \"darks\"\n[darks]\nexposure_us = [50, 100]\n"), 150),
        ("calibrated sweep", completed(&calibrated, few), 100),
        ("batches", completed(&mirror, &dots::plan("product = [{ kind = \"floodlit\" }]", 2)), 100),
        ("calibration", calibration, 50),
    ];
    assert_eq!(sessions.iter().map(|(_, _, flips)| flips).sum::<usize>(), 2000);
    std::thread::scope(|scope| {
        for (seed, (kind, session, flips)) in (1..).zip(sessions) {
            scope.spawn(move || {
                // In memory: nothing is cut off here, and syncing every product to a disk would take minutes.
                let memory = tempfile::tempdir_in("/dev/shm").unwrap();
                let folder = memory.path().join(session.file_name().unwrap());
                restore_in(&folder, &files_of(&session));
                let verdicts = flip(&folder, flips, seed);
                println!("{kind}: {flips} flips: {verdicts:?}");
                assert!(verdicts[&Verdict::Refused] * 5 > flips, "{kind}: {verdicts:?}");
            });
        }
    });
}

#[test]
fn files_that_are_cut_short_missing_or_of_another_session_are_detected_or_without_effect() {
    let bench = small_bench();
    let (folder, other) =
        (completed(&bench, SWEEP), completed(&bench, &SWEEP.replace("[-60, 0, 60]", "[-50, 0, 50]")));
    let (sound, others) = (files_of(&folder), files_of(&other));
    let mut refused = 0;
    for (name, bytes) in &sound {
        let path = folder.join(name);
        fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
        let mut verdicts = vec![verdict(&folder, &sound, &format!("{name} cut short"))];
        if name != "ledger.jsonl" {
            // Without a ledger there is no session.
            fs::remove_file(&path).unwrap();
            verdicts.push(verdict(&folder, &sound, &format!("{name} missing")));
        }
        if let Some(bytes) = others.get(name) {
            fs::write(&path, bytes).unwrap();
            verdicts.push(verdict(&folder, &sound, &format!("{name} of another session")));
        }
        refused += verdicts.iter().filter(|verdict| **verdict == Verdict::Refused).count();
    }
    assert!(refused > sound.len() / 2, "{refused}");
    fs::write(folder.join("stack.zarr/sum/c.3.0.0"), &sound["stack.zarr/sum/c.4.0.0"]).unwrap();
    assert_eq!(verdict(&folder, &sound, "a chunk of another point"), Verdict::Refused);
    // A line of the ledger left out, or two in the other order.
    let ledger = String::from_utf8(sound["ledger.jsonl"].clone()).unwrap();
    let lines: Vec<&str> = ledger.split_inclusive('\n').collect();
    for at in 0..lines.len() - 2 {
        let mut fewer = lines.clone();
        fewer.remove(at);
        let mut turned = lines.clone();
        turned.swap(at, at + 1);
        for changed in [fewer, turned] {
            fs::write(folder.join("ledger.jsonl"), changed.concat()).unwrap();
            assert_eq!(verdict(&folder, &sound, &format!("line {at} of the ledger")), Verdict::Refused);
        }
    }
}

fn damage(path: &Path) {
    let mut bytes = fs::read(path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 0x10;
    fs::write(path, bytes).unwrap();
}

#[test]
fn damage_is_refused_or_left_out_and_said_and_a_resumed_run_acquires_it_again() {
    let bench = small_bench();
    let folder = completed(&bench, SWEEP);
    let sound = files_of(&folder);
    damage(&folder.join("stack.zarr/sum/c.3.0.0"));
    fs::remove_file(folder.join("stack.zarr/dark/c.1.0.0")).unwrap();
    let refused = process(&folder).unwrap_err().to_string();
    assert!(refused.contains("sum 3 is damaged") && refused.contains("dark 1 is damaged"), "{refused}");
    assert!(results(&files_of(&folder)) == results(&sound), "the products are kept");

    let accepting = Asked { accept_damage: true, ..Asked::default() };
    let made = process_asked(&folder, &accepting).unwrap();
    assert_eq!((made.stored, made.points), (8, 9));
    let texts = ["report.html", "manifest.json", "products/epipolar.json", "products/transport.json"];
    for text in texts {
        assert!(fs::read_to_string(folder.join(text)).unwrap().contains("sum 3 is damaged"), "{text}");
    }

    let mut events = bench.runner.events();
    bench.runner.resume(ResumeParams { session: folder.clone() }).unwrap();
    let warnings = loop {
        if let Event::Finished { warnings, state, .. } = next_event(&mut events) {
            assert_eq!(state, "complete");
            break warnings;
        }
    };
    // 9 points, a dark image for each exposure and for the regular image, and that one.
    assert!(
        warnings.iter().any(|warning| warning.contains("2 of 14 stored images were damaged")),
        "{warnings:?}"
    );
    assert!(results(&files_of(&folder)) == results(&sound), "the same attempts give the same bits");
    let (_, audit) = Audit::of(&Session::open(&folder).unwrap()).unwrap();
    assert!(audit.damage.is_empty(), "{:?}", audit.damage);
    assert!(!fs::read_to_string(folder.join("manifest.json")).unwrap().contains("damaged"));
}

#[test]
fn a_resumed_run_that_faults_keeps_what_it_said_of_damage() {
    let bench = small_bench();
    let folder = completed(&bench, SWEEP);
    damage(&folder.join("stack.zarr/sum/c.3.0.0"));
    // No product can be written, and no end of the run's own.
    fs::remove_dir_all(folder.join("products")).unwrap();
    fs::write(folder.join("products"), "").unwrap();
    let resumed = bench.resume(&folder);
    let end = resumed.open().1.end.unwrap();
    assert_eq!((resumed.state.as_str(), end.state, end.error), ("faulted", EndState::Faulted, resumed.error));
    let [warning] = &end.warnings[..] else { panic!("{:?}", end.warnings) };
    assert!(warning.contains("1 of 14 stored images were damaged"), "{warning}");
}

#[test]
fn a_damaged_product_is_not_certified_and_not_copied() {
    let bench = small_bench();
    let folder = completed(&bench, SWEEP);
    damage(&folder.join("products/epipolar.npy"));
    let only = Asked {
        products: vec!["kind = \"epipolar\", width_rows = 3".into()],
        only: true,
        ..Asked::default()
    };
    process_asked(&folder, &only).unwrap();
    let damaged = |folder: &Path| {
        let (_, audit) = Audit::of(&Session::open(folder).unwrap()).unwrap();
        audit.damage.iter().map(ToString::to_string).collect::<Vec<_>>()
    };
    assert!(damaged(&folder)[0].starts_with("products/epipolar.npy is damaged"), "{:?}", damaged(&folder));
    let to = bench.folder.path().join("copy");
    let refused = export(&folder, &to, false, ExportScope::Results).unwrap_err().to_string();
    assert!(refused.contains("products/epipolar.npy") && !to.exists(), "{refused}");
    process(&folder).unwrap();
    assert_eq!(damaged(&folder), [""; 0]);
    export(&folder, &to, false, ExportScope::Results).unwrap();
}

#[test]
fn a_manifest_that_is_gone_and_what_no_session_contains_are_damage() {
    let bench = small_bench();
    let folder = completed(&bench, SWEEP);
    let damaged = || {
        let (_, audit) = Audit::of(&Session::open(&folder).unwrap()).unwrap();
        audit.damage.iter().map(ToString::to_string).collect::<Vec<_>>()
    };
    let to = bench.folder.path().join("copy");
    let refused = || export(&folder, &to, false, ExportScope::Results).unwrap_err().to_string();

    std::os::unix::fs::symlink("/etc/hostname", folder.join("products/link")).unwrap();
    let [link] = &damaged()[..] else { panic!("{:?}", damaged()) };
    assert!(link.starts_with("products/link is damaged (it is a symbolic link"), "{link}");
    fs::remove_file(folder.join("products/link")).unwrap();

    damage(&folder.join("products/epipolar.npy"));
    fs::remove_file(folder.join("manifest.json")).unwrap();
    assert_eq!(
        damaged(),
        ["manifest.json is damaged (it is missing, unless the run is being finished at this moment)"]
    );
    assert!(refused().contains("manifest.json") && !to.exists(), "{}", refused());
    process(&folder).unwrap();
    assert_eq!(damaged(), [""; 0]);

    // A sparse file, which would take minutes to read.
    fs::File::options().write(true).open(folder.join("plan.toml")).unwrap().set_len(1 << 40).unwrap();
    fs::File::options().write(true).open(folder.join("report.html")).unwrap().set_len(1 << 40).unwrap();
    let found = damaged();
    assert!(found.len() == 2 && found[0].starts_with("plan.toml"), "{found:?}");
    assert!(found[1].contains("its size is not the one in the manifest"), "{found:?}");
}

#[test]
fn an_edited_plan_is_refused_until_it_is_accepted_and_never_with_other_points() {
    let bench = small_bench();
    let folder = completed(&bench, SWEEP);
    let plan = folder.join("plan.toml");
    let fewer = SWEEP.replace("[50, 100, 150]", "[50, 100]");
    fs::write(&plan, &fewer).unwrap();
    let refused = bench.runner.resume(ResumeParams { session: folder.clone() }).unwrap_err();
    assert!(
        refused.message.contains("plan.toml") && refused.message.contains("restore"),
        "{}",
        refused.message
    );
    let accepting = Asked { accept_edits: true, ..Asked::default() };
    for other in [fewer, SWEEP.replace("-60", "-61")] {
        fs::write(&plan, other).unwrap();
        let refused = process(&folder).unwrap_err().to_string();
        assert!(refused.contains("--accept-edits"), "{refused}");
        let refused = process_asked(&folder, &accepting).unwrap_err().to_string();
        assert!(refused.contains("restore the original"), "{refused}");
    }
    fs::write(&plan, format!("{SWEEP}[[product]]\nkind = \"regular\"\nname = \"later\"\n")).unwrap();
    process_asked(&folder, &accepting).unwrap();
    assert!(folder.join("products/later.npy").exists());
    process(&folder).expect("the edit is on record");
}

/// Moves the folders of all sessions away when a point arrives.
struct Remover(PathBuf);

impl Stage for Remover {
    fn name(&self) -> &str {
        "remover"
    }

    fn apply(&self, unit: &Unit, image: Array2<f32>) -> Result<Array2<f32>, StageError> {
        if unit.id.point == 7 {
            fs::rename(&self.0, self.0.with_extension("away")).unwrap();
        }
        Ok(image)
    }
}

#[test]
fn a_session_whose_folder_is_removed_in_mid_run_is_not_made_anew_in_part() {
    let mut bench = small_bench();
    let sessions = bench.folder.path().join("sessions");
    let stages: Vec<std::sync::Arc<dyn Stage>> = vec![std::sync::Arc::new(Remover(sessions.clone()))];
    bench.restart_with(Probes { stages, ..Probes::default() });
    let mut events = bench.runner.events();
    bench.runner.run(RunParams { plan: SWEEP.into(), ..RunParams::default() }).unwrap();
    let session = loop {
        if let Event::Finished { session, state, .. } = next_event(&mut events) {
            assert_eq!(state, "faulted");
            break session;
        }
    };
    assert!(!session.exists(), "{:?}", files_of(&session).keys());
}

#[test]
fn a_run_that_cannot_begin_is_faulted_not_unfinished() {
    let bench = small_bench();
    let folder = completed(&bench, SWEEP);
    // A file in the way of the results ends the run after its last point.
    let ledger = fs::read_to_string(folder.join("ledger.jsonl")).unwrap();
    let lines: Vec<&str> = ledger.split_inclusive('\n').collect();
    fs::write(folder.join("ledger.jsonl"), lines[..6].concat()).unwrap();
    fs::remove_dir_all(folder.join("products")).unwrap();
    fs::write(folder.join("products"), "in the way").unwrap();
    let resumed = bench.resume(&folder);
    assert_eq!(resumed.state, "faulted");
    let listed = list(&bench.folder.path().join("sessions")).unwrap().sessions;
    assert_eq!(listed[0].end.unwrap().name(), "faulted");
}

#[test]
fn sessions_whose_plans_are_not_allowed_any_more_are_processed() {
    let folder = tempfile::tempdir().unwrap();
    let session = folder.path().join("sweep");
    restore_in(&session, &files_of(&data("sessions/sweep")));
    let plan = fs::read_to_string(session.join("plan.toml")).unwrap();
    let stages = "[[stage]]\nname = \"demux\"\n[[stage]]\nname = \"hot-pixels\"\nstep_px = 2\n";
    let late = format!("{plan}\n{stages}");
    let bench = Bench::new(&fs::read_to_string(session.join("rig.toml")).unwrap());
    assert!(bench.runner.check(&late).unwrap_err().message.contains("comes after demux"));
    let first = late.replace("[[stage]]\nname = \"demux\"\n", "") + "[[stage]]\nname = \"demux\"\n";
    assert!(bench.runner.check(&first).unwrap_err().message.contains("no Bayer mosaic"));
    fs::write(session.join("plan.toml"), late).unwrap();
    process(&session).unwrap();
    assert_eq!(Session::open(&session).unwrap().state().unwrap().stored(ArrayName::Sum).count(), 2);
}
