//! Drivers for real devices behind the traits of `raysweep-core`. Drivers that need a C library are behind a
//! feature.

mod arrival_clock;
pub mod camera;
pub mod mirror;
pub mod projector;
mod reopen;
pub mod search;
pub mod serial;
pub mod vsync;
