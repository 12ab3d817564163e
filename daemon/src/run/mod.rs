//! The life of a run, whatever its procedure.

pub mod board;
pub mod error;
pub mod life;
pub mod look;
pub mod orders;
pub mod patience;
pub mod progress;
