//! `raysweep watch` while its daemon is killed and started again.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod daemon;
mod process;

use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use daemon::{Daemon, end, plan};
use nix::sys::signal::Signal;
use process::{Process, wait_for};
use raysweep_proto::RunState;
use tempfile::TempDir;

const RIG: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n\
                   [projector]\ndriver = \"sim\"\nrows = 8\n\
                   [sim]\nscene = \"v-groove\"\nscene_rows = 8\nscene_columns = 8\n";
const PLAN: &str = "kind = \"sweep\"\nname = \"watched\"\n[sweep]\naverage = 1000\n\
                    delay_us = [-60, 0, 60]\nexposure_us = [50, 100, 150]\n";
const FILM: &str = "kind = \"film\"\n[film]\ncycles = 1000\ndelay_us = [-60, 0, 60]\nexposure_us = 100\n";

fn folder() -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("rig.toml"), RIG).unwrap();
    folder
}

/// A run that is paused.
fn paused(daemon: &mut Daemon, text: &str) -> PathBuf {
    let mut client = daemon.client();
    let session = client.run(&plan(text)).unwrap().session;
    wait_for("a run that can be paused", || client.pause().ok());
    wait_for("the pause", || (client.status().unwrap().state == RunState::Paused).then_some(()));
    session
}

/// `raysweep watch` of the daemon of a folder, with what it says in files there.
fn watch(folder: &Path) -> Process {
    let say = |name: &str| File::create(folder.join(name)).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
    command.arg("--socket").arg(folder.join("socket")).arg("watch");
    Process::start(command.stdin(Stdio::null()).stdout(say("output")).stderr(say("notes")))
}

fn wait_until_said(folder: &Path, words: &str) {
    let said = || std::fs::read_to_string(folder.join("notes")).unwrap().contains(words);
    wait_for(words, || said().then_some(()));
}

/// A daemon that was killed during a pause while it was watched: its folder, the session and the watcher.
fn killed_while_watched(text: &str) -> (TempDir, PathBuf, Process) {
    let folder = folder();
    let mut daemon = Daemon::start(folder.path());
    let session = paused(&mut daemon, text);
    let watch = watch(folder.path());
    wait_until_said(folder.path(), "paused");
    daemon.kill();
    wait_until_said(folder.path(), "the daemon is gone");
    (folder, session, watch)
}

fn output(folder: &Path) -> String {
    std::fs::read_to_string(folder.join("output")).unwrap()
}

#[test]
fn a_run_is_watched_to_its_end_across_a_restart_of_the_daemon() {
    let (folder, session, mut watch) = killed_while_watched(PLAN);
    let mut daemon = Daemon::start(folder.path());
    let (_, state) = end(&mut daemon, |client| drop(client.resume(&session).unwrap()));
    assert_eq!(state, "complete");
    assert_eq!(watch.wait().code(), Some(0));
    let output = output(folder.path());
    assert!(output.starts_with("complete: "), "{output}");
}

#[test]
fn a_run_that_nobody_goes_on_with_is_said_to_be_incomplete() {
    let (folder, session, mut watch) = killed_while_watched(PLAN);
    let _daemon = Daemon::start(folder.path());
    assert_eq!(watch.wait().code(), Some(3));
    let name = session.file_name().unwrap().to_str().unwrap();
    let output = output(folder.path());
    assert!(output.contains(&format!("`raysweep resume {name}`")), "{output}");
}

#[test]
fn a_film_that_was_cut_off_is_not_said_to_be_resumed() {
    let (folder, _session, mut watch) = killed_while_watched(FILM);
    let _daemon = Daemon::start(folder.path());
    assert_eq!(watch.wait().code(), Some(3));
    let output = output(folder.path());
    assert!(output.starts_with("unfinished: ") && !output.contains("resume"), "{output}");
}

#[test]
fn ctrl_c_ends_the_wait_for_a_daemon() {
    let (_folder, _session, mut watch) = killed_while_watched(PLAN);
    watch.signal(Signal::SIGINT);
    assert_eq!(watch.wait().code(), Some(0));
}
