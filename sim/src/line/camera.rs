//! The camera at the end of the line: what triggers it, and under which settings each frame is exposed.

use std::collections::VecDeque;

use raysweep_core::{CameraSettings, SettingsId, Shutter, ns_from_us};

/// One exposure of the camera.
pub struct Exposure {
    /// The camera's frame id.
    pub seq: u64,
    /// Point, attempt, and frames since the settings were written: what noise is keyed by.
    pub key: [u64; 3],
    /// Settings in force.
    pub settings: CameraSettings,
    /// Start of row 0's exposure.
    pub start_ns: i64,
    /// When the frame is on the host.
    pub done_ns: i64,
    /// Whether it gets there.
    pub delivered: bool,
}

/// What starts the camera's exposures.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TriggeredBy {
    /// The edges of the VSYNC line.
    Edges,
    /// [`super::Line::fire`] alone.
    Software,
    /// The camera's own clock, as often as it is ready and no faster than this.
    FreeRun {
        /// From one exposure's trigger to the next one's.
        period_ns: i64,
    },
}

/// The camera at the line's end.
pub(super) struct CameraLine {
    pub(super) armed: bool,
    pub(super) triggered_by: TriggeredBy,
    /// When a free-running camera triggers itself next.
    pub(super) next_free_ns: i64,
    /// Triggers before this are not heard.
    pub(super) deaf_until_ns: i64,
    /// No exposure may start before this.
    pub(super) occupied_until_ns: i64,
    pub(super) in_force: Written,
    /// Triggers answered under the settings in force.
    pub(super) frames: u64,
    /// Settings on their way into the sensor, in the order of their first frames.
    pub(super) written: VecDeque<Written>,
    pub(super) sequence: Option<Sequence>,
    pub(super) seq: u64,
    pub(super) exposures: VecDeque<Exposure>,
}

/// Settings of the camera's own sequencer, each with the number of those that the frame after has.
pub type Sets = Vec<(CameraSettings, usize)>;

/// The camera's own sequencer while it runs.
pub(super) struct Sequence {
    pub(super) sets: Sets,
    /// Which one the next frame has.
    pub(super) next: usize,
    pub(super) frames: u32,
}

/// Settings, and the first frame that has them.
#[derive(Clone, Copy)]
pub(super) struct Written {
    pub(super) first_seq: u64,
    pub(super) id: SettingsId,
    pub(super) settings: CameraSettings,
}

impl CameraLine {
    pub(super) fn at_rest() -> Self {
        let idle = Written {
            first_seq: 0,
            id: SettingsId { point: u32::MAX, attempt: u32::MAX },
            settings: CameraSettings { shutter: Shutter::Rolling, exposure_us: 100.0, trigger_delay_us: 0.0 },
        };
        Self {
            armed: false,
            triggered_by: TriggeredBy::Edges,
            next_free_ns: 0,
            deaf_until_ns: 0,
            occupied_until_ns: 0,
            in_force: idle,
            frames: 0,
            written: VecDeque::new(),
            sequence: None,
            seq: 0,
            exposures: VecDeque::new(),
        }
    }

    /// The settings of the next frame to be triggered, and how many frames have had them.
    pub(super) fn due(&self) -> (Written, u64) {
        let due = self.written.iter().rev().find(|written| written.first_seq <= self.seq);
        due.map_or((self.in_force, self.frames), |written| (*written, 0))
    }

    /// What noise and faults of the next frame are keyed by.
    pub(super) fn key(&self) -> [u64; 3] {
        let (Written { id, .. }, frames) = self.due();
        [u64::from(id.point), u64::from(id.attempt), frames]
    }

    /// The key of the newest frame.
    pub(super) fn newest_key(&self) -> [u64; 3] {
        let Written { id, .. } = self.in_force;
        [u64::from(id.point), u64::from(id.attempt), self.frames.saturating_sub(1)]
    }

    /// Where the sequencer runs, the next frame has its next set.
    pub(super) fn take_next_set(&mut self) {
        let Some(Sequence { sets, next, frames }) = &mut self.sequence else { return };
        let Some(&(settings, after)) = sets.get(*next) else { return };
        let id = SettingsId { point: *next as u32, attempt: *frames };
        self.written.push_back(Written { first_seq: self.seq, id, settings });
        (*next, *frames) = (after, *frames + 1);
    }

    /// When the camera triggers itself, where it does.
    pub(super) fn free_run_ns(&self) -> i64 {
        let runs = self.armed && matches!(self.triggered_by, TriggeredBy::FreeRun { .. });
        if runs { self.next_free_ns } else { i64::MAX }
    }

    /// Whether an edge at `edge_ns` would be answered.
    pub(super) fn is_ready(&self, edge_ns: i64, latency_us: f64) -> bool {
        let (Written { settings, .. }, _) = self.due();
        let start_ns = edge_ns + ns_from_us(latency_us + settings.trigger_delay_us);
        edge_ns >= self.deaf_until_ns && start_ns >= self.occupied_until_ns
    }
}
