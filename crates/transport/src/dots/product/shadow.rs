use ndarray::Array3;
use rayon::prelude::*;

use super::Separation;
use super::check_light;
use super::sum::{blocks_of, by_bands, first_word};
use crate::dots::batch::Word;
use crate::dots::calibrate::Confusion;
use crate::dots::calibrate::luminance;
use crate::dots::column::runs;
use crate::dots::error::{check_range, check_shape};
use crate::dots::shape::WORD_PX;
use crate::dots::{Batch, DotsError};

/// Marks a pixel without a dot.
const NONE: u32 = u32::MAX;

/// Separates direct from global light by the extremes over images lit by all dots but one, as Nayar et al. (2006) do
/// with patterns: `direct = L_max - L_min`, `global = L_min N / (N - 1)` for N dots. `light` is the floodlit image.
///
/// Switching a dot off removes its light only where its mask is. Where several dots cover a pixel, switching off one
/// of them does not make it dark: see [`shadow_neighbours`].
///
/// # Errors
/// [`DotsError::OutOfRange`] below two dots, [`DotsError::Shape`] if `light` does not have the batch's shape.
pub fn shadow_dot(batch: &Batch, light: &Array3<f32>) -> Result<Separation, DotsError> {
    let dots = batch.dots();
    check_range("dots", dots as f64, dots >= 2, "at least 2")?;
    let light = check_light(batch, light)?;
    let channels = batch.shape().channels();
    let share = dots as f64 / (dots - 1) as f64;
    let [direct, global] = by_bands(batch.shape(), channels, |band, sums| {
        let pixels = sums.len() / (2 * channels);
        let mut covering = vec![0_u32; pixels];
        // Largest and smallest light that a single dot removes.
        let (most, least) = sums.split_at_mut(channels * pixels);
        most.fill(f64::NEG_INFINITY);
        least.fill(f64::INFINITY);
        for (_, column) in batch.in_band(band) {
            for Word { word, mask, mut values } in column.words() {
                let first = (word - first_word(batch, band)) * WORD_PX;
                for run in runs(mask) {
                    let (of_run, rest) = values.split_at(run.len() * channels);
                    values = rest;
                    let run = first + run.start..first + run.end;
                    covering[run.clone()].iter_mut().for_each(|covering| *covering += 1);
                    for channel in 0..channels {
                        let at = channel * pixels + run.start..channel * pixels + run.end;
                        let extremes = most[at.clone()].iter_mut().zip(&mut least[at]);
                        let light = of_run[channel..].iter().step_by(channels).map(|&value| f64::from(value));
                        for ((most, least), light) in extremes.zip(light) {
                            *most = if light > *most { light } else { *most };
                            *least = if light < *least { light } else { *least };
                        }
                    }
                }
            }
        }
        let light = of_band(light, band, pixels * channels, batch);
        for channel in 0..channels {
            let at = channel * pixels..(channel + 1) * pixels;
            let extremes = most[at.clone()].iter_mut().zip(&mut least[at]);
            let light = light[channel..].iter().step_by(channels);
            for (((most, least), &light), &covering) in extremes.zip(light).zip(&covering) {
                // A dot that does not cover the pixel removes no light.
                let none = if (covering as usize) < dots { 0.0 } else { *most };
                let (largest, smallest) = (most.max(none), least.min(none));
                (*most, *least) = (largest - smallest, (f64::from(light) - largest) * share);
            }
        }
    });
    Ok(Separation { direct, global })
}

/// The values of a row of blocks, `[pixels, channels]`.
fn of_band<'a>(light: &'a [f32], band: usize, values: usize, batch: &Batch) -> &'a [f32] {
    &light[band * WORD_PX * batch.shape().width() * batch.shape().channels()..][..values]
}

/// Separates direct from global light where dots overlap: at each pixel, all dots are switched off that share pixels
/// of the calibration plane with the one that is brightest there, `S = {j : M_ij > 0}`. What remains is global light
/// from the other dots: `global = L_min N / (N - |S|)`, `direct = floodlit - global`. `light` is the floodlit image.
///
/// The same neighbours are used off the plane, where the dots' positions differ. Pixels outside all masks are global.
///
/// # Errors
/// [`DotsError::Shape`] if the confusion matrix does not have the batch's dots or `light` not its shape,
/// [`DotsError::OutOfRange`] if a dot has all others as neighbours.
pub fn shadow_neighbours(
    batch: &Batch,
    light: &Array3<f32>,
    confusion: &Confusion,
) -> Result<Separation, DotsError> {
    let (shape, dots) = (batch.shape(), batch.dots());
    let channels = shape.channels();
    check_shape("confusion", "[dots]", &[confusion.dots()], &[dots])?;
    let most = (0..dots).map(|dot| confusion.neighbours(dot).len().max(1)).max().unwrap_or(0);
    check_range(
        "neighbours of a dot",
        most as f64,
        most < dots,
        "fewer than there are dots: binarise higher",
    )?;
    let light = check_light(batch, light)?;
    let is_neighbour = Neighbours::new(confusion);
    let [direct, global] = by_bands(shape, channels, |band, sums| {
        let pixels = sums.len() / (2 * channels);
        // First the light of the dots that are switched off, then direct and global light.
        let (off, global) = sums.split_at_mut(channels * pixels);
        let (mut brightest, mut dot_of) = (vec![f32::NEG_INFINITY; pixels], vec![NONE; pixels]);
        for (dot, column) in batch.in_band(band) {
            for Word { word, mask, mut values } in column.words() {
                let first = (word - first_word(batch, band)) * WORD_PX;
                for run in runs(mask) {
                    let (of_run, rest) = values.split_at(run.len() * channels);
                    values = rest;
                    let run = first + run.start..first + run.end;
                    let pixels = brightest[run.clone()].iter_mut().zip(&mut dot_of[run]);
                    for ((most, dot_of), value) in pixels.zip(of_run.chunks_exact(channels)) {
                        let light = luminance(value);
                        let brighter = light > *most;
                        *most = if brighter { light } else { *most };
                        *dot_of = if brighter { dot as u32 } else { *dot_of };
                    }
                }
            }
        }
        for (dot, column) in batch.in_band(band) {
            let neighbours = is_neighbour.of(dot);
            for (block, Word { word, mask, mut values }) in column.parts() {
                let first = (word - first_word(batch, band)) * WORD_PX;
                for run in runs(mask) {
                    let (of_run, rest) = values.split_at(run.len() * channels);
                    values = rest;
                    let run = first + run.start..first + run.end;
                    for channel in 0..channels {
                        let mean = f64::from(column.residual()[block * channels + channel]);
                        let off = &mut off[channel * pixels + run.start..channel * pixels + run.end];
                        let light = of_run[channel..].iter().step_by(channels);
                        for ((sum, &value), &brightest) in off.iter_mut().zip(light).zip(&dot_of[run.clone()])
                        {
                            let shares = neighbours[brightest as usize / 64] >> (brightest % 64) & 1 == 1;
                            *sum += if shares { f64::from(value) - mean } else { 0.0 };
                        }
                    }
                }
            }
        }
        // The neighbours' residual is switched off too; one sum serves all pixels of a block with the same dot.
        let light = of_band(light, band, pixels * channels, batch);
        let mut residuals: Vec<Option<[f64; 3]>> = vec![None; dots];
        let mut met = Vec::new();
        let (side, columns) = (shape.block_px(), shape.block_columns());
        for (at, block) in blocks_of(batch, band).enumerate() {
            let rows = (at / columns * side..pixels / shape.width()).take(side);
            let first = at % columns * side;
            for pixel in rows.flat_map(|row| row * shape.width() + first..row * shape.width() + first + side)
            {
                let dot = dot_of[pixel] as usize;
                let (residual, count) = match dot_of[pixel] {
                    NONE => ([0.0; 3], 0),
                    _ => {
                        // The dot may be missing from the calibration.
                        let itself = [dot as u32];
                        let neighbours = match confusion.neighbours(dot) {
                            [] => &itself,
                            neighbours => neighbours,
                        };
                        let residual = *residuals[dot].get_or_insert_with(|| {
                            met.push(dot);
                            residual_of(batch, neighbours, block)
                        });
                        (residual, neighbours.len())
                    }
                };
                let share = dots as f64 / (dots - count) as f64;
                for channel in 0..channels {
                    let at = channel * pixels + pixel;
                    let light = f64::from(light[pixel * channels + channel]);
                    global[at] = (light - off[at] - residual[channel]) * share;
                    off[at] = light - global[at];
                }
            }
            met.drain(..).for_each(|dot| residuals[dot] = None);
        }
    });
    Ok(Separation { direct, global })
}

/// Sum of the residuals of `dots` in one block.
fn residual_of(batch: &Batch, dots: &[u32], block: usize) -> [f64; 3] {
    let channels = batch.shape().channels();
    let mut sum = [0.0; 3];
    for &dot in dots {
        let means = &batch.column(dot as usize).residual()[block * channels..][..channels];
        sum.iter_mut().zip(means).for_each(|(sum, &mean)| *sum += f64::from(mean));
    }
    sum
}

/// The confusion matrix as bits. Each dot is its own neighbour, even if the calibration did not see it.
struct Neighbours {
    dots: usize,
    bits: Vec<u64>,
}

impl Neighbours {
    fn new(confusion: &Confusion) -> Self {
        let dots = confusion.dots();
        let mut bits = vec![0_u64; dots * dots.div_ceil(64)];
        bits.par_chunks_mut(dots.div_ceil(64).max(1)).enumerate().for_each(|(dot, bits)| {
            for other in confusion.neighbours(dot).iter().copied().chain([dot as u32]) {
                bits[other as usize / 64] |= 1 << (other % 64);
            }
        });
        Self { dots, bits }
    }

    /// One bit per dot, set if it shares pixels with `dot`.
    fn of(&self, dot: usize) -> &[u64] {
        &self.bits[dot * self.dots.div_ceil(64)..][..self.dots.div_ceil(64)]
    }
}
