//! The logic analyser behind the kernel's USB stack (`vhci-hcd`): order and numbers of edges, silence, a halted
//! endpoint, unplugging while streaming, and an analyser without firmware.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod guest;

use std::time::{Duration, Instant};

use guest::{PATIENCE, wait_for};
use raysweep_core::{DeviceErrorKind, Edge, Vsync};
use raysweep_drivers::vsync::fx2lafw::{Fx2Lafw, Fx2LafwConfig, Slope, Usb};
use raysweep_drivers::vsync::reopen::Reopened;
use raysweep_sim::usb::{Fx2Analyser, Fx2Blank, Fx2Faults, Plugged, Signal};

const PERIOD_NS: i64 = 16_666_667;

fn plug() -> (Plugged, Fx2Faults) {
    let signal = Signal {
        seed: 1,
        period_ns: PERIOD_NS,
        pulse_ns: 2_000_000,
        jitter_ns: 0.0,
        missing: 0.0,
        false_edges: 0.0,
        exposure_after_ns: 3_000_000,
        exposure_ns: 1_000_000,
    };
    let (analyser, faults) = Fx2Analyser::new(signal, 20.0);
    (Plugged::new(analyser).unwrap(), faults)
}

/// A sample rate that software emulation can sustain.
fn config() -> Fx2LafwConfig {
    let channels = [("vsync".to_owned(), 0), ("exposure".to_owned(), 1)];
    Fx2LafwConfig { sample_rate_hz: 100_000, channels: channels.into(), ..Fx2LafwConfig::default() }
}

fn open() -> Fx2Lafw<Usb> {
    // The bus detects it a moment after it was plugged in.
    wait_for("the analyser", || Fx2Lafw::open(&config()).ok())
}

fn edges(vsync: &mut dyn Vsync, count: usize) -> Vec<Edge> {
    let began = Instant::now();
    let mut edges = Vec::new();
    while edges.len() < count {
        assert!(began.elapsed() < PATIENCE, "{} edges", edges.len());
        edges.extend(vsync.next_edge(Duration::from_millis(100)).unwrap());
    }
    edges
}

fn end(vsync: &mut dyn Vsync) -> DeviceErrorKind {
    let began = Instant::now();
    loop {
        // Earlier edges may still be queued.
        if let Err(error) = vsync.next_edge(PATIENCE) {
            println!("{error}");
            return error.kind;
        }
        assert!(began.elapsed() < PATIENCE, "the analyser goes on");
    }
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn every_edge_comes_once_and_in_order() {
    let (plugged, _) = plug();
    let mut vsync = open();
    let edges = edges(&mut vsync, 120);
    assert!(edges.windows(2).all(|pair| pair[1].seq == pair[0].seq + 1), "{edges:?}");
    let (first, last) = (edges[0], edges[edges.len() - 1]);
    let period_us = (last.host_ns - first.host_ns) as f64 / (last.seq - first.seq) as f64 / 1e3;
    // Whenever the guest is busy, its clock fit shifts from one window to the next.
    assert!((period_us / 16_666.667 - 1.0).abs() < 0.1, "{period_us} us");
    println!("{:?}", vsync.clock());
    drop(vsync);
    drop(plugged);
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn signals_follow_one_another_as_on_the_line() {
    let (plugged, _) = plug();
    let mut analyser = open();
    let mut changes = Vec::new();
    while changes.len() < 80 {
        changes.push(analyser.next_change(PATIENCE).unwrap().unwrap());
    }
    let names = analyser.channels().to_vec();
    let first = changes.iter().position(|c| names[c.channel] == "vsync" && c.slope == Slope::Rising).unwrap();
    for (k, change) in changes[first..].iter().enumerate() {
        let expected = [
            ("vsync", Slope::Rising),
            ("vsync", Slope::Falling),
            ("exposure", Slope::Rising),
            ("exposure", Slope::Falling),
        ];
        assert_eq!((names[change.channel].as_str(), change.slope), expected[k % 4]);
    }
    drop(analyser);
    drop(plugged);
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn a_halted_endpoint_and_a_pulled_plug_are_told_apart() {
    let (plugged, faults) = plug();
    let mut vsync = open();
    edges(&mut vsync, 3);
    faults.stall();
    assert_eq!(end(&mut vsync), DeviceErrorKind::Protocol);
    drop(vsync);
    drop(plugged);
    wait_for("the analyser's end", || {
        Fx2Lafw::open(&config()).err().filter(|error| error.kind == DeviceErrorKind::Disconnected)
    });

    let (plugged, _) = plug();
    let mut vsync = open();
    edges(&mut vsync, 3);
    drop(plugged);
    assert_eq!(end(&mut vsync), DeviceErrorKind::Disconnected);
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn an_analyser_that_is_plugged_in_again_goes_on() {
    let (plugged, _) = plug();
    let device = open();
    let mut vsync = Reopened::new(device, Box::new(|| Fx2Lafw::open(&config())), PATIENCE);
    let before = edges(&mut vsync, 5);
    drop(plugged);
    let (plugged, faults) = plug();
    let after = edges(&mut vsync, 5 + before.len());
    assert!(faults.starts() >= 1, "the new one samples");
    let numbers: Vec<u64> = before.iter().chain(&after).map(|edge| edge.seq).collect();
    assert!(numbers.is_sorted_by(|a, b| a < b), "{numbers:?}");
    drop(vsync);
    drop(plugged);
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn firmware_is_loaded_and_the_analyser_comes_back_with_it() {
    let (blank, memory) = Fx2Blank::new();
    let blank = Plugged::new(blank).unwrap();
    let error = wait_for("the blank analyser", || {
        Fx2Lafw::open(&config()).err().filter(|error| error.kind != DeviceErrorKind::Disconnected)
    });
    assert_eq!(error.kind, DeviceErrorKind::NotReady, "{error}");
    let image: Vec<u8> = (0..9000_u32).map(|k| (k * 7 % 251) as u8).collect();
    let folder = tempfile::tempdir().unwrap();
    let firmware = folder.path().join("fx2lafw.fw");
    std::fs::write(&firmware, &image).unwrap();
    let bus = std::thread::spawn({
        let memory = memory.clone();
        move || {
            wait_for("the firmware's start", || memory.is_started().then_some(()));
            drop(blank);
            plug()
        }
    });
    let config = Fx2LafwConfig { firmware: Some(firmware), ..config() };
    let mut vsync = Fx2Lafw::open(&config).unwrap();
    assert_eq!(memory.image(9000), image);
    edges(&mut vsync, 10);
    drop(vsync);
    drop(bus.join().unwrap());
}
