//! The life of a run, which all procedures share: from a checked plan to the final report.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use raysweep_pipeline::message_of;
use raysweep_proto::{CheckReport, DesignParams, DesignReport, ErrorCode, Event, RpcError, RunState};
use raysweep_session::Session;
use raysweep_session::integrity::damaged_data;
use raysweep_session::ledger::{EndEntry, EndState, Entry, Ledger};
use raysweep_session::stack::{ArrayName, StackShape};

use super::board::StatusBoard;
use super::error::RunError;
use super::orders::{Order, Orders};
use crate::live::Outlet;
use crate::probes::Probes;

/// How long the end of a run waits for its other threads.
const MOST_HELD: Duration = Duration::from_secs(10);
/// Most damaged images that a warning names.
const MOST_NAMED: usize = 10;

/// A plan on the daemon's rig, and the prediction of its run.
pub struct Foreseen {
    /// The prediction.
    pub report: CheckReport,
    /// Name of the procedure.
    pub kind: &'static str,
    /// Name of the session.
    pub name: String,
    /// Shape of the session's stack.
    pub shape: StackShape,
    /// Projector row that camera row 0 sees; 0 on a dot rig.
    pub first_row: usize,
    /// Advice for the user if memory is insufficient.
    pub instead: &'static str,
    /// The procedure that carries it out.
    pub procedure: Box<dyn Measurement>,
}

/// The part of a run that differs between procedures.
pub trait Measurement: Send {
    /// Adds what is computed only on request: a run must not wait for it.
    fn advise(&self, _report: &mut CheckReport) {}

    /// Searches its settings for a wanted error or a time of light.
    ///
    /// # Errors
    /// If its plan has no settings to search, or nothing that suits is found.
    fn design(&self, _params: &DesignParams) -> Result<DesignReport, RpcError> {
        let message =
            "the settings of this plan cannot be searched: give a plan of kind \"sweep\" or \"film\"";
        Err(RpcError::new(ErrorCode::InvalidPlan, message))
    }

    /// Stores in a new session what the run's results will need.
    ///
    /// # Errors
    /// When it is not available or cannot be written.
    fn keep(&self, _session: &Session) -> Result<(), RpcError> {
        Ok(())
    }

    /// Acquires what is missing and makes the results.
    ///
    /// # Errors
    /// When the run could not begin, or its results cannot be written. A fault during acquisition is in
    /// [`Ended::end`]: what was acquired is kept.
    fn measure(self: Box<Self>, run: Run) -> Result<Ended, RunError>;
}

/// What every run needs.
pub struct Run {
    /// Its session.
    pub session: Session,
    /// Its ledger, locked for this run.
    pub ledger: Ledger,
    /// Whether earlier runs have stored points in the session.
    pub is_resumed: bool,
    /// The daemon's data folder, which has the mirror's state.
    pub data: PathBuf,
    /// Orders to the run.
    pub orders: Arc<Orders>,
    /// State and events published by the run.
    pub board: Arc<StatusBoard>,
    /// Where live images are published during the run, if anywhere.
    pub live: Option<Outlet>,
    /// What tests insert.
    pub probes: Probes,
    /// Warnings from before it began; those of its end begin with them.
    pub warnings: Vec<String>,
}

impl Run {
    /// Records in the ledger that the run begins.
    ///
    /// # Errors
    /// When the ledger cannot be written.
    pub fn note_beginning(&mut self) -> Result<(), RunError> {
        let started = jiff::Timestamp::now();
        Ok(self.ledger.append(&Entry::Run { started, resumed: self.is_resumed })?)
    }

    /// Checks the data that earlier runs have stored. What is damaged counts as missing, so that this run acquires it
    /// again; returns what to tell the operator of it.
    fn leave_out_damage(&mut self) -> Option<String> {
        let state = self.ledger.state();
        let damage = damaged_data(&self.session, state, &|| self.orders.go_on());
        let first = damage.iter().take(MOST_NAMED).map(ToString::to_string).collect::<Vec<_>>().join("; ");
        if damage.is_empty() {
            return None;
        }
        let (count, stored) = (damage.len(), ArrayName::ALL.map(|array| state.stored(array).count()));
        let stored = stored.iter().sum::<usize>();
        let more = if count > MOST_NAMED { "; ..." } else { "" };
        self.ledger.leave_out(&damage);
        let text = format!(
            "{count} of {stored} stored images were damaged, so they are acquired again: {first}{more}"
        );
        tracing::warn!("{text}");
        Some(text)
    }
}

/// How a run ended.
pub struct Ended {
    /// The ledger's entry, which has the run's warnings.
    pub end: EndEntry,
    /// What the run found, beside its products, in a sentence each.
    pub found: Vec<String>,
}

/// The run's thread: acquires, makes the results, and reports the end. Errors and panics never leave the daemon stuck.
pub fn conduct(procedure: Box<dyn Measurement>, mut run: Run, shape: StackShape) {
    let (board, dir) = (run.board.clone(), run.session.dir().to_owned());
    tracing::info!(session = %dir.display(), resumed = run.is_resumed, "run begins");
    let mut warnings = run.warnings.clone();
    let measure = || {
        warnings.extend(run.leave_out_damage());
        run.warnings.clone_from(&warnings);
        procedure.measure(run)
    };
    let ended = catch_unwind(AssertUnwindSafe(measure))
        .unwrap_or_else(|panic| Err(RunError::Panicked(message_of(&*panic).to_owned())));
    let ended = ended.unwrap_or_else(|error| failed(&error, shape.points(), &dir, warnings));
    finish(ended, &board, &dir, shape);
}

/// The end of a run that could not reach its own, with the warnings from before it began: also recorded in the ledger, so
/// that the session does not look as if it were still under way.
fn failed(error: &RunError, points: usize, dir: &Path, warnings: Vec<String>) -> Ended {
    let faulted = |stored, missing, warnings| EndEntry {
        error: Some(error.to_string()),
        ..EndEntry::new(EndState::Faulted, stored, missing, warnings)
    };
    let recorded = Session::open(dir).and_then(|session| freed(&session)).and_then(|mut ledger| {
        let state = ledger.state();
        // An end that was recorded before the report failed has warnings of its own.
        let known = state.end.as_ref().map_or_else(Vec::new, |end| end.warnings.clone());
        let mut end = faulted(state.stored_points(), state.missing_points(), warnings.clone());
        end.warnings.retain(|warning| !known.contains(warning));
        end.warnings.extend(known);
        ledger.append(&Entry::End(end.clone())).map(|()| end)
    });
    let end = recorded.unwrap_or_else(|not_recorded| {
        tracing::warn!(error = %not_recorded, "the end of the run is not in the ledger");
        let stored = Session::open(dir).and_then(|session| session.state());
        let stored = stored.map_or(0, |state| state.stored_points());
        faulted(stored, points.saturating_sub(stored), warnings)
    });
    Ended { end, found: Vec::new() }
}

/// The ledger of a run that has ended. After a panic, the run's other threads hold it until they have ended too.
fn freed(session: &Session) -> raysweep_session::Result<Ledger> {
    let began = Instant::now();
    loop {
        match session.resume() {
            Err(raysweep_session::Error::InUse { .. }) if began.elapsed() < MOST_HELD => {
                std::thread::sleep(Duration::from_millis(10));
            }
            freed => return freed,
        }
    }
}

/// Reports the end of a run.
fn finish(Ended { end, found }: Ended, board: &StatusBoard, dir: &Path, shape: StackShape) {
    let state = if end.state == EndState::Faulted { RunState::Faulted } else { RunState::Idle };
    if let Some(error) = &end.error {
        tracing::error!(%error, session = %dir.display(), "run faulted");
        board.set_error(error.clone());
    }
    tracing::info!(session = %dir.display(), state = end.state.name(), stored = end.stored, missing = end.missing, "run ended");
    let report = dir.join("report.html");
    let finished = Event::Finished {
        session: dir.to_owned(),
        state: end.state.name().into(),
        error: end.error,
        report: report.exists().then_some(report),
        stored: end.stored,
        missing: end.missing,
        is_final: end.is_final || shape.contents.past().is_some(),
        film: board.status().film,
        warnings: end.warnings,
        found,
        final_s: end.final_s,
        light_s: end.light_s,
        simulated_time: end.simulated_time,
    };
    if board.status().state != RunState::Draining && state == RunState::Idle {
        let _ = board.go(RunState::Draining);
    }
    let _ = board.go(state);
    board.publish(finished);
}

/// The end state of a run, given its fault, if any, and its orders.
pub fn end_state(fault: Option<&RunError>, orders: &Orders) -> EndState {
    match fault {
        Some(_) => EndState::Faulted,
        None if orders.now() == Order::Cancel => EndState::Cancelled,
        None => EndState::Complete,
    }
}
