//! `[film]`: the settings of a film's cycle.

use serde::Deserialize;

use super::Axis;
use crate::document::{Document, counted};
use crate::whole::whole;

/// `[film]`: one frame at each delay, cycle after cycle without a pause. The order of the delays within a cycle
/// depends on the camera, not on the plan.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FilmPlan {
    /// Delays t_d.
    pub delay_us: Axis,
    /// Exposure t_e, the same for all frames: cameras may take long to change it.
    pub exposure_us: f64,
    /// Number of cycles.
    #[serde(deserialize_with = "whole::<_, 1, 86_400>")]
    pub cycles: u32,
    /// Frames whose measured delay deviates by more than this are dropped; their cycle is incomplete.
    pub max_jitter_us: f64,
}

/// 15 delays for an exposure of 600 us. The far ones divide indirect light by its distance. Edges of the six at
/// ±289, ±311 and ±333 us lie within 1.5 rows of 22.22 us of the pixel's own row, and divide what is near it.
const DELAYS_US: [f64; 15] = [
    -1500.0, -1000.0, -640.0, -420.0, -333.0, -311.0, -289.0, 0.0, 289.0, 311.0, 333.0, 420.0, 640.0, 1000.0,
    1500.0,
];

impl Default for FilmPlan {
    fn default() -> Self {
        Self {
            delay_us: Axis::List(DELAYS_US.to_vec()),
            exposure_us: 600.0,
            cycles: 240,
            max_jitter_us: 50.0,
        }
    }
}

/// Maximum number of cycles of a film: six hours at four per second.
const MAX_CYCLES: u64 = 86_400;
/// Maximum number of settings per cycle.
const MAX_SETTINGS: usize = 256;
impl FilmPlan {
    /// Whether this table is valid in a plan.
    pub fn is_possible(&self) -> bool {
        let Ok(mut document) = Document::parse("") else { return false };
        self.check(&mut document);
        document.finish(Some(())).is_ok()
    }

    /// Its table in a plan.
    pub fn to_toml(&self) -> String {
        let Self { delay_us, exposure_us, cycles, max_jitter_us } = self;
        format!(
            "[film]\ndelay_us = {delay_us}\nexposure_us = {exposure_us}\ncycles = {cycles}\nmax_jitter_us = {max_jitter_us}\n"
        )
    }

    pub(super) fn check(&self, document: &mut Document<'_>) {
        let settings = self.delay_us.len();
        if (2..=MAX_SETTINGS).contains(&settings) {
            let mut delays = self.delay_us.values();
            delays.sort_by(f64::total_cmp);
            if let Some(value) = delays.iter().find(|value| !value.is_finite()) {
                let message = format!("film.delay_us contains {value}: must be finite");
                document.refuse(&["film", "delay_us"], message);
            } else if let Some(pair) = delays.windows(2).find(|pair| pair[0] == pair[1]) {
                let message = format!("film.delay_us contains {} twice: give each delay once", pair[0]);
                document.refuse_new(&["film", "delay_us"], message);
            }
        } else {
            let message =
                format!("film.delay_us has {}: give 2 to {MAX_SETTINGS}", counted(settings, "value"));
            document.refuse(&["film", "delay_us"], message);
        }
        document.check_positive(&["film", "exposure_us"], self.exposure_us, "microseconds");
        document.check_count(&["film", "cycles"], self.cycles.into(), 1..=MAX_CYCLES);
        document.check_positive(&["film", "max_jitter_us"], self.max_jitter_us, "microseconds");
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::tests::{documented, parse};
    use crate::plan::{Plan, Procedure};

    fn film(plan: Plan) -> FilmPlan {
        let Procedure::Film(film) = plan.procedure else { panic!("{plan:?}") };
        film
    }

    #[test]
    fn the_default_film_is_the_documented_one() {
        let (documented, default) = (parse(documented("film")).unwrap(), parse("kind = \"film\"").unwrap());
        assert_eq!((&documented.name, &default.name), (&"film".to_owned(), &"film".to_owned()));
        assert_eq!(film(documented), film(default));
    }
}
