//! `raysweep doctor` on the simulated GigE camera and on simulated boxes at pseudo-terminals: what is sound is found
//! sound, and each fault is named with what mends it.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot go on may panic")]

mod process;
mod wire_rig;

use std::fs::{self, Permissions};
use std::os::unix::fs::PermissionsExt;
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, Stdio};

use nix::unistd::Uid;
use process::{Process, wait_for};
use raysweep::doctor;
use raysweep::rig::AnyRig;
use raysweep_proto::{
    Client, DoctorCheck, DoctorParams, DoctorReport, ErrorCode, Grade, RunParams, RunState,
};
use raysweep_sim::mirror::{MirrorPty, PlayzerXController, PlayzerXControllerConfig, SerialLink, WireFaults};
use raysweep_sim::triggerbox::TriggerBoxPty;
use wire_rig::WireRig;

fn rig_text(camera: &str, sim: &str) -> String {
    format!(
        "kind = \"plane\"\n[camera]\npixel_format = \"Mono12p\"\ndriver = \"aravis\"\naravis.address = \"127.0.0.1\"\n\
         aravis.trigger_latency_us = 8\n{camera}\n[vsync]\ndriver = \"sim\"\n[projector]\ndriver = \"sim\"\nrows = 32\n\
         row_time_us = 22.22\nfirst_row_us = 2200\n[sim]\nbench = \"bench.sock\"\nscene = \"v-groove\"\n\
         scene_rows = 32\nscene_columns = 32\n{sim}"
    )
}

/// What `raysweep doctor --rig` finds.
fn examined(rig: &WireRig) -> DoctorReport {
    let (report, code) = by_hand(&rig.path("rig.toml"), &rig.path("data"));
    assert_eq!(code == Some(1), report.worst() == Grade::Failure, "{report:#?}");
    report
}

fn by_hand(rig: &Path, data: &Path) -> (DoctorReport, Option<i32>) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
    let output =
        command.args(["--json", "doctor", "--rig"]).arg(rig).arg("--data").arg(data).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    (serde_json::from_slice(&output.stdout).expect(&error), output.status.code())
}

fn check<'a>(report: &'a DoctorReport, name: &str) -> &'a DoctorCheck {
    report.checks.iter().find(|check| check.name == name).unwrap_or_else(|| panic!("{name}: {report:#?}"))
}

/// The only checks that are wrong are the named ones.
fn assert_wrong(report: &DoctorReport, wrong: &[(&str, Grade)]) {
    // What the machine of the test is like.
    const OF_THE_HOST: [&str; 6] =
        ["real-time priority", "clock source", "memory", "service", "network buffers", "camera search"];
    let found: Vec<(&str, Grade)> = report
        .checks
        .iter()
        .filter(|check| check.grade > Grade::Skipped && !OF_THE_HOST.contains(&check.name.as_str()))
        .map(|check| (check.name.as_str(), check.grade))
        .collect();
    assert_eq!(found, wrong, "{report:#?}");
    assert!(report.checks.iter().all(|check| (check.grade > Grade::Skipped) == check.remedy.is_some()));
}

#[test]
fn a_sound_rig_on_the_wire_is_found_sound_by_the_daemon_and_runs_afterwards() {
    let rig = WireRig::start(&rig_text("", ""), &[], 9000);
    let socket = rig.path("socket");
    let mut command = Command::new(env!("CARGO_BIN_EXE_raysweepd"));
    command.arg("--rig").arg(rig.path("rig.toml")).arg("--socket").arg(&socket);
    let _daemon = Process::start(command.arg("--data").arg(rig.path("data")).stderr(Stdio::null()));
    let mut client = wait_for("the daemon does not listen", || Client::connect(&socket).ok());
    let plan = "kind = \"sweep\"\n[sweep]\naverage = 1\ndelay_us = [0, 100]\nexposure_us = [400]\n";
    let report = client.doctor(&DoctorParams { plan: Some(plan.into()) }).unwrap();
    // A busy host loses frames on the wire; a simulated rig does not, below.
    let frames = check(&report, "frames");
    let lossy = [("frames", Grade::Warning)];
    assert_wrong(&report, if frames.grade == Grade::Warning { &lossy[..] } else { &[] });
    assert!(check(&report, "disk").found.contains("the plan needs"), "{report:#?}");
    assert!(frames.found.contains("arrived"), "{report:#?}");
    assert_eq!(client.status().unwrap().state, RunState::Idle);

    let invalid = client.doctor(&DoctorParams { plan: Some("kind = \"swep\"".into()) }).unwrap_err();
    assert!(invalid.to_string().contains("sweep"), "{invalid}");
    let paused = plan.replace("average = 1", "average = 200");
    client.run(&RunParams { plan: paused, ..RunParams::default() }).unwrap();
    let refused = client.doctor(&DoctorParams::default()).unwrap_err();
    let raysweep_proto::ClientError::Rpc(refused) = refused else { panic!("{refused}") };
    assert_eq!(refused.name(), Some(ErrorCode::Busy));
    client.cancel().unwrap();
}

#[test]
fn a_camera_without_a_trigger_is_told_from_a_line_without_edges() {
    let rig = WireRig::start(&rig_text("aravis.trigger_source = \"Software\"", ""), &[], 9000);
    let report = examined(&rig);
    assert_wrong(&report, &[("frames", Grade::Failure)]);
    let remedy = check(&report, "frames").remedy.as_ref().unwrap();
    assert!(remedy.contains("trigger_source") && remedy.contains("Software"), "{remedy}");
}

#[test]
fn frames_whose_stamps_mean_something_else_have_no_edge() {
    let rig = WireRig::start(&rig_text("aravis.timestamp_at = \"exposure_end\"", ""), &[], 9000);
    let report = examined(&rig);
    assert_wrong(&report, &[("frames and edges", Grade::Failure)]);
    let ties = check(&report, "frames and edges");
    assert!(ties.found.contains("0 of"), "{ties:?}");
    let remedy = ties.remedy.as_ref().unwrap();
    assert!(remedy.contains("timestamp_at = \"exposure_start\"") && !remedy.contains("latency"), "{remedy}");
}

#[test]
fn lost_packets_are_named() {
    let rig = WireRig::start(&rig_text("", ""), &["packet_loss=0.1", "resend=false"], 1500);
    let report = examined(&rig);
    let frames = check(&report, "frames");
    assert_eq!(frames.grade, Grade::Warning, "{report:#?}");
    assert!(frames.found.contains("packets lost"), "{frames:?}");
}

#[test]
fn packets_larger_than_the_network_carries_are_named() {
    let rig = WireRig::start(&rig_text("aravis.packet_size = 9000", ""), &[], 1500);
    let size = check(&examined(&rig), "packet size").clone();
    assert_eq!(size.grade, Grade::Failure, "{size:?}");
    assert!(size.remedy.unwrap().contains("ip link set lo mtu 9000"));
}

#[test]
fn a_jittering_line_is_named() {
    let rig = WireRig::start(&rig_text("", "[sim.vsync]\njitter_us = 60\n"), &[], 9000);
    let report = examined(&rig);
    assert_eq!(check(&report, "vsync edges").grade, Grade::Warning, "{report:#?}");
}

/// A simulated rig whose watcher of the VSYNC is not plugged in.
const WITHOUT_WATCHER: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"modemline\"\n\
    modemline.port = \"/dev/serial/by-id/none\"\n[projector]\ndriver = \"sim\"\n\
    [sim]\nrealtime = true\nscene_rows = 32\nscene_columns = 32\n";

#[test]
fn raysweepd_checks_every_device_though_one_fails() {
    let folder = tempfile::tempdir().unwrap();
    let rig = folder.path().join("rig.toml");
    let checked = |text: &str| {
        fs::write(&rig, text).unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_raysweepd"));
        command.arg("--check").arg("--rig").arg(&rig).arg("--data").arg(folder.path().join("data"));
        let output = command.output().unwrap();
        (output.status.code(), String::from_utf8(output.stdout).unwrap())
    };
    let (code, said) = checked(WITHOUT_WATCHER);
    let line = |name: &str| {
        let is_of = |line: &&str| line.split_whitespace().nth(1) == Some(name);
        said.lines().find(is_of).unwrap_or_else(|| panic!("{name}: {said}"))
    };
    assert_eq!(code, Some(1), "{said}");
    assert!(
        line("vsync").starts_with("FAILURE") && line("vsync").contains("/dev/serial/by-id/none"),
        "{said}"
    );
    for name in ["camera", "projector"] {
        assert!(line(name).starts_with("OK"), "{said}");
    }
    assert!(line("versions").contains("libaravis 0.8.") && line("versions").contains("Linux"), "{said}");
    // The failure of its file and that of its device are the only ones.
    assert_eq!(said.lines().filter(|line| line.starts_with("FAILURE")).count(), 2, "{said}");
    let sound = WITHOUT_WATCHER.replace("modemline\"\nmodemline.port = \"/dev/serial/by-id/none\"", "sim\"");
    assert_eq!(checked(&sound).0, Some(0));
}

#[test]
fn a_plan_is_examined_without_a_daemon_if_the_devices_open() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    fs::write(path("plan.toml"), "kind = \"sweep\"\n[sweep]\ndelay_us = [0, 100]\nexposure_us = [400]\n")
        .unwrap();
    let disk = |rig: &str| {
        fs::write(path("rig.toml"), rig).unwrap();
        let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
        command.args(["--json", "doctor", "plan.toml", "--rig", "rig.toml", "--data", "data"]);
        let output = command.current_dir(&folder).output().unwrap();
        let said = String::from_utf8(output.stderr).unwrap();
        let report: DoctorReport = serde_json::from_slice(&output.stdout).expect(&said);
        (check(&report, "disk").found.clone(), said)
    };
    let sound = WITHOUT_WATCHER.replace("modemline\"\nmodemline.port = \"/dev/serial/by-id/none\"", "sim\"");
    assert!(disk(&sound).0.contains("the plan needs"), "{:?}", disk(&sound));
    let (found, said) = disk(&sound.replace(
        "\"sim\"\n[vsync]",
        "\"v4l2\"\nv4l2 = { device = \"/none\", width = 8, height = 8 }\n[vsync]",
    ));
    assert!(!found.contains("the plan needs") && said.contains("plan.toml: not examined"), "{found}: {said}");
}

#[test]
fn an_examination_that_was_cancelled_is_not_passed() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("rig.toml");
    let sound = WITHOUT_WATCHER.replace("modemline\"\nmodemline.port = \"/dev/serial/by-id/none\"", "sim\"");
    fs::write(&path, sound).unwrap();
    let rig = AnyRig::load(&path).unwrap();
    let report = doctor::examine(&rig.into(), &folder.path().join("data"), None, &|| false);
    assert_eq!(report.worst(), Grade::Failure, "{report:#?}");
    assert!(check(&report, "examination").found.contains("cancelled"), "{report:#?}");
    assert!(!folder.path().join("data").exists(), "doctor only looks");
}

/// What is found on a simulated rig without a wire.
fn simulated(text: &str) -> DoctorReport {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("rig.toml");
    fs::write(&path, text).unwrap();
    let rig = AnyRig::load(&path).unwrap();
    doctor::examine(&rig.into(), &folder.path().join("data"), None, &|| true)
}

fn simulated_with(vsync: &str, sim: &str) -> DoctorReport {
    simulated(&format!(
        "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n{vsync}\n[projector]\ndriver = \"sim\"\n\
         [sim]\nscene_rows = 8\nscene_columns = 8\n{sim}"
    ))
}

#[test]
fn faults_of_line_and_camera_are_named() {
    use Grade::{Failure, Warning};
    let sound = simulated_with("", "");
    assert_wrong(&sound, &[]);
    assert!(check(&sound, "frames").found.contains("80 arrived, none lost"), "{sound:#?}");
    let silent = simulated_with("", "[sim.vsync]\nmissing = 1\n");
    assert_wrong(&silent, &[("vsync edges", Failure), ("frames", Failure)]);
    assert!(check(&silent, "frames").remedy.as_ref().unwrap().contains("no edges either"));
    let crosstalk = simulated_with("", "[sim.vsync]\nfalse_edges = 0.2\n");
    assert_wrong(&crosstalk, &[("vsync edges", Warning), ("frames and edges", Warning)]);
    assert_wrong(&simulated_with("", "[sim.vsync]\nunseen = 0.1\n"), &[("vsync edges", Warning)]);
    assert_wrong(&simulated_with("", "[sim.camera]\ndropped = 0.2\n"), &[("frames", Warning)]);
    assert_wrong(&simulated_with("", "[sim.camera]\ndropped = 0.8\n"), &[("frames", Failure)]);
    // A projector at 50 Hz.
    let other = simulated_with("period_us = 20000", "");
    assert_wrong(&other, &[]);
}

fn triggerbox_rig(port: &Path) -> String {
    format!(
        "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"triggerbox\"\n\
         triggerbox = {{ port = \"{}\", link = \"usb\" }}\n[projector]\ndriver = \"external\"\n\
         [sim]\nrealtime = true\nscene_rows = 8\nscene_columns = 8\n",
        port.display()
    )
}

#[test]
fn a_triggerbox_is_watched_and_a_port_that_another_program_has_open_is_named() {
    let link = SerialLink::VirtualCom;
    let pty = TriggerBoxPty::plug(16_666_667, link, WireFaults::default()).unwrap();
    let report = simulated(&triggerbox_rig(pty.path()));
    assert_eq!(check(&report, "vsync").grade, Grade::Ok, "{report:#?}");
    // A busy host watches it less exactly, which is said.
    let edges = check(&report, "vsync edges");
    assert!(edges.grade != Grade::Failure && edges.found.contains("edges"), "{report:#?}");
    let held = fs::File::options().read(true).write(true).open(pty.path()).unwrap();
    held.try_lock().unwrap();
    let busy = simulated(&triggerbox_rig(pty.path()));
    let vsync = check(&busy, "vsync");
    assert_eq!(vsync.grade, Grade::Failure, "{busy:#?}");
    assert!(vsync.remedy.as_ref().unwrap().contains("fuser"), "{vsync:?}");
}

/// Somebody else than the daemon's user, of no group that matters.
#[test]
fn a_port_that_the_user_may_not_open_is_named_with_what_permits_it() {
    const NOBODY: u32 = 65534;
    assert!(Uid::effective().is_root(), "only root can be somebody else");
    let link = SerialLink::VirtualCom;
    let pty = TriggerBoxPty::plug(16_666_667, link, WireFaults::default()).unwrap();
    fs::set_permissions(pty.path(), Permissions::from_mode(0o600)).unwrap();
    let folder = tempfile::tempdir().unwrap();
    fs::set_permissions(folder.path(), Permissions::from_mode(0o755)).unwrap();
    let (rig, data) = (folder.path().join("rig.toml"), folder.path().join("data"));
    fs::write(&rig, triggerbox_rig(pty.path())).unwrap();
    fs::create_dir(&data).unwrap();
    std::os::unix::fs::chown(&data, Some(NOBODY), Some(NOBODY)).unwrap();
    // Others may not enter the folder in which it was built, such as root's home.
    let program = folder.path().join("raysweep");
    fs::copy(env!("CARGO_BIN_EXE_raysweep"), &program).unwrap();
    let mut command = Command::new(&program);
    command.args(["--json", "doctor", "--rig"]).arg(&rig).arg("--data").arg(&data);
    let output = command.uid(NOBODY).gid(NOBODY).output().unwrap();
    let error = String::from_utf8_lossy(&output.stderr);
    let report: DoctorReport = serde_json::from_slice(&output.stdout).expect(&error);
    assert_eq!((output.status.code(), report.user.as_str()), (Some(1), "nobody"), "{report:#?}");
    assert_wrong(&report, &[("vsync.triggerbox.port", Grade::Failure), ("vsync", Grade::Failure)]);
    let port = check(&report, "vsync.triggerbox.port");
    assert!(port.found.contains("nobody may not use it"), "{port:?}");
    // Its group may not use it either, so to be in the group would not help.
    assert!(port.remedy.as_ref().unwrap().contains("chmod g+rw"), "{port:?}");
}

#[test]
fn a_mirror_answers_in_darkness_and_unmoved() {
    let controller = PlayzerXController::new(PlayzerXControllerConfig::default());
    let pty = MirrorPty::plug(controller, SerialLink::VirtualCom, WireFaults::default()).unwrap();
    let rig = |port: &Path| {
        format!(
            "kind = \"dots\"\n[camera]\ndriver = \"sim\"\n[mirror]\ndriver = \"playzerx\"\nport = \"{}\"\n\
             [sim.dots]\nrows = 16\ncolumns = 32\n",
            port.display()
        )
    };
    let report = simulated(&rig(pty.path()));
    assert_wrong(&report, &[("light", Grade::Warning)]);
    assert!(check(&report, "mirror").found.contains("not moved"), "{report:#?}");
    let truth = pty.truth();
    assert!(truth.held.iter().all(|held| held.x == 0.0 && held.y == 0.0 && held.light == 0), "it moved");
    let missing = simulated(&rig(Path::new("/dev/nowhere")));
    assert_wrong(
        &missing,
        &[("mirror.port", Grade::Failure), ("mirror", Grade::Failure), ("light", Grade::Warning)],
    );
}
