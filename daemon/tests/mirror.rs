//! Runs on a rig with a mirror on a serial line: the path reaches the mirror bit for bit, and however the daemon ends,
//! it leaves the mirror parked with the light off. The time that takes is printed.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod process;

use std::fs;
use std::os::unix::fs::symlink;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::sync::Arc;
use std::time::{Duration, Instant};

use nix::sys::signal::Signal;
use process::{HUNG, Process, wait_for};
use raysweep::control::Control;
use raysweep::mirror::state_file;
use raysweep::rig::AnyRig;
use raysweep::{Probes, Runner};
use raysweep_config::{DotRigFile, Plan, Procedure};
use raysweep_core::{Clock, MirrorLimits};
use raysweep_drivers::mirror::playzerx::protocol::MirrorSample;
use raysweep_drivers::mirror::{Parked, park};
use raysweep_pipeline::dots::{ColumnStage, ColumnWorker};
use raysweep_proto::{Client, Event, RunParams, RunState};
use raysweep_sim::mirror::{
    Held, MirrorPty, PlayzerXController, PlayzerXControllerConfig, SerialLink, WireFaults,
};
use raysweep_transport::dots::{Background, DotsError, NoiseFloor, SparseColumn};
use serde_json::Value;
use tempfile::TempDir;

/// 6500 samples and 50 dots per batch: few enough frames for any machine.
fn plan(count: u32) -> String {
    format!(
        "kind = \"batches\"\nname = \"mirror\"\n[batches]\ncount = {count}\ndots = 50\nexposure_us = 70\n\
         trailing_region = [16, 32, 0, 32]\ndark_frames = 50\ncalibration = []\n\
         [batches.path]\namplitude_deg = [2.3, 1.3]\nlines = 40\n"
    )
}

struct Lab {
    pty: MirrorPty,
    folder: TempDir,
}

impl Lab {
    fn new() -> Self {
        let controller = PlayzerXController::new(PlayzerXControllerConfig::default());
        let pty = MirrorPty::plug(controller, SerialLink::VirtualCom, WireFaults::default()).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let rig = format!(
            "kind = \"dots\"\n[camera]\ndriver = \"sim\"\n[mirror]\ndriver = \"playzerx\"\nport = \"{}\"\n\
             interlock = \"{}\"\n[sim.dots]\nrows = 16\ncolumns = 32\n",
            pty.path().display(),
            folder.path().join("interlock").display()
        );
        fs::write(folder.path().join("interlock"), "1\n").unwrap();
        fs::write(folder.path().join("rig.toml"), rig).unwrap();
        Self { pty, folder }
    }

    fn data(&self) -> PathBuf {
        self.folder.path().join("data")
    }

    fn socket(&self) -> PathBuf {
        self.folder.path().join("socket")
    }

    fn daemon(&self) -> Process {
        let mut command = Command::new(env!("CARGO_BIN_EXE_raysweepd"));
        command
            .arg("--rig")
            .arg(self.folder.path().join("rig.toml"))
            .arg("--socket")
            .arg(self.socket())
            .arg("--data")
            .arg(self.data())
            .stderr(fs::File::create(self.folder.path().join("log")).map_or(Stdio::null(), Stdio::from));
        Process::start(&mut command)
    }

    fn log(&self) -> String {
        fs::read_to_string(self.folder.path().join("log")).unwrap_or_default()
    }

    fn client(&self) -> Client {
        wait_for("the daemon does not listen", || Client::connect(self.socket()).ok())
    }

    /// Starts a run and waits until the mirror has played a number of samples with light.
    fn play(&self, count: u32, samples: usize) -> Process {
        self.play_plan(plan(count), samples)
    }

    fn play_plan(&self, plan: String, samples: usize) -> Process {
        let daemon = self.daemon();
        let params = RunParams { plan, ..RunParams::default() };
        let mut client = self.client();
        client.run(&params).unwrap();
        let began = Instant::now();
        while self.lit() < samples {
            let has_faulted = client.status().unwrap().state == RunState::Faulted;
            assert!(!has_faulted && began.elapsed() < HUNG, "no light\n{}", self.log());
            std::thread::sleep(Duration::from_millis(5));
        }
        daemon
    }

    fn lit(&self) -> usize {
        self.pty.look(|truth| truth.held.iter().filter(|held| held.light > 0).count())
    }

    /// Waits until the run has ended; returns state and error.
    fn ended(&self) -> (RunState, Option<String>) {
        let mut client = self.client();
        let began = Instant::now();
        loop {
            let status = client.status().unwrap();
            if matches!(status.state, RunState::Idle | RunState::Faulted) {
                return (status.state, status.error);
            }
            assert!(began.elapsed() < HUNG, "{status:?}");
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// What a batch of [`plan`] is on the wire.
    fn codes(&self) -> Vec<Held> {
        let rig =
            DotRigFile::parse(&fs::read_to_string(self.folder.path().join("rig.toml")).unwrap()).unwrap();
        let Procedure::Batches(plan) = Plan::parse(&plan(1)).unwrap().procedure else { panic!("batches") };
        let path = plan.mirror_path(&rig.limits()).unwrap();
        let samples =
            path.points().iter().map(|point| MirrorSample::of(*point, MirrorLimits::A7B2_3_3600AL.max_tilt));
        samples.map(|MirrorSample { x, y, light }| Held { x: f64::from(x), y: f64::from(y), light }).collect()
    }

    /// Waits until the light is off and then the mirror is parked, without any step on the way; prints the times.
    fn assert_parked(&self, way: &str, since_ns: i64) {
        self.assert_parked_with_steps(way, since_ns, MAX_STEP_CODES);
    }

    /// The same after the end of a process that played [`plan`]: if it died within a write, the place from which the
    /// mirror is taken to its origin is known to half a write, or 32 samples.
    fn assert_parked_after_kill(&self, way: &str, since_ns: i64) {
        let half_a_write =
            self.codes().windows(33).map(|held| step_codes(&held[0], &held[32])).fold(0.0, f64::max);
        self.assert_parked_with_steps(way, since_ns, half_a_write.max(MAX_STEP_CODES));
    }

    fn assert_parked_with_steps(&self, way: &str, since_ns: i64, most_codes: f64) {
        let began = Instant::now();
        let (dark_ns, parked_ns) = loop {
            let parked = self.pty.look(|truth| truth.dark_since_ns.zip(truth.parked_since_ns));
            if let Some(parked) = parked {
                break parked;
            }
            assert!(began.elapsed() < HUNG, "{way}: not parked\n{}", self.log());
            std::thread::sleep(Duration::from_millis(2));
        };
        assert!(dark_ns <= parked_ns);
        let held = self.pty.truth().held;
        let step = held.windows(2).map(|pair| step_codes(&pair[0], &pair[1])).fold(0.0, f64::max);
        // Two codes: rounding at both ends.
        let allowed = most_codes + 2.0;
        assert!(step <= allowed, "{way}: a step of {step} codes, {allowed} are allowed\n{}", self.log());
        let ms = |ns: i64| (ns - since_ns) as f64 / 1e6;
        println!("{way}: light off after {:.1} ms, mirror parked after {:.1} ms", ms(dark_ns), ms(parked_ns));
    }

    /// Waits until the mirror's previous user has recorded that it is parked.
    fn assert_noted(&self) {
        let began = Instant::now();
        loop {
            match park(&state_file(&self.data())) {
                Ok(parked) => {
                    return assert_eq!(parked, Parked::Already, "somebody else has parked it before");
                }
                Err(error) => assert!(began.elapsed() < HUNG, "{error}"),
            }
        }
    }
}

/// The longest step between two samples that the mirror may be asked for.
const MAX_STEP_CODES: f64 = MirrorLimits::A7B2_3_3600AL.max_step.0 / 6.5 * 2047.0;

fn step_codes(from: &Held, to: &Held) -> f64 {
    (to.x - from.x).abs().max((to.y - from.y).abs())
}

fn now_ns() -> i64 {
    Clock::real().now_ns()
}

#[test]
fn sixty_batches_reach_the_mirror_bit_for_bit() {
    let lab = Lab::new();
    let _daemon = lab.daemon();
    let events = lab.client().subscribe().unwrap();
    // Two more batches are played than requested, because the first one has no beginning.
    lab.client().run(&RunParams { plan: plan(58), ..RunParams::default() }).unwrap();
    let finished = events.into_iter().find_map(|event| match event.unwrap() {
        Event::Finished { state, error, .. } => Some((state, error)),
        _ => None,
    });
    assert_eq!(finished, Some(("complete".into(), None)), "{}", lab.log());
    let truth = lab.pty.truth();
    assert_eq!((truth.underruns, truth.overfills), (0, 0));
    let codes = lab.codes();
    assert_eq!(codes.len(), 6500);
    let first = codes.iter().position(|held| held.light > 0).unwrap();
    let begin = truth.held.iter().position(|held| held.light > 0).unwrap() - first;
    assert!(truth.held.len() >= begin + 390_000);
    for (batch, held) in truth.held[begin..begin + 390_000].chunks(6500).enumerate() {
        assert!(held == codes, "batch {batch} differs");
    }
    lab.assert_parked("the run's end, after the last light", truth.dark_since_ns.unwrap());
    lab.assert_noted();
}

#[test]
fn cancel() {
    let lab = Lab::new();
    let _daemon = lab.play(1000, 20_000);
    let status = lab.client().status().unwrap().mirror.unwrap();
    assert!(status.laser && !status.parked, "{status:?}");
    assert_eq!(status.light, "interlock_closed");
    let since_ns = now_ns();
    lab.client().cancel().unwrap();
    lab.assert_parked("cancel", since_ns);
    assert_eq!(lab.ended().0, RunState::Idle);
    let status = lab.client().status().unwrap().mirror.unwrap();
    assert!(!status.laser && status.parked, "{status:?}\n{}", lab.log());
}

#[test]
fn interlock() {
    let lab = Lab::new();
    let _daemon = lab.play(1000, 20_000);
    let since_ns = now_ns();
    fs::write(lab.folder.path().join("interlock"), "0\n").unwrap();
    lab.assert_parked("interlock opened", since_ns);
    let (state, error) = lab.ended();
    assert_eq!(state, RunState::Faulted);
    let error = error.unwrap();
    assert!(error.contains("interlock"), "{error}");
    let status = lab.client().status().unwrap().mirror.unwrap();
    assert_eq!((status.light.as_str(), status.parked), ("interlock_open", true));
}

/// A host that is too slow: the daemon is stopped for longer than the controller's 125,000 samples last.
#[test]
fn underrun() {
    let lab = Lab::new();
    let daemon = lab.play(1000, 20_000);
    daemon.signal(Signal::SIGSTOP);
    let began = Instant::now();
    // It may stand where the path itself rests: then the simulator counts no underrun.
    let played = || lab.pty.look(|truth| truth.held.len());
    let (mut last, mut moved) = (played(), Instant::now());
    while moved.elapsed() < Duration::from_secs(1) {
        assert!(began.elapsed() < HUNG, "the FIFO does not run dry");
        if played() > last {
            (last, moved) = (played(), Instant::now());
        }
        std::thread::sleep(Duration::from_millis(5));
    }
    let since_ns = now_ns();
    daemon.signal(Signal::SIGCONT);
    lab.assert_parked("underrun, from when the daemon goes on", since_ns);
    let (state, error) = lab.ended();
    assert_eq!(state, RunState::Faulted);
    let error = error.unwrap();
    assert!(error.contains("ran out of samples"), "{error}");
}

#[test]
fn unplug() {
    let mut lab = Lab::new();
    let _daemon = lab.play(1000, 20_000);
    let since_ns = now_ns();
    // Unplugging cuts the power: the light goes off and the mirror springs back.
    lab.pty.unplug();
    let (state, error) = lab.ended();
    assert_eq!(state, RunState::Faulted);
    let error = error.unwrap();
    assert!(error.contains("the controller is gone"), "{error}");
    println!("unplug: the run had ended after {:.1} ms", (now_ns() - since_ns) as f64 / 1e6);
    let status = lab.client().status().unwrap().mirror.unwrap();
    assert!(!status.parked, "nobody takes it for parked: {status:?}");
}

#[test]
fn sigterm() {
    let lab = Lab::new();
    let mut daemon = lab.play(1000, 20_000);
    let since_ns = now_ns();
    daemon.signal(Signal::SIGTERM);
    lab.assert_parked("SIGTERM", since_ns);
    assert!(daemon.wait().success(), "{}", lab.log());
    println!("SIGTERM: the daemon had ended after {:.1} ms", (now_ns() - since_ns) as f64 / 1e6);
    lab.assert_noted();
}

#[test]
fn sigkill() {
    let lab = Lab::new();
    let mut daemon = lab.play(1000, 20_000);
    let since_ns = now_ns();
    daemon.signal(Signal::SIGKILL);
    daemon.wait();
    lab.assert_parked_after_kill("SIGKILL, by the guardian", since_ns);
    lab.assert_noted();
}

/// A stage that panics on every frame.
struct Panicking;

impl ColumnStage for Panicking {
    fn worker(&self) -> Box<dyn ColumnWorker> {
        Box::new(Self)
    }
}

impl ColumnWorker for Panicking {
    fn column(
        &mut self,
        _: &[u16],
        _: &Background,
        _: NoiseFloor,
        _: &mut SparseColumn,
    ) -> Result<(), DotsError> {
        panic!("as planned");
    }
}

/// A panicking stage costs only its frames: the run continues, and the mirror is parked at its end.
#[test]
fn panic_in_a_stage() {
    let lab = Lab::new();
    let probes = Probes { column_stage: Some(Arc::new(|_| Arc::new(Panicking))), ..Probes::default() };
    let rig = AnyRig::load(&lab.folder.path().join("rig.toml")).unwrap();
    fs::create_dir(lab.data()).unwrap();
    let runner = Runner::new(rig, lab.data()).unwrap().with_probes(probes);
    runner.run(RunParams { plan: plan(3), ..RunParams::default() }).unwrap();
    let began = Instant::now();
    while !matches!(runner.status().state, RunState::Idle | RunState::Faulted) {
        assert!(began.elapsed() < HUNG, "{:?}", runner.status());
        std::thread::sleep(Duration::from_millis(5));
    }
    let ended_ns = now_ns();
    assert!(lab.lit() > 0);
    let dark_ns = lab.pty.look(|truth| truth.dark_since_ns).unwrap();
    lab.assert_parked("panic in a stage, after the last light", dark_ns);
    assert!(lab.pty.look(|truth| truth.parked_since_ns).unwrap() <= ended_ns, "before the run ends");
    lab.assert_noted();
}

#[test]
fn no_light_without_a_word() {
    let lab = Lab::new();
    fs::write(lab.folder.path().join("interlock"), "0\n").unwrap();
    let _daemon = lab.daemon();
    lab.client().run(&RunParams { plan: plan(2), ..RunParams::default() }).unwrap();
    let (state, error) = lab.ended();
    assert_eq!(state, RunState::Faulted);
    assert!(error.as_ref().is_some_and(|said| said.contains("close the enclosure")), "{error:?}");
    assert_eq!(lab.lit(), 0);
}

/// A viewfinder holds the dot aside. Whatever ends it, the light goes off before the mirror returns.
#[test]
fn viewfinder() {
    let plan = || "kind = \"viewfinder\"\n[viewfinder]\ntilt_deg = [2.0, -1.0]\n".to_owned();
    let lab = Lab::new();
    let daemon = lab.play_plan(plan(), 5000);
    let since_ns = now_ns();
    lab.client().cancel().unwrap();
    lab.assert_parked("viewfinder cancelled", since_ns);
    assert_eq!(lab.ended(), (RunState::Idle, None));
    drop(daemon);

    let lab = Lab::new();
    let _daemon = lab.play_plan(plan(), 5000);
    let since_ns = now_ns();
    fs::write(lab.folder.path().join("interlock"), "0\n").unwrap();
    lab.assert_parked("viewfinder, interlock opened", since_ns);
    let (state, error) = lab.ended();
    assert_eq!(state, RunState::Faulted);
    let error = error.unwrap();
    assert!(error.contains("interlock"), "{error}");
    // It gets no light either if it begins like this.
    let lit = lab.lit();
    lab.client().run(&RunParams { plan: plan(), ..RunParams::default() }).unwrap();
    assert!(lab.ended().1.unwrap().contains("close the enclosure"));
    assert_eq!(lab.lit(), lit);

    let lab = Lab::new();
    let mut daemon = lab.play_plan(plan(), 5000);
    let since_ns = now_ns();
    daemon.signal(Signal::SIGTERM);
    lab.assert_parked("viewfinder, SIGTERM", since_ns);
    assert!(daemon.wait().success(), "{}", lab.log());
    lab.assert_noted();
}

#[test]
fn parking_what_was_never_moved_is_a_failure_unless_only_what_was_moved_is_to_be_parked() {
    let folder = tempfile::tempdir().unwrap();
    let park = |more: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
        let output = command
            .current_dir(&folder)
            .args(["park", "--state", "mirror.json"])
            .args(more)
            .output()
            .unwrap();
        (output.status.code(), String::from_utf8(output.stdout).unwrap())
    };
    let (code, said) = park(&[]);
    assert!(code == Some(1) && said.contains("mirror.json does not exist: nothing was parked"), "{said}");
    assert_eq!(park(&["--if-moved"]), (Some(0), String::new()));
}

/// Nothing is known of a mirror whose state cannot be read: it must not pass for a parked one.
#[test]
fn a_state_that_cannot_be_read_is_no_parked_mirror() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    fs::create_dir(path("folder")).unwrap();
    symlink("loop", path("loop")).unwrap();
    let (sound, torn) = (r#"{"playing": null}"#, r#"{"boot_id": "#);
    let files: [(&str, &[u8]); 4] =
        [("empty", b""), ("other", sound.as_bytes()), ("torn", torn.as_bytes()), ("bytes", &[0, 0xff, 0])];
    for (name, content) in files {
        fs::write(path(name), content).unwrap();
    }
    let park = |state: &str, more: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
        let output =
            command.current_dir(&folder).args(["park", "--state", state]).args(more).output().unwrap();
        let text = |bytes| String::from_utf8(bytes).unwrap();
        (output.status.code(), text(output.stdout), text(output.stderr))
    };
    for state in ["folder", "loop", "empty", "other", "torn", "bytes", "empty/mirror.json"] {
        for more in [&[] as &[&str], &["--if-moved"], &["--when-closed"]] {
            let (code, out, err) = park(state, more);
            assert_eq!((code, out.as_str()), (Some(1), ""), "{state} {more:?}: {err}");
            assert!(err.contains(state) && !err.contains("parked"), "{state} {more:?}: {err}");
        }
        let (code, out, _) = park(state, &["--json"]);
        let said: Value = serde_json::from_str(&out).unwrap();
        assert!(
            code == Some(1) && said["error"].is_object() && said.get("parked").is_none(),
            "{state}: {said}"
        );
    }
    for more in [&[] as &[&str], &["--when-closed"]] {
        let (code, out, _) = park("/nonexistent/mirror.json", more);
        assert!(
            code == Some(1) && out.contains("/nonexistent/mirror.json does not exist: nothing was parked"),
            "{more:?}: {out}"
        );
    }
    let (code, out, _) = park("/nonexistent/mirror.json", &["--json"]);
    assert_eq!((code, out.trim()), (Some(1), r#"{"parked":"nothing"}"#));
}
