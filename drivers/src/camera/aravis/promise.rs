//! From which frame on new settings hold, told from what is certain: when they were written, when the newest frame was
//! triggered, and how soon after it the next trigger can come.

use std::collections::VecDeque;

use raysweep_core::FirstFrame;

/// How many frames after a change still have the old settings.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Latency {
    /// At least.
    pub min_frames: u32,
    /// At most.
    pub max_frames: u32,
}

/// What is known of the triggers when settings are written.
#[derive(Debug, Clone, Copy)]
pub struct Triggers {
    /// Id of the frame that the first trigger after the newest known one makes.
    pub next_seq: u64,
    /// The newest known trigger at the earliest; nothing while the camera is not armed and answers none.
    pub last_ns: Option<i64>,
    /// From one trigger to the next.
    pub period_ns: i64,
    /// By how much a trigger may come too early.
    pub margin_ns: i64,
}

/// The first frame with settings whose last register was written at `written_ns`.
///
/// It is exactly known where no trigger can have come between the newest frame and the end of the writing: whether the
/// triggers after that are answered or missed, the next frame is the first. Where triggers may have come, each may have made a frame or
/// none, before the registers were written or after.
pub fn first_frame(triggers: Triggers, written_ns: i64, latency: Latency) -> FirstFrame {
    let Triggers { next_seq, last_ns, period_ns, margin_ns } = triggers;
    let possible = last_ns.map_or(0, |last_ns| {
        let passed_ns = written_ns.saturating_sub(last_ns).saturating_add(margin_ns);
        u64::try_from(passed_ns / period_ns.max(1)).unwrap_or(0)
    });
    let earliest = next_seq + u64::from(latency.min_frames);
    let certain = next_seq + possible + u64::from(latency.max_frames);
    if possible == 0 && latency.min_frames == latency.max_frames {
        FirstFrame::Exactly(certain)
    } else {
        FirstFrame::Within { earliest, certain }
    }
}

/// Promises of the recent past: which values a frame may have been exposed with.
#[derive(Debug)]
pub struct Promises<T> {
    kept: VecDeque<(FirstFrame, T)>,
}

/// More settings than this are never on their way at once.
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

    /// The newest value, whether or not a frame has it yet.
    pub fn newest(&self) -> Option<T> {
        self.kept.back().map(|(_, value)| *value)
    }

    /// The latest frame that is named in a promise.
    pub fn latest_seq(&self) -> u64 {
        self.kept.iter().map(|(first, _)| first.certain()).max().unwrap_or(0)
    }

    /// The values that the frame `seq` may have been exposed with, newest first.
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

    #[test]
    fn settings_written_between_triggers_hold_exactly_from_the_next_frame_on() {
        let first = |written_ns, latency| first_frame(triggers(Some(0)), written_ns, latency);
        assert_eq!(first(6_000_000, NEXT), FirstFrame::Exactly(10));
        assert_eq!(first(16_100_000, NEXT), FirstFrame::Exactly(10));
        let late = Latency { min_frames: 3, max_frames: 3 };
        assert_eq!(first(6_000_000, late), FirstFrame::Exactly(13));
        let unsure = Latency { min_frames: 0, max_frames: 3 };
        assert_eq!(first(6_000_000, unsure), FirstFrame::Within { earliest: 10, certain: 13 });
    }

    #[test]
    fn a_trigger_that_may_have_come_makes_the_promise_later_and_vague() {
        let first = |written_ns| first_frame(triggers(Some(0)), written_ns, NEXT);
        let within = |certain| FirstFrame::Within { earliest: 10, certain };
        assert_eq!(first(16_200_000), within(11), "within the margin of the next trigger");
        assert_eq!(first(17_000_000), within(11));
        assert_eq!(first(33_000_000), within(12));
        assert_eq!(first(1_000_000_000), within(70), "a second without frames");
    }

    #[test]
    fn a_camera_that_is_not_armed_answers_no_trigger() {
        assert_eq!(first_frame(triggers(None), 1_000_000_000, NEXT), FirstFrame::Exactly(10));
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
