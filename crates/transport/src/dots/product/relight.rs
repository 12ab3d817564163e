use ndarray::{Array2, Array3, ArrayView2, ArrayView3};

use super::sum::{add_blocks, blocks_of, by_bands, first_word, sum_blocks};
use crate::dots::batch::Word;
use crate::dots::calibrate::Centroids;
use crate::dots::column::runs;
use crate::dots::error::{check_range, check_shape};
use crate::dots::shape::WORD_PX;
use crate::dots::{Batch, DotsError};

/// The scene with all dots lit: the sum of all columns, `[height, width, channels]`.
pub fn floodlit(batch: &Batch) -> Array3<f32> {
    weighted(batch, Array2::ones((batch.dots(), batch.shape().channels())).view())
}

/// The scene lit by dots with these weights, `[dots, colours]`, where the number of colours is that of the batch's
/// channels, or three for a batch with one channel. The result is `[height, width, colours]`.
///
/// # Errors
/// [`DotsError::Shape`] if the weights do not fit the batch.
pub fn relight(batch: &Batch, weights: ArrayView2<f32>) -> Result<Array3<f32>, DotsError> {
    let colours = match (batch.shape().channels(), weights.ncols()) {
        (1, 3) => 3,
        (channels, _) => channels,
    };
    check_shape("weights", "[dots, colours]", weights.shape(), &[batch.dots(), colours])?;
    Ok(weighted(batch, weights))
}

/// The scene lit by a sequence of lighting patterns, each `[height, width, 3]` of any size, frame by frame. See
/// [`pattern_weights`].
///
/// # Errors
/// As [`pattern_weights`] and [`relight`], for the current pattern.
pub fn relight_sequence<'a>(
    batch: &'a Batch,
    centroids: &'a Centroids,
    patterns: impl IntoIterator<Item = ArrayView3<'a, f32>> + 'a,
) -> impl Iterator<Item = Result<Array3<f32>, DotsError>> + 'a {
    patterns.into_iter().map(|pattern| relight(batch, pattern_weights(centroids, pattern)?.view()))
}

/// The weights of the dots for a lighting pattern `[height, width, colours]` stretched over the frame: its bicubic
/// interpolation (Keys 1981, a = -0.5) at the dots' centroids, with the nearest pixel beyond its border. Linear in
/// the pattern, so not clamped. Dots that were not seen have weight 0.
///
/// # Errors
/// [`DotsError::OutOfRange`] for a pattern without pixels.
pub fn pattern_weights(centroids: &Centroids, pattern: ArrayView3<f32>) -> Result<Array2<f32>, DotsError> {
    let (height, width, colours) = pattern.dim();
    check_range("pattern's pixels", (height * width) as f64, height * width > 0, "at least 1")?;
    let frame = centroids.shape();
    let mut weights = Array2::zeros((centroids.xy.len(), colours));
    for (xy, mut weights) in centroids.xy.iter().zip(weights.rows_mut()) {
        let Some([x, y]) = *xy else { continue };
        let columns = cubic((x + 0.5) * width as f64 / frame.width() as f64 - 0.5, width);
        let rows = cubic((y + 0.5) * height as f64 / frame.height() as f64 - 0.5, height);
        for (colour, weight) in weights.iter_mut().enumerate() {
            let in_row = |row: usize| -> f64 {
                columns.iter().map(|&(column, share)| share * f64::from(pattern[[row, column, colour]])).sum()
            };
            *weight = rows.iter().map(|&(row, share)| share * in_row(row)).sum::<f64>() as f32;
        }
    }
    Ok(weights)
}

/// The four pixels of a line around a position, and their weights.
fn cubic(at: f64, size: usize) -> [(usize, f64); 4] {
    let first = at.floor();
    let near = |distance: f64| (1.5 * distance - 2.5) * distance * distance + 1.0;
    let far = |distance: f64| ((-0.5 * distance + 2.5) * distance - 4.0) * distance + 2.0;
    let t = at - first;
    let shares = [far(1.0 + t), near(t), near(1.0 - t), far(2.0 - t)];
    std::array::from_fn(|step| {
        let pixel = (first + step as f64 - 1.0).clamp(0.0, size as f64 - 1.0);
        (pixel as usize, shares[step])
    })
}

fn weighted(batch: &Batch, weights: ArrayView2<f32>) -> Array3<f32> {
    let (shape, colours) = (batch.shape(), weights.ncols());
    let (channels, blocks) = (shape.channels(), shape.blocks());
    // One channel is used for all colours.
    let channel_of = |colour: usize| colour.min(channels - 1);
    let residual = sum_blocks(batch, colours, |dot, sums| {
        let means = batch.column(dot).residual();
        for (colour, sums) in sums.chunks_exact_mut(blocks).enumerate() {
            let weight = f64::from(weights[[dot, colour]]);
            let add = |(sum, &mean): (&mut f64, &f32)| *sum += weight * f64::from(mean);
            match channels {
                1 => sums.iter_mut().zip(means).for_each(add),
                _ => sums.iter_mut().zip(means[channel_of(colour)..].iter().step_by(channels)).for_each(add),
            }
        }
    });
    let [image] = by_bands(shape, colours, |band, sums| {
        let pixels = sums.len() / colours;
        for (dot, column) in batch.in_band(band) {
            for (block, Word { word, mask, mut values }) in column.parts() {
                let first = (word - first_word(batch, band)) * WORD_PX;
                for run in runs(mask) {
                    let (of_run, rest) = values.split_at(run.len() * channels);
                    values = rest;
                    for colour in 0..colours {
                        let weight = f64::from(weights[[dot, colour]]);
                        // The block's mean is added to all its pixels at the end; it does not apply to pixels of the
                        // mask.
                        let mean = f64::from(column.residual()[block * channels + channel_of(colour)]);
                        let place = colour * pixels + first;
                        let sums = &mut sums[place + run.start..place + run.end];
                        let add =
                            |(sum, &value): (&mut f64, &f32)| *sum += weight * (f64::from(value) - mean);
                        match channels {
                            1 => sums.iter_mut().zip(of_run).for_each(add),
                            _ => sums
                                .iter_mut()
                                .zip(of_run[channel_of(colour)..].iter().step_by(channels))
                                .for_each(add),
                        }
                    }
                }
            }
        }
        for (sums, residual) in sums.chunks_exact_mut(pixels).zip(residual.chunks_exact(blocks)) {
            add_blocks(sums, &residual[blocks_of(batch, band)], shape);
        }
    });
    image
}
