//! `[vsync]`: what watches the VSYNC line.

use raysweep_drivers::vsync::fx2lafw::Fx2LafwConfig;
use raysweep_drivers::vsync::modemline::ModemLineConfig;
use raysweep_drivers::vsync::pps::PpsConfig;
use raysweep_drivers::vsync::triggerbox::TriggerBoxConfig;
use serde::Deserialize;

use super::ConfigError;

/// Drivers by the names that rig files use.
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
    /// strawlab's triggerbox, which makes the VSYNC.
    TriggerBox,
}

/// `[vsync]`
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VsyncSection {
    /// Which driver watches the line.
    pub driver: VsyncDriver,
    /// From one edge to the next.
    #[serde(default = "default_period_us")]
    pub period_us: f64,
    /// An edge this far from where the one before puts it is not the projector's.
    #[serde(default = "default_gate_us")]
    pub gate_us: f64,
    /// How long a watcher that is unplugged within a run may stay away.
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
    pub(super) fn check(&self, text: &str) -> Result<(), ConfigError> {
        let missing = |table: &str, keys: &str| {
            let message =
                format!("vsync.driver = \"{table}\": a table [vsync.{table}] with {keys} is missing");
            Err(ConfigError::at(text, &["vsync", "driver"], message))
        };
        match self.driver {
            VsyncDriver::ModemLine if self.modemline.is_none() => missing("modemline", "port"),
            VsyncDriver::Pps if self.pps.is_none() => missing("pps", "source"),
            VsyncDriver::TriggerBox if self.triggerbox.is_none() => missing("triggerbox", "port"),
            VsyncDriver::Fx2Lafw => match self.fx2lafw.check() {
                Ok(_) => Ok(()),
                Err((key, message)) => Err(ConfigError::at(text, &["vsync", "fx2lafw", key], message)),
            },
            _ => Ok(()),
        }
    }
}
