//! The accounting of frames: every expected trigger is counted in exactly one column.

use std::collections::BTreeMap;
use std::fmt;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Why a frame that a point needed was not used.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum LossCause {
    /// The camera exposed a frame (its id says so) that never reached the host.
    CameraGap,
    /// Packets of the frame were lost on the wire, and the camera did not or could not send them again.
    PacketsLost,
    /// The camera's driver had no free buffer: the host fetched frames too late.
    DriverFull,
    /// The camera had stopped answering and was being reopened.
    CameraLost,
    /// A VSYNC edge came while the camera should have been ready, and no frame followed.
    MissedTrigger,
    /// No VSYNC edge was seen where that of the frame, or that of its light, should have been.
    EdgeMissing,
    /// The frame was triggered by an edge that did not come from the projector.
    FalseEdge,
    /// The measured delay differs from the wanted one by more than the plan's `max_jitter_us`.
    Jitter,
    /// The exposure that the frame reports differs from the one that the point asked for.
    SettingsMismatch,
    /// The pool had no free buffer.
    PoolEmpty,
    /// The pipeline's queue was full.
    QueueFull,
    /// The data could not be written.
    WriterError,
    /// No trailing dots enclose the frame, so its dot is unknown.
    Unsynchronised,
    /// The frame is overexposed.
    Saturated,
    /// Its batch had a frame too many, and another frame is nearer to the dot.
    Surplus,
    /// The stage that computes its column failed.
    StageFailed,
}

impl fmt::Display for LossCause {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::CameraGap => "camera gap",
            Self::PacketsLost => "packets lost",
            Self::DriverFull => "driver full",
            Self::CameraLost => "camera lost",
            Self::MissedTrigger => "missed trigger",
            Self::EdgeMissing => "edge missing",
            Self::FalseEdge => "false edge",
            Self::Jitter => "jitter",
            Self::SettingsMismatch => "settings mismatch",
            Self::PoolEmpty => "pool empty",
            Self::QueueFull => "queue full",
            Self::WriterError => "writer error",
            Self::Unsynchronised => "unsynchronised",
            Self::Saturated => "saturated",
            Self::Surplus => "surplus",
            Self::StageFailed => "stage failed",
        })
    }
}

/// How far a point is that is being taken.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct PointUnderWay {
    /// Frames averaged so far.
    pub frames: u32,
    /// Frames that it needs.
    pub of: u32,
}

impl PointUnderWay {
    /// The share of its frames that it has, 0 to 1.
    pub fn share(self) -> f64 {
        f64::from(self.frames.min(self.of)) / f64::from(self.of.max(1))
    }
}

/// What became of the triggers of a point, an attempt or a run.
///
/// Invariant ([`Counts::balanced`]): `expected = averaged + settling + cancelled + sum(lost)`. `expected` grows with
/// the camera's frame ids and with unanswered edges. The other columns grow where the fate of a frame is decided.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct Counts {
    /// Triggers that the camera should have answered.
    pub expected: u64,
    /// Frames summed into stored images.
    pub averaged: u64,
    /// Frames that may have been exposed with the previous settings.
    pub settling: u64,
    /// Frames that were not needed: between passes, after a pause or cancellation, or of an abandoned attempt.
    pub cancelled: u64,
    /// Frames lost, by cause.
    #[serde(default)]
    pub lost: BTreeMap<LossCause, u64>,
}

impl Counts {
    /// Counts `frames` as lost to `cause`; zero frames add no entry.
    pub fn lose(&mut self, cause: LossCause, frames: u64) {
        if frames > 0 {
            let lost = self.lost.entry(cause).or_default();
            *lost = lost.saturating_add(frames);
        }
    }

    /// Total number of lost frames.
    pub fn lost_total(&self) -> u64 {
        self.lost.values().fold(0, |sum, frames| sum.saturating_add(*frames))
    }

    /// The lost frames by cause, as text.
    pub fn losses(&self) -> String {
        let causes: Vec<_> = self.lost.iter().map(|(cause, frames)| format!("{frames} {cause}")).collect();
        match self.lost.first_key_value() {
            None => "none lost".into(),
            Some((cause, frames)) if causes.len() == 1 => format!("{frames} lost ({cause})"),
            Some(_) => format!("{} lost ({})", self.lost_total(), causes.join(", ")),
        }
    }

    /// Whether every expected trigger is accounted for exactly once.
    pub fn balanced(&self) -> bool {
        let parts = [self.averaged, self.settling, self.cancelled, self.lost_total()];
        parts.into_iter().try_fold(0_u64, u64::checked_add) == Some(self.expected)
    }

    /// Adds the counts of `other`.
    pub fn add(&mut self, other: &Counts) {
        self.expected = self.expected.saturating_add(other.expected);
        self.averaged = self.averaged.saturating_add(other.averaged);
        self.settling = self.settling.saturating_add(other.settling);
        self.cancelled = self.cancelled.saturating_add(other.cancelled);
        for (&cause, &frames) in &other.lost {
            self.lose(cause, frames);
        }
    }

    /// Counts all averaged frames as lost to `cause`: their sum could not be stored.
    pub fn forfeit(&mut self, cause: LossCause) {
        let frames = std::mem::take(&mut self.averaged);
        self.lose(cause, frames);
    }
}

/// Statistics of the edges on a run's VSYNC line.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct VsyncStats {
    /// Genuine edges seen.
    pub edges: u64,
    /// Edges that should have come but were not seen.
    pub missed: u64,
    /// Edges that did not come from the projector.
    pub false_edges: u64,
    /// Mean period.
    pub period_us: f64,
    /// Standard deviation of edges from the straight line through their neighbours; 0 until enough edges are seen.
    pub jitter_us: f64,
    /// 99th percentile of the edges' deviation.
    #[serde(default)]
    pub jitter_p99_us: f64,
    /// Allan deviation of the line's frequency over one second; `None` until two seconds of the line have been seen.
    #[serde(default)]
    pub allan_1s: Option<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn losses_are_told_by_cause() {
        let mut counts = Counts::default();
        assert_eq!(counts.losses(), "none lost");
        counts.lose(LossCause::CameraGap, 3);
        assert_eq!(counts.losses(), "3 lost (camera gap)");
        counts.lose(LossCause::Jitter, 1);
        assert_eq!(counts.losses(), "4 lost (3 camera gap, 1 jitter)");
    }
}
