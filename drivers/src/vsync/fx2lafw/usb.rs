//! The analyser on the USB.

use std::path::Path;
use std::time::{Duration, Instant};

use nusb::transfer::{Bulk, Completion, ControlIn, ControlOut, ControlType, In, Recipient, TransferError};
use nusb::{Endpoint, Interface, MaybeFuture};
use raysweep_core::{Clock, DeviceError, DeviceErrorKind};

use super::AnalyserLink;
use super::protocol::{
    CPUCS, FIRMWARE_BYTES, MAJOR, SAMPLES, START, SampleRate, VERSION, WRITE_BYTES, WRITE_RAM,
};
use crate::vsync::DEVICE;

/// Vendor and product ids of analysers with the firmware.
const READY: (u16, u16) = (0x1D50, 0x608C);
/// Vendor and product ids of the chip and of clones without the firmware.
const BLANK: [(u16, u16); 3] = [(0x0925, 0x3881), (0x04B4, 0x8613), (0x08A9, 0x0014)];
/// Whether the analyser with these ids has its firmware; `None` for other devices.
pub fn has_firmware(vendor: u16, product: u16) -> Option<bool> {
    let is_blank = BLANK.contains(&(vendor, product));
    ((vendor, product) == READY || is_blank).then_some(!is_blank)
}

/// Maximum time for an analyser to reappear with its firmware.
const RENUMERATION: Duration = Duration::from_secs(3);
const CONTROL: Duration = Duration::from_millis(500);
/// Duration of one transfer, and number of pending transfers: together the host may sleep for an eighth of a second.
const TRANSFER_MS: u32 = 4;
const TRANSFERS: usize = 32;

/// Why an analyser cannot be used, or cannot be used any longer.
#[derive(Debug, thiserror::Error)]
enum UsbError {
    #[error("no fx2lafw analyser on the bus: plug it in")]
    NotFound,
    #[error("{0} fx2lafw analysers on the bus: leave one")]
    Several(usize),
    #[error(
        "the analyser has no firmware: install sigrok-firmware-fx2lafw and name its file as vsync.fx2lafw.firmware"
    )]
    NoFirmware,
    #[error("vsync.fx2lafw.firmware = {path}: {what}")]
    Firmware { path: String, what: String },
    #[error("the analyser did not come back within {RENUMERATION:?} with its firmware: plug it in again")]
    NotBack,
    #[error(
        "unsupported firmware version {major}.{minor} of the analyser (this driver needs {MAJOR}.x): unplug it, so that it loads another"
    )]
    Version { major: u8, minor: u8 },
    #[error(
        "{call}: {source}: may the daemon's user write to the device (udev), and does no other program hold it?"
    )]
    System { call: &'static str, source: nusb::Error },
    #[error("{call}: {source}: plug the analyser in again")]
    Transfer { call: &'static str, source: TransferError },
}

impl From<UsbError> for DeviceError {
    fn from(error: UsbError) -> Self {
        let kind = match &error {
            UsbError::NotFound | UsbError::NotBack => DeviceErrorKind::Disconnected,
            UsbError::Several(_) | UsbError::Version { .. } => DeviceErrorKind::Unsupported,
            UsbError::NoFirmware | UsbError::Firmware { .. } => DeviceErrorKind::NotReady,
            UsbError::System { source, .. } => match source.kind() {
                nusb::ErrorKind::Busy => DeviceErrorKind::Busy,
                nusb::ErrorKind::Disconnected | nusb::ErrorKind::NotFound => DeviceErrorKind::Disconnected,
                _ => DeviceErrorKind::NotReady,
            },
            UsbError::Transfer { source, .. } => match source {
                TransferError::Disconnected => DeviceErrorKind::Disconnected,
                TransferError::Cancelled => DeviceErrorKind::Timeout,
                _ => DeviceErrorKind::Protocol,
            },
        };
        Self::new(DEVICE, kind, error)
    }
}

/// A sampling analyser with its pending transfers.
pub struct Usb {
    endpoint: Endpoint<Bulk, In>,
    clock: Clock,
    /// Keeps the interface claimed for as long as the endpoint exists.
    _interface: Interface,
}

impl Usb {
    pub(super) fn open(firmware: Option<&Path>, rate: SampleRate) -> Result<Self, DeviceError> {
        let device = match find(&[READY])? {
            Some(device) => device,
            None => load(find(&BLANK)?.ok_or(UsbError::NotFound)?, firmware)?,
        };
        let interface = claim(&device)?;
        let version = ControlIn {
            control_type: ControlType::Vendor,
            recipient: Recipient::Device,
            request: VERSION,
            value: 0,
            index: 0,
            length: 2,
        };
        let version = interface.control_in(version, CONTROL).wait().map_err(transfer("version"))?;
        match version[..] {
            [MAJOR, _] => {}
            [major, minor] => return Err(UsbError::Version { major, minor }.into()),
            _ => return Err(UsbError::Version { major: 0, minor: 0 }.into()),
        }
        let mut endpoint = interface
            .endpoint::<Bulk, In>(SAMPLES)
            .map_err(|source| UsbError::System { call: "samples", source })?;
        // A halted endpoint stays halted for the next process that opens it, unless cleared.
        endpoint.clear_halt().wait().map_err(|source| UsbError::System { call: "clear", source })?;
        let packet = endpoint.max_packet_size().max(1);
        let bytes = (rate.hz() as usize * TRANSFER_MS as usize / 1000).next_multiple_of(packet);
        // Submitted before the first sample is taken: the analyser stops at once if nobody receives its samples.
        for _ in 0..TRANSFERS {
            let buffer = endpoint.allocate(bytes);
            endpoint.submit(buffer);
        }
        write(&interface, START, 0, &rate.start_command())?;
        Ok(Self { endpoint, clock: Clock::real(), _interface: interface })
    }
}

impl AnalyserLink for Usb {
    fn receive(&mut self, timeout: Duration, take: &mut dyn FnMut(&[u8], i64)) -> Result<(), DeviceError> {
        let Some(completion) = self.endpoint.wait_next_complete(timeout) else { return Ok(()) };
        let arrived_ns = self.clock.now_ns();
        let Completion { mut buffer, actual_len, status } = completion;
        status.map_err(transfer("samples"))?;
        take(&buffer[..actual_len], arrived_ns);
        buffer.clear();
        self.endpoint.submit(buffer);
        Ok(())
    }
}

fn transfer(call: &'static str) -> impl Fn(TransferError) -> UsbError {
    move |source| UsbError::Transfer { call, source }
}

/// Finds the only device on the bus with one of these ids.
fn find(identities: &[(u16, u16)]) -> Result<Option<nusb::DeviceInfo>, UsbError> {
    let devices = nusb::list_devices().wait().map_err(|source| UsbError::System { call: "list", source })?;
    let mut found: Vec<_> =
        devices.filter(|device| identities.contains(&(device.vendor_id(), device.product_id()))).collect();
    match found.len() {
        0 | 1 => Ok(found.pop()),
        several => Err(UsbError::Several(several)),
    }
}

fn claim(device: &nusb::DeviceInfo) -> Result<Interface, UsbError> {
    let system = |call| move |source| UsbError::System { call, source };
    let device = device.open().wait().map_err(system("open"))?;
    device.claim_interface(0).wait().map_err(system("claim"))
}

fn write(interface: &Interface, request: u8, value: u16, data: &[u8]) -> Result<(), UsbError> {
    let out = ControlOut {
        control_type: ControlType::Vendor,
        recipient: Recipient::Device,
        request,
        value,
        index: 0,
        data,
    };
    interface.control_out(out, CONTROL).wait().map_err(transfer("control"))
}

/// Loads the firmware and waits for the analyser to reappear.
fn load(blank: nusb::DeviceInfo, firmware: Option<&Path>) -> Result<nusb::DeviceInfo, UsbError> {
    let path = firmware.ok_or(UsbError::NoFirmware)?;
    let refused = |what: String| UsbError::Firmware { path: path.display().to_string(), what };
    let image = std::fs::read(path).map_err(|error| refused(error.to_string()))?;
    if image.is_empty() || image.len() > FIRMWARE_BYTES {
        return Err(refused(format!("{} bytes: must be from 1 to {FIRMWARE_BYTES}", image.len())));
    }
    let interface = claim(&blank)?;
    write(&interface, WRITE_RAM, CPUCS, &[1])?;
    for (part, address) in image.chunks(WRITE_BYTES).zip((0..).step_by(WRITE_BYTES)) {
        write(&interface, WRITE_RAM, address, part)?;
    }
    // The chip starts the firmware and leaves the bus, sometimes before it has answered.
    if let Err(error) = write(&interface, WRITE_RAM, CPUCS, &[0]) {
        tracing::debug!(%error, "the analyser left the bus to start its firmware");
    }
    drop(interface);
    let deadline = Instant::now() + RENUMERATION;
    while Instant::now() < deadline {
        if let Some(device) = find(&[READY])? {
            return Ok(device);
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    Err(UsbError::NotBack)
}
