use ndarray::Array3;
use pulp::Arch;
use rayon::prelude::*;

use crate::dots::shape::BLOCK_PX;
use crate::dots::{Batch, FrameShape};

/// Makes an image by rows of blocks, in parallel: `draw` has the number of the row of blocks and an accumulator of its
/// pixels, `[channels, rows, width]`, which is 0.
pub(super) fn by_bands(
    shape: FrameShape,
    channels: usize,
    draw: impl Fn(usize, &mut [f64]) + Sync,
) -> Array3<f32> {
    let (height, width) = (shape.height(), shape.width());
    let mut image = vec![0.0_f32; height * width * channels];
    image.par_chunks_mut(BLOCK_PX * width * channels).enumerate().for_each_init(
        || vec![0.0; BLOCK_PX * width * channels],
        |sums, (band, image)| {
            let pixels = image.len() / channels;
            let sums = &mut sums[..image.len()];
            sums.fill(0.0);
            // With the widest instructions; they round as all others do.
            Arch::new().dispatch(|| draw(band, &mut *sums));
            for (channel, plane) in sums.chunks_exact(pixels).enumerate() {
                image[channel..]
                    .iter_mut()
                    .step_by(channels)
                    .zip(plane)
                    .for_each(|(to, &sum)| *to = sum as f32);
            }
        },
    );
    let mut array = Array3::zeros((height, width, channels));
    array.iter_mut().zip(image).for_each(|(place, value)| *place = value);
    array
}

/// Adds each block's value to all its pixels of a row of blocks, `[rows, width]`.
pub(super) fn add_blocks(sums: &mut [f64], blocks: impl ExactSizeIterator<Item = f64> + Clone) {
    let width = blocks.len() * BLOCK_PX;
    for row in sums.chunks_exact_mut(width) {
        for (pixels, value) in row.chunks_exact_mut(BLOCK_PX).zip(blocks.clone()) {
            pixels.iter_mut().for_each(|pixel| *pixel += value);
        }
    }
}

/// First word of a row of blocks.
pub(super) fn first_word(batch: &Batch, band: usize) -> usize {
    band * batch.shape().width()
}
