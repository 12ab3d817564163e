use ndarray::Array3;
use rayon::prelude::*;

use super::Separation;
use super::relight::floodlit;
use super::sum::{by_bands, first_word};
use crate::dots::batch::Word;
use crate::dots::calibrate::Confusion;
use crate::dots::calibrate::luminance;
use crate::dots::column::runs;
use crate::dots::error::{check_range, check_shape};
use crate::dots::shape::BLOCK_PX;
use crate::dots::{Batch, DotsError};

/// The dot that no pixel has.
const NONE: u32 = u32::MAX;

/// Separates direct from global light by the extremes over images that are lit by all dots but one, as Nayar et al. (2006)
/// do with patterns: `direct = L_max - L_min`, `global = L_min N / (N - 1)` for N dots.
///
/// A dot's shadow is where its mask is; beyond it the light stays. Where several dots cover a pixel, one of them missing does
/// not make it dark: see [`shadow_neighbours`].
///
/// # Errors
/// [`DotsError::OutOfRange`] below two dots.
pub fn shadow_dot(batch: &Batch) -> Result<Separation, DotsError> {
    let dots = batch.dots();
    check_range("dots", dots as f64, dots >= 2, "at least 2")?;
    let channels = batch.shape().channels();
    let light = floodlit(batch);
    // Largest and least light that one dot takes away, one image each: as two more channels.
    let extremes = by_bands(batch.shape(), 2 * channels, |band, sums| {
        let pixels = sums.len() / (2 * channels);
        let mut covering = vec![0_u32; pixels];
        let (most, least) = sums.split_at_mut(channels * pixels);
        most.fill(f64::NEG_INFINITY);
        least.fill(f64::INFINITY);
        for dot in 0..dots {
            for Word { word, mask, mut values } in batch.band(dot, band).words() {
                let first = (word - first_word(batch, band)) * BLOCK_PX;
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
        for (pixel, &covering) in covering.iter().enumerate() {
            for at in (0..channels).map(|channel| channel * pixels + pixel) {
                // A dot that does not cover the pixel takes nothing away.
                if (covering as usize) < dots {
                    (most[at], least[at]) = (most[at].max(0.0), least[at].min(0.0));
                }
            }
        }
    });
    let share = dots as f32 / (dots - 1) as f32;
    let separate = |at: (usize, usize, usize)| {
        let (row, column, channel) = at;
        let (most, least) = (extremes[at], extremes[[row, column, channels + channel]]);
        (most - least, (light[at] - most) * share)
    };
    Ok(Separation {
        direct: Array3::from_shape_fn(light.dim(), |at| separate(at).0),
        global: Array3::from_shape_fn(light.dim(), |at| separate(at).1),
    })
}

/// Separates direct from global light where dots overlap: at each pixel, all dots are switched off that share pixels of the
/// calibration plane with the one that is brightest there, `S = {j : M_ij > 0}`. What is left is global light from the
/// other dots: `global = L_min N / (N - |S|)`, `direct = floodlit - global`.
///
/// The neighbours hold off the plane as well, where the dots' places on it do not. Pixels that no mask has are global.
///
/// # Errors
/// [`DotsError::Shape`] if the confusion matrix is not of the batch's dots, [`DotsError::OutOfRange`] if a dot has all
/// others for neighbours.
pub fn shadow_neighbours(batch: &Batch, confusion: &Confusion) -> Result<Separation, DotsError> {
    let (shape, dots) = (batch.shape(), batch.dots());
    let (channels, columns) = (shape.channels(), shape.block_columns());
    check_shape("confusion", "[dots]", &[confusion.dots()], &[dots])?;
    let most = (0..dots).map(|dot| confusion.neighbours(dot).len().max(1)).max().unwrap_or(0);
    check_range(
        "neighbours of a dot",
        most as f64,
        most < dots,
        "fewer than there are dots: binarise higher",
    )?;
    let is_neighbour = Neighbours::new(confusion);
    let light = floodlit(batch);
    // What the dots that are switched off would give, in the pixels' channels, and N / (N - |S|) in one more.
    let off = by_bands(shape, channels + 1, |band, sums| {
        let pixels = sums.len() / (channels + 1);
        let (mut brightest, mut dot_of) = (vec![f32::NEG_INFINITY; pixels], vec![NONE; pixels]);
        for dot in 0..dots {
            for Word { word, mask, mut values } in batch.band(dot, band).words() {
                let first = (word - first_word(batch, band)) * BLOCK_PX;
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
        for dot in 0..dots {
            let (column, neighbours) = (batch.band(dot, band), is_neighbour.of(dot));
            for Word { word, mask, mut values } in column.words() {
                let (first, block) = ((word - first_word(batch, band)) * BLOCK_PX, word % columns);
                for run in runs(mask) {
                    let (of_run, rest) = values.split_at(run.len() * channels);
                    values = rest;
                    let run = first + run.start..first + run.end;
                    for channel in 0..channels {
                        let mean = f64::from(column.residual()[block * channels + channel]);
                        let sums = &mut sums[channel * pixels + run.start..channel * pixels + run.end];
                        let light = of_run[channel..].iter().step_by(channels);
                        for ((sum, &value), &brightest) in
                            sums.iter_mut().zip(light).zip(&dot_of[run.clone()])
                        {
                            let shares = neighbours[brightest as usize / 64] >> (brightest % 64) & 1 == 1;
                            *sum += if shares { f64::from(value) - mean } else { 0.0 };
                        }
                    }
                }
            }
        }
        // The neighbours' residual too is switched off; one sum serves all pixels of a block with the same dot.
        let mut residuals: Vec<Option<[f64; 3]>> = vec![None; dots];
        for block in 0..columns {
            let mut met = Vec::new();
            let rows = (block * BLOCK_PX..pixels).step_by(shape.width());
            for pixel in rows.flat_map(|first| first..first + BLOCK_PX) {
                let dot = dot_of[pixel] as usize;
                if dot_of[pixel] == NONE {
                    sums[channels * pixels + pixel] = 1.0;
                    continue;
                }
                // The calibration may not have seen the dot.
                let itself = [dot as u32];
                let neighbours = match confusion.neighbours(dot) {
                    [] => &itself,
                    neighbours => neighbours,
                };
                let residual = *residuals[dot].get_or_insert_with(|| {
                    met.push(dot);
                    let mut sum = [0.0; 3];
                    for &other in neighbours {
                        let means =
                            &batch.band(other as usize, band).residual()[block * channels..][..channels];
                        sum.iter_mut().zip(means).for_each(|(sum, &mean)| *sum += f64::from(mean));
                    }
                    sum
                });
                for channel in 0..channels {
                    sums[channel * pixels + pixel] += residual[channel];
                }
                sums[channels * pixels + pixel] = dots as f64 / (dots - neighbours.len()) as f64;
            }
            met.into_iter().for_each(|dot| residuals[dot] = None);
        }
    });
    let global = Array3::from_shape_fn(light.dim(), |at| (light[at] - off[at]) * off[[at.0, at.1, channels]]);
    Ok(Separation { direct: light - &global, global })
}

/// The confusion matrix as bits, each dot its own neighbour even where the calibration has not seen it.
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

    /// A bit for each dot that shares pixels with this one.
    fn of(&self, dot: usize) -> &[u64] {
        &self.bits[dot * self.dots.div_ceil(64)..][..self.dots.div_ceil(64)]
    }
}
