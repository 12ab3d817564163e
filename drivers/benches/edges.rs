//! Benchmark of the logic analyser's edge scan on one core, compared with the 24 million samples per second
//! of the fastest analyser. Run it with `cargo xtask bench edges`.

#![allow(clippy::unwrap_used, reason = "a benchmark that cannot go on may panic")]

use std::hint::black_box;
use std::time::{Duration, Instant};

use raysweep_core::{DeviceError, DeviceErrorKind};
use raysweep_drivers::vsync::fx2lafw::scan::Scanner;
use raysweep_drivers::vsync::fx2lafw::{AnalyserLink, Fx2Lafw, Fx2LafwConfig};
use raysweep_sim::usb::Signal;

const RATE_HZ: u32 = 24_000_000;
/// Half a second, 30 edges of the line.
const SAMPLES: usize = RATE_HZ as usize / 2;
/// As many transfers per second as the driver requests.
const TRANSFER: usize = RATE_HZ as usize / 250;
/// The fastest repetition counts: the others had to share the machine.
const REPETITIONS: usize = 10;

/// A link with recorded samples, one transfer per call.
struct Recorded<'a> {
    transfers: std::slice::Chunks<'a, u8>,
    arrived_ns: i64,
}

impl AnalyserLink for Recorded<'_> {
    fn receive(&mut self, _: Duration, take: &mut dyn FnMut(&[u8], i64)) -> Result<(), DeviceError> {
        let over = || DeviceError::new("vsync", DeviceErrorKind::Disconnected, "the recording is over");
        let transfer = self.transfers.next().ok_or_else(over)?;
        self.arrived_ns += (transfer.len() as f64 * 1e9 / f64::from(RATE_HZ)) as i64;
        take(transfer, self.arrived_ns);
        Ok(())
    }
}

fn main() {
    // Passed by cargo itself.
    if let Some(unknown) = std::env::args().skip(1).find(|argument| argument != "--bench") {
        eprintln!("no option `{unknown}`: there are none");
        std::process::exit(2);
    }
    println!("{SAMPLES} samples on one core: millions a second, and in times of 24 MHz");
    println!(
        "{:<34}{:>18}{:>18}{:>18}{:>10}",
        "signal", "plain count", "edge scan", "whole driver", "changes"
    );
    for (name, samples) in signals() {
        measure(name, &samples);
    }
}

/// Signals as an analyser sees them, from quiet to the worst case.
fn signals() -> [(&'static str, Vec<u8>); 3] {
    let step_ns = 1e9 / f64::from(RATE_HZ);
    let signal = Signal {
        seed: 1,
        period_ns: 16_666_667,
        pulse_ns: 500_000,
        jitter_ns: 5_000.0,
        missing: 0.0,
        false_edges: 0.0,
        exposure_after_ns: 700_000,
        exposure_ns: 900_000,
    };
    let mut line = vec![0; SAMPLES];
    signal.samples(1e9, step_ns, &mut line);
    let mut mirror = line.clone();
    let half_ns = 1e9 / 39_000.0 / 2.0;
    for (index, sample) in mirror.iter_mut().enumerate() {
        *sample |= u8::from((index as f64 * step_ns / half_ns) as u64 % 2 == 1) << 2;
    }
    let worst = (0..SAMPLES).map(|index| (index % 2) as u8).collect();
    [
        ("VSYNC and exposure at 60 Hz", line),
        ("and a mirror's clock of 39 kHz", mirror),
        ("a change with every sample", worst),
    ]
}

fn measure(name: &str, samples: &[u8]) {
    let channels = [("vsync".to_owned(), 0), ("exposure".to_owned(), 1), ("mirror".to_owned(), 2)];
    let config =
        Fx2LafwConfig { sample_rate_hz: RATE_HZ, channels: channels.into(), ..Fx2LafwConfig::default() };
    let [mut plain, mut scanned, mut driven] = [Duration::MAX; 3];
    let mut changes = 0_u64;
    for _ in 0..REPETITIONS {
        // Interleaved, so that other load on the machine affects all alike.
        fastest(&mut plain, || {
            black_box(black_box(samples).windows(2).filter(|pair| (pair[0] ^ pair[1]) & 7 != 0).count());
        });
        changes = 0;
        fastest(&mut scanned, || {
            let mut scanner = Scanner::new(7);
            for transfer in black_box(samples).chunks(TRANSFER) {
                scanner.scan(transfer, |sample, levels, changed| {
                    black_box((sample, levels, changed));
                    changes += 1;
                });
            }
        });
        fastest(&mut driven, || {
            let link = Recorded { transfers: black_box(samples).chunks(TRANSFER), arrived_ns: 0 };
            let mut analyser = Fx2Lafw::new(link, &config).unwrap();
            while let Ok(change) = analyser.next_change(Duration::from_secs(1)) {
                black_box(change);
            }
        });
    }
    print!("{name:<34}");
    for time in [plain, scanned, driven] {
        let rate_hz = samples.len() as f64 / time.as_secs_f64();
        print!("{:>9.0}{:>9}", rate_hz * 1e-6, format!("{:.1}x", rate_hz / f64::from(RATE_HZ)));
    }
    println!("{changes:>10}");
}

fn fastest(best: &mut Duration, work: impl FnOnce()) {
    let began = Instant::now();
    work();
    *best = began.elapsed().min(*best);
}
