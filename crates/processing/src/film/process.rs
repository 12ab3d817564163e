//! Offline processing: recomputes the transports of a film from its stored frames.

use std::sync::Arc;

use ndarray::{Array2, Axis};
use raysweep_config::FilmPlan;
use raysweep_core::{Counts, SettingsId};
use raysweep_pipeline::{Point, ProductSpec, Stages, Unit, run_stages};
use raysweep_session::Session;
use raysweep_session::film::{CycleEntry, crc32};
use raysweep_session::ledger::State;
use raysweep_session::stack::ArrayName;
use raysweep_transport::plane::Setting;

use super::product::write_products;
use super::report::{self, forget_findings, note_findings};
use super::task::{FilmTask, create_transports};
use crate::plane::{append_argument, manifest, unit_of};
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
    let mut products = write_products(session, state, &task, &specs, &is_wanted, &|| true)?;
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
        let refused = |spec: &ProductSpec| spec.not_of_a_film().or_else(|| spec.beyond(reach_rows));
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
    let Some(dark) = dark_image(session, state, stages)? else {
        problems.push("the dark image is missing or damaged: no transport can be made without it".into());
        return Ok(problems);
    };
    let film = session.film()?;
    let transports = create_transports(session, task, solver.reach_rows())?;
    let mut summary = state.film.clone().unwrap_or_default();
    forget_findings(&mut summary);
    for entry in state.cycles() {
        let frames = match film.read(entry.cycle) {
            Ok(Some(frames)) if crc32(frames.view()) == entry.crc32 => frames,
            Ok(_) => {
                problems.push(format!(
                    "cycle {} is damaged: its checksum differs from the ledger's",
                    entry.cycle
                ));
                continue;
            }
            Err(error) => {
                problems.push(format!("cycle {} is damaged ({error})", entry.cycle));
                continue;
            }
        };
        let images = frames.axis_iter(Axis(0)).zip(task.task.settings()).zip(&entry.delays_us).map(
            |((frame, (ordinal, point)), &delay_us)| {
                let unit = frame_unit((ordinal, point), entry, delay_us, frame.mapv(u32::from));
                let setting = Setting::new(delay_us, entry.exposure_us);
                run_stages(stages, &unit).map(|image| (setting, Arc::new(image)))
            },
        );
        let solved =
            images.collect::<Result<Vec<_>, _>>().map_err(|error| error.to_string()).and_then(|images| {
                match solver.solve(&images, &dark, &|| true) {
                    Ok(transport) => Ok((transport, images)),
                    Err(error) => Err(error.to_string()),
                }
            });
        match solved {
            Ok((transport, images)) => {
                transports.write(entry.cycle, transport.t.view())?;
                if let Some(learned) = solver.learn(&images, &dark) {
                    note_findings(&mut summary, learned);
                }
            }
            Err(error) => problems.push(format!("cycle {}: {error}", entry.cycle)),
        }
    }
    state.film = Some(summary);
    Ok(problems)
}

fn frame_unit((ordinal, point): (u32, &Point), entry: &CycleEntry, delay_us: f64, sum: Array2<u32>) -> Unit {
    Unit {
        id: SettingsId { point: ordinal, attempt: entry.cycle as u32 },
        frames: 1,
        delay_us: point.delay_us,
        exposure_us: entry.exposure_us,
        delays_us: vec![delay_us],
        run: 0,
        starts_ns: Vec::new(),
        sum: Arc::new(sum),
        clipped: None,
        counts: Counts::default(),
    }
}

/// The stored dark image after all stages, if it is intact.
fn dark_image(
    session: &Session,
    state: &State,
    stages: &Stages,
) -> raysweep_session::Result<Option<Array2<f32>>> {
    let Some(entry) = state.point(ArrayName::Dark, 0) else { return Ok(None) };
    let sum = session.stack()?.read_point(ArrayName::Dark, 0)?;
    if raysweep_session::stack::crc32(sum.view()) != entry.crc32 {
        return Ok(None);
    }
    Ok(run_stages(stages, &unit_of(0, entry, sum, None)).ok())
}
