//! Inverts the forward model: from a stack to its transport, the exact minimum of each pixel's objective.

mod censored;
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

pub use demux::{Bracket, Demux};
pub use prior::Prior;
pub use simd::SimdLevel;
pub use tiles::objectives_bytes;

/// The linear algebra by itself, for the benchmark `demux`.
#[doc(hidden)]
pub mod linear {
    pub use super::cholesky::invert;
    pub use super::pivot::minimise_free;
    pub use super::quadratic::Quadratic;
}
