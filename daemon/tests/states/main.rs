//! The states of runs under random requests and faults: never a forbidden transition, each request answered, at the end
//! the light off and the mirror parked, all frames accounted for and every session readable.
//! `RAYSWEEP_STATE_CASES=1000 cargo test -p raysweep --all-features --test states` tries more sequences than CI does.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

#[path = "../process/mod.rs"]
mod process;
mod rig;

use std::cell::RefCell;
use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use process::HUNG;
use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};
use raysweep::control::Control;
use raysweep_proto::{ErrorCode, Event, ResumeParams, RpcError, RunParams, RunState, Started};
use raysweep_session::Session;
use raysweep_session::integrity::Audit;
use rig::{Faults, Laboratory, PLANS, RigKind};
use tokio::sync::broadcast::Receiver;
use tokio::sync::broadcast::error::TryRecvError;

/// How long any answer may take, on a machine that does something else too.
const LONGEST_ANSWER: Duration = Duration::from_secs(60);

/// Sequences in each run of the tests, for each rig.
const CASES: u32 = 10;

/// Goes through the states of a run, if it is not over before it is paused.
const VISIT: [Step; 6] = [
    Step::Run(0),
    Step::Until(RunState::Running),
    Step::Pause,
    Step::Until(RunState::Paused),
    Step::Continue,
    Step::Cancel,
];
const MOST_VISITS: usize = 20;

/// What happens to a daemon's core.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Step {
    Run(usize),
    /// Of the session begun last.
    Resume,
    Pause,
    Continue,
    Cancel,
    ArmLight,
    Check,
    Wait(u64),
    /// Until a run has had this state, or all are over.
    Until(RunState),
    CameraIsGone,
    WatcherIsGone,
    ProjectorIsGone,
    MirrorIsGone,
    DiskFails,
    /// All devices and the disk are there again.
    Mended,
    ShutDown,
}

fn steps() -> impl Strategy<Value = Vec<Step>> {
    let step = prop_oneof![
        6 => (0..PLANS.len()).prop_map(Step::Run),
        3 => Just(Step::Resume),
        4 => Just(Step::Pause),
        4 => Just(Step::Continue),
        3 => Just(Step::Cancel),
        1 => Just(Step::ArmLight),
        1 => Just(Step::Check),
        8 => (0_u64..60).prop_map(Step::Wait),
        1 => Just(Step::CameraIsGone),
        1 => Just(Step::WatcherIsGone),
        1 => Just(Step::ProjectorIsGone),
        1 => Just(Step::MirrorIsGone),
        1 => Just(Step::DiskFails),
        3 => Just(Step::Mended),
    ];
    // At most one end, and after it requests that are refused.
    (prop::collection::vec(step.clone(), 3..16), prop::collection::vec(step, 0..3), any::<bool>()).prop_map(
        |(mut steps, after, ends)| {
            if ends {
                steps.push(Step::ShutDown);
                steps.extend(after);
            }
            steps
        },
    )
}

/// Follows the published states.
struct Watch {
    events: Receiver<Event>,
    state: Option<RunState>,
    /// All states so far, by their names.
    seen: BTreeSet<String>,
    begun: usize,
    finished: usize,
}

impl Watch {
    fn look(&mut self) {
        loop {
            match self.events.try_recv() {
                Ok(Event::State { state, .. }) => {
                    if let Some(before) = self.state {
                        assert!(before.may_become(state), "{before:?} became {state:?}");
                    }
                    self.state = Some(state);
                    self.seen.insert(format!("{state:?}"));
                    self.begun += usize::from(state == RunState::Preparing);
                }
                Ok(Event::Finished { .. }) => self.finished += 1,
                Ok(_) => {}
                Err(TryRecvError::Lagged(_)) => self.state = None,
                Err(TryRecvError::Empty | TryRecvError::Closed) => return,
            }
        }
    }

    fn until(&mut self, state: RunState) {
        let began = Instant::now();
        let name = format!("{state:?}");
        while !self.seen.contains(&name) && (self.begun == 0 || self.finished < self.begun) {
            assert!(began.elapsed() < HUNG, "no run is {name}, and none is over");
            std::thread::sleep(Duration::from_millis(1));
            self.look();
        }
    }
}

fn answered<T>(what: &str, request: impl FnOnce() -> T) -> T {
    let began = Instant::now();
    let answer = request();
    assert!(began.elapsed() < LONGEST_ANSWER, "{what} was answered after {:?}", began.elapsed());
    answer
}

/// Requests that cannot be met have a reason for it, and are no defects.
fn refused(what: &str, answer: Result<(), RpcError>) {
    if let Err(error) = answer {
        assert_ne!(error.name(), Some(ErrorCode::Internal), "{what}: {error}");
    }
}

/// Runs a sequence on a rig. Returns the states of its runs.
fn conduct(kind: RigKind, steps: &[Step]) -> BTreeSet<String> {
    let laboratory = Laboratory::new(kind);
    let runner = &laboratory.runner;
    let (state, seen) = (Some(RunState::Idle), BTreeSet::new());
    let mut watch = Watch { events: runner.events(), state, seen, begun: 0, finished: 0 };
    std::thread::scope(|scope| {
        let mut beginning = Vec::new();
        let mut last: Option<PathBuf> = None;
        let mut begin =
            |what: &'static str, request: Box<dyn FnOnce() -> Result<Started, RpcError> + Send>| {
                // Orders are also given while a run is prepared.
                beginning.push(scope.spawn(move || refused(what, answered(what, request).map(drop))));
            };
        for step in steps {
            watch.look();
            last = runner.status().session.or(last);
            match *step {
                Step::Run(plan) => {
                    let params = RunParams { plan: kind.plan(plan), ..RunParams::default() };
                    begin("run", Box::new(move || runner.run(params)));
                }
                Step::Resume => {
                    let session = last.clone().unwrap_or_default();
                    begin("resume", Box::new(move || runner.resume(ResumeParams { session })));
                }
                Step::Pause => refused("pause", answered("pause", || runner.pause())),
                Step::Continue => refused("continue", answered("continue", || runner.go_on())),
                Step::Cancel => refused("cancel", answered("cancel", || runner.cancel())),
                Step::ArmLight => refused("arm-light", answered("arm-light", || runner.arm_light())),
                Step::Check => refused("check", answered("check", || runner.check(PLANS[0])).map(drop)),
                Step::Wait(ms) => std::thread::sleep(Duration::from_millis(ms)),
                Step::Until(state) => watch.until(state),
                Step::CameraIsGone => Faults::begin(&laboratory.faults.camera),
                Step::WatcherIsGone => Faults::begin(&laboratory.faults.watcher),
                Step::ProjectorIsGone => Faults::begin(&laboratory.faults.projector),
                Step::MirrorIsGone => Faults::begin(&laboratory.faults.mirror),
                Step::DiskFails => laboratory.block_disk(last.as_deref()),
                Step::Mended => laboratory.mend(),
                Step::ShutDown => {
                    answered("shut down", || runner.shut_down());
                    let params = RunParams { plan: PLANS[0].into(), ..RunParams::default() };
                    let refused = runner.run(params).unwrap_err();
                    assert_eq!(refused.name(), Some(ErrorCode::Busy), "{refused}");
                }
            }
        }
    });
    laboratory.mend();
    let _ = answered("cancel", || runner.cancel());
    let began = Instant::now();
    while !matches!(runner.status().state, RunState::Idle | RunState::Faulted) {
        assert!(began.elapsed() < HUNG, "the run does not end: {:?}", runner.status());
        watch.look();
        std::thread::sleep(Duration::from_millis(2));
    }
    answered("shut down", || runner.shut_down());
    watch.look();
    assert!(matches!(watch.state, Some(RunState::Idle | RunState::Faulted) | None), "{:?}", watch.state);
    assert!(watch.finished <= watch.begun, "{} ends of {} runs", watch.finished, watch.begun);
    laboratory.is_dark();
    judge_sessions(&laboratory);
    watch.seen
}

/// Every session is readable, has an end, accounts for its frames, and has the data that its ledger names; the last one
/// that can be resumed is completed on a rig that is sound.
fn judge_sessions(laboratory: &Laboratory) {
    let data = laboratory.data();
    if !data.exists() {
        return;
    }
    let listing = raysweep_session::list(&data).unwrap();
    assert!(listing.unreadable.is_empty(), "{:?}", listing.unreadable);
    for summary in &listing.sessions {
        let session = Session::open(&summary.dir).unwrap();
        let (state, audit) = Audit::of(&session).unwrap();
        assert!(state.counts.balanced(), "{:?}", state.counts);
        assert!(state.end.is_some(), "{} has no end", summary.dir.display());
        assert!(audit.damage.is_empty(), "{:?}", audit.damage);
    }
    let Some(last) =
        listing.sessions.iter().rev().find(|session| ["sweep", "darks"].contains(&session.kind.as_str()))
    else {
        return;
    };
    let again = laboratory.again();
    let mut events = again.events();
    again.resume(ResumeParams { session: last.dir.clone() }).unwrap();
    loop {
        match events.blocking_recv() {
            Ok(Event::Finished { state, error, stored, missing, .. }) => {
                assert_eq!((state.as_str(), missing), ("complete", 0), "{error:?}, {stored} stored");
                break;
            }
            Ok(Event::Ask(_)) => drop(again.go_on()),
            Ok(_) | Err(tokio::sync::broadcast::error::RecvError::Lagged(_)) => {}
            Err(error) => panic!("{error}"),
        }
    }
    again.shut_down();
}

fn sequences(kind: RigKind) {
    let cases = std::env::var("RAYSWEEP_STATE_CASES").map_or(CASES, |cases| cases.parse().unwrap());
    let config = Config { cases, max_shrink_iters: 40, failure_persistence: None, ..Config::default() };
    // The same sequences each time; other ones with another number of cases would hide which have been tried.
    let mut runner = TestRunner::new_with_rng(
        config,
        proptest::test_runner::TestRng::deterministic_rng(proptest::test_runner::RngAlgorithm::ChaCha),
    );
    let seen = RefCell::new(BTreeSet::new());
    runner
        .run(&steps(), |steps| {
            seen.borrow_mut().extend(conduct(kind, &steps));
            Ok(())
        })
        .unwrap_or_else(|error| panic!("{kind:?}: {error}"));
    // Which states the sequences meet depends on the speed of the machine; all of them are to be tried on any.
    let all = ["Armed", "Draining", "Idle", "Paused", "Preparing", "Running"];
    let unseen = || all.into_iter().filter(|state| !seen.borrow().contains(*state)).collect::<Vec<_>>();
    for _ in 0..MOST_VISITS {
        if unseen().is_empty() {
            return;
        }
        let visited = conduct(kind, &VISIT);
        seen.borrow_mut().extend(visited);
    }
    panic!("{kind:?}: these states were not tried: {:?}", unseen());
}

#[test]
fn random_requests_and_faults_on_a_plane_rig_end_in_order() {
    sequences(RigKind::Plane);
}

#[test]
fn random_requests_and_faults_with_an_operator_end_in_order() {
    sequences(RigKind::Operated);
}

#[test]
fn random_requests_and_faults_on_a_dot_rig_end_in_order() {
    sequences(RigKind::Dots);
}

#[test]
fn a_session_is_resumed_only_where_its_run_would_be_begun() {
    let laboratory = Laboratory::new(RigKind::Plane);
    let mut events = laboratory.runner.events();
    let params = RunParams { plan: PLANS[0].into(), ..RunParams::default() };
    let session = laboratory.runner.run(params.clone()).unwrap().session;
    while !matches!(events.blocking_recv(), Ok(Event::Progress(_))) {}
    laboratory.runner.cancel().unwrap();
    laboratory.runner.shut_down();
    let small = laboratory.again().with_memory_limit(1);
    let refused = small.run(params).unwrap_err();
    assert_eq!(refused.name(), Some(ErrorCode::Storage), "{refused}");
    let also = small.resume(ResumeParams { session: session.clone() }).unwrap_err();
    assert_eq!(also.to_string(), refused.to_string());
    laboratory.again().resume(ResumeParams { session }).unwrap();
}
