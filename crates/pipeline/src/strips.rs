//! Sweeps that are larger than the memory: images that were not kept are read again, some camera rows at a time.

use std::ops::Range;

use ndarray::Array2;
use raysweep_transport::plane::Transport;

use crate::findings::Findings;
use crate::products::SweepStack;
use crate::stage::FoldError;

/// Reads again what a fold was given and did not keep.
pub trait ImageRows: Sync {
    /// Some rows of the image of a point of the schedule, as [`crate::Fold::push`] was given it: counts, `[rows, s]`.
    ///
    /// # Errors
    /// What cannot be read, why, and what to do.
    fn read(&self, point: u32, rows: Range<usize>) -> Result<Array2<f32>, String>;
}

/// Camera rows of a sweep that follow each other, and what they were made into.
#[derive(Debug, Clone)]
pub struct Strip {
    /// The camera row that is row 0 of the strip.
    pub first_row: usize,
    /// The images; the timing is that of the whole camera.
    pub stack: SweepStack,
    /// The transport of these rows alone.
    pub transport: Transport,
}

/// How a fold is to finish that has kept no images.
pub struct InStrips<'a> {
    /// Where it reads them again.
    pub images: &'a dyn ImageRows,
    /// Camera rows of a strip; the last may be lower.
    pub strip_rows: usize,
    /// Takes each strip, from top to bottom, once; and how all of them are demultiplexed.
    pub take: &'a mut dyn FnMut(&Findings, Strip) -> Result<(), FoldError>,
}
