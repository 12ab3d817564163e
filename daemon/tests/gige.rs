//! The whole sweep over a real wire: raysweepd with the driver `aravis`, the simulated GigE Vision camera, and the bench
//! beside it, each a process of its own. What is stored must be what the simulated devices store, whatever the wire loses.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread;
use std::time::{Duration, Instant};

use ndarray::Array3;
use nix::sched::{CloneFlags, unshare};
use raysweep_core::{Counts, LossCause};
use raysweep_proto::{Client, Event, RunParams};
use raysweep_session::Session;
use raysweep_session::stack::ArrayName;
use raysweep_sim::bench::BenchProbe;
use raysweep_sim::gige::Faults;

/// Without noise and jitter, so that stacks can be compared pixel by pixel.
const SIM: &str = "[vsync]\ndriver = \"sim\"\n\
                   [projector]\ndriver = \"sim\"\nrows = 32\nrow_time_us = 22.22\nfirst_row_us = 2200\n\
                   [sim]\nscene = \"v-groove\"\nscene_rows = 32\nscene_columns = 32\n\
                   [sim.sensor]\nnoise = false\n[sim.vsync]\njitter_us = 0\n";
const PLAN: &str = "kind = \"sweep\"\nname = \"wire\"\n[sweep]\naverage = 4\n\
                    delay_us = { start = -300, stop = 300, count = 7 }\nexposure_us = [400, 600]\n";
const FRAMES: u32 = 4;

fn rig(camera: &str, more: &str) -> String {
    format!("kind = \"plane\"\n[camera]\npixel_format = \"Mono12p\"\n{camera}\n{SIM}{more}")
}

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

/// Runs the plan to its end; `meanwhile` sees every event.
fn run(folder: &Path, mut meanwhile: impl FnMut(&Event)) -> (Array3<u32>, Counts) {
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
            let counts = session.state().unwrap().counts;
            assert!(counts.balanced(), "{counts:?}");
            return (session.stack().unwrap().read(ArrayName::Sum).unwrap(), counts);
        }
    }
    panic!("the daemon ended before the run");
}

/// What the simulated devices store.
fn reference() -> Array3<u32> {
    let folder = tempfile::tempdir().unwrap();
    std::fs::write(folder.path().join("rig.toml"), rig("driver = \"sim\"", "")).unwrap();
    run(folder.path(), |_| {}).0
}

/// The same over the wire, on a network of this test's own; `act` may interfere.
fn over_the_wire(
    more: &str,
    faults: &[&str],
    mut act: impl FnMut(&mut BenchProbe, &Event),
) -> (Array3<u32>, Counts) {
    unshare(CloneFlags::CLONE_NEWNET)
        .expect("a network namespace needs root: run `cargo xtask test` as root");
    assert!(Command::new("ip").args(["link", "set", "lo", "up"]).status().unwrap().success());
    let folder = tempfile::tempdir().unwrap();
    let camera = "driver = \"aravis\"\naravis.address = \"127.0.0.1\"\naravis.trigger_latency_us = 8";
    let bench = folder.path().join("bench.sock");
    let text = rig(camera, more).replace("[sim]\n", "[sim]\nbench = \"bench.sock\"\n");
    let path = folder.path().join("rig.toml");
    std::fs::write(&path, text).unwrap();
    let mut arguments = vec!["--rig", path.to_str().unwrap()];
    arguments.extend(faults.iter().flat_map(|fault| ["--fault", fault]));
    let _camera = Process::start(env!("CARGO_BIN_EXE_raysweep-sim-camera"), &arguments);
    let mut probe = wait_for("the camera does not start", || BenchProbe::open(&bench).ok());
    run(folder.path(), |event| act(&mut probe, event))
}

/// A frame's time is measured, so that images differ by what microseconds change, and no more.
fn assert_same_images(found: &Array3<u32>, expected: &Array3<u32>) {
    assert_eq!(found.dim(), expected.dim());
    let brightest = f64::from(*expected.iter().max().unwrap()) / f64::from(FRAMES);
    let worst = found.iter().zip(expected).map(|(&a, &b)| a.abs_diff(b)).max().unwrap();
    let worst = f64::from(worst) / f64::from(FRAMES);
    // One step of the delay moves a 25th of a row's light and more; a wrong setting would be twenty times as bad.
    assert!(worst < 0.01 * brightest, "{worst} of {brightest} counts");
}

fn nothing(_: &mut BenchProbe, _: &Event) {}

#[test]
fn a_sweep_over_the_wire_stores_what_the_simulated_devices_store() {
    let (stack, counts) = over_the_wire("", &[], nothing);
    assert_same_images(&stack, &reference());
    assert!(!counts.lost.contains_key(&LossCause::CameraLost), "{counts:?}");
}

#[test]
fn lost_packets_cost_frames_and_no_image() {
    let (stack, counts) =
        over_the_wire("", &["packet_loss=0.05", "resend=false", "reordering=0.02"], nothing);
    assert_same_images(&stack, &reference());
    assert!(counts.lost[&LossCause::PacketsLost] > 0, "{counts:?}");
}

#[test]
fn settings_that_act_late_now_and_then_mislabel_nothing() {
    let late = "[sim.camera]\nlate_frames_min = 0\nlate_frames_max = 3\n";
    let (stack, _) = over_the_wire(late, &[], nothing);
    assert_same_images(&stack, &reference());
}

#[test]
fn a_camera_that_dies_in_the_middle_costs_the_frames_of_its_absence() {
    let mut died = None;
    let (stack, counts) = over_the_wire("", &[], |probe, event| match (event, died) {
        (Event::Progress(progress), None) if progress.points_stored >= 3 => {
            probe.set_faults(Faults { dead: true, ..Faults::default() }).unwrap();
            thread::sleep(Duration::from_secs(2));
            died = Some(());
            probe.set_faults(Faults::default()).unwrap();
        }
        _ => {}
    });
    assert!(died.is_some());
    assert_same_images(&stack, &reference());
    assert!(counts.lost[&LossCause::CameraLost] > 0, "{counts:?}");
}
