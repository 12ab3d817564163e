//! Sweeps that are larger than the memory: images are not kept but read again, some camera rows at a time.

use std::ops::Range;

use ndarray::Array2;
use raysweep_transport::plane::Transport;

use crate::findings::Findings;
use crate::stack::SweepStack;

/// Why a sweep, or a cycle of a film, has no transport.
#[derive(Debug, thiserror::Error)]
#[error("{of}: {what}")]
pub struct NotSolved {
    /// `demux` or `film`.
    pub of: &'static str,
    /// What happened and what to do.
    pub what: String,
}

/// Some rows of the image of a point.
#[derive(Debug, Clone)]
pub struct PointRows {
    /// Mean counts, `[rows, s]`.
    pub image: Array2<f32>,
    /// Where any of its frames saturates, `[rows, s]`; `None` if nowhere, or if it is not known.
    pub clipped: Option<Array2<bool>>,
}

/// Reads images again that were not kept.
pub trait ImageRows: Sync {
    /// Some rows of the image of a point of the schedule, as passed to [`crate::DemuxFold::push`].
    ///
    /// # Errors
    /// What cannot be read, why, and what to do.
    fn read(&self, point: u32, rows: Range<usize>) -> Result<PointRows, String>;
}

/// Consecutive camera rows of a sweep and their results.
#[derive(Debug, Clone)]
pub struct Strip {
    /// The camera row of row 0 of the strip.
    pub first_row: usize,
    /// The images; the timing is that of the whole camera.
    pub stack: SweepStack,
    /// The transport of these rows only.
    pub transport: Transport,
}

/// How a sweep is solved whose images were not kept.
pub struct InStrips<'a> {
    /// Source of the images.
    pub images: &'a dyn ImageRows,
    /// Number of camera rows per strip; the last strip may have fewer.
    pub strip_rows: usize,
    /// Receives each strip once, from top to bottom, and the findings common to all of them.
    pub take: &'a mut dyn FnMut(&Findings, Strip) -> Result<(), NotSolved>,
}
