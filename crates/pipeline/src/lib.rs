//! From frames to results: frames and VSYNC edges become averaged units, units pass through stages in parallel, and
//! sinks and folds receive them in order.
//!
//! This crate accesses no devices, files or sockets. Threads are named `std` threads, workers are rayon's.

mod assembler;
mod demux;
pub mod dots;
mod edges;
mod film;
mod findings;
mod pipeline;
mod product;
mod products;
mod queue;
mod registry;
mod regularity;
mod schedule;
mod stack;
mod stage;
mod strips;
mod unit;

pub use assembler::{
    Assembler, AssemblerConfig, Decision, EXPOSURE_TOLERANCE_US, Event, Failure, Job, Label,
};
pub use demux::{DemuxFold, DemuxOptions, PREDICTED_SHARE};
pub use edges::{EdgeTracker, Line};
pub use film::{Cycle, CycleOrder, FilmFrame, FilmSolver};
pub use findings::{Findings, name as prior_name, rows_to_choose_by};
pub use pipeline::{Ordered, Pipeline, PipelineConfig, PipelineError, Sink, message_of, run_stages};
pub use product::{Product, Profile};
pub use products::{Assembly, NotMade, ProductError, ProductSpec};
pub use queue::{Input, Policy, QueueError, Receiver};
pub use registry::{Entry, Registry, RegistryError};
pub use schedule::{Point, Role, Scan, Schedule, Shot, Spot, SweepGeometry};
pub use stack::SweepStack;
pub use stage::{Fold, FoldError, HotPixels, Snapshot, Stage, StageError};
pub use strips::{ImageRows, InStrips, Strip};
pub use unit::Unit;
