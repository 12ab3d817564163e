//! The rehearsal of docs/commissioning.md: commands that stand in it lead from a camera on the network to a calibrated
//! sweep, and find what the rig file does not say.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot go on may panic")]

mod process;
mod wire_rig;

use std::fs;
use std::process::{Command, Output, Stdio};

use nix::sys::signal::Signal;
use process::{Process, wait_for};
use raysweep_proto::Client;
use raysweep_session::Session;
use serde_json::Value;
use wire_rig::WireRig;

const GUIDE: &str = include_str!("../../docs/commissioning.md");
/// What the guide says to answer, and its defaults.
const ANSWERS: &str = "kind = 'plane'\ncamera = 'genicam:127.0.0.1'\nprojector_rows = 132\nprojector = 'bench'\nvsync = 'bench'\n\
    trigger_latency_us = 8\nrow_time_us = 22.22\nfirst_row_us = 2200\nscene_rows = 128\n";

/// A command of the guide.
fn command(rig: &WireRig, line: &str) -> Command {
    let (_, rehearsal) = GUIDE.split_once("\n## Rehearse\n").expect("a rehearsal");
    assert!(rehearsal.contains(line), "the guide does not say: {line}");
    let mut words = line.split(' ');
    let program = match words.next().unwrap() {
        "raysweep" => env!("CARGO_BIN_EXE_raysweep"),
        "raysweepd" => env!("CARGO_BIN_EXE_raysweepd"),
        other => panic!("{other}"),
    };
    let socket = rig.path("socket");
    let mut command = Command::new(program);
    command.args(words.map(|word| word.replace("$RAYSWEEP_SOCKET", socket.to_str().unwrap())));
    command.current_dir(rig.path("")).env("RAYSWEEP_SOCKET", &socket).stdin(Stdio::null());
    command
}

/// The output of a command of the guide that succeeds.
fn succeeds(rig: &WireRig, line: &str, more: &[&str]) -> Output {
    let output = command(rig, line).args(more).output().unwrap();
    assert!(output.status.success(), "{line}: {output:?}");
    output
}

#[test]
fn the_commissioning_guides_rehearsal_finds_the_rig_and_sweeps_with_it() {
    let rig = WireRig::start(include_str!("../../deploy/rigs/rehearsal.toml"), &[], 9000);
    fs::write(rig.path("answers.toml"), ANSWERS).unwrap();
    succeeds(&rig, "raysweep setup --rig my-rig.toml --plan first-plan.toml", &["--answers", "answers.toml"]);
    succeeds(&rig, "raysweep doctor --rig my-rig.toml --data sessions", &[]);
    let line = "raysweepd --rig my-rig.toml --socket $RAYSWEEP_SOCKET --data sessions";
    let _daemon = Process::start(command(&rig, line).stderr(Stdio::null()));
    let mut client = wait_for("the daemon does not listen", || Client::connect(rig.path("socket")).ok());

    let line = "raysweep viewfinder --picture align --board";
    let mut finder = Process::start(command(&rig, line).stdout(Stdio::null()).stderr(Stdio::null()));
    let found = wait_for("no alignment", || client.status().unwrap().viewfinder?.alignment);
    // What is true of it: [sim.truth].
    assert!((found.shift_rows - 0.4).abs() < 0.1 && (found.rotation_deg - 0.2).abs() < 0.05, "{found:?}");
    assert!(!found.advice.is_empty(), "{found:?}");
    finder.signal(Signal::SIGINT);
    finder.wait();

    succeeds(&rig, "raysweep calibrate", &[]);
    let shown = succeeds(&rig, "raysweep calibration show", &["--json"]);
    let shown: Value = serde_json::from_slice(&shown.stdout).unwrap();
    let row_time_us = shown["timing"]["row_time_us"][0].as_f64().expect("a row time");
    assert!((row_time_us - 22.3).abs() < 0.005, "{row_time_us} us: the rig file says 22.22");

    let proposed = succeeds(&rig, "raysweep expose first-plan.toml", &[]).stdout;
    let proposed = String::from_utf8(proposed).unwrap();
    assert!(proposed.contains("\n#   gain: ") && proposed.contains("\n#   expected error: "), "{proposed}");
    // As many frames as are proposed take minutes.
    let average = proposed.lines().find(|line| line.starts_with("average = ")).expect(&proposed);
    fs::write(rig.path("plan.toml"), proposed.replace(average, "average = 4")).unwrap();
    let told = succeeds(&rig, "raysweep run plan.toml", &["--json"]).stdout;
    let end: Value = serde_json::from_str(String::from_utf8(told).unwrap().lines().last().unwrap()).unwrap();
    let session = rig.path("").join(end["session"].as_str().unwrap());
    let metadata = fs::read(session.join("products/transport.json")).unwrap();
    let metadata: Value = serde_json::from_slice(&metadata).unwrap();
    assert!(metadata["calibration"]["made"].is_string(), "{metadata}");
    assert!(Session::open(&session).unwrap().state().unwrap().counts.balanced());
}
