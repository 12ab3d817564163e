//! What the real daemon's runs leave for later: their warnings.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod daemon;
mod process;

use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use daemon::{Daemon, end, plan};
use serde_json::Value;
use tempfile::TempDir;

const DOTS: &str = "kind = \"dots\"\n[camera]\ndriver = \"sim\"\n[mirror]\ndriver = \"sim\"\n\
                    [sim.dots]\nscene = \"v-groove\"\nrows = 112\ncolumns = 128\nmargin_rows = 16\nseed = 5\n";
const BATCHES: &str = "kind = \"batches\"\nname = \"dots\"\nproduct = [{ kind = \"floodlit\" }]\n\
                       [batches]\ncount = 1\ndots = 300\nexposure_us = 100\ndark_frames = 64\n\
                       trailing_region = [112, 128, 48, 80]\nbackground_indices = [0]\ncalibration = []\n\
                       [batches.path]\nshape = \"lissajous\"\ncycles = [7, 1]\namplitude_deg = [2.3, 1.3]\n\
                       samples = 1500\nrate_hz = 30000\n";
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
