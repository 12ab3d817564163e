//! How the daemon starts and ends: what is left in its folders, who may read it, and the signals that end a run in order.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod process;

use std::fs;
use std::os::unix::fs::{PermissionsExt, symlink};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use process::{Process, wait_for};
use raysweep_proto::{Client, RunParams, RunState};
use raysweep_session::Session;
use raysweep_session::ledger::EndState;
use tempfile::TempDir;

const RIG: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n[projector]\ndriver = \"sim\"\n\
                   [sim]\nscene = \"v-groove\"\nscene_rows = 16\nscene_columns = 8\nrealtime = true\n";
/// Takes minutes.
const PLAN: &str =
    "kind = \"sweep\"\n[sweep]\ndelay_us = [-300, 0, 300]\nexposure_us = [600]\naverage = 4000\n";

struct Lab(TempDir);

impl Lab {
    fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("rig.toml"), RIG).unwrap();
        Self(folder)
    }

    fn path(&self, name: &str) -> PathBuf {
        self.0.path().join(name)
    }

    /// Starts the daemon after a shell command that has the daemon's process id.
    fn daemon_after(&self, command: &str) -> Process {
        let mut shell = Command::new("sh");
        shell
            .args(["-c", &format!("{command}; exec \"$0\" --rig rig.toml --socket socket --data data")])
            .arg(env!("CARGO_BIN_EXE_raysweepd"))
            .current_dir(self.0.path())
            .stderr(fs::File::create(self.path("log")).map_or(Stdio::null(), Stdio::from));
        Process::start(&mut shell)
    }

    fn client(&self) -> Client {
        wait_for("the daemon does not listen", || Client::connect(self.path("socket")).ok())
    }

    fn session(&self) -> Session {
        let listed = raysweep_session::list(&self.path("data")).unwrap();
        assert!(listed.unreadable.is_empty());
        Session::open(&listed.sessions[0].dir).unwrap()
    }
}

fn mode(path: &Path) -> u32 {
    fs::metadata(path).unwrap().permissions().mode() & 0o777
}

#[test]
fn every_signal_that_asks_for_the_end_ends_a_run_in_order() {
    for signal in [Signal::SIGTERM, Signal::SIGINT, Signal::SIGHUP] {
        let lab = Lab::new();
        let mut daemon = lab.daemon_after("true");
        let mut client = lab.client();
        client.run(&RunParams { plan: PLAN.into(), ..RunParams::default() }).unwrap();
        running(&mut client);
        daemon.signal(signal);
        let began = Instant::now();
        assert!(daemon.wait().success(), "{signal}");
        println!("{signal}: {:.2?} to the end", began.elapsed());
        let session = lab.session();
        assert_eq!(session.state().unwrap().end.unwrap().state, EndState::Cancelled, "{signal}");
        assert!(!lab.path("socket").exists(), "{signal}");
        // The group may read what is in a session, and only the daemon may write it.
        for path in
            [session.ledger_path(), session.rig_path(), session.dir().to_owned(), session.stack_path()]
        {
            let (mode, read) = (mode(&path), if path.is_dir() { 0o750 } else { 0o640 });
            assert_eq!(mode, read, "{}: {mode:o}", path.display());
        }
    }
}

/// Waits until a run is under way.
fn running(client: &mut Client) {
    wait_for("no run is under way", || (client.status().unwrap().state == RunState::Running).then_some(()));
}

#[test]
fn a_second_sigterm_does_not_cut_the_end_of_a_run_short() {
    let lab = Lab::new();
    let mut daemon = lab.daemon_after("true");
    let mut client = lab.client();
    client.run(&RunParams { plan: PLAN.into(), ..RunParams::default() }).unwrap();
    running(&mut client);
    daemon.signal(Signal::SIGTERM);
    daemon.signal(Signal::SIGTERM);
    assert!(daemon.wait().success());
    assert_eq!(lab.session().state().unwrap().end.unwrap().state, EndState::Cancelled);
}

#[test]
fn a_daemon_that_was_stopped_for_a_while_loses_frames_and_no_point() {
    let lab = Lab::new();
    let daemon = lab.daemon_after("true");
    let mut client = lab.client();
    // In real time: the camera goes on while the daemon stands still.
    let short = PLAN.replace("4000", "200");
    client.run(&RunParams { plan: short, ..RunParams::default() }).unwrap();
    running(&mut client);
    daemon.signal(Signal::SIGSTOP);
    std::thread::sleep(Duration::from_millis(800));
    daemon.signal(Signal::SIGCONT);
    wait_for("the run does not end", || (client.status().unwrap().state == RunState::Idle).then_some(()));
    let state = lab.session().state().unwrap();
    assert_eq!((state.end.as_ref().unwrap().state, state.missing_points()), (EndState::Complete, 0));
    assert!(state.counts.balanced(), "{:?}", state.counts);
}

#[test]
fn what_others_left_in_the_folders_does_not_hinder_a_start() {
    let lab = Lab::new();
    // The folder with which an earlier version tried whether it could write, and a lock that nobody holds.
    let mut daemon = lab.daemon_after("mkdir -p data/.raysweepd-$$; touch socket.lock");
    lab.client().status().unwrap();
    assert_eq!(mode(&lab.path("socket")), 0o666, "everybody may observe");
    daemon.signal(Signal::SIGTERM);
    assert!(daemon.wait().success());
    // A link in place of the lock is not followed.
    fs::remove_file(lab.path("socket.lock")).unwrap();
    symlink("victim", lab.path("socket.lock")).unwrap();
    assert!(!lab.daemon_after("true").wait().success());
    assert!(!lab.path("victim").exists());
}
