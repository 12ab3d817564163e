//! Lost frames by cause. Gaps between frame ids show that frames are lost; other events show why.

use std::ops::Range;

use raysweep_core::LossCause;

use super::frames::MOST_BUFFERS;

/// Number of incomplete frames remembered within one gap; there are never more than the driver has buffers.
const REMEMBERED: usize = MOST_BUFFERS;

/// The causes that the driver can distinguish.
const CAUSES: [LossCause; 4] =
    [LossCause::CameraGap, LossCause::PacketsLost, LossCause::DriverFull, LossCause::CameraLost];

/// Causes of the frames lost in the newest gap, and totals of lost frames.
#[derive(Debug)]
pub struct Losses {
    /// Frames with missing packets, since the newest complete frame or in the gap before it.
    incomplete: Vec<u64>,
    /// Incomplete frames since the newest complete one whose received part lacks the id.
    nameless: usize,
    /// Frames missed while the camera was away.
    away: Range<u64>,
    /// Up to this frame there may have been no free buffer.
    full_until: Option<u64>,
    /// The gap before the newest complete frame.
    gap: Range<u64>,
    newest: Option<u64>,
    /// Lost frames for each of the [`CAUSES`]; an array, so that counting allocates no memory.
    totals: [u64; CAUSES.len()],
}

impl Losses {
    pub fn new() -> Self {
        Self {
            incomplete: Vec::with_capacity(REMEMBERED),
            nameless: 0,
            away: 0..0,
            full_until: None,
            gap: 0..0,
            newest: None,
            totals: [0; CAUSES.len()],
        }
    }

    /// Records a frame with missing packets; `None` if the packet with its id is missing.
    pub fn incomplete(&mut self, seq: Option<u64>) {
        let Some(seq) = seq else {
            self.nameless += 1;
            return;
        };
        if self.incomplete.len() == REMEMBERED {
            let end = self.gap.end;
            self.incomplete.retain(|&seq| seq >= end);
        }
        if self.incomplete.len() < REMEMBERED {
            self.incomplete.push(seq);
        }
    }

    /// Records that all buffers are full, the newest of them with this frame or an earlier one; the next frame may be
    /// lost.
    pub fn full(&mut self, seq: u64) {
        self.full_until = Some(seq);
    }

    /// Records that the camera was away for these frames.
    pub fn away(&mut self, seqs: Range<u64>) {
        self.away = seqs;
    }

    /// Records a complete frame, which ends the gap before it.
    pub fn whole(&mut self, seq: u64) {
        self.gap = self.newest.map_or(seq, |newest| newest + 1)..seq;
        self.newest = Some(seq);
        // The frames without id are in the gap; which ones does not matter.
        for lost in self.gap.clone() {
            if self.nameless == 0 {
                break;
            }
            if !self.incomplete.contains(&lost) {
                self.nameless -= 1;
                self.incomplete(Some(lost));
            }
        }
        self.nameless = 0;
        for lost in self.gap.clone() {
            let cause = self.cause(lost);
            CAUSES
                .iter()
                .zip(&mut self.totals)
                .filter(|(of, _)| **of == cause)
                .for_each(|(_, total)| *total += 1);
        }
    }

    /// Cause of the loss of a frame in the gap before the newest complete one.
    pub fn cause(&self, seq: u64) -> LossCause {
        if self.away.contains(&seq) {
            LossCause::CameraLost
        } else if self.incomplete.contains(&seq) {
            LossCause::PacketsLost
        } else if self.full_until.is_some_and(|until| self.gap.start <= until + 1) {
            LossCause::DriverFull
        } else {
            LossCause::CameraGap
        }
    }

    /// Frames lost so far, by cause.
    pub fn totals(&self) -> impl Iterator<Item = (LossCause, u64)> {
        CAUSES.into_iter().zip(self.totals).filter(|(_, frames)| *frames > 0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_lost_frame_has_one_cause() {
        let mut losses = Losses::new();
        (0..3).for_each(|seq| losses.whole(seq));
        losses.incomplete(Some(4));
        losses.whole(6);
        assert_eq!([3, 4, 5].map(|seq| losses.cause(seq)), {
            use LossCause::{CameraGap, PacketsLost};
            [CameraGap, PacketsLost, CameraGap]
        });
        losses.incomplete(None);
        losses.whole(7);
        losses.incomplete(None);
        losses.whole(9);
        assert_eq!(losses.cause(8), LossCause::PacketsLost, "between 6 and 7 there was no place for another");
        let mut losses = Losses::new();
        losses.whole(6);
        // Two buffers, filled with 7 and 8, then two frames without a buffer, later one lost by the camera.
        losses.full(8);
        [7, 8, 11].into_iter().for_each(|seq| losses.whole(seq));
        assert_eq!(losses.cause(9), LossCause::DriverFull);
        losses.whole(13);
        assert_eq!(losses.cause(12), LossCause::CameraGap, "not of the time when buffers were full");
        losses.away(14..20);
        losses.whole(21);
        assert_eq!([19, 20].map(|seq| losses.cause(seq)), [LossCause::CameraLost, LossCause::CameraGap]);
        let totals: Vec<_> = losses.totals().collect();
        assert_eq!(
            totals,
            [(LossCause::CameraGap, 2), (LossCause::DriverFull, 2), (LossCause::CameraLost, 6)]
        );
    }

    #[test]
    fn many_torn_frames_need_no_more_memory() {
        let mut losses = Losses::new();
        losses.whole(0);
        for seq in (1..10_000).step_by(2) {
            losses.incomplete(Some(seq));
            losses.whole(seq + 1);
            assert_eq!(losses.cause(seq), LossCause::PacketsLost);
        }
        assert_eq!(losses.incomplete.capacity(), REMEMBERED);
        assert!(losses.totals().eq([(LossCause::PacketsLost, 5_000)]));
    }
}
