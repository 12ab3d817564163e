//! Makes products and reports from stored sessions. Runs call the same functions, so offline results are
//! bit-identical to those of the run.
//!
//! Needs no rig, socket or device.

pub mod batches;
pub mod calibration;
pub mod darks;
mod export;
pub mod film;
pub mod memory;
pub mod mirror_response;
pub mod plane;
mod report;
pub mod response;
mod saturation;
mod software;
mod stored;
pub mod sweep;

use std::path::Path;

use raysweep_config::{Plan, Procedure};
use raysweep_session::Session;

use self::stored::read;

pub use export::export;
pub use software::SOFTWARE;
pub use stored::{Asked, ProcessError, Processed, Stored};

/// Makes the products of a session again, with its own plan and rig file: bit-identical to those of the run.
///
/// # Errors
/// When the session is being written by a run, or cannot be read.
pub fn process(dir: &Path) -> Result<Processed, ProcessError> {
    process_asked(dir, &Asked::default())
}

/// Like [`process`], with products that the plan does not name. Files of products that are not made now are kept.
///
/// # Errors
/// Those of [`process`]; and when a product cannot be made from this session, before anything is written.
pub fn process_asked(dir: &Path, asked: &Asked) -> Result<Processed, ProcessError> {
    let session = Session::open(dir)?;
    let ledger = session.resume()?;
    let path = session.plan_path();
    let plan_text = read(&path)?;
    let plan = Plan::parse(&plan_text)
        .map_err(|error| ProcessError::Config(error.render(&path.display().to_string(), &plan_text)))?;
    let stored = Stored { session: &session, state: ledger.state(), plan: &plan, plan_text: &plan_text };
    match plan.procedure.clone() {
        Procedure::Sweep(own) => sweep::process(&stored, own, asked),
        Procedure::Film(own) => film::process(&stored, own, asked),
        Procedure::Batches(own) => batches::process(&stored, own, asked),
        Procedure::Response(own) => response::process(&stored, own, asked),
        Procedure::Darks(own) => darks::process(&stored, own, asked),
        Procedure::Calibration(own) => calibration::process(&stored, own, asked),
    }
}
