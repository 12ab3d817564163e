//! The threads that own the devices during a run.

pub mod camera;
pub mod dots;
pub mod operator;
pub mod priority;
pub mod vsync;
