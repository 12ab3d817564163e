//! The threads that own devices while a run goes on.

pub mod camera;
pub mod dots;
pub mod operator;
pub mod priority;
pub mod vsync;
