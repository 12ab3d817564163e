//! Turns frames and VSYNC edges into averaged units. A plain state machine: no thread, no clock, no channel. How a
//! frame is classified depends on its timestamps, not on whether it or its edges arrived first.

use std::collections::VecDeque;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use ndarray::Array2;
use raysweep_core::{
    Applied, CameraCapabilities, Counts, Edge, Frame, FrameStamp, LossCause, PointUnderWay, Raster,
    SettingsId, VsyncStats, ns_from_us, us_from_ns,
};

use crate::edges::{EdgeTracker, Found, Line};
use crate::regularity::TrueEdge;
use crate::unit::Unit;

/// One attempt at a point, with the camera's settings for it.
#[derive(Debug, Clone, Copy)]
pub struct Job {
    /// Point and attempt.
    pub id: SettingsId,
    /// Frames to average.
    pub frames: u32,
    /// The settings as the camera applied them.
    pub applied: Applied,
    /// Wanted delay t_d.
    pub delay_us: f64,
    /// The edge whose light is measured, in edges after the trigger's own (0).
    pub light_edges_later: u32,
    /// In a film, VSYNC periods from the trigger of the previous job to the first trigger of this one; `None` after a
    /// pause and for independent jobs.
    pub periods_from_last: Option<u32>,
}

/// The classification of a frame, before it is known whether the frame is sound.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Label {
    /// It belongs to the point.
    Counted,
    /// It belongs to the point, unless a false edge at this time triggered it with the previous settings, which would
    /// give the same timestamps.
    CountedUnless {
        /// Time of the false edge, on the clock of the timestamps.
        triggered_ns: i64,
    },
    /// It was, or may have been, exposed with the previous settings.
    Settling,
    /// It is not needed.
    Cancelled,
}

/// Messages from the device threads to the assembler, in order.
pub enum DeviceEvent {
    /// An edge of the VSYNC line.
    Edge(Edge),
    /// The camera has been configured for an attempt.
    Begin(Job),
    /// A frame.
    Frame(Frame, Label),
    /// The id of a frame that found no room or never arrived; without a cause if no point needed it.
    Lost(u64, Option<LossCause>),
    /// The attempt is over: all its frames have arrived or were lost on the way.
    End,
    /// The attempt ended before its last frame: frames with other settings came first, or the camera was
    /// disconnected.
    Interrupt,
    /// No frames are taken for a while; those that pass do not count as lost.
    Idle,
    /// A flag to set when everything before it is decided.
    Settle(Arc<AtomicBool>),
    /// No more frames of this pass will arrive: decide everything.
    Flush,
}

/// The assembler's results.
pub enum Decision {
    /// The averaged image of a point.
    Unit(Unit),
    /// An attempt that lacks frames.
    Failed(SettingsId, Failure, Counts),
    /// A long attempt goes on.
    UnderWay(PointUnderWay),
    /// The pass is over; counts of frames outside any attempt, and statistics of the line so far.
    Flushed(Counts, VsyncStats),
}

/// Why an attempt lacks frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Failure {
    /// Too many of its own frames were lost or not sound: the point needs another attempt.
    Losses,
    /// It ended early for external reasons: the same attempt is repeated.
    Interrupted,
}

/// What the assembler needs to know about the rig.
#[derive(Debug, Clone)]
pub struct AssemblerConfig {
    /// The camera.
    pub camera: CameraCapabilities,
    /// When the projector lights its rows.
    pub raster: Raster,
    /// Projector row that camera row 0 sees.
    pub first_row: usize,
    /// Frames whose measured delay is off by more than this are not used.
    pub max_jitter_us: f64,
    /// Counts from which a pixel of a frame is saturated.
    pub saturation_dn: f64,
    /// Largest distance of an edge from its position expected from the last true edge.
    pub edge_gate_us: f64,
}

impl AssemblerConfig {
    /// The VSYNC line, as the tracker needs it.
    pub fn line(&self) -> Line {
        Line { period_ns: ns_from_us(self.raster.period_us), gate_ns: ns_from_us(self.edge_gate_us) }
    }
}

/// Largest distance between the edge to which a frame is tied and the expected time of its trigger.
const TRIGGER_TOLERANCE_NS: i64 = 200_000;
/// How long a frame waits, on the host's clock, for the edges around it.
const EDGE_PATIENCE_NS: i64 = 100_000_000;
/// How long an attempt goes on, on the host's clock, until it is told again how far it is.
const TOLD_EVERY_NS: i64 = 500_000_000;
/// The exposure that a camera reports may differ from its setting by rounding.
pub const EXPOSURE_TOLERANCE_US: f64 = 0.5;

/// The assembler's state.
pub struct Assembler {
    config: AssemblerConfig,
    tracker: EdgeTracker,
    waiting: VecDeque<Waiting>,
    attempt: Option<AttemptFrames>,
    /// Chain of the previous attempt.
    chain: Chain,
    outside: Counts,
    last_seq: Option<u64>,
    /// Whether unrequested frames may have passed.
    idle: bool,
    newest_ns: i64,
}

/// Events that wait for edges, in order.
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

struct AttemptFrames {
    job: Job,
    sum: Array2<u32>,
    /// In how many of the frames each pixel saturates. It takes no memory before one does.
    clipped: Array2<u32>,
    any_clipped: bool,
    averaged: u32,
    /// When it was last told how many are averaged; at first, when the first of them was.
    told_ns: Option<i64>,
    delays_us: Vec<f64>,
    counts: Counts,
    starts_ns: Vec<i64>,
    /// Whether one of its frames may have been exposed with the previous settings; later frames are then not used.
    is_doubtful: bool,
    chain: Chain,
}

/// Follows the triggers from frame to frame, to detect triggers without a frame.
#[derive(Default)]
struct Chain {
    /// The last frame that was tied to an edge.
    tied: Option<(u64, TrueEdge)>,
    /// Frames since then that were not triggered by a true edge.
    untied: i64,
    /// Additional periods since then that were needed for changes of settings.
    extra_periods: i64,
}

/// The light of a frame, or why the frame is not used.
enum Judgement {
    Undecided,
    Sound {
        trigger: TrueEdge,
        delay_us: f64,
    },
    Unsound {
        trigger: Option<TrueEdge>,
        cause: LossCause,
    },
    /// It may have been exposed with the previous settings.
    Doubtful,
}

impl Assembler {
    /// An assembler in its initial state.
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

    /// Processes an event; passes what can be decided now to `decide`, in order.
    pub fn push(&mut self, event: DeviceEvent, mut decide: impl FnMut(Decision)) {
        match event {
            DeviceEvent::Edge(edge) => {
                self.newest_ns = self.newest_ns.max(edge.host_ns);
                self.tracker.push(edge);
            }
            DeviceEvent::Begin(job) => self.waiting.push_back(Waiting::Begin(job)),
            DeviceEvent::Frame(frame, label) => {
                self.newest_ns = self.newest_ns.max(frame.stamp.host_ns);
                self.waiting.push_back(Waiting::Frame(frame, label));
            }
            DeviceEvent::Lost(seq, cause) => self.waiting.push_back(Waiting::Lost(seq, cause)),
            DeviceEvent::End => self.waiting.push_back(Waiting::End),
            DeviceEvent::Interrupt => self.waiting.push_back(Waiting::Interrupt),
            DeviceEvent::Idle => self.waiting.push_back(Waiting::Idle),
            DeviceEvent::Settle(decided) => self.waiting.push_back(Waiting::Settle(decided)),
            DeviceEvent::Flush => self.waiting.push_back(Waiting::Flush),
        }
        while let Some(next) = self.waiting.pop_front() {
            let flushing = self.waiting.iter().chain([&next]).any(|item| matches!(item, Waiting::Flush));
            if let Some(undecided) = self.settle(next, flushing, &mut decide) {
                self.waiting.push_front(undecided);
                break;
            }
        }
    }

    /// Settles one item, or returns it if its edges are still missing.
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
                    Judgement::Undecided => return Some(Waiting::Frame(frame, label)),
                    verdict => {
                        self.count(&frame, verdict);
                        let under_way = self.attempt.as_mut().and_then(|it| it.told_at(frame.stamp.host_ns));
                        under_way.into_iter().for_each(|frames| decide(Decision::UnderWay(frames)));
                    }
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
                // A failed device may have left its attempt open.
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
        self.attempt = Some(AttemptFrames {
            job,
            sum: Array2::zeros((self.config.camera.height, self.config.camera.width)),
            clipped: Array2::zeros((self.config.camera.height, self.config.camera.width)),
            any_clipped: false,
            averaged: 0,
            told_ns: None,
            delays_us: Vec::with_capacity(job.frames as usize),
            counts: Counts::default(),
            starts_ns: Vec::with_capacity(job.frames as usize),
            is_doubtful: false,
            chain,
        });
    }

    /// Ends the current attempt, if any. `failure` is the reason if the attempt lacks frames.
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

    /// The counts of the current attempt, or those outside any attempt.
    fn counts(&mut self) -> &mut Counts {
        self.attempt.as_mut().map_or(&mut self.outside, |attempt| &mut attempt.counts)
    }

    /// Follows the camera's frame ids: every id is an answered trigger, a skipped id is a lost frame.
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
    fn judge(&self, stamp: &FrameStamp, label: Label, flushing: bool) -> Judgement {
        let Some(AttemptFrames { job, .. }) = &self.attempt else {
            return Judgement::Unsound { trigger: None, cause: LossCause::SettingsMismatch };
        };
        let settings = &job.applied.actual;
        let out_of_patience = flushing || self.newest_ns > stamp.host_ns.saturating_add(EDGE_PATIENCE_NS);
        let known_ns = if out_of_patience { i64::MAX } else { self.tracker.known_until_ns() };

        let trigger_ns = stamp.exposure_start_ns
            - ns_from_us(self.config.camera.trigger_latency_us + settings.trigger_delay_us);
        if known_ns < trigger_ns + TRIGGER_TOLERANCE_NS {
            return Judgement::Undecided;
        }
        if let Label::CountedUnless { triggered_ns } = label {
            if known_ns < triggered_ns + TRIGGER_TOLERANCE_NS {
                return Judgement::Undecided;
            }
            if self.tracker.near(triggered_ns, TRIGGER_TOLERANCE_NS) == Found::False {
                return Judgement::Doubtful;
            }
        }
        let trigger = match self.tracker.near(trigger_ns, TRIGGER_TOLERANCE_NS) {
            Found::True(edge) => edge,
            Found::False => return Judgement::Unsound { trigger: None, cause: LossCause::FalseEdge },
            Found::Nothing => return Judgement::Unsound { trigger: None, cause: LossCause::EdgeMissing },
        };
        let later = i64::from(job.light_edges_later);
        let light = if later == 0 {
            trigger
        } else {
            match self.tracker.by_index(trigger.index + later) {
                Some(edge) => edge,
                None if known_ns < self.tracker.expected_ns(trigger, later) + self.tracker.gate_ns() => {
                    return Judgement::Undecided;
                }
                None => return Judgement::Unsound { trigger: Some(trigger), cause: LossCause::EdgeMissing },
            }
        };
        let exposure_us = stamp.exposure_us.unwrap_or(settings.exposure_us);
        if (exposure_us - settings.exposure_us).abs() > EXPOSURE_TOLERANCE_US {
            return Judgement::Unsound { trigger: Some(trigger), cause: LossCause::SettingsMismatch };
        }
        let start_us = us_from_ns(stamp.exposure_start_ns - light.host_ns);
        let delay_us = self.config.raster.delay_us(self.config.first_row, start_us, exposure_us);
        if (delay_us - job.delay_us).abs() > self.config.max_jitter_us {
            return Judgement::Unsound { trigger: Some(trigger), cause: LossCause::Jitter };
        }
        Judgement::Sound { trigger, delay_us }
    }

    /// Adds a sound frame to the sum, or counts the reason why it is not used.
    fn count(&mut self, frame: &Frame, verdict: Judgement) {
        self.follow(frame.stamp.seq);
        let Some(periods_per_frame) =
            self.attempt.as_ref().map(|attempt| self.periods_per_frame(&attempt.job))
        else {
            return;
        };
        let limit_dn = self.config.saturation_dn.ceil() as u16;
        let Some(attempt) = &mut self.attempt else { return };
        let (trigger, sound) = match verdict {
            Judgement::Sound { trigger, delay_us } => (Some(trigger), Ok(delay_us)),
            Judgement::Unsound { trigger, cause } => (trigger, Err(cause)),
            Judgement::Doubtful => {
                attempt.is_doubtful = true;
                attempt.chain.untied += 1;
                attempt.counts.settling += 1;
                return;
            }
            Judgement::Undecided => return,
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
                // An array created from zeros is one slice, row by row, like a frame.
                let sums = attempt.sum.as_slice_mut().unwrap_or_default();
                let clipped = attempt.clipped.as_slice_mut().unwrap_or_default();
                match frame.format.add_counting(&frame.data, sums, limit_dn, clipped) {
                    Ok(any) => attempt.any_clipped |= any,
                    Err(error) => {
                        tracing::warn!(%error, seq = frame.stamp.seq, "frame does not match its format");
                        return attempt.counts.lose(LossCause::SettingsMismatch, 1);
                    }
                }
                attempt.averaged += 1;
                attempt.delays_us.push(delay_us);
                attempt.starts_ns.push(frame.stamp.exposure_start_ns);
            }
            Err(cause) => attempt.counts.lose(cause, 1),
        }
    }
}

impl Chain {
    /// Number of triggers without a frame since the last frame that was tied to an edge.
    fn tie(&mut self, seq: u64, edge: TrueEdge, periods_per_frame: i64) -> u64 {
        let last = std::mem::replace(self, Self { tied: Some((seq, edge)), ..Self::default() });
        let Some((last_seq, last_edge)) = last.tied else { return 0 };
        let answered = i64::try_from(seq.saturating_sub(last_seq)).unwrap_or(i64::MAX) - last.untied;
        let taken = answered.saturating_mul(periods_per_frame).saturating_add(last.extra_periods);
        u64::try_from((edge.index - last_edge.index).saturating_sub(taken)).unwrap_or(0)
    }
}

impl AttemptFrames {
    /// How far it is at a frame's time, if that was not told for a while and frames are still missing.
    fn told_at(&mut self, now_ns: i64) -> Option<PointUnderWay> {
        let since = *self.told_ns.get_or_insert(now_ns);
        let is_due = now_ns.saturating_sub(since) >= TOLD_EVERY_NS && self.averaged < self.job.frames;
        is_due.then(|| {
            self.told_ns = Some(now_ns);
            PointUnderWay { frames: self.averaged, of: self.job.frames }
        })
    }

    fn finish(mut self, failure: Failure) -> Decision {
        self.counts.averaged = u64::from(self.averaged);
        if self.averaged < self.job.frames {
            // Sound frames of an incomplete attempt are not kept: the whole point is taken again.
            self.counts.cancelled += std::mem::take(&mut self.counts.averaged);
            let failure = if self.is_doubtful { Failure::Interrupted } else { failure };
            return Decision::Failed(self.job.id, failure, self.counts);
        }
        Decision::Unit(Unit {
            id: self.job.id,
            frames: self.averaged,
            delay_us: self.job.delay_us,
            exposure_us: self.job.applied.actual.exposure_us,
            delays_us: self.delays_us,
            run: 0,
            starts_ns: self.starts_ns,
            sum: Arc::new(self.sum),
            clipped: self.any_clipped.then(|| Arc::new(self.clipped)),
            counts: self.counts,
        })
    }
}

#[cfg(test)]
mod tests;
