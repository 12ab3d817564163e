//! The real daemon in a separate process: killed after any line of the ledger, asked to terminate, activated by a socket.
//! `kills` kills it at any moment.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod daemon;
mod outcome;
mod process;

use std::path::Path;
use std::process::{Command, Stdio};

use daemon::{Daemon, end, plan, wait_for_line};
use outcome::{Outcome, outcome};
use process::Process;
use raysweep_proto::{ClientError, ErrorCode, Event};
use raysweep_session::Session;
use raysweep_session::film::TransportFilm;
use raysweep_session::ledger::{PointEntry, State};
use raysweep_session::stack::ArrayName;
use tempfile::TempDir;

/// With delays that frames' timestamps tell apart, because the camera does not say when its settings act.
const FILM: &str =
    "kind = \"film\"\n[film]\ncycles = 80000\ndelay_us = { start = -1500, stop = 1500, count = 15 }\n";
/// 8 x 8 pixels, 9 points, and all faults whose effects could differ after a crash.
const RIG: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n\
                   [projector]\ndriver = \"sim\"\nrows = 8\n\
                   [sim]\nscene = \"v-groove\"\nscene_rows = 8\nscene_columns = 8\nseed = 11\n\
                   [sim.vsync]\nmissing = 0.02\nfalse_edges = 0.02\nunseen = 0.02\n\
                   [sim.camera]\nlate_frames_max = 3\ndropped = 0.02\n\
                   [sim.ambient]\nlevel = 0.001\nflicker = 0.5\nphase = \"drawn\"\n\
                   [sim.projector]\nphase_jitter_us = 5\n";
const PLAN: &str = "kind = \"sweep\"\nname = \"crash\"\n[sweep]\naverage = 2\n\
                    delay_us = [-60, 0, 60]\nexposure_us = [50, 100, 150]\n";

fn folder(rig: &str) -> TempDir {
    folder_in(&std::env::temp_dir(), rig)
}

fn folder_in(parent: &Path, rig: &str) -> TempDir {
    let folder = tempfile::tempdir_in(parent).unwrap();
    std::fs::write(folder.path().join("rig.toml"), rig).unwrap();
    folder
}

fn stored(session: &Path) -> Option<State> {
    Session::open(session).and_then(|session| session.state()).ok()
}

/// Kills a run after `line` lines of its ledger, resumes it, and compares the outcome with that of an uninterrupted
/// run.
fn resumes_to_the_same_bits(rig: &str, plan_text: &str, line: usize) {
    let (whole, crashed) = (folder(rig), folder(rig));
    let mut daemon = Daemon::start(whole.path());
    let (session, state) = end(&mut daemon, |client| drop(client.run(&plan(plan_text)).unwrap()));
    assert_eq!(state, "complete");
    let expected = outcome(&session);
    daemon.kill();
    let mut daemon = Daemon::start(crashed.path());
    let session = daemon.client().run(&plan(plan_text)).unwrap().session;
    wait_for_line(&session, line);
    daemon.kill();
    let mut daemon = Daemon::start(crashed.path());
    let (session, state) = end(&mut daemon, |client| drop(client.resume(&session).unwrap()));
    assert_eq!(state, "complete");
    let resumed = outcome(&session);
    assert_eq!(resumed.points, expected.points, "killed after line {line}");
    assert!(resumed.files == expected.files, "killed after line {line}: the products differ");
}

/// Faults are more frequent than in [`RIG`], so that attempts fail, and are interrupted, in every way.
fn faulty_rig(seed: u64) -> String {
    RIG.replace("0.02", "0.06").replace("seed = 11", &format!("seed = {seed}"))
}

const OVERLAPPED: &str = "overlapped readout";

/// Cameras that differ in when settings take effect and in what frames report about them.
fn cameras(rig: &str) -> [(&'static str, String); 5] {
    let late = "late_frames_max = 3";
    let silent = format!("{late}\nchunk_exposure = false");
    let constant = format!("late_frames_min = 3\n{silent}");
    let overlapped = "[sim.camera]\nreadout = \"overlapped\"\nreadout_us = 9000\n";
    [
        ("late now and then", rig.to_owned()),
        ("late now and then, frames do not say their exposure", rig.replace(late, &silent)),
        ("always late, frames do not say their exposure", rig.replace(late, &constant)),
        ("never late", rig.replace(late, "late_frames_max = 0")),
        (OVERLAPPED, rig.replace("[sim.camera]\n", overlapped)),
    ]
}

/// The same points with exposures so long that they start before the edge of their light: an earlier edge triggers
/// them.
fn light_after_the_trigger() -> String {
    PLAN.replace("[50, 100, 150]", "[1200, 1500, 1800]")
}

/// Runs a plan, then resumes its session from every line of its ledger, as if the run had been killed just after that
/// line. Returns each outcome with its line; the first is that of the uninterrupted run.
fn outcomes_from_every_line(rig: &str, plan_text: &str) -> Vec<(usize, Outcome)> {
    // In memory: no process is killed here, and syncing each line to a disk would take ten times as long.
    let folder = folder_in(Path::new("/dev/shm"), rig);
    let mut daemon = Daemon::start(folder.path());
    let (session, state) = end(&mut daemon, |client| drop(client.run(&plan(plan_text)).unwrap()));
    assert_eq!(state, "complete");
    let ledger = std::fs::read_to_string(session.join("ledger.jsonl")).unwrap();
    let lines: Vec<&str> = ledger.split_inclusive('\n').collect();
    let mut outcomes = vec![(lines.len(), outcome(&session))];
    for kept in 1..lines.len() {
        std::fs::write(session.join("ledger.jsonl"), lines[..kept].concat()).unwrap();
        let _ = std::fs::remove_dir_all(session.join("products"));
        let (session, state) = end(&mut daemon, |client| drop(client.resume(&session).unwrap()));
        assert_eq!(state, "complete", "resumed after line {kept}");
        outcomes.push((kept, outcome(&session)));
    }
    outcomes
}

/// Cases to try: every camera, with seeds that have found bugs. `RAYSWEEP_SEEDS=40` adds 40 seeds for each camera.
fn trials() -> Vec<(&'static str, String, u64)> {
    let (short, long) = (PLAN.to_owned(), light_after_the_trigger());
    let mut trials = vec![
        ("late now and then", short.clone(), 14),
        ("late now and then, frames do not say their exposure", short.clone(), 12),
        ("always late, frames do not say their exposure", short.clone(), 13),
        (OVERLAPPED, short.clone(), 14),
        ("never late", long.clone(), 14),
    ];
    let more = std::env::var("RAYSWEEP_SEEDS").map_or(0, |seeds| seeds.parse().unwrap());
    for seed in 100..100 + more {
        for (camera, _) in cameras("") {
            trials.push((camera, short.clone(), seed));
            // Overlapped readout is the exception tested below.
            if camera != OVERLAPPED {
                trials.push((camera, long.clone(), seed));
            }
        }
    }
    trials
}

#[test]
fn a_session_resumed_from_any_line_of_its_ledger_ends_with_the_same_bits() {
    for (name, plan, seed) in trials() {
        let cameras = cameras(&faulty_rig(seed));
        let (_, rig) = cameras.iter().find(|(camera, _)| *camera == name).unwrap();
        let outcomes = outcomes_from_every_line(rig, &plan);
        let (_, whole) = &outcomes[0];
        for (line, resumed) in &outcomes[1..] {
            let what = format!("{name}, seed {seed}, resumed after line {line}");
            assert_eq!(resumed.points, whole.points, "{what}: {plan}");
            assert!(resumed.files == whole.files, "{what}: products differ: {plan}");
        }
    }
}

/// An exception: with overlapped readout, the edge that lights a point's last frame may already trigger the next
/// point's first frame, and which point is next depends on the interruption. If no such edge is missed, attempts and
/// frames are nevertheless the same, and so is the delay of every frame but the last.
#[test]
fn light_that_the_next_point_triggers_changes_the_last_delay_of_a_point_and_no_more() {
    let points = |outcome: &Outcome| -> Vec<PointEntry> {
        outcome.points.iter().map(|point| serde_json::from_str(point).unwrap()).collect()
    };
    let mut differing = 0;
    for seed in [12, 13] {
        let late = faulty_rig(seed)
            .replace("missing = 0.06", "missing = 0")
            .replace("unseen = 0.06", "unseen = 0")
            .replace("late_frames_max", "late_frames_min = 3\nlate_frames_max");
        let rig =
            late.replace("[sim.camera]\n", "[sim.camera]\nreadout = \"overlapped\"\nreadout_us = 9000\n");
        let outcomes = outcomes_from_every_line(&rig, &light_after_the_trigger());
        let whole = points(&outcomes[0].1);
        for (line, resumed) in &outcomes[1..] {
            for (was, is) in whole.iter().zip(points(resumed)) {
                let what = format!("seed {seed}, resumed after line {line}: {is:?}");
                assert_eq!((was.attempt, was.frames), (is.attempt, is.frames), "{what}");
                let last = was.delays_us.len().saturating_sub(1);
                assert_eq!(was.delays_us[..last], is.delays_us[..last], "{what}");
                differing += usize::from(was.delays_us != is.delays_us);
                // Where that delay is the same, so are the counts.
                assert!(was.delays_us != is.delays_us || was.crc32 == is.crc32, "{what}");
            }
        }
    }
    assert_ne!(differing, 0, "there is no exception any more: ARCHITECTURE.md says that there is");
}

#[test]
fn cameras_that_are_busy_at_the_edge_resume_to_the_same_bits_too() {
    // Overlapped readout: triggers are accepted while the previous frame is still being read out.
    let overlapped =
        RIG.replace("[sim.camera]\n", "[sim.camera]\nreadout = \"overlapped\"\nreadout_us = 9000\n");
    // The scene at the end of the projector frame: exposures end, and settings are written, just before the next edge.
    let late = RIG
        .replace("late_frames_max = 3", "late_frames_max = 0")
        .replace("rows = 8\n[sim]", "rows = 720\n[sim]")
        .replace("[camera]\n", "[camera]\nfirst_projector_row = 706\n");
    assert_ne!(late, RIG);
    let late_plan = PLAN.replace("[-60, 0, 60]", "[-150, -100, -50]");
    for line in [3, 7, 8, 9, 10, 11, 13] {
        resumes_to_the_same_bits(&overlapped, PLAN, line);
        resumes_to_the_same_bits(&late, &late_plan, line);
    }
}

#[test]
fn cameras_that_say_nothing_of_the_exposure_resume_to_the_same_bits_too() {
    // Which of a point's frames count must not depend on the previous point, which a resumed run may not have acquired.
    let late = "late_frames_max = 3\nchunk_exposure = false";
    let varying = RIG.replace("late_frames_max = 3", late);
    let constant = RIG.replace("late_frames_max = 3", &format!("late_frames_min = 3\n{late}"));
    for line in [8, 9, 10, 12, 14] {
        resumes_to_the_same_bits(&varying, PLAN, line);
        resumes_to_the_same_bits(&constant, PLAN, line);
    }
}

#[test]
fn the_same_seed_gives_the_same_bits_with_one_thread_and_with_two() {
    let [one, two] = [1, 2].map(|threads| {
        let folder = folder(RIG);
        let mut daemon = Daemon::start_with_threads(folder.path(), threads);
        let (session, state) = end(&mut daemon, |client| drop(client.run(&plan(PLAN)).unwrap()));
        assert_eq!(state, "complete");
        daemon.kill();
        let ledger = std::fs::read_to_string(session.join("ledger.jsonl")).unwrap();
        let timeless = ledger.lines().map(|line| {
            let mut entry: serde_json::Value = serde_json::from_str(line).unwrap();
            let entry = entry.as_object_mut().unwrap();
            entry.remove("created");
            entry.remove("started");
            entry.remove("final_s");
            // It covers the times.
            entry.remove("chain");
            serde_json::to_string(entry).unwrap()
        });
        let transport = std::fs::read(session.join("transport.zarr/transport/c.0.0.0")).unwrap();
        (outcome(&session), timeless.collect::<Vec<_>>(), transport)
    });
    assert!(one == two, "the sessions differ");
}

#[test]
fn sigterm_ends_a_run_in_order_and_keeps_what_was_acquired() {
    let folder = folder(&RIG.replace("seed = 11", "seed = 11\nrealtime = true"));
    let mut daemon = Daemon::start(folder.path());
    let events = daemon.client().subscribe().unwrap();
    daemon.client().run(&plan(&PLAN.replace("average = 2", "average = 20"))).unwrap();
    let (mut is_asked, mut finished) = (false, None);
    for event in events {
        match event.unwrap() {
            Event::Progress(progress) if !is_asked && progress.points_stored >= 2 => {
                daemon.terminate();
                is_asked = true;
            }
            Event::Finished { session, state, .. } => {
                finished = Some((session, state));
                break;
            }
            _ => {}
        }
    }
    let (session, state) = finished.expect("subscribers learn how the run ended");
    assert_eq!(state, "cancelled");
    assert!(daemon.process.wait().success());
    let state = stored(&session).unwrap();
    assert!(state.stored(ArrayName::Dark).count() + state.stored(ArrayName::Sum).count() >= 1);
    assert!(state.counts.balanced(), "{:?}", state.counts);
    let resumed = {
        let mut daemon = Daemon::start(folder.path());
        let (resumed, end) = end(&mut daemon, |client| drop(client.resume(&session).unwrap()));
        assert_eq!(end, "complete");
        resumed
    };
    assert!(raysweep_session::manifest::verify(&Session::open(&resumed).unwrap()).unwrap().is_empty());
}

/// The exit code and output of a command that needs no daemon.
fn raysweep(arguments: &[&str], session: &Path) -> (i32, String, String) {
    let output = Command::new(env!("CARGO_BIN_EXE_raysweep")).args(arguments).arg(session).output().unwrap();
    let text = |bytes: Vec<u8>| String::from_utf8(bytes).unwrap();
    (output.status.code().unwrap(), text(output.stdout), text(output.stderr))
}

#[test]
fn a_damaged_session_fails_verify_and_process_until_the_damage_is_accepted() {
    let folder = folder(RIG);
    let mut daemon = Daemon::start(folder.path());
    let (session, _) = end(&mut daemon, |client| drop(client.run(&plan(PLAN)).unwrap()));
    daemon.kill();
    let (exit, out, _) = raysweep(&["verify"], &session);
    assert_eq!((exit, out.as_str()), (0, "nothing is damaged; 9 of 9 points are stored\n"));
    std::fs::remove_file(session.join("stack.zarr/sum/c.4.0.0")).unwrap();
    let before = outcome(&session).files;
    let (exit, out, _) = raysweep(&["verify"], &session);
    assert!(exit == 1 && out.contains("sum 4 is damaged") && out.contains("1 damaged"), "{exit} {out}");
    let (exit, out, _) = raysweep(&["verify", "--json"], &session);
    let json: serde_json::Value = serde_json::from_str(&out).unwrap();
    assert_eq!((exit, &json["audit"]["damage"][0]["index"]), (1, &serde_json::json!(4)), "{json}");
    let (exit, _, err) = raysweep(&["process"], &session);
    assert!(exit == 1 && err.contains("sum 4 is damaged") && err.contains("--accept-damage"), "{exit} {err}");
    assert!(outcome(&session).files == before, "the products are kept");
    let (exit, out, _) = raysweep(&["process", "--accept-damage"], &session);
    assert!(exit == 0 && out.contains("made from what is stored: 8 of 9"), "{exit} {out}");
}

#[test]
fn results_of_a_processing_that_was_killed_before_its_manifest_are_sound_once_made_again() {
    let folder = folder(RIG);
    let epipolar = |width| format!("{PLAN}[[product]]\nkind = \"epipolar\"\nwidth_rows = {width}\n");
    let mut daemon = Daemon::start(folder.path());
    let (session, _) = end(&mut daemon, |client| drop(client.run(&plan(&epipolar(3))).unwrap()));
    daemon.kill();
    let manifest = std::fs::read(session.join("manifest.json")).unwrap();
    std::fs::write(session.join("plan.toml"), epipolar(5)).unwrap();
    assert_eq!(raysweep(&["process", "--accept-edits"], &session).0, 0);
    std::fs::write(session.join("manifest.json"), manifest).unwrap();
    let (exit, out, _) = raysweep(&["verify"], &session);
    assert!(exit == 1 && out.contains("products/epipolar"), "{exit} {out}");
    // The same bytes as before, so that they alone do not tell that they are new.
    assert_eq!(raysweep(&["process"], &session).0, 0);
    let (exit, out, _) = raysweep(&["verify"], &session);
    assert_eq!((exit, out.as_str()), (0, "nothing is damaged; 9 of 9 points are stored\n"));
}

#[test]
fn a_socket_passed_by_the_service_manager_is_served() {
    let folder = folder(RIG);
    let path = folder.path().join("activated");
    // The service manager's own helper passes the socket and LISTEN_FDS, and starts the daemon on the first connection.
    let mut command = Command::new("systemd-socket-activate");
    command
        .arg("--listen")
        .arg(&path)
        .arg(env!("CARGO_BIN_EXE_raysweepd"))
        .arg("--rig")
        .arg(folder.path().join("rig.toml"))
        .arg("--data")
        .arg(folder.path().join("sessions"))
        .stderr(Stdio::null());
    let mut daemon = Daemon { process: Process::start(&mut command), socket: path };
    assert_eq!(daemon.client().status().unwrap().rig, "plane");
    daemon.terminate();
    assert!(daemon.process.wait().success());
}

#[test]
fn a_film_that_is_killed_keeps_its_cycles_and_is_processed_not_resumed() {
    let folder = folder(RIG);
    let mut daemon = Daemon::start(folder.path());
    let started = daemon.client().run(&plan(FILM)).unwrap();
    wait_for_line(&started.session, 30);
    daemon.kill();

    let session = Session::open(&started.session).unwrap();
    let state = session.state().unwrap();
    assert!(state.end.is_none() && state.cycles().count() > 5, "{} cycles", state.cycles().count());
    let mut daemon = Daemon::start(folder.path());
    let refused = daemon.client().resume(&started.session).unwrap_err();
    let ClientError::Rpc(refused) = refused else { panic!("{refused}") };
    assert_eq!(refused.name(), Some(ErrorCode::NoSession), "{refused}");
    drop(daemon);

    let processed = raysweep_processing::process(&started.session).unwrap();
    assert_eq!((processed.stored, processed.problems), (state.cycles().count(), Vec::new()));
    let transports = TransportFilm::open(&session.transport_film_path()).unwrap();
    for cycle in state.cycles() {
        assert!(transports.read(cycle.cycle).unwrap().is_some(), "cycle {} has no transport", cycle.cycle);
    }
    assert!(raysweep_session::manifest::verify(&session).unwrap().is_empty());
}
