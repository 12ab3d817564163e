//! Makes products and reports of stored sessions. A run calls the same functions, so its results and those that are made
//! again have the same bits.
//!
//! Nothing here needs a rig, a socket or a device.

pub mod batches;
pub mod film;
pub mod memory;
pub mod mirror_response;
pub mod plane;
mod report;
pub mod response;
mod session;
mod stored;
pub mod sweep;

use raysweep_core::PixelFormat;

pub use session::{export, process, process_asked};
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
