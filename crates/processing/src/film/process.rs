//! Offline processing: recomputes the transports of a film from its stored frames.

use std::sync::Arc;

use raysweep_config::FilmPlan;
use raysweep_pipeline::{ProductSpec, Stages};
use raysweep_session::Session;
use raysweep_session::ledger::State;

use super::frames::{NO_DARK, StoredCycle, StoredFrames};
use super::product::write_products;
use super::report::{self, forget_findings, note_findings};
use super::task::{FilmTask, create_transports, write_transport};
use crate::plane::{append_argument, manifest};
use crate::stored::{Asked, ProcessError, Processed, Stored};

/// Recomputes the transports of a stored film, and its products.
///
/// # Errors
/// When a product cannot be made from a film, before anything is written; when the session cannot be written.
pub fn process(stored: &Stored<'_>, film: FilmPlan, asked: &Asked) -> Result<Processed, ProcessError> {
    let Stored { session, state, plan, .. } = stored;
    let rig = stored.plane_rig()?;
    let shape = state.session.shape;
    let mut task = FilmTask::new(plan, film, &stored.known(&rig)?);
    Arc::make_mut(&mut task.task).left_out = state.left_out();
    stored.check_contents(task.contents())?;
    let stages = task.stages().map_err(|error| stored.in_plan(&error))?;
    let (specs, wanted) = products(&task, asked, stored)?;
    let is_wanted = |name: &str| specs[..wanted].iter().any(|spec| spec.name() == name);
    let mut state = State::clone(state);
    let mut problems = make_transports(session, &task, &mut state, &stages)?;
    let state = &state;
    let mut products = write_products(session, state, &task, &stages, &specs, &is_wanted, &|| true)?;
    // What stands in the way of the transports stands in that of the products.
    products.problems.retain(|problem| !problems.contains(problem));
    problems.append(&mut products.problems);
    report::write(session, state, &task, &products, &problems)?;
    manifest::write(session, state, &task.task, &rig)?;
    Ok(Processed {
        report: session.report_path(),
        stored: state.stored_points(),
        points: shape.points(),
        problems,
    })
}

/// The products of the plan and those asked for, and how many of them are to be written: the first ones. The others are
/// only shown in the report, which is written anew.
fn products(
    task: &FilmTask,
    asked: &Asked,
    stored: &Stored<'_>,
) -> Result<(Vec<ProductSpec>, usize), ProcessError> {
    let of_plan = task.products().map_err(|error| stored.in_plan(&error))?;
    let mut specs = if asked.only { Vec::new() } else { of_plan.clone() };
    let reach_rows = task.solver().map_err(|error| stored.in_plan(&error))?.reach_rows();
    for argument in &asked.products {
        let before = specs.len();
        append_argument(&mut specs, argument, &task.task).map_err(ProcessError::Product)?;
        let refused = |spec: &ProductSpec| task.cannot_make(spec).or_else(|| spec.beyond(reach_rows));
        if let Some(what) = specs[before..].iter().find_map(refused) {
            return Err(ProcessError::Product(format!("--product {argument}: {what}")));
        }
    }
    let wanted = specs.len();
    for spec in of_plan {
        if specs.iter().all(|other| other.name() != spec.name()) {
            specs.push(spec);
        }
    }
    Ok((specs, wanted))
}

/// Computes the transports of all stored cycles, and enters into the film's summary what its first cycles showed;
/// returns the problems.
fn make_transports(
    session: &Session,
    task: &FilmTask,
    state: &mut State,
    stages: &Stages,
) -> raysweep_session::Result<Vec<String>> {
    let mut problems = state.left_out();
    let mut solver = match task.solver() {
        Ok(solver) => solver,
        Err(error) => {
            problems.push(error.to_string());
            return Ok(problems);
        }
    };
    let Some(frames) = StoredFrames::open(session, state, task, stages)? else {
        problems.push(NO_DARK.into());
        return Ok(problems);
    };
    let transports = create_transports(session, task, solver.reach_rows())?;
    let mut summary = state.film.clone().unwrap_or_default();
    forget_findings(&mut summary);
    for entry in state.cycles() {
        let frames_of = frames.read(entry);
        let solved = frames_of.and_then(|StoredCycle { frames: of_cycle, .. }| {
            let solved = solver.solve(&of_cycle, &frames.dark, &|| true);
            solved
                .map(|transport| (transport, of_cycle))
                .map_err(|error| format!("cycle {}: {error}", entry.cycle))
        });
        match solved {
            Ok((transport, of_cycle)) => {
                write_transport(&transports, entry.cycle, &transport)?;
                if let Some(learned) = solver.learn(&of_cycle, &frames.dark) {
                    note_findings(&mut summary, learned);
                }
            }
            Err(problem) => problems.push(problem),
        }
    }
    state.film = Some(summary);
    Ok(problems)
}
