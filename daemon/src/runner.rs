//! The daemon's core: a rig, a data folder, and at most one run.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::{self, JoinHandle};
use std::time::Duration;

use raysweep_config::plan::with_tables;
use raysweep_core::{CameraCapabilities, Size, io_text};
use raysweep_pipeline::message_of;
use raysweep_processing::calibration::KeptCalibration;
use raysweep_proto::{
    CalibrationInfo, CheckReport, DesignParams, DesignReport, DoctorParams, DoctorReport, ErrorCode, Event,
    ResumeParams, RpcError, RunParams, RunState, SessionInfo, Started, Status, ViewfinderParams,
};
use raysweep_session::integrity::changed_inputs;
use raysweep_session::ledger::{Ledger, SessionEntry};
use raysweep_session::{Session, input};
use tokio::sync::broadcast;

use crate::catalogue::{calibrations_in, damaged_calibration, sessions_in};
use crate::computing::Computing;
use crate::control::Control;
use crate::doctor::{self, PlanNeeds};
use crate::live::{LiveFile, Outlet};
use crate::mirror;
use crate::probes::Probes;
use crate::procedure::lab::Lab;
use crate::procedure::{foresee, foresee_rest};
use crate::refusals::{NotBegun, invalid_plan, no_session, storage, wrong_state};
use crate::rig::{AnyRig, RigError, SharedRig};
use crate::run::board::StatusBoard;
use crate::run::life::{Foreseen, Run, conduct};
use crate::run::look::{NoViewfinder, check_look};
use crate::run::orders::{Order, Orders};

/// Frame rate at which a dot rig's camera is opened to check that it is present; each run opens it at its own rate.
const LEAST_FRAME_RATE_HZ: f64 = 100.0;

/// The longest run that is begun, in hours of light: a week.
const MOST_HOURS: f64 = 168.0;

/// How long a daemon that shuts down waits for a run that is being prepared.
const MOST_PREPARING: Duration = Duration::from_millis(500);

/// Longest plan or rig file of a session.
const MOST_TEXT_BYTES: u64 = 4 << 20;

/// The daemon's core: a rig, a data folder, and at most one run.
pub struct Runner {
    rig: SharedRig,
    /// Capabilities of the rig's camera when the daemon started.
    camera: CameraCapabilities,
    data: PathBuf,
    board: Arc<StatusBoard>,
    live: Option<Arc<LiveFile>>,
    memory_limit_bytes: Option<u64>,
    probes: Probes,
    computing: Computing,
    current: Mutex<Option<Current>>,
    /// Notified when a run's preparation has ended.
    prepared: Condvar,
    /// Set once, when no more runs may begin.
    closed: AtomicBool,
}

/// How a run starts.
struct Start<'a> {
    orders: &'a Arc<Orders>,
    is_resumed: bool,
    is_attached: bool,
}

/// The run in progress, or the last one.
struct Current {
    orders: Arc<Orders>,
    /// `None` while the run is being prepared.
    begun: Option<Begun>,
}

/// A run that has begun.
struct Begun {
    session: PathBuf,
    /// Whether it ends with the client that began it; never if it was resumed.
    is_attached: bool,
    thread: JoinHandle<()>,
}

impl Runner {
    /// A daemon for `rig` that stores its sessions in `data`. Opens all devices once, to check that they are present;
    /// each run opens them again, and between runs they are free for other programs.
    ///
    /// # Errors
    /// The devices that cannot be opened and that every run needs.
    pub fn new(rig: impl Into<AnyRig>, data: PathBuf) -> Result<Self, RigError> {
        let rig = SharedRig::from(rig.into());
        let (camera, kind) = match &rig {
            SharedRig::Plane(rig) => (rig.look_for_camera()?, "plane"),
            SharedRig::Dots(rig) => {
                (rig.open(&data, LEAST_FRAME_RATE_HZ)?.camera.capabilities().clone(), "dots")
            }
        };
        Ok(Self {
            rig,
            camera,
            data,
            board: Arc::new(StatusBoard::new(kind)),
            live: None,
            memory_limit_bytes: None,
            probes: Probes::default(),
            computing: Computing::new().map_err(|error| RigError::Config(error.to_string()))?,
            current: Mutex::default(),
            prepared: Condvar::new(),
            closed: AtomicBool::new(false),
        })
    }

    /// Adds a file for the running estimates of its runs.
    #[must_use]
    pub fn with_live(mut self, file: LiveFile) -> Self {
        self.board.set_live(file.path().to_owned());
        self.live = Some(Arc::new(file));
        self
    }

    /// Sets a memory limit: results that need more are made in strips of camera rows. The default is the memory that
    /// is free when a run begins.
    #[must_use]
    pub fn with_memory_limit(mut self, bytes: u64) -> Self {
        self.memory_limit_bytes = Some(bytes);
        self
    }

    /// Inserts these into its runs, for tests.
    #[must_use]
    pub fn with_probes(mut self, probes: Probes) -> Self {
        self.probes = probes;
        self
    }

    /// Capabilities of the rig's camera.
    pub fn camera(&self) -> &CameraCapabilities {
        &self.camera
    }

    fn lab(&self) -> Lab<'_> {
        Lab {
            rig: &self.rig,
            camera: &self.camera,
            data: &self.data,
            probes: &self.probes,
            memory_limit_bytes: self.memory_limit_bytes,
        }
    }

    fn foresee(&self, plan: &str) -> Result<Foreseen, RpcError> {
        foresee(&self.lab(), plan).map_err(|error| invalid_plan(&error))
    }

    fn lock(&self) -> MutexGuard<'_, Option<Current>> {
        self.current.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Ends the run in progress, if any, waits for it, and allows no more runs. A run that is still being prepared has
    /// moved and stored nothing: it is waited for only shortly.
    pub fn shut_down(&self) {
        let mut current = self.lock();
        self.closed.store(true, Ordering::Relaxed);
        if let Some(Current { orders, .. }) = &*current {
            orders.give(Order::Cancel);
        }
        let in_preparation =
            |current: &mut Option<Current>| matches!(current, Some(Current { begun: None, .. }));
        (current, _) = self
            .prepared
            .wait_timeout_while(current, MOST_PREPARING, in_preparation)
            .unwrap_or_else(PoisonError::into_inner);
        let begun = current.take().and_then(|current| current.begun);
        drop(current);
        if begun.is_some_and(|begun| begun.thread.join().is_err()) {
            tracing::error!("the run's thread panicked");
        }
    }

    /// Allows no more runs if none is in progress. Returns whether none is.
    pub fn close_if_idle(&self) -> bool {
        // No run can begin while this is locked.
        let _current = self.current.lock().unwrap_or_else(PoisonError::into_inner);
        let is_idle = self.board.status().state.is_over();
        if is_idle {
            self.closed.store(true, Ordering::Relaxed);
        }
        is_idle
    }

    fn order(&self, order: Order, from: &[RunState], to: Option<RunState>) -> Result<(), RpcError> {
        let current = self.lock();
        let state = self.board.status().state;
        let Some(current) = current.as_ref().filter(|_| from.contains(&state)) else {
            let what = match (state, order) {
                (RunState::Idle | RunState::Faulted, _) => "no run in progress".to_owned(),
                (RunState::Paused, Order::Pause) => {
                    "the run is already paused; `raysweep continue` goes on".to_owned()
                }
                (RunState::Running, Order::Go) => "the run is not paused, so it goes on anyway".to_owned(),
                (RunState::Draining, _) => {
                    "the run is ending: wait for its end, or `raysweep cancel`".to_owned()
                }
                (_, _) => "the run is still being prepared: wait until it is running, or `raysweep cancel`"
                    .to_owned(),
            };
            return Err(RpcError::new(ErrorCode::NotRunning, what));
        };
        if let Some(to) = to {
            self.board.go(to).map_err(wrong_state)?;
        }
        current.orders.give(order);
        Ok(())
    }

    /// Reserves the daemon for a run, prepares it and starts its thread.
    fn start(
        &self,
        begin: impl FnOnce(&Arc<Orders>) -> Result<Begun, RpcError>,
    ) -> Result<Started, RpcError> {
        self.reserved(|orders| {
            begin(orders).map(|begun| (Started { session: begun.session.clone() }, Some(begun)))
        })
    }

    /// Reserves the daemon while `begin` works; unless that has started a run's thread, the daemon is then free again.
    /// Meanwhile, orders can be given.
    fn reserved<T>(
        &self,
        begin: impl FnOnce(&Arc<Orders>) -> Result<(T, Option<Begun>), RpcError>,
    ) -> Result<T, RpcError> {
        let orders = Arc::new(Orders::default());
        let last = {
            let mut current = self.lock();
            if self.closed.load(Ordering::Relaxed) {
                return Err(RpcError::new(
                    ErrorCode::Busy,
                    "the daemon is shutting down: start it again first",
                ));
            }
            self.board.go(RunState::Preparing).map_err(wrong_state)?;
            current.replace(Current { orders: orders.clone(), begun: None })
        };
        if let Some(Begun { thread, .. }) = last.and_then(|last| last.begun) {
            // The thread of the last run had nothing left to do once the state allowed a new run.
            let _ = thread.join();
        }
        let outcome = catch_unwind(AssertUnwindSafe(|| begin(&orders))).unwrap_or_else(|panic| {
            let what = format!("preparing the run failed because of a bug: {}", message_of(&*panic));
            Err(RpcError::new(ErrorCode::Internal, what))
        });
        let mut current = self.lock();
        let (result, begun) = match outcome {
            Ok((result, begun)) => (Ok(result), begun),
            Err(error) => (Err(error), None),
        };
        if begun.is_none() {
            // No run has begun, so none has failed.
            let _ = self.board.go(RunState::Idle);
        }
        // There is no current run if the daemon did not wait for the preparation before it shut down.
        match (&mut *current, begun) {
            (Some(current), begun @ Some(_)) => current.begun = begun,
            (_, None) => *current = None,
            (None, Some(_cancelled)) => {}
        }
        self.prepared.notify_all();
        result
    }

    /// Starts the thread of a run.
    fn spawn(
        &self,
        foreseen: Foreseen,
        session: Session,
        ledger: Ledger,
        start: Start<'_>,
    ) -> Result<Begun, RpcError> {
        let Start { orders, is_resumed, is_attached } = start;
        let dir = session.dir().to_owned();
        self.board.set_session(dir.clone());
        let run = Run {
            session,
            ledger,
            is_resumed,
            data: self.data.clone(),
            orders: orders.clone(),
            board: self.board.clone(),
            live: self.outlet(&dir),
            probes: self.probes.clone(),
            warnings: foreseen.report.settings_refused.into_iter().collect(),
        };
        let Foreseen { procedure, shape, .. } = foreseen;
        let thread =
            thread::Builder::new().name("run".into()).spawn(move || conduct(procedure, run, shape)).map_err(
                |error| RpcError::new(ErrorCode::Internal, format!("cannot start the run's thread: {error}")),
            )?;
        Ok(Begun { session: dir, is_attached, thread })
    }

    fn outlet(&self, dir: &Path) -> Option<Outlet> {
        let session = dir.display().to_string();
        let outlet = |file: &Arc<LiveFile>| Outlet { file: file.clone(), board: self.board.clone(), session };
        self.live.as_ref().map(outlet)
    }

    /// Checks that disk and memory suffice, and that the run ends some day; `instead` advises the user if memory does
    /// not suffice. A session that is resumed already has `stored_bytes`.
    fn check_needs(&self, report: &CheckReport, instead: &str, stored_bytes: u64) -> Result<(), RpcError> {
        if report.light_s > MOST_HOURS * 3600.0 {
            let what = format!(
                "the run would take {:.0} hours of light, and at most {MOST_HOURS} are allowed: take fewer points or frames",
                report.light_s / 3600.0
            );
            return Err(RpcError::new(ErrorCode::InvalidPlan, what));
        }
        let disk_bytes = report.disk_bytes.saturating_sub(stored_bytes);
        if disk_bytes > report.disk_free_bytes {
            let what = format!(
                "the session needs {}, but {} has only {} free: free some space or give the daemon another --data",
                Size(disk_bytes),
                self.data.display(),
                Size(report.disk_free_bytes)
            );
            return Err(RpcError::new(ErrorCode::Storage, what));
        }
        if report.memory_bytes > report.memory_free_bytes {
            let what = format!(
                "the run needs {} of memory, but only {} may be used: {instead}, give the daemon more --memory, or take a larger machine",
                Size(report.memory_bytes),
                Size(report.memory_free_bytes)
            );
            return Err(RpcError::new(ErrorCode::Storage, what));
        }
        Ok(())
    }

    fn begin(&self, params: &RunParams, orders: &Arc<Orders>) -> Result<Begun, RpcError> {
        let foreseen = self.foresee(&params.plan)?;
        self.check_needs(&foreseen.report, foreseen.instead, 0)?;
        self.go_on_preparing(orders)?;
        let entry = SessionEntry {
            format: raysweep_session::ledger::FORMAT,
            name: foreseen.name.clone(),
            kind: foreseen.kind.into(),
            operator: params.operator.clone(),
            sample: params.sample.clone(),
            note: params.note.clone(),
            tags: params.tags.clone(),
            created: jiff::Timestamp::now(),
            software: raysweep_processing::SOFTWARE.into(),
            shape: foreseen.shape,
            first_row: foreseen.first_row,
        };
        // The session states what it measured, whatever later versions choose.
        let plan = match &foreseen.report.settings {
            Some(table) => with_tables(&params.plan, table).map_err(|error| invalid_plan(&error))?,
            None => params.plan.clone(),
        };
        let texts = [plan.as_str(), self.rig.text()];
        let keep = |session: &Session| foreseen.procedure.keep(session).map_err(NotBegun);
        let (session, ledger) =
            Session::create_with(&self.data, entry, texts, keep).map_err(|NotBegun(error)| error)?;
        let dir = session.dir().to_owned();
        self.spawn(
            foreseen,
            session,
            ledger,
            Start { orders, is_resumed: false, is_attached: params.attached },
        )
        .inspect_err(|_| {
            // Nothing was acquired, so there is nothing to resume.
            let _ = std::fs::remove_dir_all(&dir);
        })
    }

    /// Whether a run is still wanted that is being prepared.
    fn go_on_preparing(&self, orders: &Orders) -> Result<(), RpcError> {
        if let Some(preparing) = &self.probes.preparing {
            preparing();
        }
        match orders.go_on() {
            true => Ok(()),
            false => {
                let what = "the run was cancelled while it was being prepared: nothing was moved or stored";
                Err(RpcError::new(ErrorCode::NotRunning, what))
            }
        }
    }

    /// A session of the data folder, given by its folder or its name.
    fn session(&self, given: &Path) -> Result<Session, RpcError> {
        Session::open_below(std::slice::from_ref(&self.data), given)
            .map_err(|error| no_session(error.to_string()))
    }

    fn resume_session(&self, params: &ResumeParams, orders: &Arc<Orders>) -> Result<Begun, RpcError> {
        let session = self.session(&params.session)?;
        if session.is_in_trash() {
            let dir = session.dir().display();
            return Err(no_session(format!(
                "{dir} is in the trash: `raysweep restore {dir}` brings it back"
            )));
        }
        let read = |path: PathBuf| {
            let folders = std::slice::from_ref(&self.data);
            input::open_below(folders, &path, MOST_TEXT_BYTES)
                .and_then(|file| input::read_open(&file, MOST_TEXT_BYTES))
                .map(|bytes| String::from_utf8_lossy(&bytes).into_owned())
                .map_err(|error| no_session(format!("cannot read {}: {}", path.display(), io_text(&error))))
        };
        let plan = read(session.plan_path())?;
        let state = session.state().map_err(|error| storage(&error))?;
        // Another rig file would not help.
        if let Some(what) = state.session.shape.contents.past() {
            return Err(no_session(format!("{}: {what}", session.dir().display())));
        }
        if !self.rig.is_of(&read(session.rig_path())?) {
            return Err(no_session(format!(
                "{} was begun with another rig file than the daemon's: start the daemon with {}",
                session.dir().display(),
                session.rig_path().display()
            )));
        }
        let ledger = session.resume().map_err(|error| storage(&error))?;
        let changed = changed_inputs(&session, ledger.state()).map_err(|error| storage(&error))?;
        if !changed.is_empty() {
            let changed: Vec<String> = changed.iter().map(ToString::to_string).collect();
            return Err(no_session(format!(
                "{} was changed after it was begun: {}; restore the original",
                session.dir().display(),
                changed.join("; ")
            )));
        }
        let foreseen =
            foresee_rest(&self.lab(), &plan, session.dir(), &ledger.state().session).map_err(|error| {
                RpcError {
                    message: error.render(&session.plan_path().display().to_string(), &plan),
                    ..invalid_plan(&error)
                }
            })?;
        let begun = ledger.state().session.shape;
        if foreseen.shape != begun {
            let what = format!(
                "{} was changed after the session was begun: its points are not those of the ledger; restore the original",
                session.plan_path().display(),
            );
            return Err(no_session(what));
        }
        let stored_bytes = session.stored_bytes().map_err(|error| storage(&error))?;
        self.check_needs(&foreseen.report, foreseen.instead, stored_bytes)?;
        self.go_on_preparing(orders)?;
        self.spawn(foreseen, session, ledger, Start { orders, is_resumed: true, is_attached: false })
    }
}

impl Control for Runner {
    fn status(&self) -> Status {
        let guard = match &self.rig {
            SharedRig::Plane(_) => mirror::light_guard(&self.data, None),
            SharedRig::Dots(rig) => rig.light_guard(&self.data),
        };
        let mirror = mirror::status(&self.data, &guard);
        Status { data: Some(self.data.clone()), mirror, ..self.board.status() }
    }

    fn check(&self, plan: &str) -> Result<CheckReport, RpcError> {
        self.computing.check(
            plan,
            || self.board.status().state,
            || {
                let Foreseen { mut report, procedure, .. } = self.foresee(plan)?;
                procedure.advise(&mut report);
                Ok(report)
            },
        )
    }

    fn design(&self, params: &DesignParams) -> Result<DesignReport, RpcError> {
        self.computing.between_runs(
            || self.board.status().state,
            || {
                let report = self.foresee(&params.plan)?.procedure.design(params)?;
                let plan = with_tables(&params.plan, &report.plan).map_err(|error| invalid_plan(&error))?;
                Ok(DesignReport { plan, ..report })
            },
        )
    }

    fn doctor(&self, params: &DoctorParams) -> Result<DoctorReport, RpcError> {
        let foresee = |plan| {
            let report = self.foresee(plan)?.report;
            Ok(PlanNeeds { disk_bytes: report.disk_bytes, light_s: report.light_s })
        };
        let state = || self.board.status().state;
        let needs = params.plan.as_ref();
        let needs = needs.map(|plan| self.computing.between_runs(state, || foresee(plan))).transpose()?;
        self.reserved(|orders| {
            let report = doctor::examine(&self.rig, &self.data, needs, &|| orders.go_on());
            Ok((report, None))
        })
    }

    fn run(&self, params: RunParams) -> Result<Started, RpcError> {
        self.start(|orders| self.begin(&params, orders))
    }

    fn resume(&self, params: ResumeParams) -> Result<Started, RpcError> {
        self.start(|orders| self.resume_session(&params, orders))
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

    fn abandon(&self, session: &Path) {
        let current = self.lock();
        let is_it = |current: &&Current| {
            current.begun.as_ref().is_some_and(|begun| begun.is_attached && begun.session == session)
        };
        if let Some(current) = current.as_ref().filter(is_it) {
            // Nothing happens if the run is over.
            current.orders.give(Order::Cancel);
        }
    }

    fn arm_light(&self) -> Result<(), RpcError> {
        let is_without_mirror = match &self.rig {
            SharedRig::Plane(_) => true,
            SharedRig::Dots(rig) => rig.file.mirror.is_none(),
        };
        if is_without_mirror {
            let what =
                "this rig has no mirror: there is no light to permit; a projector's needs no permission";
            return Err(RpcError::new(ErrorCode::MethodNotFound, what));
        }
        mirror::arm_light(&self.data)
    }

    fn sessions(&self) -> Result<Vec<SessionInfo>, RpcError> {
        let mut sessions = self.computing.now(|| sessions_in(&self.data)).map_err(|error| storage(&error))?;
        let status = self.board.status();
        let is_under_way = |info: &&mut SessionInfo| {
            !status.state.is_over() && status.session.as_ref() == Some(&info.session)
        };
        if let Some(info) = sessions.iter_mut().find(is_under_way) {
            info.state = "running".into();
            info.can_resume = false;
        }
        Ok(sessions)
    }

    fn calibrations(&self) -> Result<Vec<CalibrationInfo>, RpcError> {
        if !self.data.exists() {
            return Ok(Vec::new());
        }
        self.computing.now(|| calibrations_in(&self.data)).map_err(|error| storage(&error))
    }

    fn use_calibration(&self, session: &Path) -> Result<(), RpcError> {
        let session = self.session(session)?;
        let folder = session.dir().to_owned();
        // All results are read to hold them against their checksums.
        let damage = self.computing.now(|| damaged_calibration(&session)).map_err(|error| storage(&error))?;
        if let Some(damage) = damage {
            let advice = "`raysweep process` with --accept-damage makes it again";
            return Err(no_session(format!("{}: {damage}; {advice}", folder.display())));
        }
        let kept = KeptCalibration::read(&folder).map_err(no_session)?.ok_or_else(|| {
            no_session(format!(
                "{} has no calibration.toml: give a session of kind \"calibration\" whose run succeeded; `raysweep calibration list` lists them",
                folder.display()
            ))
        })?;
        self.computing.forget();
        kept.use_in(&self.data).map_err(|error| storage(&error))
    }

    fn viewfinder(&self, wanted: &ViewfinderParams) -> Result<(), RpcError> {
        check_look(wanted, &self.camera, matches!(self.rig, SharedRig::Dots(_)))?;
        let none = || {
            let what = "no viewfinder is running: `raysweep viewfinder` starts one";
            RpcError::new(ErrorCode::NotRunning, what)
        };
        let current = self.lock();
        let is_over = self.board.status().state.is_over();
        let current = current.as_ref().filter(|_| !is_over).ok_or_else(none)?;
        current.orders.look.change(wanted).map_err(|NoViewfinder| none())
    }

    fn events(&self) -> broadcast::Receiver<Event> {
        self.board.subscribe()
    }
}
