//! Batches of a flying dot: checks a plan and processes the columns.

mod calibration;
mod columns;
pub mod flat;
mod product;
mod report;
mod results;
mod task;

use raysweep_config::BatchesPlan;

pub use self::columns::{from_stored, to_stored};
pub use self::product::DotSpec;
pub use self::results::{BatchProducts, keep_patterns, make};
pub use self::task::{CorrectOptions, DotTask, sampling};
use crate::stored::{Asked, ProcessError, Processed, Stored};

/// Reprocesses stored batches.
///
/// # Errors
/// When a product cannot be made from them, before anything is written; when the session cannot be written.
pub fn process(stored: &Stored<'_>, batches: BatchesPlan, asked: &Asked) -> Result<Processed, ProcessError> {
    let Stored { session, state, plan, .. } = stored;
    let rig = stored.dot_rig()?;
    let shape = state.session.shape;
    let size = (shape.rows, shape.columns);
    let task = DotTask::new(plan, batches, &rig, rig.camera.pixel_format, size, session.dir())
        .map_err(|error| ProcessError::Config(error.to_string()))?;
    stored.check_contents(task.contents())?;
    let mut specs = if asked.only { Vec::new() } else { task.specs.clone() };
    for argument in &asked.products {
        for spec in DotSpec::of_argument(argument).map_err(ProcessError::Product)? {
            specs.retain(|other| other.name != spec.name);
            specs.push(spec);
        }
    }
    let products = make(session, state, &task, &specs, Vec::new(), &|| true)?;
    products.write_report(session, state, &task, &rig)?;
    Ok(Processed {
        report: session.report_path(),
        stored: state.stored_points(),
        points: shape.points(),
        problems: products.problems,
    })
}
