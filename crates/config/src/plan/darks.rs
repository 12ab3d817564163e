//! `[darks]`: images without light.

use serde::Deserialize;

use super::Axis;
use crate::document::{Document, counted};
use crate::whole::whole;

/// `[darks]`: two images at each exposure; the noise is computed from their difference.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct DarksPlan {
    /// Exposure times.
    pub exposure_us: Axis,
    /// Frames averaged per image.
    #[serde(deserialize_with = "whole::<_, 1, 65_536>")]
    pub frames: u32,
    /// Pixels whose dark level lies more than this many standard deviations above the others' are hot.
    pub hot_sigmas: f64,
}

impl Default for DarksPlan {
    fn default() -> Self {
        Self { exposure_us: Axis::List(vec![100.0, 1000.0, 10_000.0]), frames: 16, hot_sigmas: 8.0 }
    }
}

/// Maximum number of exposures.
const MAX_EXPOSURES: usize = 256;

impl DarksPlan {
    pub(super) fn check(&self, document: &mut Document<'_>) {
        let exposures = self.exposure_us.len();
        if !(1..=MAX_EXPOSURES).contains(&exposures) {
            let message =
                format!("darks.exposure_us has {}: give 1 to {MAX_EXPOSURES}", counted(exposures, "value"));
            document.refuse(&["darks", "exposure_us"], message);
        } else if let Some(value) =
            self.exposure_us.values().into_iter().find(|us| !(us.is_finite() && *us > 0.0))
        {
            let message = format!("darks.exposure_us contains {value}: must be more than 0 microseconds");
            document.refuse(&["darks", "exposure_us"], message);
        }
        document.check_count(&["darks", "frames"], self.frames.into(), 1..=65_536);
        document.check_range(&["darks", "hot_sigmas"], self.hot_sigmas, 1.0..=1000.0);
    }
}

#[cfg(test)]
mod tests {
    use super::DarksPlan;
    use crate::plan::tests::documented;
    use crate::plan::{Plan, Procedure};

    #[test]
    fn the_default_is_the_documented_one() {
        let documented = Plan::parse(documented("darks")).unwrap();
        assert_eq!(documented.procedure, Procedure::Darks(DarksPlan::default()));
    }
}
