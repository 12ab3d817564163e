//! The driver of the triggerbox with a simulated box on a pseudo-terminal.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

#[path = "suite/hung.rs"]
mod hung;
#[path = "suite/noise.rs"]
mod noise;

use std::io::Write;
use std::path::Path;
use std::time::{Duration, Instant};

use hung::HUNG;
use raysweep_core::{Clock, DeviceErrorKind, Edge, Vsync};
use raysweep_drivers::vsync::triggerbox::protocol::parse_reply;
use raysweep_drivers::vsync::triggerbox::{TriggerBox, TriggerBoxConfig, TriggerBoxLink, firmware};
use raysweep_sim::mirror::{SerialLink as Wire, WireFaults};
use raysweep_sim::triggerbox::TriggerBoxPty;

const PERIOD_NS: i64 = 16_666_667;
const PERIOD_US: f64 = 16_666.667;

fn plug(faults: WireFaults) -> TriggerBoxPty {
    TriggerBoxPty::plug(PERIOD_NS, Wire::VirtualCom, faults).unwrap()
}

fn config(path: &Path) -> TriggerBoxConfig {
    TriggerBoxConfig { port: path.to_owned(), link: TriggerBoxLink::Usb }
}

fn edges(vsync: &mut dyn Vsync, count: usize) -> Vec<Edge> {
    let began = Instant::now();
    let mut edges = Vec::new();
    while edges.len() < count {
        assert!(began.elapsed() < HUNG, "{} edges", edges.len());
        edges.extend(vsync.next_edge(Duration::from_millis(100)).unwrap());
    }
    edges
}

/// Every pulse once, in order, at multiples of the line's period, within the accuracy of round trips on a busy
/// machine.
fn assert_on_grid(edges: &[Edge]) {
    assert!(edges.windows(2).all(|pair| pair[1].seq == pair[0].seq + 1), "{edges:?}");
    for edge in edges {
        let off_ns = (edge.host_ns + PERIOD_NS / 2).rem_euclid(PERIOD_NS) - PERIOD_NS / 2;
        assert!(off_ns.abs() < 2_000_000, "{off_ns} ns off");
        assert!(edge.host_ns <= Clock::real().now_ns(), "an edge from the future");
    }
}

/// The firmware reads pairs of bytes.
#[test]
fn a_box_that_others_have_left_with_half_a_pair_is_found() {
    let pty = plug(WireFaults::default());
    std::fs::OpenOptions::new().write(true).open(pty.path()).unwrap().write_all(b"?").unwrap();
    let mut vsync = TriggerBox::open(config(pty.path()), PERIOD_US).unwrap();
    assert_on_grid(&edges(&mut vsync, 10));
}

/// A busy host passes answers on late: more questions are on their way by then.
#[test]
fn a_box_whose_answers_come_late_is_found_and_found_again() {
    for seed in 1..=4 {
        let pty = plug(WireFaults { seed, stalls: 0.05, stall_ms: 700, ..WireFaults::default() });
        // Until the line has stalled for the first time.
        std::thread::sleep(Duration::from_millis(200));
        assert_eq!(firmware(pty.path()), Some(14));
        TriggerBox::open(config(pty.path()), PERIOD_US).unwrap();
    }
}

#[test]
fn every_pulse_is_told_when_it_was() {
    let pty = plug(WireFaults::default());
    let mut vsync = TriggerBox::open(config(pty.path()), PERIOD_US).unwrap();
    let edges = edges(&mut vsync, 120);
    assert_on_grid(&edges);
    let clock = vsync.clock().unwrap();
    println!("{clock:?}");
    assert!(clock.round_trips >= 8);
}

#[test]
fn garbage_and_stalls_on_the_wire_cost_nothing_but_round_trips() {
    let pty = plug(WireFaults { seed: 3, garbage: 0.3, stalls: 0.02, stall_ms: 30 });
    let mut vsync = TriggerBox::open(config(pty.path()), PERIOD_US).unwrap();
    assert_on_grid(&edges(&mut vsync, 120));
}

#[test]
fn an_unplugged_box_is_gone_and_what_is_no_box_is_told() {
    let mut pty = plug(WireFaults::default());
    let mut vsync = TriggerBox::open(config(pty.path()), PERIOD_US).unwrap();
    edges(&mut vsync, 10);
    let error = TriggerBox::open(config(pty.path()), PERIOD_US).err().unwrap();
    assert_eq!(error.kind, DeviceErrorKind::Busy, "{error}");
    pty.unplug();
    let error = loop {
        if let Err(error) = vsync.next_edge(Duration::from_millis(100)) {
            break error;
        }
    };
    assert_eq!(error.kind, DeviceErrorKind::Disconnected, "{error}");
    let error = TriggerBox::open(config(Path::new("/dev/ttyNONE")), PERIOD_US).err().unwrap();
    assert_eq!(error.kind, DeviceErrorKind::Disconnected, "{error}");
    let error = TriggerBox::open(config(Path::new("/dev/ttyNONE")), 1e6).err().unwrap();
    assert_eq!(error.kind, DeviceErrorKind::OutOfRange, "{error}");
}

#[test]
fn ten_million_bytes_of_noise_are_accounted_for() {
    let alphabet = b"PV\x07\x00\x01\x0e\x10";
    let (pushed, in_replies, receiver) = noise::survives(parse_reply, alphabet, |_| 10);
    assert!(in_replies > 0);
    assert_eq!(in_replies + receiver.garbage_bytes() as usize + receiver.waiting_bytes(), pushed);
}
