//! Simulated USB devices for the kernel's own drivers, or libusb: over USB/IP through `vhci-hcd`, without a network.
//! Plugging one in requires root and that kernel module, which the kernel guest (`cargo xtask guest`) provides.

mod ftdi;
mod fx2lafw;
mod responder;
mod vhci;

pub use ftdi::{Ftdi, FtdiLine};
pub use fx2lafw::{Fx2Analyser, Fx2Blank, Fx2Faults, Fx2Memory, Signal};
pub use responder::respond;
pub use vhci::Plugged;

/// The endpoint stalls: the answer to requests that a device does not know or cannot perform.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stall;

/// A request on endpoint 0 (USB 2.0, section 9.3).
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct UsbRequest {
    /// Direction, kind and recipient (`bmRequestType`).
    pub kind: u8,
    /// `bRequest`.
    pub request: u8,
    /// `wValue`.
    pub value: u16,
    /// `wIndex`.
    pub index: u16,
    /// Number of bytes that follow or are requested.
    pub length: u16,
}

impl UsbRequest {
    /// Whether the device returns data.
    pub fn is_in(&self) -> bool {
        self.kind & 0x80 != 0
    }
}

/// A device with one vendor-specific interface of bulk endpoints. The responder answers standard requests.
pub trait UsbDevice: Send {
    /// The device's descriptors; constant while it is plugged in.
    fn identity(&self) -> &UsbIdentity;

    /// Handles a vendor or class request, with the data of an outgoing one; returns the data of an incoming one.
    ///
    /// # Errors
    /// When the device does not know the request.
    fn control(&mut self, request: &UsbRequest, data: &[u8]) -> Result<Vec<u8>, Stall>;

    /// Returns at most `room` bytes for the host from an endpoint, `None` if there are none. Polled every millisecond.
    ///
    /// # Errors
    /// When the endpoint is halted.
    fn bulk_in(&mut self, endpoint: u8, room: usize) -> Option<Result<Vec<u8>, Stall>>;

    /// Handles bytes from the host to an endpoint.
    ///
    /// # Errors
    /// When the endpoint is halted.
    fn bulk_out(&mut self, endpoint: u8, data: &[u8]) -> Result<(), Stall>;

    /// The host has cleared an endpoint that may be halted.
    fn clear_halt(&mut self, _endpoint: u8) {}
}

/// Speed of a device, numbered as in Linux.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Speed {
    /// 12 Mbit/s.
    Full = 2,
    /// 480 Mbit/s.
    High = 3,
}

/// Contents of the descriptors.
#[derive(Debug, Clone)]
pub struct UsbIdentity {
    /// Full or high speed.
    pub speed: Speed,
    /// `idVendor`.
    pub vendor: u16,
    /// `idProduct`.
    pub product: u16,
    /// `bcdDevice`, by which drivers tell chips apart.
    pub release: u16,
    /// Manufacturer, product, serial number.
    pub strings: [&'static str; 3],
    /// Addresses of the bulk endpoints; bit 7 is set for IN endpoints.
    pub endpoints: Vec<u8>,
}

impl UsbIdentity {
    /// Returns a descriptor by its type and index (USB 2.0, section 9.6).
    fn descriptor(&self, kind: u8, index: u8) -> Result<Vec<u8>, Stall> {
        match kind {
            1 => Ok(self.device_descriptor()),
            2 => Ok(self.configuration_descriptor()),
            3 => self.string_descriptor(index),
            _ => Err(Stall),
        }
    }

    fn device_descriptor(&self) -> Vec<u8> {
        let mut bytes = vec![18, 1, 0x00, 0x02, 0, 0, 0, 64];
        bytes.extend([self.vendor, self.product, self.release].iter().flat_map(|word| word.to_le_bytes()));
        bytes.extend([1, 2, 3, 1]);
        bytes
    }

    fn configuration_descriptor(&self) -> Vec<u8> {
        let total = 9 + 9 + 7 * self.endpoints.len() as u16;
        let [low, high] = total.to_le_bytes();
        // Declared as bus-powered, 100 mA.
        let mut bytes = vec![9, 2, low, high, 1, 1, 0, 0x80, 50];
        bytes.extend([9, 4, 0, 0, self.endpoints.len() as u8, 0xff, 0xff, 0xff, 2]);
        let [low, high] = self.packet_len().to_le_bytes();
        for &endpoint in &self.endpoints {
            bytes.extend([7, 5, endpoint, 2, low, high, 0]);
        }
        bytes
    }

    fn string_descriptor(&self, index: u8) -> Result<Vec<u8>, Stall> {
        const ENGLISH: u16 = 0x0409;
        let units: Vec<u16> = match index {
            0 => vec![ENGLISH],
            _ => self.strings.get(usize::from(index) - 1).ok_or(Stall)?.encode_utf16().collect(),
        };
        let head = [2 + 2 * units.len() as u8, 3];
        Ok(head.into_iter().chain(units.iter().flat_map(|unit| unit.to_le_bytes())).collect())
    }

    /// Maximum packet size of a bulk endpoint.
    fn packet_len(&self) -> u16 {
        match self.speed {
            Speed::Full => 64,
            Speed::High => 512,
        }
    }
}
