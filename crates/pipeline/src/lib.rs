//! From frames to results: frames and VSYNC edges become averaged units, units pass through stages in parallel, and
//! the sink and the demultiplexer receive them in order.
//!
//! This crate accesses no devices, files or sockets. Threads are named `std` threads, workers are rayon's.

mod assembler;
mod bracket;
mod calibrated;
mod demux;
pub mod dots;
mod edges;
mod film;
mod findings;
mod flicker;
mod jitter;
mod light;
mod pipeline;
mod product;
mod products;
mod queue;
mod regularity;
mod scale;
mod schedule;
mod spot;
mod stack;
mod stage;
mod stage_refused;
mod strips;
mod unit;

pub use assembler::{
    Assembler, AssemblerConfig, Decision, DeviceEvent, EXPOSURE_TOLERANCE_US, Failure, Job, Label,
};
pub use demux::{DEMUX, DemuxFold, DemuxOptions, PREDICTED_SHARE, Snapshot, Solved, SweepSummary};
pub use edges::{EdgeTracker, Found, Line};
pub use film::{Cycle, CycleOrder, FilmFrame, FilmImage, FilmSolver};
pub use findings::{Findings, name as prior_name, rows_to_choose_by};
pub use light::SeenLight;
pub use pipeline::{Ordered, Pipeline, PipelineConfig, PipelineError, Sink};
pub use product::{CrossSection, Product, Profile};
pub use products::mask;
pub use products::{Assembly, NotMade, ProductError, ProductSpec};
pub use queue::{Input, Policy, QueueError, Receiver};
pub use scale::LightScale;
pub use schedule::{Point, PointRole, Schedule, Shot, Spot, SpotScan, SweepGeometry};
pub use spot::SpotCut;
pub use stack::SweepStack;
pub use stage::{HOT_PIXELS, HotPixels, PlaneStage, Stage, StageError, Stages, message_of, run_stages};
pub use stage_refused::StageRefused;
pub use strips::{ImageRows, InStrips, NotSolved, PointRows, Strip};
pub use unit::Unit;
