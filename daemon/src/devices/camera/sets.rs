//! Films by the camera's own sequencer: the camera goes through the cycle's settings by itself, so that no frame
//! depends on a write between two triggers.
//!
//! Each exposed frame has the set after that of the previous frame, whether it arrives or not. So a single number,
//! the phase, maps every frame id to its set. If frames report their set, two consecutive frames that report the same
//! phase are trusted. Otherwise, or if timestamps contradict the report, the phase is the only one that agrees with
//! the timestamps of a whole cycle of frames. The assembler checks each frame's delay against its edge in any case.

use std::iter::Peekable;

use raysweep_core::{Applied, CameraSettings, DeviceError, FirstFrame, FrameStamp, LossCause, us_from_ns};
use raysweep_pipeline::{DeviceEvent, EXPOSURE_TOLERANCE_US, Job, Label, PointRole};

use super::sequence::{FilmPass, SequenceSlot};
use super::{Acquisition, POLL, Taken, TriggerLine, Watchdog, closed};
use crate::run::orders::Order;

/// Frames further apart than this are not compared: the line's period is not known precisely enough. [A]
const COMPARED_NS: i64 = 1_000_000_000;
/// Number of cycles in which the phase must be found; otherwise the camera does not follow its sequence.
const PATIENCE_CYCLES: usize = 8;

impl Acquisition {
    /// Takes slots of a film with the camera's own sequencer, as far as that is usable.
    pub(super) fn take_by_sets(
        &mut self,
        film: &FilmPass,
        slots: &mut Peekable<impl Iterator<Item = SequenceSlot>>,
    ) -> Result<(), DeviceError> {
        let settings: Vec<CameraSettings> =
            film.settings.iter().map(|setting| setting.shot.settings).collect();
        if !(self.line.distinct && self.line.has_one_exposure) {
            return Ok(());
        }
        while slots.peek().is_some() && self.orders.go_on() {
            let Some(sets) = self.when_there(|camera| camera.sequence(&settings))?.flatten() else {
                return Ok(());
            };
            tracing::info!(sets = sets.len(), "the film is taken by the camera's own sequencer");
            let longest_us = sets.iter().map(|settings| self.frame_us(settings)).fold(0.0, f64::max);
            self.longest_frame_us = self.longest_frame_us.max(longest_us);
            let taken = self.take_frames(slots, Phase::new(sets, self.line));
            // The timestamps of its frames were interpreted under the settings written before.
            self.ahead.lose_track();
            let is_followed = taken?;
            // Stops the sequencer.
            self.pass_through(&settings[0])?;
            if !is_followed {
                tracing::warn!(
                    "frames do not show the settings of the camera's sequencer one after the other: settings are written instead"
                );
                return Ok(());
            }
            if slots.peek().is_some() && self.orders.go_on() {
                self.input.send(DeviceEvent::Idle).map_err(closed)?;
                self.orders.wait_while_paused();
                self.told_seq = None;
            }
        }
        Ok(())
    }

    /// Takes frames until every slot has its own, or a pause falls between two cycles; `false`: the camera does not
    /// go through its sets.
    fn take_frames(
        &mut self,
        slots: &mut Peekable<impl Iterator<Item = SequenceSlot>>,
        mut phase: Phase,
    ) -> Result<bool, DeviceError> {
        let mut watchdog = Watchdog::default();
        let mut next_seq = None;
        let mut slot_before: Option<u64> = None;
        while let Some(slot) = slots.peek() {
            if !self.orders.go_on() || slot.may_hold && self.orders.now() == Order::Pause {
                break;
            }
            let Some(received) = self.receive(POLL)? else {
                watchdog.missed(POLL, self.longest_frame_us, self.camera.state())?;
                continue;
            };
            watchdog.feed();
            let stamp = received.stamp;
            for lost_seq in next_seq.unwrap_or(stamp.seq)..stamp.seq {
                let cause = self.camera.loss_of(lost_seq);
                if let Some(slot) = slots.next_if(|slot| phase.set_of(lost_seq) == Some(slot.place)) {
                    let job = phase.job(&slot, lost_seq, slot_before.replace(lost_seq));
                    self.input.send(DeviceEvent::Begin(job)).map_err(closed)?;
                    self.input.send(DeviceEvent::Lost(lost_seq, Some(cause))).map_err(closed)?;
                    self.input.send(DeviceEvent::End).map_err(closed)?;
                    self.told_seq = Some(lost_seq);
                }
                if cause == LossCause::CameraLost {
                    // Its ids were made up, and its sequencer has restarted.
                    phase.forget();
                    break;
                }
            }
            next_seq = Some(stamp.seq + 1);
            phase.see(&stamp, self.camera.active_set());
            if phase.is_hopeless() {
                self.hand_on(received, Label::Settling)?;
                return Ok(false);
            }
            let Some(slot) = slots.next_if(|slot| phase.set_of(stamp.seq) == Some(slot.place)) else {
                self.hand_on(received, Label::Settling)?;
                continue;
            };
            let job = phase.job(&slot, stamp.seq, slot_before.replace(stamp.seq));
            self.input.send(DeviceEvent::Begin(job)).map_err(closed)?;
            let taken = self.hand_on(received, Label::Counted)?;
            self.input.send(DeviceEvent::End).map_err(closed)?;
            if let Taken::Passed = taken {
                let is_lit = !matches!(slot.attempt.point.role, PointRole::Dark(_));
                self.note_exposure(&stamp, &job.applied.actual, is_lit);
            }
        }
        Ok(true)
    }
}

/// Maps frames to sets.
struct Phase {
    /// The settings of the sets, as the camera applied them.
    sets: Vec<CameraSettings>,
    line: TriggerLine,
    /// Index of the set of frame 0, even if that frame was not in the sequence.
    known: Option<usize>,
    /// For each phase, the number of consecutive frames that agreed with it, each relative to the frame before.
    agreeing: Vec<usize>,
    newest: Option<FrameStamp>,
    /// Whether timestamps distinguish each phase from all others.
    stamps_tell: bool,
    /// The phase that the newest frame reported.
    said: Option<usize>,
    /// Whether timestamps have not yet contradicted the reports.
    is_word_true: bool,
    /// Frames examined without result.
    in_vain: usize,
}

impl Phase {
    fn new(sets: Vec<CameraSettings>, line: TriggerLine) -> Self {
        Self {
            known: None,
            agreeing: vec![0; sets.len()],
            newest: None,
            stamps_tell: Self::differ(&sets, &line),
            said: None,
            is_word_true: true,
            in_vain: 0,
            sets,
            line,
        }
    }

    /// Whether the timestamps of a cycle of frames distinguish all phases.
    fn differ(sets: &[CameraSettings], line: &TriggerLine) -> bool {
        let delay_us = |place: usize| sets[place % sets.len()].trigger_delay_us;
        let step_us = |place: usize| delay_us(place + 1) - delay_us(place);
        // Edges may be off by the permitted jitter, and frames are compared with the same tolerance.
        let differs = |shift: usize| {
            (0..sets.len())
                .any(|place| line.off_us(step_us(place + shift) - step_us(place)) > 2.0 * line.max_jitter_us)
        };
        (1..sets.len()).all(differs)
    }

    fn set_of(&self, seq: u64) -> Option<usize> {
        self.known.map(|phase| self.set_by(phase, seq))
    }

    fn set_by(&self, phase: usize, seq: u64) -> usize {
        let sets = self.sets.len();
        ((seq % sets as u64) as usize + phase) % sets
    }

    /// The phase in which frame `seq` has this set, if the set exists.
    fn phase_by(&self, set: usize, seq: u64) -> Option<usize> {
        let sets = self.sets.len();
        (set < sets).then(|| (sets + set - (seq % sets as u64) as usize) % sets)
    }

    /// Discards all observations.
    fn forget(&mut self) {
        *self = Self::new(std::mem::take(&mut self.sets), self.line);
    }

    /// Processes a frame and the set that it reports.
    fn see(&mut self, stamp: &FrameStamp, said: Option<usize>) {
        let before = self.newest.replace(*stamp);
        let before = before.filter(|before| stamp.exposure_start_ns - before.exposure_start_ns < COMPARED_NS);
        for phase in 0..self.sets.len() {
            let agrees = before.is_some_and(|before| self.agrees(phase, &before, stamp));
            self.agreeing[phase] = if agrees { self.agreeing[phase] + 1 } else { 0 };
        }
        let mut certain = (0..self.sets.len()).filter(|&phase| self.agreeing[phase] >= self.sets.len());
        let by_stamps = certain.next().filter(|_| certain.next().is_none());
        let mut said = said.filter(|_| self.is_word_true).and_then(|set| self.phase_by(set, stamp.seq));
        if let (Some(phase), Some(by_stamps)) = (said, by_stamps)
            && phase != by_stamps
        {
            tracing::warn!(
                "frames say another set of the camera's sequencer than their times show: their times are believed"
            );
            (self.is_word_true, said) = (false, None);
        }
        // A report counts only if the previous frame agreed: the sequence may stutter, or the frame may predate it.
        let by_word = said.filter(|_| self.said == said);
        self.said = said;
        self.known = by_word.or(by_stamps).or(self.known.filter(|_| said.is_none()));
        self.in_vain = if self.known.is_some() { 0 } else { self.in_vain + 1 };
    }

    fn is_hopeless(&self) -> bool {
        let can_tell = self.stamps_tell || self.said.is_some();
        self.in_vain > if can_tell { PATIENCE_CYCLES * self.sets.len() } else { 0 }
    }

    /// Whether, assuming this phase, two frames were triggered whole periods apart and have the exposures that they
    /// report.
    fn agrees(&self, phase: usize, before: &FrameStamp, stamp: &FrameStamp) -> bool {
        let [first, second] = [before, stamp].map(|stamp| self.sets[self.set_by(phase, stamp.seq)]);
        let exposure_us = stamp.exposure_us.unwrap_or(second.exposure_us);
        let starts_us = us_from_ns(stamp.exposure_start_ns - before.exposure_start_ns);
        let triggers_us = starts_us - (second.trigger_delay_us - first.trigger_delay_us);
        self.line.off_us(triggers_us) <= self.line.max_jitter_us
            && (exposure_us - second.exposure_us).abs() <= EXPOSURE_TOLERANCE_US
    }

    /// The assembler's job for frame `seq`, which has a slot's set; `before` is the frame of the previous slot.
    fn job(&self, slot: &SequenceSlot, seq: u64, before: Option<u64>) -> Job {
        let runs_on = before.is_some_and(|before| before + 1 == seq);
        Job {
            id: slot.attempt.id,
            frames: slot.attempt.point.frames,
            applied: Applied { actual: self.sets[slot.place], first_frame: FirstFrame::Exactly(seq) },
            delay_us: slot.attempt.point.delay_us,
            light_edges_later: slot.attempt.shot.light_edges_later,
            periods_from_last: slot.periods_from_last.filter(|_| runs_on),
        }
    }
}
