//! Stages that turn a frame into a column, by their names in plans.

use std::sync::Arc;

use raysweep_transport::dots::{
    Background, Correction, DenoiseSettings, Denoiser, DotsError, NoiseFloor, Region, Scratch, SparseColumn,
    StopRule, reference,
};
use serde::Deserialize;
use serde_json::Value;

use crate::stage_refused::{self, StageRefused};

/// Computes sparse columns from raw frames.
pub trait ColumnStage: Send + Sync {
    /// The state of one thread, reused from frame to frame.
    fn worker(&self) -> Box<dyn ColumnWorker>;
}

/// One thread's state of a [`ColumnStage`].
pub trait ColumnWorker: Send {
    /// Computes the column of a raw frame `[height, width]` in counts.
    ///
    /// # Errors
    /// If the frame cannot be processed; its dot is then lost, with the cause.
    fn column(
        &mut self,
        frame: &[u16],
        background: &Background,
        floor: NoiseFloor,
        column: &mut SparseColumn,
    ) -> Result<(), DotsError>;
}

/// Options of `denoise` and `denoise-reference`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DenoiseOptions {
    /// Radius of the discs, as large as the dot; if omitted, 20 pixels for a frame width of 1024 pixels.
    pub radius_px: Option<f64>,
    /// When to stop.
    pub stop: Stop,
    /// False discs per frame without light, for the rule `false-alarms`.
    pub false_alarms: f64,
    /// Background patch of the rule `printed`: first and last row, first and last column, last ones exclusive.
    pub patch: [usize; 4],
    /// For the rule `printed`: tolerance, in standard deviations of the patch, within which the rest equals the
    /// background.
    pub tolerance: f64,
    /// Largest number of discs per frame; frames that stop here are counted.
    pub max_discs: u32,
    /// Whether the light outside the discs is kept as means of blocks.
    pub residual: bool,
}

/// Names of [`StopRule`] in plans.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Stop {
    /// When the rest can be explained by noise.
    FalseAlarms,
    /// As printed in the paper.
    Printed,
}

impl Default for DenoiseOptions {
    fn default() -> Self {
        Self {
            radius_px: None,
            stop: Stop::FalseAlarms,
            false_alarms: 0.05,
            patch: [0, 32, 0, 32],
            tolerance: 0.05,
            max_discs: 64,
            residual: true,
        }
    }
}

impl DenoiseOptions {
    fn settings(&self, width_px: usize) -> DenoiseSettings {
        let [top, bottom, left, right] = self.patch;
        DenoiseSettings {
            // A disc that contains the paper's dot of 32 pixels wherever noise puts its brightest pixel.
            radius_px: self.radius_px.unwrap_or(20.0 * width_px as f64 / 1024.0),
            stop: match self.stop {
                Stop::FalseAlarms => StopRule::FalseAlarms { per_frame: self.false_alarms },
                Stop::Printed => StopRule::Printed {
                    patch: Region { rows: top..bottom, columns: left..right },
                    tolerance: self.tolerance,
                },
            },
            max_discs: self.max_discs,
        }
    }
}

/// The fused pass over a frame.
struct Fused {
    denoiser: Arc<Denoiser>,
    residual: bool,
}

struct FusedWorker {
    denoiser: Arc<Denoiser>,
    scratch: Scratch,
    residual: bool,
}

impl ColumnStage for Fused {
    fn worker(&self) -> Box<dyn ColumnWorker> {
        let (denoiser, residual) = (self.denoiser.clone(), self.residual);
        Box::new(FusedWorker { scratch: denoiser.scratch(), denoiser, residual })
    }
}

impl ColumnWorker for FusedWorker {
    fn column(
        &mut self,
        frame: &[u16],
        background: &Background,
        floor: NoiseFloor,
        column: &mut SparseColumn,
    ) -> Result<(), DotsError> {
        self.denoiser.column(frame, background, floor, &mut self.scratch, column)?;
        if !self.residual {
            column.residual.fill(0.0);
        }
        Ok(())
    }
}

/// The simple reference, which the fused pass must equal.
#[derive(Clone)]
struct Plain {
    correction: Arc<Correction>,
    settings: DenoiseSettings,
    residual: bool,
}

impl ColumnStage for Plain {
    fn worker(&self) -> Box<dyn ColumnWorker> {
        Box::new(self.clone())
    }
}

impl ColumnWorker for Plain {
    fn column(
        &mut self,
        frame: &[u16],
        background: &Background,
        floor: NoiseFloor,
        column: &mut SparseColumn,
    ) -> Result<(), DotsError> {
        *column = reference::column(frame, &self.correction, background, floor, &self.settings)?;
        if !self.residual {
            column.residual.fill(0.0);
        }
        Ok(())
    }
}

/// The stage that a plan names, with the plan's options (a JSON object).
///
/// # Errors
/// For unknown names, and for options that the stage rejects.
pub fn column_stage(
    name: &str,
    options: Value,
    correction: &Correction,
) -> Result<Arc<dyn ColumnStage>, StageRefused> {
    match name {
        "denoise" => {
            let (DenoiseOptions { residual, .. }, denoiser) = checked(name, options, correction)?;
            Ok(Arc::new(Fused { denoiser: Arc::new(denoiser), residual }))
        }
        "denoise-reference" => {
            let (options, _) = checked(name, options, correction)?;
            let settings = options.settings(correction.shape().width());
            let correction = Arc::new(correction.clone());
            Ok(Arc::new(Plain { correction, settings, residual: options.residual }))
        }
        _ => Err(StageRefused::Unknown { name: name.into(), known: "denoise, denoise-reference".into() }),
    }
}

/// The options, and the denoiser with them; the reference rejects the same settings.
fn checked(
    name: &str,
    options: Value,
    correction: &Correction,
) -> Result<(DenoiseOptions, Denoiser), StageRefused> {
    let options: DenoiseOptions = stage_refused::options(name, options)?;
    let settings = options.settings(correction.shape().width());
    let denoiser = Denoiser::new(correction.clone(), settings)
        .map_err(|error| StageRefused::Invalid { name: name.into(), what: error.to_string() })?;
    Ok((options, denoiser))
}

#[cfg(test)]
mod tests {
    use raysweep_transport::dots::FrameShape;
    use serde_json::json;

    use super::*;

    #[test]
    fn both_stages_make_the_same_column_and_leave_out_the_residual_when_asked() {
        let shape = FrameShape::new(64, 64, 1).unwrap();
        let correction = Correction::none(shape);
        let background = Background::new(&correction, &vec![100.0; shape.pixels()]).unwrap();
        let floor = NoiseFloor { mean: 0.0, sigma: 3.0 };
        let mut frame = vec![102; shape.pixels()];
        (0..5).for_each(|at| frame[64 * 30 + 20 + at] = 900);
        let column = |name: &str, residual: bool| {
            let options = json!({ "radius_px": 6.0, "residual": residual });
            let stage = column_stage(name, options, &correction).unwrap();
            let mut column = SparseColumn::default();
            stage.worker().column(&frame, &background, floor, &mut column).unwrap();
            column
        };
        let fused = column("denoise", true);
        // Blocks that the discs cover wholly have none.
        let (even, covered): (Vec<f32>, Vec<f32>) = fused.residual.iter().partition(|&&light| light == 2.0);
        assert!(!fused.words.is_empty() && even.len() > 240 && covered.iter().all(|&light| light == 0.0));
        assert_eq!(fused, column("denoise-reference", true));
        assert!(column("denoise", false).residual.iter().all(|&light| light == 0.0));
    }

    #[test]
    fn what_no_stage_takes_is_refused_by_name() {
        let correction = Correction::none(FrameShape::new(64, 64, 1).unwrap());
        let refused = |name: &str, options: Value| column_stage(name, options, &correction).err().unwrap();
        assert!(matches!(refused("demux", json!({})), StageRefused::Unknown { .. }));
        assert!(matches!(refused("denoise", json!({ "radius": 3 })), StageRefused::Options { .. }));
        assert!(matches!(refused("denoise", json!({ "radius_px": -1.0 })), StageRefused::Invalid { .. }));
        let beyond = refused("denoise-reference", json!({ "stop": "printed", "patch": [0, 99, 0, 8] }));
        assert!(matches!(beyond, StageRefused::Invalid { .. }), "{beyond}");
    }
}
