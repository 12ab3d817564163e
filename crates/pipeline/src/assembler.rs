//! Frames and VSYNC edges in, averaged units out. A plain state machine: no thread, no clock, no channel; what a frame
//! is taken for hangs on its stamps, not on whether it or its edges came first.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use ndarray::Array2;
use raysweep_core::{
    Applied, CameraCapabilities, Counts, Edge, Frame, FrameStamp, LossCause, Raster, SettingsId, VsyncStats,
    ns_from_us, us_from_ns,
};

use crate::edges::{EdgeTracker, Found, Line, TrueEdge};
use crate::unit::Unit;

/// One attempt at a point, as the camera was set for it.
#[derive(Debug, Clone, Copy)]
pub struct Job {
    /// Point and attempt.
    pub id: SettingsId,
    /// Frames to average.
    pub frames: u32,
    /// What the camera made of the settings.
    pub applied: Applied,
    /// Wanted t_d.
    pub delay_us: f64,
    /// Which edge's light is measured: the trigger's own (0) or a later one.
    pub light_edges_later: u32,
    /// In a film, VSYNC periods from the trigger of the job before to this one's first; nothing after a pause and
    /// where jobs stand alone.
    pub periods_from_last: Option<u32>,
}

/// What a frame is taken for, before it is known whether it is sound.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Label {
    /// It belongs to the point.
    Counted,
    /// It belongs to the point, unless a false edge at this moment triggered it under the settings before: then its
    /// stamps would be the same.
    CountedUnless {
        /// On the clock of the stamps.
        triggered_ns: i64,
    },
    /// It was, or may have been, exposed under the settings before.
    Settling,
    /// Nobody waits for it.
    Cancelled,
}

/// What the device threads tell the assembler, in order.
pub enum Event {
    /// The line had an edge.
    Edge(Edge),
    /// The camera has been set for an attempt.
    Begin(Job),
    /// A frame.
    Frame(Frame, Label),
    /// The id of a frame that there was no room for, or that never came; without a cause, one that no point waited for.
    Lost(u64, Option<LossCause>),
    /// The attempt is over: all its frames have come or were lost on their way.
    End,
    /// The attempt is over before its last frame: frames of other settings came first, or the camera was away.
    Interrupt,
    /// Nobody takes frames for a while: those that pass are nobody's loss.
    Idle,
    /// To be raised when everything before it is decided.
    Settle(Arc<AtomicBool>),
    /// No further frame of this pass comes: decide everything.
    Flush,
}

/// What the assembler decided.
pub enum Decision {
    /// A point's image.
    Unit(Unit),
    /// An attempt without all its frames.
    Failed(SettingsId, Failure, Counts),
    /// The pass is over; frames outside any attempt, and the line so far.
    Flushed(Counts, VsyncStats),
}

/// Why an attempt lacks frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Failure {
    /// Too many of its own frames were lost or unsound: the point needs another attempt.
    Losses,
    /// It ended before its last frame, by no fault of its own: the same attempt is made again.
    Interrupted,
}

/// What the assembler must know of the rig.
#[derive(Debug, Clone)]
pub struct AssemblerConfig {
    /// The camera.
    pub camera: CameraCapabilities,
    /// When the projector lights its rows.
    pub raster: Raster,
    /// Projector row that camera row 0 sees.
    pub first_row: usize,
    /// Frames whose measured delay is further off than this do not count.
    pub max_jitter_us: f64,
    /// How far an edge may lie from where the last true one puts it.
    pub edge_gate_us: f64,
}

impl AssemblerConfig {
    /// The VSYNC line as its tracker must know it.
    pub fn line(&self) -> Line {
        Line { period_ns: ns_from_us(self.raster.period_us), gate_ns: ns_from_us(self.edge_gate_us) }
    }
}

/// A frame is tied to the edge within this of the one that must have triggered it.
const TRIGGER_TOLERANCE_NS: i64 = 200_000;
/// A frame waits this long, on the host's clock, for the edges around it.
const EDGE_PATIENCE_NS: i64 = 100_000_000;
/// A camera's own word for its exposure may differ by rounding from what it was set to.
pub const EXPOSURE_TOLERANCE_US: f64 = 0.5;

/// The assembler's state.
pub struct Assembler {
    config: AssemblerConfig,
    tracker: EdgeTracker,
    waiting: VecDeque<Waiting>,
    attempt: Option<Attempt>,
    /// Of the attempt before.
    chain: Chain,
    outside: Counts,
    last_seq: Option<u64>,
    /// Whether frames may have passed that nobody asked for.
    idle: bool,
    newest_ns: i64,
}

/// Events that wait for edges, in their order.
enum Waiting {
    Begin(Job),
    Frame(Frame, Label),
    Lost(u64, Option<LossCause>),
    End,
    Interrupt,
    Idle,
    Settle(Arc<AtomicBool>),
    Flush,
}

struct Attempt {
    job: Job,
    sum: Array2<u32>,
    averaged: u32,
    delays_us: Vec<f64>,
    counts: Counts,
    last_exposure_ns: Option<i64>,
    /// Whether one of its frames may have been exposed under the settings before: none after it counts.
    is_doubtful: bool,
    chain: Chain,
}

/// Follows the triggers from frame to frame, so that those that no frame answered show.
#[derive(Default)]
struct Chain {
    /// The last frame that was tied to an edge.
    tied: Option<(u64, TrueEdge)>,
    /// Frames since then that were triggered by no true edge.
    untied: i64,
    /// Periods that changes of settings have taken since then, beyond those of the frames.
    extra_periods: i64,
}

/// The light of a frame, or why it does not count.
enum Verdict {
    Undecided,
    Sound {
        trigger: TrueEdge,
        delay_us: f64,
    },
    Unsound {
        trigger: Option<TrueEdge>,
        cause: LossCause,
    },
    /// It may have been exposed under the settings before.
    Doubtful,
}

impl Assembler {
    /// An assembler that has seen nothing.
    pub fn new(config: AssemblerConfig) -> Self {
        Self {
            tracker: EdgeTracker::new(config.line()),
            config,
            waiting: VecDeque::new(),
            attempt: None,
            chain: Chain::default(),
            outside: Counts::default(),
            last_seq: None,
            idle: true,
            newest_ns: i64::MIN,
        }
    }

    /// Takes an event; what can be decided now goes to `decide`, in order.
    pub fn push(&mut self, event: Event, mut decide: impl FnMut(Decision)) {
        match event {
            Event::Edge(edge) => {
                self.newest_ns = self.newest_ns.max(edge.host_ns);
                self.tracker.push(edge);
            }
            Event::Begin(job) => self.waiting.push_back(Waiting::Begin(job)),
            Event::Frame(frame, label) => {
                self.newest_ns = self.newest_ns.max(frame.stamp.host_ns);
                self.waiting.push_back(Waiting::Frame(frame, label));
            }
            Event::Lost(seq, cause) => self.waiting.push_back(Waiting::Lost(seq, cause)),
            Event::End => self.waiting.push_back(Waiting::End),
            Event::Interrupt => self.waiting.push_back(Waiting::Interrupt),
            Event::Idle => self.waiting.push_back(Waiting::Idle),
            Event::Settle(decided) => self.waiting.push_back(Waiting::Settle(decided)),
            Event::Flush => self.waiting.push_back(Waiting::Flush),
        }
        while let Some(next) = self.waiting.pop_front() {
            let flushing = self.waiting.iter().chain([&next]).any(|item| matches!(item, Waiting::Flush));
            if let Some(undecided) = self.settle(next, flushing, &mut decide) {
                self.waiting.push_front(undecided);
                break;
            }
        }
    }

    /// Settles one item; gives it back if its edges are still to come.
    fn settle(
        &mut self,
        item: Waiting,
        flushing: bool,
        decide: &mut impl FnMut(Decision),
    ) -> Option<Waiting> {
        match item {
            Waiting::Begin(job) => self.begin(job),
            Waiting::Lost(seq, cause) => {
                self.follow(seq);
                match cause {
                    Some(cause) => self.counts().lose(cause, 1),
                    None => self.counts().cancelled += 1,
                }
            }
            Waiting::Frame(frame, label @ (Label::Counted | Label::CountedUnless { .. })) => {
                match self.judge(&frame.stamp, label, flushing) {
                    Verdict::Undecided => return Some(Waiting::Frame(frame, label)),
                    verdict => self.count(&frame, verdict),
                }
            }
            Waiting::Frame(frame, Label::Settling) => {
                self.follow(frame.stamp.seq);
                self.counts().settling += 1;
            }
            Waiting::Frame(frame, Label::Cancelled) => {
                self.follow(frame.stamp.seq);
                self.counts().cancelled += 1;
            }
            Waiting::End => self.end(Failure::Losses, decide),
            Waiting::Interrupt => self.end(Failure::Interrupted, decide),
            Waiting::Idle => self.idle = true,
            Waiting::Settle(decided) => decided.store(true, Ordering::Release),
            Waiting::Flush => {
                self.idle = true;
                // A device that failed may have left its attempt open.
                self.end(Failure::Interrupted, decide);
                decide(Decision::Flushed(std::mem::take(&mut self.outside), self.tracker.stats()));
            }
        }
        None
    }

    fn begin(&mut self, job: Job) {
        let mut chain = std::mem::take(&mut self.chain);
        match job.periods_from_last {
            Some(periods) => chain.extra_periods += i64::from(periods) - self.periods_per_frame(&job),
            None => chain = Chain::default(),
        }
        self.attempt = Some(Attempt {
            job,
            sum: Array2::zeros((self.config.camera.height, self.config.camera.width)),
            averaged: 0,
            delays_us: Vec::with_capacity(job.frames as usize),
            counts: Counts::default(),
            last_exposure_ns: None,
            is_doubtful: false,
            chain,
        });
    }

    /// Ends the attempt, if there is one; `failure` is why it lacks frames if it does.
    fn end(&mut self, failure: Failure, decide: &mut impl FnMut(Decision)) {
        if let Some(mut attempt) = self.attempt.take() {
            self.chain = std::mem::take(&mut attempt.chain);
            decide(attempt.finish(failure));
        }
    }

    fn periods_per_frame(&self, job: &Job) -> i64 {
        let Raster { period_us, .. } = self.config.raster;
        i64::from(self.config.camera.periods_per_frame(&job.applied.actual, period_us))
    }

    /// The account that the present belongs to.
    fn counts(&mut self) -> &mut Counts {
        self.attempt.as_mut().map_or(&mut self.outside, |attempt| &mut attempt.counts)
    }

    /// Follows the camera's frame ids: every id is a trigger that was answered, an id left out is a lost frame.
    fn follow(&mut self, seq: u64) {
        let gap = self.last_seq.map_or(0, |last| seq.saturating_sub(last + 1));
        self.last_seq = Some(seq);
        let idle = std::mem::replace(&mut self.idle, false);
        self.counts().expected += gap + 1;
        if idle {
            self.counts().cancelled += gap;
        } else {
            self.counts().lose(LossCause::CameraGap, gap);
        }
    }

    /// Ties a frame to the edge that triggered it and to the edge of the light that it saw.
    fn judge(&self, stamp: &FrameStamp, label: Label, flushing: bool) -> Verdict {
        let Some(Attempt { job, .. }) = &self.attempt else {
            return Verdict::Unsound { trigger: None, cause: LossCause::SettingsMismatch };
        };
        let settings = &job.applied.actual;
        let out_of_patience = flushing || self.newest_ns > stamp.host_ns.saturating_add(EDGE_PATIENCE_NS);
        let known_ns = if out_of_patience { i64::MAX } else { self.tracker.known_until_ns() };

        let trigger_ns = stamp.exposure_start_ns
            - ns_from_us(self.config.camera.trigger_latency_us + settings.trigger_delay_us);
        if known_ns < trigger_ns + TRIGGER_TOLERANCE_NS {
            return Verdict::Undecided;
        }
        if let Label::CountedUnless { triggered_ns } = label {
            if known_ns < triggered_ns + TRIGGER_TOLERANCE_NS {
                return Verdict::Undecided;
            }
            if self.tracker.near(triggered_ns, TRIGGER_TOLERANCE_NS) == Found::False {
                return Verdict::Doubtful;
            }
        }
        let trigger = match self.tracker.near(trigger_ns, TRIGGER_TOLERANCE_NS) {
            Found::True(edge) => edge,
            Found::False => return Verdict::Unsound { trigger: None, cause: LossCause::FalseEdge },
            Found::Nothing => return Verdict::Unsound { trigger: None, cause: LossCause::EdgeMissing },
        };
        let later = i64::from(job.light_edges_later);
        let light = if later == 0 {
            trigger
        } else {
            match self.tracker.by_index(trigger.index + later) {
                Some(edge) => edge,
                None if known_ns < self.tracker.expected_ns(trigger, later) + self.tracker.gate_ns() => {
                    return Verdict::Undecided;
                }
                None => return Verdict::Unsound { trigger: Some(trigger), cause: LossCause::EdgeMissing },
            }
        };
        let exposure_us = stamp.exposure_us.unwrap_or(settings.exposure_us);
        if (exposure_us - settings.exposure_us).abs() > EXPOSURE_TOLERANCE_US {
            return Verdict::Unsound { trigger: Some(trigger), cause: LossCause::SettingsMismatch };
        }
        let start_us = us_from_ns(stamp.exposure_start_ns - light.host_ns);
        let delay_us = self.config.raster.delay_us(self.config.first_row, start_us, exposure_us);
        if (delay_us - job.delay_us).abs() > self.config.max_jitter_us {
            return Verdict::Unsound { trigger: Some(trigger), cause: LossCause::Jitter };
        }
        Verdict::Sound { trigger, delay_us }
    }

    /// Adds a sound frame to the sum, or notes why it does not count.
    fn count(&mut self, frame: &Frame, verdict: Verdict) {
        self.follow(frame.stamp.seq);
        let Some(periods_per_frame) =
            self.attempt.as_ref().map(|attempt| self.periods_per_frame(&attempt.job))
        else {
            return;
        };
        let Some(attempt) = &mut self.attempt else { return };
        let (trigger, sound) = match verdict {
            Verdict::Sound { trigger, delay_us } => (Some(trigger), Ok(delay_us)),
            Verdict::Unsound { trigger, cause } => (trigger, Err(cause)),
            Verdict::Doubtful => {
                attempt.is_doubtful = true;
                attempt.chain.untied += 1;
                attempt.counts.settling += 1;
                return;
            }
            Verdict::Undecided => return,
        };
        match trigger {
            Some(edge) => {
                let unanswered = attempt.chain.tie(frame.stamp.seq, edge, periods_per_frame);
                attempt.counts.expected += unanswered;
                attempt.counts.lose(LossCause::MissedTrigger, unanswered);
            }
            None => attempt.chain.untied += 1,
        }
        match sound {
            Ok(_) if attempt.averaged == attempt.job.frames || attempt.is_doubtful => {
                attempt.counts.cancelled += 1;
            }
            Ok(delay_us) => {
                // An array that was made of zeros is one slice, row by row, as frames are.
                let sums = attempt.sum.as_slice_mut().unwrap_or_default();
                if let Err(error) = frame.format.add_to(&frame.data, sums) {
                    tracing::warn!(%error, seq = frame.stamp.seq, "frame does not match its format");
                    return attempt.counts.lose(LossCause::SettingsMismatch, 1);
                }
                attempt.averaged += 1;
                attempt.delays_us.push(delay_us);
                attempt.last_exposure_ns = Some(frame.stamp.exposure_start_ns);
            }
            Err(cause) => attempt.counts.lose(cause, 1),
        }
    }
}

impl Chain {
    /// How many triggers stayed unanswered since the last frame that was tied to an edge.
    fn tie(&mut self, seq: u64, edge: TrueEdge, periods_per_frame: i64) -> u64 {
        let last = std::mem::replace(self, Self { tied: Some((seq, edge)), ..Self::default() });
        let Some((last_seq, last_edge)) = last.tied else { return 0 };
        let answered = i64::try_from(seq.saturating_sub(last_seq)).unwrap_or(i64::MAX) - last.untied;
        let taken = answered.saturating_mul(periods_per_frame).saturating_add(last.extra_periods);
        u64::try_from((edge.index - last_edge.index).saturating_sub(taken)).unwrap_or(0)
    }
}

impl Attempt {
    fn finish(mut self, failure: Failure) -> Decision {
        self.counts.averaged = u64::from(self.averaged);
        if self.averaged < self.job.frames {
            // Sound frames of an attempt that lacks others are not kept: the point is taken again as a whole.
            self.counts.cancelled += std::mem::take(&mut self.counts.averaged);
            let failure = if self.is_doubtful { Failure::Interrupted } else { failure };
            return Decision::Failed(self.job.id, failure, self.counts);
        }
        Decision::Unit(Unit {
            id: self.job.id,
            frames: self.averaged,
            exposure_us: self.job.applied.actual.exposure_us,
            delays_us: self.delays_us,
            last_exposure_ns: self.last_exposure_ns,
            sum: Arc::new(self.sum),
            counts: self.counts,
        })
    }
}

#[cfg(test)]
mod tests;
