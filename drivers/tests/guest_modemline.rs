//! VSYNC at 60 Hz on the DCD line of a simulated converter behind the kernel's `ftdi_sio`: with `TIOCMIWAIT` and as
//! pulse-per-second source.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod guest;

use std::fs;
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use guest::{PATIENCE, wait_for};
use raysweep_core::{Clock, DeviceErrorKind, Edge, Vsync};
use raysweep_drivers::vsync::Polarity;
use raysweep_drivers::vsync::modemline::{ModemLine, ModemLineInput};
use raysweep_drivers::vsync::pps::Pps;
use raysweep_sim::usb::{Ftdi, FtdiLine, Plugged};

const PORT: &str = "/dev/ttyUSB0";
const SOURCE: &str = "/dev/pps0";
const PERIOD: Duration = Duration::from_nanos(16_666_667);
/// Long enough that a guest under load sees most pulses.
const PULSE: Duration = Duration::from_millis(8);

fn plug() -> (Plugged, FtdiLine) {
    plug_with(PERIOD, PULSE)
}

fn plug_with(period: Duration, pulse: Duration) -> (Plugged, FtdiLine) {
    let (converter, line) = Ftdi::new(period, pulse);
    let plugged = Plugged::new(converter).unwrap();
    // The port's file appears a moment before it can be opened.
    let nonblocking = nix::fcntl::OFlag::O_NONBLOCK.bits();
    wait_for(PORT, || fs::File::options().read(true).custom_flags(nonblocking).open(PORT).ok());
    (plugged, line)
}

fn unplug(plugged: Plugged) {
    drop(plugged);
    wait_for("the port's end", || (!Path::new(PORT).exists()).then_some(()));
}

/// Watches 60 edges: their numbers match the line's pulses exactly, whether or not all were seen.
fn numbers_are_the_line_s_own(vsync: &mut dyn Vsync, line: &FtdiLine) {
    line.start();
    let began = Instant::now();
    let mut edges: Vec<Edge> = Vec::new();
    let mut caught_up = false;
    while edges.len() < 60 || !caught_up {
        assert!(began.elapsed() < PATIENCE, "the numbers stay behind the line's {}", line.pulses());
        let edge = vsync.next_edge(PATIENCE).unwrap().expect("the line toggles");
        assert!(edge.seq <= line.pulses(), "an edge that the line did not have");
        assert!(edge.host_ns <= Clock::real().now_ns(), "an edge from the future");
        caught_up = edge.seq == line.pulses();
        edges.push(edge);
    }
    assert!(edges.is_sorted_by(|a, b| a.seq < b.seq && a.host_ns < b.host_ns), "{edges:?}");
    let (first, last) = (edges[0], edges[edges.len() - 1]);
    let period_us = (last.host_ns - first.host_ns) as f64 / (last.seq - first.seq) as f64 / 1e3;
    println!("{} of {} edges seen; mean period {period_us:.0} us", edges.len(), last.seq);
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn modem_line_counts_each_pulse_and_stamps_those_it_sees() {
    let (plugged, line) = plug();
    let mut vsync = ModemLine::open(Path::new(PORT), ModemLineInput::Dcd, Polarity::Assert).unwrap();
    numbers_are_the_line_s_own(&mut vsync, &line);
    unplug(plugged);
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn modem_line_tells_of_an_unplugged_port_and_opens_again() {
    for _ in 0..2 {
        let (plugged, line) = plug();
        let mut vsync = ModemLine::open(Path::new(PORT), ModemLineInput::Dcd, Polarity::Clear).unwrap();
        line.start();
        assert!(vsync.next_edge(PATIENCE).unwrap().is_some());
        drop(plugged);
        let error = loop {
            // Earlier edges may still be queued.
            if let Err(error) = vsync.next_edge(PATIENCE) {
                break error;
            }
        };
        assert_eq!(error.kind, DeviceErrorKind::Disconnected, "{error}");
        assert_eq!(vsync.next_edge(PATIENCE).unwrap_err().kind, DeviceErrorKind::Disconnected);
        drop(vsync);
        wait_for("the port's end", || (!Path::new(PORT).exists()).then_some(()));
    }
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn a_line_that_does_not_change_gives_no_edge() {
    let (plugged, line) = plug();
    line.start();
    let mut vsync = ModemLine::open(Path::new(PORT), ModemLineInput::Cts, Polarity::Assert).unwrap();
    assert_eq!(vsync.next_edge(Duration::from_millis(200)).unwrap(), None);
    drop(vsync); // and closing it does not hang
    unplug(plugged);
}

/// `ldattach`, which stays in the foreground when asked to print messages.
struct LineDiscipline(Child);

impl LineDiscipline {
    fn pps() -> Self {
        let child =
            Command::new("ldattach").args(["--debug", "PPS", PORT]).stderr(Stdio::null()).spawn().unwrap();
        let attached = Self(child);
        wait_for(SOURCE, || Path::new(SOURCE).exists().then_some(()));
        attached
    }
}

impl Drop for LineDiscipline {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn pulse_per_second_source_has_the_kernel_s_stamps_and_numbers() {
    let (plugged, line) = plug();
    let attached = LineDiscipline::pps();
    let mut vsync = Pps::open(Path::new(SOURCE), Polarity::Assert).unwrap();
    numbers_are_the_line_s_own(&mut vsync, &line);
    unplug(plugged);
    let error = loop {
        if let Err(error) = vsync.next_edge(PATIENCE) {
            break error;
        }
    };
    assert_eq!(error.kind, DeviceErrorKind::Disconnected, "{error}");
    drop(attached);
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn the_polarity_says_which_change_is_the_edge() {
    for edge in [Polarity::Assert, Polarity::Clear] {
        // After an edge, the line stays unchanged for longer than a guest takes to notice it.
        let (plugged, line) = plug_with(Duration::from_secs(2), Duration::from_secs(1));
        let mut vsync = ModemLine::open(Path::new(PORT), ModemLineInput::Dcd, edge).unwrap();
        line.start();
        assert!(vsync.next_edge(PATIENCE).unwrap().is_some());
        assert_eq!(line.is_asserted(), edge == Polarity::Assert, "{edge:?} by TIOCMIWAIT");
        drop(vsync);

        let attached = LineDiscipline::pps();
        let mut vsync = Pps::open(Path::new(SOURCE), edge).unwrap();
        assert!(vsync.next_edge(PATIENCE).unwrap().is_some());
        assert_eq!(line.is_asserted(), edge == Polarity::Assert, "{edge:?} by PPS");
        drop(vsync);
        unplug(plugged);
        drop(attached);
    }
}
