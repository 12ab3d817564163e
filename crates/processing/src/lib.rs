//! Makes products and reports from stored sessions. Runs call the same functions, so offline results are
//! bit-identical to those of the run.
//!
//! Needs no rig, socket or device.

pub mod batches;
pub mod darks;
mod export;
pub mod film;
pub mod memory;
pub mod mirror_response;
pub mod plane;
mod report;
pub mod response;
mod stored;
pub mod sweep;

use std::path::Path;

use raysweep_config::{Plan, Procedure};
use raysweep_core::PixelFormat;
use raysweep_session::Session;

use self::stored::read;

pub use export::export;
pub use stored::{Asked, ProcessError, Processed, Stored};

/// Name and version that are recorded in sessions.
pub const SOFTWARE: &str = concat!("raysweepd ", env!("CARGO_PKG_VERSION"));

/// A mean counts as saturated from this share of the converter's range on: the noise of single frames must not be
/// clipped.
const SATURATION: f64 = 0.97;

/// Counts from which on a pixel of this format is overexposed: wells may be full before the converter saturates.
pub(crate) fn saturation_dn(format: PixelFormat) -> f64 {
    SATURATION * f64::from(format.max_value())
}

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
    }
}
