use std::collections::VecDeque;
use std::f64::consts::PI;

use rayon::prelude::*;

use super::Centroids;
use super::footprint::luminance;
use crate::dots::error::check_shape;
use crate::dots::sensor::median;
use crate::dots::shape::WORD_PX;
use crate::dots::{Batch, BatchArrays, DotsError, FrameShape, SparseColumn};

/// Pixels below this share of the peak are not part of the dot.
const TAIL: f32 = 0.02;

/// A dot whose estimate is not unimodal is taken to be evenly bright down to this share of the peak.
const PILLBOX: f32 = 0.5;

/// Shares of the peak at which the contour of a unimodal dot must be one piece.
const LEVELS: [f32; 3] = [0.25, 0.5, 0.75];

/// Share of a piece's pixels that may lie outside it, because of noise.
const CRUMBS: f64 = 0.05;

/// A dot whose peak differs by more than this from what its light suggests lies partly beside the plane.
const PEAK_TOLERANCE: f32 = 0.2;

/// The spread of each dot's light over the pixels, with peak 1: columns of one channel without residual.
#[derive(Debug, Clone, PartialEq)]
pub struct PointSpreads {
    /// The dots' spreads.
    pub columns: Batch,
    /// Whether each dot has its own estimate. The others, such as dots on a boundary of textures, are pillboxes.
    pub unimodal: Vec<bool>,
}

impl PointSpreads {
    /// From the discs around the brightest pixel of each dot's column: the measured values where all contours are one
    /// piece, otherwise 1 down to half of the peak. The peak is that of the mean of 3 x 3 pixels or, with less noise,
    /// the dot's light times the median ratio of peak to light. Dots without a centroid have no spread.
    ///
    /// # Errors
    /// [`DotsError::Shape`] if the centroids belong to another batch, [`DotsError::Damaged`] if there are more pixels
    /// than a batch can contain.
    pub fn new(batch: &Batch, centroids: &Centroids) -> Result<Self, DotsError> {
        check_shape("centroids", "[dots]", &[centroids.xy.len()], &[batch.dots()])?;
        let shape = FrameShape::new(batch.shape().height(), batch.shape().width(), 1)?;
        let mut spreads: Vec<(SparseColumn, bool)> = (0..batch.dots())
            .into_par_iter()
            .map_init(
                || Plane::new(shape),
                |plane, dot| match centroids.xy[dot] {
                    Some(_) => plane.spread(batch, dot),
                    None => (plane.none(), false),
                },
            )
            .collect();
        even_peaks(&mut spreads);
        let mut arrays = BatchArrays::default();
        spreads.iter().for_each(|(column, _)| arrays.push(column));
        let unimodal = spreads.iter().map(|(_, unimodal)| *unimodal).collect();
        Ok(Self { columns: Batch::new(shape, arrays)?, unimodal })
    }

    /// Radius of a dot down to a fiftieth of its peak: that of a disc of equal area, the median over the dots with
    /// their own estimate; `None` if there is no such dot.
    pub fn radius_px(&self) -> Option<f64> {
        let own = self.unimodal.iter().enumerate().filter(|(_, unimodal)| **unimodal).map(|(dot, _)| dot);
        let mut radii: Vec<f64> =
            own.map(|dot| (self.columns.column(dot).pixels().count() as f64 / PI).sqrt()).collect();
        (!radii.is_empty()).then(|| median(&mut radii))
    }
}

/// Scales the spreads of whole dots, each in units of its own peak, to the peak that its light suggests.
fn even_peaks(spreads: &mut [(SparseColumn, bool)]) {
    let light = |column: &SparseColumn| column.values.iter().sum::<f32>();
    let own = || spreads.iter().filter(|(_, unimodal)| *unimodal);
    let mut lights: Vec<f64> = own().map(|(column, _)| f64::from(light(column))).collect();
    if lights.is_empty() {
        return;
    }
    let usual = median(&mut lights) as f32;
    for (column, _) in spreads.iter_mut().filter(|(_, unimodal)| *unimodal) {
        let scale = usual / light(column);
        if (scale - 1.0).abs() <= PEAK_TOLERANCE {
            column.values.iter_mut().for_each(|value| *value *= scale);
        }
    }
}

/// A column as an image. Outside its mask it has no light, so that it is clean between dots.
struct Plane {
    shape: FrameShape,
    light: Vec<f32>,
    /// Means of 3 x 3 pixels; NaN, which fails every threshold, outside the mask.
    smooth: Vec<f32>,
    seen: Vec<bool>,
}

impl Plane {
    fn new(shape: FrameShape) -> Self {
        let pixels = shape.pixels();
        Self { shape, light: vec![0.0; pixels], smooth: vec![f32::NAN; pixels], seen: vec![false; pixels] }
    }

    /// No light.
    fn none(&self) -> SparseColumn {
        SparseColumn { residual: vec![0.0; self.shape.blocks()], ..SparseColumn::default() }
    }

    fn spread(&mut self, batch: &Batch, dot: usize) -> (SparseColumn, bool) {
        let column = batch.column(dot);
        column.pixels().for_each(|(pixel, value)| self.light[pixel] = luminance(value));
        let pixels: Vec<usize> = column.pixels().map(|(pixel, _)| pixel).collect();
        for &pixel in &pixels {
            self.smooth[pixel] = self.around(pixel).map(|near| self.light[near]).sum::<f32>() / 9.0;
        }
        let brightest = pixels.iter().copied().max_by(|&a, &b| self.smooth[a].total_cmp(&self.smooth[b]));
        let peak = brightest.map_or(0.0, |pixel| self.smooth[pixel]);
        let mut spread = self.none();
        let mut unimodal = false;
        if let Some(brightest) = brightest.filter(|_| peak > 0.0) {
            let disc = self.piece(brightest, f32::NEG_INFINITY);
            unimodal = LEVELS.iter().all(|level| {
                let above = disc.iter().filter(|&&pixel| self.smooth[pixel] >= level * peak).count();
                self.piece(brightest, level * peak).len() as f64 >= (1.0 - CRUMBS) * above as f64
            });
            let mut dot = match unimodal {
                true => self.piece(brightest, TAIL * peak),
                false => disc.into_iter().filter(|&pixel| self.smooth[pixel] >= PILLBOX * peak).collect(),
            };
            dot.sort_unstable();
            for pixel in dot {
                let word = (pixel / WORD_PX) as u32;
                if spread.words.last() != Some(&word) {
                    spread.words.push(word);
                    spread.masks.push(0);
                }
                if let Some(mask) = spread.masks.last_mut() {
                    *mask |= 1 << (pixel % WORD_PX);
                }
                spread.values.push(if unimodal { self.light[pixel] / peak } else { 1.0 });
            }
        }
        for pixel in pixels {
            (self.light[pixel], self.smooth[pixel]) = (0.0, f32::NAN);
        }
        (spread, unimodal)
    }

    /// The pixels connected to `start` that are at least as bright as `least`.
    fn piece(&mut self, start: usize, least: f32) -> Vec<usize> {
        let mut piece = Vec::new();
        let mut next = VecDeque::from([start]);
        self.seen[start] = true;
        while let Some(pixel) = next.pop_front() {
            piece.push(pixel);
            for near in self.around(pixel) {
                if !self.seen[near] && self.smooth[near] >= least {
                    self.seen[near] = true;
                    next.push_back(near);
                }
            }
        }
        piece.iter().for_each(|&pixel| self.seen[pixel] = false);
        piece
    }

    /// The 3 x 3 pixels around `pixel`, fewer at the frame's border.
    fn around(&self, pixel: usize) -> impl Iterator<Item = usize> + use<> {
        let (width, height) = (self.shape.width(), self.shape.height());
        let (row, column) = (pixel / width, pixel % width);
        let rows = row.saturating_sub(1)..(row + 2).min(height);
        rows.flat_map(move |row| {
            (column.saturating_sub(1)..(column + 2).min(width)).map(move |column| row * width + column)
        })
    }
}
