use std::ops::Range;

use ndarray::Array3;

use super::sum::{add_blocks, blocks_of, by_bands, first_word, sum_blocks};
use super::{Separation, check_light};
use crate::dots::batch::Word;
use crate::dots::calibrate::Fundamental;
use crate::dots::column::runs;
use crate::dots::error::{check_range, check_shape};
use crate::dots::shape::WORD_PX;
use crate::dots::{Batch, DotsError, FrameShape};

/// Frame width in pixels to which the distances of masks refer.
pub const REFERENCE_WIDTH_PX: f64 = 1024.0;

/// A block's share of the mask is the mean over this many points per side.
const POINTS: usize = 4;

/// Shares of blocks that are kept for the next row of a disc.
const BLOCKS_AT_HAND: usize = 16;

/// Beyond this many sigmas the mask is 0; a Gaussian is 4e-6 there.
const REACH_SIGMAS: f64 = 5.0;

/// How the mask falls off around an epipolar line.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum MaskRule {
    /// 1 up to the distance, then falling off as a Gaussian: the dot's whole width is direct.
    #[default]
    Plateau,
    /// Eq. 7 as printed: a Gaussian around the line itself, cut off at the distance. Keeps a fifth of the paper's
    /// dot.
    Printed,
}

/// Which light counts as direct, by its distance from the dot's epipolar line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpipolarMask {
    /// The paper's d_thresh, in pixels of a frame that is 1024 pixels wide; for example 19.
    pub distance_px: f64,
    /// Softness, in the same pixels, for example 2; 0 gives a sharp edge.
    pub sigma_px: f64,
    /// The shape of the mask.
    pub rule: MaskRule,
}

/// A mask with distances in the batch's own pixels.
#[derive(Clone, Copy)]
struct Falloff {
    distance_px: f64,
    sigma_px: f64,
    rule: MaskRule,
}

impl Falloff {
    /// Beyond this distance no light is direct.
    fn reach_px(&self) -> f64 {
        self.distance_px + REACH_SIGMAS * self.sigma_px
    }

    /// Share of direct light at this distance from the line.
    fn at(&self, px: f64) -> f64 {
        let gaussian = |px: f64| (-0.5 * (px / self.sigma_px).powi(2)).exp();
        if px > self.reach_px() {
            return 0.0;
        }
        match self.rule {
            MaskRule::Plateau if px <= self.distance_px => 1.0,
            MaskRule::Plateau if self.sigma_px > 0.0 => gaussian(px - self.distance_px),
            MaskRule::Printed if px > self.distance_px => 0.0,
            MaskRule::Printed if self.sigma_px > 0.0 => gaussian(px),
            MaskRule::Printed => 1.0,
            MaskRule::Plateau => 0.0,
        }
    }
}

impl Falloff {
    /// Shares of adjacent pixels starting at (x, y). Their distance from a line is largest at one end, and smallest
    /// at the other unless the line crosses them, so that mostly one share serves all of them.
    #[inline(always)]
    fn along(&self, line: &Line, x: f64, y: f64, shares: &mut [f64]) {
        let (first, last) = (line.signed(x, y), line.signed(x + (shares.len() - 1) as f64, y));
        let flat = match self.rule {
            MaskRule::Plateau => self.distance_px,
            MaskRule::Printed => -1.0,
        };
        if first.abs().max(last.abs()) <= flat {
            shares.fill(1.0);
        } else if first * last > 0.0 && first.abs().min(last.abs()) > self.reach_px() {
            shares.fill(0.0);
        } else {
            for (step, share) in shares.iter_mut().enumerate() {
                *share = self.at(line.distance(x + step as f64, y));
            }
        }
    }
}

/// A dot's epipolar line, scaled to give distances in pixels.
#[derive(Clone, Copy)]
struct Line {
    x: f64,
    y: f64,
    constant: f64,
}

impl Line {
    /// `None` for the line at infinity, to which all points of the image are equally far.
    fn new([x, y, constant]: [f64; 3]) -> Option<Self> {
        let length = x.hypot(y);
        (length > 0.0 && length.is_finite()).then(|| Self {
            x: x / length,
            y: y / length,
            constant: constant / length,
        })
    }

    /// Signed distance in pixels: positive on one side of the line, negative on the other.
    fn signed(&self, x: f64, y: f64) -> f64 {
        self.x * x + self.y * y + self.constant
    }

    /// The blocks of a row that the mask may reach; the share of all other blocks is 0.
    fn blocks_near(&self, falloff: &Falloff, row: usize, shape: FrameShape) -> Range<usize> {
        let side = shape.block_px() as f64;
        let half = (side - 1.0) / 2.0;
        let reach = falloff.reach_px() + (half + 0.5) * std::f64::consts::SQRT_2;
        let columns = shape.block_columns();
        // Distance of the block's centre, a linear function of its column.
        let at_0 = self.signed(half, row as f64 * side + half);
        let step = self.x * side;
        let (one, other) = ((-reach - at_0) / step, (reach - at_0) / step);
        let (first, last) = match step == 0.0 {
            true if at_0.abs() <= reach => (0.0, columns as f64 - 1.0),
            true => return 0..0,
            false => (one.min(other).ceil(), one.max(other).floor()),
        };
        let within = |column: f64| column.clamp(0.0, columns as f64) as usize;
        let (first, end) = (within(first), within(last + 1.0));
        row * columns + first..row * columns + end.max(first)
    }

    fn distance(&self, x: f64, y: f64) -> f64 {
        self.signed(x, y).abs()
    }
}

/// Separates direct from global light by the epipolar constraint (after O'Toole et al. 2014): the part of each column
/// near its dot's epipolar line is direct. `mirror` has each dot's position on the plane in front of the mirror,
/// `None` for dots that were not calibrated, whose light counts as global. Direct plus global is `light`, the
/// floodlit image.
///
/// Light of the residual has no position within its block, so its mask is the mean over the block.
///
/// # Errors
/// [`DotsError::Shape`] unless `mirror` has all dots and `light` the batch's shape, [`DotsError::OutOfRange`] for an
/// invalid mask.
pub fn epipolar(
    batch: &Batch,
    light: &Array3<f32>,
    fundamental: &Fundamental,
    mirror: &[Option<[f64; 2]>],
    mask: &EpipolarMask,
) -> Result<Separation, DotsError> {
    let shape = batch.shape();
    check_light(batch, light)?;
    check_shape("mirror", "[dots]", &[mirror.len()], &[batch.dots()])?;
    for (field, value) in [("distance_px", mask.distance_px), ("sigma_px", mask.sigma_px)] {
        check_range(field, value, value >= 0.0 && value.is_finite(), "at least 0 pixels of 1024")?;
    }
    let scale = shape.width() as f64 / REFERENCE_WIDTH_PX;
    let falloff =
        Falloff { distance_px: scale * mask.distance_px, sigma_px: scale * mask.sigma_px, rule: mask.rule };
    let lines: Vec<Option<Line>> = mirror
        .iter()
        .map(|mirror| mirror.and_then(|mirror| Line::new(fundamental.epipolar_line(mirror))))
        .collect();

    let (channels, blocks) = (shape.channels(), shape.blocks());
    let residual = sum_blocks(batch, channels, |dot, sums| {
        let Some(line) = &lines[dot] else { return };
        let means = batch.column(dot).residual();
        for row in 0..shape.block_rows() {
            for block in line.blocks_near(&falloff, row, shape) {
                let share = share_of_block(line, &falloff, block, shape);
                for channel in 0..channels {
                    sums[channel * blocks + block] += share * f64::from(means[block * channels + channel]);
                }
            }
        }
    });
    let [direct] = by_bands(shape, channels, |band, sums| {
        let pixels = sums.len() / channels;
        let mut weights = [0.0; WORD_PX];
        for (dot, column) in batch.in_band(band) {
            let Some(line) = &lines[dot] else { continue };
            // Each row of a disc touches the same few blocks.
            let mut shares = [(usize::MAX, 0.0); BLOCKS_AT_HAND];
            for (block, Word { word, mask, mut values }) in column.parts() {
                let slot = &mut shares[block % BLOCKS_AT_HAND];
                if slot.0 != block {
                    *slot = (block, share_of_block(line, &falloff, block, shape));
                }
                let share = slot.1;
                let first = (word - first_word(batch, band)) * WORD_PX;
                let left = (word % shape.word_columns() * WORD_PX) as f64;
                let y = (word / shape.word_columns()) as f64;
                for run in runs(mask) {
                    let (of_run, rest) = values.split_at(run.len() * channels);
                    values = rest;
                    let weights = &mut weights[..run.len()];
                    falloff.along(line, left + run.start as f64, y, weights);
                    for channel in 0..channels {
                        let place = channel * pixels + first;
                        let sums = sums[place + run.start..place + run.end].iter_mut();
                        // The block's mean is added to all its pixels at the end; it does not apply to pixels of the
                        // mask.
                        let mean = share * f64::from(column.residual()[block * channels + channel]);
                        let light = of_run[channel..].iter().step_by(channels).zip(&*weights);
                        sums.zip(light)
                            .for_each(|(sum, (&value, weight))| *sum += weight * f64::from(value) - mean);
                    }
                }
            }
        }
        for (sums, residual) in sums.chunks_exact_mut(pixels).zip(residual.chunks_exact(blocks)) {
            add_blocks(sums, &residual[blocks_of(batch, band)], shape);
        }
    });
    let global = light - &direct;
    Ok(Separation { direct, global })
}

/// Mean of the mask over a block.
fn share_of_block(line: &Line, falloff: &Falloff, block: usize, shape: FrameShape) -> f64 {
    let (side, columns) = (shape.block_px(), shape.block_columns());
    let pitch_px = (side / POINTS) as f64;
    let left = (block % columns * side) as f64;
    let top = (block / columns * side) as f64;
    let at = |point: usize| point as f64 * pitch_px + (pitch_px - 1.0) / 2.0;
    let points = (0..POINTS * POINTS).map(|point| (left + at(point % POINTS), top + at(point / POINTS)));
    points.map(|(x, y)| falloff.at(line.distance(x, y))).sum::<f64>() / (POINTS * POINTS) as f64
}
