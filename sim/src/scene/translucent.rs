//! Light that enters a translucent body at one point and leaves it at another.

use ndarray::{Array2, Array3, ArrayViewMut2, ArrayViewMut3, ArrayViewMut4, Axis, Zip, s};
use rayon::prelude::*;

use super::object::Indirect;
use super::projector::PatternPart;

/// Projector rows per work item; fixed, so that the sums do not depend on the number of threads.
const BLOCK_ROWS: usize = 16;
/// Lags per work item, whose images are summed; fixed for the same reason.
const BLOCK_LAGS: usize = 32;

/// A body with the same cross-section at each of its rows (a slab's stripe, a vertical cylinder), so that diffusion
/// depends only on the lag between rows.
#[derive(Debug)]
pub(super) struct TranslucentStrip {
    /// First camera column of the body.
    pub(super) column: usize,
    /// Per channel `[lag, camera column, cell]`: exitance of a pixel, lag rows away from a cell's row, per irradiance
    /// entering that cell.
    pub(super) kernel: Vec<Array3<f32>>,
    /// `[row, cell]`: irradiance that enters a cell of the lit surface under white light.
    pub(super) entry: Array2<f32>,
    /// Projector columns (0..1) that light each cell.
    pub(super) cell_columns: Vec<(f32, f32)>,
    /// `[row, camera column]`: fraction of the exitance that reaches the camera.
    pub(super) exit: Array2<f32>,
}

impl TranslucentStrip {
    fn add_transport(&self, channel: usize, mut transport: ArrayViewMut3<f32>) {
        let rows = self.entry.nrows();
        let kernel = &self.kernel[channel];
        transport.axis_chunks_iter_mut(Axis(0), BLOCK_ROWS).into_par_iter().enumerate().for_each(
            |(block, mut images)| {
                let first = block * BLOCK_ROWS;
                let entry = self.entry.slice(s![first..first + images.len_of(Axis(0)), ..]);
                for lag in 0..rows {
                    let exitance = entry.dot(&kernel.index_axis(Axis(0), lag).t());
                    for (v, (mut image, exitance)) in
                        (first..).zip(images.outer_iter_mut().zip(exitance.outer_iter()))
                    {
                        let above = v.checked_sub(lag).filter(|_| lag > 0);
                        let below = Some(v + lag).filter(|&t| t < rows);
                        for t in [above, below].into_iter().flatten() {
                            Zip::from(image.row_mut(t))
                                .and(&exitance)
                                .and(self.exit.row(t))
                                .for_each(|sum, &exitance, &exit| *sum += exitance * exit);
                        }
                    }
                }
            },
        );
    }

    fn add_image(&self, channel: usize, pattern: &PatternPart, mut image: ArrayViewMut2<f32>) {
        let rows = self.entry.nrows();
        let mut lit = self.entry.clone();
        for ((row, cell), value) in lit.indexed_iter_mut() {
            *value *= pattern.mean(row, self.cell_columns[cell]);
        }
        let lags: Vec<usize> = (0..rows).collect();
        let parts: Vec<Array2<f32>> = lags
            .par_chunks(BLOCK_LAGS)
            .map(|lags| {
                let mut part = Array2::zeros(self.exit.dim());
                for &lag in lags {
                    let kernel = self.kernel[channel].index_axis(Axis(0), lag);
                    let exitance = lit.dot(&kernel.t());
                    let mut below = part.slice_mut(s![lag.., ..]);
                    below += &exitance.slice(s![..rows - lag, ..]);
                    if lag > 0 {
                        let mut above = part.slice_mut(s![..rows - lag, ..]);
                        above += &exitance.slice(s![lag.., ..]);
                    }
                }
                part
            })
            .collect();
        for part in parts {
            image += &(part * &self.exit);
        }
    }
}

impl Indirect for Vec<TranslucentStrip> {
    fn add_transport(&self, mut transport: ArrayViewMut4<f32>) {
        for strip in self {
            let columns = strip.column..strip.column + strip.exit.ncols();
            for channel in 0..strip.kernel.len() {
                strip.add_transport(channel, transport.slice_mut(s![.., .., columns.clone(), channel]));
            }
        }
    }

    fn add_image(&self, pattern: &PatternPart, mut image: ArrayViewMut3<f32>) {
        for strip in self {
            let columns = strip.column..strip.column + strip.exit.ncols();
            for channel in 0..strip.kernel.len() {
                strip.add_image(channel, pattern, image.slice_mut(s![.., columns.clone(), channel]));
            }
        }
    }
}
