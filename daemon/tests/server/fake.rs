//! A daemon without a rig; the first word of the plan determines what it does.

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use raysweep::control::Control;
use raysweep::server::{Access, Limits, Listening, serve_within};
use raysweep_core::{Counts, LossCause, PointUnderWay, VsyncStats};
use raysweep_proto::{
    BetterPlan, CalibrationInfo, CheckReport, Client, DesignParams, DesignReport, DoctorCheck, DoctorParams,
    DoctorReport, ErrorCode, ErrorRange, Event, ExpectedError, Grade, MirrorStatus, NoiseEstimate,
    NoiseSource, PlanAdvice, Progress, Question, ResumeParams, RigAccuracy, RpcError, RunParams, RunState,
    SessionInfo, Started, Status, ViewfinderParams,
};
use tokio::runtime::Runtime;
use tokio::sync::{broadcast, oneshot};

/// Number of events that the fake queues for a subscriber.
pub const KEPT_EVENTS: usize = 16;

/// A complete [`Control`] that consists only of its state.
pub struct Fake {
    pub state: Mutex<RunState>,
    pub runs: Mutex<Vec<RunParams>>,
    pub abandoned: Mutex<Vec<PathBuf>>,
    pub resumed: Mutex<Vec<PathBuf>>,
    /// Held by a test to block a call of `check` with the plan `wait`.
    pub gate: Mutex<()>,
    /// Number of calls of `check`.
    pub checks: AtomicUsize,
    /// Path of the file with live images; the file need not exist.
    pub live: PathBuf,
    events: broadcast::Sender<Event>,
}

impl Fake {
    fn new(live: PathBuf) -> Self {
        Self {
            state: Mutex::new(RunState::Idle),
            runs: Mutex::default(),
            abandoned: Mutex::default(),
            resumed: Mutex::default(),
            gate: Mutex::default(),
            checks: AtomicUsize::new(0),
            live,
            events: broadcast::Sender::new(KEPT_EVENTS),
        }
    }

    pub fn publish(&self, event: Event) {
        let _ = self.events.send(event);
    }

    fn go(&self, state: RunState) {
        *self.state.lock().unwrap() = state;
        self.publish(Event::State { state, session: Some(session()) });
    }

    fn finish(&self, state: &str, missing: usize) {
        self.go(if state == "faulted" { RunState::Faulted } else { RunState::Idle });
        let error = (state == "faulted").then(|| "camera: unplugged".to_owned());
        let report = (state == "complete").then(|| session().join("report.html"));
        let (session, state) = (session(), state.to_owned());
        self.publish(Event::Finished {
            session,
            state,
            error,
            report,
            stored: 75 - missing,
            missing,
            is_final: false,
            film: None,
            warnings: Vec::new(),
            found: Vec::new(),
            final_s: None,
            light_s: None,
            simulated_time: false,
        });
    }

    /// Starts a run and, unless the plan says `hang`, ends it as the plan says.
    fn begin(&self, plan: &str) -> Result<Started, RpcError> {
        if *self.state.lock().unwrap() == RunState::Running {
            return Err(RpcError::new(ErrorCode::Busy, "the daemon is running: cancel the run"));
        }
        self.go(RunState::Running);
        self.publish(Event::Progress(progress()));
        self.publish(Event::Lost { point: 3, attempt: 0, counts: progress().counts });
        match plan {
            "hang" => {}
            "fault" => self.finish("faulted", 40),
            "gaps" => self.finish("complete", 2),
            _ => self.finish("complete", 0),
        }
        Ok(Started { session: session() })
    }

    fn turn(&self, from: RunState, to: RunState) -> Result<(), RpcError> {
        if *self.state.lock().unwrap() != from {
            return Err(RpcError::new(ErrorCode::NotRunning, "there is no run"));
        }
        self.go(to);
        Ok(())
    }
}

pub fn session() -> PathBuf {
    "/data/20260101-000000_fake".into()
}

pub fn progress() -> Progress {
    let mut counts = Counts { expected: 300, averaged: 296, ..Counts::default() };
    counts.lose(LossCause::CameraGap, 4);
    Progress {
        points_stored: 37,
        points_planned: 75,
        under_way: Some(PointUnderWay { frames: 3, of: 8 }),
        counts,
        elapsed_s: 1.5,
        left_s: Some(1.5),
        frames_per_s: 200.0,
    }
}

fn expected() -> ExpectedError {
    let total = ErrorRange { low: 0.015, median: 0.023, high: 0.075 };
    ExpectedError { total, noise: total, bias: total, calibration: total, band: total }
}

pub fn examined() -> DoctorReport {
    let check = DoctorCheck {
        name: "vsync".into(),
        grade: Grade::Warning,
        found: "2 false edges".into(),
        remedy: Some("look at the line".into()),
    };
    DoctorReport { user: "lab".into(), version: "1".into(), checks: vec![check] }
}

pub fn designed() -> DesignReport {
    DesignReport {
        points: 15,
        frames: 120,
        light_s: 2.0,
        expected: expected(),
        plan: "kind = \"sweep\"\n".into(),
        warnings: vec!["not reached".into()],
    }
}

pub fn report() -> CheckReport {
    let expected = expected();
    CheckReport {
        points: 75,
        extra_points: 6,
        frames: 648,
        light_s: 10.8,
        memory_bytes: 20 << 20,
        memory_free_bytes: 8_000_000_000,
        disk_bytes: 30 << 20,
        disk_free_bytes: 1 << 40,
        settings: Some("[sweep]\naverage = 4\n".into()),
        settings_refused: None,
        white_dn: None,
        reach_rows: Some((-94, 94)),
        condition: Some(1234.5),
        advice: Some(PlanAdvice {
            rig: RigAccuracy {
                calibrated: false,
                latency_us: 0.3,
                edge_us: 0.5,
                exposure_us: 0.1,
                place_rows: 0.02,
            },
            noise: NoiseEstimate { dark: 0.002, shot: 0.0155, source: NoiseSource::Assumed },
            prior: "split".into(),
            expected,
            better: Some(BetterPlan {
                points: 74,
                frames: 616,
                expected,
                table: "[sweep]\naverage = 8\n".into(),
            }),
        }),
        film: None,
        batches: None,
        response: None,
        warnings: vec!["few points".into()],
    }
}

pub fn listed() -> SessionInfo {
    SessionInfo {
        session: session(),
        name: "fake".into(),
        created: "2026-01-01T00:00:00Z".into(),
        stored: 75,
        points: 75,
        can_resume: false,
        state: "complete".into(),
        kind: "sweep".into(),
        operator: Some("Ada".into()),
        sample: Some("candle".into()),
        tags: vec!["a".into()],
        warnings: vec!["few frames".into()],
    }
}

/// The error for the plan `bad ...`, which marks its fifth and sixth byte.
pub fn bad_plan() -> RpcError {
    let mut error =
        RpcError::new(ErrorCode::InvalidPlan, "count is 0; 1 to 1000 is allowed").of_field("sweep.count");
    error.data.as_mut().unwrap().span = Some((4, 6));
    error
}

impl Control for Fake {
    fn status(&self) -> Status {
        let state = *self.state.lock().unwrap();
        Status {
            role: None,
            operators: None,
            version: "1".into(),
            rig: "plane".into(),
            state,
            question: (state == RunState::Paused)
                .then(|| Question { text: "cover the lens".into(), wants_answer: true }),
            data: self.live.parent().map(Path::to_owned),
            session: Some(session()),
            progress: Some(progress()),
            vsync: Some(VsyncStats { edges: 10, period_us: 16_666.7, ..VsyncStats::default() }),
            vsync_clock: None,
            film: None,
            viewfinder: None,
            settings_latency: None,
            ended: None,
            error: None,
            warnings: Vec::new(),
            live: self.live.exists().then(|| self.live.clone()),
            mirror: Some(MirrorStatus { parked: true, laser: false, light: "armed".into() }),
        }
    }

    fn check(&self, plan: &str) -> Result<CheckReport, RpcError> {
        self.checks.fetch_add(1, Ordering::SeqCst);
        match plan.split_whitespace().next() {
            Some("bad") => return Err(bad_plan()),
            Some("panic") => panic!("a defect, on purpose"),
            Some("wait") => drop(self.gate.lock()),
            _ => {}
        }
        Ok(report())
    }

    fn design(&self, _: &DesignParams) -> Result<DesignReport, RpcError> {
        Ok(designed())
    }

    fn doctor(&self, _: &DoctorParams) -> Result<DoctorReport, RpcError> {
        Ok(examined())
    }

    fn run(&self, params: RunParams) -> Result<Started, RpcError> {
        if params.plan.starts_with("bad") {
            return Err(bad_plan());
        }
        self.runs.lock().unwrap().push(params.clone());
        self.begin(&params.plan)
    }

    fn resume(&self, params: ResumeParams) -> Result<Started, RpcError> {
        if params.session == Path::new("none") {
            return Err(RpcError::new(ErrorCode::NoSession, "there is no session `none`"));
        }
        self.resumed.lock().unwrap().push(params.session);
        self.begin("")
    }

    fn pause(&self) -> Result<(), RpcError> {
        self.turn(RunState::Running, RunState::Paused)
    }

    fn go_on(&self) -> Result<(), RpcError> {
        self.turn(RunState::Paused, RunState::Running)
    }

    /// Cancels a run, unless it was started with the note `stubborn`.
    fn cancel(&self) -> Result<(), RpcError> {
        if *self.state.lock().unwrap() != RunState::Running {
            return Err(RpcError::new(ErrorCode::NotRunning, "there is no run"));
        }
        if self.runs.lock().unwrap().last().and_then(|run| run.note.clone()).as_deref() != Some("stubborn") {
            self.finish("cancelled", 38);
        }
        Ok(())
    }

    fn abandon(&self, session: &Path) {
        self.abandoned.lock().unwrap().push(session.to_owned());
    }

    fn arm_light(&self) -> Result<(), RpcError> {
        Ok(())
    }

    fn viewfinder(&self, _: &ViewfinderParams) -> Result<(), RpcError> {
        Err(RpcError::new(ErrorCode::NotRunning, "no viewfinder is running"))
    }

    fn sessions(&self) -> Result<Vec<SessionInfo>, RpcError> {
        Ok(vec![listed()])
    }

    fn calibrations(&self) -> Result<Vec<CalibrationInfo>, RpcError> {
        Ok(vec![CalibrationInfo {
            session: session(),
            made: "2026-01-01T00:00:00Z".into(),
            camera: "fake".into(),
            in_use: true,
            problem: None,
        }])
    }

    fn use_calibration(&self, session: &Path) -> Result<(), RpcError> {
        if session == Path::new("none") {
            return Err(RpcError::new(ErrorCode::NoSession, "there is no session `none`"));
        }
        Ok(())
    }

    fn events(&self) -> broadcast::Receiver<Event> {
        self.events.subscribe()
    }
}

/// A server on a real socket, with the fake behind it.
pub struct Daemon {
    pub fake: Arc<Fake>,
    pub path: PathBuf,
    pub folder: tempfile::TempDir,
    runtime: Option<Runtime>,
    stop: Option<oneshot::Sender<()>>,
    served: Option<tokio::task::JoinHandle<std::io::Result<()>>>,
}

impl Daemon {
    pub fn start() -> Self {
        Self::with(Limits::default(), Access::new(None))
    }

    pub fn with(limits: Limits, access: Access) -> Self {
        let runtime =
            tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("raysweepd.sock");
        let fake = Arc::new(Fake::new(folder.path().join("live")));
        let (stop, stopped) = oneshot::channel::<()>();
        let Listening { listener, file } = {
            let _within = runtime.enter();
            Listening::bind(&path).unwrap()
        };
        let control = fake.clone();
        let served = runtime.spawn(async move {
            let served = serve_within(limits, listener, control, access, async { drop(stopped.await) }).await;
            drop(file);
            served
        });
        Self { fake, path, folder, runtime: Some(runtime), stop: Some(stop), served: Some(served) }
    }

    pub fn client(&self) -> Client {
        Client::connect(&self.path).unwrap()
    }

    /// Stops the server and waits for its end.
    pub fn stop(&mut self) {
        if let (Some(runtime), Some(served)) = (&self.runtime, self.served.take()) {
            drop(self.stop.take());
            runtime.block_on(served).unwrap().unwrap();
        }
    }
}

impl Drop for Daemon {
    fn drop(&mut self) {
        // Clients left behind by a failed test must not block its end.
        if let Some(runtime) = self.runtime.take() {
            runtime.shutdown_timeout(Duration::from_millis(100));
        }
    }
}
