//! Settings that the camera has been given but that are not yet in effect: which frame has which settings, and when
//! the next ones must be written.
//!
//! A camera applies settings at a trigger, with a latency of L frames. Settings for frame n must therefore be written
//! between the triggers of frames n - 1 - L and n - L, but the frames reach the host when that interval is almost
//! over. Trigger times are therefore predicted by the clock from the timestamps of earlier frames.
//!
//! An example with L = 1. Job A has the frames 10 to 12 and job B those from 13 on, so B must be written (`w`) between
//! the triggers of frames 11 and 12. Each frame arrives (`^`) when it has been exposed (`=`) and read out (`-`):
//!
//! ```text
//! frame      10          11          12          13          14
//! trigger    |           |           |           |           |
//! exposure   :..====--   :..====--   :..====--   :.====--    :.====--      A waits longer than B after the trigger
//! arrival              ^           ^           ^          ^           ^
//! write                        w
//! settings   A           A           A           B           B
//! ```
//!
//! - Frame 10 arrives. It gives the time of its trigger, from which those of frames 11 and 12 are predicted. A still
//!   needs two frames, so `end_seq` is 12, and `due_ns` is shortly after frame 11 has begun its exposure: by then its
//!   settings are latched.
//! - B is written. The camera promises only `Within { earliest: 11, certain: 14 }`. The newest frame to have arrived
//!   is 10, so the next to be triggered after the write is 11 or later (`next_seq` is 11 to unknown); with L = 1, B
//!   begins with frame 12 at the earliest. If the predicted triggers are right, it begins with 13 (`planned_seq`).
//! - Frame 11 arrives. Its timestamp shows that it was latched before the write: the next frame was 12 or later, so B
//!   begins with 13 or later.
//! - Frame 12 arrives. Its timestamp shows that it was triggered after the write: the next frame was 12, so B begins
//!   with 13 at the latest. Earliest and certain now agree, and frame 13 belongs to B by its id alone.
//!
//! If L varies, B begins with one of the frames 12 to 14. Each of those belongs to the settings whose exposure and
//! delay its timestamps show; if they fit both or neither, the frame is dropped.

use std::collections::VecDeque;
use std::ops::{Range, RangeInclusive};

use raysweep_core::{
    Applied, CameraCapabilities, CameraSettings, FirstFrame, FrameStamp, SettingsLatency, ns_from_us,
};
use raysweep_pipeline::{EXPOSURE_TOLERANCE_US, Job};

use super::triggers::TriggerTimes;

/// A sensor has latched its registers by this time after an exposure has begun. [A]
const HELD_AFTER_US: f64 = 500.0;
/// Settings are written this long after the previous exposure has begun. [A]
const AFTER_START_US: f64 = 1_000.0;
/// Nothing is written within this time before a trigger, which might come first. [A]
const BEFORE_TRIGGER_US: f64 = 1_000.0;
/// Frames that may be in transit to the host; a camera that owes more has missed a trigger, or is gone.
const FRAMES_UNDER_WAY: u64 = 4;

/// Trigger line and settings of a run.
#[derive(Debug, Clone, Copy)]
pub struct TriggerLine {
    /// Nominal period of the triggers.
    pub period_us: f64,
    /// Frames whose measured delay deviates by more than this are dropped.
    pub max_jitter_us: f64,
    /// Whether a frame's delay distinguishes each of the plan's settings from all others of the same exposure.
    pub distinct: bool,
    /// Whether all settings have the same exposure.
    pub has_one_exposure: bool,
}

impl TriggerLine {
    /// The line of a camera that goes through these settings.
    pub fn new(period_us: f64, max_jitter_us: f64, plan: &[CameraSettings]) -> Self {
        let phase_us = |settings: &CameraSettings| settings.trigger_delay_us.rem_euclid(period_us);
        let mut sorted: Vec<&CameraSettings> = plan.iter().collect();
        sorted.sort_by(|a, b| {
            let exposures = a.exposure_us.total_cmp(&b.exposure_us);
            exposures.then(phase_us(a).total_cmp(&phase_us(b)))
        });
        let same_exposure = |a: &CameraSettings, b: &CameraSettings| {
            (a.exposure_us - b.exposure_us).abs() <= 2.0 * EXPOSURE_TOLERANCE_US
        };
        let distinct = sorted.chunk_by(|a, b| same_exposure(a, b)).all(|settings| {
            let (first, last) = (phase_us(settings[0]), phase_us(settings[settings.len() - 1]));
            let wraps = settings.len() == 1 || first + period_us - last > max_jitter_us;
            let mut steps = settings.windows(2).map(|pair| phase_us(pair[1]) - phase_us(pair[0]));
            wraps && steps.all(|step_us| step_us > max_jitter_us)
        });
        let has_one_exposure = sorted.chunk_by(|a, b| same_exposure(a, b)).count() <= 1;
        Self { period_us, max_jitter_us, distinct, has_one_exposure }
    }

    /// Distance of a time from the nearest whole number of periods.
    pub fn off_us(&self, time_us: f64) -> f64 {
        let since_us = time_us.rem_euclid(self.period_us);
        since_us.min(self.period_us - since_us)
    }
}

/// Settings that were written to the camera.
pub struct Written {
    /// The values that the hardware applied.
    pub settings: CameraSettings,
    /// The first frame that has them, according to the camera; they stay until the next settings take effect.
    promised: FirstFrame,
    /// Bounds, from timestamps, for the first frame that was triggered after they were written.
    next_seq: (u64, u64),
    /// Number of frames after that one until they take effect, if known.
    late_frames: Option<u64>,
    /// The first frame that has them if the camera answers every trigger.
    planned_seq: u64,
    /// Whether timestamps may distinguish their frames from those of the previous settings.
    by_stamps: bool,
    /// The first frame that was observed to have them.
    seen_seq: u64,
    /// From the write of the first register to that of the last.
    written_ns: (i64, i64),
    /// The job they are for; `None` if they only lead in to others.
    pub work: Option<WantedFrames>,
}

/// Frames that a job waits for.
pub struct WantedFrames {
    /// The job as the assembler is told about it.
    pub job: Job,
    /// Whether the frames are exposed with the projector's light on.
    pub is_lit: bool,
    /// Whether the assembler has been told about the job.
    pub is_begun: bool,
    /// Whether it ended before its last frame.
    pub is_interrupted: bool,
    /// Number of consecutive frames of the job; a job that failed before gets some more than it needs. A frame that
    /// is lost in transit counts, so that the frames of a job do not depend on when the loss is noticed.
    pub frames: u32,
    /// Number of additional frames for which the settings stay before the next are written ahead.
    pub margin_frames: u32,
    /// Frames of the job that have been handed on or were lost in transit.
    pub passed: u32,
    /// Frames that may still be dropped for lack of room before the job is given up.
    pub spare_frames: u32,
}

impl WantedFrames {
    /// Whether it needs no more frames.
    pub fn is_complete(&self) -> bool {
        self.is_interrupted || self.passed >= self.frames || self.spare_frames == 0
    }
}

impl Written {
    /// Whether these settings need no more frames.
    fn is_complete(&self, newest_seq: Option<u64>) -> bool {
        match &self.work {
            Some(wanted) => wanted.is_complete(),
            None => newest_seq.is_some_and(|seq| seq >= self.certain()),
        }
    }

    /// The job, if it still needs frames.
    pub fn open(&mut self) -> Option<&mut WantedFrames> {
        self.work.as_mut().filter(|wanted| !wanted.is_complete())
    }

    /// The ids from `since_seq` on, below `seq`, of the job's frames that never arrived.
    pub fn lost(&self, since_seq: u64, seq: u64) -> Range<u64> {
        let Some(wanted) = self.work.as_ref().filter(|wanted| !wanted.is_complete()) else { return seq..seq };
        let first_seq = if wanted.passed > 0 { since_seq } else { self.certain().max(since_seq) };
        first_seq..seq.min(first_seq + u64::from(wanted.frames - wanted.passed))
    }

    /// The first frame that may have these settings.
    pub fn earliest(&self) -> u64 {
        match self.promised {
            FirstFrame::Exactly(seq) => seq,
            FirstFrame::Within { earliest, certain } => {
                earliest.max(self.next_seq.0 + self.late_frames.unwrap_or(0)).min(certain)
            }
        }
    }

    /// The first frame that certainly has these settings.
    pub fn certain(&self) -> u64 {
        let known_seq = match (self.promised, self.late_frames) {
            (FirstFrame::Within { certain, .. }, Some(late_frames)) => {
                certain.min(self.next_seq.1.saturating_add(late_frames)).max(self.earliest())
            }
            (promised, _) => promised.certain(),
        };
        known_seq.min(self.seen_seq)
    }

    /// The first frame that has these settings if everything goes as planned.
    fn planned(&self) -> u64 {
        self.planned_seq.clamp(self.earliest(), self.certain())
    }

    /// Narrows the bounds by a frame whose registers were latched before these settings were written, or that was
    /// triggered after.
    fn learn(&mut self, seq: u64, held_ns: i64, trigger_ns: Option<i64>) {
        let (from_ns, to_ns) = self.written_ns;
        if held_ns <= from_ns {
            self.next_seq.0 = self.next_seq.0.max(seq + 1);
        } else if trigger_ns.is_some_and(|trigger_ns| trigger_ns > to_ns) {
            self.next_seq.1 = self.next_seq.1.min(seq);
        }
    }
}

/// What was learnt from a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Seen {
    /// Index of the frame's settings, counted from those in force; `None` if unknown.
    pub owner: Option<usize>,
    /// Set if `owner` was found by timestamps, not by the frame id: the trigger time if the frame has the settings in
    /// force instead.
    pub else_triggered_ns: Option<i64>,
    /// Set if this is the first frame with new settings: how many frames after the next trigger at the time of
    /// writing.
    pub late_frames: Option<u32>,
    /// The id that follows the previous frame seen; frames were lost if it is less than this frame's id.
    pub since_seq: u64,
}

/// The settings that were written, from those in force on.
pub struct Ahead {
    camera: CameraCapabilities,
    line: TriggerLine,
    written: VecDeque<Written>,
    triggers: TriggerTimes,
    newest_seq: Option<u64>,
    frames_carry_exposure: bool,
    /// Whether the camera itself reports the first frame exactly.
    camera_is_exact: bool,
    latency: Option<SettingsLatency>,
}

impl Ahead {
    /// Starts without knowledge of the camera's earlier settings.
    pub fn new(camera: CameraCapabilities, line: TriggerLine) -> Self {
        Self {
            camera,
            triggers: TriggerTimes::new(ns_from_us(line.period_us)),
            line,
            written: VecDeque::new(),
            newest_seq: None,
            frames_carry_exposure: false,
            camera_is_exact: false,
            latency: None,
        }
    }

    /// Sets the latency that a probe has measured.
    pub fn set_latency(&mut self, latency: SettingsLatency) {
        self.latency = Some(latency);
    }

    /// Whether frames carry their exposure time.
    pub fn frames_carry_exposure(&self) -> bool {
        self.frames_carry_exposure
    }

    /// The settings that are certainly in force, or the first that were written.
    pub fn front(&mut self) -> Option<&mut Written> {
        self.written.front_mut()
    }

    /// The settings that were written after the front ones.
    pub fn second(&self) -> Option<&Written> {
        self.written.get(1)
    }

    /// Removes the settings in force, when later ones have replaced them.
    pub fn pop(&mut self) -> Option<Written> {
        self.written.pop_front()
    }

    /// Forgets the trigger times, which are too old to predict from.
    pub fn lose_track(&mut self) {
        self.triggers.forget();
    }

    /// Whether no written settings wait for a frame.
    pub fn is_idle(&self) -> bool {
        self.written.iter().all(|written| written.is_complete(self.newest_seq))
    }

    /// The job that waits for its first frame, if no earlier job is open and frame `seq` may have its settings.
    pub fn opening(&mut self, seq: u64) -> Option<&mut WantedFrames> {
        let newest_seq = self.newest_seq;
        let next = self.written.iter_mut().find(|written| !written.is_complete(newest_seq))?;
        if seq < next.earliest() { None } else { next.open() }
    }

    /// Whether frames cannot show when the exposure of `next` takes effect, although their delays show it for other
    /// settings: the exposure must then be changed first, until it is certain.
    pub fn needs_lead_in(&self, next: &CameraSettings) -> bool {
        let changes_exposure = |last: &Written| {
            let change_us = last.settings.exposure_us - next.exposure_us;
            last.work.is_some() && change_us.abs() > EXPOSURE_TOLERANCE_US
        };
        !self.frames_carry_exposure
            && !self.camera_is_exact
            && self.constant_latency().is_some()
            && self.written.back().is_some_and(changes_exposure)
    }

    fn constant_latency(&self) -> Option<u64> {
        self.latency.and_then(SettingsLatency::constant).map(u64::from)
    }

    /// When to write the next settings, so that the last ones get all their frames and no trigger is wasted;
    /// `i64::MAX`: not before another frame arrives. `leads_in`: timestamps may not show from which frame on the next
    /// settings are in effect.
    pub fn due_ns(&self, now_ns: i64, leads_in: bool) -> i64 {
        let Some(last) = self.written.back() else { return now_ns };
        let lead = self.constant_latency().filter(|_| !leads_in);
        let due_ns = match (&last.work, lead) {
            _ if last.is_complete(self.newest_seq) => now_ns,
            (None, None) => return i64::MAX,
            (None, Some(lead)) => self.after_trigger_ns(last.planned().saturating_sub(lead)),
            (Some(wanted), lead) => {
                self.after_trigger_ns(self.end_seq(last, wanted).saturating_sub(lead.unwrap_or(0)))
            }
        };
        if due_ns > now_ns {
            due_ns
        } else {
            self.triggers.between_ns(now_ns, self.window_ns(&last.settings))
        }
    }

    /// The last frame before which other settings must not take effect: a job's last frame, plus its margin.
    fn end_seq(&self, written: &Written, wanted: &WantedFrames) -> u64 {
        let next_seq = self.newest_seq.map_or(0, |seq| seq + 1);
        let first_seq = if wanted.passed > 0 { next_seq } else { written.planned().max(next_seq) };
        first_seq + u64::from(wanted.frames - wanted.passed + wanted.margin_frames) - 1
    }

    /// The first frame that is triggered after `time_ns`, if the camera answers every trigger.
    fn seq_after(&self, time_ns: i64) -> Option<u64> {
        let (known_seq, known_ns) = self.triggers.newest()?;
        let newest_seq = self.newest_seq.unwrap_or(known_seq);
        let mut trigger_ns = known_ns;
        (known_seq..newest_seq + FRAMES_UNDER_WAY)
            .find(|&seq| {
                trigger_ns += self.step_ns(seq);
                trigger_ns > time_ns
            })
            .map(|seq| seq + 1)
    }

    /// Time from the trigger of frame `seq` to that of the next frame.
    fn step_ns(&self, seq: u64) -> i64 {
        let period_us = self.line.period_us - self.line.max_jitter_us;
        let (settings, next) = (self.settings_of(seq), self.settings_of(seq + 1));
        let periods = settings.zip(next).map_or(1, |(a, b)| self.camera.periods_between(a, b, period_us));
        i64::from(periods) * self.triggers.period_ns()
    }

    /// When frame `seq` has been triggered and its exposure has begun.
    fn after_trigger_ns(&self, seq: u64) -> i64 {
        let Some((known_seq, known_ns)) = self.triggers.newest() else { return i64::MAX };
        if seq > self.newest_seq.unwrap_or(0) + FRAMES_UNDER_WAY {
            return i64::MAX;
        }
        let trigger_ns = known_ns + (known_seq..seq).map(|seq| self.step_ns(seq)).sum::<i64>();
        let possible = self.possible(seq).into_iter().flatten().map(|place| &self.written[place].settings);
        trigger_ns + possible.map(|settings| self.window_ns(settings).0).max().unwrap_or(0)
    }

    /// The settings that a frame will have if everything goes as planned.
    fn settings_of(&self, seq: u64) -> Option<&CameraSettings> {
        let planned = self.written.iter().rev().find(|written| written.planned() <= seq);
        planned.or(self.written.front()).map(|written| &written.settings)
    }

    /// The interval, relative to the trigger of a frame with these settings, in which others may be written.
    fn window_ns(&self, settings: &CameraSettings) -> (i64, i64) {
        let start_ns = ns_from_us(self.camera.trigger_latency_us + settings.trigger_delay_us);
        let from_ns = self.taken_ns(0, start_ns) + ns_from_us(AFTER_START_US);
        (from_ns, ns_from_us(self.line.period_us - BEFORE_TRIGGER_US))
    }

    /// Records settings that were written in the interval `written_ns`. Without `work` they only lead in to others.
    pub fn push(&mut self, applied: Applied, written_ns: (i64, i64), work: Option<WantedFrames>) {
        self.camera_is_exact = matches!(applied.first_frame, FirstFrame::Exactly(_));
        // If latencies vary, timestamps must decide for all points or for none: which frames of a point count must
        // not depend on the previous point, which a resumed run may not have acquired.
        let tell_alike =
            self.frames_carry_exposure || self.line.has_one_exposure || self.constant_latency().is_some();
        let by_stamps = work.is_none() || self.line.distinct && tell_alike;
        // If frames do not carry their exposure, the probe measured only the latency of delays.
        let late_frames = self.constant_latency().filter(|_| work.is_some());
        let certain = applied.first_frame.certain();
        let planned_seq =
            late_frames.zip(self.seq_after(written_ns.0)).map_or(certain, |(late, next)| next + late);
        self.written.push_back(Written {
            settings: applied.actual,
            promised: applied.first_frame,
            next_seq: (self.newest_seq.map_or(0, |seq| seq + 1), u64::MAX),
            late_frames,
            planned_seq,
            by_stamps,
            seen_seq: u64::MAX,
            written_ns,
            work,
        });
    }

    /// Processes a frame.
    pub fn see(&mut self, stamp: &FrameStamp) -> Seen {
        let trigger_ns = self.trigger_of(stamp);
        self.learn(stamp.seq, stamp.exposure_start_ns, trigger_ns);
        let owner = self.owner(stamp);
        let in_force = self.possible(stamp.seq).map(|candidates| *candidates.start());
        let since_seq = self.newest_seq.map_or(stamp.seq, |newest| newest + 1);
        self.newest_seq = Some(stamp.seq);
        self.frames_carry_exposure = stamp.exposure_us.is_some();
        let Some(written) = owner.and_then(|owner| self.written.get_mut(owner)) else {
            return Seen { owner, else_triggered_ns: None, late_frames: None, since_seq };
        };
        let is_by_stamps = stamp.seq < written.certain();
        let in_force = in_force.filter(|in_force| is_by_stamps && owner != Some(*in_force));
        written.seen_seq = written.seen_seq.min(stamp.seq);
        let (settings, (next_seq, latest_seq)) = (written.settings, written.next_seq);
        let is_new = owner > Some(0);
        let else_triggered_ns =
            in_force.map(|in_force| self.trigger_ns(stamp, &self.written[in_force].settings));
        self.triggers.note(stamp.seq, self.trigger_ns(stamp, &settings));
        let late_frames = u32::try_from(stamp.seq.saturating_sub(next_seq)).ok();
        let is_first = is_new && since_seq == stamp.seq;
        let late_frames = late_frames.filter(|_| is_first && next_seq == latest_seq);
        Seen { owner, else_triggered_ns, late_frames, since_seq }
    }

    /// Learns from a frame which settings were written before it and which after.
    fn learn(&mut self, seq: u64, start_ns: i64, trigger_ns: Option<i64>) {
        let taken_ns = trigger_ns.map_or(start_ns, |trigger_ns| self.taken_ns(trigger_ns, start_ns));
        for written in &mut self.written {
            written.learn(seq, taken_ns + ns_from_us(HELD_AFTER_US), trigger_ns);
        }
    }

    /// Latest time at which a frame's settings are latched.
    fn taken_ns(&self, trigger_ns: i64, start_ns: i64) -> i64 {
        start_ns.min(trigger_ns + self.triggers.period_ns() / 2)
    }

    /// When a frame was triggered, if all settings that fit its timestamps agree.
    fn trigger_of(&self, stamp: &FrameStamp) -> Option<i64> {
        let fitting = self.written.iter().filter(|written| self.fits(stamp, &written.settings));
        let mut triggers = fitting.map(|written| self.trigger_ns(stamp, &written.settings));
        let first_ns = triggers.next()?;
        let jitter_ns = ns_from_us(self.line.max_jitter_us).unsigned_abs();
        triggers.all(|trigger_ns| trigger_ns.abs_diff(first_ns) <= jitter_ns).then_some(first_ns)
    }

    fn trigger_ns(&self, stamp: &FrameStamp, settings: &CameraSettings) -> i64 {
        stamp.exposure_start_ns - ns_from_us(self.camera.trigger_latency_us + settings.trigger_delay_us)
    }

    /// The settings that a frame may have, judging by its id.
    fn possible(&self, seq: u64) -> Option<RangeInclusive<usize>> {
        let latest = self.written.iter().rposition(|written| written.earliest() <= seq)?;
        let certain = self.written.iter().rposition(|written| written.certain() <= seq);
        Some(certain.unwrap_or(0)..=latest)
    }

    /// The settings that a frame has: by its id and, if that is ambiguous, by its exposure and delay.
    fn owner(&self, stamp: &FrameStamp) -> Option<usize> {
        let candidates = self.possible(stamp.seq)?;
        if self.written[*candidates.end()].certain() <= stamp.seq {
            return Some(*candidates.end());
        }
        let among = || candidates.clone().map(|place| (place, &self.written[place]));
        let exposure_us = self.written[*candidates.end()].settings.exposure_us;
        let exposure_shows = stamp.exposure_us.is_some()
            || among().all(|(_, written)| written.settings.exposure_us == exposure_us);
        let stamps_tell = among().skip(1).all(|(_, written)| written.by_stamps);
        if !exposure_shows || !stamps_tell {
            return None;
        }
        let mut fitting = among().filter(|(_, written)| self.fits(stamp, &written.settings));
        let (place, _) = fitting.next()?;
        fitting.next().is_none().then_some(place)
    }

    /// Whether a frame has the exposure of these settings and, within half the permitted jitter, their delay.
    fn fits(&self, stamp: &FrameStamp, settings: &CameraSettings) -> bool {
        let exposure_us = stamp.exposure_us.unwrap_or(settings.exposure_us);
        let off_ns = self.triggers.off_ns(self.trigger_ns(stamp, settings));
        (exposure_us - settings.exposure_us).abs() <= EXPOSURE_TOLERANCE_US
            && off_ns.is_some_and(|off_ns| off_ns <= ns_from_us(self.line.max_jitter_us / 2.0))
    }
}
