//! What makes sessions and products.

/// Name and version that are recorded in sessions.
pub const SOFTWARE: &str = concat!("raysweepd ", env!("CARGO_PKG_VERSION"));
