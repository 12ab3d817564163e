//! Acquisition of points on the plane rig, which sweeps and films share: opens the devices, makes passes until
//! nothing is missing, and closes everything again.

pub mod advice;
pub mod foresight;
mod sink;

use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use ndarray::Array2;
use raysweep_core::{
    Camera, CameraCapabilities, CameraSettings, Clock, Counts, DeviceError, Pattern, Projector, SettingsId,
    SettingsLatency, Shown, Subject, Vsync,
};
use raysweep_drivers::projector::external::ShowRequest;
use raysweep_pipeline::{
    AssemblerConfig, Pipeline, PipelineConfig, Point, PointRole, Policy, SeenLight, Sink, Stages,
    SweepGeometry,
};
use raysweep_processing::plane::{PlaneTask, place};
use raysweep_proto::RunState;
use raysweep_session::ledger::State;
use raysweep_session::stack::ArrayName;

pub use self::sink::{PointSink, Verdict};
use crate::devices::camera::{
    Attempt, CameraThread, Drive, Exposures, FilmPass, FilmSetting, Glance, Gone, Pass, TriggerLine, Work,
};
use crate::devices::operator::{self, Operator};
use crate::devices::vsync::VsyncThread;
use crate::rig::{Devices, Pace, Rig, Stand};
use crate::run::board::StatusBoard;
use crate::run::error::RunError;
use crate::run::life::Run;
use crate::run::orders::Orders;

/// This many consecutive passes without any point end a run.
const FRUITLESS_PASSES: u32 = 8;
/// The rest after the first of these passes; it doubles each time, to twelve seconds in all, in which a disturbance
/// may pass.
const FIRST_REST: Duration = Duration::from_millis(100);
/// Frames of a glance, in darkness and with light.
const GLANCE_FRAMES: u32 = 4;
/// Capacity of the assembler's event queue.
const QUEUE_EVENTS: usize = 64;

/// Turns the light off when it goes out of scope, on every way out.
pub struct LitProjector {
    projector: Box<dyn Projector>,
    /// The operator thread, if a person operates the projector; it outlives the projector.
    operator: Option<Operator>,
}

impl LitProjector {
    /// Takes over the projector of a run, and the questions that it has for its operator, if a person operates it.
    ///
    /// # Errors
    /// When the operator's thread cannot be started.
    pub fn new(
        projector: Box<dyn Projector>,
        questions: Option<Receiver<ShowRequest>>,
        run: &Run,
    ) -> Result<Self, DeviceError> {
        let operator = questions
            .map(|questions| Operator::start(questions, run.orders.clone(), run.board.clone()))
            .transpose()?;
        Ok(Self { projector, operator })
    }

    /// Whether a person operates it.
    pub fn is_operated(&self) -> bool {
        self.operator.is_some()
    }

    /// Shows a pattern, or nothing; `None` if the run was ended while waiting for the operator.
    ///
    /// # Errors
    /// When the projector cannot show it.
    pub fn show(&mut self, pattern: Option<&Pattern>, orders: &Orders) -> Result<Option<Shown>, DeviceError> {
        let shown = match pattern {
            Some(pattern) => self.projector.show(pattern),
            None => self.projector.blank(),
        };
        match shown {
            Err(_) if self.operator.is_some() && !orders.go_on() => Ok(None),
            shown => shown.map(Some),
        }
    }
}

impl Drop for LitProjector {
    fn drop(&mut self) {
        if let Some(operator) = &self.operator {
            operator.dismiss();
        }
        match self.projector.blank() {
            Ok(_) => {}
            // As after every run: the operator has been told.
            Err(error) if self.operator.is_some() => tracing::warn!(%error, "projector not known to be dark"),
            Err(error) => tracing::error!(%error, "projector not blanked"),
        }
    }
}

/// The devices of a rig, opened for a run.
pub struct Opened {
    task: Arc<PlaneTask>,
    camera: Box<dyn Camera>,
    vsync: Box<dyn Vsync>,
    projector: LitProjector,
    stand: Stand,
    clock: Clock,
    assembler: AssemblerConfig,
    orders: Arc<Orders>,
    board: Arc<StatusBoard>,
    /// Whether the devices or the pipeline set the pace.
    pub pace: Pace,
    /// Whether the run looks for light before anything else, if it has a regular image.
    pub looks_first: bool,
}

/// Result of acquisition.
pub struct Taken<S> {
    /// The pipeline's sink, which has received everything.
    pub sink: S,
    /// When the frames that points waited for were exposed.
    pub exposures: Exposures,
    /// The settings latency that a probe measured.
    pub latency: Option<SettingsLatency>,
    /// The device error that ended acquisition early, if any.
    pub fault: Option<RunError>,
}

impl Opened {
    /// Opens all devices.
    ///
    /// # Errors
    /// The first device that cannot be opened; a camera whose size differs from the task's.
    pub fn open(rig: &Rig, task: &Arc<PlaneTask>, run: &Run) -> Result<Self, RunError> {
        let Devices { camera, vsync, projector, questions, stand, clock, pace } =
            run.probes.instead_of(rig.open()?);
        let projector = LitProjector::new(projector, questions, run)?;
        let (geometry, capabilities) = (&task.geometry, camera.capabilities());
        let (found, expected) =
            ((capabilities.height, capabilities.width), (geometry.height, geometry.width));
        if found != expected {
            return Err(RunError::OtherCamera { found, expected });
        }
        let assembler = AssemblerConfig {
            camera: capabilities.clone(),
            raster: geometry.raster,
            first_row: geometry.first_row,
            max_jitter_us: task.max_jitter_us,
            saturation_dn: geometry.saturation_dn,
            edge_gate_us: rig.file.vsync.gate_us,
        };
        let (task, orders, board) = (task.clone(), run.orders.clone(), run.board.clone());
        let looks_first = false;
        Ok(Self { task, camera, vsync, projector, stand, clock, assembler, orders, board, pace, looks_first })
    }

    /// Capabilities of the camera.
    pub fn camera(&self) -> &CameraCapabilities {
        &self.assembler.camera
    }

    /// Runs the threads of devices and pipeline while `points` makes passes. Units go through `stages` into `sink`,
    /// at most the given number of them at a time; `results` is the other end of the sink's verdicts.
    ///
    /// # Errors
    /// When a thread cannot be started, or the pipeline fails.
    pub fn acquire<S: Sink + 'static>(
        self,
        stages: Stages,
        units_under_way: usize,
        sink: S,
        results: &Receiver<Verdict>,
        points: impl FnOnce(&mut Passes<'_>) -> Result<(), RunError>,
    ) -> Result<Taken<S>, RunError> {
        let Self {
            task,
            camera,
            vsync,
            projector,
            stand,
            clock,
            assembler,
            orders,
            board,
            pace,
            looks_first,
        } = self;
        let config = PipelineConfig {
            queue_events: QUEUE_EVENTS,
            policy: match pace {
                Pace::Pipeline => Policy::Wait,
                Pace::Devices => Policy::Fail,
            },
            units_under_way,
            worker_threads: 0,
        };
        let trigger_latency_us = assembler.camera.trigger_latency_us;
        let vsync_line = assembler.line();
        let (pipeline, input) = Pipeline::start(config, assembler, stages, sink)?;
        let vsync =
            VsyncThread::start(vsync, vsync_line, pace, board.clone(), input.clone(), orders.clone())?;
        let line = line_of(&task, trigger_latency_us);
        let camera = CameraThread::start(camera, Drive { clock, pace, line }, input, orders.clone())?;
        let _ = board.go(RunState::Armed);
        let mut passes = Passes {
            task: &task,
            camera: &camera,
            vsync: &vsync,
            projector,
            stand: &stand,
            results,
            orders: &orders,
            board: &board,
            pace,
            trigger_latency_us,
        };
        let _ = board.go(RunState::Running);
        let looked = if looks_first { passes.look_for_light() } else { Ok(()) };
        let acquired = looked
            .and_then(|()| passes.probe())
            .map(|()| board.set_settings_latency(camera.latency()))
            .and_then(|()| points(&mut passes));
        let _ = board.go(RunState::Draining);
        drop(passes);
        let latency = camera.latency();
        let imaged = camera.join();
        let watched = vsync.join();
        let sink = pipeline.join()?;
        // The first failure is the cause; the others are consequences.
        let (exposures, imaged) = match imaged {
            Ok(exposures) => (exposures, Ok(())),
            Err(error) => (Exposures::default(), Err(error)),
        };
        let device = watched.and(imaged).err().map(RunError::from);
        Ok(Taken { sink, exposures, latency, fault: device.or(acquired.err()) })
    }
}

/// The line that triggers the camera through a task's settings. Dark points have their own pass.
fn line_of(task: &PlaneTask, trigger_latency_us: f64) -> TriggerLine {
    let points = &task.schedule.points;
    let is_lit = |point: &&Point| !matches!(point.role, PointRole::Dark(_));
    let all_dark = !points.iter().any(|point| is_lit(&point));
    let settings: Vec<CameraSettings> = points
        .iter()
        .filter(|point| all_dark || is_lit(point))
        .map(|point| task.geometry.shot(point, trigger_latency_us).settings)
        .collect();
    TriggerLine::new(task.geometry.raster.period_us, task.max_jitter_us, &settings)
}

/// The points of a task that the ledger does not list as stored, with the number of their next attempt.
pub fn missing(task: &PlaneTask, state: &State) -> Vec<SettingsId> {
    (0..)
        .zip(&task.schedule.points)
        .filter_map(|(ordinal, point)| {
            let (array, index) = place(point.role);
            let attempt = state.next_attempt(array, index);
            state.point(array, index).is_none().then_some(SettingsId { point: ordinal, attempt })
        })
        .collect()
}

/// The regular image, if it is stored and lit points are missing: a resumed run takes it again before them, only to see
/// whether there is light, because they may be points that see none.
pub fn regular_again(task: &PlaneTask, missing: &[SettingsId], state: &State) -> Option<SettingsId> {
    let points = &task.schedule.points;
    let regular = points.iter().position(|point| point.role == PointRole::Regular)? as u32;
    let is_missing = missing.iter().any(|id| id.point == regular);
    let attempt = state.next_attempt(ArrayName::Regular, 0);
    (!is_missing && is_any_lit(task, missing)).then_some(SettingsId { point: regular, attempt })
}

/// Whether any of these points is taken with light.
pub fn is_any_lit(task: &PlaneTask, points: &[SettingsId]) -> bool {
    let role = |id: &SettingsId| task.schedule.points[id.point as usize].role;
    points.iter().any(|id| !matches!(role(id), PointRole::Dark(_)))
}

/// Makes passes over the points while the devices' threads run.
pub struct Passes<'a> {
    task: &'a PlaneTask,
    camera: &'a CameraThread,
    vsync: &'a VsyncThread,
    projector: LitProjector,
    stand: &'a Stand,
    results: &'a Receiver<Verdict>,
    orders: &'a Orders,
    board: &'a StatusBoard,
    pace: Pace,
    trigger_latency_us: f64,
}

impl Passes<'_> {
    /// Compares a few frames with light with as many in darkness, by the regular image's settings, so that a run that
    /// would measure nothing ends before its dark images. What so few frames cannot tell is left to the regular image.
    /// A person who works the projector is not asked for it.
    fn look_for_light(&mut self) -> Result<(), RunError> {
        let regular = self.task.schedule.points.iter().find(|point| point.role == PointRole::Regular);
        let Some(regular) = regular.copied().filter(|_| !self.projector.is_operated()) else {
            return Ok(());
        };
        let Some(dark) = self.glance(None, &regular)? else { return Ok(()) };
        let Some(lit) = self.glance(Some(&Pattern::White), &regular)? else { return Ok(()) };
        self.projector.show(None, self.orders)?;
        let SweepGeometry { white_dn, saturation_dn, .. } = self.task.geometry;
        match SeenLight::between(lit.view(), dark.view(), white_dn, saturation_dn) {
            Some(none) if none.is_surely_none() => Err(RunError::no_regular_light(none)),
            _ => Ok(()),
        }
    }

    /// The mean of a few frames, in counts; `None` if the run is told to end.
    fn glance(&mut self, pattern: Option<&Pattern>, point: &Point) -> Result<Option<Array2<f32>>, RunError> {
        let Some(shown) = self.projector.show(pattern, self.orders)? else { return Ok(None) };
        let settings = self.task.geometry.shot(point, self.trigger_latency_us).settings;
        let (seen, sums) = channel();
        let glance = Glance { settings, not_before_ns: shown.not_before_ns, frames: GLANCE_FRAMES, seen };
        let glanced = self.camera.acquire(Work::Glance(glance)).map_err(|Gone| RunError::Interrupted)?;
        self.results.iter().find(|verdict| matches!(verdict, Verdict::Flushed));
        glanced?;
        let size = (self.task.geometry.height, self.task.geometry.width);
        let mean = |sum: u32| sum as f32 / GLANCE_FRAMES as f32;
        let image = sums.try_recv().ok().and_then(|sums| Array2::from_shape_vec(size, sums).ok());
        Ok(image.map(|sums| sums.mapv(mean)))
    }

    /// Measures the settings latency, if the task has several settings.
    fn probe(&self) -> Result<(), RunError> {
        let mut settings = self.task.settings().map(|(_, point)| *point);
        let Some(first) = settings.next().filter(|_| settings.next().is_some() && self.orders.go_on()) else {
            return Ok(());
        };
        let shot = self.task.geometry.shot(&first, self.trigger_latency_us);
        let probed = self.camera.acquire(Work::Probe(shot.settings)).map_err(|Gone| RunError::Interrupted)?;
        self.results.iter().find(|verdict| matches!(verdict, Verdict::Flushed));
        Ok(probed?)
    }

    /// Acquires points until none is missing or the run is told to end: dark ones without light, then the others under
    /// white.
    ///
    /// # Errors
    /// When a device fails, or points fail repeatedly.
    pub fn acquire(&mut self, missing: Vec<SettingsId>) -> Result<(), RunError> {
        let todo = missing.into_iter().map(|id| self.attempt(id)).collect();
        self.until_none_is_missing(todo, |passes, todo, counts| {
            let (dark, lit): (Vec<_>, Vec<_>) =
                todo.into_iter().partition(|attempt| matches!(attempt.point.role, PointRole::Dark(_)));
            let mut again = Vec::new();
            for (attempts, pattern) in [(dark, None), (lit, Some(&Pattern::White))] {
                if !attempts.is_empty() && passes.orders.go_on() {
                    let Some(failed) = passes.pass(attempts, pattern, counts)? else { return Ok(None) };
                    again.extend(failed);
                }
            }
            Ok(Some(again))
        })
    }

    /// Acquires points with one picture (`None`: no light) until none is missing or the run is told to end.
    ///
    /// # Errors
    /// When a device fails, or points fail repeatedly.
    pub fn acquire_under(
        &mut self,
        pattern: Option<&Pattern>,
        attempts: Vec<Attempt>,
    ) -> Result<(), RunError> {
        self.until_none_is_missing(attempts, |passes, todo, counts| passes.pass(todo, pattern, counts))
    }

    /// Acquires points under several pictures until none is missing or the run is told to end: picture after picture,
    /// each shown once, unless points under it have to be taken again. `picture` tells what a point is taken under
    /// (`None`: no light).
    ///
    /// # Errors
    /// When a device fails, or points fail repeatedly.
    pub fn acquire_under_each<'p>(
        &mut self,
        attempts: Vec<Attempt>,
        picture: impl Fn(&Attempt) -> Option<&'p Pattern>,
    ) -> Result<(), RunError> {
        self.until_none_is_missing(attempts, |passes, todo, counts| {
            let mut is_over = false;
            let mut acquired = Ok(());
            for group in todo.chunk_by(|a, b| picture(a) == picture(b)) {
                let shown = match passes.orders.go_on() {
                    true => passes.projector.show(picture(&group[0]), passes.orders),
                    false => Ok(None),
                };
                let not_before_ns = match shown {
                    Ok(Some(Shown { not_before_ns })) => not_before_ns,
                    Ok(None) => {
                        is_over = true;
                        break;
                    }
                    Err(error) => {
                        acquired = Err(error);
                        break;
                    }
                };
                let pass = Pass { attempts: group.to_vec(), not_before_ns };
                let done = passes.camera.acquire(Work::PassOn(pass)).map_err(|Gone| RunError::Interrupted)?;
                if let Err(error) = done {
                    acquired = Err(error);
                    break;
                }
            }
            // Whatever happened, the points so far are decided and counted.
            let settled = passes.camera.acquire(Work::Settle).map_err(|Gone| RunError::Interrupted)?;
            let again = passes.failed(&todo, counts);
            acquired.and(settled)?;
            Ok((!is_over).then_some(again))
        })
    }

    /// Places a subject in front of the camera; waits for the operator if needed.
    ///
    /// # Errors
    /// When the rig does not have the subject.
    pub fn place(&self, subject: Subject) -> Result<(), RunError> {
        Ok(operator::place(self.stand, subject, 0, self.orders, self.board)?)
    }

    /// Makes `round`s of the attempts that are still to be made, until none is left or the run is told to end. A round
    /// returns those to be made again, or `None` if the run was ended.
    fn until_none_is_missing(
        &mut self,
        mut todo: Vec<Attempt>,
        mut round: impl FnMut(&mut Self, Vec<Attempt>, &mut Counts) -> Result<Option<Vec<Attempt>>, RunError>,
    ) -> Result<(), RunError> {
        let mut fruitless = 0;
        loop {
            let before = todo.len();
            let mut counts = Counts::default();
            let Some(again) = round(self, todo, &mut counts)? else { return Ok(()) };
            todo = again;
            if todo.is_empty() || !self.orders.go_on() {
                return Ok(());
            }
            fruitless = if todo.len() < before { 0 } else { fruitless + 1 };
            if fruitless == FRUITLESS_PASSES {
                let interrupted = todo.iter().filter(|attempt| attempt.interruptions > 0).count();
                let (points, passes) = (todo.len(), FRUITLESS_PASSES);
                return Err(RunError::Hopeless { points, passes, counts, interrupted });
            }
            if fruitless > 0 && self.pace == Pace::Devices {
                self.orders.rest(FIRST_REST * (1 << (fruitless - 1)));
            }
            // No point can succeed while the line is not watched.
            self.vsync.await_watcher(self.orders);
        }
    }

    /// An attempt at a point of the schedule, or at one that takes its place.
    pub fn attempt_at(&self, id: SettingsId, point: Point) -> Attempt {
        let shot = self.task.geometry.shot(&point, self.trigger_latency_us);
        Attempt { id, point, shot, interruptions: 0 }
    }

    fn attempt(&self, id: SettingsId) -> Attempt {
        self.attempt_at(id, self.task.schedule.points[id.point as usize])
    }

    /// Takes a film with the camera, under white light.
    ///
    /// # Errors
    /// When a device fails.
    pub fn film(&mut self, settings: Vec<FilmSetting>, cycles: u32) -> Result<(), RunError> {
        let white = self.projector.show(Some(&Pattern::White), self.orders)?;
        let Some(shown) = white else { return Ok(()) };
        let film = FilmPass { settings, cycles, not_before_ns: shown.not_before_ns };
        let acquired = self.camera.acquire(Work::Film(film)).map_err(|Gone| RunError::Interrupted)?;
        self.results.iter().find(|verdict| matches!(verdict, Verdict::Flushed));
        Ok(acquired?)
    }

    /// Whether the run continues.
    pub fn go_on(&self) -> bool {
        self.orders.go_on()
    }

    /// Makes attempts with one picture (`None`: no light); returns the next attempts, or `None` if the run was ended
    /// while waiting for the operator. Adds up the frame counts.
    fn pass(
        &mut self,
        attempts: Vec<Attempt>,
        pattern: Option<&Pattern>,
        counts: &mut Counts,
    ) -> Result<Option<Vec<Attempt>>, RunError> {
        let Some(shown) = self.projector.show(pattern, self.orders)? else { return Ok(None) };
        let not_before_ns = shown.not_before_ns;
        let pass = Pass { attempts: attempts.clone(), not_before_ns };
        let acquired = self.camera.acquire(Work::Pass(pass)).map_err(|Gone| RunError::Interrupted)?;
        let again = self.failed(&attempts, counts);
        acquired?;
        Ok(Some(again))
    }

    /// The next attempts after those that failed, once all are decided. Adds up the frame counts.
    fn failed(&self, attempts: &[Attempt], counts: &mut Counts) -> Vec<Attempt> {
        let mut again = Vec::new();
        // The sink closes the channel when it ends, so this cannot wait forever.
        for verdict in self.results {
            match verdict {
                Verdict::Failed(id, failure, of_attempt) => {
                    let failed = attempts.iter().filter(|attempt| attempt.id == id);
                    again.extend(failed.map(|attempt| attempt.after(failure)));
                    counts.add(&of_attempt);
                }
                Verdict::Flushed => break,
            }
        }
        again
    }
}
