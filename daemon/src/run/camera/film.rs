//! Films: the settings of each frame are written while frames before it are still under way, so that no trigger
//! goes by for want of them.

use std::collections::VecDeque;

use raysweep_core::{DeviceError, FirstFrame, FrameStamp, SettingsId};
use raysweep_pipeline::{Event, Job, Label, Point, Shot};

use super::{MARGIN_FRAMES, Received, Sequencer, Taken, closed};
use crate::run::orders::Order;

/// A film to take under one picture of the projector.
#[derive(Debug, Clone)]
pub struct FilmPass {
    /// The settings of a cycle, in the order in which it takes them.
    pub settings: Vec<FilmSetting>,
    /// How many cycles.
    pub cycles: u32,
    /// Frames exposed earlier may still see the picture before.
    pub not_before_ns: i64,
}

/// One setting of a film's cycle.
#[derive(Debug, Clone, Copy)]
pub struct FilmSetting {
    /// Its point's ordinal in the schedule.
    pub ordinal: u32,
    /// What to acquire.
    pub point: Point,
    /// How to set the camera for it.
    pub shot: Shot,
    /// VSYNC periods from the frame of the setting before to this one's.
    pub periods_from_last: u32,
}

/// One frame of the film.
struct Slot {
    setting: FilmSetting,
    cycle: u32,
    first_of_cycle: bool,
}

/// Settings that the camera has been given.
struct Written {
    job: Job,
    /// VSYNC periods from the frame before to theirs.
    periods: u32,
    /// The first frame that is certain to have them; the next settings end their time.
    first_seq: u64,
}

/// What has been written and not yet been seen in a frame.
#[derive(Default)]
struct Ahead {
    written: VecDeque<Written>,
    newest_seq: Option<u64>,
    /// Fewest VSYNC periods from one frame to the next.
    frame_periods: u64,
    /// VSYNC periods after the newest frame's in which frames have their settings already when new ones are written,
    /// because they are on their way to the host or their settings on their way into the sensor: what the camera says of
    /// its first frames tells. 0 where it cannot say exactly.
    lead_periods: Option<u64>,
    /// Whether settings were written before, without a pause since.
    running: bool,
}

impl FilmPass {
    fn slots(&self) -> impl Iterator<Item = Slot> {
        (0..self.cycles).flat_map(|cycle| {
            self.settings.iter().enumerate().map(move |(place, &setting)| Slot {
                setting,
                cycle,
                first_of_cycle: place == 0,
            })
        })
    }
}

impl Ahead {
    /// Whether settings that are written now take effect after those written last, so that each have a frame.
    fn has_room(&self) -> bool {
        let Some(last) = self.written.back() else { return true };
        // By frame ids, so that frames count that were exposed once more because settings came late for them.
        let frames = last.first_seq.saturating_sub(self.newest_seq.unwrap_or(0));
        let longer_steps: u64 = self
            .written
            .iter()
            .map(|written| u64::from(written.periods).saturating_sub(self.frame_periods))
            .sum();
        frames * self.frame_periods + longer_steps <= self.lead_periods.unwrap_or(0)
    }

    fn push(&mut self, job: Job, periods: u32) {
        let (first_seq, lead_periods) = match job.applied.first_frame {
            FirstFrame::Exactly(seq) => {
                // Where the write was late, the lead looks longer than it is, and settings that are written too soon
                // would take the place of others.
                let lead = seq.saturating_sub(self.newest_seq.unwrap_or(seq) + 1) * self.frame_periods;
                (seq, self.lead_periods.map_or(lead, |known| known.min(lead)))
            }
            FirstFrame::Within(seq) => (seq, 0),
        };
        self.lead_periods = Some(lead_periods);
        self.running = true;
        self.written.push_back(Written { job, periods, first_seq });
    }

    /// The oldest settings, if the time of their frames is over by the frame `seq`, and when it was over.
    fn pop_missed(&mut self, seq: u64) -> Option<(Written, u64)> {
        let end_seq = self.written.get(1)?.first_seq;
        if end_seq > seq {
            return None;
        }
        Some((self.written.pop_front()?, end_seq))
    }

    /// The oldest settings, if `seq` is a frame of theirs.
    fn pop_seen(&mut self, seq: u64) -> Option<Written> {
        if self.written.front()?.first_seq > seq {
            return None;
        }
        self.written.pop_front()
    }
}

impl Sequencer {
    /// Takes a film. Every slot that was begun ends in a unit or a failure, in order.
    pub(super) fn film(&mut self, film: &FilmPass) -> Result<(), DeviceError> {
        self.warm_up(film.not_before_ns)?;
        let mut slots = film.slots().peekable();
        let frame_periods = film.settings.iter().map(|setting| u64::from(setting.periods_from_last)).min();
        let mut ahead = Ahead {
            newest_seq: self.newest_seq,
            frame_periods: frame_periods.unwrap_or(1),
            ..Ahead::default()
        };
        let mut watchdog = self.watchdog();
        while self.orders.go_on() {
            let is_held =
                self.orders.now() == Order::Pause && slots.peek().is_some_and(|slot| slot.first_of_cycle);
            if ahead.has_room()
                && let Some(slot) = slots.next_if(|_| !is_held)
            {
                self.write(&slot, &mut ahead)?;
                watchdog = self.watchdog();
                continue;
            }
            if ahead.written.is_empty() {
                if !is_held {
                    break;
                }
                self.idle()?;
                ahead.running = false;
                continue;
            }
            match self.receive()? {
                Some(received) => {
                    self.deliver(received, &mut ahead)?;
                    watchdog.feed();
                }
                None => watchdog.missed(self.camera.state())?,
            }
        }
        self.pass_frames(MARGIN_FRAMES, i64::MIN)
    }

    fn write(&mut self, slot: &Slot, ahead: &mut Ahead) -> Result<(), DeviceError> {
        let FilmSetting { ordinal, point, shot, periods_from_last } = slot.setting;
        let id = SettingsId { point: ordinal, attempt: slot.cycle };
        let Some(applied) = self.configure(id, &shot.settings)? else { return Ok(()) };
        self.longest_frame_us = self.longest_frame_us.max(self.frame_us(&applied.actual));
        let job = Job {
            id,
            frames: point.frames,
            applied,
            delay_us: point.delay_us,
            light_edges_later: shot.light_edges_later,
            periods_from_last: ahead.running.then_some(periods_from_last),
        };
        ahead.push(job, periods_from_last);
        Ok(())
    }

    /// Hands a frame on as that of the settings that it was exposed with; settings whose frames never came are given
    /// up before it.
    fn deliver(&mut self, received: Received, ahead: &mut Ahead) -> Result<(), DeviceError> {
        let FrameStamp { seq, .. } = received.stamp;
        while let Some((Written { job, first_seq, .. }, end_seq)) = ahead.pop_missed(seq) {
            self.input.send(Event::Begin(job)).map_err(closed)?;
            for lost_seq in first_seq.max(ahead.newest_seq.map_or(0, |newest| newest + 1))..end_seq {
                let cause = self.camera.loss_of(lost_seq);
                self.input.send(Event::Lost(lost_seq, Some(cause))).map_err(closed)?;
                self.told_seq = Some(lost_seq);
            }
            self.input.send(Event::End).map_err(closed)?;
        }
        ahead.newest_seq = Some(seq);
        match ahead.pop_seen(seq) {
            Some(Written { job, .. }) => {
                self.input.send(Event::Begin(job)).map_err(closed)?;
                if let Taken::Passed(stamp, _) = self.hand_on(received, Label::Counted)? {
                    self.exposed_until = self.end_of_exposure(&stamp, &job.applied.actual);
                }
                self.input.send(Event::End).map_err(closed)?;
            }
            // Exposed once more under settings that have their frame: the next ones came too late for it.
            None => {
                self.hand_on(received, Label::Settling)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use raysweep_core::{Applied, CameraSettings, Shutter};

    use super::*;

    fn job(first_frame: FirstFrame) -> Job {
        let actual =
            CameraSettings { shutter: Shutter::Rolling, exposure_us: 600.0, trigger_delay_us: 1000.0 };
        Job {
            id: SettingsId { point: 0, attempt: 0 },
            frames: 1,
            applied: Applied { actual, first_frame },
            delay_us: 0.0,
            light_edges_later: 0,
            periods_from_last: None,
        }
    }

    /// Plays a camera that gives settings to the frame `latency` after the next one, until `frames` frames have come;
    /// returns the first frames of all settings written.
    fn play(latency: u64, frames: u64, exact: bool) -> Vec<u64> {
        let mut ahead = Ahead { newest_seq: Some(0), frame_periods: 1, ..Ahead::default() };
        let mut first = Vec::new();
        for newest in 0..frames {
            ahead.newest_seq = Some(newest);
            ahead.pop_seen(newest);
            while ahead.has_room() {
                let seq = newest + 1 + latency;
                ahead.push(job(if exact { FirstFrame::Exactly(seq) } else { FirstFrame::Within(seq) }), 1);
                first.push(seq);
            }
        }
        first
    }

    #[test]
    fn every_frame_has_settings_of_its_own_however_late_they_take_effect() {
        for latency in 0..4 {
            let expected: Vec<u64> = (0..20).map(|frame| frame + 1 + latency).collect();
            assert_eq!(play(latency, 20, true), expected, "latency of {latency} frames");
        }
    }

    #[test]
    fn a_host_that_is_late_now_and_then_overwrites_no_settings() {
        for latency in 0..4 {
            let mut ahead = Ahead { newest_seq: Some(0), frame_periods: 1, ..Ahead::default() };
            let mut first = Vec::new();
            // Triggers that have passed unseen when a frame is looked at: the host was busy, then catches up.
            for (newest, late) in (0..).zip([0, 0, 0, 2, 1, 0, 0, 1, 0, 3, 2, 1, 0, 0, 0, 0, 1, 0, 0]) {
                ahead.newest_seq = Some(newest);
                ahead.pop_seen(newest);
                while ahead.has_room() {
                    let seq = newest + 1 + late + latency;
                    ahead.push(job(FirstFrame::Exactly(seq)), 1);
                    first.push(seq);
                }
            }
            assert!(first.is_sorted_by(|a, b| a < b), "latency of {latency} frames: {first:?}");
        }
    }

    #[test]
    fn settings_that_take_effect_some_time_wait_for_their_frame() {
        assert_eq!(play(2, 12, false), [3, 6, 9, 12]);
    }

    #[test]
    fn settings_that_never_had_a_frame_are_given_up_when_the_next_ones_have() {
        let mut ahead = Ahead { newest_seq: Some(4), ..Ahead::default() };
        ahead.push(job(FirstFrame::Exactly(5)), 1);
        ahead.push(job(FirstFrame::Exactly(7)), 1);
        assert!(ahead.pop_missed(6).is_none(), "frame 6 still has the settings of frame 5");
        let (missed, end_seq) = ahead.pop_missed(7).unwrap();
        assert_eq!((missed.first_seq, end_seq), (5, 7));
        assert!(ahead.pop_missed(9).is_none(), "nothing is known to end the last");
    }
}
