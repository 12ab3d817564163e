//! The camera on the line: what triggers it, and the settings of each frame.

use std::collections::VecDeque;

use raysweep_core::{CameraSettings, SettingsId, Shutter, Subject, ns_from_us};

/// One exposure of the camera.
pub struct Exposure {
    /// The camera's frame id.
    pub seq: u64,
    /// Noise key: point, attempt, and number of frames since the settings were written.
    pub key: [u64; 3],
    /// Settings of the exposure.
    pub settings: CameraSettings,
    /// What stands before the camera.
    pub subject: Subject,
    /// Start of row 0's exposure.
    pub start_ns: i64,
    /// Start of row 0's exposure as the camera stamps it, by the trigger latency that it states.
    pub stamped_ns: i64,
    /// When the frame arrives at the host.
    pub done_ns: i64,
    /// Whether the frame arrives.
    pub delivered: bool,
}

/// What starts the camera's exposures.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum TriggeredBy {
    /// The edges of the VSYNC line.
    Edges,
    /// Calls of [`super::VsyncLine::fire`] only.
    Software,
    /// The camera's own clock, whenever it is ready but no faster than `period_ns`.
    FreeRun {
        /// Minimum time between triggers.
        period_ns: i64,
    },
}

/// State of the camera on the line.
pub(super) struct CameraLine {
    pub(super) armed: bool,
    pub(super) triggered_by: TriggeredBy,
    /// Next trigger of a free-running camera.
    pub(super) next_free_ns: i64,
    /// Triggers before this time are ignored.
    pub(super) deaf_until_ns: i64,
    /// Exposures cannot start before this time.
    pub(super) occupied_until_ns: i64,
    pub(super) in_force: WrittenSettings,
    /// Number of frames triggered under the current settings.
    pub(super) frames: u64,
    /// Settings that have not taken effect yet, in the order of their first frames.
    pub(super) written: VecDeque<WrittenSettings>,
    pub(super) sequence: Option<RunningSequence>,
    pub(super) seq: u64,
    pub(super) exposures: VecDeque<Exposure>,
}

/// Sets of the camera's sequencer: settings, and the index of the next frame's set.
pub type Sets = Vec<(CameraSettings, usize)>;

/// The camera's running sequencer.
pub(super) struct RunningSequence {
    pub(super) sets: Sets,
    /// Index of the next frame's set.
    pub(super) next: usize,
    pub(super) frames: u32,
}

/// Settings, and the first frame that uses them.
#[derive(Clone, Copy)]
pub(super) struct WrittenSettings {
    pub(super) first_seq: u64,
    pub(super) id: SettingsId,
    pub(super) settings: CameraSettings,
}

impl CameraLine {
    pub(super) fn at_rest() -> Self {
        let idle = WrittenSettings {
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

    /// Settings of the next frame to be triggered, and the number of frames that have used them.
    pub(super) fn due(&self) -> (WrittenSettings, u64) {
        let due = self.written.iter().rev().find(|written| written.first_seq <= self.seq);
        due.map_or((self.in_force, self.frames), |written| (*written, 0))
    }

    /// Key for noise and faults of the next frame.
    pub(super) fn key(&self) -> [u64; 3] {
        let (WrittenSettings { id, .. }, frames) = self.due();
        [u64::from(id.point), u64::from(id.attempt), frames]
    }

    /// Key of the newest frame.
    pub(super) fn newest_key(&self) -> [u64; 3] {
        let WrittenSettings { id, .. } = self.in_force;
        [u64::from(id.point), u64::from(id.attempt), self.frames.saturating_sub(1)]
    }

    /// If a sequence is running, moves on to the next frame's set.
    pub(super) fn take_next_set(&mut self) {
        let Some(RunningSequence { sets, next, frames }) = &mut self.sequence else { return };
        let Some(&(settings, after)) = sets.get(*next) else { return };
        let id = SettingsId { point: *next as u32, attempt: *frames };
        self.written.push_back(WrittenSettings { first_seq: self.seq, id, settings });
        (*next, *frames) = (after, *frames + 1);
    }

    /// Time of the next trigger of a free-running camera; `i64::MAX` if it is not free-running.
    pub(super) fn free_run_ns(&self) -> i64 {
        let runs = self.armed && matches!(self.triggered_by, TriggeredBy::FreeRun { .. });
        if runs { self.next_free_ns } else { i64::MAX }
    }

    /// Whether the camera would respond to an edge at `edge_ns`.
    pub(super) fn is_ready(&self, edge_ns: i64, latency_us: f64) -> bool {
        let (WrittenSettings { settings, .. }, _) = self.due();
        let start_ns = edge_ns + ns_from_us(latency_us + settings.trigger_delay_us);
        edge_ns >= self.deaf_until_ns && start_ns >= self.occupied_until_ns
    }
}
