//! What goes wrong on the wire and in the camera's firmware: seeded, and changeable while the camera runs.

use serde::{Deserialize, Serialize};

/// In which order a camera lets its trigger be set.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum TriggerOrder {
    /// Any.
    #[default]
    Any,
    /// Nothing about the trigger can be written before `TriggerSelector` was.
    SelectorFirst,
    /// Source, activation and delay cannot be written while `TriggerMode` is `On`.
    ModeLast,
}

/// The camera's faults. Shares are of packets unless they say otherwise, 0..=1.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Faults {
    /// Seeds everything that is random.
    pub seed: u64,
    /// Share of packets lost, resent ones too.
    pub packet_loss: f64,
    /// Share of packets sent twice.
    pub duplication: f64,
    /// Share of packets that the next one overtakes.
    pub reordering: f64,
    /// Share of frames that are exposed, counted and never sent.
    pub frame_loss: f64,
    /// How much later than it could a frame is sent.
    pub delay_us: u32,
    /// Whether packets are sent again for a client that asks.
    pub resend: bool,
    /// Frames that still have the old settings after a change; left out: what the rig file says.
    pub late_frames: Option<u32>,
    /// Whether the chunk `ExposureTime` tells the exposure of the frame before.
    pub late_chunk: bool,
    /// In which order the trigger can be set.
    pub trigger_order: TriggerOrder,
    /// Answers nothing and sends nothing; afterwards the camera starts anew, as after a loss of power.
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

/// What really left the camera, for tests alone.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WireTruth {
    /// Frames sent, whatever became of their packets.
    pub frames: u64,
    /// When the last packet of the newest of them left, on the host's clock.
    pub last_left_ns: i64,
    /// Frames kept back by [`Faults::frame_loss`].
    pub frames_lost: u64,
    /// Packets sent for the first time, those lost included.
    pub packets: u64,
    /// Packets lost by [`Faults::packet_loss`].
    pub packets_lost: u64,
    /// Packets sent twice.
    pub packets_duplicated: u64,
    /// Packets overtaken.
    pub packets_reordered: u64,
    /// Packets sent again because a client asked.
    pub packets_resent: u64,
    /// Packets asked for that were no longer kept.
    pub packets_unavailable: u64,
    /// Packets that the host's network did not take.
    pub packets_refused: u64,
    /// Writes of exposure, delay or shutter that were taken.
    pub settings_written: u64,
}
