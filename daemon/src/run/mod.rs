//! Runs: from a plan to a session, one at a time.

mod board;
mod camera;
mod engine;
mod orders;
mod storage;
mod vsync;

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::{self, JoinHandle};

use raysweep_pipeline::Registry;
use raysweep_proto::{
    CheckReport, ErrorCode, Event, ResumeParams, RpcError, RunParams, RunState, SessionInfo, Started, Status,
};
use raysweep_session::Session;
use raysweep_session::ledger::{EndEntry, EndState, Entry, Ledger, SessionEntry};
use raysweep_session::stack::{ArrayName, StackShape};
use tokio::sync::broadcast;

use self::board::{Board, WrongState};
use self::engine::{Acquired, Run, RunError};
use self::orders::{Order, Orders};
use crate::check;
use crate::config::{ConfigError, Plan};
use crate::control::Control;
use crate::processing::Task;
use crate::results;
use crate::rig::Rig;

/// The daemon's core: a rig, a data folder, and at most one run.
pub struct Runner {
    rig: Arc<Rig>,
    data: PathBuf,
    registry: Arc<Registry>,
    board: Arc<Board>,
    current: Mutex<Option<Current>>,
    /// Set once, when no further run may begin.
    closed: AtomicBool,
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
    /// A daemon for `rig` that keeps its sessions in `data`.
    pub fn new(rig: Rig, data: PathBuf, registry: Registry) -> Self {
        Self {
            rig: Arc::new(rig),
            data,
            registry: Arc::new(registry),
            board: Arc::new(Board::new("plane")),
            current: Mutex::default(),
            closed: AtomicBool::new(false),
        }
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
            let what = format!("the daemon is {}: there is no run to do this to", name_of(state));
            return Err(RpcError::new(ErrorCode::NotRunning, what));
        };
        if let Some(to) = to {
            self.board.go(to).map_err(wrong_state)?;
        }
        current.orders.give(order);
        Ok(())
    }

    /// Claims the daemon for a run, prepares it and starts its thread; on any error the daemon is free again.
    fn start(&self, prepare: impl FnOnce() -> Result<Prepared, RpcError>) -> Result<Started, RpcError> {
        let mut current = self.current.lock().unwrap_or_else(PoisonError::into_inner);
        if self.closed.load(Ordering::Relaxed) {
            return Err(RpcError::new(ErrorCode::Busy, "the daemon is ending: start it again first"));
        }
        self.board.go(RunState::Preparing).map_err(wrong_state)?;
        if let Some(last) = current.take() {
            // Its thread has nothing left to do once the state allowed a new run.
            let _ = last.thread.join();
        }
        let started = prepare().and_then(|prepared| self.spawn(prepared));
        match started {
            Ok((started, run)) => {
                *current = Some(run);
                Ok(started)
            }
            Err(error) => {
                let refused = matches!(error.name(), Some(ErrorCode::InvalidPlan | ErrorCode::NoSession));
                if !refused {
                    self.board.set_error(error.message.clone());
                }
                let _ = self.board.go(if refused { RunState::Idle } else { RunState::Faulted });
                Err(error)
            }
        }
    }

    fn spawn(&self, prepared: Prepared) -> Result<(Started, Current), RpcError> {
        let Prepared { task, session, ledger, plan_text, resumed } = prepared;
        let processing = task.processing(&self.registry, &plan_text).map_err(|error| invalid_plan(&error))?;
        let dir = session.dir().to_owned();
        self.board.set_session(dir.clone());
        let orders = Arc::new(Orders::default());
        let run = Run {
            rig: self.rig.clone(),
            task,
            session,
            ledger,
            processing,
            resumed,
            orders: orders.clone(),
            board: self.board.clone(),
        };
        let board = self.board.clone();
        let thread = thread::Builder::new()
            .name("run".into())
            .spawn({
                let orders = orders.clone();
                let dir = dir.clone();
                move || conduct(run, &orders, &board, &dir)
            })
            .map_err(|error| RpcError::new(ErrorCode::Internal, format!("no thread for the run: {error}")))?;
        Ok((Started { session: dir }, Current { orders, thread }))
    }

    fn prepare_new(&self, params: &RunParams) -> Result<Prepared, RpcError> {
        let plan = Plan::parse(&params.plan).map_err(|error| invalid_plan(&error))?;
        let devices = self.rig.open().map_err(|error| RpcError::new(ErrorCode::Device, error.to_string()))?;
        let camera = devices.camera.capabilities().clone();
        drop(devices);
        let size = (camera.height, camera.width);
        let task = Task::new(plan, &self.rig.file, self.rig.first_row(), size);
        task.processing(&self.registry, &params.plan).map_err(|error| invalid_plan(&error))?;
        let report = check::check(&task, &camera, &self.data).map_err(|error| invalid_plan(&error))?;
        if report.disk_bytes > report.disk_free_bytes {
            let what = format!(
                "the session needs {} MB, {} has {} MB: free some space or give the daemon another --data",
                report.disk_bytes / 1_000_000,
                self.data.display(),
                report.disk_free_bytes / 1_000_000
            );
            return Err(RpcError::new(ErrorCode::Storage, what));
        }
        let entry = SessionEntry {
            format: raysweep_session::ledger::FORMAT,
            name: task.plan.name.clone(),
            kind: "sweep".into(),
            operator: params.operator.clone(),
            sample: params.sample.clone(),
            note: params.note.clone(),
            tags: params.tags.clone(),
            created: jiff::Timestamp::now(),
            software: crate::SOFTWARE.into(),
            shape: StackShape {
                points: task.schedule.sweep_len(),
                exposures: task.schedule.dark_len(),
                rows: size.0,
                columns: size.1,
            },
            first_row: self.rig.first_row(),
        };
        let (session, ledger) = Session::create(&self.data, entry, &params.plan, &self.rig.text)
            .map_err(|error| storage(&error))?;
        Ok(Prepared { task: Arc::new(task), session, ledger, plan_text: params.plan.clone(), resumed: false })
    }

    fn prepare_resumed(&self, params: &ResumeParams) -> Result<Prepared, RpcError> {
        let no_session = |what: String| RpcError::new(ErrorCode::NoSession, what);
        let session =
            Session::open(&self.data.join(&params.session)).map_err(|error| no_session(error.to_string()))?;
        let read = |path: PathBuf| {
            std::fs::read_to_string(&path)
                .map_err(|error| no_session(format!("cannot read {}: {error}", path.display())))
        };
        let plan_text = read(session.plan_path())?;
        if read(session.rig_path())? != self.rig.text {
            return Err(no_session(format!(
                "{} was taken on another rig file than the daemon's: start the daemon with {}",
                session.dir().display(),
                session.rig_path().display()
            )));
        }
        let plan = Plan::parse(&plan_text).map_err(|error| invalid_plan(&error))?;
        let ledger = session.resume().map_err(|error| storage(&error))?;
        let entry = &ledger.state().session;
        let task = Task::new(plan, &self.rig.file, entry.first_row, (entry.shape.rows, entry.shape.columns));
        Ok(Prepared { task: Arc::new(task), session, ledger, plan_text, resumed: true })
    }
}

/// The run's thread: acquires, makes the results, and says how it ended. Nothing it meets leaves the daemon stuck.
fn conduct(run: Run, orders: &Orders, board: &Board, dir: &Path) {
    let task = run.task.clone();
    let rig = run.rig.clone();
    let ended = catch_unwind(AssertUnwindSafe(|| -> Result<EndEntry, RunError> {
        let acquired = run.acquire()?;
        conclude(acquired, &task, &rig, orders)
    }))
    .unwrap_or_else(|panic| Err(RunError::Panicked(message_of(&*panic).to_owned())));
    let (state, end) = match ended {
        Ok(end) if end.state == EndState::Faulted => (RunState::Faulted, end),
        Ok(end) => (RunState::Idle, end),
        Err(error) => {
            let points = task.schedule.sweep_len();
            let stored = Session::open(dir).and_then(|session| session.state());
            let stored = stored.map_or(0, |state| state.stored(ArrayName::Sum).count());
            let error = Some(error.to_string());
            (
                RunState::Faulted,
                EndEntry { state: EndState::Faulted, error, stored, missing: points - stored, vsync: None },
            )
        }
    };
    if let Some(error) = &end.error {
        tracing::error!(%error, session = %dir.display(), "run faulted");
        board.set_error(error.clone());
    }
    let report = dir.join("report.html");
    let finished = Event::Finished {
        session: dir.to_owned(),
        state: results::name_of(end.state).into(),
        error: end.error,
        report: report.exists().then_some(report),
        stored: end.stored,
        missing: end.missing,
    };
    if board.status().state != RunState::Draining && state == RunState::Idle {
        let _ = board.go(RunState::Draining);
    }
    let _ = board.go(state);
    board.publish(finished);
}

/// Makes the results of what was acquired; a cancelled run has none, so that it ends soon.
fn conclude(acquired: Acquired, task: &Task, rig: &Rig, orders: &Orders) -> Result<EndEntry, RunError> {
    let Acquired { session, mut ledger, mut processing, vsync, fault } = acquired;
    let missing = engine::missing(&task.schedule, ledger.state()).len();
    let state = match (&fault, missing) {
        (Some(_), _) => EndState::Faulted,
        (None, 0) => EndState::Complete,
        (None, _) if orders.now() == Order::Cancel => EndState::Cancelled,
        (None, _) => EndState::Faulted,
    };
    let stored = ledger.state().stored(ArrayName::Sum).count();
    let end = EndEntry {
        state,
        error: fault.map(|fault| fault.to_string()),
        stored,
        missing: task.schedule.sweep_len() - stored,
        vsync,
    };
    if state == EndState::Complete {
        let (products, problems) = processing.finish();
        results::write_products(&session, task, &products)?;
        ledger.append(&Entry::End(end.clone()))?;
        results::write_report(&session, ledger.state(), task, &products, &problems)?;
    } else {
        ledger.append(&Entry::End(end.clone()))?;
    }
    results::write_manifest(&session, ledger.state(), task, &rig.file)?;
    Ok(end)
}

impl Control for Runner {
    fn status(&self) -> Status {
        self.board.status()
    }

    fn check(&self, plan: &str) -> Result<CheckReport, RpcError> {
        let parsed = Plan::parse(plan).map_err(|error| invalid_plan(&error))?;
        let devices = self.rig.open().map_err(|error| RpcError::new(ErrorCode::Device, error.to_string()))?;
        let camera = devices.camera.capabilities();
        let size = (camera.height, camera.width);
        let task = Task::new(parsed, &self.rig.file, self.rig.first_row(), size);
        task.processing(&self.registry, plan).map_err(|error| invalid_plan(&error))?;
        check::check(&task, camera, &self.data).map_err(|error| invalid_plan(&error))
    }

    fn run(&self, params: RunParams) -> Result<Started, RpcError> {
        self.start(|| self.prepare_new(&params))
    }

    fn resume(&self, params: ResumeParams) -> Result<Started, RpcError> {
        self.start(|| self.prepare_resumed(&params))
    }

    fn pause(&self) -> Result<(), RpcError> {
        self.order(Order::Pause, &[RunState::Running], Some(RunState::Paused))
    }

    fn go_on(&self) -> Result<(), RpcError> {
        self.order(Order::Go, &[RunState::Paused], Some(RunState::Running))
    }

    fn cancel(&self) -> Result<(), RpcError> {
        let during = [RunState::Preparing, RunState::Armed, RunState::Running, RunState::Paused];
        self.order(Order::Cancel, &during, None)
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

fn message_of(panic: &(dyn Any + Send)) -> &str {
    panic
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| panic.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("without a message")
}
