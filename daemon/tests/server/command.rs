//! The program `raysweep`: its output and exit codes.

use std::fs;
use std::io::{BufRead, BufReader, Lines, Write};
use std::path::PathBuf;
use std::process::{Child, ChildStdout, Command, Output, Stdio};
use std::time::Duration;

use nix::sys::signal::{Signal, kill};
use nix::unistd::Pid;
use raysweep::live::{EPIPOLAR, FLOODLIT, INDIRECT, LiveFile};
use raysweep::server::{Access, Limits, Peer};
use raysweep_core::VsyncStats;
use raysweep_proto::{Event, Question, RunState};
use serde_json::Value;

use crate::fake::{Daemon, session};

fn command(daemon: &Daemon, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
    command.env("RAYSWEEP_SOCKET", &daemon.path).args(arguments);
    command
}

/// Exit code, standard output, standard error.
fn run(daemon: &Daemon, arguments: &[&str]) -> (i32, String, String) {
    let Output { status, stdout, stderr } = command(daemon, arguments).output().unwrap();
    let text = |bytes| String::from_utf8(bytes).unwrap();
    (status.code().unwrap(), text(stdout), text(stderr))
}

fn plan(daemon: &Daemon, text: &str) -> String {
    let path: PathBuf = daemon.folder.path().join("plan.toml");
    std::fs::write(&path, text).unwrap();
    path.to_str().unwrap().into()
}

fn json_lines(text: &str) -> Vec<Value> {
    text.lines().map(|line| serde_json::from_str(line).unwrap()).collect()
}

#[test]
fn a_run_is_followed_to_its_end_and_the_exit_code_tells_how_it_went() {
    let daemon = Daemon::start();
    for (text, code, wanted) in [
        ("", 0, "complete: 75 of 75 points stored, 0 missing"),
        ("gaps", 3, "2 missing"),
        ("fault", 1, "faulted"),
    ] {
        let (exit, out, err) = run(&daemon, &["run", &plan(&daemon, text)]);
        assert_eq!(exit, code, "{text}: {out}{err}");
        assert!(out.contains(wanted) && out.contains(session().to_str().unwrap()), "{text}: {out}");
        assert!(
            err.contains("37/75 measurements stored") && err.contains("4 lost (camera gap)"),
            "{text}: {err}"
        );
        assert_eq!(out.contains("report.html"), text != "fault", "{text}: {out}");
        assert_eq!(err.contains("unplugged"), text == "fault", "{text}: {err}");
        let (quiet_exit, quiet_out, quiet_err) = run(&daemon, &["run", "--quiet", &plan(&daemon, text)]);
        assert_eq!((quiet_exit, quiet_out), (exit, out), "{text}");
        assert!(!quiet_err.contains("stored") && !quiet_err.contains("lost"), "{text}: {quiet_err}");
        assert_eq!(quiet_err.contains("unplugged"), text == "fault", "{text}: {quiet_err}");
    }
}

#[test]
fn what_is_known_of_a_run_arrives_at_the_daemon() {
    let daemon = Daemon::start();
    let arguments =
        ["--operator", "Ada", "--sample", "candle", "--note", "third try", "--tag", "a", "--tag", "b"];
    let plan = plan(&daemon, "plan\ntext");
    let (exit, out, _) = run(&daemon, &[&["run", &plan, "--detach", "--json"], &arguments[..]].concat());
    assert_eq!((exit, json_lines(&out)[0]["session"].as_str()), (0, session().to_str()));
    let runs = daemon.fake.runs.lock().unwrap();
    let params = &runs[0];
    assert_eq!(params.plan, "plan\ntext");
    assert_eq!(params.operator.as_deref(), Some("Ada"));
    assert_eq!(params.sample.as_deref(), Some("candle"));
    assert_eq!(params.note.as_deref(), Some("third try"));
    assert_eq!(params.tags, ["a", "b"]);
}

#[test]
fn for_programs_every_event_is_a_line_and_the_end_is_the_last() {
    let daemon = Daemon::start();
    let (exit, out, err) = run(&daemon, &["--json", "run", &plan(&daemon, "")]);
    assert_eq!((exit, err.as_str()), (0, ""));
    let kinds: Vec<_> =
        json_lines(&out).iter().map(|line| line["event"].as_str().unwrap().to_owned()).collect();
    assert_eq!(kinds, ["state", "progress", "lost", "state", "finished"]);
}

#[test]
fn every_other_command_prints_for_people_and_for_programs() {
    let daemon = Daemon::start();
    let plan = plan(&daemon, "hang");
    for (arguments, human, json) in [
        (vec!["status"], "stored     37 of 75", "/progress/points_stored"),
        (vec!["status"], "parked, light off; light is armed", "/mirror/parked"),
        (vec!["arm-light"], "until the next boot", ""),
        (vec!["describe"], "operator  Starts a run", "/methods/0/params/type"),
        (vec!["check", &plan], "relative rows -94 to 94", "/warnings/0"),
        (vec!["check", &plan], "assumed: state camera.electrons_per_dn", "/advice/noise/source"),
        (vec!["check", &plan], "0.023 (0.015 to 0.075); noise 0.023", "/advice/expected/total/median"),
        (
            vec!["check", &plan],
            "few points\n\n# the settings that are taken\n[sweep]\naverage = 4\n",
            "/settings",
        ),
        (vec!["check", &plan], "\n# better settings\n[sweep]\naverage = 8\n", "/advice/better/table"),
        (vec!["design", &plan, "--light", "2s"], "# warning: not reached\nkind = \"sweep\"\n", "/plan"),
        (vec!["doctor"], "warning  vsync  2 false edges", "/checks/0/remedy"),
        (vec!["sessions"], "20260101-000000_fake  complete, 1 warning   75/75  fake", "/0/warnings/0"),
        (vec!["run", &plan, "--detach"], "/data/20260101-000000_fake", ""),
        (vec!["pause"], "pauses", ""),
        (vec!["status"], "to do      cover the lens", "/question/text"),
        (vec!["continue"], "continues", ""),
        (vec!["cancel"], "kept", ""),
        (vec!["resume", "old", "--detach"], "/data/20260101-000000_fake", ""),
    ] {
        let (exit, out, err) = run(&daemon, &arguments);
        assert_eq!(exit, 0, "{arguments:?}: {out}{err}");
        assert!(out.contains(human), "{arguments:?}: {out}");
        if !json.is_empty() {
            let (exit, out, _) = run(&daemon, &[&arguments[..], &["--json"]].concat());
            assert_eq!(exit, 0, "{arguments:?}");
            let lines = json_lines(&out);
            assert!(lines.len() == 1 && lines[0].pointer(json).is_some(), "{arguments:?}: {out}");
        }
    }
}

#[test]
fn the_preview_is_a_picture_of_both_images_and_is_followed_to_the_result() {
    let daemon = Daemon::start();
    let output = daemon.folder.path().join("seen.png");
    let arguments = ["preview", "--output", output.to_str().unwrap()];
    assert_eq!(run(&daemon, &arguments).0, 5, "there is no live file");
    let live = LiveFile::create(&daemon.fake.live).unwrap();
    assert_eq!(run(&daemon, &arguments).0, 5, "the file has no image");
    assert!(!output.exists());

    let show = |points: u32, last: bool| {
        let metadata = serde_json::json!({ "points": points, "last": last });
        for (name, light) in [(EPIPOLAR, 0.5), (INDIRECT, 0.01)] {
            let image = ndarray::Array2::from_elem((6, 8), light).into_dyn();
            live.publish(name, image.view(), metadata.as_object().unwrap()).unwrap();
        }
    };
    show(5, false);
    let (exit, out, err) = run(&daemon, &[&arguments[..], &["--json"]].concat());
    assert_eq!((exit, json_lines(&out)[0]["points"].as_u64()), (0, Some(5)), "{out}{err}");
    // Width and height are in the first chunk of a PNG file.
    let size = |at: usize| u32::from_be_bytes(fs::read(&output).unwrap()[at..at + 4].try_into().unwrap());
    assert_eq!((size(16), size(20)), (8 + 4 + 8, 6));

    let mut child = command(&daemon, &[&arguments[..], &["--follow", "--json"]].concat())
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    assert_eq!(json_lines(&lines.next().unwrap().unwrap())[0]["sequence"], 2);
    show(9, true);
    assert_eq!(json_lines(&lines.next().unwrap().unwrap())[0]["points"], 9);
    assert_eq!(child.wait().unwrap().code(), Some(0));
}

#[test]
fn the_preview_shows_batches_and_cycles_and_writes_no_other_format() {
    let daemon = Daemon::start();
    let output = daemon.folder.path().join("seen.png");
    let live = LiveFile::create(&daemon.fake.live).unwrap();
    let show = |names: &[&str], metadata: Value| {
        for name in names {
            let image = ndarray::Array2::from_elem((6, 8), 0.5).into_dyn();
            live.publish(name, image.view(), metadata.as_object().unwrap()).unwrap();
        }
    };
    let arguments = ["preview", "--output", output.to_str().unwrap()];
    show(&[FLOODLIT], serde_json::json!({ "batch": 3 }));
    let (exit, out, err) = run(&daemon, &arguments);
    assert!(exit == 0 && out.contains("of batch 3"), "{out}{err}");
    // As wide as one image.
    assert_eq!(u32::from_be_bytes(fs::read(&output).unwrap()[16..20].try_into().unwrap()), 8);
    show(&[EPIPOLAR, INDIRECT], serde_json::json!({ "cycle": 7 }));
    let (exit, out, err) = run(&daemon, &arguments);
    assert!(exit == 0 && out.contains("of cycle 7"), "{out}{err}");
    let (exit, _, err) = run(&daemon, &["preview", "--output", "seen.jpg"]);
    assert!(exit == 2 && err.contains("ends in .png"), "{err}");
}

#[test]
fn a_film_is_followed_by_the_preview_to_the_end_of_its_run() {
    let daemon = Daemon::start();
    let live = LiveFile::create(&daemon.fake.live).unwrap();
    let metadata = serde_json::json!({ "cycle": 7 });
    for name in [EPIPOLAR, INDIRECT] {
        let image = ndarray::Array2::from_elem((6, 8), 0.5).into_dyn();
        live.publish(name, image.view(), metadata.as_object().unwrap()).unwrap();
    }
    assert_eq!(run(&daemon, &["run", &plan(&daemon, "hang"), "--detach"]).0, 0);
    let output = daemon.folder.path().join("seen.png");
    let arguments = ["preview", "--follow", "--output", output.to_str().unwrap()];
    let mut child = command(&daemon, &arguments).stdout(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    assert!(lines.next().unwrap().unwrap().contains("of cycle 7"));
    // It has seen the run before it drew anything.
    assert_eq!(run(&daemon, &["cancel"]).0, 0);
    assert_eq!(child.wait().unwrap().code(), Some(0));
}

#[test]
fn a_session_is_found_by_its_name_wherever_a_folder_is_wanted() {
    let daemon = Daemon::start();
    for command in ["process", "verify", "export"] {
        let (exit, _, err) = run(&daemon, &[command, "20260101-000000_fake"]);
        assert!(exit == 1 && err.contains("/data/20260101-000000_fake"), "{command}: {err}");
        let (_, _, err) = run(&daemon, &[command, "nothing"]);
        assert!(err.contains("nothing") && !err.contains("/data"), "{command}: {err}");
    }
}

#[test]
fn enter_answers_the_question_of_the_run_that_shows_it() {
    let daemon = Daemon::start();
    let terminal = nix::pty::openpty(None, None).unwrap();
    let mut child = command(&daemon, &["run", &plan(&daemon, "hang")])
        .stdin(Stdio::from(terminal.slave))
        .stderr(Stdio::piped())
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    assert!(lines.any(|line| line.unwrap() == "running"));
    // Typed before the question: no answer to it.
    let mut keyboard = fs::File::from(terminal.master);
    keyboard.write_all(b"\n").unwrap();
    assert_eq!(run(&daemon, &["pause"]).0, 0);
    // Nothing that goes on by itself is answered.
    let by_itself = Question { text: "make room on the disk".into(), wants_answer: false };
    daemon.fake.publish(Event::Ask(by_itself));
    let question = Question { text: "cover the lens".into(), wants_answer: true };
    daemon.fake.publish(Event::Ask(question));
    assert!(lines.any(|line| line.unwrap().contains("press Enter")));
    assert_eq!(*daemon.fake.state.lock().unwrap(), RunState::Paused);
    keyboard.write_all(b"\n").unwrap();
    assert!(lines.any(|line| line.unwrap() == "running"), "Enter continues the run");
    assert_eq!(run(&daemon, &["cancel"]).0, 0);
    assert_eq!(child.wait().unwrap().code(), Some(3));
}

#[test]
fn who_watches_a_run_is_told_its_state_and_progress_at_once() {
    let daemon = Daemon::start();
    assert_eq!(run(&daemon, &["run", &plan(&daemon, "hang"), "--detach"]).0, 0);
    let mut child =
        command(&daemon, &["watch"]).stderr(Stdio::piped()).stdout(Stdio::null()).spawn().unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    assert_eq!(lines.next().unwrap().unwrap(), "running");
    assert!(lines.next().unwrap().unwrap().contains("37/75 measurements stored"));
    assert_eq!(run(&daemon, &["cancel"]).0, 0);
    assert_eq!(child.wait().unwrap().code(), Some(3));
}

#[test]
fn a_bad_plan_is_shown_with_its_file_and_line() {
    let daemon = Daemon::start();
    let plan = plan(&daemon, "bad\n12 = count\n");
    for name in ["check", "run"] {
        let (exit, out, err) = run(&daemon, &[name, &plan]);
        assert_eq!((exit, out.as_str()), (5, ""), "{err}");
        for part in ["count is 0; 1 to 1000 is allowed", "plan.toml", "12 = count", "sweep.count"] {
            assert!(err.contains(part), "{name}: {part} in {err}");
        }
        let (exit, out, err) = run(&daemon, &[name, &plan, "--json"]);
        assert_eq!((exit, err.as_str()), (5, ""));
        assert_eq!(json_lines(&out)[0]["error"]["data"]["name"], "invalid_plan");
    }
}

#[test]
fn what_cannot_be_done_has_its_exit_code() {
    let mut daemon = Daemon::start();
    let (exit, _, err) = run(&daemon, &["frobnicate"]);
    assert_eq!(exit, 2, "{err}");
    let (exit, _, err) = run(&daemon, &["run", "no/such/plan.toml"]);
    assert!(exit == 2 && err.contains("no/such/plan.toml"), "{exit} {err}");
    let refused = |daemon: &Daemon, arguments: &[&str], name: &str| {
        let (exit, out, err) = run(daemon, &[arguments, &["--json"]].concat());
        assert_eq!((exit, err.as_str()), (5, ""), "{arguments:?}");
        let error = &json_lines(&out)[0]["error"];
        assert_eq!(error["data"]["name"], name, "{arguments:?}: {error}");
        error.clone()
    };
    refused(&daemon, &["cancel"], "not_running");
    refused(&daemon, &["watch"], "not_running");
    refused(&daemon, &["resume", "none"], "no_session");
    let (exit, _, err) = run(&daemon, &["process", "no/such/session"]);
    assert!(exit == 1 && !err.is_empty(), "{exit} {err}");

    daemon.stop();
    let (exit, out, err) = run(&daemon, &["status"]);
    assert!(exit == 4 && out.is_empty() && err.contains("raysweepd.sock"), "{exit} {err}");
    let (exit, out, _) = run(&daemon, &["status", "--json"]);
    assert!(exit == 4 && json_lines(&out)[0]["error"]["message"].is_string(), "{exit} {out}");

    let access = Access::identified_by(Some("raysweep".into()), |_| Ok(Peer { uid: 65534, gid: 65534 }));
    let daemon = Daemon::with(Limits::default(), access);
    let error = refused(&daemon, &["run", &plan(&daemon, "")], "forbidden");
    assert!(error["data"]["help"].is_string(), "{error}");
}

#[test]
fn ctrl_c_cancels_the_run_and_the_client_sees_its_end() {
    let daemon = Daemon::start();
    let mut child =
        command(&daemon, &["run", &plan(&daemon, "hang"), "--json"]).stdout(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    lines.next().unwrap().unwrap();
    kill(Pid::from_raw(child.id() as i32), Signal::SIGINT).unwrap();
    let last: Value = serde_json::from_str(&lines.last().unwrap().unwrap()).unwrap();
    assert_eq!((&last["event"], &last["state"]), (&"finished".into(), &"cancelled".into()));
    assert_eq!(child.wait().unwrap().code(), Some(3));
    assert_eq!(*daemon.fake.state.lock().unwrap(), RunState::Idle);
}

#[test]
fn a_second_ctrl_c_leaves_the_run_to_the_daemon() {
    let daemon = Daemon::start();
    let arguments = ["run", &plan(&daemon, "hang"), "--note", "stubborn"];
    let mut child = command(&daemon, &arguments).stderr(Stdio::piped()).spawn().unwrap();
    let pid = Pid::from_raw(child.id() as i32);
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines().map(Result::unwrap);
    assert!(lines.any(|line| line.contains("running")));
    kill(pid, Signal::SIGINT).unwrap();
    assert!(lines.any(|line| line.contains("Ctrl-C again")));
    kill(pid, Signal::SIGINT).unwrap();
    assert!(lines.any(|line| line.contains("left to the daemon")));
    assert_eq!(child.wait().unwrap().code(), Some(3));
    assert_eq!(*daemon.fake.state.lock().unwrap(), RunState::Running);
}

#[test]
fn watch_follows_anothers_run_and_ctrl_c_does_not_touch_it() {
    let daemon = Daemon::start();
    run(&daemon, &["run", &plan(&daemon, "hang"), "--detach"]);
    let (mut left, _lines) = watching(&daemon);
    let (mut stays, lines) = watching(&daemon);
    kill(Pid::from_raw(left.id() as i32), Signal::SIGINT).unwrap();
    assert_eq!(left.wait().unwrap().code(), Some(0));
    assert_eq!(*daemon.fake.state.lock().unwrap(), RunState::Running);
    run(&daemon, &["cancel"]);
    assert_eq!(json_lines(&lines.last().unwrap().unwrap())[0]["state"], "cancelled");
    assert_eq!(stays.wait().unwrap().code(), Some(3));
}

#[test]
fn watch_begins_with_what_an_operator_was_asked_before() {
    let daemon = Daemon::start();
    run(&daemon, &["run", &plan(&daemon, "hang"), "--detach"]);
    run(&daemon, &["pause"]);
    let mut child = command(&daemon, &["watch", "--json"]).stdout(Stdio::piped()).spawn().unwrap();
    let lines = BufReader::new(child.stdout.take().unwrap()).lines().take(4);
    let said: Vec<Value> = lines.flat_map(|line| json_lines(&line.unwrap())).collect();
    let kinds: Vec<_> = said.iter().map(|line| line["event"].as_str().unwrap()).collect();
    assert_eq!(kinds, ["state", "progress", "ask", "vsync"]);
    assert_eq!((&said[0]["state"], &said[2]["text"]), (&"paused".into(), &"cover the lens".into()));
    kill(Pid::from_raw(child.id() as i32), Signal::SIGINT).unwrap();
    assert_eq!(child.wait().unwrap().code(), Some(0));
}

/// Starts `raysweep watch` and waits until it receives events.
fn watching(daemon: &Daemon) -> (Child, Lines<BufReader<ChildStdout>>) {
    let mut child = command(daemon, &["watch", "--json"]).stdout(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    let first = std::thread::spawn(move || {
        lines.next().unwrap().unwrap();
        lines
    });
    while !first.is_finished() {
        daemon.fake.publish(Event::Vsync(VsyncStats::default()));
        std::thread::sleep(Duration::from_millis(1));
    }
    (child, first.join().unwrap())
}

#[test]
fn a_daemon_that_goes_away_ends_the_client() {
    let mut daemon = Daemon::start();
    let mut child =
        command(&daemon, &["run", &plan(&daemon, "hang"), "--json"]).stdout(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(child.stdout.take().unwrap()).lines();
    lines.next().unwrap().unwrap();
    daemon.stop();
    assert!(json_lines(&lines.last().unwrap().unwrap())[0]["error"]["message"].is_string());
    assert_eq!(child.wait().unwrap().code(), Some(4));
}
