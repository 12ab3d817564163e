//! Sweeps: computes one light transport from images at many delays and exposures.

mod report;
mod results;
mod strips;
mod task;

use std::sync::Arc;

use raysweep_config::SweepPlan;

pub use self::report::write as write_report;
pub use self::results::{Results, write_products};
pub use self::strips::Overview;
pub use self::task::SweepTask;
use crate::memory::{MemoryNeed, available_bytes};
use crate::plane::{append_argument, manifest};
use crate::stored::{Asked, ProcessError, Processed, Stored};

/// Makes the products of a stored sweep again.
///
/// # Errors
/// When a product cannot be made from it, before anything is written; when the session cannot be written.
pub fn process(stored: &Stored<'_>, sweep: SweepPlan, asked: &Asked) -> Result<Processed, ProcessError> {
    let Stored { session, state, plan, .. } = stored;
    let rig = stored.plane_rig()?;
    let shape = state.session.shape;
    let mut sweep = SweepTask::new(plan, sweep, &stored.known(&rig)?);
    stored.check_points(sweep.contents(), &sweep.task)?;
    Arc::make_mut(&mut sweep.task).left_out = state.left_out();
    let task = &*sweep.task;
    let mut processing = sweep.processing().map_err(|error| stored.in_plan(&error))?;
    let of_plan = match asked.only {
        true => std::mem::take(&mut processing.products),
        false => Vec::new(),
    };
    for argument in &asked.products {
        let planned = processing.products.len();
        append_argument(&mut processing.products, argument, task).map_err(ProcessError::Product)?;
        let reach = processing.demux.as_ref().and_then(|fold| fold.demux().ok()).map(|demux| demux.reach());
        let mut asked = processing.products[planned..].iter();
        if let Some(what) =
            reach.and_then(|reach| asked.find_map(|spec| spec.beyond((*reach.start(), *reach.end()))))
        {
            return Err(ProcessError::Product(format!("--product {argument}: {what}")));
        }
    }
    let wanted: Vec<String> = processing.products.iter().map(|spec| spec.name().to_owned()).collect();
    let is_wanted = |name: &str| wanted.iter().any(|wanted| wanted == name);
    // Not written again, but shown in the report, which is written anew.
    processing.products.extend(of_plan.into_iter().filter(|spec| !is_wanted(spec.name())));
    let memory = MemoryNeed::of_sweep(task, &processing.products)
        .map_err(|error| ProcessError::Config(error.to_string()))?;
    let available_bytes = available_bytes(asked.memory_limit_bytes);
    if memory.bytes(available_bytes) > available_bytes {
        return Err(ProcessError::Memory { needed_bytes: memory.bytes(available_bytes), available_bytes });
    }
    let in_strips = memory.in_strips(available_bytes);
    if in_strips {
        processing.keep_no_images();
    }
    processing.problems.extend(state.left_out());
    processing.feed_stored(task, state, &session.stack()?, &|| true);
    let mut results = match in_strips {
        true => Results::in_strips(processing, session, state, task, &|| true)?,
        false => Results::whole(processing, session, task, &|| true)?,
    };
    results.write_transport()?;
    let overview = results.overview();
    write_products(session, task, &mut results, &is_wanted, &|| true)?;
    write_report(session, state, &sweep, &results, overview.as_ref())?;
    manifest::write(session, state, task, &rig)?;
    Ok(Processed {
        report: session.report_path(),
        stored: state.stored_points(),
        points: shape.points(),
        problems: results.problems,
    })
}
