//! What the camera has been told and has not yet shown: which frame has which settings, and when the next are to be
//! written.
//!
//! A camera takes settings at a trigger, its latency of L frames later. Settings for frame n must therefore be written
//! between the triggers of frames n - 1 - L and n - L, and frames reach the host when that time is all but over: when
//! triggers are, the clock says, by the stamps of the frames before.

use std::collections::VecDeque;

use raysweep_core::{
    Applied, CameraCapabilities, CameraSettings, FirstFrame, FrameStamp, SettingsLatency, ns_from_us,
};
use raysweep_pipeline::{EXPOSURE_TOLERANCE_US, Job};

use super::triggers::Triggers;

/// Settings are written so long after the exposure before them has begun: a sensor holds its registers by then. [A]
const AFTER_START_US: f64 = 1_000.0;
/// Nothing is written so shortly before a trigger, which might come first. [A]
const BEFORE_TRIGGER_US: f64 = 1_000.0;
/// Frames that may be on their way to the host; a camera that owes more has missed a trigger, or is gone.
const FRAMES_UNDER_WAY: u64 = 4;

/// What the settings of a run are like.
#[derive(Debug, Clone, Copy)]
pub struct Line {
    /// Nominal period of the triggers.
    pub period_us: f64,
    /// Frames whose measured delay is further off do not count.
    pub max_jitter_us: f64,
    /// Whether the stamps of a frame tell each settings of the plan from all others, where frames carry their exposure.
    pub distinct: bool,
    /// The same where they do not.
    pub distinct_without_exposure: bool,
}

impl Line {
    /// A line whose camera is taken through these settings.
    pub fn new(period_us: f64, max_jitter_us: f64, plan: &[CameraSettings]) -> Self {
        let phase_us = |settings: &CameraSettings| settings.trigger_delay_us.rem_euclid(period_us);
        let are_apart = |by_exposure: bool| {
            let mut sorted: Vec<&CameraSettings> = plan.iter().collect();
            sorted.sort_by(|a, b| {
                let exposures = a.exposure_us.total_cmp(&b.exposure_us);
                exposures.then(phase_us(a).total_cmp(&phase_us(b)))
            });
            let same_exposure = |a: &CameraSettings, b: &CameraSettings| {
                (a.exposure_us - b.exposure_us).abs() <= 2.0 * EXPOSURE_TOLERANCE_US
            };
            sorted.chunk_by(|a, b| same_exposure(a, b)).enumerate().all(|(group, settings)| {
                let (first, last) = (phase_us(settings[0]), phase_us(settings[settings.len() - 1]));
                let wraps = settings.len() == 1 || first + period_us - last > max_jitter_us;
                let steps =
                    settings.windows(2).all(|pair| phase_us(pair[1]) - phase_us(pair[0]) > max_jitter_us);
                wraps && steps && (by_exposure || group == 0)
            })
        };
        Self {
            period_us,
            max_jitter_us,
            distinct: are_apart(true),
            distinct_without_exposure: are_apart(false),
        }
    }
}

/// Settings that the camera has been given.
pub struct Written {
    /// As the hardware took them.
    pub settings: CameraSettings,
    /// The frames that have them; the next settings end their time.
    first: FirstFrame,
    /// Whether stamps may tell its frames from those of the settings before.
    by_stamps: bool,
    written_ns: i64,
    /// The first frame to be triggered after they were written, by its stamps.
    next_seq: Option<u64>,
    /// What they are for; nothing where they only lead from one to the next.
    pub work: Option<Wanted>,
}

/// Frames that a job waits for.
pub struct Wanted {
    /// What the assembler is told of them.
    pub job: Job,
    /// Whether they are exposed with the projector's light.
    pub is_lit: bool,
    /// Whether the assembler has been told.
    pub is_begun: bool,
    /// Frames to hand on: of a job that failed before, some more than it needs.
    pub frames: u32,
    /// Frames handed on.
    pub passed: u32,
    /// Frames that may find no room before it is given up.
    pub spare_frames: u32,
}

impl Wanted {
    /// Whether it waits for no frame any more.
    pub fn is_complete(&self) -> bool {
        self.passed >= self.frames || self.spare_frames == 0
    }
}

impl Written {
    /// Whether no frame is waited for.
    fn is_complete(&self, newest_seq: Option<u64>) -> bool {
        match &self.work {
            Some(wanted) => wanted.is_complete(),
            None => newest_seq.is_some_and(|seq| seq >= self.first.certain()),
        }
    }

    /// The job, if it still waits for frames.
    pub fn open(&mut self) -> Option<&mut Wanted> {
        self.work.as_mut().filter(|wanted| !wanted.is_complete())
    }

    /// The first frame that is certain to have the settings.
    pub fn certain(&self) -> u64 {
        self.first.certain()
    }
}

/// What a frame shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Seen {
    /// Which of the written settings it has, counted from those in force; nothing where it is not known.
    pub owner: Option<usize>,
    /// Where it is the first with new settings: how many frames later than the next to be triggered when they were
    /// written.
    pub late_frames: Option<u32>,
    /// The first frame after the one before that was seen; a later id than this one's own less one: frames were lost.
    pub since_seq: u64,
}

/// What has been written, from the settings in force on.
pub struct Ahead {
    camera: CameraCapabilities,
    line: Line,
    written: VecDeque<Written>,
    triggers: Triggers,
    newest_seq: Option<u64>,
    frames_carry_exposure: bool,
    /// Whether the camera itself says which frame is the first.
    camera_is_exact: bool,
    latency: Option<SettingsLatency>,
}

impl Ahead {
    /// Nothing is known of what the camera was told before.
    pub fn new(camera: CameraCapabilities, line: Line) -> Self {
        Self {
            camera,
            triggers: Triggers::new(ns_from_us(line.period_us)),
            line,
            written: VecDeque::new(),
            newest_seq: None,
            frames_carry_exposure: false,
            camera_is_exact: false,
            latency: None,
        }
    }

    /// From now on settings are expected to act as late as a probe has found.
    pub fn set_latency(&mut self, latency: SettingsLatency) {
        self.latency = Some(latency);
    }

    /// Whether frames say under which exposure they were taken.
    pub fn frames_carry_exposure(&self) -> bool {
        self.frames_carry_exposure
    }

    /// What is in force for certain, or was written first.
    pub fn front(&mut self) -> Option<&mut Written> {
        self.written.front_mut()
    }

    /// Takes what is in force out, since something later is.
    pub fn pop(&mut self) -> Option<Written> {
        self.written.pop_front()
    }

    /// The time has passed in which frames tell when triggers are.
    pub fn lose_track(&mut self) {
        self.triggers.forget();
    }

    /// Whether nothing that was written waits for a frame.
    pub fn is_idle(&self) -> bool {
        self.written.iter().all(|written| written.is_complete(self.newest_seq))
    }

    /// The job that waits for its first frame, if nothing before it does and the frame `seq` may have its settings.
    pub fn opening(&mut self, seq: u64) -> Option<&mut Wanted> {
        let newest_seq = self.newest_seq;
        let next = self.written.iter_mut().find(|written| !written.is_complete(newest_seq))?;
        if seq < next.first.earliest() { None } else { next.open() }
    }

    /// Whether frames cannot tell when the exposure of `next` acts, while their delays have told when settings do: the
    /// exposure must then come first, and be certain.
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

    /// When settings are to be written after those written last, so that these have all their frames and no trigger is
    /// waited for in vain; `i64::MAX`: not before another frame has come. `leads_in`: stamps may not tell from which
    /// frame on they act.
    pub fn due_ns(&self, now_ns: i64, leads_in: bool) -> i64 {
        let Some(last) = self.written.back() else { return now_ns };
        let lead = self.constant_latency().filter(|_| !leads_in);
        let due_ns = match (&last.work, lead) {
            _ if last.is_complete(self.newest_seq) => now_ns,
            (None, None) => return i64::MAX,
            (None, Some(lead)) => self.after_trigger_ns(last.first.certain().saturating_sub(lead)),
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

    /// The last frame that a job waits for, if none is lost.
    fn end_seq(&self, written: &Written, wanted: &Wanted) -> u64 {
        let next_seq = self.newest_seq.map_or(0, |seq| seq + 1);
        let first_seq = if wanted.passed > 0 { next_seq } else { written.first.certain().max(next_seq) };
        first_seq + u64::from(wanted.frames - wanted.passed) - 1
    }

    /// The first frame to be triggered after a moment, if every trigger is answered.
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

    /// From the trigger of the frame `seq` to that of the next.
    fn step_ns(&self, seq: u64) -> i64 {
        let period_us = self.line.period_us - self.line.max_jitter_us;
        let (settings, next) = (self.settings_of(seq), self.settings_of(seq + 1));
        let periods = settings.zip(next).map_or(1, |(a, b)| self.camera.periods_between(a, b, period_us));
        i64::from(periods) * self.triggers.period_ns()
    }

    /// When the frame `seq` has been triggered and its exposure begun.
    fn after_trigger_ns(&self, seq: u64) -> i64 {
        let Some((known_seq, known_ns)) = self.triggers.newest() else { return i64::MAX };
        if seq > self.newest_seq.unwrap_or(0) + FRAMES_UNDER_WAY {
            return i64::MAX;
        }
        let trigger_ns = known_ns + (known_seq..seq).map(|seq| self.step_ns(seq)).sum::<i64>();
        trigger_ns + self.settings_of(seq).map_or(0, |settings| self.window_ns(settings).0)
    }

    /// The settings that a frame will have if all goes as planned.
    fn settings_of(&self, seq: u64) -> Option<&CameraSettings> {
        let planned = self.written.iter().rev().find(|written| written.first.certain() <= seq);
        planned.or(self.written.front()).map(|written| &written.settings)
    }

    /// From when to when, after a trigger of a frame with these settings, others may be written.
    fn window_ns(&self, settings: &CameraSettings) -> (i64, i64) {
        let start_us = self.camera.trigger_latency_us + settings.trigger_delay_us;
        let from_us = start_us.min(self.line.period_us / 2.0) + AFTER_START_US;
        (ns_from_us(from_us), ns_from_us(self.line.period_us - BEFORE_TRIGGER_US))
    }

    /// Notes settings that were written between two moments. Without `work` they only lead to others.
    pub fn push(&mut self, applied: Applied, written_ns: (i64, i64), work: Option<Wanted>) {
        self.camera_is_exact = matches!(applied.first_frame, FirstFrame::Exactly(_));
        let by_stamps = work.is_none()
            || if self.frames_carry_exposure {
                self.line.distinct
            } else {
                self.line.distinct_without_exposure
            };
        let first = match (applied.first_frame, self.constant_latency()) {
            (FirstFrame::Within { earliest, certain }, Some(frames))
                if work.is_some() && self.triggers.none_within(written_ns) =>
            {
                // A driver knows of no trigger whose frame it has not seen. The clock does, but not whether it was
                // answered: what hangs on it must show in the stamps.
                let next_seq = self.seq_after(written_ns.0).unwrap_or(earliest).max(earliest);
                if by_stamps || next_seq == earliest {
                    FirstFrame::Exactly((next_seq + frames).min(certain))
                } else {
                    applied.first_frame
                }
            }
            (promised, _) => promised,
        };
        self.written.push_back(Written {
            settings: applied.actual,
            first,
            by_stamps,
            written_ns: written_ns.1,
            next_seq: None,
            work,
        });
    }

    /// Looks at a frame.
    pub fn see(&mut self, stamp: &FrameStamp) -> Seen {
        let owner = self.owner(stamp);
        let since_seq = self.newest_seq.map_or(stamp.seq, |newest| newest + 1);
        self.newest_seq = Some(stamp.seq);
        self.frames_carry_exposure = stamp.exposure_us.is_some();
        let Some(settings) = owner.and_then(|owner| self.written.get(owner)).map(|written| written.settings)
        else {
            return Seen { owner, late_frames: None, since_seq };
        };
        let trigger_ns = self.trigger_ns(stamp, &settings);
        let before = self.triggers.newest().filter(|(seq, _)| seq + 1 == stamp.seq);
        if let (Some((_, before_ns)), Some(last)) = (before, self.written.back_mut())
            && last.next_seq.is_none()
            && before_ns <= last.written_ns
            && last.written_ns < trigger_ns
        {
            last.next_seq = Some(stamp.seq);
        }
        self.triggers.note(stamp.seq, trigger_ns);
        let is_new = owner.is_some_and(|owner| owner > 0) && before.is_some();
        let next_seq = owner.filter(|_| is_new).and_then(|owner| self.written[owner].next_seq);
        let late_frames = next_seq.and_then(|next_seq| u32::try_from(stamp.seq.checked_sub(next_seq)?).ok());
        Seen { owner, late_frames, since_seq }
    }

    fn trigger_ns(&self, stamp: &FrameStamp, settings: &CameraSettings) -> i64 {
        stamp.exposure_start_ns - ns_from_us(self.camera.trigger_latency_us + settings.trigger_delay_us)
    }

    /// Which settings a frame has: by its id, and where that leaves several, by its own exposure and delay.
    fn owner(&self, stamp: &FrameStamp) -> Option<usize> {
        let latest = self.written.iter().rposition(|written| written.first.earliest() <= stamp.seq)?;
        let certain = self.written.iter().rposition(|written| written.first.certain() <= stamp.seq);
        if certain == Some(latest) {
            return certain;
        }
        let candidates = certain.unwrap_or(0)..=latest;
        let among = || candidates.clone().map(|place| (place, &self.written[place]));
        let exposure_us = self.written[latest].settings.exposure_us;
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

    /// Whether a frame has the exposure and, to half the jitter that is allowed, the delay of these settings.
    fn fits(&self, stamp: &FrameStamp, settings: &CameraSettings) -> bool {
        let exposure_us = stamp.exposure_us.unwrap_or(settings.exposure_us);
        let off_ns = self.triggers.off_ns(self.trigger_ns(stamp, settings));
        (exposure_us - settings.exposure_us).abs() <= EXPOSURE_TOLERANCE_US
            && off_ns.is_some_and(|off_ns| off_ns <= ns_from_us(self.line.max_jitter_us / 2.0))
    }
}
