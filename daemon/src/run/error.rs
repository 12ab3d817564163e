//! Errors that end a run early.

use raysweep_config::ConfigError;
use raysweep_core::{Counts, DeviceError};
use raysweep_pipeline::PipelineError;
use raysweep_processing::response::ResponseError;

use crate::rig::RigError;

/// Why a run could not be completed.
#[derive(Debug, thiserror::Error)]
pub enum RunError {
    /// A device failed.
    #[error(transparent)]
    Device(#[from] DeviceError),
    /// The rig cannot be opened.
    #[error(transparent)]
    Rig(#[from] RigError),
    /// The session cannot be written.
    #[error(transparent)]
    Session(#[from] raysweep_session::Error),
    /// The pipeline failed.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// The camera differs from the one that the session was begun with.
    #[error(
        "the camera has {found:?} rows and columns, the session {expected:?}: resume it on the rig that it was begun on"
    )]
    OtherCamera {
        /// Rows and columns of the camera.
        found: (usize, usize),
        /// Rows and columns of the session.
        expected: (usize, usize),
    },
    /// The frames, or the calibration, of a dot rig cannot be used.
    #[error(transparent)]
    Dots(#[from] raysweep_transport::dots::DotsError),
    /// The mirror's response could not be identified.
    #[error(transparent)]
    Response(#[from] ResponseError),
    /// A frame cannot be read.
    #[error("{0}")]
    Frame(String),
    /// The plan gives no model on this rig.
    #[error("{0}")]
    Plan(#[from] ConfigError),
    /// Points failed repeatedly.
    #[error(
        "{points} points failed in {passes} passes in a row; frames of the last pass: {}, {interrupted} attempts interrupted. The ledger has the causes of each; mend them and resume the session",
        .counts.losses()
    )]
    Hopeless {
        /// Number of points.
        points: usize,
        /// Number of passes.
        passes: u32,
        /// Frame counts of the last pass.
        counts: Counts,
        /// Attempts of the last pass that ended before their last frame.
        interrupted: usize,
    },
    /// A thread of the run has ended unexpectedly; another error says which and why.
    #[error(
        "a thread of the run has ended; the log has its message. What was stored stays stored; resume the session"
    )]
    Interrupted,
    /// The run panicked, which is a bug.
    #[error("the run panicked: {0}. What was stored stays stored; resume the session")]
    Panicked(String),
}
