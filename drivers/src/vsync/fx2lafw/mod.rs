//! VSYNC on an input of a logic analyser with sigrok's firmware fx2lafw. The analyser samples the line, at 1 MHz
//! unless the rig file says otherwise, together with other signals (the camera's exposure, a mirror's sync), all on
//! its own clock.
//!
//! If the host does not keep up, the analyser stops: samples are never lost within a running stream.

pub mod protocol;
pub mod scan;
mod usb;

use std::collections::VecDeque;
use std::time::{Duration, Instant};

pub use raysweep_config::rig::vsync::{Fx2LafwConfig, Slope};
use raysweep_core::{ClockQuality, DeviceError, DeviceErrorKind, Edge, Vsync, ns_from_us};

use self::protocol::SampleRate;
use self::scan::Scanner;
use super::DEVICE;
use crate::arrival_clock::ArrivalClock;
pub use usb::{Usb, has_firmware};

/// Without a sample for so long the analyser has stopped.
const STALL: Duration = Duration::from_millis(1000);

/// The way to an analyser that samples.
pub trait AnalyserLink: Send {
    /// Passes the next samples to `take`, with their arrival time on the host's clock. Does nothing if none arrived
    /// within `timeout`.
    ///
    /// # Errors
    /// `Disconnected` if the analyser is gone.
    fn receive(&mut self, timeout: Duration, take: &mut dyn FnMut(&[u8], i64)) -> Result<(), DeviceError>;
}

/// A change of one of the analyser's signals.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Change {
    /// Index of the signal, in alphabetical order of names.
    pub channel: usize,
    /// Its direction.
    pub slope: Slope,
    /// Number of this change among the signal's changes in this direction, counted from 1.
    pub seq: u64,
    /// Time of the change.
    pub host_ns: i64,
}

/// Maximum number of changes that wait for the reader. Any more in one transfer are lost, which shows in their
/// numbers.
const QUEUE: usize = 4096;

/// A logic analyser that watches the VSYNC line.
pub struct Fx2Lafw<L> {
    link: L,
    last_sample: Instant,
    names: Vec<String>,
    signals: Signals,
    edge: Slope,
}

/// Processing of the samples.
struct Signals {
    rate: SampleRate,
    scanner: Scanner,
    clock: ArrivalClock,
    quiet_ns: i64,
    channels: Vec<Channel>,
    changes: VecDeque<Change>,
}

struct Channel {
    bit: u8,
    /// Its last change, whether it counted or not, on the analyser's clock.
    changed_ns: i64,
    /// Number of rising and falling changes that counted.
    counts: [u64; 2],
}

impl Fx2Lafw<Usb> {
    /// Opens the analyser, loads its firmware if it has none, and starts sampling. Edges are numbered from 1.
    ///
    /// # Errors
    /// `Disconnected` if there is none, `NotReady` if it needs a firmware that the rig file does not name,
    /// `Unsupported` for another device, `OutOfRange` for an invalid configuration.
    pub fn open(config: &Fx2LafwConfig) -> Result<Self, DeviceError> {
        let rate = checked(config)?;
        Self::new(Usb::open(config.firmware.as_deref(), rate)?, config)
    }
}

/// The rate of a configuration that an analyser can have.
fn checked(config: &Fx2LafwConfig) -> Result<SampleRate, DeviceError> {
    let refused =
        |what: String| DeviceError::new(DEVICE, DeviceErrorKind::OutOfRange, format!("vsync.fx2lafw.{what}"));
    if let Some(fault) = config.faults().into_iter().next() {
        return Err(refused(fault.to_string()));
    }
    SampleRate::from_hz(config.sample_rate_hz)
        .ok_or_else(|| refused(format!("sample_rate_hz = {}: no such rate", config.sample_rate_hz)))
}

impl<L: AnalyserLink> Fx2Lafw<L> {
    /// Uses an analyser that samples according to `config`.
    ///
    /// # Errors
    /// `OutOfRange` for an invalid configuration.
    pub fn new(link: L, config: &Fx2LafwConfig) -> Result<Self, DeviceError> {
        let rate = checked(config)?;
        let quiet_ns = ns_from_us(config.quiet_us);
        // The state before the first sample is unknown; it counts as quiet.
        let channel = |&input| Channel { bit: 1_u8 << input, changed_ns: -quiet_ns, counts: [0; 2] };
        let channels: Vec<Channel> = config.channels.values().map(channel).collect();
        Ok(Self {
            link,
            last_sample: Instant::now(),
            names: config.channels.keys().cloned().collect(),
            signals: Signals {
                rate,
                scanner: Scanner::new(channels.iter().fold(0, |mask, channel| mask | channel.bit)),
                clock: ArrivalClock::new(ns_from_us(config.latency_us)),
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

    /// The next change of any signal; `None` if there was none within `timeout`.
    ///
    /// # Errors
    /// `Disconnected` if the analyser is gone, `Timeout` if it has stopped.
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
                // Before the clock is known, a change has no time: it is numbered but dropped.
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

impl<L: AnalyserLink> Vsync for Fx2Lafw<L> {
    fn next_edge(&mut self, timeout: Duration) -> Result<Option<Edge>, DeviceError> {
        let deadline = Instant::now() + timeout;
        loop {
            let left = deadline.saturating_duration_since(Instant::now());
            let Some(change) = self.next_change(left)? else { return Ok(None) };
            if self.names[change.channel] == Fx2LafwConfig::VSYNC && change.slope == self.edge {
                return Ok(Some(Edge { seq: change.seq, host_ns: change.host_ns }));
            }
        }
    }

    fn clock(&self) -> Option<ClockQuality> {
        self.signals.clock.quality()
    }
}
