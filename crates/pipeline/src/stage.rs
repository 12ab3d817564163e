//! Processing of units: stages, in parallel and each unit independently; folds, over all units in order.

use ndarray::{Array2, ArrayView2};
use raysweep_transport::plane::Transport;
use serde::{Deserialize, Serialize};

use crate::product::Product;
use crate::strips::InStrips;
use crate::unit::Unit;

/// Why a stage failed on a unit.
#[derive(Debug, thiserror::Error)]
#[error("stage {stage}: {what}")]
pub struct StageError {
    /// The stage's name.
    pub stage: String,
    /// What happened.
    pub what: String,
}

/// A pure computation on one unit's mean image; runs on any worker thread.
pub trait Stage: Send + Sync {
    /// Its name in plans.
    fn name(&self) -> &str;

    /// Returns the image for the next stage or the folds: counts, `[t, s]`.
    ///
    /// # Errors
    /// If this unit cannot be processed; its raw image is still stored.
    fn apply(&self, unit: &Unit, image: Array2<f32>) -> Result<Array2<f32>, StageError>;

    /// Number of rows above and below a pixel on which its result may depend, anywhere in the image. A stage can then
    /// process some rows given these additional ones. `None`: it needs the whole image, which costs time if the sweep
    /// is larger than the memory.
    fn halo_rows(&self) -> Option<usize> {
        None
    }
}

/// Why a fold could not finish.
#[derive(Debug, thiserror::Error)]
#[error("{fold}: {what}")]
pub struct FoldError {
    /// The fold's name.
    pub fold: String,
    /// What happened and what to do.
    pub what: String,
}

/// Takes units in order and computes products from all of them.
pub trait Fold: Send {
    /// Its name in plans.
    fn name(&self) -> &str;

    /// Takes the next unit; a later attempt at a point replaces an earlier one.
    fn push(&mut self, unit: &Unit, image: ArrayView2<'_, f32>);

    /// The units taken so far, from which another thread can compute an estimate while more arrive; `None` if the
    /// fold has no estimates, or too few units. Cheap: images are shared, not copied.
    fn snapshot(&self) -> Option<Box<dyn Snapshot>> {
        None
    }

    /// Computes the products from the units taken, which it consumes. Stops early, with an error, soon after `go_on`
    /// returns false.
    ///
    /// # Errors
    /// If too few units were taken, or `go_on` returned false.
    fn finish(&mut self, go_on: &(dyn Fn() -> bool + Sync)) -> Result<Vec<Product>, FoldError>;

    /// Stops keeping images and providing snapshots: [`Self::finish_in_strips`] reads the images again. Does nothing
    /// for a fold whose memory does not grow with the sweep.
    fn keep_no_images(&mut self) {}

    /// [`Self::finish`] after [`Self::keep_no_images`]. The transport and its stack are not among the products; they
    /// are handed over strip by strip.
    ///
    /// # Errors
    /// Those of [`Self::finish`]; if an image cannot be read again, or a strip is refused.
    fn finish_in_strips(
        &mut self,
        _strips: InStrips<'_>,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Vec<Product>, FoldError> {
        self.finish(go_on)
    }
}

/// The units of a fold at some time.
pub trait Snapshot: Send + Sync {
    /// Number of points of the sweep that it can use for an estimate.
    fn points(&self) -> usize;

    /// The transport estimated from these points; starting from the estimate of fewer points makes it faster. Stops
    /// early, with an error, soon after `go_on` returns false.
    ///
    /// # Errors
    /// If it cannot be estimated, or `go_on` returned false.
    fn estimate(
        &self,
        before: Option<&Transport>,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Transport, FoldError>;
}

/// Stage `hot-pixels`: replaces a pixel that exceeds all its neighbours by more than `threshold_dn` by their median.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HotPixels {
    /// Counts above the brightest neighbour from which a pixel is hot.
    pub threshold_dn: f32,
    /// Distance of the neighbours: 1, or 2 on a Bayer mosaic.
    pub step_px: usize,
}

impl Default for HotPixels {
    fn default() -> Self {
        Self { threshold_dn: 100.0, step_px: 1 }
    }
}

impl HotPixels {
    /// Checks the options; an error names field, value and the allowed values.
    pub(crate) fn check(&self) -> Result<(), String> {
        if !(self.threshold_dn > 0.0 && self.threshold_dn.is_finite()) {
            return Err(format!("threshold_dn = {}: must be more than 0 counts", self.threshold_dn));
        }
        if !(1..=2).contains(&self.step_px) {
            return Err(format!("step_px = {}: must be 1, or 2 on a Bayer mosaic", self.step_px));
        }
        Ok(())
    }
}

impl Stage for HotPixels {
    fn name(&self) -> &str {
        "hot-pixels"
    }

    fn apply(&self, _unit: &Unit, image: Array2<f32>) -> Result<Array2<f32>, StageError> {
        let (height, width) = image.dim();
        let mut repaired = image.clone();
        let step = self.step_px as isize;
        let mut around = Vec::with_capacity(8);
        for ((t, s), pixel) in repaired.indexed_iter_mut() {
            around.clear();
            for (dt, ds) in [(-1, -1), (-1, 0), (-1, 1), (0, -1), (0, 1), (1, -1), (1, 0), (1, 1)] {
                let neighbour = t.checked_add_signed(dt * step).zip(s.checked_add_signed(ds * step));
                if let Some((t, s)) = neighbour.filter(|&(t, s)| t < height && s < width) {
                    around.push(image[[t, s]]);
                }
            }
            around.sort_unstable_by(f32::total_cmp);
            if around.last().is_some_and(|&brightest| *pixel > brightest + self.threshold_dn) {
                *pixel = around[around.len() / 2];
            }
        }
        Ok(repaired)
    }

    fn halo_rows(&self) -> Option<usize> {
        Some(self.step_px)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use raysweep_core::{Counts, SettingsId};

    use super::*;

    fn unit() -> Unit {
        Unit {
            id: SettingsId { point: 0, attempt: 0 },
            frames: 1,
            exposure_us: 1.0,
            delays_us: vec![0.0],
            last_exposure_ns: None,
            sum: Arc::new(Array2::zeros((5, 5))),
            counts: Counts::default(),
        }
    }

    #[test]
    fn a_hot_pixel_takes_its_neighbours_median_and_an_edge_stays() {
        // A bright right half is not a defect; single bright pixels at a border and in the middle are.
        let mut image = Array2::from_shape_fn((5, 5), |(_, s)| if s >= 3 { 1000.0 } else { 10.0 });
        let clean = image.clone();
        (image[[0, 0]], image[[2, 1]]) = (500.0, 3000.0);
        let repaired = HotPixels::default().apply(&unit(), image).unwrap();
        assert_eq!(repaired, clean);
    }

    #[test]
    fn options_out_of_range_are_refused_by_name() {
        let check = |threshold_dn, step_px| HotPixels { threshold_dn, step_px }.check();
        assert!(check(100.0, 2).is_ok());
        assert!(check(-1.0, 1).is_err());
        assert!(check(100.0, 0).is_err());
        assert!(check(100.0, usize::MAX).is_err());
    }
}
