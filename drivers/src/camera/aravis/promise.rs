//! Determines the first frame with new settings from what is certain: when they were written, when the newest frame
//! was triggered, and how soon after that the next trigger can come.

use std::collections::VecDeque;

use raysweep_core::FirstFrame;

/// Number of frames after a change that still have the old settings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Latency {
    /// Minimum number.
    pub min_frames: u32,
    /// Maximum number.
    pub max_frames: u32,
}

/// What is known about the triggers when settings are written.
#[derive(Debug, Clone, Copy)]
pub struct Triggers {
    /// Id of the frame that results from the first trigger after the newest known one.
    pub next_seq: u64,
    /// Earliest possible time of the newest known trigger; `None` while the camera is not armed and answers no
    /// triggers.
    pub last_ns: Option<i64>,
    /// From one trigger to the next.
    pub period_ns: i64,
    /// Maximum amount by which a trigger may be early.
    pub margin_ns: i64,
}

/// The first frame with settings whose last register was written at `written_ns`.
///
/// It is never known exactly while a camera is armed: each trigger since the newest known one may or may not have
/// resulted in a frame, before or after the registers were written, and a false edge may occur at any time.
pub fn first_frame(triggers: Triggers, written_ns: i64, latency: Latency) -> FirstFrame {
    let Triggers { next_seq, last_ns, period_ns, margin_ns } = triggers;
    let Some(last_ns) = last_ns else {
        // Nothing is exposed, so the settings may apply to the next frame even if they otherwise take effect late.
        return match latency.max_frames {
            0 => FirstFrame::Exactly(next_seq),
            late => FirstFrame::Within { earliest: next_seq, certain: next_seq + u64::from(late) },
        };
    };
    let passed_ns = written_ns.saturating_sub(last_ns).saturating_add(margin_ns);
    let possible = u64::try_from(passed_ns / period_ns.max(1)).unwrap_or(0);
    FirstFrame::Within {
        earliest: next_seq + u64::from(latency.min_frames),
        certain: next_seq + possible + u64::from(latency.max_frames),
    }
}

/// Recent promises: the values that a frame may have been exposed with.
#[derive(Debug)]
pub struct Promises<T> {
    kept: VecDeque<(FirstFrame, T)>,
}

/// Maximum number of pending settings.
const KEPT: usize = 16;

impl<T: Copy> Promises<T> {
    pub fn new() -> Self {
        Self { kept: VecDeque::with_capacity(KEPT) }
    }

    pub fn push(&mut self, first_frame: FirstFrame, value: T) {
        if self.kept.len() == KEPT {
            self.kept.pop_front();
        }
        self.kept.push_back((first_frame, value));
    }

    /// The newest value, even if no frame has it yet.
    pub fn newest(&self) -> Option<T> {
        self.kept.back().map(|(_, value)| *value)
    }

    /// The latest frame named in a promise.
    pub fn latest_seq(&self) -> u64 {
        self.kept.iter().map(|(first, _)| first.certain()).max().unwrap_or(0)
    }

    /// The values that frame `seq` may have been exposed with, newest first.
    pub fn possible(&self, seq: u64) -> impl Iterator<Item = T> {
        let mut decided = false;
        self.kept
            .iter()
            .rev()
            .take_while(move |(first, _)| !std::mem::replace(&mut decided, first.certain() <= seq))
            .filter(move |(first, _)| first.earliest() <= seq)
            .map(|(_, value)| *value)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NEXT: Latency = Latency { min_frames: 0, max_frames: 0 };

    fn triggers(last_ns: Option<i64>) -> Triggers {
        Triggers { next_seq: 10, last_ns, period_ns: 16_666_667, margin_ns: 500_000 }
    }

    fn within(earliest: u64, certain: u64) -> FirstFrame {
        FirstFrame::Within { earliest, certain }
    }

    #[test]
    fn a_promise_leaves_room_for_every_trigger_that_may_have_come() {
        let first = |written_ns| first_frame(triggers(Some(0)), written_ns, NEXT);
        assert_eq!(first(6_000_000), within(10, 10));
        assert_eq!(first(16_100_000), within(10, 10));
        assert_eq!(first(16_200_000), within(10, 11), "within the margin of the next trigger");
        assert_eq!(first(33_000_000), within(10, 12));
        assert_eq!(first(1_000_000_000), within(10, 70), "a second without frames");
    }

    #[test]
    fn a_promise_is_as_late_as_the_camera() {
        let first = |min_frames, max_frames| {
            first_frame(triggers(Some(0)), 6_000_000, Latency { min_frames, max_frames })
        };
        assert_eq!(first(3, 3), within(13, 13));
        assert_eq!(first(0, 3), within(10, 13));
    }

    #[test]
    fn a_camera_that_is_not_armed_answers_no_trigger() {
        let first = |latency| first_frame(triggers(None), 1_000_000_000, latency);
        assert_eq!(first(NEXT), FirstFrame::Exactly(10));
        assert_eq!(first(Latency { min_frames: 2, max_frames: 3 }), within(10, 13));
    }

    #[test]
    fn frames_have_the_settings_that_were_promised_or_may_have() {
        let mut promises = Promises::new();
        promises.push(FirstFrame::Exactly(1), 'a');
        promises.push(FirstFrame::Within { earliest: 5, certain: 10 }, 'b');
        promises.push(FirstFrame::Exactly(20), 'c');
        let possible = |seq| promises.possible(seq).collect::<String>();
        assert_eq!(possible(4), "a");
        assert_eq!(possible(5), "ba");
        assert_eq!(possible(10), "b");
        assert_eq!(possible(19), "b");
        assert_eq!(possible(20), "c");
        assert_eq!((promises.newest(), promises.latest_seq()), (Some('c'), 20));
        (21..60).for_each(|seq| promises.push(FirstFrame::Exactly(seq), 'd'));
        assert_eq!(promises.kept.len(), KEPT);
    }
}
