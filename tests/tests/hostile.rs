//! What clients can ask of a daemon, at its worst: files that are none, sessions that lie elsewhere, plans that need
//! more than there is, and orders at any moment.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::fs;
use std::os::unix::fs::symlink;
use std::path::Path;
use std::process::Command;
use std::sync::{Arc, Condvar, Mutex};
use std::time::{Duration, Instant};

use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use raysweep::control::Control;
use raysweep::rig::DotRig;
use raysweep::{Probes, Runner};
use raysweep_proto::{ErrorCode, ResumeParams, RpcError, RunParams, RunState};
use raysweep_tests::dots::{plan, rig};
use raysweep_tests::{Bench, end_of, rig_text, wait_until};

fn field(error: &RpcError) -> Option<&str> {
    error.data.as_ref()?.field.as_deref()
}

fn pipe(path: &Path) {
    assert!(Command::new("mkfifo").arg(path).status().unwrap().success());
}

/// Calls `answer` on a thread of its own, so that a call that hangs fails the test.
fn answered<T: Send + 'static>(answer: impl FnOnce() -> T + Send + 'static) -> T {
    let thread = std::thread::spawn(answer);
    wait_until(|| thread.is_finished());
    thread.join().unwrap()
}

/// Checks and runs a plan; both must refuse it. Returns the error of `run`.
fn refused(bench: &Bench, plan: &str) -> RpcError {
    let (runner, plan) = (bench.runner.clone(), plan.to_owned());
    answered(move || {
        let checked = runner.check(&plan).unwrap_err();
        let error = runner.run(RunParams { plan, ..RunParams::default() }).unwrap_err();
        assert_eq!(checked, error);
        assert_eq!(runner.status().state, RunState::Idle);
        error
    })
}

#[test]
fn a_pattern_is_a_sound_file_in_a_folder_that_the_rig_file_allows() {
    let bench = Bench::dots(&format!("plan_folders = [\"patterns\"]\n{}", rig("")));
    let file = |name: &str| bench.folder.path().join(name);
    fs::create_dir(file("patterns")).unwrap();
    let sound = ndarray::Array2::<f32>::ones((4, 8));
    for name in ["patterns/sound.npy", "elsewhere.npy"] {
        ndarray_npy::write_npy(file(name), &sound).unwrap();
    }
    pipe(&file("patterns/pipe.npy"));
    symlink(file("elsewhere.npy"), file("patterns/link.npy")).unwrap();
    fs::File::create(file("patterns/sparse.npy")).unwrap().set_len(20 << 30).unwrap();
    let relit = |image: &str| plan(&format!("product = [{{ kind = \"relight\", image = {image:?} }}]"), 1);
    for image in [
        "pipe.npy",
        "link.npy",
        "sparse.npy",
        "../elsewhere.npy",
        file("elsewhere.npy").to_str().unwrap(),
        "/dev/zero",
        "/proc/self/environ",
        "missing.npy",
    ] {
        let error = refused(&bench, &relit(image));
        assert_eq!(
            (error.name(), field(&error)),
            (Some(ErrorCode::InvalidPlan), Some("product.0.image")),
            "{image}: {error}"
        );
        assert!(error.message.contains("plan_folders"), "{error}");
    }
    // 128 bytes that claim 100000 x 100000 x 3 numbers: the header is read when the run is prepared.
    let header = "{'descr': '<f4', 'fortran_order': False, 'shape': (100000, 100000, 3), }";
    let bomb = [b"\x93NUMPY\x01\x00\x76\x00".to_vec(), format!("{header:117}\n").into_bytes()].concat();
    fs::write(file("patterns/bomb.npy"), bomb).unwrap();
    let (runner, bad) = (bench.runner.clone(), relit("bomb.npy"));
    let error = answered(move || runner.run(RunParams { plan: bad, ..RunParams::default() }).unwrap_err());
    assert_eq!(error.name(), Some(ErrorCode::InvalidPlan), "{error}");
    for image in ["sound.npy", file("patterns/sound.npy").to_str().unwrap()] {
        bench.runner.check(&relit(image)).unwrap();
    }
}

#[test]
fn a_flat_field_is_in_a_session_of_the_data_folder_and_never_takes_the_memory() {
    let bench = Bench::dots(&rig(""));
    let sessions = bench.folder.path().join("sessions");
    let make = |folder: &Path| fs::create_dir_all(folder).unwrap();
    let outside = bench.folder.path().join("outside");
    for folder in [&outside, &sessions.join("sparse"), &sessions.join("pipe")] {
        make(folder);
    }
    fs::write(outside.join("ledger.jsonl"), "").unwrap();
    fs::File::create(sessions.join("sparse/ledger.jsonl")).unwrap().set_len(20 << 30).unwrap();
    pipe(&sessions.join("pipe/ledger.jsonl"));
    symlink(&outside, sessions.join("link")).unwrap();
    for name in ["sparse", "pipe", "link", "../outside", outside.to_str().unwrap(), "/proc/self"] {
        let stage = format!("[[stage]]\nname = \"correct\"\nflat_field = {name:?}\n");
        let error = refused(&bench, &(plan("", 1) + &stage));
        assert_eq!(field(&error), Some("stage.0.flat_field"), "{name}: {error}");
    }
    // Neither is a session of the list.
    let runner = bench.runner.clone();
    assert!(answered(move || runner.sessions()).unwrap().iter().all(|session| session.state == "unreadable"));
}

#[test]
fn what_lies_outside_of_the_data_folder_is_no_session() {
    let bench = Bench::new(&rig_text(720, "scene = \"v-groove\"\nscene_rows = 16\nscene_columns = 8\n", ""));
    let sweep = "kind = \"sweep\"\n[sweep]\ndelay_us = [0, 300]\nexposure_us = [600]\naverage = 1\n";
    let ended = bench.run(sweep);
    let (inside, outside) = (ended.session.clone(), bench.folder.path().join("outside"));
    assert!(Command::new("cp").arg("-r").args([&inside, &outside]).status().unwrap().success());
    // A torn line and a leftover, which resuming would remove.
    let ledger = fs::read_to_string(outside.join("ledger.jsonl")).unwrap() + "{\"torn";
    fs::write(outside.join("ledger.jsonl"), &ledger).unwrap();
    fs::write(outside.join("mine.raysweep-tmp"), "").unwrap();
    symlink(&outside, bench.folder.path().join("sessions/link")).unwrap();
    for given in ["link", "../outside", outside.to_str().unwrap(), "..", "", "/"] {
        let params = ResumeParams { session: given.into() };
        for error in [
            bench.runner.resume(params).unwrap_err(),
            bench.runner.use_calibration(given.as_ref()).unwrap_err(),
        ] {
            assert_eq!(error.name(), Some(ErrorCode::NoSession), "{given}: {error}");
        }
    }
    assert_eq!(fs::read_to_string(outside.join("ledger.jsonl")).unwrap(), ledger);
    assert!(outside.join("mine.raysweep-tmp").exists());
    // A link within a session would make the run write elsewhere.
    let victim = bench.folder.path().join("victim");
    fs::write(&victim, "mine").unwrap();
    fs::remove_file(inside.join("manifest.json")).unwrap();
    symlink(&victim, inside.join("manifest.json.raysweep-tmp")).unwrap();
    assert_eq!(bench.resume(&inside).state, "complete");
    assert_eq!(fs::read_to_string(&victim).unwrap(), "mine");
    symlink(bench.folder.path(), inside.join("patterns")).unwrap();
    let error = bench.runner.resume(ResumeParams { session: inside }).unwrap_err();
    assert!(error.message.contains("symbolic link"), "{error}");
}

#[test]
fn the_memory_of_all_products_is_foreseen_and_time_is_limited() {
    let bench = Bench::dots(&rig(""));
    let products = |count: usize| {
        let duals: Vec<_> = (0..count)
            .map(|n| format!("{{ kind = \"dual\", name = \"d{n}\", size_px = [8192, 8192] }}"))
            .collect();
        plan(&format!("product = [{}]", duals.join(", ")), 1)
    };
    let report = bench.runner.check(&products(12)).unwrap();
    assert!(report.memory_bytes > 8192 * 8192 * 4 * 5, "{} bytes", report.memory_bytes);
    assert!(report.disk_bytes > 12 * 8192 * 8192 * 8, "{} bytes", report.disk_bytes);
    let small = DotRig::load(&bench.folder.path().join("rig.toml")).unwrap();
    let small = Runner::new(small, bench.folder.path().join("small")).unwrap().with_memory_limit(1 << 30);
    let error = small.run(RunParams { plan: products(1), ..RunParams::default() }).unwrap_err();
    assert_eq!(error.name(), Some(ErrorCode::Storage), "{error}");
    assert!(!bench.folder.path().join("small").exists(), "a refused run leaves no session");

    let bench = Bench::new(&rig_text(720, "scene = \"v-groove\"\nscene_rows = 16\nscene_columns = 8\n", ""));
    let years = "kind = \"sweep\"\n[sweep]\ndelay_us = { start = -1500, stop = 1500, count = 1000 }\n\
                 exposure_us = [600]\naverage = 65536\n";
    let error = bench.runner.run(RunParams { plan: years.into(), ..RunParams::default() }).unwrap_err();
    assert_eq!(error.name(), Some(ErrorCode::InvalidPlan), "{error}");
    assert!(error.message.contains("hours"), "{error}");
}

/// A door that is shut until it is opened.
#[derive(Default)]
struct Door(Mutex<bool>, Condvar);

impl Door {
    fn pass(&self) {
        let mut open = self.0.lock().unwrap();
        while !*open {
            open = self.1.wait(open).unwrap();
        }
    }

    fn open(&self) {
        *self.0.lock().unwrap() = true;
        self.1.notify_all();
    }
}

const SWEEP: &str = "kind = \"sweep\"\n[sweep]\ndelay_us = { start = -900, stop = 900, count = 9 }\n\
                     exposure_us = [400, 800]\naverage = 2\n";

fn sim(realtime: bool) -> String {
    rig_text(
        720,
        &format!("scene = \"v-groove\"\nscene_rows = 16\nscene_columns = 8\nrealtime = {realtime}\n"),
        "",
    )
}

fn run(runner: &Runner) -> Result<(), RpcError> {
    runner.run(RunParams { plan: SWEEP.into(), ..RunParams::default() }).map(drop)
}

#[test]
fn a_run_that_is_prepared_can_be_cancelled_and_does_not_hold_the_daemon() {
    for ends in [false, true] {
        let door = Arc::new(Door::default());
        let behind = door.clone();
        let probes = Probes { preparing: Some(Arc::new(move || behind.pass())), ..Probes::default() };
        let bench = Bench::with_probes(&sim(false), probes);
        let runner = bench.runner.clone();
        let started = std::thread::spawn(move || run(&runner));
        wait_until(|| bench.runner.status().state == RunState::Preparing);
        let runner = bench.runner.clone();
        answered(move || if ends { runner.shut_down() } else { runner.cancel().unwrap() });
        assert!(!started.is_finished(), "the preparation still waits");
        door.open();
        let error = started.join().unwrap().unwrap_err();
        assert_eq!(error.name(), Some(ErrorCode::NotRunning), "{error}");
        assert_eq!(bench.runner.status().state, RunState::Idle);
        assert!(!bench.folder.path().join("sessions").exists(), "nothing was stored");
        if !ends {
            let mut events = bench.runner.events();
            run(&bench.runner).unwrap();
            assert_eq!(end_of(&mut events).state, "complete");
        }
    }
}

/// Orders at random moments of random runs. The longest times are printed.
#[test]
fn every_state_answers_to_cancel_and_to_the_end_of_the_daemon() {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(17);
    let (mut states, mut answer, mut end) =
        (std::collections::BTreeMap::new(), Duration::ZERO, Duration::ZERO);
    for round in 0..60 {
        let bench = Bench::new(&sim(round % 3 == 0));
        let mut events = bench.runner.events();
        run(&bench.runner).unwrap();
        let moment = Duration::from_millis(random.next_u64() % if round % 3 == 0 { 900 } else { 120 });
        std::thread::sleep(moment);
        if random.next_u64() % 3 == 0 && bench.runner.pause().is_ok() && random.next_u64() % 2 == 0 {
            std::thread::sleep(Duration::from_millis(random.next_u64() % 50));
        }
        let state = bench.runner.status().state;
        *states.entry(format!("{state:?}")).or_insert(0) += 1;
        let cancels = random.next_u64() % 2 == 0;
        let runner = bench.runner.clone();
        let began = Instant::now();
        let answered = answered(move || {
            if cancels {
                return runner.cancel().is_ok();
            }
            runner.shut_down();
            true
        });
        if cancels {
            answer = answer.max(began.elapsed());
        }
        let ended = end_of(&mut events);
        end = end.max(began.elapsed());
        assert!(["complete", "cancelled"].contains(&ended.state.as_str()), "{ended:?} after {state:?}");
        assert!(ended.state == "complete" || answered, "{state:?}");
        let runner = bench.runner.clone();
        self::answered(move || runner.shut_down());
        assert!([RunState::Idle, RunState::Faulted].contains(&bench.runner.status().state));
        assert_eq!(run(&bench.runner).unwrap_err().name(), Some(ErrorCode::Busy), "it has ended");
        assert!(ended.open().1.counts.balanced());
    }
    println!("states {states:?}; longest answer to cancel {answer:.3?}, longest end of a run {end:.3?}");
}

#[test]
fn during_a_run_plans_are_not_computed_for_clients() {
    let bench = Bench::new(&sim(true));
    let known = bench.runner.check(SWEEP).unwrap();
    let mut events = bench.runner.events();
    // It goes on until it is cancelled.
    let plan = SWEEP.replace("average = 2", "average = 2000");
    bench.runner.run(RunParams { plan, ..RunParams::default() }).unwrap();
    let other = SWEEP.replace("average = 2", "average = 3");
    let (busy, kept) = (bench.runner.check(&other), bench.runner.check(SWEEP));
    let design = bench.runner.design(&raysweep_proto::DesignParams {
        plan: SWEEP.into(),
        light_s: Some(1.0),
        ..Default::default()
    });
    bench.runner.status();
    bench.runner.sessions().unwrap();
    bench.runner.cancel().unwrap();
    end_of(&mut events);
    assert_eq!(busy.unwrap_err().name(), Some(ErrorCode::Busy));
    assert_eq!(design.unwrap_err().name(), Some(ErrorCode::Busy));
    let kept = kept.unwrap();
    assert_eq!(
        (kept.points, kept.frames, kept.warnings.len()),
        (known.points, known.frames, known.warnings.len() + 1)
    );
    bench.runner.check(&other).unwrap();
}
