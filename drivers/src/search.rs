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
    pulse_sources_in(Path::new("/sys/class/pps"))
}

fn pulse_sources_in(class: &Path) -> Vec<FoundPulses> {
    let found = entries(class).into_iter().filter_map(|source| {
        let about = fs::read_to_string(source.join("name")).unwrap_or_default().trim().to_owned();
        Some(FoundPulses { path: Path::new("/dev").join(source.file_name()?), about })
    });
    found.collect()
}

/// Display outputs with a display.
pub fn displays() -> Vec<FoundDisplay> {
    displays_in(Path::new("/sys/class/drm"))
}

fn displays_in(class: &Path) -> Vec<FoundDisplay> {
    let found = entries(class).into_iter().filter_map(|output| {
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
    use raysweep_sim::mirror::{
        MechanicsConfig, MirrorPty, MtiController, OptotuneController, PlayzerXController,
        PlayzerXControllerConfig, Pty, SerialLink, WireFaults,
    };
    use raysweep_sim::triggerbox::TriggerBoxPty;

    use super::*;

    /// A class of the kernel's devices, as files with these contents.
    fn class(files: &[(&str, &str)]) -> tempfile::TempDir {
        let folder = tempfile::tempdir().unwrap();
        for (file, content) in files {
            let path = folder.path().join(file);
            fs::create_dir_all(path.parent().unwrap()).unwrap();
            fs::write(path, content).unwrap();
        }
        folder
    }

    #[test]
    fn displays_are_the_outputs_to_which_one_is_connected_with_the_preferred_mode_first() {
        let class = class(&[
            ("version", "drm 1.1.0 20060810\n"),
            ("card0/dev", "226:0\n"),
            ("renderD128/dev", "226:128\n"),
            ("card0-DP-1/status", "disconnected\n"),
            ("card0-DP-1/modes", ""),
            ("card1-HDMI-A-2/status", "connected\n"),
            ("card1-HDMI-A-2/modes", "1920x1080\n1280x720\n"),
            ("card0-eDP-1/status", "connected\n"),
            ("card0-VGA-1/status", "unknown\n"),
        ]);
        let found = displays_in(class.path());
        let display = |card: &str, connector: &str, modes: &[&str]| FoundDisplay {
            card: card.into(),
            connector: connector.into(),
            modes: modes.iter().map(|&mode| mode.into()).collect(),
        };
        let hdmi = display("/dev/dri/card1", "HDMI-A-2", &["1920x1080", "1280x720"]);
        assert_eq!(found, [display("/dev/dri/card0", "eDP-1", &[]), hdmi]);
        assert_eq!(displays_in(&class.path().join("none")), []);
    }

    #[test]
    fn pulse_sources_are_told_with_their_nodes_and_names() {
        let class = class(&[("pps1/name", "ktimer\n"), ("pps0/name", "serial0\n"), ("pps2/dev", "250:2\n")]);
        let pulses =
            |node: &str, about: &str| FoundPulses { path: Path::new("/dev").join(node), about: about.into() };
        let expected = [pulses("pps0", "serial0"), pulses("pps1", "ktimer"), pulses("pps2", "")];
        assert_eq!(pulse_sources_in(class.path()), expected);
        assert_eq!(pulse_sources_in(&class.path().join("none")), []);
    }

    #[test]
    fn devices_at_serial_ports_are_told_from_each_other() {
        let (usb, sound) = (SerialLink::VirtualCom, WireFaults::default());
        let playzerx = PlayzerXController::new(PlayzerXControllerConfig::default());
        let playzerx = MirrorPty::plug(playzerx, usb, sound).unwrap();
        let mti = MirrorPty::plug(MtiController::new(MechanicsConfig::default()), usb, sound).unwrap();
        let optotune =
            MirrorPty::plug(OptotuneController::new(MechanicsConfig::default()), usb, sound).unwrap();
        let trigger = TriggerBoxPty::plug(16_666_667, usb, sound).unwrap();
        let mute = Pty::plug(Box::new(|_: &[u8], _: i64, _: &mut Vec<u8>| ()), usb, sound).unwrap();
        assert!(matches!(ask(playzerx.path()), Some(Answering::PlayzerX(about)) if !about.is_empty()));
        assert!(matches!(ask(mti.path()), Some(Answering::Mti(about)) if !about.is_empty()));
        assert!(matches!(ask(optotune.path()), Some(Answering::Optotune(about)) if !about.is_empty()));
        assert!(matches!(ask(trigger.path()), Some(Answering::TriggerBox(14))));
        assert_eq!(ask(mute.path()), None);
        assert_eq!(ask(Path::new("/nonexistent")), None);
        for mirror in [&playzerx, &mti, &optotune] {
            let held = mirror.truth().held;
            assert!(held.iter().all(|held| (held.x, held.y, held.light) == (0.0, 0.0, 0)), "moved or lit");
        }
    }

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
