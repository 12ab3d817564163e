//! Converts a camera's frame ids to ids that only increase.

/// GigE Vision 1.x ids: 16 bits; 65535 is followed by 1, because 0 is not a valid id.
const SHORT_IDS: u64 = 65_535;

/// Extends 16-bit frame ids to 64 bits and continues ids that are long already (USB3 Vision, GigE Vision 2.0).
#[derive(Debug, Default)]
pub struct FrameIds {
    /// The newest frame: the camera's id and ours.
    last: Option<(u64, u64)>,
    /// Minimum id of the next frame after a restart.
    next: u64,
}

impl FrameIds {
    /// The id of the next frame if none is lost before it.
    pub fn next(&self) -> u64 {
        self.last.map_or(self.next, |(_, seq)| seq + 1)
    }

    /// The camera restarts its count; its first frame gets `seq` or, if that is taken, the id after the last.
    pub fn restart(&mut self, seq: u64) {
        self.next = self.next().max(seq);
        self.last = None;
    }

    /// The id of the frame that the camera calls `raw`; `None` for a frame that was already received.
    pub fn extend(&mut self, raw: u64) -> Option<u64> {
        let seq = match self.step_to(raw) {
            Step::First => self.next,
            Step::Same => return None,
            Step::Forward(step) => self.next() - 1 + step,
            // The camera restarted its count; how many frames were missed is unknown.
            Step::Back => self.next(),
        };
        self.last = Some((raw, seq));
        Some(seq)
    }

    /// The id of an incomplete frame, if the received part contains it; otherwise the library reports an id from long
    /// ago.
    pub fn of_part(&self, raw: u64) -> Option<u64> {
        match self.step_to(raw) {
            Step::Forward(step) => Some(self.next() - 1 + step),
            Step::First | Step::Same | Step::Back => None,
        }
    }

    fn step_to(&self, raw: u64) -> Step {
        let Some((last_raw, _)) = self.last else { return Step::First };
        let step = if raw > SHORT_IDS || last_raw > SHORT_IDS {
            raw.wrapping_sub(last_raw)
        } else {
            (raw + SHORT_IDS - last_raw) % SHORT_IDS
        };
        match step {
            0 => Step::Same,
            // No host sleeps through half of all ids.
            step if step > SHORT_IDS / 2 => Step::Back,
            step => Step::Forward(step),
        }
    }
}

/// Distance from the newest frame to another.
enum Step {
    First,
    Same,
    Forward(u64),
    Back,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn short_ids_wrap_past_zero_and_gaps_stay_gaps() {
        let mut ids = FrameIds::default();
        ids.restart(1);
        // Three wraps of a 16-bit counter that skips 0; every seventh frame is lost.
        let mut raw = 0_u16;
        for seq in 1..=3 * 65_535 {
            raw = raw.checked_add(1).unwrap_or(1);
            if seq % 7 != 0 {
                assert_eq!(ids.extend(raw.into()), Some(seq));
            }
        }
        assert_eq!((ids.next(), raw), (3 * 65_535 + 1, 65_535));
        assert_eq!(ids.extend(65_535), None, "the same frame again");
    }

    #[test]
    fn long_ids_go_on_past_65535() {
        let mut ids = FrameIds::default();
        for raw in 65_530..70_000 {
            assert_eq!(ids.extend(raw), Some(raw - 65_530));
        }
        let mut from_zero = FrameIds::default();
        assert_eq!(
            [from_zero.extend(0), from_zero.extend(1), from_zero.extend(4)],
            [Some(0), Some(1), Some(4)]
        );
    }

    #[test]
    fn a_part_of_a_frame_moves_nothing() {
        let mut ids = FrameIds::default();
        ids.restart(1);
        assert_eq!(ids.of_part(1), None, "nothing to count from yet");
        assert_eq!(ids.extend(100), Some(1));
        assert_eq!([103, 100, 68, 0].map(|raw| ids.of_part(raw)), [Some(4), None, None, None]);
        assert_eq!(ids.extend(102), Some(3));
    }

    #[test]
    fn a_camera_that_counts_anew_goes_on_where_it_was() {
        let mut ids = FrameIds::default();
        ids.restart(1);
        assert_eq!((1..=500).map(|raw| ids.extend(raw)).last(), Some(Some(500)));
        assert_eq!(ids.extend(1), Some(501), "without a word");
        ids.restart(100);
        assert_eq!(ids.extend(1), Some(502), "no id twice");
        ids.restart(900);
        assert_eq!([ids.extend(3), ids.extend(4)], [Some(900), Some(901)]);
    }
}
