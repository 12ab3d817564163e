//! What cameras on Ethernet and USB need of the host.

#[cfg(not(feature = "aravis"))]
use raysweep_config::rig::aravis::AravisConfig;

use super::checkup::Checkup;
use crate::rig::SharedRig;

#[cfg(not(feature = "aravis"))]
pub(super) fn examine(_: &mut Checkup, _: &SharedRig) {}

#[cfg(not(feature = "aravis"))]
pub(super) fn examine_buffers(_: &mut Checkup, _: &AravisConfig, _: usize) {}

#[cfg(feature = "aravis")]
pub(super) use with_aravis::{examine, examine_buffers};

#[cfg(feature = "aravis")]
mod with_aravis {
    use std::fs;
    use std::net::{IpAddr, Ipv4Addr};
    use std::process::Command;

    use raysweep_config::rig::aravis::AravisConfig;
    use raysweep_config::rig::dots::DotCameraDriver;
    use raysweep_config::rig::plane::CameraDriver;
    use raysweep_core::Size;
    use raysweep_drivers::camera::aravis::{FoundCamera, SocketBuffer, discover};
    use serde::Deserialize;

    use super::{Checkup, SharedRig};

    /// Memory that the kernel lends to USB transfers, in MiB.
    const USB_MEMORY: &str = "/sys/module/usbcore/parameters/usbfs_memory_mb";
    /// The kernel's default of 16 holds few frames.
    const ENOUGH_USB_MEMORY_MB: u64 = 256;
    /// What a Gigabit interface takes without jumbo frames.
    const ETHERNET_MTU: u64 = 1500;

    pub fn examine(checkup: &mut Checkup, rig: &SharedRig) {
        let config = match rig {
            SharedRig::Plane(rig) if rig.file.camera.driver == CameraDriver::Aravis => {
                &rig.file.camera.aravis
            }
            SharedRig::Dots(rig) if rig.file.camera.driver == DotCameraDriver::Aravis => {
                &rig.file.camera.aravis
            }
            _ => return,
        };
        let Some(camera) = found(config) else {
            return checkup.warning(
                "camera search",
                "the camera of the rig file does not answer a search of the networks of this host and of its USB",
                "switch it on and connect it; `raysweep devices` lists the cameras that answer: correct camera.aravis.address or .name",
            );
        };
        let FoundCamera { name, address, protocol, .. } = &camera;
        checkup.ok("camera search", format!("{name} answers at {address} by {protocol}"));
        match address.parse() {
            Ok(address) => examine_network(checkup, config, address),
            Err(_) => examine_usb(checkup),
        }
    }

    /// The camera that a rig file means, if it answers.
    fn found(config: &AravisConfig) -> Option<FoundCamera> {
        let AravisConfig { address, name, .. } = config;
        let is_meant = |camera: &FoundCamera| match (address, name) {
            (Some(address), _) => camera.address == *address,
            (None, Some(name)) => camera.name == *name,
            (None, None) => true,
        };
        discover().into_iter().find(is_meant)
    }

    fn examine_network(checkup: &mut Checkup, config: &AravisConfig, address: IpAddr) {
        let Some((interface, mtu)) = interface_to(address) else {
            return checkup.skipped("packet size", format!("no interface leads to {address} directly"));
        };
        let wanted = config.packet_size.map(u64::from);
        match wanted {
            Some(wanted) if wanted > mtu => checkup.failure(
                "packet size",
                format!("camera.aravis.packet_size = {wanted}, but {interface} carries {mtu} bytes: every frame loses packets"),
                format!("`ip link set {interface} mtu {wanted}` as root, if the switch carries it too, or leave packet_size out: it is then negotiated"),
            ),
            Some(wanted) => checkup.ok("packet size", format!("{wanted} bytes; {interface} carries {mtu}")),
            None if mtu <= ETHERNET_MTU => checkup.warning(
                "packet size",
                format!("negotiated; {interface} carries {mtu} bytes: many small packets cost processor time"),
                format!("`ip link set {interface} mtu 9000` as root, if camera and switch carry jumbo frames"),
            ),
            None => checkup.ok("packet size", format!("negotiated; {interface} carries {mtu} bytes")),
        }
    }

    /// Whether the system allows the socket buffer that frames of this size need; a camera on USB needs none.
    pub fn examine_buffers(checkup: &mut Checkup, config: &AravisConfig, payload_bytes: usize) {
        let is_on_usb = |camera: FoundCamera| camera.address.parse::<IpAddr>().is_err();
        if config.address.is_none() && found(config).is_some_and(is_on_usb) {
            return;
        }
        let buffer = SocketBuffer::of(config, payload_bytes);
        match buffer.shortage() {
            Some((found, remedy)) => checkup.warning("network buffers", found, remedy),
            None => checkup.ok("network buffers", format!("{} are allowed", Size(buffer.wanted_bytes))),
        }
    }

    /// The interface in whose network an address lies, and the largest packet that it carries, by ip(8): sysfs shows
    /// those of another network namespace.
    fn interface_to(address: IpAddr) -> Option<(String, u64)> {
        let IpAddr::V4(address) = address else { return None };
        let output = Command::new("ip").args(["-json", "-4", "address", "show"]).output().ok()?;
        let interfaces: Vec<Interface> = serde_json::from_slice(&output.stdout).ok()?;
        let leads_there = |own: &InterfaceAddress| {
            let mask = u32::MAX.checked_shl(32 - own.prefixlen.min(32)).unwrap_or(0);
            u32::from(own.local) & mask == u32::from(address) & mask
        };
        let interface =
            interfaces.into_iter().find(|interface| interface.addr_info.iter().any(leads_there))?;
        Some((interface.ifname, interface.mtu))
    }

    #[derive(Deserialize)]
    struct Interface {
        ifname: String,
        mtu: u64,
        addr_info: Vec<InterfaceAddress>,
    }

    #[derive(Deserialize)]
    struct InterfaceAddress {
        local: Ipv4Addr,
        prefixlen: u32,
    }

    fn examine_usb(checkup: &mut Checkup) {
        const NAME: &str = "USB memory";
        let text = fs::read_to_string(USB_MEMORY).unwrap_or_default();
        let Ok(allowed_mb) = text.trim().parse::<u64>() else {
            return checkup.skipped(NAME, format!("{USB_MEMORY} cannot be read"));
        };
        let found = format!("the kernel lends {} to USB transfers", Size(allowed_mb << 20));
        // Zero stands for no limit.
        if (1..ENOUGH_USB_MEMORY_MB).contains(&allowed_mb) {
            checkup.warning(
                NAME,
                found,
                format!("`echo 1000 > {USB_MEMORY}` as root; `usbcore.usbfs_memory_mb=1000` on the kernel's command line keeps it"),
            );
        } else {
            checkup.ok(NAME, found);
        }
    }
}
