//! A logic analyser with sigrok's firmware fx2lafw, and the same chip without firmware.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, PoisonError};

use rand_distr::{Distribution, StandardNormal};
use raysweep_core::Clock;

use super::{Speed, Stall, UsbDevice, UsbIdentity, UsbRequest};
use crate::keyed::{Purpose, keyed, uniform};

/// Signals on the analyser's inputs, timed by the host's clock: a VSYNC on input 0, whose edges lie on multiples of its
/// period like those of the simulated line, and on input 1 the exposures of a camera that it triggers.
#[derive(Debug, Clone, Copy)]
pub struct Signal {
    /// Seed of all random numbers.
    pub seed: u64,
    /// Period of the VSYNC.
    pub period_ns: i64,
    /// Pulse length of the VSYNC.
    pub pulse_ns: i64,
    /// Standard deviation of the VSYNC edges.
    pub jitter_ns: f64,
    /// Fraction of edges that are missing.
    pub missing: f64,
    /// Fraction of periods with a false pulse.
    pub false_edges: f64,
    /// Time from an edge to the start of an exposure.
    pub exposure_after_ns: i64,
    /// Exposure time.
    pub exposure_ns: i64,
}

impl Signal {
    /// Start times of a period's pulse, unless it is missing, and of its false pulse, if any.
    pub fn edges(&self, period: i64) -> [Option<i64>; 2] {
        let mut random = keyed(self.seed, Purpose::Line, &[period.unsigned_abs()]);
        let z: f64 = StandardNormal.sample(&mut random);
        let present = uniform(&mut random) >= self.missing;
        let false_edge = uniform(&mut random) < self.false_edges;
        let nominal_ns = period * self.period_ns;
        let at = |share: f64| nominal_ns + (share * self.period_ns as f64) as i64;
        // A false pulse fits between the end of the exposure and the next true edge.
        let false_ns = at(0.3 + 0.5 * uniform(&mut random));
        [present.then_some(nominal_ns + (z * self.jitter_ns) as i64), false_edge.then_some(false_ns)]
    }

    /// Writes the samples from `first_ns` on, `step_ns` apart.
    pub fn samples(&self, first_ns: f64, step_ns: f64, samples: &mut [u8]) {
        samples.fill(0);
        let end_ns = first_ns + step_ns * samples.len() as f64;
        let mut draw = |bit: u8, from_ns: i64, to_ns: i64| {
            let place = |at_ns: i64| ((at_ns as f64 - first_ns) / step_ns).ceil().max(0.0) as usize;
            let (from, to) = (place(from_ns).min(samples.len()), place(to_ns).min(samples.len()));
            samples[from..to].iter_mut().for_each(|sample| *sample |= bit);
        };
        let period = |at_ns: f64| (at_ns / self.period_ns as f64).floor() as i64;
        for edge_ns in (period(first_ns) - 1..=period(end_ns) + 1).flat_map(|k| self.edges(k)).flatten() {
            draw(1, edge_ns, edge_ns + self.pulse_ns);
            let start_ns = edge_ns + self.exposure_after_ns;
            draw(2, start_ns, start_ns + self.exposure_ns);
        }
    }
}

/// The analyser.
pub struct Fx2Analyser {
    identity: UsbIdentity,
    signal: Signal,
    clock: Clock,
    /// How slow its clock is, in parts per million.
    rate_ppm: f64,
    running: Option<Sampling>,
    faults: Fx2Faults,
}

struct Sampling {
    start_ns: i64,
    step_ns: f64,
    taken: u64,
}

/// Faults that a test injects into the analyser.
#[derive(Clone, Default)]
pub struct Fx2Faults {
    stalled: Arc<AtomicBool>,
    overrun: Arc<AtomicBool>,
    starts: Arc<AtomicU64>,
}

impl Fx2Faults {
    /// Halts the sample endpoint until the host clears it.
    pub fn stall(&self) {
        self.stalled.store(true, Ordering::Relaxed);
    }

    /// Stops sampling until restarted, as after an overrun when the host is too slow.
    pub fn overrun(&self) {
        self.overrun.store(true, Ordering::Relaxed);
    }

    /// Number of times sampling was started.
    pub fn starts(&self) -> u64 {
        self.starts.load(Ordering::Relaxed)
    }
}

impl Fx2Analyser {
    /// An analyser of a signal.
    pub fn new(signal: Signal, rate_ppm: f64) -> (Self, Fx2Faults) {
        let identity = UsbIdentity {
            speed: Speed::High,
            vendor: 0x1D50,
            product: 0x608C,
            release: 1,
            strings: ["sigrok", "fx2lafw", ""],
            endpoints: vec![0x82],
        };
        let faults = Fx2Faults::default();
        let clock = Clock::real();
        (Self { identity, signal, clock, rate_ppm, running: None, faults: faults.clone() }, faults)
    }
}

impl UsbDevice for Fx2Analyser {
    fn identity(&self) -> &UsbIdentity {
        &self.identity
    }

    fn control(&mut self, request: &UsbRequest, data: &[u8]) -> Result<Vec<u8>, Stall> {
        match (request.is_in(), request.request, data) {
            (true, 0xB0, _) => Ok(vec![1, 4]),
            (false, 0xB1, &[flags, high, low]) => {
                let clock_hz = if flags & 0x40 != 0 { 48e6 } else { 30e6 };
                let step_ns = 1e9 / clock_hz * (f64::from(u16::from_be_bytes([high, low])) + 1.0);
                let step_ns = step_ns * (1.0 + self.rate_ppm * 1e-6);
                self.running = Some(Sampling { start_ns: self.clock.now_ns(), step_ns, taken: 0 });
                self.faults.starts.fetch_add(1, Ordering::Relaxed);
                Ok(Vec::new())
            }
            _ => Err(Stall),
        }
    }

    fn bulk_in(&mut self, _: u8, room: usize) -> Option<Result<Vec<u8>, Stall>> {
        if self.faults.stalled.load(Ordering::Relaxed) {
            return Some(Err(Stall));
        }
        if self.faults.overrun.swap(false, Ordering::Relaxed) {
            self.running = None;
        }
        let sampling = self.running.as_mut()?;
        let first_ns = sampling.start_ns as f64 + sampling.taken as f64 * sampling.step_ns;
        if first_ns + room as f64 * sampling.step_ns > self.clock.now_ns() as f64 {
            return None;
        }
        let mut samples = vec![0; room];
        self.signal.samples(first_ns, sampling.step_ns, &mut samples);
        sampling.taken += room as u64;
        Some(Ok(samples))
    }

    fn clear_halt(&mut self, _: u8) {
        self.faults.stalled.store(false, Ordering::Relaxed);
    }

    fn bulk_out(&mut self, _: u8, _: &[u8]) -> Result<(), Stall> {
        Err(Stall)
    }
}

/// The chip's boot loader: it accepts a firmware and leaves the bus when started; the test then plugs in an
/// [`Fx2Analyser`].
pub struct Fx2Blank {
    identity: UsbIdentity,
    memory: Fx2Memory,
}

/// The firmware loaded so far.
#[derive(Clone, Default)]
pub struct Fx2Memory {
    bytes: Arc<Mutex<BTreeMap<u16, u8>>>,
    started: Arc<AtomicBool>,
}

impl Fx2Memory {
    /// The first `len` bytes; bytes never written are zero.
    pub fn image(&self, len: u16) -> Vec<u8> {
        let bytes = self.bytes.lock().unwrap_or_else(PoisonError::into_inner);
        (0..len).map(|address| bytes.get(&address).copied().unwrap_or(0)).collect()
    }

    /// Whether the processor was started.
    pub fn is_started(&self) -> bool {
        self.started.load(Ordering::Relaxed)
    }
}

impl Fx2Blank {
    /// A clone of the analyser as sold, without firmware.
    pub fn new() -> (Self, Fx2Memory) {
        let identity = UsbIdentity {
            speed: Speed::High,
            vendor: 0x0925,
            product: 0x3881,
            release: 1,
            strings: ["", "", ""],
            endpoints: vec![0x82],
        };
        let memory = Fx2Memory::default();
        (Self { identity, memory: memory.clone() }, memory)
    }
}

impl UsbDevice for Fx2Blank {
    fn identity(&self) -> &UsbIdentity {
        &self.identity
    }

    fn control(&mut self, request: &UsbRequest, data: &[u8]) -> Result<Vec<u8>, Stall> {
        const CPUCS: u16 = 0xE600;
        match (request.request, request.value, data) {
            (0xA0, CPUCS, &[reset]) => self.memory.started.store(reset == 0, Ordering::Relaxed),
            (0xA0, address, data) => {
                let mut bytes = self.memory.bytes.lock().unwrap_or_else(PoisonError::into_inner);
                bytes.extend((address..).zip(data.iter().copied()));
            }
            _ => return Err(Stall),
        }
        Ok(Vec::new())
    }

    fn bulk_in(&mut self, _: u8, _: usize) -> Option<Result<Vec<u8>, Stall>> {
        None
    }

    fn bulk_out(&mut self, _: u8, _: &[u8]) -> Result<(), Stall> {
        Err(Stall)
    }
}
