//! The entries of a ledger.

use std::collections::BTreeMap;

use jiff::Timestamp;
use raysweep_core::{Counts, FilmSummary, SettingsLatency, VsyncStats};
use serde::{Deserialize, Serialize};

use crate::dots::BatchEntry;
use crate::film::CycleEntry;
use crate::stack::{ArrayName, StackShape};

/// The format of the session folder that this version writes.
/// From 2 on, each line has a checksum.
pub const FORMAT: u32 = 2;

/// One line of the ledger; the key `event` tells the kinds apart.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Entry {
    /// The first line, and only the first: describes the session.
    Session(SessionEntry),
    /// Files of the session that its results depend on. A later line replaces an earlier one of the same file.
    Files {
        /// SHA-256 of each, hexadecimal, by path with `/` separators.
        sha256: BTreeMap<String, String>,
    },
    /// An acquisition run begins.
    Run {
        /// Wall-clock time, UTC.
        started: Timestamp,
        /// Whether it acquires what an earlier run left missing.
        resumed: bool,
    },
    /// A point's data are durable in the stack. A later line for the same point replaces the earlier one.
    Point(PointEntry),
    /// An attempt at a point failed.
    AttemptFailed {
        /// The array of the stack.
        array: ArrayName,
        /// The point's index in that array.
        index: usize,
        /// Counted from 0.
        attempt: u32,
        /// What became of the attempt's frames.
        counts: Counts,
    },
    /// An attempt at a point was interrupted through no fault of its own; it is repeated with the same
    /// number.
    AttemptInterrupted {
        /// The array of the stack.
        array: ArrayName,
        /// The point's index in that array.
        index: usize,
        /// Counted from 0.
        attempt: u32,
        /// What became of the attempt's frames.
        counts: Counts,
    },
    /// A point is stored, but a processing stage failed on it: the results of this run lack it.
    StageFailed {
        /// The array of the stack.
        array: ArrayName,
        /// The point's index in that array.
        index: usize,
        /// Counted from 0.
        attempt: u32,
        /// The stage and its error.
        error: String,
    },
    /// A cycle of a film is durable in `film.zarr`.
    Cycle(CycleEntry),
    /// A cycle of a film lacks frames and is not stored; a film does not repeat frames.
    CycleLost {
        /// Counted from 0.
        cycle: usize,
        /// The settings without a usable frame.
        missing: Vec<usize>,
        /// What became of the cycle's frames.
        counts: Counts,
    },
    /// A batch of a flying dot is durable in `dots.zarr`.
    Batch(BatchEntry),
    /// A batch lacks too many frames or could not be written, and is not stored; it is not repeated.
    BatchLost {
        /// Counted from 0.
        batch: usize,
        /// What became of the batch's frames.
        counts: Counts,
    },
    /// The record of a mirror axis during its chirp is durable in `products`.
    Axis(AxisEntry),
    /// A film has ended; its cycles have lines of their own.
    Film(FilmSummary),
    /// Frames outside any point: drained, during a pause, or after a cancel.
    Outside {
        /// What became of these frames.
        counts: Counts,
    },
    /// An acquisition run has ended.
    End(EndEntry),
    /// Somebody's remark about the session.
    Note(Remark),
}

/// A remark about a session, made after its run began.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Remark {
    /// When it was made, UTC.
    pub at: Timestamp,
    /// Who made it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub by: Option<String>,
    /// What it says.
    pub text: String,
}

/// Description of a session.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SessionEntry {
    /// Format version, [`FORMAT`].
    pub format: u32,
    /// The name as given, before it was adapted for the folder's name.
    pub name: String,
    /// The plan's kind, for example `sweep`.
    pub kind: String,
    /// Who ran it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub operator: Option<String>,
    /// What was in front of the camera.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sample: Option<String>,
    /// Free text.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
    /// Labels for finding the session.
    #[serde(default)]
    pub tags: Vec<String>,
    /// Creation time, UTC.
    pub created: Timestamp,
    /// Name and version of the software.
    pub software: String,
    /// The arrays of the stack; `shape.points` is the number of planned points.
    pub shape: StackShape,
    /// Projector row that camera row 0 sees.
    pub first_row: usize,
}

/// A stored point.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PointEntry {
    /// The array of the stack.
    pub array: ArrayName,
    /// The point's index in that array: for `sum`, `exposure_index * delays + delay_index`; for `dark`,
    /// `exposure_index`.
    pub index: usize,
    /// Attempt, counted from 0.
    pub attempt: u32,
    /// Frames summed.
    pub frames: u32,
    /// The exposure time that the camera applied, in us.
    pub exposure_us: f64,
    /// The requested and applied delay in us (centre of exposure minus centre of illumination).
    pub delay_us: f64,
    /// The true delay of each summed frame in us, from its exposure start and its VSYNC edge; empty for dark
    /// and regular frames, for which delays are meaningless.
    pub delays_us: Vec<f64>,
    /// What became of the attempt's frames.
    pub counts: Counts,
    /// CRC-32 of the stored data, see [`crate::stack::crc32`].
    pub crc32: u32,
    /// CRC-32 of the point's counts of clipped frames in the array `clipped`; `None` if no pixel of any frame
    /// saturated, and in sessions from before they were counted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub clipped_crc32: Option<u32>,
    /// When the summed frames were exposed; `None` in sessions from before it was stored.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub exposed: Option<FrameStarts>,
}

/// When the frames of a point were exposed.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrameStarts {
    /// The session's run that took them, counted from 1: each run has its own clock.
    pub run: u32,
    /// Start of the exposure of camera row 0 in each frame, in ns on the clock of frames and edges.
    pub starts_ns: Vec<i64>,
}

impl PointEntry {
    /// The mean of the true delays, if there are any.
    pub fn mean_delay_us(&self) -> Option<f64> {
        let frames = self.delays_us.len();
        (frames > 0).then(|| self.delays_us.iter().sum::<f64>() / frames as f64)
    }
}

/// The stored record of a mirror axis.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AxisEntry {
    /// 0: x, 1: y.
    pub axis: usize,
    /// Frames of the record, which covers the axis's chirp.
    pub frames: usize,
    /// Frames of these that were lost.
    pub lost: usize,
    /// Frames of these that arrived but show no dot.
    pub empty: usize,
    /// What became of its triggers.
    pub counts: Counts,
}

/// How an acquisition run ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EndEntry {
    /// Final state.
    pub state: EndState,
    /// Why it faulted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
    /// Whether a resumed run would come to the same end.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub is_final: bool,
    /// Sweep points stored by now.
    pub stored: usize,
    /// Sweep points planned and not stored.
    pub missing: usize,
    /// Statistics of the VSYNC line during the run, if it was watched.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vsync: Option<VsyncStats>,
    /// Seconds from the end of the last frame's exposure to the transport on disk, if the run had both.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub final_s: Option<f64>,
    /// Seconds from the first frame with light to the end of the last, without the probe and the dark points.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub light_s: Option<f64>,
    /// Whether `light_s` is time of a simulated rig, which does not wait for the clock on the wall.
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub simulated_time: bool,
    /// Latency of the camera's settings, if a probe measured it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub settings_latency: Option<SettingsLatency>,
    /// Reasons why the results may be worse than they look.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub warnings: Vec<String>,
}

/// Most warnings of a run that are kept.
const MOST_WARNINGS: usize = 100;
/// Most characters of such a warning.
const MOST_CHARACTERS: usize = 1000;

impl EndEntry {
    /// The end of a run of which only its points and warnings are known. Of very many warnings the first are kept, and
    /// of very long ones the beginning.
    pub fn new(state: EndState, stored: usize, missing: usize, warnings: Vec<String>) -> Self {
        let more = warnings.len().saturating_sub(MOST_WARNINGS);
        let more = (more > 0).then(|| format!("{more} more warnings of this run are not kept"));
        Self {
            state,
            error: None,
            is_final: false,
            stored,
            missing,
            vsync: None,
            final_s: None,
            light_s: None,
            simulated_time: false,
            settings_latency: None,
            warnings: warnings.into_iter().take(MOST_WARNINGS).map(shortened).chain(more).collect(),
        }
    }
}

fn shortened(text: String) -> String {
    match text.char_indices().nth(MOST_CHARACTERS) {
        Some((end, _)) => format!("{}…", &text[..end]),
        None => text,
    }
}

/// Final state of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EndState {
    /// Everything planned is stored.
    Complete,
    /// The operator ended it.
    Cancelled,
    /// A device or the disk failed.
    Faulted,
}

impl EndState {
    /// The state in a word, as reports and messages call it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Complete => "complete",
            Self::Cancelled => "cancelled",
            Self::Faulted => "faulted",
        }
    }
}
