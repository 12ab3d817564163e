//! What is connected, for people, for programs, and as choices.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use raysweep_drivers::camera::CameraFacts;
use raysweep_drivers::search::{
    Answering, FoundAnalyser, FoundDisplay, FoundPort, FoundPulses, analysers, displays, pulse_sources,
    serial_ports,
};
use serde::Serialize;

/// Most sizes of a format that people are told.
const MOST_SIZES: usize = 6;

/// A camera that was found.
#[derive(Debug, Clone, Serialize)]
pub(super) struct ConnectedCamera {
    /// `genicam:NAME` or `v4l2:NODE`.
    pub value: String,
    pub about: String,
    /// What it offers; `None` if that cannot be read.
    pub facts: Option<CameraFacts>,
}

impl ConnectedCamera {
    /// Whether an answer means this camera, by its value or by another path of its node.
    pub fn is(&self, answer: &str) -> bool {
        let node = |value: &str| Path::new(value.strip_prefix("v4l2:")?).canonicalize().ok();
        self.value == answer || node(answer).is_some_and(|of| node(&self.value) == Some(of))
    }

    /// A line for what it is, and one each for its sizes and limits.
    fn lines(&self) -> Vec<String> {
        let mut lines = vec![format!("{}  {}", self.value, self.about)];
        let Some(facts) = &self.facts else { return lines };
        // Most cameras have the same sizes in all formats.
        for same in facts.formats.chunk_by(|(_, a), (_, b)| a == b) {
            let formats: Vec<String> = same.iter().map(|(format, _)| format.to_string()).collect();
            let sizes: Vec<String> =
                same[0].1.iter().map(|(rows, columns)| format!("{columns} x {rows}")).collect();
            let shown = match sizes.len() {
                0 => "sizes not stated".into(),
                count if count > MOST_SIZES => {
                    format!("{} and {} more sizes", sizes[..MOST_SIZES].join(", "), count - MOST_SIZES)
                }
                _ => sizes.join(", "),
            };
            lines.push(format!("  {}: {shown}", formats.join(" ")));
        }
        let limits = [
            ("exposure", "us", &facts.exposure_us),
            ("trigger delay", "us", &facts.trigger_delay_us),
            ("free-running", "frames per s", &facts.rate_hz),
        ];
        let limits = limits.map(|(name, unit, range)| match range {
            Some(range) => format!("{name} {} to {} {unit}", shown(*range.start()), shown(*range.end())),
            None => format!("{name} not stated"),
        });
        lines.push(format!("  {}", limits.join(", ")));
        lines
    }
}

/// A limit with no more digits than people read.
fn shown(value: f64) -> String {
    let rounded = (value * 1e3).round() / 1e3;
    if rounded.abs() >= 1e7 { format!("{rounded:.2e}") } else { rounded.to_string() }
}

/// Everything that was found.
#[derive(Debug, Serialize)]
pub(super) struct ConnectedDevices {
    pub cameras: Vec<ConnectedCamera>,
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
        section("cameras", self.cameras.iter().flat_map(ConnectedCamera::lines).collect());
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
fn genicam_cameras() -> Vec<ConnectedCamera> {
    let found = raysweep_drivers::camera::aravis::discover().into_iter();
    let camera = |camera: raysweep_drivers::camera::aravis::FoundCamera| {
        let about =
            format!("{} {} at {} by {}", camera.vendor, camera.model, camera.address, camera.protocol);
        let (facts, about) = match raysweep_drivers::camera::aravis::facts(&camera.name) {
            Ok(facts) => (Some(facts), about),
            Err(error) => (None, format!("{about}; what it offers cannot be read: {}", error.source)),
        };
        ConnectedCamera { value: format!("genicam:{}", camera.name), about, facts }
    };
    found.map(camera).collect()
}

#[cfg(not(feature = "aravis"))]
fn genicam_cameras() -> Vec<ConnectedCamera> {
    Vec::new()
}

#[cfg(feature = "v4l2")]
fn kernel_cameras() -> Vec<ConnectedCamera> {
    let found = raysweep_drivers::camera::v4l2::nodes().into_iter();
    let camera = |node: raysweep_drivers::camera::v4l2::FoundNode| {
        let value = format!("v4l2:{}", node.path.display());
        ConnectedCamera { value, about: node.facts.model.clone(), facts: Some(node.facts) }
    };
    found.map(camera).collect()
}

#[cfg(not(feature = "v4l2"))]
fn kernel_cameras() -> Vec<ConnectedCamera> {
    Vec::new()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_is_told_with_its_formats_sizes_and_limits() {
        let formats = [("Mono8", vec![(480, 640)]), ("Mono12p", vec![(480, 640)]), ("Mono10", vec![])];
        let facts = CameraFacts {
            formats: formats.map(|(name, sizes)| (name.parse().unwrap(), sizes)).into(),
            exposure_us: Some(19.25..=3e7),
            rate_hz: Some(0.5..=163.123_456),
            ..CameraFacts::default()
        };
        let camera = ConnectedCamera {
            value: "v4l2:/dev/video0".into(),
            about: "a camera".into(),
            facts: Some(facts),
        };
        let told = [
            "v4l2:/dev/video0  a camera",
            "  Mono8 Mono12p: 640 x 480",
            "  Mono10: sizes not stated",
            "  exposure 19.25 to 3.00e7 us, trigger delay not stated, free-running 0.5 to 163.123 frames per s",
        ];
        assert_eq!(camera.lines(), told);
        let many = (1..=9).map(|side| (side, side)).collect();
        let facts = CameraFacts { formats: vec![("Mono8".parse().unwrap(), many)], ..CameraFacts::default() };
        let lines = ConnectedCamera { facts: Some(facts), ..camera }.lines();
        assert!(lines[1].ends_with("6 x 6 and 3 more sizes"), "{lines:?}");
    }
}
