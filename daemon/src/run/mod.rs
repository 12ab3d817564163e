//! Runs: from a plan to a session, one at a time.

mod board;
mod camera;
mod conclude;
mod dots;
mod engine;
mod film;
mod operator;
mod orders;
pub(crate) mod priority;
mod response;
mod storage;
mod vsync;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};

use raysweep_core::CameraCapabilities;
use raysweep_pipeline::Registry;
use raysweep_proto::{
    CheckReport, ErrorCode, Event, ResumeParams, RpcError, RunParams, RunState, SessionInfo, Started, Status,
};
use raysweep_session::Session;
use raysweep_session::ledger::{Ledger, SessionEntry};
use raysweep_session::stack::StackShape;
use tokio::sync::broadcast;

pub(crate) use self::board::Board;
use self::board::WrongState;
use self::conclude::{conduct, conduct_batches};
use self::dots::DotRun;
pub(crate) use self::dots::{FRAMES_AT_WORK, frames_waiting};
use self::engine::Run;
use self::orders::{Order, Orders};
use self::response::is_response;
use crate::advice;
use crate::check;
use crate::config::{ConfigError, Plan, PlanKind};
use crate::control::Control;
use crate::dots::{self as dot_rig, DotTask};
use crate::live::{LiveFile, Outlet};
use crate::memory::{MemoryNeed, available_bytes};
use crate::mirror;
use crate::processing::Task;
use crate::results;
use crate::rig::{AnyRig, DotRig, Rig, RigError};

/// At which rate a dot rig's camera is opened to see that it is there; each run opens it at its own.
const LEAST_FRAME_RATE_HZ: f64 = 100.0;

/// The daemon's core: a rig, a data folder, and at most one run.
pub struct Runner {
    rig: Bench,
    /// The rig's camera, as it was when the daemon began.
    camera: CameraCapabilities,
    data: PathBuf,
    registry: Arc<Registry>,
    board: Arc<Board>,
    live: Option<Arc<LiveFile>>,
    memory_limit_bytes: Option<u64>,
    current: Mutex<Option<Current>>,
    /// Set once, when no further run may begin.
    closed: AtomicBool,
}

/// The daemon's rig.
#[derive(Clone)]
enum Bench {
    Plane(Arc<Rig>),
    Dots(Arc<DotRig>),
}

/// The run under way, or the last one.
struct Current {
    orders: Arc<Orders>,
    thread: JoinHandle<()>,
}

/// What of a session a new run starts from.
struct Prepared {
    task: Arc<Task>,
    session: Session,
    ledger: Ledger,
    plan_text: String,
    resumed: bool,
}

impl Runner {
    /// A daemon for `rig` that keeps its sessions in `data`. Opens all devices once, to know that they are there; each
    /// run opens them anew, and between runs they are free for other programs.
    ///
    /// # Errors
    /// The first device that does not open.
    pub fn new(rig: impl Into<AnyRig>, data: PathBuf, registry: Registry) -> Result<Self, RigError> {
        let (rig, camera, kind) = match rig.into() {
            AnyRig::Plane(rig) => {
                let camera = rig.open()?.camera.capabilities().clone();
                (Bench::Plane(Arc::new(rig)), camera, "plane")
            }
            AnyRig::Dots(rig) => {
                let camera = rig.open(&data, LEAST_FRAME_RATE_HZ)?.camera.capabilities().clone();
                (Bench::Dots(Arc::new(rig)), camera, "dots")
            }
        };
        Ok(Self {
            rig,
            camera,
            data,
            registry: Arc::new(registry),
            board: Arc::new(Board::new(kind)),
            live: None,
            memory_limit_bytes: None,
            current: Mutex::default(),
            closed: AtomicBool::new(false),
        })
    }

    /// The same, with a file for the running estimates of its runs.
    #[must_use]
    pub fn with_live(mut self, file: LiveFile) -> Self {
        self.board.set_live(file.path().to_owned());
        self.live = Some(Arc::new(file));
        self
    }

    /// The same; results that would take more memory than this are made some camera rows at a time. Without, that is
    /// what is free when a run begins.
    #[must_use]
    pub fn with_memory_limit(mut self, bytes: u64) -> Self {
        self.memory_limit_bytes = Some(bytes);
        self
    }

    /// The rig's camera.
    pub fn camera(&self) -> &CameraCapabilities {
        &self.camera
    }

    /// A plan of batches on this rig, and what it would do.
    fn foresee_batches(&self, rig: &DotRig, plan: &str) -> Result<(DotTask, CheckReport), RpcError> {
        let foreseen = || {
            let size = (self.camera.height, self.camera.width);
            let parsed = Plan::parse(plan)?;
            let task = DotTask::new(parsed, plan, &rig.file, self.camera.format, size, &self.data)?;
            let camera = self.camera_at(task.batches().camera_rate_hz());
            let limit_bytes = self.memory_limit_bytes;
            let report = dot_rig::check::check(
                &task,
                plan,
                &self.registry,
                &camera,
                rig.pace(),
                &self.data,
                limit_bytes,
            )?;
            Ok((task, report))
        };
        foreseen().map_err(|error| invalid_plan(&error))
    }

    /// The rig's camera when it makes so many frames a second.
    fn camera_at(&self, rate_hz: f64) -> CameraCapabilities {
        let exposure_us = *self.camera.exposure_us.start()..=1e6 / rate_hz;
        CameraCapabilities { exposure_us, ..self.camera.clone() }
    }

    /// A plan on this rig, and what it would do.
    fn foresee(&self, rig: &Rig, plan: &str) -> Result<(Task, CheckReport), RpcError> {
        let parsed = Plan::parse(plan).map_err(|error| invalid_plan(&error))?;
        if matches!(parsed.kind, PlanKind::Batches | PlanKind::Response) {
            let kind = parsed.kind.name();
            let message = format!("kind = \"{kind}\": a plane rig runs plans of kind \"sweep\" and \"film\"");
            return Err(invalid_plan(&ConfigError::at(plan, &["kind"], message)));
        }
        let size = (self.camera.height, self.camera.width);
        let task = Task::new(parsed, &rig.file, rig.first_row(&self.camera), size);
        let processing = task.processing(&self.registry, plan).map_err(|error| invalid_plan(&error))?;
        let limit_bytes = self.memory_limit_bytes;
        let report = check::check(&task, &processing.products, &self.camera, &self.data, limit_bytes)
            .map_err(|error| invalid_plan(&error))?;
        Ok((task, report))
    }

    /// Ends the run under way, if there is one, waits for it, and lets none begin any more.
    pub fn shut_down(&self) {
        self.closed.store(true, Ordering::Relaxed);
        let current = self.current.lock().unwrap_or_else(PoisonError::into_inner).take();
        if let Some(Current { orders, thread }) = current {
            orders.give(Order::Cancel);
            if thread.join().is_err() {
                tracing::error!("the run's thread panicked");
            }
        }
    }

    fn order(&self, order: Order, from: &[RunState], to: Option<RunState>) -> Result<(), RpcError> {
        let current = self.current.lock().unwrap_or_else(PoisonError::into_inner);
        let state = self.board.status().state;
        let Some(current) = current.as_ref().filter(|_| from.contains(&state)) else {
            let what = format!("the daemon is {}: there is nothing to do this to", name_of(state));
            return Err(RpcError::new(ErrorCode::NotRunning, what));
        };
        if let Some(to) = to {
            self.board.go(to).map_err(wrong_state)?;
        }
        current.orders.give(order);
        Ok(())
    }

    /// Claims the daemon for a run, prepares it and starts its thread; on any error the daemon is free again.
    fn start(
        &self,
        begin: impl FnOnce() -> Result<(Started, Current), RpcError>,
    ) -> Result<Started, RpcError> {
        let mut current = self.current.lock().unwrap_or_else(PoisonError::into_inner);
        if self.closed.load(Ordering::Relaxed) {
            return Err(RpcError::new(ErrorCode::Busy, "the daemon is ending: start it again first"));
        }
        self.board.go(RunState::Preparing).map_err(wrong_state)?;
        if let Some(last) = current.take() {
            // Its thread has nothing left to do once the state allowed a new run.
            let _ = last.thread.join();
        }
        match begin() {
            Ok((started, run)) => {
                *current = Some(run);
                Ok(started)
            }
            Err(error) => {
                // Nothing has begun, so nothing has failed.
                let _ = self.board.go(RunState::Idle);
                Err(error)
            }
        }
    }

    /// Prepares a run of batches and starts its thread.
    fn begin_batches(&self, rig: &Arc<DotRig>, params: &RunParams) -> Result<(Started, Current), RpcError> {
        let (task, report) = self.foresee_batches(rig, &params.plan)?;
        self.check_room(&report, "take fewer or smaller frames")?;
        let (session, ledger) = self.create_session(
            params,
            PlanKind::Batches,
            &task.plan.name,
            task.stack_shape(),
            0,
            &rig.text,
        )?;
        let dir = session.dir().to_owned();
        let task = Arc::new(task);
        let patterns = dot_rig::keep_patterns(&session, &task);
        patterns.map_err(|error| RpcError::new(ErrorCode::InvalidPlan, error))?;
        if let Some(predistortion) = &task.predistortion {
            predistortion.keep(&session).map_err(|error| storage(&error))?;
        }
        self.board.set_session(dir.clone());
        let orders = Arc::new(Orders::default());
        let run = DotRun {
            rig: rig.clone(),
            task,
            plan_text: params.plan.clone(),
            registry: self.registry.clone(),
            session,
            ledger,
            data: self.data.clone(),
            orders: orders.clone(),
            board: self.board.clone(),
            live: self.outlet(&dir),
        };
        let board = self.board.clone();
        let thread = spawn_run({
            let (orders, dir) = (orders.clone(), dir.clone());
            move || conduct_batches(run, &orders, &board, &dir)
        })?;
        Ok((Started { session: dir }, Current { orders, thread }))
    }

    fn outlet(&self, dir: &Path) -> Option<Outlet> {
        let session = dir.display().to_string();
        let outlet = |file: &Arc<LiveFile>| Outlet { file: file.clone(), board: self.board.clone(), session };
        self.live.as_ref().map(outlet)
    }

    fn spawn(&self, rig: &Arc<Rig>, prepared: Prepared) -> Result<(Started, Current), RpcError> {
        let Prepared { task, session, ledger, plan_text, resumed } = prepared;
        let mut processing =
            task.processing(&self.registry, &plan_text).map_err(|error| invalid_plan(&error))?;
        let memory = MemoryNeed::of(&task, &processing.products)
            .map_err(|error| RpcError::new(ErrorCode::InvalidPlan, error.to_string()))?;
        let in_strips = memory.in_strips(available_bytes(self.memory_limit_bytes));
        if in_strips {
            processing.keep_no_images();
        }
        let dir = session.dir().to_owned();
        self.board.set_session(dir.clone());
        let orders = Arc::new(Orders::default());
        let run = Run {
            rig: rig.clone(),
            task,
            session,
            ledger,
            processing,
            resumed,
            orders: orders.clone(),
            board: self.board.clone(),
            live: self.outlet(&dir),
        };
        let board = self.board.clone();
        let thread = spawn_run({
            let (orders, dir) = (orders.clone(), dir.clone());
            move || conduct(run, in_strips, &orders, &board, &dir)
        })?;
        Ok((Started { session: dir }, Current { orders, thread }))
    }

    /// Whether disk and memory suffice; `instead` is what to do where memory does not.
    fn check_room(&self, report: &CheckReport, instead: &str) -> Result<(), RpcError> {
        if report.disk_bytes > report.disk_free_bytes {
            let what = format!(
                "the session needs {} MB, {} has {} MB: free some space or give the daemon another --data",
                report.disk_bytes / 1_000_000,
                self.data.display(),
                report.disk_free_bytes / 1_000_000
            );
            return Err(RpcError::new(ErrorCode::Storage, what));
        }
        if report.memory_bytes > report.memory_free_bytes {
            let what = format!(
                "the run needs {} MB of memory, {} MB may be used: {instead}, give the daemon more --memory, or take a larger machine",
                report.memory_bytes / 1_000_000,
                report.memory_free_bytes / 1_000_000
            );
            return Err(RpcError::new(ErrorCode::Storage, what));
        }
        Ok(())
    }

    fn create_session(
        &self,
        params: &RunParams,
        kind: PlanKind,
        name: &str,
        shape: StackShape,
        first_row: usize,
        rig_text: &str,
    ) -> Result<(Session, Ledger), RpcError> {
        let entry = SessionEntry {
            format: raysweep_session::ledger::FORMAT,
            name: name.into(),
            kind: kind.name().into(),
            operator: params.operator.clone(),
            sample: params.sample.clone(),
            note: params.note.clone(),
            tags: params.tags.clone(),
            created: jiff::Timestamp::now(),
            software: crate::SOFTWARE.into(),
            shape,
            first_row,
        };
        Session::create(&self.data, entry, &params.plan, rig_text).map_err(|error| storage(&error))
    }

    fn prepare_new(&self, rig: &Rig, params: &RunParams) -> Result<Prepared, RpcError> {
        let (task, report) = self.foresee(rig, &params.plan)?;
        let instead = match task.is_film() {
            true => "take fewer settings",
            false => "even some camera rows at a time; make shorter sequences",
        };
        self.check_room(&report, instead)?;
        let shape = StackShape {
            points: task.points(),
            settings: if task.is_film() { task.settings().count() } else { 0 },
            dots: 0,
            exposures: task.schedule.dark_len(),
            rows: self.camera.height,
            columns: self.camera.width,
        };
        let first_row = rig.first_row(&self.camera);
        let (session, ledger) =
            self.create_session(params, task.plan.kind, &task.plan.name, shape, first_row, &rig.text)?;
        Ok(Prepared { task: Arc::new(task), session, ledger, plan_text: params.plan.clone(), resumed: false })
    }

    fn prepare_resumed(&self, rig: &Rig, params: &ResumeParams) -> Result<Prepared, RpcError> {
        let no_session = |what: String| RpcError::new(ErrorCode::NoSession, what);
        let session =
            Session::open(&self.data.join(&params.session)).map_err(|error| no_session(error.to_string()))?;
        let read = |path: PathBuf| {
            std::fs::read_to_string(&path)
                .map_err(|error| no_session(format!("cannot read {}: {error}", path.display())))
        };
        let plan_text = read(session.plan_path())?;
        if read(session.rig_path())? != rig.text {
            return Err(no_session(format!(
                "{} was taken on another rig file than the daemon's: start the daemon with {}",
                session.dir().display(),
                session.rig_path().display()
            )));
        }
        let plan = Plan::parse(&plan_text).map_err(|error| invalid_plan(&error))?;
        if plan.kind == PlanKind::Film {
            return Err(no_session(format!(
                "{} is a film, which cannot be resumed: its time has passed. `raysweep process` makes the transports of the cycles that are there; run the plan again for another film",
                session.dir().display()
            )));
        }
        let ledger = session.resume().map_err(|error| storage(&error))?;
        let entry = &ledger.state().session;
        let task = Task::new(plan, &rig.file, entry.first_row, (entry.shape.rows, entry.shape.columns));
        Ok(Prepared { task: Arc::new(task), session, ledger, plan_text, resumed: true })
    }
}

fn spawn_run(run: impl FnOnce() + Send + 'static) -> Result<JoinHandle<()>, RpcError> {
    thread::Builder::new()
        .name("run".into())
        .spawn(run)
        .map_err(|error| RpcError::new(ErrorCode::Internal, format!("no thread for the run: {error}")))
}

impl Control for Runner {
    fn status(&self) -> Status {
        let guard = match &self.rig {
            Bench::Plane(_) => mirror::light_guard(&self.data, None),
            Bench::Dots(rig) => rig.light_guard(&self.data),
        };
        Status { mirror: mirror::status(&self.data, &guard), ..self.board.status() }
    }

    fn check(&self, plan: &str) -> Result<CheckReport, RpcError> {
        let rig = match &self.rig {
            Bench::Plane(rig) => rig,
            Bench::Dots(rig) if is_response(plan)? => return Ok(self.foresee_response(rig, plan)?.1),
            Bench::Dots(rig) => return Ok(self.foresee_batches(rig, plan)?.1),
        };
        let (task, mut report) = self.foresee(rig, plan)?;
        if !task.is_film() {
            match advice::advise(&task, &rig.file, &self.camera) {
                Ok(advice) => report.advice = Some(advice),
                Err(none) => report.warnings.push(none.to_string()),
            }
        }
        Ok(report)
    }

    fn run(&self, params: RunParams) -> Result<Started, RpcError> {
        self.start(|| match &self.rig {
            Bench::Plane(rig) => self.spawn(rig, self.prepare_new(rig, &params)?),
            Bench::Dots(rig) if is_response(&params.plan)? => self.begin_response(rig, &params),
            Bench::Dots(rig) => self.begin_batches(rig, &params),
        })
    }

    fn resume(&self, params: ResumeParams) -> Result<Started, RpcError> {
        self.start(|| match &self.rig {
            Bench::Plane(rig) => self.spawn(rig, self.prepare_resumed(rig, &params)?),
            Bench::Dots(_) => {
                let what = "batches cannot be resumed: their time has passed. `raysweep process` makes the products of those that are there; run the plan again for more";
                Err(RpcError::new(ErrorCode::NoSession, what))
            }
        })
    }

    fn pause(&self) -> Result<(), RpcError> {
        self.order(Order::Pause, &[RunState::Running], Some(RunState::Paused))
    }

    fn go_on(&self) -> Result<(), RpcError> {
        self.order(Order::Go, &[RunState::Paused], Some(RunState::Running))
    }

    fn cancel(&self) -> Result<(), RpcError> {
        let during =
            [RunState::Preparing, RunState::Armed, RunState::Running, RunState::Paused, RunState::Draining];
        self.order(Order::Cancel, &during, None)
    }

    fn arm_light(&self) -> Result<(), RpcError> {
        mirror::arm_light(&self.data)
    }

    fn sessions(&self) -> Result<Vec<SessionInfo>, RpcError> {
        let listing = raysweep_session::list(&self.data).map_err(|error| storage(&error))?;
        let readable = listing.sessions.into_iter().map(|session| SessionInfo {
            session: session.dir,
            name: session.name,
            created: session.created.to_string(),
            stored: session.stored,
            points: session.points,
            state: session.end.map_or("unfinished", results::name_of).into(),
        });
        let unreadable = listing.unreadable.into_iter().map(|(dir, error)| SessionInfo {
            session: dir,
            name: error.to_string(),
            created: String::new(),
            stored: 0,
            points: 0,
            state: "unreadable".into(),
        });
        Ok(readable.chain(unreadable).collect())
    }

    fn events(&self) -> broadcast::Receiver<Event> {
        self.board.subscribe()
    }
}

fn invalid_plan(error: &ConfigError) -> RpcError {
    let mut rpc = RpcError::new(ErrorCode::InvalidPlan, error.to_string());
    if let Some(data) = &mut rpc.data {
        data.field.clone_from(&error.field);
        data.span = error.span.clone().map(|span| (span.start, span.end));
    }
    rpc
}

fn storage(error: &raysweep_session::Error) -> RpcError {
    RpcError::new(ErrorCode::Storage, error.to_string())
}

fn wrong_state(WrongState(state): WrongState) -> RpcError {
    let what = format!("the daemon is {}: wait for the run's end, or cancel it", name_of(state));
    RpcError::new(ErrorCode::Busy, what)
}

fn name_of(state: RunState) -> &'static str {
    match state {
        RunState::Idle => "idle",
        RunState::Preparing => "preparing a run",
        RunState::Armed => "armed",
        RunState::Running => "running",
        RunState::Paused => "paused",
        RunState::Draining => "finishing a run",
        RunState::Faulted => "faulted",
    }
}
