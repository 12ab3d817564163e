//! What is connected, for people, for programs, and as choices.

use std::fmt::Write as _;
use std::path::PathBuf;

use raysweep_drivers::search::{
    Answering, FoundAnalyser, FoundDisplay, FoundPort, FoundPulses, analysers, displays, pulse_sources,
    serial_ports,
};
use serde::Serialize;

/// A camera that was found.
#[derive(Debug, Clone, Serialize)]
pub(super) struct FoundEye {
    /// `genicam:NAME` or `v4l2:NODE`.
    pub value: String,
    pub about: String,
}

/// Everything that was found.
#[derive(Debug, Serialize)]
pub(super) struct ConnectedDevices {
    pub cameras: Vec<FoundEye>,
    pub serial_ports: Vec<FoundPort>,
    pub analysers: Vec<FoundAnalyser>,
    pub pulse_sources: Vec<FoundPulses>,
    pub displays: Vec<FoundDisplay>,
    /// What answers at the ports that were asked.
    pub answering: Vec<(PathBuf, Option<Answering>)>,
}

impl ConnectedDevices {
    /// Searches for everything; asks no port.
    pub fn search() -> Self {
        Self {
            cameras: genicam_cameras().into_iter().chain(kernel_cameras()).collect(),
            serial_ports: serial_ports(),
            analysers: analysers(),
            pulse_sources: pulse_sources(),
            displays: displays(),
            answering: Vec::new(),
        }
    }

    /// One line for each device.
    pub fn text(&self) -> String {
        let mut text = String::from("connected:\n");
        let mut section = |name: &str, lines: Vec<String>| {
            let shown = if lines.is_empty() { vec!["none".to_owned()] } else { lines };
            for (number, line) in shown.into_iter().enumerate() {
                let _ = writeln!(text, "  {:<16} {line}", if number == 0 { name } else { "" });
            }
        };
        section("cameras", self.cameras.iter().map(|eye| format!("{}  {}", eye.value, eye.about)).collect());
        let ports = self.serial_ports.iter();
        section(
            "serial ports",
            ports.map(|port| format!("{}  {}", port.path.display(), port.about)).collect(),
        );
        let firmware =
            |analyser: &FoundAnalyser| if analyser.has_firmware { "" } else { ", without firmware" };
        let analysers = self.analysers.iter();
        section(
            "logic analysers",
            analysers.map(|analyser| format!("{}{}", analyser.about, firmware(analyser))).collect(),
        );
        let pulses = self.pulse_sources.iter();
        section(
            "pulse sources",
            pulses.map(|source| format!("{}  {}", source.path.display(), source.about)).collect(),
        );
        let displays = self.displays.iter().map(|display| {
            format!(
                "{} {}  {}",
                display.card.display(),
                display.connector,
                display.modes.first().map_or("", |mode| mode)
            )
        });
        section("displays", displays.collect());
        text
    }
}

/// What answers at a port, for people.
pub(super) fn answer_text(answer: Option<&Answering>) -> String {
    match answer {
        Some(Answering::PlayzerX(about)) => format!("PlayzerX: {about}"),
        Some(Answering::Mti(about)) => format!("MTI controller: {about}"),
        Some(Answering::Optotune(about)) => about.clone(),
        Some(Answering::TriggerBox(version)) => format!("triggerbox, firmware {version}"),
        None => "no mirror controller and no triggerbox answers".into(),
    }
}

#[cfg(feature = "aravis")]
fn genicam_cameras() -> Vec<FoundEye> {
    let found = raysweep_drivers::camera::aravis::discover().into_iter();
    let eye = |camera: raysweep_drivers::camera::aravis::FoundCamera| FoundEye {
        value: format!("genicam:{}", camera.name),
        about: format!("{} {} at {} by {}", camera.vendor, camera.model, camera.address, camera.protocol),
    };
    found.map(eye).collect()
}

#[cfg(not(feature = "aravis"))]
fn genicam_cameras() -> Vec<FoundEye> {
    Vec::new()
}

#[cfg(feature = "v4l2")]
fn kernel_cameras() -> Vec<FoundEye> {
    let found = raysweep_drivers::camera::v4l2::nodes().into_iter();
    let eye = |node: raysweep_drivers::camera::v4l2::FoundNode| {
        let formats: Vec<String> = node.formats.iter().map(|(format, _)| format.to_string()).collect();
        FoundEye {
            value: format!("v4l2:{}", node.path.display()),
            about: format!("{}, {}", node.card, formats.join(" ")),
        }
    };
    found.map(eye).collect()
}

#[cfg(not(feature = "v4l2"))]
fn kernel_cameras() -> Vec<FoundEye> {
    Vec::new()
}
