//! `[vsync]`: the device that watches the VSYNC line.

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use serde::Deserialize;

use crate::document::{Document, Fault, out_of_range};

/// VSYNC drivers, by their names in rig files.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum VsyncDriver {
    /// The simulated rig.
    Sim,
    /// A modem line of a serial port.
    ModemLine,
    /// A pulse-per-second source of the kernel.
    Pps,
    /// A logic analyser with sigrok's firmware.
    Fx2Lafw,
    /// strawlab's triggerbox, which generates the VSYNC.
    TriggerBox,
}

/// `[vsync]`
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VsyncSection {
    /// The driver that watches the line.
    pub driver: VsyncDriver,
    /// Time from one edge to the next.
    #[serde(default = "default_period_us")]
    pub period_us: f64,
    /// An edge that deviates by more than this from the prediction is not the projector's.
    #[serde(default = "default_gate_us")]
    pub gate_us: f64,
    /// How long to wait, in a run, for a watcher that was unplugged.
    #[serde(default = "default_reopen_s")]
    pub reopen_s: f64,
    /// `[vsync.modemline]`
    pub modemline: Option<ModemLineConfig>,
    /// `[vsync.pps]`
    pub pps: Option<PpsConfig>,
    /// `[vsync.fx2lafw]`
    #[serde(default)]
    pub fx2lafw: Fx2LafwConfig,
    /// `[vsync.triggerbox]`
    pub triggerbox: Option<TriggerBoxConfig>,
}

fn default_period_us() -> f64 {
    16_666.667
}
fn default_gate_us() -> f64 {
    500.0
}
fn default_reopen_s() -> f64 {
    60.0
}

impl VsyncSection {
    pub(super) fn check(&self, document: &mut Document<'_>) {
        document.check_range(&["vsync", "period_us"], self.period_us, 4000.0..=1e6);
        // If the period is out of its range, that is one mistake, not two.
        let period_us = self.period_us.clamp(4000.0, 1e6);
        document.check_range(&["vsync", "gate_us"], self.gate_us, 1.0..=period_us / 4.0);
        document.check_range(&["vsync", "reopen_s"], self.reopen_s, 0.0..=3600.0);
        let missing = match self.driver {
            VsyncDriver::ModemLine if self.modemline.is_none() => Some(("modemline", "port")),
            VsyncDriver::Pps if self.pps.is_none() => Some(("pps", "source")),
            VsyncDriver::TriggerBox if self.triggerbox.is_none() => Some(("triggerbox", "port")),
            _ => None,
        };
        if let Some((table, keys)) = missing {
            let message = format!("vsync.driver = \"{table}\" requires a table [vsync.{table}] with {keys}");
            document.refuse(&["vsync", "driver"], message);
        }
        if self.driver == VsyncDriver::Fx2Lafw {
            document.refuse_all(&["vsync", "fx2lafw"], self.fx2lafw.faults());
        }
    }
}

/// `[vsync.modemline]`
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ModemLineConfig {
    /// The serial port.
    pub port: PathBuf,
    /// The line that carries the VSYNC.
    #[serde(default)]
    pub line: ModemLineInput,
    /// The transition that counts as the edge.
    #[serde(default)]
    pub edge: Polarity,
}

/// A modem line for the VSYNC.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum ModemLineInput {
    /// Data carrier detect.
    #[default]
    Dcd,
    /// Clear to send.
    Cts,
}

/// `[vsync.pps]`
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PpsConfig {
    /// The source, such as `/dev/pps0`.
    pub source: PathBuf,
    /// The transition that counts as the edge.
    #[serde(default)]
    pub edge: Polarity,
}

/// The transition that counts as the VSYNC edge. TTL converters invert: a line at 0 V is asserted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Polarity {
    /// The line becomes asserted.
    #[default]
    Assert,
    /// The line becomes clear.
    Clear,
}

/// `[vsync.fx2lafw]`
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Fx2LafwConfig {
    /// Firmware to load into an analyser that has none, such as the file that sigrok's packages install.
    pub firmware: Option<PathBuf>,
    /// Samples per second: 48 or 30 MHz divided by an integer.
    pub sample_rate_hz: u32,
    /// Inputs, 0 to 7, by signal name; one of them is `vsync`.
    pub channels: BTreeMap<String, u8>,
    /// The transition of the VSYNC that counts as its edge.
    pub edge: Slope,
    /// A signal must have been quiet for this long before a change counts: lines ring.
    pub quiet_us: f64,
    /// From a sample to the arrival of its transfer without extra delay.
    pub latency_us: f64,
}

/// A direction of change.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Slope {
    /// From low to high.
    Rising,
    /// From high to low.
    Falling,
}

impl Default for Fx2LafwConfig {
    fn default() -> Self {
        Self {
            firmware: None,
            sample_rate_hz: 1_000_000,
            channels: [(Self::VSYNC.to_owned(), 0)].into(),
            edge: Slope::Rising,
            quiet_us: 5.0,
            latency_us: 100.0, // [A]
        }
    }
}

impl Fx2LafwConfig {
    /// The channel that carries the VSYNC.
    pub const VSYNC: &str = "vsync";
    /// The analyser's two clocks.
    const CLOCKS_HZ: [u32; 2] = [48_000_000, 30_000_000];
    /// Sample rates that a divided clock can provide.
    const RATES_HZ: std::ops::RangeInclusive<u32> = 20_000..=24_000_000;

    /// Faults that can be found without the analyser.
    pub fn faults(&self) -> Vec<Fault> {
        let Self { sample_rate_hz, channels, quiet_us, latency_us, .. } = self;
        let rules = [("quiet_us", *quiet_us, 0.0..=1000.0), ("latency_us", *latency_us, 0.0..=10_000.0)];
        let mut faults: Vec<Fault> = out_of_range(rules).collect();
        let is_divided = |clock_hz: u32| *sample_rate_hz > 0 && clock_hz.is_multiple_of(*sample_rate_hz);
        if !(Self::RATES_HZ.contains(sample_rate_hz) && Self::CLOCKS_HZ.into_iter().any(is_divided)) {
            let message = format!(
                " = {sample_rate_hz}: must be 48000000 or 30000000 divided by a whole number, from 20000 to 24000000; 1000000 is a good choice"
            );
            faults.push(Fault { key: "sample_rate_hz", message });
        }
        let inputs: BTreeSet<_> = channels.values().collect();
        if !channels.contains_key(Self::VSYNC)
            || channels.values().any(|&input| input > 7)
            || inputs.len() < channels.len()
        {
            let message = format!(
                " = {channels:?}: must give each signal an input of its own, 0 to 7, and name one signal \"{}\"",
                Self::VSYNC
            );
            faults.push(Fault { key: "channels", message });
        }
        faults
    }
}

/// `[vsync.triggerbox]`
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TriggerBoxConfig {
    /// Its serial port.
    pub port: PathBuf,
    /// The connection between the port and the box.
    #[serde(default)]
    pub link: TriggerBoxLink,
}

/// How bytes reach the box.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum TriggerBoxLink {
    /// A UART (Arduino Uno and Nano): each byte takes 87 us.
    #[default]
    Uart,
    /// The box's own USB (Raspberry Pi Pico): bytes take no time.
    Usb,
}
