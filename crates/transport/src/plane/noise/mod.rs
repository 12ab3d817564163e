//! The noise of a stack, and its reduction before the stack is solved.

mod coupling;
mod model;

pub use coupling::{Coupled, Coupling};
pub use model::NoiseModel;
pub(super) use model::check_shapes;
