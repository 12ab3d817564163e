use super::Footprints;
use super::footprint::luminance;
use crate::dots::batch::Word;
use crate::dots::column::bits;
use crate::dots::error::check_shape;
use crate::dots::sensor::median;
use crate::dots::shape::WORD_PX;
use crate::dots::{Batch, DotsError, FrameShape};

/// A dot with less than this share of the median dot's light missed the plane, or most of it: what is seen is noise, or
/// an edge whose middle is not the dot's.
const LEAST_LIGHT: f64 = 0.25;

/// The positions of the dots on the calibration plane.
#[derive(Debug, Clone, PartialEq)]
pub struct Centroids {
    shape: FrameShape,
    /// Column and row in pixels, 0 at the centre of the first pixel; `None` for a dot that was not seen.
    pub xy: Vec<Option<[f64; 2]>>,
}

/// The shift of one batch's dots from another's.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Drift {
    /// Median shift to the right.
    pub right_px: f64,
    /// Median shift down.
    pub down_px: f64,
    /// Root mean square distance of the individual dots from that shift.
    pub rms_px: f64,
    /// Number of dots seen in both batches.
    pub dots: usize,
}

impl Centroids {
    /// Positions that are known otherwise, `[dots]`.
    pub fn at(shape: FrameShape, xy: Vec<Option<[f64; 2]>>) -> Self {
        Self { shape, xy }
    }

    /// Means of the pixel positions within the footprints, weighted by light. Dots with less than a quarter of the
    /// median dot's light are not seen.
    ///
    /// # Errors
    /// [`DotsError::Shape`] if the footprints belong to another batch.
    pub fn new(batch: &Batch, footprints: &Footprints) -> Result<Self, DotsError> {
        check_shape("footprints", "[dots]", &[footprints.dots()], &[batch.dots()])?;
        let shape = batch.shape();
        let centroid = |dot: usize| {
            let [mut light, mut x, mut y] = [0.0; 3];
            let mut covered = footprints.words(dot).peekable();
            for Word { word, mask, values } in batch.column(dot).words() {
                let Some((_, footprint)) = covered.next_if(|(at, _)| *at == word) else { continue };
                for (bit, value) in bits(mask).zip(values.chunks_exact(shape.channels())) {
                    if footprint >> bit & 1 == 1 {
                        let (pixel, value) = (word * WORD_PX + bit, f64::from(luminance(value)));
                        light += value;
                        x += value * (pixel % shape.width()) as f64;
                        y += value * (pixel / shape.width()) as f64;
                    }
                }
            }
            (light, [x / light, y / light])
        };
        let found: Vec<(f64, [f64; 2])> = (0..batch.dots()).map(centroid).collect();
        let mut lights: Vec<f64> =
            found.iter().map(|(light, _)| *light).filter(|light| *light > 0.0).collect();
        let least = if lights.is_empty() { 0.0 } else { LEAST_LIGHT * median(&mut lights) };
        let xy = found.into_iter().map(|(light, xy)| (light > 0.0 && light >= least).then_some(xy));
        Ok(Self { shape, xy: xy.collect() })
    }

    /// Shape of the frames.
    pub fn shape(&self) -> FrameShape {
        self.shape
    }

    /// The shift of the dots from `earlier` to these. Both must show the plane, or the same part of a static scene.
    ///
    /// # Errors
    /// [`DotsError::Shape`] if the numbers of dots differ, [`DotsError::TooFew`] if no dot is seen in both.
    pub fn drift_from(&self, earlier: &Self) -> Result<Drift, DotsError> {
        check_shape("centroids", "[dots]", &[self.xy.len()], &[earlier.xy.len()])?;
        let both = self.xy.iter().zip(&earlier.xy).filter_map(|(now, then)| Some(((*now)?, (*then)?)));
        let (mut right, mut down): (Vec<f64>, Vec<f64>) =
            both.map(|(now, then)| (now[0] - then[0], now[1] - then[1])).unzip();
        if right.is_empty() {
            let what = "dots that both batches show: calibrate again with the plane in place";
            return Err(DotsError::TooFew { what, given: 0, needed: 1 });
        }
        // The sum of squares is computed first, because the median reorders the values.
        let shifts = right.clone().into_iter().zip(down.clone());
        let (right_px, down_px) = (median(&mut right), median(&mut down));
        let squares: f64 =
            shifts.map(|(right, down)| (right - right_px).powi(2) + (down - down_px).powi(2)).sum();
        Ok(Drift { right_px, down_px, rms_px: (squares / right.len() as f64).sqrt(), dots: right.len() })
    }
}
