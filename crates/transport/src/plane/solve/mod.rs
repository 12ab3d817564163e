//! Inverts the forward model: from a stack to its transport, the exact minimum of each pixel's objective.

pub(super) mod cholesky;
mod demux;
mod dense;
mod narrow;
pub(super) mod pivot;
mod prior;
pub(super) mod quadratic;
pub mod reference;
mod simd;
pub(super) mod tiles;

pub use demux::Demux;
pub use prior::Prior;
pub use simd::SimdLevel;
pub use tiles::objectives_bytes;
