//! The daemon with a logic analyser on its VSYNC line, through the kernel's USB stack (`vhci-hcd`): every frame that
//! counts is matched to an edge seen by the analyser, whatever happens to the line and the analyser. The camera is the
//! daemon's simulated one, the analyser runs in the test's process; for both, the line's edges lie on multiples of its
//! period on the guest's clock.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

#[path = "../../drivers/tests/guest/mod.rs"]
mod guest;
mod process;

use std::fs::File;
use std::path::PathBuf;
use std::process::Command;
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use guest::wait_for;
use process::Process;
use raysweep_core::{Edge, LossCause, Vsync};
use raysweep_drivers::vsync::fx2lafw::{Fx2Lafw, Fx2LafwConfig, Usb};
use raysweep_proto::{Client, Event, RunParams};
use raysweep_session::Session;
use raysweep_session::ledger::State;
use raysweep_session::stack::ArrayName;
use raysweep_sim::usb::{Fx2Analyser, Fx2Faults, Plugged, Signal};
use tempfile::TempDir;
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

/// Period and sample rate that software emulation can handle even on a busy host.
const PERIOD_NS: i64 = 50_000_000;
const SAMPLE_RATE_HZ: u32 = 100_000;
const POINTS: usize = 12;
const FRAMES: u32 = 2;
/// Below the 200 us within which frames are matched to edges.
const MAX_JITTER_US: f64 = 180.0;

fn plan() -> String {
    format!(
        "kind = \"sweep\"\n[sweep]\naverage = {FRAMES}\nmax_jitter_us = {MAX_JITTER_US}\n\
         delay_us = {{ start = -750, stop = 750, count = {POINTS} }}\nexposure_us = [500]\n"
    )
}

/// The line as seen by the analyser: that of the simulated camera, with edges that the analyser misses and false ones.
fn signal(missing: f64, false_edges: f64) -> Signal {
    Signal {
        seed: 3,
        period_ns: PERIOD_NS,
        pulse_ns: 2_000_000,
        jitter_ns: 0.0,
        missing,
        false_edges,
        exposure_after_ns: 3_000_000,
        exposure_ns: 1_000_000,
    }
}

/// Plugs in an analyser whose thread, since it represents a device, has priority over the guest's computations.
fn plug(signal: Signal) -> (Plugged, Fx2Faults) {
    let (analyser, faults) = Fx2Analyser::new(signal, 20.0);
    let plugged = std::thread::spawn(|| {
        let priority = ThreadPriorityValue::try_from(80).map(ThreadPriority::Crossplatform).unwrap();
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        set_thread_priority_and_policy(thread_native_id(), priority, policy).unwrap();
        // The analyser's thread inherits the priority.
        Plugged::new(analyser).unwrap()
    });
    (plugged.join().unwrap(), faults)
}

/// The driver's view of the analyser, once the kernel has enumerated it.
fn open_analyser() -> Fx2Lafw<Usb> {
    let config =
        Fx2LafwConfig { sample_rate_hz: SAMPLE_RATE_HZ, latency_us: 0.0, ..Fx2LafwConfig::default() };
    wait_for("the analyser", || Fx2Lafw::open(&config).ok())
}

/// Delay of the driver's stamps in this guest: emulation slows down every transfer. A lab measures its own value.
fn lateness_us() -> f64 {
    static MEASURED: OnceLock<f64> = OnceLock::new();
    *MEASURED.get_or_init(|| {
        let (_plugged, _) = plug(signal(0.0, 0.0));
        let mut vsync = open_analyser();
        let late_ns = |edge: Edge| (edge.host_ns + PERIOD_NS / 2).rem_euclid(PERIOD_NS) - PERIOD_NS / 2;
        let mut late: Vec<i64> = Vec::new();
        while late.len() < 120 {
            late.extend(vsync.next_edge(Duration::from_millis(100)).unwrap().map(late_ns));
        }
        println!("{:?}", vsync.clock());
        // The clock fit needs the first seconds to settle.
        let late = &mut late[80..];
        late.sort_unstable();
        println!("stamps are late by {} to {} ns", late[0], late[late.len() - 1]);
        (late[late.len() / 2] as f64 / 1e3).max(0.0)
    })
}

/// A daemon with its analyser, in a temporary folder.
struct Lab {
    // Dropped before the folder.
    _daemon: Process,
    folder: TempDir,
}

impl Lab {
    /// Starts the daemon. The analyser must be plugged in already.
    fn new(latency_us: f64) -> Self {
        drop(open_analyser());
        let folder = tempfile::tempdir().unwrap();
        let rig = format!(
            "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[projector]\ndriver = \"sim\"\nrows = 8\nrow_time_us = 22.22\n\
             [vsync]\ndriver = \"fx2lafw\"\nperiod_us = 50000\nreopen_s = 30\n\
             fx2lafw = {{ sample_rate_hz = {SAMPLE_RATE_HZ}, latency_us = {latency_us} }}\n\
             [sim]\nrealtime = true\nscene = \"slab\"\nscene_rows = 8\nscene_columns = 8\n[sim.vsync]\njitter_us = 0\n"
        );
        std::fs::write(folder.path().join("rig.toml"), rig).unwrap();
        let program = std::env::current_exe().unwrap().with_file_name("raysweepd");
        let path = |name: &str| folder.path().join(name);
        let mut command = Command::new(program);
        command
            .arg("--rig")
            .arg(path("rig.toml"))
            .arg("--socket")
            .arg(path("socket"))
            .arg("--data")
            .arg(path("sessions"))
            .stderr(File::create(path("log")).unwrap());
        Self { _daemon: Process::start(&mut command), folder }
    }

    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Runs the plan and expects it to complete; `meanwhile` is called with the number of stored points.
    fn sweep(&self, mut meanwhile: impl FnMut(usize)) -> State {
        let client = || wait_for("the daemon", || Client::connect(self.path("socket")).ok());
        let events = client().subscribe().unwrap();
        let began = Instant::now();
        client().run(&RunParams { plan: plan(), ..RunParams::default() }).unwrap();
        for event in events {
            match event.unwrap() {
                Event::Progress(progress) => meanwhile(progress.points_stored),
                Event::Finished { session, state, error, missing, .. } => {
                    println!("{state} after {:?}", began.elapsed());
                    assert_eq!((state.as_str(), error, missing), ("complete", None, 0));
                    return Session::open(&session).unwrap().state().unwrap();
                }
                _ => {}
            }
        }
        panic!("the daemon ended before the run");
    }
}

impl Drop for Lab {
    fn drop(&mut self) {
        // The only trace of a daemon that failed in the guest.
        println!("{}", std::fs::read_to_string(self.path("log")).unwrap_or_default());
    }
}

/// Every frame of every point was matched to an edge, and its measured delay is the requested one.
fn assert_tied(state: &State) {
    let delays: Vec<f64> = (0..POINTS).map(|k| -750.0 + 1500.0 * k as f64 / (POINTS - 1) as f64).collect();
    let mut worst_us = 0.0_f64;
    for (point, delay_us) in state.stored(ArrayName::Sum).zip(delays) {
        assert!((point.delay_us - delay_us).abs() < 1e-6, "{point:?}");
        assert_eq!(point.delays_us.len(), FRAMES as usize, "{point:?}");
        for measured_us in &point.delays_us {
            worst_us = worst_us.max((measured_us - delay_us).abs());
        }
    }
    println!("{:?}: delays are off by up to {worst_us:.0} us", state.counts);
    assert_eq!(state.stored(ArrayName::Sum).count(), POINTS);
    assert!(worst_us <= MAX_JITTER_US);
    assert!(state.counts.balanced());
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn edges_that_the_analyser_misses_and_false_ones_tie_no_frame_wrongly() {
    let latency_us = lateness_us();
    let (_plugged, _) = plug(signal(0.05, 0.1));
    let state = Lab::new(latency_us).sweep(|_| {});
    assert_tied(&state);
    let vsync = state.end.unwrap().vsync.unwrap();
    println!("{vsync:?}");
    assert!(vsync.missed > 0 && vsync.false_edges > 0, "{vsync:?}");
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn an_analyser_that_halts_stops_or_is_unplugged_within_a_sweep_costs_the_frames_of_its_absence() {
    let latency_us = lateness_us();
    let (first, faults) = plug(signal(0.0, 0.0));
    let mut plugged = Some(first);
    // Number of times that sampling had been started before each fault. Points exposed before a fault may be stored
    // after it, so the next fault waits until sampling has been restarted.
    let mut starts = vec![0];
    let state = Lab::new(latency_us).sweep(|stored| match starts.len() {
        _ if starts.last() == Some(&faults.starts()) => {}
        1 if stored >= 3 => {
            starts.push(faults.starts());
            faults.stall();
        }
        2 if stored >= 5 => {
            starts.push(faults.starts());
            faults.overrun();
        }
        3 if stored >= 7 => {
            starts.push(faults.starts());
            plugged = None;
            std::thread::sleep(Duration::from_secs(3));
            plugged = Some(plug(signal(0.0, 0.0)).0);
        }
        _ => {}
    });
    assert!(starts.len() == 4 && starts.is_sorted_by(|a, b| a < b), "{starts:?}");
    assert_tied(&state);
    assert!(state.counts.lost[&LossCause::EdgeMissing] > 0, "{:?}", state.counts);
}
