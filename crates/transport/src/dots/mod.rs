//! Light transport of a flying dot: a mirror moves one spot of light over the scene while a fast camera takes one
//! frame per position. Every frame is a column of the scene's light transport.
//!
//! The [`Synchroniser`] determines which dot a frame shows. The [`Denoiser`] turns raw frames into sparse columns:
//! individual pixels where they exceed the noise, means of blocks elsewhere. The columns of a scan form a [`Batch`].
mod background;
mod batch;
pub mod calibrate;
mod column;
mod correction;
mod denoise;
mod error;
mod flat;
pub mod identify;
pub mod product;
mod sensor;
mod shape;
mod synchronise;

pub use background::{Background, BackgroundMean, NoiseFloor};
pub use batch::{Batch, BatchArrays, BatchCounts, Column};
pub use column::{ColumnOutcome, SparseColumn};
pub use correction::{Correction, Sampling};
pub use denoise::{DenoiseSettings, Denoiser, Scratch, StopRule, false_alarm_sigmas, reference};
pub use error::DotsError;
pub use flat::FlatField;
pub use sensor::RunStatistics;
pub use shape::{FrameShape, Region, WORD_PX};
pub use synchronise::{
    Cause, Decided, Fate, Observation, SyncCounts, SyncSettings, Synchroniser, pulse_threshold,
};
