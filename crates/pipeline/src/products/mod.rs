//! Products: validated by plan before anything moves, and computed from the transport and the stack at the end of the
//! run or any time later.

mod assembly;
mod band;
mod bands;
mod captured;
mod cross_section;
pub mod mask;
mod planned;
mod profile;
mod relight;
mod spec;
mod uncertainty;

pub use self::assembly::{Assembly, NotMade};
pub use self::spec::{ProductError, ProductSpec};

#[cfg(test)]
mod tests;
