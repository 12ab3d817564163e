//! `[calibration]`: images of a white board from which a plane rig is calibrated.

use serde::Deserialize;

use super::Axis;
use crate::document::Document;

/// `[calibration]`: how many images to take.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CalibrationPlan {
    /// Exposures of the dark images, with the lens capped; those of later plans lie best among them.
    pub exposure_us: Axis,
    /// Frames of each dark image, each half of those of the white and the black picture.
    pub frames: u32,
    /// Frames averaged of each picture of sparse rows.
    pub picture_frames: u32,
    /// Boards that are shown, 1 or 2: a second one of another material tells the beam from light that spreads inside a
    /// board.
    pub boards: u32,
    /// Largest number of passes of the beam in the exposures that show how linear the camera is; 0: none are taken.
    pub passes: u32,
    /// Delays at which the arrival of each row's light is measured: once over all at which it may come, twice over those
    /// at which it does.
    pub delays: u32,
    /// Frames whose measured delay deviates by more than this are dropped.
    pub max_jitter_us: f64,
}

impl Default for CalibrationPlan {
    fn default() -> Self {
        Self {
            exposure_us: Axis::List(vec![60.0, 600.0, 1200.0, 3600.0]),
            frames: 16,
            picture_frames: 4,
            boards: 1,
            passes: 3,
            delays: 64,
            max_jitter_us: 100.0,
        }
    }
}

/// More passes of the grey would saturate.
const MOST_PASSES: u32 = 3;
/// Maximum number of exposures.
const MAX_EXPOSURES: usize = 32;

impl CalibrationPlan {
    pub(super) fn check(&self, document: &mut Document<'_>) {
        let exposures = self.exposure_us.values();
        if !(2..=MAX_EXPOSURES).contains(&exposures.len()) {
            let message = format!(
                "calibration.exposure_us has {} values: give 2 to {MAX_EXPOSURES}, because the dark image is a line over them",
                exposures.len()
            );
            document.refuse(&["calibration", "exposure_us"], message);
        } else if let Some(value) = exposures.iter().find(|us| !(us.is_finite() && **us > 0.0)) {
            let message =
                format!("calibration.exposure_us contains {value}: must be more than 0 microseconds");
            document.refuse(&["calibration", "exposure_us"], message);
        } else if exposures.iter().all(|us| *us == exposures[0]) {
            let message =
                "calibration.exposure_us contains one exposure only: give at least two different ones";
            document.refuse(&["calibration", "exposure_us"], message);
        }
        document.check_count(&["calibration", "frames"], self.frames.into(), 4..=1024);
        document.check_count(&["calibration", "picture_frames"], self.picture_frames.into(), 1..=1024);
        document.check_count(&["calibration", "boards"], self.boards.into(), 1..=2);
        if self.passes == 1 || self.passes > MOST_PASSES {
            let message = format!(
                "calibration.passes = {}: must be 2 to {MOST_PASSES}, or 0 for a camera that cannot be exposed for two VSYNC periods",
                self.passes
            );
            document.refuse(&["calibration", "passes"], message);
        }
        document.check_count(&["calibration", "delays"], self.delays.into(), 24..=1024);
        document.check_range(&["calibration", "max_jitter_us"], self.max_jitter_us, 0.1..=10_000.0);
    }
}

#[cfg(test)]
mod tests {
    use super::CalibrationPlan;
    use crate::plan::tests::documented;
    use crate::plan::{Plan, Procedure};

    #[test]
    fn the_default_is_the_documented_one() {
        let documented = Plan::parse(documented("calibration")).unwrap();
        assert_eq!(documented.procedure, Procedure::Calibration(CalibrationPlan::default()));
    }
}
