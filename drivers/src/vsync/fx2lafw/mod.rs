//! VSYNC on an input of a logic analyser with sigrok's firmware fx2lafw: the line is sampled, by 1 MHz unless the rig says
//! otherwise, and so are other signals beside it (the camera's exposure, a mirror's sync), all on the analyser's one clock.
//!
//! An analyser whose host does not keep up stops by itself: no sample is ever lost within a stream that goes on.

mod clock;
pub mod protocol;
pub mod scan;
mod usb;

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::time::{Duration, Instant};

use raysweep_core::{ClockQuality, DeviceError, DeviceErrorKind, Edge, Vsync, ns_from_us};

use self::clock::SampleClock;
use self::protocol::SampleRate;
use self::scan::Scanner;
use super::DEVICE;
pub use usb::Usb;

/// The channel that carries the VSYNC.
pub const VSYNC: &str = "vsync";
/// Without a sample for so long the analyser has stopped.
const STALL: Duration = Duration::from_millis(1000);

/// `[vsync.fx2lafw]`
#[derive(Debug, Clone, serde::Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Fx2LafwConfig {
    /// Firmware to load into an analyser that has none, as sigrok's packages install it.
    pub firmware: Option<PathBuf>,
    /// Samples a second: 48 or 30 MHz over a whole number.
    pub sample_rate_hz: u32,
    /// Inputs, 0 to 7, by the names of their signals; `vsync` is one of them.
    pub channels: BTreeMap<String, u8>,
    /// Which change of the VSYNC is its edge.
    pub edge: Slope,
    /// A signal must have been quiet for so long before a change counts: lines ring.
    pub quiet_us: f64,
    /// From a sample to its transfer's arrival when nothing delays it.
    pub latency_us: f64,
}

impl Default for Fx2LafwConfig {
    fn default() -> Self {
        Self {
            firmware: None,
            sample_rate_hz: 1_000_000,
            channels: [(VSYNC.to_owned(), 0)].into(),
            edge: Slope::Rising,
            quiet_us: 5.0,
            latency_us: 100.0, // [A]
        }
    }
}

/// A direction of change.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Slope {
    /// From low to high.
    Rising,
    /// From high to low.
    Falling,
}

impl Fx2LafwConfig {
    /// Whether the values can be; else the key and what is wrong.
    ///
    /// # Errors
    /// Key, value and what is allowed.
    pub fn check(&self) -> Result<SampleRate, (&'static str, String)> {
        let Self { sample_rate_hz, channels, quiet_us, latency_us, .. } = self;
        let Some(rate) = SampleRate::from_hz(*sample_rate_hz) else {
            let what = format!(
                "vsync.fx2lafw.sample_rate_hz = {sample_rate_hz}: allowed is 48000000 or 30000000 over a whole number, 20000 to 24000000; take 1000000"
            );
            return Err(("sample_rate_hz", what));
        };
        let inputs: std::collections::BTreeSet<_> = channels.values().collect();
        if !channels.contains_key(VSYNC)
            || channels.values().any(|&input| input > 7)
            || inputs.len() < channels.len()
        {
            let what = format!(
                "vsync.fx2lafw.channels = {channels:?}: each is an input of its own, 0 to 7, and \"{VSYNC}\" is one of them"
            );
            return Err(("channels", what));
        }
        for (key, value, high) in [("quiet_us", *quiet_us, 1000.0), ("latency_us", *latency_us, 10_000.0)] {
            if !(0.0..=high).contains(&value) {
                return Err((key, format!("vsync.fx2lafw.{key} = {value}: allowed is 0 to {high}")));
            }
        }
        Ok(rate)
    }
}

/// The way to an analyser that samples.
pub trait Link: Send {
    /// Hands the next samples, with when they had arrived on the host's clock, to `take`; nothing if none came within
    /// `timeout`.
    ///
    /// # Errors
    /// `Disconnected` when the analyser is gone.
    fn receive(&mut self, timeout: Duration, take: &mut dyn FnMut(&[u8], i64)) -> Result<(), DeviceError>;
}

/// A change of one of the analyser's signals.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Change {
    /// Which, in the alphabetical order of names.
    pub channel: usize,
    /// Its direction.
    pub slope: Slope,
    /// Changes of this signal in this direction so far, this one with them.
    pub seq: u64,
    /// When it was.
    pub host_ns: i64,
}

/// Changes that wait for the reader. More in one transfer are lost, and their numbers show it.
const QUEUE: usize = 4096;

/// A logic analyser that watches the VSYNC line.
pub struct Fx2Lafw<L> {
    link: L,
    last_sample: Instant,
    names: Vec<String>,
    signals: Signals,
    edge: Slope,
}

/// What is made of the samples.
struct Signals {
    rate: SampleRate,
    scanner: Scanner,
    clock: SampleClock,
    quiet_ns: i64,
    channels: Vec<Channel>,
    changes: VecDeque<Change>,
}

struct Channel {
    bit: u8,
    /// When it changed last, whether that counted or not, on the analyser's clock.
    changed_ns: i64,
    /// Rising and falling changes that counted.
    counts: [u64; 2],
}

impl Fx2Lafw<Usb> {
    /// Opens the analyser, loads its firmware if it has none, and begins to sample. Edges are numbered from 1 on.
    ///
    /// # Errors
    /// `Disconnected` if there is none, `NotReady` if it needs a firmware that the rig does not name, `Unsupported` if it is
    /// another device, `OutOfRange` for a configuration that cannot be.
    pub fn open(config: &Fx2LafwConfig) -> Result<Self, DeviceError> {
        let rate = checked(config)?;
        Self::new(Usb::open(config.firmware.as_deref(), rate)?, config)
    }
}

fn checked(config: &Fx2LafwConfig) -> Result<SampleRate, DeviceError> {
    config.check().map_err(|(_, what)| DeviceError::new(DEVICE, DeviceErrorKind::OutOfRange, what))
}

impl<L: Link> Fx2Lafw<L> {
    /// An analyser that has begun to sample as `config` says.
    ///
    /// # Errors
    /// `OutOfRange` for a configuration that cannot be.
    pub fn new(link: L, config: &Fx2LafwConfig) -> Result<Self, DeviceError> {
        let rate = checked(config)?;
        let quiet_ns = ns_from_us(config.quiet_us);
        // Before the first sample nothing is known; it counts as quiet.
        let channel = |&input| Channel { bit: 1_u8 << input, changed_ns: -quiet_ns, counts: [0; 2] };
        let channels: Vec<Channel> = config.channels.values().map(channel).collect();
        Ok(Self {
            link,
            last_sample: Instant::now(),
            names: config.channels.keys().cloned().collect(),
            signals: Signals {
                rate,
                scanner: Scanner::new(channels.iter().fold(0, |mask, channel| mask | channel.bit)),
                clock: SampleClock::new(ns_from_us(config.latency_us)),
                quiet_ns,
                channels,
                changes: VecDeque::with_capacity(QUEUE),
            },
            edge: config.edge,
        })
    }

    /// The signals' names, in the order of [`Change::channel`].
    pub fn channels(&self) -> &[String] {
        &self.names
    }

    /// The next change of any signal; `None` when none came within `timeout`.
    ///
    /// # Errors
    /// `Disconnected` when the analyser is gone, `Timeout` when it has stopped.
    pub fn next_change(&mut self, timeout: Duration) -> Result<Option<Change>, DeviceError> {
        let deadline = Instant::now() + timeout;
        loop {
            if let Some(change) = self.signals.changes.pop_front() {
                return Ok(Some(change));
            }
            let left = deadline.saturating_duration_since(Instant::now());
            let (signals, last_sample) = (&mut self.signals, &mut self.last_sample);
            self.link.receive(left, &mut |samples, arrived_ns| {
                *last_sample = Instant::now();
                signals.take(samples, arrived_ns);
            })?;
            if self.last_sample.elapsed() > STALL {
                let what = "the analyser has stopped: the host did not keep up, or its cable is loose; lower sample_rate_hz or plug it into another port";
                return Err(DeviceError::new(DEVICE, DeviceErrorKind::Timeout, what));
            }
            if left.is_zero() && self.signals.changes.is_empty() {
                return Ok(None);
            }
        }
    }
}

impl Signals {
    fn take(&mut self, samples: &[u8], arrived_ns: i64) {
        let Self { rate, scanner, clock, quiet_ns, channels, changes } = self;
        scanner.scan(samples, |sample, levels, changed| {
            let device_ns = rate.device_ns(sample);
            for (index, channel) in channels.iter_mut().enumerate().filter(|(_, c)| c.bit & changed != 0) {
                let quiet = device_ns - std::mem::replace(&mut channel.changed_ns, device_ns) >= *quiet_ns;
                if !quiet {
                    continue;
                }
                let slope = if levels & channel.bit != 0 { Slope::Rising } else { Slope::Falling };
                channel.counts[slope as usize] += 1;
                // Before the clock is known a change has no time: it is numbered, and lost.
                if let Some(host_ns) = clock.host_ns(device_ns)
                    && changes.len() < QUEUE
                {
                    changes.push_back(Change {
                        channel: index,
                        slope,
                        seq: channel.counts[slope as usize],
                        host_ns,
                    });
                }
            }
        });
        clock.arrived(rate.device_ns(scanner.samples()), arrived_ns);
    }
}

impl<L: Link> Vsync for Fx2Lafw<L> {
    fn next_edge(&mut self, timeout: Duration) -> Result<Option<Edge>, DeviceError> {
        let deadline = Instant::now() + timeout;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let Some(change) = self.next_change(left)? else { return Ok(None) };
            if self.names[change.channel] == VSYNC && change.slope == self.edge {
                return Ok(Some(Edge { seq: change.seq, host_ns: change.host_ns }));
            }
        }
    }

    fn clock(&self) -> Option<ClockQuality> {
        self.signals.clock.quality()
    }
}
