//! The camera's memory: registers of the feature table, constants of the standard, and the description.

use std::net::Ipv4Addr;

use super::features::{Feature, FeatureId, Kind, MAKERS_REGISTERS, MAKERS_STRIDE, RegisterAccess};
use super::gvcp::GvcpStatus;

/// Length of a discovery answer: the beginning of the memory.
pub const DISCOVERY_BYTES: usize = 0xF8;
/// Size of the address range defined by the standard.
const STANDARD_BYTES: u32 = 0x1000;
const DESCRIPTION: u32 = 0x10_0000;
/// Version 2.0 of GigE Vision.
const VERSION: u32 = 0x0002_0000;
/// Big-endian, UTF-8 character set.
const DEVICE_MODE: u32 = 0x8000_0001;
/// Link-local addressing, the only configuration mode that all devices support.
const LINK_LOCAL: u32 = 4;
const URL_BYTES: usize = 512;
/// Optional GVCP features of this camera: concatenated reads, memory writes, resending, heartbeat, names.
const CAPABILITIES: u32 = 1 | 1 << 1 | 1 << 30 | 1 << 31;
const RESENDS: u32 = 1 << 2;

/// Properties that are fixed when the camera is created.
pub struct CameraIdentity<'a> {
    /// Address on which it listens.
    pub address: Ipv4Addr,
    /// Model name.
    pub model: &'a str,
    /// Serial number.
    pub serial: &'a str,
    /// Ticks per second of its clock.
    pub tick_frequency_hz: u64,
    /// Description, and the name of its file.
    pub description: (Vec<u8>, &'static str),
}

/// The memory of the camera.
pub struct Registers {
    features: Vec<Feature>,
    standard: Vec<u8>,
    makers: Vec<u8>,
    description: Vec<u8>,
}

/// A validated write that has not been carried out yet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Write<'a> {
    /// The register.
    pub id: FeatureId,
    /// Access mode of the register.
    pub access: RegisterAccess,
    address: u32,
    data: &'a [u8],
}

impl Write<'_> {
    /// The written value, for a four-byte integer register.
    pub fn value(&self) -> u32 {
        super::gvcp::u32_at(self.data, 0).unwrap_or(0)
    }
}

impl Registers {
    /// The memory after power-on.
    pub fn new(features: Vec<Feature>, identity: CameraIdentity<'_>) -> Self {
        let (description, file) = identity.description;
        let bytes = description.len();
        let mut registers = Self {
            standard: vec![0; STANDARD_BYTES as usize],
            makers: vec![0; features.len() * MAKERS_STRIDE as usize],
            features,
            description,
        };
        // Clients read whole words, including the last one.
        registers.description.resize(bytes.next_multiple_of(4), 0);
        let octets = identity.address.octets();
        // A locally administered MAC address, derived from the IP address.
        let mac = [0x02, 0x52, octets[0], octets[1], octets[2], octets[3]];
        let url = format!("Local:{file};{DESCRIPTION:x};{bytes:x}");
        let mut put = |address: usize, bytes: &[u8]| {
            registers.standard[address..address + bytes.len()].copy_from_slice(bytes);
        };
        put(0x00, &VERSION.to_be_bytes());
        put(0x04, &DEVICE_MODE.to_be_bytes());
        put(0x0A, &mac);
        put(0x10, &LINK_LOCAL.to_be_bytes());
        put(0x14, &LINK_LOCAL.to_be_bytes());
        put(0x24, &octets);
        put(0x34, &[255, 0, 0, 0]);
        put(0x200, &url.as_bytes()[..url.len().min(URL_BYTES - 1)]);
        put(0x600, &1_u32.to_be_bytes());
        put(0x904, &1_u32.to_be_bytes());
        put(0x934, &CAPABILITIES.to_be_bytes());
        registers.set_text(FeatureId::DeviceVendorName, "raysweep");
        registers.set_text(FeatureId::DeviceModelName, identity.model);
        registers.set_text(FeatureId::DeviceVersion, env!("CARGO_PKG_VERSION"));
        registers.set_text(FeatureId::DeviceManufacturerInfo, "simulated camera");
        registers.set_text(FeatureId::DeviceSerialNumber, identity.serial);
        for feature in registers.features.clone() {
            if feature.initial != 0 {
                registers.set_bits(feature.id, feature.initial);
            }
        }
        registers.set_long(FeatureId::GevTimestampTickFrequency, identity.tick_frequency_hz);
        registers
    }

    /// Sets whether the camera declares support for resending packets.
    pub fn set_resends(&mut self, resends: bool) {
        let capabilities = if resends { CAPABILITIES | RESENDS } else { CAPABILITIES };
        self.standard[0x934..0x938].copy_from_slice(&capabilities.to_be_bytes());
    }

    /// Contents of a discovery answer.
    pub fn discovery(&self) -> &[u8] {
        &self.standard[..DISCOVERY_BYTES]
    }

    /// Reads bytes from an address.
    ///
    /// # Errors
    /// `BadAlignment` unless address and length are multiples of four, `InvalidAddress` outside the memory.
    pub fn read(&self, address: u32, bytes: usize) -> Result<&[u8], GvcpStatus> {
        if !address.is_multiple_of(4) || !bytes.is_multiple_of(4) {
            return Err(GvcpStatus::BadAlignment);
        }
        let (base, memory) = match address {
            DESCRIPTION.. => (DESCRIPTION, &self.description),
            MAKERS_REGISTERS.. => (MAKERS_REGISTERS, &self.makers),
            _ => (0, &self.standard),
        };
        let from = (address - base) as usize;
        memory.get(from..from + bytes).ok_or(GvcpStatus::InvalidAddress)
    }

    /// Validates a write without carrying it out.
    ///
    /// # Errors
    /// `InvalidAddress` unless it covers exactly one register, `WriteProtect` for a read-only register,
    /// `InvalidParameter` for a value that the feature does not accept.
    pub fn check<'a>(&self, address: u32, data: &'a [u8]) -> Result<Write<'a>, GvcpStatus> {
        if !address.is_multiple_of(4) {
            return Err(GvcpStatus::BadAlignment);
        }
        let feature = self.features.iter().find(|feature| {
            let end = feature.address + feature.bytes(&self.features);
            (feature.address..end).contains(&address)
        });
        let Some(feature) = feature else {
            return Err(self
                .read(address, 4)
                .map_or(GvcpStatus::InvalidAddress, |_| GvcpStatus::WriteProtect));
        };
        if feature.access == RegisterAccess::ReadOnly {
            return Err(GvcpStatus::WriteProtect);
        }
        let offset = address - feature.address;
        let whole = match feature.kind {
            Kind::BooleanFor(_) => data.len() == 4,
            Kind::Text(bytes) => offset as usize + data.len() <= bytes as usize,
            _ => offset == 0 && data.len() == feature.bytes(&self.features) as usize,
        };
        if !whole {
            return Err(GvcpStatus::InvalidAddress);
        }
        let number = || super::gvcp::u32_at(data, 0).unwrap_or(0);
        let allowed = match &feature.kind {
            _ if feature.access == RegisterAccess::Command => true,
            Kind::Integer { min, max, step, max_in } => {
                let max = max_in.map_or(*max, |id| self.number(id).min(*max));
                (*min..=max).contains(&number()) && (number() - min).is_multiple_of(*step)
            }
            Kind::Enumeration(entries) => entries.iter().any(|(_, value)| *value == number()),
            Kind::Boolean | Kind::BooleanFor(_) => number() <= 1,
            Kind::Float { min, max, .. } => {
                let value = data.first_chunk().map(|bytes| f64::from_be_bytes(*bytes));
                value.is_some_and(|value| (*min..=*max).contains(&value))
            }
            Kind::Long | Kind::Text(_) => true,
        };
        if !allowed {
            return Err(GvcpStatus::InvalidParameter);
        }
        Ok(Write { id: feature.id, access: feature.access, address, data })
    }

    /// Carries out a validated write; a command stores nothing.
    pub fn commit(&mut self, write: Write<'_>) {
        if write.access != RegisterAccess::Command
            && let Some(memory) = self.memory(write.address, write.data.len())
        {
            memory.copy_from_slice(write.data);
        }
    }

    fn memory(&mut self, address: u32, bytes: usize) -> Option<&mut [u8]> {
        let (base, memory) = if address >= MAKERS_REGISTERS {
            (MAKERS_REGISTERS, &mut self.makers)
        } else {
            (0, &mut self.standard)
        };
        let from = (address - base) as usize;
        memory.get_mut(from..from + bytes)
    }

    fn address(&self, id: FeatureId) -> u32 {
        self.features.iter().find(|feature| feature.id == id).map_or(0, |feature| feature.address)
    }

    /// Sets the bits of a register of four or eight bytes.
    fn set_bits(&mut self, id: FeatureId, bits: u64) {
        let wide = self.features.iter().any(|feature| feature.id == id && feature.bytes(&self.features) == 8);
        if wide { self.set_long(id, bits) } else { self.set_number(id, bits as u32) }
    }

    /// Reads a four-byte register.
    pub fn number(&self, id: FeatureId) -> u32 {
        self.number_for(id, 0)
    }

    /// Reads entry `index` of a register that has one entry per enumeration value.
    pub fn number_for(&self, id: FeatureId, index: u32) -> u32 {
        let word = self.read(self.address(id) + 4 * index, 4);
        word.ok().and_then(|bytes| super::gvcp::u32_at(bytes, 0)).unwrap_or(0)
    }

    /// Reads a register that holds a double.
    pub fn float(&self, id: FeatureId) -> f64 {
        let bytes = self.read(self.address(id), 8).ok().and_then(|bytes| bytes.first_chunk());
        bytes.map_or(0.0, |bytes| f64::from_be_bytes(*bytes))
    }

    /// Sets a four-byte register.
    pub fn set_number(&mut self, id: FeatureId, value: u32) {
        self.set(id, &value.to_be_bytes());
    }

    /// Sets an eight-byte register.
    pub fn set_long(&mut self, id: FeatureId, value: u64) {
        self.set(id, &value.to_be_bytes());
    }

    /// Sets a register that holds a double.
    pub fn set_float(&mut self, id: FeatureId, value: f64) {
        self.set(id, &value.to_be_bytes());
    }

    fn set_text(&mut self, id: FeatureId, text: &str) {
        let room = self.features.iter().find(|feature| feature.id == id);
        let room = room.map_or(0, |feature| feature.bytes(&self.features) as usize - 1);
        self.set(id, &text.as_bytes()[..text.len().min(room)]);
    }

    fn set(&mut self, id: FeatureId, bytes: &[u8]) {
        if let Some(memory) = self.memory(self.address(id), bytes.len()) {
            memory.copy_from_slice(bytes);
        }
    }

    /// Returns a user set: the current values of everything that clients can change.
    pub fn snapshot(&self) -> Vec<u8> {
        self.makers.clone()
    }

    /// Restores a user set.
    pub fn restore(&mut self, set: &[u8]) {
        self.makers.copy_from_slice(set);
    }
}
