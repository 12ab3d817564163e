//! The accounting of frames: every trigger that was expected ends in exactly one column.

use std::collections::BTreeMap;
use std::fmt;

use serde::{Deserialize, Serialize};

/// Why a frame that a point needed did not count towards it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LossCause {
    /// The camera exposed a frame (its id says so) that never reached the host.
    CameraGap,
    /// Packets of the frame were lost on the wire, and the camera did not or could not send them again.
    PacketsLost,
    /// The camera's driver had no free buffer: the host took its frames too late.
    DriverFull,
    /// The camera had stopped answering and was being opened again.
    CameraLost,
    /// A VSYNC edge came while the camera should have been ready, and no frame followed.
    MissedTrigger,
    /// No VSYNC edge was seen where the frame's, or its light's, should have been.
    EdgeMissing,
    /// The frame was triggered by an edge that is not the projector's.
    FalseEdge,
    /// The measured delay lies further from the wanted one than the plan's `max_jitter_us`.
    Jitter,
    /// The frame's own exposure differs from the one that the point asked for.
    SettingsMismatch,
    /// No buffer of the pool was free.
    PoolEmpty,
    /// The pipeline's queue was full.
    QueueFull,
    /// The data could not be written.
    WriterError,
    /// No trailing dots enclose the frame, so that nobody knows which dot it shows.
    Unsynchronised,
    /// The frame is overexposed.
    Saturated,
    /// Its batch was longer by a frame, and another is nearer to the dot.
    Surplus,
    /// The stage that makes its column failed.
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

/// Where the triggers of a point, an attempt or a run went.
///
/// Invariant ([`Counts::balanced`]): `expected = averaged + settling + cancelled + sum(lost)`. `expected` grows with the
/// camera's frame ids and with edges that stayed unanswered, the other columns where the fate of a frame is decided.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Counts {
    /// Triggers that the camera should have answered.
    pub expected: u64,
    /// Frames summed into stored images.
    pub averaged: u64,
    /// Frames that may have been exposed under the settings before.
    pub settling: u64,
    /// Frames that nobody waited for: between passes, after a pause or a cancel, or of an attempt given up.
    pub cancelled: u64,
    /// Frames lost, by cause.
    #[serde(default)]
    pub lost: BTreeMap<LossCause, u64>,
}

impl Counts {
    /// Notes `frames` lost to `cause`; none leaves no entry.
    pub fn lose(&mut self, cause: LossCause, frames: u64) {
        if frames > 0 {
            *self.lost.entry(cause).or_default() += frames;
        }
    }

    /// Frames lost, over all causes.
    pub fn lost_total(&self) -> u64 {
        self.lost.values().sum()
    }

    /// Frames lost, by cause, in words.
    pub fn losses(&self) -> String {
        let causes: Vec<_> = self.lost.iter().map(|(cause, frames)| format!("{frames} {cause}")).collect();
        match causes.is_empty() {
            true => "none lost".into(),
            false => format!("{} lost ({})", self.lost_total(), causes.join(", ")),
        }
    }

    /// Whether every expected trigger is accounted for exactly once.
    pub fn balanced(&self) -> bool {
        self.expected == self.averaged + self.settling + self.cancelled + self.lost_total()
    }

    /// Adds another account to this one.
    pub fn add(&mut self, other: &Counts) {
        self.expected += other.expected;
        self.averaged += other.averaged;
        self.settling += other.settling;
        self.cancelled += other.cancelled;
        for (&cause, &frames) in &other.lost {
            self.lose(cause, frames);
        }
    }

    /// Turns the frames that had been averaged into frames lost to `cause`: their sum could not be kept.
    pub fn forfeit(&mut self, cause: LossCause) {
        let frames = std::mem::take(&mut self.averaged);
        self.lose(cause, frames);
    }
}

/// What the edges of a run's VSYNC line were like.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct VsyncStats {
    /// True edges seen.
    pub edges: u64,
    /// Edges that should have been and were not seen.
    pub missed: u64,
    /// Edges that are not the projector's.
    pub false_edges: u64,
    /// Mean period.
    pub period_us: f64,
    /// Standard deviation of edges from the straight line through their neighbours; 0 before enough are seen.
    pub jitter_us: f64,
    /// What 99 % of the edges deviate less than.
    #[serde(default)]
    pub jitter_p99_us: f64,
    /// Allan deviation of the line's frequency over one second, once two seconds of it were seen.
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
        counts.lose(LossCause::Jitter, 1);
        assert_eq!(counts.losses(), "4 lost (3 camera gap, 1 jitter)");
    }
}
