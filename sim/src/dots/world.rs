//! State shared by camera and mirror: the playing path, the subject in front of the camera, and the next frame.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

use raysweep_core::{Clock, DeviceError, MirrorPath, Subject, ns_from_us};

use super::bench::Bench;
use super::scan::{Lit, MirrorScan};
use super::scene::{SpotImages, Still};
use crate::keyed::{Purpose, keyed, uniform};
use crate::subject::not_there;

/// Frames that a camera in real time buffers for a slow host.
const CAMERA_BUFFERS: u64 = 64;

/// Light of the diffuser relative to a white plane: its lamp is dimmed to suit the exposure.
const DIFFUSER_LIGHT: f32 = 0.6;

/// Light of a subject that is uniform over all pixels, independent of the mirror; `None` for other subjects.
pub(super) fn even_light(subject: Subject) -> Option<f32> {
    (subject == Subject::Diffuser).then_some(DIFFUSER_LIGHT)
}

/// What happened to a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameFate {
    /// Delivered once.
    Delivered,
    /// Exposed, but never delivered.
    Dropped,
    /// Delivered twice.
    Duplicated,
    /// Delivered once, with every pixel overexposed.
    Saturated,
}

/// Ground truth of a frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FrameTruth {
    /// Number of paths started before the one that the frame belongs to.
    pub scan: u64,
    /// Its batch in that path, from 0.
    pub batch: u64,
    /// Its index in the batch, from 0.
    pub index: u64,
    /// Subject in front of the camera.
    pub subject: Subject,
    /// What happened to it.
    pub fate: FrameFate,
}

/// Access to the ground truth behind the devices, for tests only.
#[derive(Clone)]
pub struct DotsTruth(Arc<World>);

impl DotsTruth {
    pub(super) fn new(world: Arc<World>) -> Self {
        Self(world)
    }

    /// The frame with this id; `None` if it has not been triggered yet.
    pub fn frame(&self, seq: u64) -> Option<FrameTruth> {
        let state = self.0.lock();
        let (record, frame) = state.record_of(seq)?;
        let (batch, index) = record.scan.dot_of(frame);
        let fate = self.0.fate(record.number, frame);
        Some(FrameTruth { scan: record.number, batch, index, subject: record.subject, fate })
    }

    /// Noise-free light of a frame at an exposure of `exposure_us`, `[row, column]` row-major without the margin,
    /// relative to a white plane in `camera.white_exposure_us`: direct light, and all other light. For scenes from
    /// files, the first is all light.
    pub fn light(&self, seq: u64, exposure_us: f64) -> Option<(Vec<f32>, Vec<f32>)> {
        let (mut scan, still, frame) = {
            let state = self.0.lock();
            let (record, frame) = state.record_of(seq)?;
            if let Some(even) = even_light(record.subject) {
                let SpotImages { direct, mut global } = self.0.dark();
                global.fill(even);
                return Some((direct, global));
            }
            let (batch, _) = record.scan.dot_of(frame);
            (
                record.scan.clone(),
                self.0.still(record.subject, record.scan.rate_hz(), &record.scan, batch),
                frame,
            )
        };
        let lit = scan.exposure(frame, exposure_us);
        let mut light = self.0.dark();
        self.0.render(&lit, exposure_us, &*still, &mut light);
        Some((light.direct, light.global))
    }

    /// Number of frame ids used so far.
    pub fn frames(&self) -> u64 {
        self.0.lock().next_seq
    }
}

/// The running rig.
pub struct World {
    pub bench: Arc<Bench>,
    pub frame_rate_hz: f64,
    pub clock: Clock,
    by_the_clock: bool,
    state: Mutex<State>,
}

struct State {
    subject: Subject,
    /// All paths so far; the last is the one that is playing or was played last.
    records: Vec<Record>,
    armed: bool,
    next_seq: u64,
    /// Number of the next frame within the last path.
    next_frame: u64,
}

/// A path that was started.
struct Record {
    number: u64,
    scan: MirrorScan,
    subject: Subject,
    /// Time of its first sample; `None` until the mirror's driver knows it.
    start_ns: Option<i64>,
    /// End of the path in samples, earlier if it was interrupted.
    end: f64,
    /// Id and number of the first frame taken by the camera.
    first: Option<(u64, u64)>,
}

/// The camera's next event.
pub enum Next {
    /// A frame that has been exposed.
    Frame(Due),
    /// A frame at this time.
    At(i64),
    /// No frame until another path is started.
    Nothing,
}

/// An exposed frame.
pub struct Due {
    pub seq: u64,
    pub start_ns: i64,
    pub done_ns: i64,
    /// Noise key: path and number of the frame in it.
    pub key: [u64; 2],
    pub batch: u64,
    pub lit: Vec<Lit>,
    pub fate: FrameFate,
    pub subject: Subject,
}

impl State {
    fn record_of(&self, seq: u64) -> Option<(&Record, u64)> {
        let (record, (first_seq, first_frame)) = self
            .records
            .iter()
            .rev()
            .find_map(|record| Some((record, record.first.filter(|first| first.0 <= seq)?)))?;
        let frame = first_frame + (seq - first_seq);
        (seq < self.next_seq).then_some((record, frame))
    }
}

impl Record {
    fn time_ns(&self, start_ns: i64, moment: f64) -> i64 {
        start_ns + (moment / self.scan.rate_hz() * 1e9).round() as i64
    }
}

impl World {
    pub fn new(bench: Arc<Bench>, frame_rate_hz: f64, clock: Clock, by_the_clock: bool) -> Arc<Self> {
        let state =
            State { subject: Subject::Scene, records: Vec::new(), armed: false, next_seq: 0, next_frame: 0 };
        Arc::new(Self { bench, frame_rate_hz, clock, by_the_clock, state: Mutex::new(state) })
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        // A panic in a device ends only that device's thread; the state is never left half changed.
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Places a subject in front of the camera. A path keeps the subject that was in place when it began.
    ///
    /// # Errors
    /// `OutOfRange` for a subject that does not exist on this rig.
    pub fn place(&self, subject: Subject) -> Result<(), DeviceError> {
        let planes = self.bench.scene.planes();
        match subject {
            Subject::Plane(number) if number >= planes => {
                let what = format!(
                    "plane {number}: the simulated rig has {planes}, counted from 0; see sim.dots.plane_depths"
                );
                return Err(not_there(what));
            }
            Subject::Board | Subject::SecondBoard | Subject::Cap => {
                let what = format!("{subject}: a dot rig has the scene, planes and a diffuser");
                return Err(not_there(what));
            }
            Subject::Scene | Subject::Plane(_) | Subject::Diffuser => {}
        }
        self.lock().subject = subject;
        Ok(())
    }

    /// Starts a path whose first sample is played at `start_ns`, if already known.
    pub fn start(&self, path: MirrorPath, batches: u32, start_ns: Option<i64>) {
        let mut state = self.lock();
        let begins_s = state.records.iter().map(|record| record.scan.planned_s()).sum();
        let scan = MirrorScan::new(
            path,
            batches,
            self.frame_rate_hz,
            self.bench.setup.incidence,
            begins_s,
            &self.bench.config,
        );
        let (number, subject) = (state.records.len() as u64, state.subject);
        let end = scan.samples() as f64;
        state.records.push(Record { number, scan, subject, start_ns, end, first: None });
        state.next_frame = u64::from(self.bench.config.camera.late_frames);
    }

    /// Sets the time at which the path's first sample was played, unless it is known already.
    pub fn started(&self, start_ns: i64) {
        if let Some(record) = self.lock().records.last_mut() {
            record.start_ns.get_or_insert(start_ns);
        }
    }

    /// Sample rate of the path.
    pub fn rate_hz(&self) -> f64 {
        self.lock().records.last().map_or(1.0, |record| record.scan.rate_hz())
    }

    /// The id of the next frame.
    pub fn next_seq(&self) -> u64 {
        self.lock().next_seq
    }

    /// Switches the light off and ends the triggers.
    pub fn stop(&self) {
        let now_ns = self.clock.now_ns();
        if let Some(record) = self.lock().records.last_mut() {
            let played = record
                .start_ns
                .map_or(0.0, |start_ns| (now_ns - start_ns) as f64 * 1e-9 * record.scan.rate_hz());
            record.end = record.end.min(played.max(0.0));
        }
    }

    /// Number of samples played, and total number of samples in the path.
    pub fn played(&self) -> (u64, u64) {
        let now_ns = self.clock.now_ns();
        let state = self.lock();
        let Some(record) = state.records.last() else { return (0, 0) };
        let total = record.scan.samples();
        let start_ns = record.start_ns.unwrap_or(now_ns);
        let played = (now_ns - start_ns) as f64 * 1e-9 * record.scan.rate_hz();
        ((played.max(0.0) as u64).min(total), total)
    }

    pub fn is_armed(&self) -> bool {
        self.lock().armed
    }

    /// Sets whether the camera responds to triggers.
    pub fn set_armed(&self, armed: bool) {
        let now_ns = self.clock.now_ns();
        let mut state = self.lock();
        if armed && !state.armed {
            // Skip triggers that have already passed.
            let gone = state.records.last().and_then(|record| {
                let moment = (now_ns - record.start_ns?) as f64 * 1e-9 * record.scan.rate_hz();
                Some((moment / record.scan.trigger(1)).ceil().max(0.0) as u64)
            });
            state.next_frame = state.next_frame.max(gone.unwrap_or(0));
        }
        state.armed = armed;
    }

    /// The camera's next event at `now_ns`.
    pub fn next(&self, now_ns: i64, exposure_us: f64) -> Next {
        let mut state = self.lock();
        let State { records, next_seq, next_frame, .. } = &mut *state;
        let Some(record) = records.last_mut() else { return Next::Nothing };
        let Some(start_ns) = record.start_ns else { return Next::Nothing };
        let done_ns = |record: &Record, frame| {
            record.time_ns(start_ns, record.scan.trigger(frame)) + ns_from_us(exposure_us)
        };
        let last = record.scan.frames();
        if self.by_the_clock {
            let frame_ns = Bench::frame_ns(self.frame_rate_hz);
            let late = (now_ns - done_ns(record, *next_frame)) / frame_ns;
            let lost = u64::try_from(late).unwrap_or(0).saturating_sub(CAMERA_BUFFERS);
            let lost = lost.min(last.saturating_sub(*next_frame));
            record.first.get_or_insert((*next_seq, *next_frame));
            *next_frame += lost;
            *next_seq += lost;
        }
        loop {
            let frame = *next_frame;
            if frame >= last || record.scan.trigger(frame) >= record.end {
                return Next::Nothing;
            }
            let done_ns = done_ns(record, frame);
            if done_ns > now_ns {
                return Next::At(done_ns);
            }
            record.first.get_or_insert((*next_seq, frame));
            let seq = *next_seq;
            *next_seq += 1;
            *next_frame += 1;
            let fate = self.fate(record.number, frame);
            if fate != FrameFate::Dropped {
                return Next::Frame(Due {
                    seq,
                    start_ns: record.time_ns(start_ns, record.scan.trigger(frame)),
                    done_ns,
                    key: [record.number, frame],
                    batch: record.scan.dot_of(frame).0,
                    lit: record.scan.exposure(frame, exposure_us),
                    fate,
                    subject: record.subject,
                });
            }
        }
    }

    fn fate(&self, scan: u64, frame: u64) -> FrameFate {
        let camera = &self.bench.config.camera;
        let mut random = keyed(self.bench.config.seed, Purpose::DotFrame, &[scan, frame]);
        if uniform(&mut random) < camera.dropped {
            FrameFate::Dropped
        } else if uniform(&mut random) < camera.duplicated {
            FrameFate::Duplicated
        } else if uniform(&mut random) < camera.saturated {
            FrameFate::Saturated
        } else {
            FrameFate::Delivered
        }
    }

    /// What is in front of the camera during a batch of the playing path.
    pub fn still_in(&self, subject: Subject, batch: u64) -> Option<Arc<dyn Still>> {
        let state = self.lock();
        let record = state.records.last()?;
        Some(self.still(subject, record.scan.rate_hz(), &record.scan, batch))
    }

    fn still(&self, subject: Subject, rate_hz: f64, scan: &MirrorScan, batch: u64) -> Arc<dyn Still> {
        let plane = match subject {
            Subject::Plane(number) => self.bench.scene.plane(number),
            Subject::Scene | Subject::Diffuser | Subject::Board | Subject::SecondBoard | Subject::Cap => None,
        };
        plane.unwrap_or_else(|| {
            let seconds = (batch * scan.samples_per_batch()) as f64 / rate_hz;
            let phase = seconds / self.bench.config.motion_period_s;
            self.bench.scene.at((std::f64::consts::TAU * phase).sin())
        })
    }

    /// Dark images of the scene's size.
    pub fn dark(&self) -> SpotImages {
        let (rows, columns) = self.bench.scene.view().size;
        SpotImages { direct: vec![0.0; rows * columns], global: vec![0.0; rows * columns] }
    }

    /// Adds the light of an exposure to `light`; returns how much fell on the trailing dot's plane. Light
    /// without fine detail is computed once, for the exposure's mean position.
    pub fn render(&self, lit: &[Lit], exposure_us: f64, still: &dyn Still, light: &mut SpotImages) -> f64 {
        let dot = &self.bench.config.dot;
        let share = self.bench.exposed(exposure_us) / lit.len() as f64;
        let (mut trailing, mut on_scene, mut middle) = (0.0, 0.0, [0.0; 2]);
        for lit in lit {
            match *lit {
                Lit::Nowhere => {}
                Lit::Trailing(part) => trailing += part * share,
                Lit::Scene(centre, part) => {
                    let part = part * share;
                    still.add_direct(&self.bench.beam.spot(centre, part), &mut light.direct);
                    on_scene += part;
                    (0..2).for_each(|axis| middle[axis] += part * centre[axis]);
                }
            }
        }
        if on_scene > 0.0 {
            let middle = middle.map(|sum| sum / on_scene);
            still.add_global(&self.bench.beam.spot(middle, on_scene), &mut light.global);
            if dot.ghost > 0.0 {
                let beside = [0, 1].map(|axis| middle[axis] + dot.ghost_deg[axis].to_radians().tan());
                let ghost = self.bench.beam.spot(beside, on_scene * dot.ghost);
                still.add_direct(&ghost, &mut light.global);
            }
        }
        trailing
    }
}
