//! Turns the frames of a flying dot into batches of sparse columns, at the camera's speed.
//!
//! Workers take frames off the queue in turn and denoise each immediately, before its dot is known: only its column
//! of a few kilobytes has to wait for that, not the frame. One thread receives the columns in the order of the
//! frames, divides them into batches at the trailing dot, and maintains the rolling background. The background with
//! which a frame is denoised depends only on the frame's number, so the columns are the same for any number of
//! threads.

mod background;
mod dark;
mod flow;
mod gather;
mod stage;

pub use dark::{DarkRun, FlatRun, Sensor};
pub use flow::{Arrival, DotsFlow, DotsFlowConfig, DotsInput, Gathered};
pub use gather::{Cut, CutSink, DotScan, Loss};
pub use stage::{ColumnStage, ColumnWorker, DenoiseOptions, column_stage};

#[cfg(test)]
mod tests;
