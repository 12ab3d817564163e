//! Sweeps and films: one point after another while frames keep coming. The settings of each point are written while
//! frames of earlier points are still in transit, so that no trigger is wasted.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use raysweep_core::{Applied, Camera, CameraSettings, DeviceError, DeviceState, LossCause, SettingsId};
use raysweep_pipeline::{DeviceEvent, Job, Label, Point, PointRole, Shot};

use super::ahead::WantedFrames;
use super::{Acquisition, Attempt, MARGIN_FRAMES, POLL, Pass, Received, Taken, Watchdog, closed};
use crate::rig::Pace;
use crate::run::orders::Order;

/// Lead-in settings differ from the following ones by this much delay: more than any jitter. [A]
const LEAD_IN_US: f64 = 2_000.0;
/// Interval at which to check whether the last frames are decided.
const SETTLE_POLL: Duration = Duration::from_millis(2);

/// Failures and interruptions beyond this number earn a point no more spare frames: by then it has three times its
/// own.
const MOST_SPARED_FOR: u32 = 8;

/// A film to take with one image on the projector.
#[derive(Debug, Clone)]
pub struct FilmPass {
    /// The settings of a cycle, in order.
    pub settings: Vec<FilmSetting>,
    /// Number of cycles.
    pub cycles: u32,
    /// Frames exposed earlier may still show the previous image.
    pub not_before_ns: i64,
}

/// One setting of a film's cycle.
#[derive(Debug, Clone, Copy)]
pub struct FilmSetting {
    /// Ordinal of its point in the schedule.
    pub ordinal: u32,
    /// What to acquire.
    pub point: Point,
    /// Camera settings for it.
    pub shot: Shot,
    /// VSYNC periods from the previous setting's frame to this one.
    pub periods_from_last: u32,
}

/// A position in the sequence.
pub(super) struct SequenceSlot {
    pub attempt: Attempt,
    pub periods_from_last: Option<u32>,
    /// Position in a film's cycle.
    pub place: usize,
    /// Whether the run may pause before it.
    pub may_hold: bool,
}

impl FilmPass {
    fn slots(&self) -> impl Iterator<Item = SequenceSlot> {
        (0..self.cycles).flat_map(|cycle| {
            self.settings.iter().enumerate().map(move |(place, setting)| {
                let FilmSetting { ordinal, point, shot, periods_from_last } = *setting;
                let id = SettingsId { point: ordinal, attempt: cycle };
                SequenceSlot {
                    attempt: Attempt { id, point, shot, interruptions: 0 },
                    periods_from_last: Some(periods_from_last),
                    place,
                    may_hold: place == 0,
                }
            })
        })
    }
}

impl Acquisition {
    /// Takes points in order. Each ends in a unit or a failure, at the latest once the camera has settled.
    pub(super) fn sweep(&mut self, pass: Pass) -> Result<(), DeviceError> {
        self.warm_up(pass.not_before_ns)?;
        let slot = |attempt| SequenceSlot { attempt, periods_from_last: None, place: 0, may_hold: true };
        self.sequence(pass.attempts.into_iter().map(slot))
    }

    /// Takes a film: a repeated sweep with one frame per point. What the camera's sequencer cannot do is written
    /// ahead.
    pub(super) fn film(&mut self, film: &FilmPass) -> Result<(), DeviceError> {
        self.warm_up(film.not_before_ns)?;
        let mut slots = film.slots().peekable();
        self.take_by_sets(film, &mut slots)?;
        self.sequence(slots)?;
        self.settle()
    }

    fn sequence(&mut self, slots: impl Iterator<Item = SequenceSlot>) -> Result<(), DeviceError> {
        let mut slots = slots.peekable();
        let mut watchdog = Watchdog::default();
        // Start with settings that belong to no point, so that a point's frames do not depend on what came before.
        let mut is_led_in = std::mem::take(&mut self.is_led_in);
        let mut runs_on = false;
        while self.orders.go_on() {
            let order = self.orders.now();
            let next = slots.peek().filter(|slot| !(slot.may_hold && order == Order::Pause));
            let next = next.map(|slot| slot.attempt.shot.settings);
            let now_ns = self.clock.now_ns();
            let mut due_ns = i64::MAX;
            if let Some(settings) = next {
                let leads_in = !is_led_in || self.ahead.needs_lead_in(&settings);
                due_ns = self.ahead.due_ns(now_ns, leads_in);
                if due_ns <= now_ns && leads_in {
                    self.lead_in(&settings)?;
                    is_led_in = true;
                    continue;
                }
                if due_ns <= now_ns
                    && let Some(slot) = slots.next()
                {
                    self.write(&slot, runs_on)?;
                    runs_on = true;
                    continue;
                }
            }
            if next.is_none() && self.ahead.is_idle() {
                if slots.peek().is_none() {
                    break;
                }
                self.input.send(DeviceEvent::Idle).map_err(closed)?;
                self.orders.wait_while_paused();
                self.told_seq = None;
                self.ahead.lose_track();
                (is_led_in, runs_on) = (false, false);
                continue;
            }
            let until_due = Duration::from_nanos(due_ns.saturating_sub(now_ns).unsigned_abs());
            let timeout = until_due.min(POLL);
            match self.receive(timeout)? {
                Some(received) => {
                    self.deliver(received)?;
                    watchdog.feed();
                }
                None => watchdog.missed(timeout, self.longest_frame_us, self.camera.state())?,
            }
        }
        Ok(())
    }

    /// Skips frames until all points are decided.
    pub(super) fn settle(&mut self) -> Result<(), DeviceError> {
        if self.pace == Pace::Pipeline {
            // Always the same number, so that runs are bit-identical.
            return self.pass_frames(MARGIN_FRAMES, i64::MIN);
        }
        let decided = Arc::new(AtomicBool::new(false));
        self.input.send(DeviceEvent::Settle(decided.clone())).map_err(closed)?;
        let mut left = MARGIN_FRAMES;
        let mut watchdog = Watchdog::default();
        while left > 0 && !decided.load(Ordering::Acquire) && self.orders.go_on() {
            match self.receive(SETTLE_POLL)? {
                Some(received) => {
                    self.pass(received)?;
                    left -= 1;
                }
                None => watchdog.missed(SETTLE_POLL, self.longest_frame_us, self.camera.state())?,
            }
        }
        Ok(())
    }

    /// Writes settings that timestamps can distinguish from `settings`, at the same exposure.
    fn lead_in(&mut self, settings: &CameraSettings) -> Result<(), DeviceError> {
        let apart = self.apart_from(settings);
        self.pass_through(&apart)
    }

    /// These settings with a different delay.
    pub(super) fn apart_from(&self, settings: &CameraSettings) -> CameraSettings {
        let delay_us = settings.trigger_delay_us;
        let range = &self.camera.capabilities().trigger_delay_us;
        let delays_us = [delay_us + LEAD_IN_US, delay_us - LEAD_IN_US];
        let apart_us = delays_us.into_iter().find(|delay_us| range.contains(delay_us));
        CameraSettings { trigger_delay_us: apart_us.unwrap_or(delay_us), ..*settings }
    }

    /// Writes settings that belong to no point.
    pub(super) fn pass_through(&mut self, settings: &CameraSettings) -> Result<(), DeviceError> {
        let id = SettingsId { point: u32::MAX, attempt: self.lead_ins };
        self.lead_ins += 1;
        self.configure(id, settings, |_| None)
    }

    fn write(&mut self, slot: &SequenceSlot, runs_on: bool) -> Result<(), DeviceError> {
        let Attempt { id, point, shot, interruptions } = slot.attempt;
        // The more often a point failed, the more spare frames it gets.
        let spared = |failures: u32| failures.min(MOST_SPARED_FOR) * point.frames.div_ceil(4);
        self.configure(id, &shot.settings, |applied| {
            let job = Job {
                id,
                frames: point.frames,
                applied,
                delay_us: point.delay_us,
                light_edges_later: shot.light_edges_later,
                periods_from_last: slot.periods_from_last.filter(|_| runs_on),
            };
            Some(WantedFrames {
                job,
                is_lit: !matches!(point.role, PointRole::Dark(_)),
                is_begun: false,
                is_interrupted: false,
                // In a film, the attempt is the number of the cycle.
                frames: match slot.periods_from_last {
                    Some(_) => point.frames,
                    None => point.frames + spared(id.attempt),
                },
                margin_frames: spared(interruptions),
                passed: 0,
                // Frames dropped for lack of room are repeated within the attempt, up to this limit.
                spare_frames: 64 + 3 * point.frames,
            })
        })
    }

    /// Writes settings.
    fn configure(
        &mut self,
        id: SettingsId,
        settings: &CameraSettings,
        work: impl FnOnce(Applied) -> Option<WantedFrames>,
    ) -> Result<(), DeviceError> {
        let clock = self.clock.clone();
        let written = self.when_there(|camera| Ok((clock.now_ns(), camera.configure(id, settings)?)))?;
        let Some((before_ns, applied)) = written else { return Ok(()) };
        self.longest_frame_us = self.longest_frame_us.max(self.frame_us(&applied.actual));
        self.ahead.push(applied, (before_ns, self.clock.now_ns()), work(applied));
        Ok(())
    }

    /// Runs an action on the camera, waiting while the camera is being reopened; `None` if the run ends meanwhile.
    pub(super) fn when_there<T>(
        &mut self,
        mut act: impl FnMut(&mut dyn Camera) -> Result<T, DeviceError>,
    ) -> Result<Option<T>, DeviceError> {
        loop {
            match act(&mut *self.camera) {
                Err(_) if self.camera.state() == DeviceState::Lost => {
                    if !self.orders.go_on() {
                        return Ok(None);
                    }
                    if let Some(received) = self.receive(POLL)? {
                        self.deliver(received)?;
                    }
                }
                done => return done.map(Some),
            }
        }
    }

    /// Hands a frame on under the settings that it was exposed with. Earlier jobs that still lack frames are over.
    fn deliver(&mut self, received: Received) -> Result<(), DeviceError> {
        let (seq, seen) = (received.stamp.seq, received.seen);
        for _ in 0..seen.owner.unwrap_or(0) {
            self.note_lost(seen.since_seq, self.next_earliest(seq))?;
            self.interrupt_if(|_| true)?;
            self.ahead.pop();
        }
        let is_owned = seen.owner.is_some();
        if is_owned {
            self.note_lost(seen.since_seq, seq)?;
        } else {
            // The frame may belong to this job or the next: which frames a job gets must not depend on what follows.
            self.note_lost(seen.since_seq, self.next_earliest(seq))?;
            self.interrupt_if(|wanted| wanted.passed > 0)?;
        }
        let Some(wanted) = self.ahead.front().filter(|_| is_owned).and_then(|front| front.open()) else {
            // Exposed under settings that already have their frames, or under unknown settings.
            if let Some(next) = self.ahead.opening(seq)
                && !std::mem::replace(&mut next.is_begun, true)
            {
                self.input.send(DeviceEvent::Begin(next.job)).map_err(closed)?;
            }
            self.hand_on(received, Label::Settling)?;
            return Ok(());
        };
        let (job, is_lit) = (wanted.job, wanted.is_lit);
        if !std::mem::replace(&mut wanted.is_begun, true) {
            self.input.send(DeviceEvent::Begin(job)).map_err(closed)?;
        }
        let stamp = received.stamp;
        let label = match seen.else_triggered_ns {
            Some(triggered_ns) => Label::CountedUnless { triggered_ns },
            None => Label::Counted,
        };
        let taken = self.hand_on(received, label)?;
        let Some(wanted) = self.ahead.front().and_then(|front| front.work.as_mut()) else { return Ok(()) };
        match taken {
            Taken::Passed => wanted.passed += 1,
            Taken::Lost => wanted.spare_frames -= 1,
        }
        if wanted.is_complete() {
            self.input.send(DeviceEvent::End).map_err(closed)?;
        }
        if let Taken::Passed = taken {
            self.note_exposure(&stamp, &job.applied.actual, is_lit);
        }
        Ok(())
    }

    /// The first frame, up to `seq`, that may have had the next settings: frames lost from there on do not count
    /// against the job in force.
    fn next_earliest(&self, seq: u64) -> u64 {
        self.ahead.second().map_or(seq, |next| next.earliest().min(seq))
    }

    /// Reports the frames from `since_seq` on, below `seq`, that the job in force waited for and that never arrived.
    /// If the camera was lost meanwhile, the job is interrupted instead.
    fn note_lost(&mut self, since_seq: u64, seq: u64) -> Result<(), DeviceError> {
        let Some(front) = self.ahead.front() else { return Ok(()) };
        let lost = front.lost(since_seq, seq);
        if lost.is_empty() {
            return Ok(());
        }
        self.tell_losses(lost.start)?;
        if lost.clone().any(|seq| self.camera.loss_of(seq) == LossCause::CameraLost) {
            return self.interrupt_if(|_| true);
        }
        let Some(wanted) = self.ahead.front().and_then(|front| front.open()) else { return Ok(()) };
        if !std::mem::replace(&mut wanted.is_begun, true) {
            self.input.send(DeviceEvent::Begin(wanted.job)).map_err(closed)?;
        }
        for lost_seq in lost {
            let cause = self.camera.loss_of(lost_seq);
            self.input.send(DeviceEvent::Lost(lost_seq, Some(cause))).map_err(closed)?;
            self.told_seq = Some(lost_seq);
            wanted.passed += 1;
        }
        if wanted.is_complete() {
            self.input.send(DeviceEvent::End).map_err(closed)?;
        }
        Ok(())
    }

    /// Ends the job in force early, if it is open and `is_over` holds.
    fn interrupt_if(&mut self, is_over: impl FnOnce(&WantedFrames) -> bool) -> Result<(), DeviceError> {
        let wanted = self.ahead.front().and_then(|front| front.open());
        let Some(wanted) = wanted.filter(|wanted| is_over(wanted)) else { return Ok(()) };
        wanted.is_interrupted = true;
        if !std::mem::replace(&mut wanted.is_begun, true) {
            self.input.send(DeviceEvent::Begin(wanted.job)).map_err(closed)?;
        }
        self.input.send(DeviceEvent::Interrupt).map_err(closed)
    }
}
