//! Batches between the session and the products.

use raysweep_session::dots::BatchColumns;
use raysweep_transport::dots::{Batch, BatchArrays, DotsError, FrameShape};

/// Converts a stored batch for the products; also returns which of its dots show the scene. Its residuals keep the
/// resolution that they were stored with.
pub fn from_stored(shape: FrameShape, columns: BatchColumns) -> Result<(Batch, Vec<bool>), DotsError> {
    let BatchColumns { word_offsets, words, masks, values, residual, block_px, discs, capped, seen } =
        columns;
    let arrays = BatchArrays { word_offsets, words, masks, values, residual, discs, capped };
    Ok((Batch::new(shape.with_block_px(block_px)?, arrays)?, seen))
}

/// The inverse of [`from_stored`].
pub fn to_stored(shape: FrameShape, arrays: BatchArrays, seen: Vec<bool>) -> BatchColumns {
    let block_px = shape.block_px();
    let BatchArrays { word_offsets, words, masks, values, residual, discs, capped } = arrays;
    BatchColumns { word_offsets, words, masks, values, residual, block_px, discs, capped, seen }
}
