//! `[camera.v4l2]` of a rig file.

use std::path::PathBuf;

use raysweep_core::Readout;
use serde::Deserialize;

use super::sensor::is_gain;
use crate::document::{Document, Fault, out_of_range};

/// How to open and set a V4L2 camera. Controls are called by their names, as `v4l2-ctl --list-ctrls` spells them.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct V4l2Config {
    /// The node. Prefer a link in `/dev/v4l/by-id`, which always refers to the same camera, to `/dev/video0`.
    pub device: PathBuf,
    /// Columns of a frame.
    pub width: u32,
    /// Rows of a frame.
    pub height: u32,
    /// Control values, written in this order: automatic functions off, gain, blanking, trigger mode.
    #[serde(default)]
    pub controls: Vec<(String, i64)>,
    /// Written after them where no trigger is wanted, by a viewfinder: trigger mode off.
    #[serde(default)]
    pub free_running: Vec<(String, i64)>,
    /// The exposure control; default: whichever of the kernel's the camera has.
    pub exposure: Option<TimeControl>,
    /// The trigger delay control, which only some makers provide; default: none.
    pub trigger_delay: Option<TimeControl>,
    /// Frame rate to request; default: the driver's.
    pub frames_per_s: Option<f64>,
    /// Number of buffers for the driver to fill.
    #[serde(default = "default_buffers")]
    pub buffers: u32,
    /// Maximum number of frames after a change that still have the old settings, including the one in progress [A].
    #[serde(default = "default_late_frames")]
    pub late_frames: u32,
    /// From the trigger edge to the start of row 0's exposure [A].
    #[serde(default)]
    pub trigger_latency_us: f64,
    /// Whether readout overlaps the next exposure.
    #[serde(default = "default_readout")]
    pub readout: Readout,
}

/// A control that contains a time.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TimeControl {
    /// Its name.
    pub control: String,
    /// Its unit; default: 100 us for the kernel's absolute exposures, the row time for other exposures, 1 us for
    /// delays.
    pub unit_us: Option<f64>,
}

impl V4l2Config {
    /// Keys and values of what the table says of what pixels count.
    pub(super) fn sensor_settings(&self) -> Vec<(String, String)> {
        let gains = self.controls.iter().filter(|(name, _)| is_gain(name));
        gains.map(|(name, value)| (format!("controls {name}"), value.to_string())).collect()
    }

    /// Checks the table of a camera whose driver is `v4l2`.
    pub(super) fn check_section(section: Option<&Self>, document: &mut Document<'_>) {
        match section {
            Some(config) => document.refuse_all(&["camera", "v4l2"], config.faults()),
            None => {
                let message =
                    "camera.driver = \"v4l2\" requires a table [camera.v4l2] with device, width and height";
                document.refuse(&["camera", "driver"], message);
            }
        }
    }

    /// The same camera without its trigger.
    #[must_use]
    pub fn free_running(&self) -> Self {
        let controls = self.controls.iter().chain(&self.free_running).cloned().collect();
        Self { controls, ..self.clone() }
    }

    /// Faults that can be found without the camera.
    pub fn faults(&self) -> Vec<Fault> {
        let unit_us = |control: &Option<TimeControl>| control.as_ref().and_then(|c| c.unit_us).unwrap_or(1.0);
        let rules = [
            ("width", f64::from(self.width), 1.0..=65_536.0),
            ("height", f64::from(self.height), 1.0..=65_536.0),
            ("exposure.unit_us", unit_us(&self.exposure), 1e-3..=1e6),
            ("trigger_delay.unit_us", unit_us(&self.trigger_delay), 1e-3..=1e6),
            ("frames_per_s", self.frames_per_s.unwrap_or(1.0), 1e-3..=1e6),
            ("buffers", f64::from(self.buffers), 2.0..=32.0),
            ("late_frames", f64::from(self.late_frames), 0.0..=100.0),
            ("trigger_latency_us", self.trigger_latency_us, 0.0..=1e6),
        ];
        let mut faults: Vec<Fault> = out_of_range(rules).collect();
        if self.device.as_os_str().as_encoded_bytes().contains(&0) {
            faults.push(Fault { key: "device", message: " contains a NUL: give a path".into() });
        }
        faults
    }
}

fn default_buffers() -> u32 {
    8
}
/// With Linux's sensor drivers, a new exposure applies at the latest to the second frame after the one in progress.
fn default_late_frames() -> u32 {
    3
}
fn default_readout() -> Readout {
    Readout::Sequential
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_camera_without_its_trigger_has_what_says_so_written_last() {
        let text = "device = \"/dev/video0\"\nwidth = 8\nheight = 8\ncontrols = [[\"trigger_mode\", 1], [\"gain\", 0]]\n\
                    free_running = [[\"trigger_mode\", 0]]\n";
        let config: V4l2Config = toml::from_str(text).unwrap();
        let written = config.free_running().controls;
        let names: Vec<(&str, i64)> = written.iter().map(|(name, value)| (name.as_str(), *value)).collect();
        assert_eq!(names, [("trigger_mode", 1), ("gain", 0), ("trigger_mode", 0)]);
        assert_eq!(config.controls.len(), 2, "runs keep their trigger");
    }
}
