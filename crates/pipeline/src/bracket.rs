//! The image under less light, for pixels that saturate in the sweep.

use ndarray::{Array2, Axis};
use raysweep_transport::plane::{Bracket, Demux, PlaneError, Setting};

use crate::stack::SweepStack;

/// Fewest pixels whose light tells the level.
const MIN_PIXELS: usize = 64;

/// The image of a bracket before its level is known.
#[derive(Debug, Clone)]
pub(crate) struct BracketImage {
    /// Delays and exposure.
    pub setting: Setting,
    /// `[t, s]` of all camera rows; dark image subtracted, 1 = a white pixel lit by its own row under white.
    pub image: Array2<f32>,
    /// Which of its pixels are not saturated, `[t, s]`.
    pub valid: Array2<bool>,
}

impl BracketImage {
    /// The bracket with its level: the factor by which the image is darker than predicted from the sweep, in the
    /// pixels of these camera rows none of whose samples saturates. `stack` contains only these rows, and settings
    /// that `demux` solves; `None` if too few pixels are lit.
    ///
    /// # Errors
    /// If the stack does not give a valid model.
    pub fn levelled(
        self,
        demux: &Demux,
        rows: &[usize],
        stack: &SweepStack,
    ) -> Result<Option<Bracket>, PlaneError> {
        let Self { setting, image, valid } = self;
        let exact = stack.valid.as_ref().map(|valid| valid.view());
        let transport = demux.with_settings(stack.settings.clone())?.solve_rows(
            rows,
            stack.images.view(),
            exact,
            &|| true,
        )?;
        let predicted = demux.with_settings(vec![setting.clone()])?.predict_rows(rows, &transport)?;
        let predicted = predicted.index_axis_move(Axis(0), 0);
        let (found, usable) = (image.select(Axis(0), rows), valid.select(Axis(0), rows));
        let (mut product, mut square, mut pixels) = (0.0, 0.0, 0);
        for ((at, &predicted), (&found, &usable)) in predicted.indexed_iter().zip(found.iter().zip(&usable)) {
            if usable && !transport.saturated[at] && predicted > 0.0 {
                product += f64::from(found) * f64::from(predicted);
                square += f64::from(predicted).powi(2);
                pixels += 1;
            }
        }
        let light = product / square;
        if pixels < MIN_PIXELS || !(light > 0.0 && light <= 1.0) {
            return Ok(None);
        }
        Ok(Some(Bracket {
            setting,
            light,
            image: image.mapv(|counts| (f64::from(counts) / light) as f32),
            valid,
        }))
    }
}
