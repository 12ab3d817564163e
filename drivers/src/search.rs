//! What is connected to this host, as far as it can be told without moving, lighting or setting anything. Cameras are
//! searched by [`crate::camera`].

use std::fs;
use std::path::{Path, PathBuf};

use nusb::MaybeFuture;
use raysweep_config::rig::dots::MirrorDriver;
use serde::Serialize;
use serialport::SerialPortType;

use crate::mirror::greet;
use crate::vsync::{fx2lafw, triggerbox};

/// A serial port.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct FoundPort {
    /// A path that stays with the device, if there is one.
    pub path: PathBuf,
    /// What the USB says of it.
    pub about: String,
}

/// What answers at a serial port.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Answering {
    /// Mirrorcle's PlayzerX, with its description.
    PlayzerX(String),
    /// A Mirrorcle MTI controller, with its description.
    Mti(String),
    /// Optotune's MR-E-2.
    Optotune(String),
    /// A triggerbox with this firmware version.
    TriggerBox(u8),
}

/// A logic analyser that can watch a VSYNC line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct FoundAnalyser {
    /// What the USB says of it.
    pub about: String,
    /// Whether it has its firmware.
    pub has_firmware: bool,
    /// Its node.
    pub path: PathBuf,
}

/// A pulse-per-second source of the kernel.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct FoundPulses {
    /// Its node.
    pub path: PathBuf,
    /// Its name.
    pub about: String,
}

/// A display output with a display.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct FoundDisplay {
    /// Its graphics card.
    pub card: PathBuf,
    /// Its connector, such as `HDMI-A-1`.
    pub connector: String,
    /// Its modes, the preferred one first.
    pub modes: Vec<String>,
}

/// The serial ports of this host, by their permanent names where they have one.
pub fn serial_ports() -> Vec<FoundPort> {
    let ports = serialport::available_ports().unwrap_or_default();
    let named = ports.into_iter().map(|port| {
        let about = match port.port_type {
            SerialPortType::UsbPort(usb) => {
                let words = [usb.manufacturer, usb.product, usb.serial_number];
                let words: Vec<String> = words.into_iter().flatten().collect();
                format!("USB {:04x}:{:04x} {}", usb.vid, usb.pid, words.join(" "))
            }
            SerialPortType::PciPort => "on the mainboard".into(),
            SerialPortType::BluetoothPort => "Bluetooth".into(),
            SerialPortType::Unknown => "a serial port".into(),
        };
        let path = permanent(Path::new("/dev/serial/by-id"), port.port_name.into());
        FoundPort { path, about: about.trim_end().to_owned() }
    });
    named.collect()
}

/// Asks what is connected to a serial port, as each kind of device would be asked, one after the other; `None` if
/// nothing that this project knows answers. Opening a port resets some boards, and a device of another kind may
/// misunderstand the questions, so its owner must agree.
pub fn ask(port: &Path) -> Option<Answering> {
    let mirror = |driver| greet(driver, port).ok().flatten();
    // The PlayzerX first: it alone might take a line of text for samples. The others refuse what they do not know.
    mirror(MirrorDriver::PlayzerX)
        .map(Answering::PlayzerX)
        .or_else(|| mirror(MirrorDriver::Mti).map(Answering::Mti))
        .or_else(|| mirror(MirrorDriver::Optotune).map(Answering::Optotune))
        .or_else(|| triggerbox::firmware(port).map(Answering::TriggerBox))
}

/// Logic analysers on the USB.
pub fn analysers() -> Vec<FoundAnalyser> {
    let Ok(devices) = nusb::list_devices().wait() else { return Vec::new() };
    let found = devices.filter_map(|device| {
        let has_firmware = fx2lafw::has_firmware(device.vendor_id(), device.product_id())?;
        let name = device.product_string().unwrap_or("logic analyser");
        let about = format!("USB {:04x}:{:04x} {name}", device.vendor_id(), device.product_id());
        let path = format!("/dev/bus/usb/{:03}/{:03}", device.busnum(), device.device_address());
        Some(FoundAnalyser { about, has_firmware, path: path.into() })
    });
    found.collect()
}

/// Pulse-per-second sources of the kernel.
pub fn pulse_sources() -> Vec<FoundPulses> {
    let found = entries(Path::new("/sys/class/pps")).into_iter().filter_map(|source| {
        let about = fs::read_to_string(source.join("name")).unwrap_or_default().trim().to_owned();
        Some(FoundPulses { path: Path::new("/dev").join(source.file_name()?), about })
    });
    found.collect()
}

/// Display outputs with a display.
pub fn displays() -> Vec<FoundDisplay> {
    let found = entries(Path::new("/sys/class/drm")).into_iter().filter_map(|output| {
        let name = output.file_name()?.to_str()?.to_owned();
        let (card, connector) = name.split_once('-')?;
        let status = fs::read_to_string(output.join("status")).ok()?;
        let modes = fs::read_to_string(output.join("modes")).unwrap_or_default();
        (status.trim() == "connected").then(|| FoundDisplay {
            card: Path::new("/dev/dri").join(card),
            connector: connector.to_owned(),
            modes: modes.lines().map(str::to_owned).collect(),
        })
    });
    found.collect()
}

/// The link in this folder that stays with a node's device, or the node itself if there is none.
pub(crate) fn permanent(links: &Path, node: PathBuf) -> PathBuf {
    let is_its = |link: &PathBuf| link.canonicalize().is_ok_and(|of| of == node);
    entries(links).into_iter().find(is_its).unwrap_or(node)
}

/// The entries of a folder in order; none if it is missing.
fn entries(folder: &Path) -> Vec<PathBuf> {
    let entries = fs::read_dir(folder).into_iter().flatten().flatten();
    let mut paths: Vec<PathBuf> = entries.map(|entry| entry.path()).collect();
    paths.sort();
    paths
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_node_is_called_by_the_link_that_stays_with_its_device_if_it_has_one() {
        let folder = tempfile::tempdir().unwrap();
        let folder = folder.path().canonicalize().unwrap();
        let [links, node] = ["by-id", "video2"].map(|name| folder.join(name));
        fs::create_dir(&links).unwrap();
        fs::write(&node, "").unwrap();
        assert_eq!(permanent(&links, node.clone()), node);
        std::os::unix::fs::symlink("../video2", links.join("usb-Eye-video-index0")).unwrap();
        assert_eq!(permanent(&links, node), links.join("usb-Eye-video-index0"));
        assert_eq!(permanent(&links, "/dev/null".into()), Path::new("/dev/null"));
    }
}
