//! The analyser's driver with samples of a line whose true edges are known, in simulated time.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use std::collections::BTreeMap;
use std::time::Duration;

use raysweep_core::{DeviceError, DeviceErrorKind, Vsync};
use raysweep_drivers::vsync::fx2lafw::scan::Scanner;
use raysweep_drivers::vsync::fx2lafw::{AnalyserLink, Change, Fx2Lafw, Fx2LafwConfig, Slope};
use raysweep_sim::usb::Signal;

/// Host time of the first sample.
const START_NS: i64 = 4_000_000_000_000;
const LATENCY_NS: i64 = 100_000;
/// The analyser's clock is slow by this amount.
const RATE_PPM: f64 = 35.0;

/// An analyser whose 4 ms transfers arrive late, by at least the bus's latency.
struct Scripted {
    signal: Signal,
    step_ns: f64,
    taken: u64,
    transfers: u64,
    last: u64,
}

impl AnalyserLink for Scripted {
    fn receive(&mut self, _: Duration, take: &mut dyn FnMut(&[u8], i64)) -> Result<(), DeviceError> {
        if self.transfers == self.last {
            return Err(DeviceError::new("vsync", DeviceErrorKind::Disconnected, "the script is over"));
        }
        self.transfers += 1;
        let mut samples = vec![0; (4e6 / self.step_ns) as usize];
        let first_ns = START_NS as f64 + self.taken as f64 * self.step_ns;
        self.signal.samples(first_ns, self.step_ns, &mut samples);
        self.taken += samples.len() as u64;
        // Two in three are late, by up to 9 ms.
        let late_ns = (self.transfers % 3 * (self.transfers * 7919 % 4500)) as i64 * 1000;
        let end_ns = (START_NS as f64 + self.taken as f64 * self.step_ns) as i64;
        take(&samples, end_ns + LATENCY_NS + late_ns);
        Ok(())
    }
}

fn signal() -> Signal {
    Signal {
        seed: 11,
        period_ns: 16_666_667,
        pulse_ns: 500_000,
        jitter_ns: 5_000.0,
        missing: 0.01,
        false_edges: 0.01,
        exposure_after_ns: 700_000,
        exposure_ns: 900_000,
    }
}

fn script(sample_rate_hz: u32, seconds: u64) -> Scripted {
    let step_ns = 1e9 / f64::from(sample_rate_hz) * (1.0 + RATE_PPM * 1e-6);
    Scripted { signal: signal(), step_ns, taken: 0, transfers: 0, last: seconds * 250 }
}

fn analyser(sample_rate_hz: u32, seconds: u64) -> (Fx2Lafw<Scripted>, Fx2LafwConfig) {
    let config = Fx2LafwConfig {
        sample_rate_hz,
        channels: BTreeMap::from([("vsync".into(), 0), ("exposure".into(), 1)]),
        latency_us: LATENCY_NS as f64 / 1e3,
        ..Fx2LafwConfig::default()
    };
    (Fx2Lafw::new(script(sample_rate_hz, seconds), &config).unwrap(), config)
}

/// The times of all edges of the line in this time.
fn truth(seconds: i64) -> Vec<i64> {
    let signal = signal();
    let periods =
        START_NS / signal.period_ns - 1..(START_NS + seconds * 1_000_000_000) / signal.period_ns + 2;
    let mut edges: Vec<i64> = periods.flat_map(|k| signal.edges(k)).flatten().collect();
    edges.retain(|edge_ns| *edge_ns > START_NS);
    edges.sort_unstable();
    edges
}

/// All changes until the end of the script.
fn changes(analyser: &mut Fx2Lafw<Scripted>) -> Vec<Change> {
    let next = || analyser.next_change(Duration::from_secs(1)).ok().flatten();
    std::iter::from_fn(next).collect()
}

#[test]
fn every_edge_is_seen_once_when_it_was() {
    let (mut analyser, _) = analyser(1_000_000, 30);
    assert_eq!(analyser.channels(), ["exposure", "vsync"]);
    let seen = changes(&mut analyser);
    let rising = |channel| seen.iter().filter(move |c| c.channel == channel && c.slope == Slope::Rising);
    let truth = truth(30);
    let vsync: Vec<&Change> = rising(1).collect();
    // Edges of the first moments, before the clock is known, are numbered but not reported.
    assert!(vsync.len() > truth.len() - 10, "{} of {}", vsync.len(), truth.len());
    for change in &vsync {
        let off_ns = change.host_ns - truth[change.seq as usize - 1];
        // The length of a sample, and the remaining effect of late transfers on the fit.
        assert!((-5_000..12_000).contains(&off_ns), "{change:?}: {off_ns} ns");
    }
    for pair in vsync.iter().zip(rising(0).skip_while(|c| c.seq < vsync[0].seq)) {
        let after_ns = pair.1.host_ns - pair.0.host_ns;
        assert!((after_ns - 700_000).abs() < 2_000, "one clock: {after_ns} ns");
    }
    let clock = analyser.clock().unwrap();
    assert!((clock.rate_ppm - RATE_PPM).abs() < 3.0, "{clock:?}");
}

#[test]
fn at_24_mhz_changes_are_those_of_one_sample_after_the_other() {
    let (mut analyser, config) = analyser(24_000_000, 1);
    let seen = changes(&mut analyser);
    // Reference implementation: sample by sample, each change of an input counts if the input was quiet before.
    let mut link = script(24_000_000, 1);
    let step_ns = link.step_ns;
    let (mut samples, mut scanned) = (Vec::new(), Vec::new());
    let mut scanner = Scanner::new(3);
    let mut take = |transfer: &[u8], _| {
        samples.extend_from_slice(transfer);
        scanner.scan(transfer, |sample, levels, changed| scanned.push((sample, levels, changed)));
    };
    while link.receive(Duration::ZERO, &mut take).is_ok() {}
    let pairs = samples.windows(2).zip(1..).filter(|(pair, _)| pair[0] != pair[1]);
    let plain: Vec<_> = pairs.map(|(pair, sample)| (sample, pair[1], pair[0] ^ pair[1])).collect();
    assert_eq!(scanned, plain);
    let quiet = (config.quiet_us * 24.0) as usize;
    let mut expected = Vec::new();
    for (channel, input) in [(0, 1), (1, 0)] {
        let (mut changed, mut counts) = (None, [0; 2]);
        for (index, pair) in samples.windows(2).enumerate() {
            let level = pair[1] >> input & 1;
            if level == pair[0] >> input & 1 {
                continue;
            }
            if changed.replace(index).is_none_or(|before| index - before >= quiet) {
                let slope = if level == 1 { Slope::Rising } else { Slope::Falling };
                counts[slope as usize] += 1;
                expected.push((index + 1, channel, slope, counts[slope as usize]));
            }
        }
    }
    expected.sort_unstable_by_key(|(index, channel, ..)| (*index, *channel));
    // Changes before the clock is known are numbered but not reported.
    let untold = expected.len() - seen.len();
    assert!(seen.len() > 200 && untold < 20, "{} of {}", seen.len(), expected.len());
    for (change, (index, channel, slope, seq)) in seen.iter().zip(&expected[untold..]) {
        assert_eq!((change.channel, change.slope, change.seq), (*channel, *slope, *seq));
        let off_ns = change.host_ns - START_NS - (*index as f64 * step_ns) as i64;
        assert!((-5_000..12_000).contains(&off_ns), "sample {index}: {off_ns} ns");
    }
}

#[test]
fn the_line_s_edges_are_the_vsync_alone() {
    let (mut analyser, _) = analyser(100_000, 5);
    let truth = truth(5);
    let mut last = 0;
    while let Ok(edge) = analyser.next_edge(Duration::from_secs(1)) {
        let edge = edge.unwrap();
        assert!((edge.host_ns - truth[edge.seq as usize - 1]).abs() < 30_000, "{edge:?}");
        last = edge.seq;
    }
    assert!(last as usize > truth.len() - 2, "{last} of {}", truth.len());
}

/// A link that delivers given bytes.
struct Bytes(Vec<Vec<u8>>, i64);

impl AnalyserLink for Bytes {
    fn receive(&mut self, _: Duration, take: &mut dyn FnMut(&[u8], i64)) -> Result<(), DeviceError> {
        self.1 += 60_000_000;
        match self.0.pop() {
            Some(block) => take(&block, self.1),
            None => return Err(DeviceError::new("vsync", DeviceErrorKind::Disconnected, "over")),
        }
        Ok(())
    }
}

#[test]
fn a_line_that_rings_has_one_edge() {
    // Two quiet blocks for the clock, then a pulse that rings at both edges.
    let mut ringing = vec![0_u8; 100];
    ringing.extend([1, 0, 1, 1, 0, 1]);
    ringing.extend([1; 200]);
    ringing.extend([0, 1, 0, 0, 1, 0]);
    ringing.extend([0; 100]);
    let config = Fx2LafwConfig::default();
    let mut analyser =
        Fx2Lafw::new(Bytes(vec![ringing, vec![0; 60_000], vec![0; 60_000]], 0), &config).unwrap();
    let edge = analyser.next_edge(Duration::from_secs(1)).unwrap().unwrap();
    assert_eq!(edge.seq, 1);
    assert_eq!(analyser.next_edge(Duration::from_secs(1)).unwrap_err().kind, DeviceErrorKind::Disconnected);
}

#[test]
fn any_bytes_are_samples() {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(1);
    let mut block = |len: usize| (0..len).map(|_| random.next_u64() as u8).collect::<Vec<u8>>();
    let blocks = (0..1000).map(|k| block(10_000 + k % 7)).collect();
    let config = Fx2LafwConfig { quiet_us: 0.0, ..Fx2LafwConfig::default() };
    let mut analyser = Fx2Lafw::new(Bytes(blocks, 0), &config).unwrap();
    let mut changes = 0_u64;
    while analyser.next_change(Duration::from_secs(1)).is_ok_and(|change| change.is_some()) {
        changes += 1;
    }
    assert!(changes > 1_000_000, "{changes}");
}

#[test]
fn what_cannot_be_is_refused_with_its_key() {
    let refused = |config: Fx2LafwConfig, key: &str| {
        let fault = config.faults().into_iter().next().unwrap();
        let (found, message) = (fault.key, format!("vsync.fx2lafw.{fault}"));
        assert!(found == key && message.contains(key), "{message}");
        assert_eq!(
            Fx2Lafw::new(Bytes(Vec::new(), 0), &config).err().unwrap().kind,
            DeviceErrorKind::OutOfRange
        );
    };
    let config = Fx2LafwConfig::default;
    refused(Fx2LafwConfig { sample_rate_hz: 7, ..config() }, "sample_rate_hz");
    refused(Fx2LafwConfig { channels: [("exposure".to_owned(), 0)].into(), ..config() }, "channels");
    refused(Fx2LafwConfig { channels: [("vsync".to_owned(), 8)].into(), ..config() }, "channels");
    refused(Fx2LafwConfig { quiet_us: f64::NAN, ..config() }, "quiet_us");
    refused(Fx2LafwConfig { latency_us: -1.0, ..config() }, "latency_us");
}
