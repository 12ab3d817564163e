//! `raysweepd`, the daemon that owns a rig, and `raysweep`, its client.

mod advice;
pub mod check;
pub mod cli;
pub mod config;
pub mod control;
mod dots;
mod film;
pub mod live;
mod memory;
pub mod mirror;
pub mod process;
pub mod processing;
mod report;
mod response;
mod results;
pub mod rig;
pub mod run;
pub mod server;
mod strips;

/// Name and version, as sessions keep it.
pub const SOFTWARE: &str = concat!("raysweepd ", env!("CARGO_PKG_VERSION"));
