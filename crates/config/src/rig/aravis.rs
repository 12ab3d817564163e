//! `[camera.aravis]`: the camera, and settings made once before a sweep.

use raysweep_core::Readout;
use serde::Deserialize;

use super::sensor::is_gain;
use crate::document::{Fault, out_of_range};

/// `[camera.aravis]`
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct AravisConfig {
    /// IP address of a GigE Vision camera.
    pub address: Option<String>,
    /// Name of a camera as `raysweep devices` lists it, for USB3 Vision and where addresses change.
    pub name: Option<String>,
    /// Features to set first, in this order, each as `Name=Value`.
    pub features: Vec<String>,
    /// Pixels to read out; default: all.
    pub region: Option<SensorRegion>,
    /// Sensor columns and rows that form a pixel.
    pub binning: [u32; 2],
    /// Offset of the analogue-digital converter, in the camera's units; default: unchanged.
    pub black_level: Option<f64>,
    /// The trigger input, or `off` for a free-running camera.
    pub trigger_source: String,
    /// The edge that triggers.
    pub trigger_activation: String,
    /// From the trigger edge to the start of row 0's exposure, at a trigger delay of zero.
    pub trigger_latency_us: f64,
    /// Whether the next exposure may start during readout.
    pub readout: Readout,
    /// From the end of row 0's exposure until the camera is ready; default: the camera's value, or the sum of its row
    /// times.
    pub readout_us: Option<f64>,
    /// The moment that a frame's timestamp refers to.
    pub timestamp_at: TimestampAt,
    /// Minimum number of frames after a change that still have the old settings.
    pub late_frames_min: u32,
    /// Maximum number of frames after a change that still have the old settings.
    pub late_frames_max: u32,
    /// Bytes of a GigE Vision packet; default: negotiated.
    pub packet_size: Option<u32>,
    /// Bytes of the socket's receive buffer; default: two frames, at least 1 MiB.
    pub socket_buffer_bytes: Option<u32>,
}

/// A part of the sensor, in binned pixels.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SensorRegion {
    /// First column.
    #[serde(default)]
    pub x: u32,
    /// First row.
    #[serde(default)]
    pub y: u32,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
}

/// The moment that a camera's timestamps refer to; see its data sheet.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TimestampAt {
    /// Start of the exposure of row 0 [A].
    #[default]
    ExposureStart,
    /// End of the exposure of row 0, which is the start of its readout.
    ExposureEnd,
}

impl Default for AravisConfig {
    fn default() -> Self {
        Self {
            address: None,
            name: None,
            features: Vec::new(),
            region: None,
            binning: [1, 1],
            black_level: None,
            trigger_source: "Line0".into(),
            trigger_activation: "RisingEdge".into(),
            trigger_latency_us: 0.0,
            readout: Readout::Sequential,
            readout_us: None,
            timestamp_at: TimestampAt::default(),
            late_frames_min: 0,
            late_frames_max: 3,
            packet_size: None,
            socket_buffer_bytes: None,
        }
    }
}

/// The largest payload of a UDP packet, which is what a GigE Vision packet is.
const MAX_PACKET_BYTES: u32 = 65_507;
/// Packet size that every GigE Vision device must support.
const MIN_PACKET_BYTES: u32 = 576;

impl AravisConfig {
    /// The camera's address or name, whichever is given.
    pub fn device(&self) -> Option<&str> {
        match (&self.address, &self.name) {
            (Some(device), None) | (None, Some(device)) => Some(device),
            _ => None,
        }
    }

    /// Whether frames wait for a trigger.
    pub fn is_triggered(&self) -> bool {
        self.trigger_source != "off"
    }

    /// Keys and values of what the table says of where on the sensor the pixels lie and of what they count.
    pub(super) fn sensor_settings(&self) -> Vec<(String, String)> {
        let Self { region, binning: [columns, rows], black_level, features, .. } = self;
        let region = region.map(|SensorRegion { x, y, width, height }| {
            ("region".to_owned(), format!("{width} x {height} from column {x} and row {y} on"))
        });
        let binning = ("binning".to_owned(), format!("{columns} x {rows}"));
        let black_level = black_level.map(|level| ("black_level".to_owned(), level.to_string()));
        let features = features.iter().filter_map(|feature| feature.split_once('='));
        let gains = features
            .filter(|(name, _)| is_gain(name))
            .map(|(name, value)| (format!("features {}", name.trim()), value.trim().to_owned()));
        region.into_iter().chain([binning]).chain(black_level).chain(gains).collect()
    }

    /// Faults that can be found without the camera.
    pub fn faults(&self) -> Vec<Fault> {
        let packet_bytes = f64::from(MIN_PACKET_BYTES)..=f64::from(MAX_PACKET_BYTES);
        let rules = [
            ("trigger_latency_us", self.trigger_latency_us, 0.0..=1e6),
            ("readout_us", self.readout_us.unwrap_or(0.0), 0.0..=1e6),
            ("packet_size", self.packet_size.unwrap_or(MIN_PACKET_BYTES).into(), packet_bytes),
        ];
        let mut faults: Vec<Fault> = out_of_range(rules).collect();
        let mut refuse = |key, message| faults.push(Fault { key, message });
        if self.device().is_none() {
            let what = " or camera.aravis.name: give exactly one of them; `raysweep devices` lists the cameras with both";
            refuse("address", what.into());
        }
        if let Some(text) = self.features.iter().find(|text| !text.contains('=')) {
            refuse("features", format!(" contains {text:?}: write each as \"Name=Value\""));
        }
        if self.binning.contains(&0) {
            refuse("binning", format!(" = {:?}: must be at least 1", self.binning));
        }
        if self.region.is_some_and(|region| region.width == 0 || region.height == 0) {
            refuse("region", " has no pixels: width and height must be at least 1".into());
        }
        if self.late_frames_min > self.late_frames_max {
            let (min, max) = (self.late_frames_min, self.late_frames_max);
            refuse("late_frames_min", format!(" = {min}: must be at most late_frames_max = {max}"));
        }
        faults
    }
}
