//! The electrical side of the rig: the VSYNC line, the projector frames that follow it, and the camera that its edges
//! trigger. Events are processed in order of time, regardless of which device asks first.

mod camera;

use std::collections::VecDeque;
use std::sync::Arc;

use rand_distr::{Distribution, StandardNormal};
use raysweep_core::{CameraSettings, Edge, Readout, SettingsId, Subject, ns_from_us};

use self::camera::{CameraLine, RunningSequence, WrittenSettings};
pub use self::camera::{Exposure, Sets, TriggeredBy};
use crate::keyed::{Purpose, keyed, uniform};
use crate::scene::SceneMotion;
use crate::shown::ShownOptics;
use raysweep_config::sim::{SimCamera, SimProjector, SimVsync};

/// One projector frame: the time of its edge and what it shows (`None`: dark).
#[derive(Clone)]
pub struct Light {
    /// Time of its edge, even if the edge is missing from the line.
    pub edge_ns: i64,
    /// Start of the light: the edge plus a phase error that no device measures.
    pub start_ns: i64,
    /// What is shown.
    pub shown: Option<Arc<ShownOptics>>,
    /// Key position of the scene's motion.
    pub key: usize,
}

/// Parameters of the line.
pub struct LineConfig {
    pub seed: u64,
    pub period_ns: i64,
    pub vsync: SimVsync,
    pub projector: SimProjector,
    pub camera: SimCamera,
    /// True time from the edge to the start of row 0's exposure, at a trigger delay of zero.
    pub trigger_latency_us: f64,
    pub motion: SceneMotion,
    /// Time from the end of row 0's exposure until the last row is read.
    pub readout_ns: i64,
    /// Time from the end of row 0's exposure to the end of the last row's.
    pub rolling_ns: i64,
}

/// State of the line.
pub struct VsyncLine {
    config: LineConfig,
    /// Number of the next period to draw.
    next_period: i64,
    /// The frame that the last period was drawn for; `draws` counts the periods drawn for it.
    drawn_for: DrawnFor,
    draws: u64,
    /// When settings were last written: for later periods, the camera's readiness is evaluated no earlier than this.
    configured_ns: i64,
    /// Future edges on the line, in order.
    pending: VecDeque<PendingEdge>,
    /// Light of the most recent periods and the next one.
    lights: VecDeque<Light>,
    shown: Option<Arc<ShownOptics>>,
    /// The next pattern, and the period from which the projector shows it.
    next_shown: Option<(i64, Option<Arc<ShownOptics>>)>,
    /// What stands before the camera.
    subject: Subject,
    seen: VecDeque<Edge>,
    edges: u64,
    camera: CameraLine,
    /// Overrides the configured number of late frames.
    late_frames: Option<u32>,
    truth: LineTruth,
}

/// A frame (point, attempt, number of frames before it under the same settings) and whether the camera is ready: if so,
/// the next frame, which the period may trigger; otherwise the newest frame, which sees the period's light.
type DrawnFor = ([u64; 3], bool);

struct PendingEdge {
    period: i64,
    at_ns: i64,
    kind: EdgeKind,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum EdgeKind {
    True,
    Missing,
    Unseen,
    False,
}

/// Ground truth of the line, for tests only.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct LineTruth {
    /// Exposures made while armed.
    pub exposures: u64,
    /// Exposures triggered by false edges.
    pub false_triggers: u64,
    /// Edges that never reached the line.
    pub missing_edges: u64,
    /// Edges missed by the VSYNC monitor.
    pub unseen_edges: u64,
    /// Frames lost in transit.
    pub dropped_frames: u64,
}

/// Frames that the camera buffers for the host; on overflow the oldest is lost.
const CAMERA_BUFFERS: usize = 32;
/// Retry interval of a free-running camera that was not ready.
const FREE_RETRY_NS: i64 = 50_000;
/// Time before its nominal edge at which a period is drawn; larger than any jitter.
const GUARD_NS: i64 = 400_000;

impl VsyncLine {
    /// An idle line at `now_ns`.
    pub fn new(config: LineConfig, now_ns: i64) -> Self {
        Self {
            next_period: now_ns / config.period_ns + 1,
            config,
            drawn_for: ([0; 3], false),
            draws: 0,
            configured_ns: now_ns,
            pending: VecDeque::new(),
            lights: VecDeque::new(),
            shown: None,
            next_shown: None,
            subject: Subject::Scene,
            seen: VecDeque::new(),
            edges: 0,
            camera: CameraLine::at_rest(),
            late_frames: None,
            truth: LineTruth::default(),
        }
    }

    pub fn truth(&self) -> LineTruth {
        self.truth
    }

    /// Time of the next event.
    pub fn next_event_ns(&self) -> i64 {
        self.next_line_event_ns().min(self.camera.free_run_ns())
    }

    fn next_line_event_ns(&self) -> i64 {
        let draw_ns = self.nominal_ns(self.next_period) - GUARD_NS;
        self.pending.front().map_or(draw_ns, |edge| edge.at_ns.min(draw_ns))
    }

    /// Processes all events until `now_ns`.
    pub fn advance(&mut self, now_ns: i64) {
        while self.next_event_ns() <= now_ns {
            if self.camera.free_run_ns() < self.next_line_event_ns() {
                self.free_run();
                continue;
            }
            let draw_ns = self.nominal_ns(self.next_period) - GUARD_NS;
            match self.pending.front() {
                Some(edge) if edge.at_ns <= draw_ns => {
                    if let Some(edge) = self.pending.pop_front() {
                        self.edge(&edge);
                    }
                }
                _ => self.draw_period(),
            }
        }
    }

    fn nominal_ns(&self, period: i64) -> i64 {
        period * self.config.period_ns
    }

    /// Draws the events of the next period. All random numbers are keyed by the frame concerned, so that a point has
    /// the same edges in an uninterrupted run and in a resumed one.
    fn draw_period(&mut self) {
        let nominal_ns = self.nominal_ns(self.next_period);
        let asked_ns = nominal_ns.max(self.configured_ns);
        let ready = self.camera.is_ready(asked_ns, self.config.trigger_latency_us);
        let drawn_for = (if ready { self.camera.key() } else { self.camera.newest_key() }, ready);
        if drawn_for != self.drawn_for {
            (self.drawn_for, self.draws) = (drawn_for, 0);
        }
        let [point, attempt, frame] = drawn_for.0;
        let mut random =
            keyed(self.config.seed, Purpose::Line, &[point, attempt, frame, u64::from(ready), self.draws]);
        let vsync = &self.config.vsync;
        let z: f64 = StandardNormal.sample(&mut random);
        let limit_us = GUARD_NS as f64 / 1e3 / 2.0;
        let jitter_ns = ns_from_us((z * vsync.jitter_us).clamp(-limit_us, limit_us));
        let phase_ns = ns_from_us((2.0 * uniform(&mut random) - 1.0) * self.config.projector.phase_jitter_us);
        let missing = uniform(&mut random) < vsync.missing;
        let unseen = uniform(&mut random) < vsync.unseen;
        let false_edge = uniform(&mut random) < vsync.false_edges;
        let false_at = uniform(&mut random);

        let edge_ns = nominal_ns + jitter_ns;
        if let Some((_, shown)) = self.next_shown.take_if(|(from, _)| *from <= self.next_period) {
            self.shown = shown;
        }
        let (shown, key) = (self.shown.clone(), self.config.motion.key(nominal_ns));
        self.lights.push_back(Light { edge_ns, start_ns: edge_ns + phase_ns, shown, key });
        let kind = match (missing, unseen) {
            (true, _) => EdgeKind::Missing,
            (false, true) => EdgeKind::Unseen,
            (false, false) => EdgeKind::True,
        };
        self.pending.push_back(PendingEdge { period: self.next_period, at_ns: edge_ns, kind });
        if false_edge {
            // Not close to a true edge, from which it could not be told apart.
            let offset_ns = (self.config.period_ns as f64 * (0.1 + 0.8 * false_at)) as i64;
            let at_ns = nominal_ns + offset_ns;
            self.pending.push_back(PendingEdge { period: self.next_period, at_ns, kind: EdgeKind::False });
        }
        self.next_period += 1;
        self.draws += 1;
        self.forget_old_lights(nominal_ns);
    }

    /// Drops light that no waiting or imminent exposure can see.
    fn forget_old_lights(&mut self, nominal_ns: i64) {
        let oldest_ns =
            self.camera.exposures.front().map_or(nominal_ns, |exposure| exposure.start_ns.min(nominal_ns));
        while self.lights.get(2).is_some_and(|light| light.start_ns < oldest_ns) {
            self.lights.pop_front();
        }
    }

    fn edge(&mut self, edge: &PendingEdge) {
        if edge.kind == EdgeKind::Missing {
            self.truth.missing_edges += 1;
            return;
        }
        self.edges += 1;
        if edge.kind == EdgeKind::Unseen {
            self.truth.unseen_edges += 1;
        } else {
            self.seen.push_back(Edge { seq: self.edges, host_ns: edge.at_ns });
        }
        // False edges are keyed by the frame before them. If one triggered the first frame under new settings, a point
        // would depend on the previous point, which a resumed run may not have acquired. A sequence is never resumed.
        let is_first = self.camera.due().1 == 0 && self.camera.sequence.is_none();
        let is_heard = edge.kind != EdgeKind::False || !is_first;
        let by_edges = self.camera.triggered_by == TriggeredBy::Edges;
        if by_edges && is_heard && self.trigger(edge.at_ns) && edge.kind == EdgeKind::False {
            self.truth.false_triggers += 1;
        }
    }

    /// Triggers a free-running camera.
    fn free_run(&mut self) {
        let TriggeredBy::FreeRun { period_ns } = self.camera.triggered_by else { return };
        let at_ns = self.camera.next_free_ns;
        let answered = self.trigger(at_ns);
        self.camera.next_free_ns =
            at_ns + if answered { period_ns.max(FREE_RETRY_NS) } else { FREE_RETRY_NS };
    }

    /// Triggers the camera; returns whether it responded.
    fn trigger(&mut self, edge_ns: i64) -> bool {
        let config = &self.config;
        let camera = &mut self.camera;
        if !camera.armed || !camera.is_ready(edge_ns, config.trigger_latency_us) {
            return false;
        }
        let key = camera.key();
        (camera.in_force, camera.frames) = camera.due();
        let seq = camera.seq;
        camera.written.retain(|written| written.first_seq > seq);
        let settings = camera.in_force.settings;
        let after = |latency_us: f64| edge_ns + ns_from_us(latency_us + settings.trigger_delay_us);
        let (start_ns, stamped_ns) =
            (after(config.trigger_latency_us), after(config.camera.trigger_latency_us));
        let exposure_ns = ns_from_us(settings.exposure_us);
        let delivered = uniform(&mut keyed(config.seed, Purpose::Drop, &key)) >= config.camera.dropped;
        (camera.deaf_until_ns, camera.occupied_until_ns) = match config.camera.readout {
            Readout::Sequential => (start_ns + exposure_ns + config.readout_ns, 0),
            Readout::Overlapped => (start_ns, start_ns + exposure_ns.max(config.readout_ns)),
        };
        let done_ns = start_ns + exposure_ns + config.rolling_ns.max(config.readout_ns);
        if camera.exposures.len() == CAMERA_BUFFERS {
            camera.exposures.pop_front();
        }
        camera.exposures.push_back(Exposure {
            seq: camera.seq,
            key,
            settings,
            subject: self.subject,
            start_ns,
            stamped_ns,
            done_ns,
            delivered,
        });
        camera.seq += 1;
        camera.frames += 1;
        camera.take_next_set();
        self.truth.exposures += 1;
        self.truth.dropped_frames += u64::from(!delivered);
        true
    }

    /// Writes camera settings at `now_ns`, which ends a sequence; returns the id of the next frame to be triggered.
    pub fn configure(&mut self, now_ns: i64, id: SettingsId, settings: CameraSettings) -> u64 {
        self.advance(now_ns);
        self.camera.sequence = None;
        let config = &self.config;
        let late = if config.camera.late_frames_min < config.camera.late_frames_max {
            let span = config.camera.late_frames_max - config.camera.late_frames_min + 1;
            let key = [u64::from(id.point), u64::from(id.attempt)];
            let draw = uniform(&mut keyed(config.seed, Purpose::Late, &key));
            config.camera.late_frames_min + (draw * f64::from(span)) as u32
        } else {
            config.camera.late_frames_max
        };
        let first_seq = self.camera.seq + u64::from(self.late_frames.unwrap_or(late));
        // Registers are read in the order in which they were written: the latest value counts.
        self.camera.written.retain(|earlier| earlier.first_seq < first_seq);
        self.camera.written.push_back(WrittenSettings { first_seq, id, settings });
        self.redraw(now_ns);
        self.camera.seq
    }

    /// Starts a sequence: the next frame uses the set `first`, and each later frame the successor of the previous
    /// frame's set.
    pub fn set_sequence(&mut self, now_ns: i64, sets: Sets, first: usize) {
        self.advance(now_ns);
        self.camera.written.clear();
        self.camera.sequence = Some(RunningSequence { sets, next: first, frames: 0 });
        self.camera.take_next_set();
        self.redraw(now_ns);
    }

    /// The set of the newest frame, if a sequence is running and has had a frame.
    pub fn active_set(&mut self, now_ns: i64) -> Option<usize> {
        self.advance(now_ns);
        let CameraLine { sequence, in_force, .. } = &self.camera;
        sequence.as_ref().filter(|sequence| sequence.frames > 1).map(|_| in_force.id.point as usize)
    }

    /// Redraws future periods, which were drawn for the previous settings.
    fn redraw(&mut self, now_ns: i64) {
        self.configured_ns = now_ns;
        while self.lights.back().is_some_and(|light| light.edge_ns > now_ns) {
            self.lights.pop_back();
            self.next_period -= 1;
            self.draws = self.draws.saturating_sub(1);
        }
        let next_period = self.next_period;
        self.pending.retain(|edge| edge.period < next_period);
    }

    /// Triggers the camera by software; returns whether it responded.
    pub fn fire(&mut self, now_ns: i64) -> bool {
        self.advance(now_ns);
        self.camera.triggered_by == TriggeredBy::Software && self.trigger(now_ns)
    }

    /// Selects what starts exposures.
    pub fn set_triggered_by(&mut self, now_ns: i64, triggered_by: TriggeredBy) {
        self.advance(now_ns);
        self.camera.triggered_by = triggered_by;
        self.camera.next_free_ns = now_ns;
    }

    /// Sets how many frames after a change still use the old settings; `None`: as configured.
    pub fn set_late_frames(&mut self, frames: Option<u32>) {
        self.late_frames = frames;
    }

    /// The number of the next exposure.
    pub fn next_seq(&self) -> u64 {
        self.camera.seq
    }

    /// Arms or disarms the camera.
    pub fn set_armed(&mut self, now_ns: i64, armed: bool) {
        self.advance(now_ns);
        self.camera.armed = armed;
        self.camera.next_free_ns = now_ns;
        if !armed {
            self.camera.exposures.clear();
        }
    }

    pub fn is_armed(&self) -> bool {
        self.camera.armed
    }

    /// Arrival time of the oldest pending frame at the host.
    pub fn next_frame_ns(&self) -> Option<i64> {
        self.camera.exposures.front().map(|exposure| exposure.done_ns)
    }

    /// The next frame that has arrived at the host by `now_ns`, with the light that it saw.
    pub fn take_frame(&mut self, now_ns: i64) -> Option<(Exposure, Vec<Light>)> {
        while self.next_frame_ns()? <= now_ns {
            let exposure = self.camera.exposures.pop_front()?;
            if exposure.delivered {
                let lights =
                    self.lights.iter().filter(|light| light.start_ns < exposure.done_ns).cloned().collect();
                return Some((exposure, lights));
            }
        }
        None
    }

    /// The next edge seen by the VSYNC monitor.
    pub fn take_edge(&mut self) -> Option<Edge> {
        self.seen.pop_front()
    }

    /// Changes what is shown (`None`: dark); returns the time from which the light shows it.
    pub fn show(&mut self, now_ns: i64, shown: Option<Arc<ShownOptics>>) -> i64 {
        self.advance(now_ns);
        let from_period = self.next_period + i64::from(self.config.projector.video_latency_frames);
        self.next_shown = Some((from_period, shown));
        self.nominal_ns(from_period)
    }

    /// What stands before the camera.
    pub fn subject(&self) -> Subject {
        self.subject
    }

    /// Places a subject before the camera, for exposures that are triggered from now on.
    pub fn place(&mut self, now_ns: i64, subject: Subject) {
        self.advance(now_ns);
        self.subject = subject;
    }

    /// All that is shown to exposures that are triggered from now on.
    pub fn all_shown(&self) -> Vec<Arc<ShownOptics>> {
        let lit = self.lights.iter().filter_map(|light| light.shown.as_ref());
        let next = self.next_shown.iter().filter_map(|(_, shown)| shown.as_ref());
        lit.chain(&self.shown).chain(next).cloned().collect()
    }
}
