//! One run: devices opened, passes acquired until nothing is missing, everything closed again.

use std::sync::Arc;
use std::sync::mpsc::{Receiver, channel};
use std::time::Duration;

use raysweep_core::{
    CameraCapabilities, CameraSettings, Counts, DeviceError, Pattern, Projector, SettingsId, SettingsLatency,
    Shown, VsyncStats, ns_from_us,
};
use raysweep_pipeline::{
    AssemblerConfig, CycleOrder, Pipeline, PipelineConfig, PipelineError, Point, Policy, Role,
};
use raysweep_proto::RunState;
use raysweep_session::Session;
use raysweep_session::ledger::{Entry, Ledger, State};

use super::board::Board;
use super::camera::{Attempt, CameraThread, Drive, Exposures, FilmPass, FilmSetting, Gone, Line, Pass, Work};
use super::film::{Account, CycleTiming, FilmSink, Solving, Worker};
use super::operator::Operator;
use super::orders::Orders;
use super::storage::{PaceMeter, Storage, Verdict};
use super::vsync::VsyncThread;
use crate::config::ConfigError;
use crate::film::{self, CyclePlan};
use crate::live::{LiveEstimate, Outlet};
use crate::processing::{Processing, Task, place};
use crate::response::ResponseError;
use crate::rig::{Devices, Pace, Rig, RigError};

/// So many passes in a row that bring no point end a run.
const FRUITLESS_PASSES: u32 = 8;
/// The rest after the first of them, twice as long after each: together twelve seconds, in which a disturbance may pass.
const FIRST_REST: Duration = Duration::from_millis(100);
/// Events that may wait for the assembler.
const QUEUE_EVENTS: usize = 64;
/// Units between the assembler and the disk.
const UNITS_UNDER_WAY: usize = 8;
/// The same of a film, in cycles.
const CYCLES_UNDER_WAY: usize = 4;

/// Why a run could not go to its end.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A device failed.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The rig cannot be opened.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The session cannot be written.
    #[error(transparent)]
    Session(#[from] raysweep_session::Error),
    /// The pipeline failed.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// The camera is not the one that the session was begun with.
    #[error(
        "the camera has {found:?} rows and columns, the session {expected:?}: resume it on the rig that it was begun on"
    )]
    OtherCamera {
        /// Of the camera.
        found: (usize, usize),
        /// Of the session.
        expected: (usize, usize),
    },
    /// The frames, or the calibration, of a dot rig cannot be used.
    #[error(transparent)]
    Dots(#[from] raysweep_transport::dots::DotsError),
    /// The mirror's response is not known.
    #[error(transparent)]
    Response(#[from] ResponseError),
    /// A frame cannot be read.
    #[error("{0}")]
    Frame(String),
    /// The plan makes no model on this rig.
    #[error("{0}")]
    Plan(#[from] ConfigError),
    /// Points failed again and again.
    #[error(
        "{points} points failed in {FRUITLESS_PASSES} passes in a row; frames of the last pass: {}, {interrupted} attempts interrupted. The ledger has the causes of each; mend them and resume the session",
        .counts.losses()
    )]
    Hopeless {
        /// How many.
        points: usize,
        /// Of the last pass.
        counts: Counts,
        /// Attempts of the last pass that ended before their last frame.
        interrupted: usize,
    },
    /// A thread of the run is gone; another error says which and why.
    #[error(
        "a thread of the run has ended; the log has its message. What was stored stays stored; resume the session"
    )]
    Interrupted,
    /// The run panicked: a defect.
    #[error("the run panicked: {0}. What was stored stays stored; resume the session")]
    Panicked(String),
}

/// Everything that one run needs.
pub struct Run {
    /// The rig.
    pub rig: Arc<Rig>,
    /// The plan on it.
    pub task: Arc<Task>,
    /// Its session.
    pub session: Session,
    /// Its ledger, locked for this run.
    pub ledger: Ledger,
    /// What the plan makes of the units.
    pub processing: Processing,
    /// Whether earlier runs have stored points of it.
    pub resumed: bool,
    /// What it is told.
    pub orders: Arc<Orders>,
    /// What it tells.
    pub board: Arc<Board>,
    /// Where its running estimate is shown, if anywhere.
    pub live: Option<Outlet>,
}

/// What acquisition leaves behind.
pub struct Acquired {
    /// The session.
    pub session: Session,
    /// Its ledger, still locked.
    pub ledger: Ledger,
    /// The folds, which have seen every stored point.
    pub processing: Processing,
    /// The VSYNC line.
    pub vsync: Option<VsyncStats>,
    /// When the frames that points waited for were exposed.
    pub exposures: Exposures,
    /// How late settings take effect, as a probe has found.
    pub latency: Option<SettingsLatency>,
    /// Why acquisition ended early, if a fault ended it.
    pub fault: Option<RunError>,
}

/// Turns the light off when it goes out of scope, on every way out.
struct Lit {
    projector: Box<dyn Projector>,
    /// Who works the projector, if it is a person; ends after it.
    operator: Option<Operator>,
}

impl Lit {
    /// Shows a pattern, or nothing; `None` where the run was ended while its operator was to do it.
    fn show(&mut self, pattern: Option<&Pattern>, orders: &Orders) -> Result<Option<Shown>, DeviceError> {
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

impl Drop for Lit {
    fn drop(&mut self) {
        if let Some(operator) = &self.operator {
            operator.dismiss();
        }
        match self.projector.blank() {
            Ok(_) => {}
            // As with every run: the operator has been told.
            Err(error) if self.operator.is_some() => tracing::warn!(%error, "projector not known to be dark"),
            Err(error) => tracing::error!(%error, "projector not blanked"),
        }
    }
}

impl Run {
    /// Acquires what is missing.
    ///
    /// # Errors
    /// When the run could not begin. A fault on the way is in [`Acquired::fault`]: what was acquired is kept.
    pub fn acquire(mut self) -> Result<Acquired, RunError> {
        self.ledger.append(&Entry::Run { started: jiff::Timestamp::now(), resumed: self.resumed })?;
        let Devices { camera, vsync, projector, questions, clock, pace } = self.rig.open()?;
        let operator = questions
            .map(|questions| Operator::start(questions, self.orders.clone(), self.board.clone()))
            .transpose()?;
        let projector = Lit { projector, operator };
        let assembler = self.assembler_config(camera.capabilities())?;
        let stack = self.session.stack()?;
        let state = self.ledger.state().clone();
        let mut missing = missing(&self.task, &state);
        if self.resumed {
            missing.extend(self.processing.feed_stored(&self.task, &state, &stack, &|| self.orders.go_on()));
            missing.sort_by_key(|id| id.point);
            // What is damaged is about to be mended.
            self.processing.problems.clear();
        }
        // A film is never resumed: none of its cycles is there yet.
        let cycles = if self.task.is_film() { self.task.points() } else { 0 };
        let extra = self.task.schedule.points.len() - self.task.settings().count();
        let planned = extra + self.task.points();
        let account = Arc::new(Account::new(self.task.points()));
        let cycle_plan = self.task.is_film().then(|| CyclePlan::new(&self.task, &assembler.camera));
        let film = match &cycle_plan {
            Some(cycle_plan) => Some(self.film_sink(cycle_plan, &assembler.camera, pace, &account)?),
            None => None,
        };
        let (verdicts, results) = channel();
        let stages = self.processing.stages.clone();
        let storage = Storage {
            task: self.task.clone(),
            stack,
            ledger: self.ledger,
            processing: self.processing,
            verdicts: Some(verdicts),
            orders: self.orders.clone(),
            board: self.board.clone(),
            pace: PaceMeter::new(planned - missing.len() - cycles, planned),
            film,
            vsync: None,
            // A film is its own running estimate.
            live: self.live.filter(|_| cycle_plan.is_none()).and_then(start_live),
            write_error: None,
        };
        let config = PipelineConfig {
            queue_events: QUEUE_EVENTS,
            policy: match pace {
                Pace::Pipeline => Policy::Wait,
                Pace::Devices => Policy::Fail,
            },
            // While a film's sink stores a cycle, frames of the next ones come.
            units_under_way: match &cycle_plan {
                Some(cycle_plan) => CYCLES_UNDER_WAY * cycle_plan.shots.len(),
                None => UNITS_UNDER_WAY,
            },
            worker_threads: 0,
        };
        let trigger_latency_us = assembler.camera.trigger_latency_us;
        let vsync_line = assembler.line();
        let (pipeline, input) = Pipeline::start(config, assembler, stages, storage)?;

        let board = self.board.clone();
        let vsync = VsyncThread::start(vsync, vsync_line, pace, board, input.clone(), self.orders.clone())?;
        let line = line_of(&self.task, trigger_latency_us);
        let camera = CameraThread::start(camera, Drive { clock, pace, line }, input, self.orders.clone())?;
        let _ = self.board.go(RunState::Armed);

        let mut passes = Passes {
            task: &self.task,
            camera: &camera,
            vsync: &vsync,
            projector,
            results: &results,
            orders: &self.orders,
            pace,
            trigger_latency_us,
        };
        let _ = self.board.go(RunState::Running);
        let acquired = passes
            .probe()
            .map(|()| self.board.set_settings_latency(camera.latency()))
            .and_then(|()| passes.acquire(missing))
            .and_then(|()| match &cycle_plan {
                Some(cycle_plan) if self.orders.go_on() => passes.film(cycle_plan),
                _ => Ok(()),
            });
        let _ = self.board.go(RunState::Draining);
        drop(passes);
        let latency = camera.latency();
        let imaged = camera.join();
        let watched = vsync.join();
        let mut storage = pipeline.join()?;
        if let Some(film) = storage.film.take() {
            let solved = film.finish();
            let summary = account.summary();
            storage.append(&Entry::Film(summary.clone()));
            self.board.set_film(summary);
            match solved {
                Ok(ended) => ended?,
                Err(error) => storage.note_write_error(error),
            }
        }
        // What failed first is the cause; what it brought down comes after.
        let (exposures, imaged) = match imaged {
            Ok(exposures) => (exposures, Ok(())),
            Err(error) => (Exposures::default(), Err(error)),
        };
        let device = watched.and(imaged).err().map(RunError::from);
        let fault = storage.write_error.map(RunError::from).or(device).or(acquired.err());
        Ok(Acquired {
            session: self.session,
            ledger: storage.ledger,
            processing: storage.processing,
            vsync: storage.vsync,
            exposures,
            latency,
            fault,
        })
    }

    fn film_sink(
        &self,
        cycle_plan: &CyclePlan,
        camera: &CameraCapabilities,
        pace: Pace,
        account: &Arc<Account>,
    ) -> Result<FilmSink, RunError> {
        let task = &self.task;
        let solver = task.film_solver()?;
        let transports = film::create_transports(&self.session, task, solver.reach_rows())?;
        if let Some(Err(error)) = self.live.as_ref().map(|outlet| outlet.file.clear()) {
            tracing::warn!(%error, "the live file still shows the run before");
        }
        let worker = Worker::start(Solving {
            solver,
            transports,
            live: self.live.clone(),
            board: self.board.clone(),
            account: account.clone(),
            orders: self.orders.clone(),
            pace,
        })?;
        let rolling_us = task.geometry.height.saturating_sub(1) as f64 * camera.row_time_us;
        let timing = CycleTiming {
            cycle_ns: f64::from(cycle_plan.order.cycle_periods()) * task.geometry.raster.period_us * 1e3,
            frame_ns: ns_from_us(task.plan.film.exposure_us + rolling_us),
        };
        Ok(FilmSink::new(task, self.session.film()?, worker, account.clone(), pace, timing))
    }

    fn assembler_config(&self, camera: &CameraCapabilities) -> Result<AssemblerConfig, RunError> {
        let geometry = &self.task.geometry;
        let size = (camera.height, camera.width);
        if size != (geometry.height, geometry.width) {
            return Err(RunError::OtherCamera { found: size, expected: (geometry.height, geometry.width) });
        }
        Ok(AssemblerConfig {
            camera: camera.clone(),
            raster: geometry.raster,
            first_row: geometry.first_row,
            max_jitter_us: self.task.plan.max_jitter_us(),
            edge_gate_us: self.rig.file.vsync.gate_us,
        })
    }
}

/// Starts the running estimate; a run is none the worse without.
fn start_live(outlet: Outlet) -> Option<LiveEstimate> {
    let started = outlet.file.clear().map_err(Into::into).and_then(|()| LiveEstimate::start(outlet));
    started.map_err(|error| tracing::warn!(%error, "no live estimate of this run")).ok()
}

/// The line that triggers the camera through a task's settings. Dark points have a pass of their own.
fn line_of(task: &Task, trigger_latency_us: f64) -> Line {
    let lit = task.schedule.points.iter().filter(|point| !matches!(point.role, Role::Dark(_)));
    let settings: Vec<CameraSettings> =
        lit.map(|point| task.geometry.shot(point, trigger_latency_us).settings).collect();
    Line::new(task.geometry.raster.period_us, task.plan.max_jitter_us(), &settings)
}

/// The points that the ledger does not know as stored, with the number of their next attempt; of a film those that are
/// not in its cycles.
pub fn missing(task: &Task, state: &State) -> Vec<SettingsId> {
    let in_cycles = |point: &Point| task.is_film() && matches!(point.role, Role::Sweep(_));
    (0..)
        .zip(&task.schedule.points)
        .filter(|(_, point)| !in_cycles(point))
        .filter_map(|(ordinal, point)| {
            let (array, index) = place(point.role);
            let attempt = state.next_attempt(array, index);
            state.point(array, index).is_none().then_some(SettingsId { point: ordinal, attempt })
        })
        .collect()
}

/// Passes over the missing points, until none is left.
struct Passes<'a> {
    task: &'a Task,
    camera: &'a CameraThread,
    vsync: &'a VsyncThread,
    projector: Lit,
    results: &'a Receiver<Verdict>,
    orders: &'a Orders,
    pace: Pace,
    trigger_latency_us: f64,
}

impl Passes<'_> {
    /// Finds out how late settings take effect, where there are several.
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

    fn acquire(&mut self, missing: Vec<SettingsId>) -> Result<(), RunError> {
        let mut todo: Vec<Attempt> = missing.into_iter().map(|id| self.attempt(id)).collect();
        let mut fruitless = 0;
        loop {
            let before = todo.len();
            let mut counts = Counts::default();
            let (dark, lit): (Vec<_>, Vec<_>) =
                todo.into_iter().partition(|attempt| matches!(attempt.point.role, Role::Dark(_)));
            todo = Vec::new();
            if !dark.is_empty() {
                let Some(shown) = self.projector.show(None, self.orders)? else { return Ok(()) };
                todo.extend(self.pass(dark, shown, &mut counts)?);
            }
            if !lit.is_empty() && self.orders.go_on() {
                let white = self.projector.show(Some(&Pattern::White), self.orders)?;
                let Some(shown) = white else { return Ok(()) };
                todo.extend(self.pass(lit, shown, &mut counts)?);
            }
            if todo.is_empty() || !self.orders.go_on() {
                return Ok(());
            }
            fruitless = if todo.len() < before { 0 } else { fruitless + 1 };
            if fruitless == FRUITLESS_PASSES {
                let interrupted = todo.iter().filter(|attempt| attempt.interruptions > 0).count();
                return Err(RunError::Hopeless { points: todo.len(), counts, interrupted });
            }
            if fruitless > 0 && self.pace == Pace::Devices {
                self.orders.rest(FIRST_REST * (1 << (fruitless - 1)));
            }
            // As long as nobody watches the line, no point has a chance.
            self.vsync.await_watcher(self.orders);
        }
    }

    /// Takes the film; what became of its cycles, the ledger says.
    fn film(&mut self, cycle_plan: &CyclePlan) -> Result<(), RunError> {
        let white = self.projector.show(Some(&Pattern::White), self.orders)?;
        let Some(shown) = white else { return Ok(()) };
        let points: Vec<(u32, Point)> =
            self.task.settings().map(|(ordinal, point)| (ordinal, *point)).collect();
        let CycleOrder { settings, periods } = &cycle_plan.order;
        let before = periods.iter().cycle().skip(periods.len() - 1);
        let settings = settings.iter().zip(before).map(|(&setting, &periods_from_last)| {
            let (ordinal, point) = points[setting];
            FilmSetting { ordinal, point, shot: cycle_plan.shots[setting], periods_from_last }
        });
        let film = FilmPass {
            settings: settings.collect(),
            cycles: self.task.plan.film.cycles,
            not_before_ns: shown.not_before_ns,
        };
        let acquired = self.camera.acquire(Work::Film(film)).map_err(|Gone| RunError::Interrupted)?;
        self.results.iter().find(|verdict| matches!(verdict, Verdict::Flushed));
        Ok(acquired?)
    }

    fn attempt(&self, id: SettingsId) -> Attempt {
        let point = self.task.schedule.points[id.point as usize];
        let shot = self.task.geometry.shot(&point, self.trigger_latency_us);
        Attempt { id, point, shot, interruptions: 0 }
    }

    /// Makes attempts under one picture; returns those to make next, and adds up what became of their frames.
    fn pass(
        &self,
        attempts: Vec<Attempt>,
        shown: Shown,
        counts: &mut Counts,
    ) -> Result<Vec<Attempt>, RunError> {
        let pass = Pass { attempts: attempts.clone(), not_before_ns: shown.not_before_ns };
        let acquired = self.camera.acquire(Work::Pass(pass)).map_err(|Gone| RunError::Interrupted)?;
        let mut again = Vec::new();
        // The sink closes the channel when it ends, so this waits for nothing that cannot come.
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
        acquired?;
        Ok(again)
    }
}
