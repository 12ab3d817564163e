//! Makes products and reports of stored sessions. A run calls the same functions, so its results and those that are made
//! again have the same bits.
//!
//! Nothing here needs a rig, a socket or a device.

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

/// Name and version, as sessions keep it.
pub const SOFTWARE: &str = concat!("raysweepd ", env!("CARGO_PKG_VERSION"));

/// Share of the converter's range from which on a mean counts as saturated: the noise of single frames must not have
/// been cut off.
const SATURATION: f64 = 0.97;

/// Counts from which on a pixel of this format is overexposed: wells may be full before the converter is.
pub(crate) fn saturation_dn(format: PixelFormat) -> f64 {
    SATURATION * f64::from(format.max_value())
}

/// Makes the products of a session again, with the plan and the rig file that lie in it: the same bits as the run's.
///
/// # Errors
/// When the session is being written by a run, or cannot be read.
pub fn process(dir: &Path) -> Result<Processed, ProcessError> {
    process_asked(dir, &Asked::default())
}

/// [`process`], and products that the plan does not name. Files of products that are not made now stay.
///
/// # Errors
/// Those of [`process`]; and when a product cannot be had of this session, before anything is written.
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
