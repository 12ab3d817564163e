//! The whole sweep over a real wire: raysweepd with the driver `aravis`, the simulated GigE Vision camera, and the bench
//! beside it, each a process of its own. Without noise and jitter, what is stored must be what the scene gives for the
//! settings in the ledger, pixel for pixel, whatever the wire loses.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use ndarray::Axis;
use nix::sched::{CloneFlags, unshare};
use raysweep::rig::Rig;
use raysweep_core::{CameraSettings, Counts, FramePool, LossCause, Pattern, SettingsId, Shutter, ns_from_us};
use raysweep_proto::{Client, Event, RunParams};
use raysweep_session::Session;
use raysweep_session::ledger::PointEntry;
use raysweep_session::stack::ArrayName;
use raysweep_sim::bench::BenchProbe;
use raysweep_sim::gige::{Faults, WireTruth};
use raysweep_sim::{Devices, PlaneRig};

const RIG: &str = "kind = \"plane\"\n[camera]\npixel_format = \"Mono12p\"\ndriver = \"aravis\"\n\
                   aravis.address = \"127.0.0.1\"\naravis.trigger_latency_us = 8\n[vsync]\ndriver = \"sim\"\n\
                   [projector]\ndriver = \"sim\"\nrows = 32\nrow_time_us = 22.22\nfirst_row_us = 2200\n\
                   [sim]\nbench = \"bench.sock\"\nscene = \"v-groove\"\nscene_rows = 32\nscene_columns = 32\n\
                   [sim.sensor]\nnoise = false\n[sim.vsync]\njitter_us = 0\n";
const PLAN: &str = "kind = \"sweep\"\nname = \"wire\"\n[sweep]\naverage = 4\n\
                    delay_us = { start = -300, stop = 300, count = 7 }\nexposure_us = [400, 600]\n";
/// Ended with the test.
struct Process(Child);

impl Process {
    fn start(program: &str, arguments: &[&str]) -> Self {
        let mut command = Command::new(program);
        command.args(arguments).stdout(Stdio::null()).stderr(Stdio::null());
        Self(command.spawn().unwrap())
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Waits until something is there.
fn wait_for<T>(what: &str, mut look: impl FnMut() -> Option<T>) -> T {
    let patience = Instant::now() + Duration::from_secs(60);
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(Instant::now() < patience, "{what}");
        thread::sleep(Duration::from_millis(10));
    }
}

/// Runs the plan to its end and holds its images against the scene; `meanwhile` sees every event.
fn run(folder: &Path, mut meanwhile: impl FnMut(&Event)) -> Counts {
    let (rig, socket, data) = (folder.join("rig.toml"), folder.join("socket"), folder.join("sessions"));
    let arguments = [
        "--rig",
        rig.to_str().unwrap(),
        "--socket",
        socket.to_str().unwrap(),
        "--data",
        data.to_str().unwrap(),
    ];
    let _daemon = Process::start(env!("CARGO_BIN_EXE_raysweepd"), &arguments);
    let mut client = wait_for("the daemon does not listen", || Client::connect(&socket).ok());
    let events = Client::connect(&socket).unwrap().subscribe().unwrap();
    client.run(&RunParams { plan: PLAN.into(), ..RunParams::default() }).unwrap();
    for event in events {
        let event = event.unwrap();
        meanwhile(&event);
        if let Event::Finished { session, state, missing, .. } = event {
            assert_eq!((state.as_str(), missing), ("complete", 0));
            let session = Session::open(&session).unwrap();
            assert_images_of_the_scene(&session, &Rig::load(&rig).unwrap());
            let counts = session.state().unwrap().counts;
            assert!(counts.balanced(), "{counts:?}");
            return counts;
        }
    }
    panic!("the daemon ended before the run");
}

/// Each stored image is so many times what the scene gives for the settings that the ledger has of it.
fn assert_images_of_the_scene(session: &Session, rig: &Rig) {
    let state = session.state().unwrap();
    for (array, pattern) in [(ArrayName::Sum, Pattern::White), (ArrayName::Dark, Pattern::Black)] {
        let stored = session.stack().unwrap().read(array).unwrap();
        assert_eq!(state.stored(array).count(), stored.len_of(Axis(0)));
        for entry in state.stored(array) {
            let found = stored.index_axis(Axis(0), entry.index);
            let counts = scene_counts(rig, &pattern, entry);
            let expected = counts.iter().map(|count| count * entry.frames);
            let wrong = found.iter().zip(expected).filter(|(found, expected)| **found != *expected).count();
            assert_eq!(wrong, 0, "pixels of {array:?} {}, attempt {}", entry.index, entry.attempt);
        }
    }
}

/// One frame of the simulated camera itself, without wire or daemon, under an entry's settings.
fn scene_counts(rig: &Rig, pattern: &Pattern, entry: &PointEntry) -> Vec<u32> {
    let scene: &PlaneRig = rig.simulated();
    let Devices { mut camera, mut projector, vsync, .. } = scene.open();
    // Time waits for every device.
    drop(vsync);
    let (raster, format) = (rig.file.raster(), camera.capabilities().format);
    let latency_us = camera.capabilities().trigger_latency_us;
    let trigger = raster.trigger(scene.first_row(), entry.delay_us, entry.exposure_us, latency_us);
    let settings = CameraSettings {
        shutter: Shutter::Rolling,
        exposure_us: entry.exposure_us,
        trigger_delay_us: trigger.trigger_delay_us,
    };
    let applied = camera.configure(SettingsId { point: 0, attempt: 0 }, &settings).unwrap();
    let shown = projector.show(pattern).unwrap();
    camera.arm().unwrap();
    let pixels = camera.capabilities().width * camera.capabilities().height;
    let mut frame = FramePool::new(1, format.frame_bytes(pixels)).take();
    // Light of the period before may reach into the first frame.
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

/// Runs the plan over the wire, on a network of this test's own; `act` may interfere.
fn over_the_wire(
    more: &str,
    faults: &[&str],
    mut act: impl FnMut(&mut BenchProbe, &Event),
) -> (Counts, WireTruth) {
    unshare(CloneFlags::CLONE_NEWNET)
        .expect("a network namespace needs root: run `cargo xtask test` as root");
    assert!(Command::new("ip").args(["link", "set", "lo", "up"]).status().unwrap().success());
    let folder = tempfile::tempdir().unwrap();
    let bench = folder.path().join("bench.sock");
    let path = folder.path().join("rig.toml");
    std::fs::write(&path, format!("{RIG}{more}")).unwrap();
    let mut arguments = vec!["--rig", path.to_str().unwrap()];
    arguments.extend(faults.iter().flat_map(|fault| ["--fault", fault]));
    let _camera = Process::start(env!("CARGO_BIN_EXE_raysweep-sim-camera"), &arguments);
    let mut probe = wait_for("the camera does not start", || BenchProbe::open(&bench).ok());
    let counts = run(folder.path(), |event| act(&mut probe, event));
    (counts, probe.truth().unwrap().wire)
}

fn nothing(_: &mut BenchProbe, _: &Event) {}

#[test]
fn a_sweep_over_the_wire_stores_what_the_scene_gives() {
    let (counts, _) = over_the_wire("", &[], nothing);
    assert!(!counts.lost.contains_key(&LossCause::CameraLost), "{counts:?}");
}

#[test]
fn lost_packets_are_sent_again() {
    let (counts, wire) = over_the_wire("", &["packet_loss=0.01", "reordering=0.01"], nothing);
    assert!(wire.packets_lost > 0 && wire.packets_resent > 0, "{wire:?}");
    // Frames that resends hold up are taken for those that they are.
    assert!(!counts.lost.contains_key(&LossCause::SettingsMismatch), "{counts:?}");
}

#[test]
fn packets_that_nobody_sends_again_cost_frames_and_no_image() {
    let faults = ["packet_loss=0.05", "resend=false", "reordering=0.02"];
    let (counts, _) = over_the_wire("", &faults, nothing);
    assert!(counts.lost[&LossCause::PacketsLost] > 0, "{counts:?}");
}

#[test]
fn settings_that_act_late_now_and_then_mislabel_nothing() {
    over_the_wire("[sim.camera]\nlate_frames_min = 0\nlate_frames_max = 3\n", &[], nothing);
}

#[test]
fn settings_that_act_three_frames_late_mislabel_nothing() {
    over_the_wire("[sim.camera]\nlate_frames_min = 3\nlate_frames_max = 3\n", &[], nothing);
}

#[test]
fn a_camera_that_dies_in_the_middle_costs_the_frames_of_its_absence() {
    let mut died = None;
    let (counts, _) = over_the_wire("", &[], |probe, event| match (event, died) {
        (Event::Progress(progress), None) if progress.points_stored >= 3 => {
            probe.set_faults(Faults { dead: true, ..Faults::default() }).unwrap();
            thread::sleep(Duration::from_secs(2));
            died = Some(());
            probe.set_faults(Faults::default()).unwrap();
        }
        _ => {}
    });
    assert!(died.is_some());
    assert!(counts.lost[&LossCause::CameraLost] > 0, "{counts:?}");
}
