//! What the real daemon's runs leave for later: their warnings, and their plans to be run again.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod daemon;
mod process;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use daemon::{Daemon, end, plan};
use raysweep_session::Session;
use serde_json::Value;
use tempfile::TempDir;

const DOTS: &str = "kind = \"dots\"\n[camera]\ndriver = \"sim\"\n[mirror]\ndriver = \"sim\"\n\
                    [sim.dots]\nscene = \"v-groove\"\nrows = 112\ncolumns = 128\nmargin_rows = 16\nseed = 5\n";
const BATCHES: &str = "kind = \"batches\"\nname = \"dots\"\nproduct = [{ kind = \"floodlit\" }]\n\
                       [batches]\ncount = 1\ndots = 300\nexposure_us = 100\ndark_frames = 64\n\
                       trailing_region = [112, 128, 48, 80]\nbackground_indices = [0]\ncalibration = []\n\
                       [batches.path]\nshape = \"lissajous\"\ncycles = [7, 1]\namplitude_deg = [2.3, 1.3]\n\
                       samples = 1500\nrate_hz = 30000\n";
const PLANE: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n\
                     [projector]\ndriver = \"sim\"\nrows = 8\n\
                     [sim]\nscene = \"v-groove\"\nscene_rows = 8\nscene_columns = 8\nseed = 1\n";
const SWEEP: &str = "kind = \"sweep\"\nname = \"again\"\n[sweep]\naverage = 1\n\
                     delay_us = [-60, 0, 60]\nexposure_us = [50, 100]\n";

fn folder(rig: &str) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    fs::write(folder.path().join("rig.toml"), rig).unwrap();
    folder
}

/// A command of somebody at the daemon's machine.
fn raysweep(daemon: &mut Daemon, arguments: &[&str]) -> Output {
    // It listens.
    drop(daemon.client());
    let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
    let output = command.env("RAYSWEEP_SOCKET", &daemon.socket).args(arguments).output().unwrap();
    assert!(output.status.success(), "{arguments:?}: {output:?}");
    output
}

fn text(bytes: Vec<u8>) -> String {
    String::from_utf8(bytes).unwrap()
}

fn json(daemon: &mut Daemon, arguments: &[&str]) -> Value {
    serde_json::from_slice(&raysweep(daemon, &[arguments, &["--json"]].concat()).stdout).unwrap()
}

fn name(session: &Path) -> &str {
    session.file_name().unwrap().to_str().unwrap()
}

#[test]
fn the_warnings_of_a_run_are_told_after_a_restart_of_the_daemon() {
    let folder = folder(DOTS);
    let mut daemon = Daemon::start(folder.path());
    // It finds no video encoder, which it knows only when it has made the products.
    let (session, state) = end(&mut daemon, |client| drop(client.run(&plan(BATCHES)).unwrap()));
    assert_eq!(state, "complete");
    let told = daemon.client().status().unwrap().warnings;
    assert_eq!(told.iter().filter(|warning| warning.starts_with("ffmpeg is not installed")).count(), 1);
    daemon.kill();

    let mut daemon = Daemon::start(folder.path());
    assert!(daemon.client().status().unwrap().warnings.is_empty());
    let shown = text(raysweep(&mut daemon, &["show", name(&session)]).stdout);
    assert!(shown.contains("\nwarning    ffmpeg is not installed"), "{shown}");
    assert_eq!(json(&mut daemon, &["show", name(&session)])["warnings"], serde_json::json!(told));
    let listed = text(raysweep(&mut daemon, &["sessions"]).stdout);
    let (count, s) = (told.len(), if told.len() == 1 { "" } else { "s" });
    assert!(listed.contains(&format!("complete, {count} warning{s} ")), "{listed}");
    assert_eq!(json(&mut daemon, &["sessions"])[0]["warnings"], serde_json::json!(told));
    let page = fs::read_to_string(session.join("report.html")).unwrap();
    assert_eq!(page.matches("ffmpeg is not installed").count(), 1, "no warning is said twice");
}

/// What `rerun` of a session says, and the session that it makes.
fn rerun(daemon: &mut Daemon, session: &Path) -> (String, PathBuf) {
    let output = raysweep(daemon, &["rerun", name(session)]);
    let sessions = daemon.client().sessions().unwrap();
    let newest = sessions.last().unwrap();
    assert_eq!(newest.state, "complete");
    assert!(text(output.stdout).contains("complete: 6 of 6 points stored"));
    (text(output.stderr), newest.session.clone())
}

#[test]
fn a_session_is_run_again_with_its_plan_and_metadata_and_what_changed_on_the_rig_is_said() {
    let folder = folder(PLANE);
    let plan = folder.path().join("plan.toml");
    fs::write(&plan, SWEEP).unwrap();
    let mut daemon = Daemon::start(folder.path());
    let about =
        ["--operator", "Ada", "--sample", "candle", "--note", "third try", "--tag", "a", "--tag", "b"];
    raysweep(&mut daemon, &[&["run", plan.to_str().unwrap()], &about[..]].concat());
    let first = daemon.client().sessions().unwrap()[0].session.clone();
    // What somebody has made of the plan's file since is of no account.
    fs::write(&plan, SWEEP.replace("average = 1", "average = 2")).unwrap();
    let (said, second) = rerun(&mut daemon, &first);
    assert!(said.contains("nothing on the rig has changed since"), "{said}");
    daemon.kill();

    let other = PLANE.replace("seed = 1", "seed = 2") + "[sim.ambient]\nlevel = 0.01\n";
    fs::write(folder.path().join("rig.toml"), other).unwrap();
    let mut daemon = Daemon::start(folder.path());
    let (said, third) = rerun(&mut daemon, &second);
    let changed = ["rig.toml: sim.ambient.level = 0.01, was not given", "rig.toml: sim.seed = 2, was 1"];
    let changed = format!("changed since: {}\n               {}\n", changed[0], changed[1]);
    assert!(said.contains(&changed) && !said.contains("nothing"), "{said}");

    let known = |session: &Path| {
        let entry = Session::open(session).unwrap().state().unwrap().session;
        let plan = fs::read_to_string(session.join("plan.toml")).unwrap();
        (plan, entry.name, entry.operator, entry.sample, entry.note, entry.tags)
    };
    let [operator, sample, note] = ["Ada", "candle", "third try"].map(|word| Some(word.to_owned()));
    let tags = vec!["a".to_owned(), "b".to_owned()];
    assert_eq!(known(&third), (SWEEP.to_owned(), "again".to_owned(), operator, sample, note, tags));
    assert_eq!(known(&second), known(&first));
    assert_eq!(known(&third), known(&first));
    let frames = |session: &Path| fs::read(session.join("products/epipolar.npy")).unwrap();
    assert!(frames(&first) == frames(&second) && frames(&second) != frames(&third), "the rig's seed");
}
