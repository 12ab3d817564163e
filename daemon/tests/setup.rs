//! `raysweep setup`: answers become a rig file that `doctor` finds sound and that runs the paper's sweep.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot go on may panic")]

mod process;
mod wire_rig;

use std::fs::{self, File};
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::fs::{FileTypeExt, symlink};
use std::path::Path;
use std::process::{Command, Output, Stdio};

use nix::pty::openpty;
use nix::sys::stat::Mode;
use nix::unistd::mkfifo;
use process::{Process, wait_for};
use raysweep_core::Subject;
use raysweep_proto::{Client, DoctorReport, Event, Grade, RunParams};
use raysweep_session::Session;
use raysweep_session::stack::ArrayName;
use raysweep_sim::bench::remote_subject;
use raysweep_sim::mirror::{MirrorPty, PlayzerXController, PlayzerXControllerConfig, SerialLink, WireFaults};
use raysweep_sim::triggerbox::TriggerBoxPty;
use serde_json::Value;
use wire_rig::WireRig;

/// Runs `setup` in a folder with these answers.
fn setup(folder: &Path, answers: &str) -> Output {
    fs::write(folder.join("answers.toml"), answers).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
    command.args(["--json", "setup", "--answers", "answers.toml", "--rig", "new-rig.toml"]);
    command.current_dir(folder).stdin(Stdio::null()).output().unwrap()
}

/// The same, over what is there.
fn forced(folder: &Path, answers: &str) -> Output {
    fs::write(folder.join("answers.toml"), answers).unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
    command.args(["--json", "setup", "--answers", "answers.toml", "--rig", "new-rig.toml", "--force"]);
    command.current_dir(folder).stdin(Stdio::null()).output().unwrap()
}

fn written(output: &Output) -> Value {
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

/// What `doctor` finds of the rig that was set up.
fn examined(folder: &Path) -> DoctorReport {
    let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
    command.args(["--json", "doctor", "--rig", "new-rig.toml", "--data", "data"]);
    let output = command.current_dir(folder).output().unwrap();
    serde_json::from_slice(&output.stdout)
        .unwrap_or_else(|error| panic!("{error}: {}", String::from_utf8_lossy(&output.stderr)))
}

fn failures(report: &DoctorReport) -> Vec<&str> {
    let failed = report.checks.iter().filter(|check| check.grade == Grade::Failure);
    failed.map(|check| check.name.as_str()).collect()
}

const BENCH: &str = "kind = \"plane\"\n[camera]\ndriver = \"aravis\"\naravis.address = \"127.0.0.1\"\n[vsync]\ndriver = \"sim\"\n\
    [projector]\ndriver = \"sim\"\nrows = 64\nrow_time_us = 22.22\nfirst_row_us = 2200\n[sim]\nbench = \"bench.sock\"\n\
    scene = \"v-groove\"\nscene_rows = 64\nscene_columns = 64\n";

#[test]
fn a_rig_set_up_from_answers_is_sound_and_runs_the_papers_sweep() {
    let rig = WireRig::start(BENCH, &[], 9000);
    let folder = rig.path("");
    let answers = "kind = 'plane'\nprojector_rows = 64\nrow_time_us = 22.22\nfirst_row_us = 2200\ncamera = 'genicam:127.0.0.1'\n\
        trigger_latency_us = 8\nprojector = 'bench'\nvsync = 'bench'\nscene_rows = 64\n";
    let output = setup(&folder, answers);
    let value = written(&output);
    assert_eq!(value["rig"], "new-rig.toml");
    let facts = &value["connected"]["cameras"][0]["facts"];
    assert_eq!(facts["formats"][0][1][0], serde_json::json!([64, 64]), "{value}");
    let limits = ["exposure_us", "trigger_delay_us", "rate_hz"].map(|key| &facts[key]["end"]);
    assert!(limits.iter().all(|most| most.as_f64() > Some(1000.0)), "{value}");
    let text = fs::read_to_string(rig.path("new-rig.toml")).unwrap();
    assert!(
        text.contains("pixel_format = \"Mono12p\"") && text.contains("trigger_source = \"Line0\""),
        "{text}"
    );
    let report = examined(&folder);
    assert!(failures(&report).is_empty(), "{report:#?}");

    let socket = rig.path("socket");
    let mut command = Command::new(env!("CARGO_BIN_EXE_raysweepd"));
    command.arg("--rig").arg(rig.path("new-rig.toml")).arg("--socket").arg(&socket);
    let _daemon = Process::start(command.arg("--data").arg(rig.path("data")).stderr(Stdio::null()));
    let mut client = wait_for("the daemon does not listen", || Client::connect(&socket).ok());
    let events = Client::connect(&socket).unwrap().subscribe().unwrap();
    // What an earlier run left in front of the bench's camera is not what this one is about.
    remote_subject(&rig.path("bench.sock")).unwrap().place(Subject::Board).unwrap();
    let plan = include_str!("../../deploy/plans/paper.toml");
    client.run(&RunParams { plan: plan.into(), ..RunParams::default() }).unwrap();
    let ended = events.into_iter().find_map(|event| match event.unwrap() {
        Event::Finished { session, state, missing, error, .. } => Some((session, (state, missing, error))),
        _ => None,
    });
    let (session, ended) = ended.unwrap();
    assert_eq!(ended, ("complete".into(), 0, None));
    let stack = Session::open(&session).unwrap().stack().unwrap();
    let regular = stack.read_point(ArrayName::Regular, 0).unwrap().mapv(f64::from);
    let (mean, most) = (regular.mean().unwrap(), regular.fold(0.0_f64, |most, light| most.max(*light)));
    assert!(most > 1.3 * mean, "an even board, not the scene: {mean} on average, at most {most}");
}

#[test]
fn ports_that_may_be_asked_say_what_they_are_and_a_dot_rig_is_found_sound() {
    let folder = tempfile::tempdir().unwrap();
    let link = SerialLink::VirtualCom;
    let controller = PlayzerXController::new(PlayzerXControllerConfig::default());
    let mirror = MirrorPty::plug(controller, link, WireFaults::default()).unwrap();
    let trigger = TriggerBoxPty::plug(16_666_667, link, WireFaults::default()).unwrap();
    let (mirror_port, trigger_port) = (mirror.path().display(), trigger.path().display());
    let answers = format!(
        "kind = 'dots'\ncamera = 'sim'\nask_ports = ['{mirror_port}', '{trigger_port}']\nmirror = 'playzerx:{mirror_port}'\n"
    );
    let value = written(&setup(folder.path(), &answers));
    let answering = &value["connected"]["answering"];
    assert!(answering[0][1]["playzerx"].is_string() && answering[1][1]["triggerbox"].is_u64(), "{answering}");
    let report = examined(folder.path());
    assert!(failures(&report).is_empty(), "{report:#?}");
    assert!(report.checks.iter().any(|check| check.name == "mirror" && check.found.contains("not moved")));
    let text = fs::read_to_string(folder.path().join("new-rig.toml")).unwrap();
    assert!(text.contains("max_tilt = 6.5") && text.contains("max_slew_deg_per_s = 8168.14"), "{text}");
    let answers = format!("{answers}max_tilt = 3\nbandwidth_hz = 400\nmax_step = 0.2\n");
    written(&forced(folder.path(), &answers));
    let text = fs::read_to_string(folder.path().join("new-rig.toml")).unwrap();
    for limit in ["max_tilt = 3.0", "bandwidth_hz = 400.0", "max_step = 0.2", "out_of_band = 0.03"] {
        assert!(text.contains(limit), "{limit}: {text}");
    }
    assert!(failures(&examined(folder.path())).is_empty());
    let held = mirror.truth().held;
    assert!(
        held.iter().all(|held| held.x == 0.0 && held.y == 0.0 && held.light == 0),
        "setup moved the mirror"
    );

    let folder = tempfile::tempdir().unwrap();
    let answers = format!(
        "camera = 'sim'\nprojector = 'external'\nvsync = 'triggerbox:{trigger_port}'\ntriggerbox_link = 'usb'\n"
    );
    written(&setup(folder.path(), &answers));
    let report = examined(folder.path());
    assert!(failures(&report).is_empty(), "{report:#?}");
}

#[test]
fn wrong_answers_write_nothing_and_name_what_is_allowed() {
    let folder = tempfile::tempdir().unwrap();
    for (answers, part) in [
        ("camera = 'sim'\nvsync = 'wire'\nprojector = 'sim'", "vsync = \"wire\"; allowed: "),
        ("camera = 'sim'\nprojector = 'sim'\nvsync = 'sim'\nprojector_rows = 0", "allowed: 1 to 8192"),
        ("camera = 'sim'\nprojector = 'sim'\nvsync = 'sim'\nmirror = 'sim'", "mirror: not asked for"),
        (
            "camera = 'sim'\nprojector = 'sim'\nvsync = 'sim'\nrow_time_us = 900",
            "row_time_us = 900; allowed: 0.1 to 23.148",
        ),
        ("camera = 'sim'\nprojector = 'sim'\nvsync = 'sim'\nfirst_row_us = 900", "allowed: 0 to 666.827"),
        ("camera = 'sim'\nprojector = 'sim'\nvsync = 'sim'\nprojector_rows = 1.5", "whole numbers"),
        (
            "projector_rows = 0\nprojector_hz = 'slow'\ncamera = 'sim'\nvsync = 'wire'",
            "answers.toml: projector_rows = 0; allowed: 1 to 8192\nanswers.toml: projector_hz = \"slow\"; allowed: a number\nanswers.toml: vsync",
        ),
        ("camera = 5\nkind = 'plane'", "camera = 5; allowed: a string"),
        ("camera = ", "answers.toml"),
        ("camera = 'sim'\nask_ports = ['132']", "ask_ports: 132: there is no such file"),
        ("camera = 'sim'\nask_ports = ['answers.toml']", "ask_ports: answers.toml: this is no serial port"),
        (
            "camera = 'v4l2:/none'\ncontrols = 'gain'",
            "controls = \"gain\": \"gain\" is not NAME=WHOLE NUMBER",
        ),
        (
            "camera = 'v4l2:/none'\nprojector = 'bench'\nvsync = 'bench'\nscene = '128'",
            "scene = \"128\": no such scene; allowed: v-groove, ",
        ),
        ("camera = 'v4l2:/none'\npixel_format = 'Mono13'", "pixel_format = \"Mono13\": "),
        ("kind = 'dots'\ncamera = 'sim'\nmirror = 'optotune:/dev/null'", "laser_port = \"\": an Optotune"),
    ] {
        let output = setup(folder.path(), answers);
        let error: Value = serde_json::from_slice(&output.stdout).unwrap();
        let error = error["error"]["message"].as_str().unwrap_or_else(|| panic!("{error}")).to_owned();
        assert_eq!(output.status.code(), Some(2), "{answers}: {error}");
        assert!(error.contains(part), "{answers}: {error}");
        assert!(!folder.path().join("new-rig.toml").exists(), "{answers}");
    }
    let sound = "camera = 'sim'\nprojector = 'sim'\nvsync = 'sim'";
    fs::write(folder.path().join("new-rig.toml"), "mine").unwrap();
    let output = setup(folder.path(), sound);
    assert!(String::from_utf8_lossy(&output.stdout).contains("--force"));
    assert_eq!(fs::read_to_string(folder.path().join("new-rig.toml")).unwrap(), "mine");
    let mut nobody = Command::new(env!("CARGO_BIN_EXE_raysweep"));
    let output = nobody.arg("setup").current_dir(folder.path()).stdin(Stdio::null()).output().unwrap();
    assert!(String::from_utf8_lossy(&output.stderr).contains("--answers"));
}

#[test]
fn a_kernels_camera_with_a_trigger_can_run_freely_for_a_viewfinder() {
    let folder = tempfile::tempdir().unwrap();
    let answers = "camera = 'v4l2:/none'\ncontrols = 'trigger_mode=1, gain=0'\nprojector = 'external'\nvsync = 'pps:/dev/pps0'\n";
    let text = |answers: &str| {
        written(&forced(folder.path(), answers));
        fs::read_to_string(folder.path().join("new-rig.toml")).unwrap()
    };
    assert!(text(answers).contains("free_running = [[\"trigger_mode\", 0]]"), "{}", text(answers));
    let own = format!("{answers}free_running = 'trigger_mode=2'\n");
    assert!(text(&own).contains("free_running = [[\"trigger_mode\", 2]]"), "{}", text(&own));
}

/// Runs `setup` at a terminal at which a person writes these lines; returns what it says.
fn at_a_terminal(folder: &Path, lines: &str) -> String {
    let pty = openpty(None, None).unwrap();
    let slave = |end: &OwnedFd| Stdio::from(end.try_clone().unwrap());
    let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
    command.args(["setup", "--rig", "new-rig.toml"]).current_dir(folder);
    let mut process =
        Process::start(command.stdin(slave(&pty.slave)).stdout(slave(&pty.slave)).stderr(slave(&pty.slave)));
    // The terminal ends when the process has ended and nobody here holds its end.
    drop((command, pty.slave));
    let mut person = File::from(pty.master);
    person.write_all(lines.as_bytes()).unwrap();
    let mut said = Vec::new();
    // It ends in an error.
    let _ = person.read_to_end(&mut said);
    let said = String::from_utf8_lossy(&said).into_owned();
    assert!(process.wait().success(), "{said}");
    said
}

#[test]
fn a_person_who_takes_every_default_gets_a_rig_that_can_be_rehearsed() {
    let folder = tempfile::tempdir().unwrap();
    // No camera, and nothing else, but the simulated one, wherever this machine has none.
    let said = at_a_terminal(folder.path(), "\n\n\n\nsim\nsim\nsim\n\n\n\n\n");
    assert!(said.contains("connected:") && said.contains("next: `raysweep doctor"), "{said}");
    assert!(failures(&examined(folder.path())).is_empty());
}

#[test]
fn only_two_regular_files_are_written_both_or_neither() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    fs::write(path("answers.toml"), "camera = 'sim'\nprojector = 'sim'\nvsync = 'sim'\n").unwrap();
    mkfifo(&path("pipe"), Mode::S_IRWXU).unwrap();
    symlink("/dev/null", path("link")).unwrap();
    symlink(".", path("here")).unwrap();
    let refused = |rig: &str, plan: &str, answers: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
        command.args(["setup", "--force", "--answers", answers, "--rig", rig, "--plan", plan]);
        let output = command.current_dir(folder.path()).stdin(Stdio::null()).output().unwrap();
        assert!(!output.status.success(), "{rig}, {plan}");
        String::from_utf8(output.stderr).unwrap()
    };
    for other in ["pipe", "link", "here", "/dev/null"] {
        let said = refused(other, "plan.toml", "answers.toml");
        assert!(said.contains(&format!("{other} is not a regular file")), "{said}");
    }
    assert!(path("link").is_symlink() && fs::symlink_metadata(path("pipe")).unwrap().file_type().is_fifo());
    for same in ["rig.toml", "./rig.toml", "here/rig.toml"] {
        let said = refused("rig.toml", same, "answers.toml");
        assert!(said.contains("--rig and --plan both name rig.toml"), "{said}");
    }
    let said = refused("rig.toml", "missing/plan.toml", "answers.toml");
    assert!(said.contains("missing/plan.toml"), "{said}");
    assert!(!path("rig.toml").exists(), "one without the other");
    for endless in ["pipe", "/dev/zero"] {
        let said = refused("rig.toml", "plan.toml", endless);
        assert!(said.contains(&format!("cannot read {endless}: it is not a regular file")), "{said}");
    }
}

#[test]
fn a_slip_costs_a_person_one_answer() {
    let folder = tempfile::tempdir().unwrap();
    // The first line answers a question about serial ports on a machine that has some, and no other question.
    let lines = "none\nplane\n\n\nv4l2:/none\nMono13\nMono10\n\n\ngain\ntrigger_mode=1\n\n\nexternal\npps:\npps:/dev/pps0\n\n\n";
    let said = at_a_terminal(folder.path(), lines);
    for slip in ["\"Mono13\": ", "\"gain\": \"gain\" is not NAME=WHOLE NUMBER", "\"pps:\" is none of them"] {
        assert!(said.contains(slip), "{slip}: {said}");
    }
    let text = fs::read_to_string(folder.path().join("new-rig.toml")).unwrap();
    for key in ["pixel_format = \"Mono10\"", "controls = [[\"trigger_mode\", 1]]", "source = \"/dev/pps0\""] {
        assert!(text.contains(key), "{key}: {text}");
    }
}
