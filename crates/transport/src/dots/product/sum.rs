use ndarray::Array3;
use pulp::Arch;
use rayon::prelude::*;

use crate::dots::shape::WORD_PX;
use crate::dots::{Batch, FrameShape};

/// Number of dots whose residuals are summed sequentially. These partial sums are then added in order, so that the
/// result is the same to the bit for any number of threads.
const DOTS_AT_A_TIME: usize = 128;

/// Computes images by bands, in parallel. `draw` gets the index of the band and a zeroed accumulator of its pixels, `[images, channels, rows, width]`.
pub(super) fn by_bands<const IMAGES: usize>(
    shape: FrameShape,
    channels: usize,
    draw: impl Fn(usize, &mut [f64]) + Sync,
) -> [Array3<f32>; IMAGES] {
    let of_band = WORD_PX * shape.width() * channels;
    let mut images: [Array3<f32>; IMAGES] =
        std::array::from_fn(|_| Array3::zeros((shape.height(), shape.width(), channels)));
    let mut bands: Vec<Vec<&mut [f32]>> = (0..shape.bands()).map(|_| Vec::with_capacity(IMAGES)).collect();
    for values in images.iter_mut().filter_map(Array3::as_slice_mut) {
        bands.iter_mut().zip(values.chunks_mut(of_band)).for_each(|(band, values)| band.push(values));
    }
    bands.into_par_iter().enumerate().for_each_init(
        || vec![0.0; IMAGES * of_band],
        |sums, (band, images)| {
            let size: usize = images.iter().map(|values| values.len()).sum();
            let sums = &mut sums[..size];
            // With the widest instructions; all of them round alike.
            Arch::new().dispatch(
                #[inline(always)]
                || {
                    sums.fill(0.0);
                    draw(band, &mut *sums);
                    for (values, sums) in images.into_iter().zip(sums.chunks_exact(size / IMAGES)) {
                        interleave(values, sums, channels);
                    }
                },
            );
        },
    );
    images
}

/// Converts `[channels, pixels]` to `[pixels, channels]`.
#[inline(always)]
fn interleave(values: &mut [f32], sums: &[f64], channels: usize) {
    if channels == 1 {
        values.iter_mut().zip(sums).for_each(|(value, &sum)| *value = sum as f32);
        return;
    }
    for (channel, plane) in sums.chunks_exact(sums.len() / channels).enumerate() {
        values[channel..]
            .iter_mut()
            .step_by(channels)
            .zip(plane)
            .for_each(|(value, &sum)| *value = sum as f32);
    }
}

/// Sums over all dots what `add` adds to an accumulator of blocks, `[planes, blocks]`.
pub(super) fn sum_blocks(batch: &Batch, planes: usize, add: impl Fn(usize, &mut [f64]) + Sync) -> Vec<f64> {
    let size = planes * batch.shape().blocks();
    let parts: Vec<Vec<f64>> = (0..batch.dots().div_ceil(DOTS_AT_A_TIME))
        .into_par_iter()
        .map(|part| {
            let dots = part * DOTS_AT_A_TIME..batch.dots().min((part + 1) * DOTS_AT_A_TIME);
            let mut sums = vec![0.0; size];
            Arch::new().dispatch(
                #[inline(always)]
                || dots.for_each(|dot| add(dot, &mut sums)),
            );
            sums
        })
        .collect();
    let mut sums = vec![0.0; size];
    for part in parts {
        sums.iter_mut().zip(part).for_each(|(sum, part)| *sum += part);
    }
    sums
}

/// Adds the values of a band's blocks, `[block rows, block columns]`, to all their pixels, `[rows, width]`.
#[inline(always)]
pub(super) fn add_blocks(sums: &mut [f64], blocks: &[f64], shape: FrameShape) {
    for (row, pixels) in sums.chunks_exact_mut(shape.width()).enumerate() {
        let of_row = &blocks[row / shape.block_px() * shape.block_columns()..];
        for (pixels, value) in pixels.chunks_exact_mut(shape.block_px()).zip(of_row) {
            pixels.iter_mut().for_each(|pixel| *pixel += value);
        }
    }
}

/// First word of a band.
pub(super) fn first_word(batch: &Batch, band: usize) -> usize {
    band * batch.shape().width()
}

/// First block of a band, and one past its last.
pub(super) fn blocks_of(batch: &Batch, band: usize) -> std::ops::Range<usize> {
    let shape = batch.shape();
    let of_band = WORD_PX / shape.block_px() * shape.block_columns();
    band * of_band..shape.blocks().min((band + 1) * of_band)
}
