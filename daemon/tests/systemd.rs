//! Checks the units in `deploy/` with systemd's own tools, in a staged root with the programs at their installed paths,
//! and how the daemon behaves under systemd.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod process;

use std::fs::{self, File};
use std::os::unix::fs::MetadataExt;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use nix::sys::signal::Signal;
use process::{Process, wait_for};
use tempfile::TempDir;

fn deploy() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy")
}

/// A root with the programs, our units and those that ours refer to and every system has.
fn staged() -> TempDir {
    // Programs cannot be executed in every temporary folder.
    let root = tempfile::tempdir_in(env!("CARGO_TARGET_TMPDIR")).unwrap();
    let put = |from: &Path, to: &str| {
        let to = root.path().join(to);
        fs::create_dir_all(to.parent().unwrap()).unwrap();
        fs::copy(from, to).unwrap();
    };
    put(Path::new(env!("CARGO_BIN_EXE_raysweepd")), "usr/bin/raysweepd");
    put(Path::new(env!("CARGO_BIN_EXE_raysweep")), "usr/bin/raysweep");
    for unit in ["raysweepd.service", "raysweepd.socket"] {
        put(&deploy().join("systemd").join(unit), &format!("usr/lib/systemd/system/{unit}"));
    }
    for unit in ["sysinit.target", "basic.target", "sockets.target", "multi-user.target", "shutdown.target"] {
        let path = root.path().join("usr/lib/systemd/system").join(unit);
        fs::write(path, "[Unit]\nDescription=stands for the system's own\n").unwrap();
    }
    let module = root.path().join("usr/lib/systemd/system/modprobe@.service");
    fs::write(module, "[Service]\nType=oneshot\nExecStart=/usr/bin/raysweep --version\n").unwrap();
    root
}

fn analyze(root: &TempDir, arguments: &[&str]) -> Output {
    Command::new("systemd-analyze")
        .arg(format!("--root={}", root.path().display()))
        .args(arguments)
        .output()
        .expect("systemd-analyze: `cargo xtask test` installs it")
}

#[test]
fn systemd_accepts_the_units_and_finds_what_they_start() {
    let root = staged();
    let output = analyze(
        &root,
        &["verify", "--man=no", "--recursive-errors=no", "raysweepd.service", "raysweepd.socket"],
    );
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success() && said.trim().is_empty(), "{said}");
}

/// What systemd-analyze rates the service, in tenths.
fn exposure(root: &TempDir) -> u32 {
    let output = analyze(root, &["security", "--offline=true", "--no-pager", "raysweepd.service"]);
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    let line = said.lines().find(|line| line.contains("Overall exposure level")).expect(&said);
    let number = line.rsplit(": ").next().unwrap().split(' ').next().unwrap();
    number.replace('.', "").parse().unwrap()
}

#[test]
fn the_units_are_confined() {
    let root = staged();
    let hardware = exposure(&root);
    assert!(hardware <= 20, "{hardware} tenths");
    let folder = root.path().join("usr/lib/systemd/system/raysweepd.service.d");
    fs::create_dir_all(&folder).unwrap();
    fs::copy(deploy().join("systemd/simulated.conf"), folder.join("simulated.conf")).unwrap();
    let simulated = exposure(&root);
    assert!(simulated <= 5, "{simulated} tenths");
    for unit in ["raysweepd.service", "simulated.conf"] {
        let text = fs::read_to_string(deploy().join("systemd").join(unit)).unwrap();
        // Every operator would be an observer, and drivers that are loaded later would be shut out.
        assert!(!text.contains("PrivateUsers=") && !text.contains("DevicePolicy="), "{unit}");
    }
}

#[test]
fn the_udev_rules_have_each_analyser_that_the_driver_opens() {
    let rules = fs::read_to_string(deploy().join("udev/60-raysweep.rules")).unwrap();
    let driver = include_str!("../../drivers/src/vsync/fx2lafw/usb.rs");
    let constants =
        driver.lines().filter(|line| line.starts_with("const READY") || line.starts_with("const BLANK"));
    let ids: Vec<String> = constants
        .flat_map(|line| line.split("0x").skip(1))
        .map(|rest| rest.chars().take(4).collect::<String>().to_lowercase())
        .collect();
    assert_eq!(ids.len(), 8);
    for pair in ids.chunks(2) {
        let rule = format!(
            "ATTR{{idVendor}}==\"{}\", ATTR{{idProduct}}==\"{}\", GROUP=\"plugdev\"",
            pair[0], pair[1]
        );
        assert!(rules.contains(&rule), "{rule}");
    }
}

/// The daemon with its standard error in a file that it takes for the journal.
fn daemon(folder: &Path, rig: &Path) -> (Process, PathBuf) {
    let log = folder.join("log");
    let stderr = File::create(&log).unwrap();
    let about = stderr.metadata().unwrap();
    let process = Process::start(
        Command::new(env!("CARGO_BIN_EXE_raysweepd"))
            .arg("--rig")
            .arg(rig)
            .arg("--socket")
            .arg(folder.join("socket"))
            .arg("--data")
            .arg(folder.join("data"))
            .env("JOURNAL_STREAM", format!("{}:{}", about.dev(), about.ino()))
            .stderr(stderr),
    );
    (process, log)
}

#[test]
fn an_unusable_rig_file_is_an_error_in_the_journal_with_an_exit_code_that_forbids_a_restart() {
    let folder = tempfile::tempdir().unwrap();
    let rig = folder.path().join("rig.toml");
    let unit = fs::read_to_string(deploy().join("systemd/raysweepd.service")).unwrap();
    assert!(unit.contains("\nRestartPreventExitStatus=2\n"));
    for text in [None, Some("kind = \"cube\"")] {
        if let Some(text) = text {
            fs::write(&rig, text).unwrap();
        }
        let (mut daemon, log) = daemon(folder.path(), &rig);
        assert_eq!(daemon.wait().code(), Some(2));
        let log = fs::read_to_string(log).unwrap();
        assert!(log.starts_with("<3>raysweepd: ") && log.contains("rig.toml"), "{log}");
        assert!(log.lines().all(|line| line.starts_with("<3>")), "{log}");
    }
}

#[test]
fn log_lines_have_a_priority_and_no_time_and_an_idle_daemon_ends_on_request() {
    let folder = tempfile::tempdir().unwrap();
    let (mut daemon, log) = daemon(folder.path(), &deploy().join("rig.toml"));
    wait_for("the daemon does not listen", || {
        assert!(!daemon.has_ended(), "the daemon has ended");
        UnixStream::connect(folder.path().join("socket")).ok()
    });
    // The signals are handled before the daemon listens to anybody.
    wait_for("the daemon does not log that it listens", || {
        fs::read_to_string(&log).unwrap().contains("listening").then_some(())
    });
    daemon.signal(Signal::SIGUSR1);
    assert_eq!(daemon.wait().code(), Some(0));
    let log = fs::read_to_string(log).unwrap();
    assert!(log.contains("<6>listening on "), "{log}");
    assert!(log.lines().all(|line| line.starts_with('<') && line[2..].starts_with('>')), "{log}");
}
