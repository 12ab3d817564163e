use super::Separation;
use super::relight::floodlit;
use super::sum::{add_blocks, by_bands, first_word};
use crate::dots::batch::Word;
use crate::dots::calibrate::Fundamental;
use crate::dots::column::runs;
use crate::dots::error::{check_range, check_shape};
use crate::dots::shape::BLOCK_PX;
use crate::dots::{Batch, DotsError};

/// Width of the frames that distances of masks are given for, in pixels.
const REFERENCE_WIDTH_PX: f64 = 1024.0;

/// A block's share of the mask is the mean over this many points a side.
const POINTS: usize = 4;

/// Farther out than this many sigmas the mask is 0; there a Gaussian is 4e-6.
const REACH_SIGMAS: f64 = 5.0;

/// How the mask falls off around an epipolar line.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub enum MaskRule {
    /// 1 up to the distance, beyond it a Gaussian: the dot's whole width is direct.
    #[default]
    Plateau,
    /// Eq. 7 as printed: a Gaussian around the line itself, cut off at the distance. Keeps a fifth of the paper's dot.
    Printed,
}

/// Which light counts as direct, by its distance from the dot's epipolar line.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpipolarMask {
    /// The paper's d_thresh, in pixels of a frame that is 1024 wide, as 19.
    pub distance_px: f64,
    /// Softness, in the same pixels, as 2; 0 cuts sharply.
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
    /// Nothing farther away is direct.
    fn reach_px(&self) -> f64 {
        self.distance_px + REACH_SIGMAS * self.sigma_px
    }

    /// Share that is direct at this distance from the line.
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
    /// Shares of pixels side by side from (x, y) on. The distance from a line is largest at an end of them, and smallest
    /// too where the line does not cross, so that mostly one share serves all.
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

/// A dot's epipolar line, scaled so that it gives distances in pixels.
#[derive(Clone, Copy)]
struct Line {
    x: f64,
    y: f64,
    constant: f64,
}

impl Line {
    /// None where all of the image is as far away: the dot's line is the one at infinity.
    fn new([x, y, constant]: [f64; 3]) -> Option<Self> {
        let length = x.hypot(y);
        (length > 0.0 && length.is_finite()).then(|| Self {
            x: x / length,
            y: y / length,
            constant: constant / length,
        })
    }

    /// Positive on one side of it, negative on the other.
    fn signed(&self, x: f64, y: f64) -> f64 {
        self.x * x + self.y * y + self.constant
    }

    fn distance(&self, x: f64, y: f64) -> f64 {
        self.signed(x, y).abs()
    }
}

/// Separates direct from global light by the epipolar constraint (after O'Toole et al. 2014): of each column, what lies
/// near its dot's epipolar line is direct. `mirror` has each dot's place on the plane before the mirror, none for dots that
/// were not calibrated; their light counts as global. Direct plus global is the floodlit image.
///
/// The mask of the residual, whose light has no place within its block, is the mean over the block.
///
/// # Errors
/// [`DotsError::Shape`] unless `mirror` has all dots, [`DotsError::OutOfRange`] for a mask that cannot be.
pub fn epipolar(
    batch: &Batch,
    fundamental: &Fundamental,
    mirror: &[Option<[f64; 2]>],
    mask: &EpipolarMask,
) -> Result<Separation, DotsError> {
    let shape = batch.shape();
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

    let (channels, columns) = (shape.channels(), shape.block_columns());
    let direct = by_bands(shape, channels, |band, sums| {
        let pixels = sums.len() / channels;
        let (mut blocks, mut shares) = (vec![0.0; columns * channels], vec![0.0; columns]);
        let mut weights = [0.0; BLOCK_PX];
        for (dot, line) in lines.iter().enumerate() {
            let Some(line) = line else { continue };
            let column = batch.band(dot, band);
            for (at, share) in shares.iter_mut().enumerate() {
                *share = share_of_block(line, &falloff, (at * BLOCK_PX) as f64, (band * BLOCK_PX) as f64);
                if *share > 0.0 {
                    for channel in 0..channels {
                        blocks[channel * columns + at] +=
                            *share * f64::from(column.residual()[at * channels + channel]);
                    }
                }
            }
            for Word { word, mask, values } in column.words() {
                let block = word % columns;
                let first = (word - first_word(batch, band)) * BLOCK_PX;
                let (left, y) = ((block * BLOCK_PX) as f64, (word / columns) as f64);
                let mut values = values;
                for run in runs(mask) {
                    let (of_run, rest) = values.split_at(run.len() * channels);
                    values = rest;
                    let weights = &mut weights[..run.len()];
                    falloff.along(line, left + run.start as f64, y, weights);
                    for channel in 0..channels {
                        let place = channel * pixels + first;
                        let sums = sums[place + run.start..place + run.end].iter_mut();
                        // The block's mean goes to all pixels in the end; here it is not the light.
                        let mean = shares[block] * f64::from(column.residual()[block * channels + channel]);
                        let light = of_run[channel..].iter().step_by(channels).zip(&*weights);
                        sums.zip(light)
                            .for_each(|(sum, (&value, share))| *sum += share * f64::from(value) - mean);
                    }
                }
            }
        }
        for (sums, blocks) in sums.chunks_exact_mut(pixels).zip(blocks.chunks_exact(columns)) {
            add_blocks(sums, blocks.iter().copied());
        }
    });
    let global = floodlit(batch) - &direct;
    Ok(Separation { direct, global })
}

/// Mean of the mask over a block.
fn share_of_block(line: &Line, falloff: &Falloff, left: f64, top: f64) -> f64 {
    let half = (BLOCK_PX as f64 - 1.0) / 2.0;
    let reach = falloff.distance_px
        + REACH_SIGMAS * falloff.sigma_px
        + BLOCK_PX as f64 * std::f64::consts::FRAC_1_SQRT_2;
    if line.distance(left + half, top + half) > reach {
        return 0.0;
    }
    let pitch = (BLOCK_PX / POINTS) as f64;
    let at = |point: usize| (point as f64 + 0.5) * pitch - 0.5;
    let points = (0..POINTS * POINTS).map(|point| (left + at(point % POINTS), top + at(point / POINTS)));
    points.map(|(x, y)| falloff.at(line.distance(x, y))).sum::<f64>() / (POINTS * POINTS) as f64
}
