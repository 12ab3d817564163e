//! `raysweepd`, the daemon that owns a rig, and `raysweep`, its client.

pub mod arguments;
mod catalogue;
pub mod cli;
mod computing;
pub mod control;
mod devices;
pub mod doctor;
pub mod journal;
pub mod live;
pub mod mirror;
mod plane;
mod probes;
mod procedure;
mod refusals;
pub mod rig;
mod run;
mod runner;
pub mod server;

pub use probes::Probes;
pub use runner::Runner;
