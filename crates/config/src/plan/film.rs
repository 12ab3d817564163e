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

/// 15 delays, dense near zero, where most of the light is: 1500 us x (k/7)^1.7 in both directions.
const DENSE_US: [f64; 15] = [
    -1500.0, -1154.0, -847.0, -579.0, -355.0, -178.0, -55.0, 0.0, 55.0, 178.0, 355.0, 579.0, 847.0, 1154.0,
    1500.0,
];

impl Default for FilmPlan {
    fn default() -> Self {
        Self { delay_us: Axis::List(DENSE_US.to_vec()), exposure_us: 600.0, cycles: 240, max_jitter_us: 50.0 }
    }
}

/// Maximum number of cycles of a film: six hours at four per second.
const MAX_CYCLES: u64 = 86_400;
/// Maximum number of settings per cycle.
const MAX_SETTINGS: usize = 256;
impl FilmPlan {
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
                document.refuse(&["film", "delay_us"], message);
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
    fn the_default_film_is_the_documented_one_and_its_delays_follow_their_law() {
        let (documented, default) = (parse(documented("film")).unwrap(), parse("kind = \"film\"").unwrap());
        assert_eq!((&documented.name, &default.name), (&"film".to_owned(), &"film".to_owned()));
        let (documented, default) = (film(documented), film(default));
        assert_eq!(documented, default);
        for (delay_us, k) in default.delay_us.values().into_iter().zip(-7..) {
            let law_us = 1500.0 * f64::from(k).signum() * (f64::from(k).abs() / 7.0).powf(1.7);
            assert!((delay_us - law_us).abs() < 0.5 || k == 0, "{delay_us} is not {law_us}");
        }
    }
}
