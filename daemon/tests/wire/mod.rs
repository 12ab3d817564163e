//! The whole rig over a real network connection: raysweepd with the driver `aravis`, and the simulated GigE Vision
//! camera with its bench socket, each in its own process. Without noise and jitter, stored data must match the scene
//! under the settings in the ledger, pixel for pixel, whatever the network loses.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot go on may panic")]

#[path = "../process/mod.rs"]
mod process;

use std::fs::{self, File};
use std::path::Path;
use std::process::{Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use ndarray::Axis;
use nix::sched::{CloneFlags, unshare};
use process::{Process, wait_for};
use raysweep::rig::Rig;
use raysweep_config::{FilmPlan, Plan, Procedure};
use raysweep_core::{CameraSettings, Counts, FramePool, Pattern, SettingsId, Shutter, ns_from_us};
use raysweep_proto::{Client, Event, RunParams};
use raysweep_session::Session;
use raysweep_session::ledger::EndEntry;
use raysweep_session::stack::ArrayName;
use raysweep_sim::bench::BenchProbe;
use raysweep_sim::gige::{Faults, WireTruth};
use raysweep_sim::{PlaneDevices, PlaneRig};

/// Time from the simulated camera's trigger to its exposure at zero delay.
const LATENCY_US: f64 = 8.0;

/// A sweep or a film, with faults and actions during the run.
pub struct Sweep<'a> {
    /// Rows and columns of the scene, and rows of the projector.
    pub side_px: usize,
    /// Kind of plan: `sweep`, or `film`, which must use the camera's sequencer if the camera has enough sets.
    pub kind: &'a str,
    /// Contents of the plan's `[sweep]` or `[film]`.
    pub plan: &'a str,
    /// Contents of `[sim.camera]`.
    pub camera: &'a str,
    /// Network faults from the start, each as `key=value`.
    pub faults: &'a [&'a str],
    /// An action, and the number of stored points or cycles that triggers it.
    pub then: Option<(usize, Then)>,
}

/// An action during a run.
#[allow(dead_code, reason = "the benchmark needs not all of it")]
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Then {
    /// The camera loses power for two seconds, or for longer if the daemon takes longer to notice.
    Dies,
    /// The film is paused and continued.
    IsHeld,
    /// The film is cancelled.
    IsCancelled,
}

/// Result of a run.
pub struct Swept {
    /// Accounting of the frames.
    pub counts: Counts,
    /// Ground truth of what the camera sent.
    pub wire: WireTruth,
    /// How the run ended.
    pub end: EndEntry,
}

impl Sweep<'_> {
    /// Runs the plan in a separate network namespace and compares its images with the scene.
    pub fn run(&self) -> Swept {
        unshare(CloneFlags::CLONE_NEWNET)
            .expect("a network namespace needs root: run `cargo xtask test` as root");
        assert!(Command::new("ip").args(["link", "set", "lo", "up"]).status().unwrap().success());
        let folder = tempfile::tempdir().unwrap();
        let rig = folder.path().join("rig.toml");
        fs::write(&rig, self.rig()).unwrap();
        let mut arguments = vec!["--rig", rig.to_str().unwrap()];
        arguments.extend(self.faults.iter().flat_map(|fault| ["--fault", fault]));
        let _camera = start(env!("CARGO_BIN_EXE_raysweep-sim-camera"), &arguments, Stdio::null());
        let bench = folder.path().join("bench.sock");
        let mut probe = wait_for("the camera does not start", || BenchProbe::open(&bench).ok());
        let session = self.run_daemon(folder.path(), &mut probe);
        let rig = Rig::load(&rig).unwrap();
        if self.is_cancelled() {
            assert_camera_is_left_as_set(&rig, &self.parsed());
        }
        if self.kind == "film" {
            let (stored, plan) = (session.state().unwrap().cycles().count(), self.parsed());
            assert!(stored > 0, "too few to prove anything");
            assert_frames_of_the_scene(&session, &rig, &plan);
        } else {
            assert_images_of_the_scene(&session, &rig);
        }
        let state = session.state().unwrap();
        assert!(state.counts.balanced(), "{:?}", state.counts);
        Swept { counts: state.counts, wire: probe.truth().unwrap().wire, end: state.end.unwrap() }
    }

    fn rig(&self) -> String {
        let Self { side_px, camera, .. } = self;
        format!(
            "kind = \"plane\"\n[camera]\npixel_format = \"Mono12p\"\ndriver = \"aravis\"\n\
             aravis.address = \"127.0.0.1\"\naravis.trigger_latency_us = {LATENCY_US}\n[vsync]\ndriver = \"sim\"\n\
             [projector]\ndriver = \"sim\"\nrows = {side_px}\nrow_time_us = 22.22\nfirst_row_us = 2200\n\
             [sim]\nbench = \"bench.sock\"\nscene = \"v-groove\"\nscene_rows = {side_px}\n\
             scene_columns = {side_px}\n[sim.sensor]\nnoise = false\n[sim.vsync]\njitter_us = 0\n\
             [sim.camera]\n{camera}"
        )
    }

    /// Whether the simulated camera has as many sets as the film has settings.
    fn has_sets(&self) -> bool {
        self.parsed().delay_us.values().len() <= 16
    }

    fn is_cancelled(&self) -> bool {
        matches!(self.then, Some((_, Then::IsCancelled)))
    }

    fn parsed(&self) -> FilmPlan {
        let Procedure::Film(film) = Plan::parse(&self.plan()).unwrap().procedure else { panic!("a film") };
        film
    }

    fn plan(&self) -> String {
        let Self { kind, plan, .. } = self;
        format!("kind = \"{kind}\"\nname = \"wire\"\n[{kind}]\n{plan}")
    }

    fn run_daemon(&self, folder: &Path, probe: &mut BenchProbe) -> Session {
        let (rig, socket, data) = (folder.join("rig.toml"), folder.join("socket"), folder.join("sessions"));
        let arguments = [("--rig", &rig), ("--socket", &socket), ("--data", &data)];
        let arguments = arguments.iter().flat_map(|(flag, path)| [*flag, path.to_str().unwrap()]);
        let log = folder.join("log");
        let stderr = File::create(&log).unwrap().into();
        let _daemon = start(env!("CARGO_BIN_EXE_raysweepd"), &arguments.collect::<Vec<_>>(), stderr);
        let mut client = wait_for("the daemon does not listen", || Client::connect(&socket).ok());
        let events = Client::connect(&socket).unwrap().subscribe().unwrap();
        client.run(&RunParams { plan: self.plan(), ..RunParams::default() }).unwrap();
        let mut then = self.then;
        let mut held = None;
        // Number of settings written by the time the first cycle of a film was stored, which follows its dark image.
        let mut before = None;
        let written = |probe: &mut BenchProbe| probe.truth().unwrap().wire.settings_written;
        for event in events {
            match event.unwrap() {
                Event::Progress(progress)
                    if then.is_some_and(|(points, _)| progress.points_stored >= points) =>
                {
                    match then.take() {
                        Some((_, Then::Dies)) => {
                            probe.set_faults(Faults { dead: true, ..Faults::default() }).unwrap();
                            thread::sleep(Duration::from_secs(2));
                            wait_for("the camera's loss is not noticed", || {
                                fs::read_to_string(&log).unwrap().contains("camera lost").then_some(())
                            });
                            probe.set_faults(Faults::default()).unwrap();
                        }
                        Some((_, Then::IsHeld)) => held = Some(hold(&mut client)),
                        _ => client.cancel().unwrap(),
                    }
                }
                Event::Progress(progress) if before.is_none() && progress.points_stored > 1 => {
                    before = Some(written(probe));
                }
                Event::Finished { session, state, stored, missing, error, .. } => {
                    let expected = if self.is_cancelled() { "cancelled" } else { "complete" };
                    assert_eq!(state, expected, "{error:?}");
                    assert!(missing == 0 || self.kind == "film", "{missing} points");
                    assert_eq!(then, None, "it did not happen");
                    if self.kind == "film" && self.then.is_none() {
                        let (film, before, after) = (self.parsed(), before.unwrap(), written(probe));
                        let frames = (stored * film.delay_us.values().len()) as u64;
                        let told = format!("{before}, then {after} settings for {frames} frames");
                        // Sets are written before the film; otherwise each frame needs a setting.
                        match self.has_sets() {
                            true => assert!(after - before < u64::from(film.cycles / 2), "{told}"),
                            false => assert!(after >= frames, "{told}"),
                        }
                    }
                    let session = Session::open(&session).unwrap();
                    if let Some(held) = held {
                        assert_is_held(&session, held);
                    }
                    return session;
                }
                _ => {}
            }
        }
        panic!("the daemon ended before the run");
    }
}

/// Reads the camera's features with an independent client.
fn camera_says(features: &[&str]) -> String {
    let arguments = [&["-a", "127.0.0.1", "control"], features].concat();
    let output = Command::new("arv-tool-0.8").args(arguments).output().expect("aravis-tools is installed");
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Pauses and continues a film that uses the camera's sequencer. Returns for how long nothing may have been exposed.
fn hold(client: &mut Client) -> Duration {
    let wait_for_sequencer = |mode: &str| {
        wait_for("the sequencer is not told", || {
            camera_says(&["SequencerMode"]).contains(&format!("SequencerMode = {mode}")).then_some(())
        });
    };
    wait_for_sequencer("On");
    client.pause().unwrap();
    wait_for_sequencer("Off");
    let since = Instant::now();
    thread::sleep(Duration::from_secs(1));
    let held = since.elapsed();
    client.go_on().unwrap();
    wait_for_sequencer("On");
    held
}

/// No frame of a stored cycle was exposed for that time. (When frames were stored says nothing: those of before a pause may
/// be stored in the midst of it.)
fn assert_is_held(session: &Session, held: Duration) {
    let state = session.state().unwrap();
    let starts_ns: Vec<i64> = state.cycles().flat_map(|cycle| cycle.starts_ns.clone()).collect();
    let longest_ns = starts_ns.windows(2).map(|pair| pair[1] - pair[0]).max().unwrap();
    // The camera's clock need not go like this machine's.
    assert!(longest_ns as f64 > 0.99 * held.as_nanos() as f64, "at most {longest_ns} ns, not {held:?}");
}

/// The camera's sequencer is off, and the camera has the settings written last: those of the cycle's first position,
/// which differ from those of the last saved set. Settings can be written again.
fn assert_camera_is_left_as_set(rig: &Rig, plan: &FilmPlan) {
    let exposure_us = plan.exposure_us;
    let trigger_delay_us = trigger_delay_us(rig, plan.delay_us.values()[6], exposure_us);
    let lines = [
        "SequencerMode = Off".to_owned(),
        "SequencerConfigurationMode = Off".to_owned(),
        format!("ExposureTime = {exposure_us} us"),
        format!("TriggerDelay = {trigger_delay_us:.2} us"),
        "ExposureTime = 765.25 us".to_owned(),
    ];
    let features = ["SequencerMode", "SequencerConfigurationMode", "ExposureTime", "TriggerDelay"];
    let features = [&features[..], &["ExposureTime=765.25", "ExposureTime"]].concat();
    let found = camera_says(&features);
    assert!(lines.iter().all(|line| found.contains(line)), "{lines:?}: {found}");
}

fn start(program: &str, arguments: &[&str], stderr: Stdio) -> Process {
    Process::start(Command::new(program).args(arguments).stdout(Stdio::null()).stderr(stderr))
}

/// Each stored image is the scene's image under the settings in the ledger, times the number of frames.
fn assert_images_of_the_scene(session: &Session, rig: &Rig) {
    let state = session.state().unwrap();
    for (array, pattern) in [(ArrayName::Sum, Pattern::White), (ArrayName::Dark, Pattern::Black)] {
        let stored = session.stack().unwrap().read(array).unwrap();
        assert_eq!(state.stored(array).count(), stored.len_of(Axis(0)));
        for entry in state.stored(array) {
            let found = stored.index_axis(Axis(0), entry.index);
            let counts = scene_counts(rig, &pattern, entry.delay_us, entry.exposure_us);
            let expected = counts.iter().map(|count| count * entry.frames);
            let wrong = found.iter().zip(expected).filter(|(found, expected)| **found != *expected).count();
            assert_eq!(wrong, 0, "pixels of {array:?} {}, attempt {}", entry.index, entry.attempt);
        }
    }
}

/// Each frame of a stored cycle is the scene's image under its setting.
fn assert_frames_of_the_scene(session: &Session, rig: &Rig, plan: &FilmPlan) {
    let settings = plan.delay_us.values();
    let expected: Vec<Vec<u32>> = settings
        .iter()
        .map(|&delay_us| scene_counts(rig, &Pattern::White, delay_us, plan.exposure_us))
        .collect();
    let (film, state) = (session.film().unwrap(), session.state().unwrap());
    for cycle in state.cycles() {
        let frames = film.read(cycle.cycle).unwrap().unwrap();
        for (setting, (frame, expected)) in frames.outer_iter().zip(&expected).enumerate() {
            let wrong =
                frame.iter().zip(expected).filter(|(found, expected)| u32::from(**found) != **expected);
            assert_eq!(wrong.count(), 0, "pixels of setting {setting} in cycle {}", cycle.cycle);
        }
    }
}

/// Counts of one frame of the simulated camera, without network and daemon.
fn scene_counts(rig: &Rig, pattern: &Pattern, delay_us: f64, exposure_us: f64) -> Vec<u32> {
    let scene: &PlaneRig = rig.simulated().unwrap();
    let PlaneDevices { mut camera, mut projector, vsync, .. } = scene.open();
    // Virtual time waits for every device.
    drop(vsync);
    let (raster, format) = (rig.file.raster(), camera.capabilities().format);
    let trigger_delay_us = trigger_delay_us(rig, delay_us, exposure_us);
    let settings = CameraSettings { shutter: Shutter::Rolling, exposure_us, trigger_delay_us };
    let applied = camera.configure(SettingsId { point: 0, attempt: 0 }, &settings).unwrap();
    let shown = projector.show(pattern).unwrap();
    camera.arm().unwrap();
    let pixels = camera.capabilities().width * camera.capabilities().height;
    let mut frame = FramePool::new(1, format.frame_bytes(pixels)).take();
    // Light of the previous period may reach into the first frame.
    let from_ns = shown.not_before_ns + ns_from_us(raster.period_us);
    loop {
        let stamp = camera.next_frame(&mut frame, Duration::from_secs(1)).unwrap().unwrap();
        if stamp.exposure_start_ns >= from_ns && stamp.seq >= applied.first_frame.certain() {
            break;
        }
    }
    let mut counts = vec![0; pixels];
    format.add_to(&frame, &mut counts).unwrap();
    counts
}

/// Trigger delay for a delay and an exposure.
fn trigger_delay_us(rig: &Rig, delay_us: f64, exposure_us: f64) -> f64 {
    let scene: &PlaneRig = rig.simulated().unwrap();
    rig.file.raster().trigger(scene.first_row(), delay_us, exposure_us, LATENCY_US).trigger_delay_us
}
