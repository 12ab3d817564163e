//! Stages, which process units in parallel and each unit independently.

use std::any::Any;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use ndarray::Array2;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use crate::demux::{DEMUX, DemuxOptions};
use crate::stage_refused::{self, StageRefused};
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

/// A pure computation on one unit's mean image; runs on any worker thread. Plans have [`HotPixels`]; tests add stages
/// of their own, which fail or panic.
pub trait Stage: Send + Sync {
    /// Its name in plans and errors.
    fn name(&self) -> &str;

    /// Returns the image for the next stage or the demultiplexer: counts, `[t, s]`.
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

/// The stages of a plan, in order.
pub type Stages = Arc<[Arc<dyn Stage>]>;

/// What a `[[stage]]` of a plan on the plane rig asks for.
pub enum PlaneStage {
    /// To process each image.
    Image(Arc<dyn Stage>),
    /// To demultiplex the images.
    Demux(DemuxOptions),
}

/// The name of [`HotPixels`] in plans.
pub const HOT_PIXELS: &str = "hot-pixels";

impl PlaneStage {
    /// The stage that a plan names, with the plan's options (a JSON object).
    ///
    /// # Errors
    /// For unknown names, and for options that the stage rejects.
    pub fn new(name: &str, options: Value) -> Result<Self, StageRefused> {
        match name {
            HOT_PIXELS => {
                let stage: HotPixels = stage_refused::options(name, options)?;
                stage.check().map_err(|what| StageRefused::Invalid { name: name.into(), what })?;
                Ok(Self::Image(Arc::new(stage)))
            }
            DEMUX => Ok(Self::Demux(stage_refused::options(name, options)?)),
            _ => Err(StageRefused::Unknown { name: name.into(), known: format!("{DEMUX}, {HOT_PIXELS}") }),
        }
    }
}

/// Passes a unit's mean image through all stages. A stage that panics loses its unit but does not end the run.
///
/// # Errors
/// The error or panic message of the first stage that failed.
pub fn run_stages(stages: &[Arc<dyn Stage>], unit: &Unit) -> Result<Array2<f32>, StageError> {
    stages.iter().try_fold(unit.mean(), |image, stage| {
        catch_unwind(AssertUnwindSafe(|| stage.apply(unit, image))).unwrap_or_else(|panic| {
            Err(StageError { stage: stage.name().into(), what: format!("panicked: {}", message_of(&*panic)) })
        })
    })
}

/// The message of a panic.
pub fn message_of(panic: &(dyn Any + Send)) -> &str {
    panic
        .downcast_ref::<&str>()
        .copied()
        .or_else(|| panic.downcast_ref::<String>().map(String::as_str))
        .unwrap_or("without a message")
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
        HOT_PIXELS
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
    use raysweep_core::{Counts, SettingsId};

    use super::*;

    fn unit() -> Unit {
        Unit {
            id: SettingsId { point: 0, attempt: 0 },
            frames: 1,
            delay_us: 0.0,
            exposure_us: 1.0,
            delays_us: vec![0.0],
            run: 0,
            starts_ns: Vec::new(),
            sum: Arc::new(Array2::zeros((5, 5))),
            clipped: None,
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
