//! From the frames of a flying dot to batches of sparse columns, at the camera's speed.
//!
//! Workers take frames off the queue in turn and denoise each at once, before anybody knows which dot it shows: what
//! waits for that is its column of a few kilobytes, not the frame. One thread receives the columns in the order of the
//! frames, cuts them into batches by the trailing dot, and keeps the rolling background. Which background a frame is
//! denoised with depends on its number alone, so the columns are the same for any number of threads.

mod background;
mod dark;
mod flow;
mod gather;
mod stage;

pub use dark::{DarkRun, FlatRun, Sensor};
pub use flow::{Arrival, DotsFlow, DotsFlowConfig, DotsInput, Gathered, Loss};
pub use gather::{Cut, CutSink, Scan};
pub use stage::{ColumnStage, ColumnWorker, DenoiseOptions, DotStages};

#[cfg(test)]
mod tests;
