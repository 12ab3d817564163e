//! The run's thread: from acquisition to the results and the run's last word.

use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::Path;
use std::time::{Duration, Instant};

use raysweep_pipeline::message_of;
use raysweep_proto::{Event, RunState};
use raysweep_session::Session;
use raysweep_session::ledger::{EndEntry, EndState, Entry};

use super::board::Board;
use super::dots::{self, DotRun, Recorded, ResponseRun};
use super::engine::{self, Acquired, Run, RunError};
use super::orders::{Order, Orders};
use crate::dots as dot_rig;
use crate::live::Outlet;
use crate::processing::Task;
use crate::response::Findings;
use crate::results::{self, Results};
use crate::rig::Rig;
use crate::strips::Overview;

/// The run's thread: acquires, makes the results, and says how it ended. Nothing it meets leaves the daemon stuck.
pub fn conduct(run: Run, in_strips: bool, orders: &Orders, board: &Board, dir: &Path) {
    let task = run.task.clone();
    let rig = run.rig.clone();
    let live = run.live.clone();
    tracing::info!(session = %dir.display(), resumed = run.resumed, "run begins");
    let ended = catch_unwind(AssertUnwindSafe(|| -> Result<(EndEntry, Vec<String>), RunError> {
        let acquired = run.acquire()?;
        match task.is_film() {
            true => conclude_film(acquired, &task, &rig, orders),
            false => conclude(acquired, in_strips, &task, &rig, orders, live.as_ref()),
        }
    }))
    .unwrap_or_else(|panic| Err(RunError::Panicked(message_of(&*panic).to_owned())));
    finish(ended, task.points(), board, dir);
}

/// The run's thread on a dot rig; see [`conduct`].
pub fn conduct_batches(run: DotRun, orders: &Orders, board: &Board, dir: &Path) {
    let task = run.task.clone();
    let rig = run.rig.clone();
    tracing::info!(session = %dir.display(), "run begins");
    let ended = catch_unwind(AssertUnwindSafe(|| -> Result<(EndEntry, Vec<String>), RunError> {
        let dots::Acquired { session, mut ledger, mut problems, fault } = run.acquire()?;
        let stored = ledger.state().stored_points();
        let state = match &fault {
            Some(_) => EndState::Faulted,
            None if orders.now() == Order::Cancel => EndState::Cancelled,
            None => EndState::Complete,
        };
        let missing = task.batches().total() - stored;
        let end =
            EndEntry { error: fault.map(|fault| fault.to_string()), ..end_entry(state, stored, missing) };
        ledger.append(&Entry::End(end.clone()))?;
        if state == EndState::Complete {
            let made =
                dot_rig::make(&session, ledger.state(), &task, &rig.file, &task.specs, problems, &|| {
                    orders.go_on()
                })?;
            problems = made.problems;
        }
        Ok((end, problems))
    }))
    .unwrap_or_else(|panic| Err(RunError::Panicked(message_of(&*panic).to_owned())));
    finish(ended, task.batches().total(), board, dir);
}

/// The run's thread where a mirror's response is identified; see [`conduct`].
pub fn conduct_response(run: ResponseRun, board: &Board, dir: &Path) {
    let (task, rig, data) = (run.task.clone(), run.rig.clone(), run.data.clone());
    let points = task.stack_shape().points;
    tracing::info!(session = %dir.display(), "run begins");
    let ended = catch_unwind(AssertUnwindSafe(|| -> Result<(EndEntry, Vec<String>), RunError> {
        let Recorded { session, mut ledger, mut fault } = run.acquire()?;
        let stored = ledger.state().stored_points();
        let is_whole = fault.is_none() && stored == points;
        let findings = is_whole.then(|| Findings::of(&session, ledger.state(), &task)).transpose()?;
        if let Some(findings) = &findings {
            fault = findings.refusal().cloned().map(RunError::from);
            // Before the ledger says that the run is complete.
            findings.keep(&session, ledger.state(), Some(&data))?;
        }
        let state = match (&fault, is_whole) {
            (Some(_), _) => EndState::Faulted,
            (None, true) => EndState::Complete,
            (None, false) => EndState::Cancelled,
        };
        let error = fault.map(|fault| fault.to_string());
        let end = EndEntry { error, ..end_entry(state, stored, points - stored) };
        ledger.append(&Entry::End(end.clone()))?;
        if let Some(findings) = &findings {
            findings.write(&session, ledger.state(), &task, &rig.file)?;
        }
        Ok((end, findings.map_or_else(Vec::new, |findings| findings.warnings())))
    }))
    .unwrap_or_else(|panic| Err(RunError::Panicked(message_of(&*panic).to_owned())));
    finish(ended, points, board, dir);
}

/// Says how a run of so many points ended.
fn finish(ended: Result<(EndEntry, Vec<String>), RunError>, points: usize, board: &Board, dir: &Path) {
    let (end, warnings) = ended.unwrap_or_else(|error| {
        let stored = Session::open(dir).and_then(|session| session.state());
        let stored = stored.map_or(0, |state| state.stored_points());
        let end = end_entry(EndState::Faulted, stored, points - stored);
        (EndEntry { error: Some(error.to_string()), ..end }, Vec::new())
    });
    let state = if end.state == EndState::Faulted { RunState::Faulted } else { RunState::Idle };
    if let Some(error) = &end.error {
        tracing::error!(%error, session = %dir.display(), "run faulted");
        board.set_error(error.clone());
    }
    tracing::info!(session = %dir.display(), state = results::name_of(end.state), stored = end.stored, missing = end.missing, "run ended");
    let report = dir.join("report.html");
    let finished = Event::Finished {
        session: dir.to_owned(),
        state: results::name_of(end.state).into(),
        error: end.error,
        report: report.exists().then_some(report),
        stored: end.stored,
        missing: end.missing,
        film: board.status().film,
        warnings,
        final_s: end.final_s,
        light_s: end.light_s,
    };
    if board.status().state != RunState::Draining && state == RunState::Idle {
        let _ = board.go(RunState::Draining);
    }
    let _ = board.go(state);
    board.publish(finished);
}

/// Makes the results of what was acquired, unless it is told to end: then there are none yet, so that it ends soon.
fn conclude(
    acquired: Acquired,
    in_strips: bool,
    task: &Task,
    rig: &Rig,
    orders: &Orders,
    live: Option<&Outlet>,
) -> Result<(EndEntry, Vec<String>), RunError> {
    let Acquired { session, mut ledger, processing, vsync, exposures, latency, fault } = acquired;
    let whole = fault.is_none() && engine::missing(task, ledger.state()).is_empty();
    let began = Instant::now();
    let make = || match in_strips {
        true => Results::in_strips(processing, &session, ledger.state(), task, &|| orders.go_on()),
        false => Results::whole(processing, &session, task, &|| orders.go_on()),
    };
    let mut results = whole.then(make).transpose()?;
    let computed = began.elapsed();
    let state = match (&fault, &results) {
        (Some(_), _) => EndState::Faulted,
        (None, _) if orders.now() == Order::Cancel => EndState::Cancelled,
        (None, Some(_)) => EndState::Complete,
        (None, None) => EndState::Faulted,
    };
    let stored = ledger.state().stored_points();
    let mut end = EndEntry {
        state,
        error: fault.map(|fault| fault.to_string()),
        stored,
        missing: task.points() - stored,
        vsync,
        final_s: None,
        light_s: exposures.light_s(),
        settings_latency: latency,
    };
    if let (EndState::Complete, Some(results)) = (state, &mut results) {
        results.write_transport()?;
        end.final_s = exposures.until.map(|until| until.elapsed().as_secs_f64());
        let overview = results.overview();
        if let Some((live, overview)) = live.zip(overview.as_ref()) {
            show_last(live, overview, stored, computed);
        }
        results::write_products(&session, task, &results.products)?;
        ledger.append(&Entry::End(end.clone()))?;
        results::write_report(&session, ledger.state(), task, results, overview.as_ref())?;
        results::write_manifest(&session, ledger.state(), task, &rig.file)?;
        let (computed_s, written_s) = (computed.as_secs_f64(), (began.elapsed() - computed).as_secs_f64());
        tracing::info!(computed_s, written_s, final_s = end.final_s, "results made");
    } else {
        ledger.append(&Entry::End(end.clone()))?;
    }
    let warnings = results.map_or_else(Vec::new, |Results { products, mut problems, .. }| {
        problems.extend(results::warnings(&products));
        problems
    });
    Ok((end, warnings))
}

/// Writes a film's report: its transports are there already, so one that was ended early is as good as a short one.
fn conclude_film(
    acquired: Acquired,
    task: &Task,
    rig: &Rig,
    orders: &Orders,
) -> Result<(EndEntry, Vec<String>), RunError> {
    let Acquired { session, mut ledger, processing, vsync, exposures, latency, fault } = acquired;
    let state = match &fault {
        Some(_) => EndState::Faulted,
        None if orders.now() == Order::Cancel => EndState::Cancelled,
        None => EndState::Complete,
    };
    let stored = ledger.state().stored_points();
    let error = fault.map(|fault| fault.to_string());
    let final_s = exposures.until.map(|until| until.elapsed().as_secs_f64());
    let missing = task.points() - stored;
    let (light_s, settings_latency) = (exposures.light_s(), latency);
    let end = EndEntry { state, error, stored, missing, vsync, final_s, light_s, settings_latency };
    ledger.append(&Entry::End(end.clone()))?;
    let mut problems = processing.problems;
    if state != EndState::Faulted {
        results::write_film_report(&session, ledger.state(), task, &problems)?;
        results::write_manifest(&session, ledger.state(), task, &rig.file)?;
    }
    problems.extend(crate::film::shortcomings(ledger.state()));
    Ok((end, problems))
}

/// Shows the result where the estimates before it were shown.
fn show_last(live: &Outlet, overview: &Overview, points: usize, took: Duration) {
    let Overview { epipolar, non_epipolar, total, .. } = overview;
    if let Err(error) = live.show_images([epipolar, non_epipolar, total], points, took, true) {
        tracing::warn!(%error, "the result is not among the live images");
    }
}

fn end_entry(state: EndState, stored: usize, missing: usize) -> EndEntry {
    EndEntry {
        state,
        error: None,
        stored,
        missing,
        vsync: None,
        final_s: None,
        light_s: None,
        settings_latency: None,
    }
}
