//! Faults of the network and the camera's firmware: seeded, and changeable while the camera runs.

use serde::{Deserialize, Serialize};

/// Order in which a camera accepts its trigger features.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TriggerOrder {
    /// Any order.
    #[default]
    Any,
    /// No trigger feature can be written before `TriggerSelector`.
    SelectorFirst,
    /// Source, activation and delay cannot be written while `TriggerMode` is `On`.
    ModeLast,
}

/// Faults of the camera. Fractions are of packets unless stated otherwise, 0..=1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Faults {
    /// Seed of all random faults.
    pub seed: u64,
    /// Fraction of packets lost, including resent ones.
    pub packet_loss: f64,
    /// Fraction of packets sent twice.
    pub duplication: f64,
    /// Fraction of packets overtaken by the next one.
    pub reordering: f64,
    /// Fraction of frames that are exposed and counted, but never sent.
    pub frame_loss: f64,
    /// Additional delay before a frame is sent.
    pub delay_us: u32,
    /// Whether packets are resent on request.
    pub resend: bool,
    /// Number of frames after a change that still use the old settings. Default: as in the rig file.
    pub late_frames: Option<u32>,
    /// Whether the chunk `ExposureTime` reports the exposure of the previous frame.
    pub late_chunk: bool,
    /// Order in which the trigger features can be set.
    pub trigger_order: TriggerOrder,
    /// The camera neither answers nor sends; afterwards it restarts as after a power loss.
    pub dead: bool,
}

impl Default for Faults {
    fn default() -> Self {
        Self {
            seed: 1,
            packet_loss: 0.0,
            duplication: 0.0,
            reordering: 0.0,
            frame_loss: 0.0,
            delay_us: 0,
            resend: true,
            late_frames: None,
            late_chunk: false,
            trigger_order: TriggerOrder::Any,
            dead: false,
        }
    }
}

impl Faults {
    /// Checks that fractions are fractions.
    ///
    /// # Errors
    /// Which one is not, and what is allowed.
    pub fn check(&self) -> Result<(), String> {
        let Self { packet_loss, duplication, reordering, frame_loss, .. } = *self;
        let fractions = [
            ("packet_loss", packet_loss),
            ("duplication", duplication),
            ("reordering", reordering),
            ("frame_loss", frame_loss),
        ];
        match fractions.iter().find(|(_, fraction)| !(0.0..=1.0).contains(fraction)) {
            Some((name, fraction)) => Err(format!("{name} = {fraction}: must be from 0 to 1")),
            None => Ok(()),
        }
    }
}

/// Ground truth of what the camera sent, for tests only.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WireTruth {
    /// Frames sent, whether or not their packets arrived.
    pub frames: u64,
    /// When the last packet of the newest frame was sent, on the host's clock.
    pub last_left_ns: i64,
    /// Frames withheld by [`Faults::frame_loss`].
    pub frames_lost: u64,
    /// Packets sent for the first time, including lost ones.
    pub packets: u64,
    /// Packets lost by [`Faults::packet_loss`].
    pub packets_lost: u64,
    /// Packets sent twice.
    pub packets_duplicated: u64,
    /// Packets overtaken.
    pub packets_reordered: u64,
    /// Packets resent on request.
    pub packets_resent: u64,
    /// Packets requested that were no longer stored.
    pub packets_unavailable: u64,
    /// Packets rejected by the host's network.
    pub packets_refused: u64,
    /// Accepted writes of exposure, delay or shutter.
    pub settings_written: u64,
}
