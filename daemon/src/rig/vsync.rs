//! Watchers of a real VSYNC line.

use std::time::Duration;

use raysweep_config::rig::vsync::{VsyncDriver, VsyncSection};
use raysweep_core::{DeviceError, Edge, Vsync};
use raysweep_drivers::vsync::fx2lafw::Fx2Lafw;
use raysweep_drivers::vsync::modemline::ModemLine;
use raysweep_drivers::vsync::pps::Pps;
use raysweep_drivers::vsync::reopen::Reopened;
use raysweep_drivers::vsync::triggerbox::TriggerBox;

/// In place of a watcher where nobody looks at edges.
pub struct Unwatched;

impl Vsync for Unwatched {
    fn next_edge(&mut self, timeout: Duration) -> Result<Option<Edge>, DeviceError> {
        std::thread::sleep(timeout);
        Ok(None)
    }
}

/// Opens the watcher that a rig file names; `None`: the simulated one. If it is unplugged during a run, it is
/// reopened.
///
/// # Errors
/// Those of its driver.
pub fn open(section: &VsyncSection) -> Result<Option<Box<dyn Vsync>>, DeviceError> {
    let patience = Duration::from_secs_f64(section.reopen_s);
    let watcher = match section.driver {
        VsyncDriver::Sim => None,
        VsyncDriver::ModemLine => section.modemline.clone().map(|config| {
            let open = move || ModemLine::open(&config.port, config.line, config.edge);
            open().map(|device| reopened(device, open, patience))
        }),
        VsyncDriver::Pps => section.pps.clone().map(|config| {
            let open = move || Pps::open(&config.source, config.edge);
            open().map(|device| reopened(device, open, patience))
        }),
        VsyncDriver::Fx2Lafw => {
            let config = section.fx2lafw.clone();
            let open = move || Fx2Lafw::open(&config);
            Some(open().map(|device| reopened(device, open, patience)))
        }
        VsyncDriver::TriggerBox => section.triggerbox.clone().map(|config| {
            let period_us = section.period_us;
            let device = TriggerBox::open(config.clone(), period_us);
            let open = move || TriggerBox::connect(config.clone(), period_us);
            device.map(|device| reopened(device, open, patience))
        }),
    };
    watcher.transpose()
}

fn reopened<V: Vsync + 'static>(
    device: V,
    open: impl FnMut() -> Result<V, DeviceError> + Send + 'static,
    patience: Duration,
) -> Box<dyn Vsync> {
    Box::new(Reopened::new(device, Box::new(open), patience))
}
