use ndarray::{Array2, ArrayView2, ArrayView3, ArrayViewMut3, Axis, Zip};
use rayon::prelude::*;

use super::{Estimate, ImagesError, check_frames, check_range, check_shape, is_usable, mean_image, median};

/// Frames of one level of light.
#[derive(Debug, Clone, Copy)]
pub struct LightLevel<'a> {
    /// The light, relative to the other levels: the number of passes of the beam over the exposure.
    pub light: f64,
    /// The frames, `[n, t, s]`.
    pub frames: ArrayView3<'a, f32>,
    /// The dark image at their exposure, `[t, s]`.
    pub dark_dn: ArrayView2<'a, f32>,
}

impl LightLevel<'_> {
    /// Checks shapes and the number of frames.
    pub(super) fn check(&self, frames: usize) -> Result<(), ImagesError> {
        check_frames(self.frames.len_of(Axis(0)), frames)?;
        check_shape("dark_dn", "[t, s]", self.dark_dn.shape(), &self.frames.shape()[1..])?;
        let accepted = self.light.is_finite() && self.light >= 0.0;
        check_range("light", self.light, accepted, "at least 0: the number of passes of the beam")
    }
}

/// The curve of the camera's response: `DN (1 + a DN)` is proportional to the light, DN counting from an exposure of 0.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Linearity {
    /// `a`.
    pub per_dn: Estimate,
    /// What full scale deviates by from a straight line, relative to itself.
    pub bend: f64,
}

/// Largest accepted bend.
pub const MOST_BEND: f64 = 0.03;
/// Standard deviations by which a bend is certainly larger.
const CERTAIN: f64 = 3.0;
/// Share of the pixels that must not be cut off.
const LEAST_KEPT: f64 = 0.5;
/// Pixels whose brightest level exceeds this share of full scale may be cut off in some frames.
const HIGHEST_SHARE: f32 = 0.97;

impl Linearity {
    /// Fits `a` to levels of known light, at least two of them different; with 1, 2 and 3 passes of one picture the
    /// light is known exactly. The standard deviation is found by fitting the frames one by one, so that it contains
    /// whatever changes between frames; it takes at least 4 frames a level.
    ///
    /// # Errors
    /// [`ImagesError::Curved`] beyond 3 % of `full_scale_dn` by more than 3 standard deviations: gamma is on;
    /// [`ImagesError::TooFew`];
    /// [`ImagesError::Shape`]; [`ImagesError::OutOfRange`].
    pub fn new(
        levels: &[LightLevel],
        full_scale_dn: f32,
        usable: Option<ArrayView2<bool>>,
    ) -> Result<Self, ImagesError> {
        let different = levels.iter().filter(|level| level.light != levels[0].light).count();
        if different == 0 {
            let what = "levels of different light";
            let cure = "take frames of 1, 2 and 3 passes of one picture";
            return Err(ImagesError::TooFew { what, given: levels.len().min(1), needed: 2, cure });
        }
        for level in levels {
            level.check(4)?;
            check_shape("levels", "[t, s]", &level.frames.shape()[1..], &levels[0].frames.shape()[1..])?;
            check_range("light", level.light, level.light > 0.0, "positive: leave out dark frames")?;
        }
        let means: Vec<Array2<f32>> = levels.iter().map(|level| mean_image(level.frames)).collect();
        let kept = Array2::from_shape_fn(means[0].dim(), |(t, s)| {
            is_usable(usable, t, s)
                && means.iter().zip(levels).all(|(mean, level)| {
                    mean[[t, s]] < HIGHEST_SHARE * full_scale_dn && mean[[t, s]] > level.dark_dn[[t, s]]
                })
        });
        let pixels = kept.iter().filter(|kept| **kept).count();
        // Where only the darker ones of equal pixels are left, their noise is what selects them.
        let needed = ((LEAST_KEPT * kept.len() as f64) as usize).max(1);
        if pixels < needed {
            let what = "pixels that are lit and do not saturate at any level";
            return Err(ImagesError::TooFew { what, given: pixels, needed, cure: "take a darker grey" });
        }
        let images: Vec<ArrayView2<f32>> = means.iter().map(|mean| mean.view()).collect();
        let value = curve(levels, &images, &kept);
        let frames = levels.iter().map(|level| level.frames.len_of(Axis(0))).min().unwrap_or(0);
        let of_frames = (0..frames).map(|frame| {
            let images: Vec<_> = levels.iter().map(|level| level.frames.index_axis(Axis(0), frame)).collect();
            curve(levels, &images, &kept)
        });
        let of_frames: Vec<f64> = of_frames.collect();
        let mean = of_frames.iter().sum::<f64>() / frames as f64;
        let squares = of_frames.iter().map(|one| (one - mean).powi(2)).sum::<f64>();
        let sd = (squares / (frames * (frames - 1)) as f64).sqrt();
        let bend = value * f64::from(full_scale_dn);
        let doubt = CERTAIN * sd * f64::from(full_scale_dn);
        if bend.is_nan() || bend.abs() - doubt > MOST_BEND {
            return Err(ImagesError::Curved { bend: bend.abs(), limit: MOST_BEND });
        }
        Ok(Self { per_dn: Estimate { value, sd }, bend })
    }

    /// Makes images of these pixels `[n, t, s]` proportional to the light; `zero_dn` are their counts at an exposure of 0,
    /// `[t, s]`, which stay as they are.
    pub fn straighten(&self, mut images: ArrayViewMut3<'_, f32>, zero_dn: &Array2<f32>) {
        let a = self.per_dn.value as f32;
        for mut image in images.outer_iter_mut() {
            Zip::from(&mut image).and(zero_dn).par_for_each(|dn, zero| {
                let above = *dn - zero;
                *dn = zero + above * (1.0 + a * above);
            });
        }
    }
}

/// Pixels are averaged over blocks of this many rows and columns: noise does not average out of squares.
const BLOCK: usize = 16;
/// The four colours that a mosaic may have: whether row and column are odd.
const MOSAIC: [[usize; 2]; 4] = [[0, 0], [0, 1], [1, 0], [1, 1]];

/// The `a` for which `y (1 + a y)` of each block of kept pixels is closest to its own multiple of the levels' light.
/// Levels are weighted with 1 / light, as is shot noise.
fn curve(levels: &[LightLevel], images: &[ArrayView2<f32>], kept: &Array2<bool>) -> f64 {
    let light: f64 = levels.iter().map(|level| level.light).sum();
    let (rows, columns) = kept.dim();
    // Pixels of one colour of a mosaic are averaged apart: squares of a mean do not see what differs within it.
    let parts = (0..columns).step_by(BLOCK).flat_map(|first| MOSAIC.map(|part| (first, part)));
    let parts: Vec<(usize, [usize; 2])> = parts.collect();
    let sums = (0..rows.div_ceil(BLOCK)).into_par_iter().map(|block_row| {
        let mut sums = [0.0; 2];
        for &(first, [odd_row, odd_column]) in &parts {
            let inside = || {
                let rows = block_row * BLOCK..((block_row + 1) * BLOCK).min(rows);
                rows.flat_map(move |t| (first..(first + BLOCK).min(columns)).map(move |s| (t, s)))
                    .filter(|&(t, s)| kept[[t, s]] && [t % 2, s % 2] == [odd_row, odd_column])
            };
            let pixels = inside().count() as f64;
            if pixels == 0.0 {
                continue;
            }
            let [mut y1, mut y2, mut y3, mut y4] = [0.0; 4];
            for (level, image) in levels.iter().zip(images) {
                let y = inside().map(|at| f64::from(image[at] - level.dark_dn[at])).sum::<f64>() / pixels;
                y1 += y;
                y2 += y * y;
                y3 += y.powi(3) / level.light;
                y4 += y.powi(4) / level.light;
            }
            // The parts of y and y^2 that are proportional to the light are the block's own brightness.
            sums[0] += pixels * (y3 - y2 * y1 / light);
            sums[1] += pixels * (y4 - y2 * y2 / light);
        }
        sums
    });
    // In one order, so that the bits do not depend on the threads.
    let sums: Vec<[f64; 2]> = sums.collect();
    let [product, square] = [0, 1].map(|of| sums.iter().map(|sums| sums[of]).sum::<f64>());
    -product / square
}

/// From which DN a pixel is taken to be saturated.
#[derive(Debug, Clone, PartialEq)]
pub struct SaturationLimit {
    /// The limit in DN as the camera delivers them, `[t, s]`.
    pub limit_dn: Array2<u16>,
    /// Median of the plateaus, or full scale if no pixel reached one.
    pub plateau_dn: f64,
    /// Share of the pixels whose own plateau was seen.
    pub seen: f64,
}

/// A pixel is on its plateau if the last step of light raises it by less than this share of what it should.
const STILL_RISING: f64 = 0.8;
/// The limit lies this many standard deviations of a frame below the plateau.
const LIMIT_SIGMAS: f64 = 4.0;

impl SaturationLimit {
    /// From a ladder of light of which at least the last level saturates some pixels: each pixel's plateau less 4
    /// standard deviations of a frame there, which is at least the read noise. Pixels that reach no plateau get the
    /// median of the others, or full scale less 4 standard deviations if there are none.
    ///
    /// # Errors
    /// [`ImagesError::TooFew`] for fewer than two levels of 2 frames; [`ImagesError::Shape`];
    /// [`ImagesError::OutOfRange`].
    pub fn new(ladder: &[LightLevel], full_scale_dn: f32, read_noise_dn: f64) -> Result<Self, ImagesError> {
        for level in ladder {
            level.check(2)?;
        }
        let mut ladder: Vec<&LightLevel> = ladder.iter().collect();
        ladder.sort_by(|a, b| a.light.total_cmp(&b.light));
        let [.., below, top] = ladder[..] else {
            let cure = "take frames of 1 to 4 passes of one picture";
            return Err(ImagesError::TooFew {
                what: "levels of light",
                given: ladder.len(),
                needed: 2,
                cure,
            });
        };
        check_range(
            "light",
            top.light,
            below.light > 0.0 && top.light > below.light,
            "brighter than the level before it",
        )?;
        check_shape("ladder", "[n, t, s]", &top.frames.shape()[1..], &below.frames.shape()[1..])?;
        let (before, plateau) = (mean_image(below.frames), mean_image(top.frames));
        let rise = top.light / below.light - 1.0;
        let reached = Zip::from(&before).and(&plateau).and(&below.dark_dn).and(&top.dark_dn).map_collect(
            |&before, &plateau, &before_dark, &dark| {
                let signal = f64::from(before - before_dark);
                signal > 0.0 && f64::from(plateau - dark) - signal < STILL_RISING * rise * signal
            },
        );
        let on_plateau = || plateau.iter().zip(&reached).filter(|(_, reached)| **reached);
        let mut plateaus: Vec<f64> = on_plateau().map(|(&plateau, _)| f64::from(plateau)).collect();
        let seen = plateaus.len() as f64 / plateau.len() as f64;
        let typical = median(&mut plateaus).unwrap_or(f64::from(full_scale_dn));
        let mut scatter: Vec<f64> = reached
            .indexed_iter()
            .filter(|(_, reached)| **reached)
            .map(|((t, s), _)| {
                let samples = top.frames.slice(ndarray::s![.., t, s]).mapv(f64::from);
                samples.var(1.0)
            })
            .collect();
        let degrees = top.frames.len_of(Axis(0)) - 1;
        let variance = median(&mut scatter).unwrap_or(0.0) / super::median_of_variance(degrees);
        let margin = LIMIT_SIGMAS * variance.sqrt().max(read_noise_dn);
        let limit_dn = Zip::from(&plateau).and(&reached).map_collect(|&plateau, &reached| {
            let plateau = if reached { f64::from(plateau) } else { typical };
            (plateau - margin).clamp(0.0, f64::from(u16::MAX)) as u16
        });
        Ok(Self { limit_dn, plateau_dn: typical, seen })
    }
}
