//! `[film]`: the settings of a film's cycle.

use raysweep_pipeline::{Point, Role, Schedule};
use serde::Deserialize;

use super::{Axis, ConfigError};

/// `[film]`: one frame under each delay, cycle after cycle without pause. In which order a cycle takes its delays is
/// for the camera to say, not for the plan.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FilmPlan {
    /// t_d.
    pub delay_us: Axis,
    /// t_e, one for all: cameras may take long to change it.
    pub exposure_us: f64,
    /// How many cycles.
    pub cycles: u32,
    /// Frames whose measured delay is further off do not count; their cycle is incomplete.
    pub max_jitter_us: f64,
}

/// 15 delays, dense near zero where most of the light is: 1500 us x (k/7)^1.7 to either side.
const DENSE_US: [f64; 15] = [
    -1500.0, -1154.0, -847.0, -579.0, -355.0, -178.0, -55.0, 0.0, 55.0, 178.0, 355.0, 579.0, 847.0, 1154.0,
    1500.0,
];

impl Default for FilmPlan {
    fn default() -> Self {
        Self { delay_us: Axis::List(DENSE_US.to_vec()), exposure_us: 600.0, cycles: 240, max_jitter_us: 50.0 }
    }
}

/// Most cycles of a film: six hours at four a second.
const MAX_CYCLES: u32 = 86_400;
/// Most settings of a cycle.
const MAX_SETTINGS: usize = 256;
/// Frames of the dark image: its noise is in every cycle, so there are many.
const DARK_FRAMES: u32 = 32;

impl FilmPlan {
    pub(super) fn check(&self, text: &str) -> Result<(), ConfigError> {
        let refused = |key: &str, message: String| Err(ConfigError::at(text, &["film", key], message));
        if !(2..=MAX_SETTINGS).contains(&self.delay_us.len()) {
            let settings = self.delay_us.len();
            let message = format!("film.delay_us has {settings} values: 2 to {MAX_SETTINGS} are allowed");
            return refused("delay_us", message);
        }
        let mut delays = self.delay_us.values();
        if let Some(value) = delays.iter().find(|value| !value.is_finite()) {
            return refused("delay_us", format!("film.delay_us contains {value}: give finite microseconds"));
        }
        delays.sort_by(f64::total_cmp);
        if let Some(pair) = delays.windows(2).find(|pair| pair[0] == pair[1]) {
            let message = format!("film.delay_us contains {} twice: give each delay once", pair[0]);
            return refused("delay_us", message);
        }
        if !(self.exposure_us > 0.0 && self.exposure_us.is_finite()) {
            let message =
                format!("film.exposure_us = {}: give microseconds greater than 0", self.exposure_us);
            return refused("exposure_us", message);
        }
        if !(1..=MAX_CYCLES).contains(&self.cycles) {
            let message = format!("film.cycles = {}: 1 to {MAX_CYCLES} are allowed", self.cycles);
            return refused("cycles", message);
        }
        if !(self.max_jitter_us > 0.0 && self.max_jitter_us.is_finite()) {
            let message =
                format!("film.max_jitter_us = {}: give microseconds greater than 0", self.max_jitter_us);
            return refused("max_jitter_us", message);
        }
        Ok(())
    }

    /// The dark image, then the settings of one cycle in the plan's order. There is no regular image: what it would
    /// check has moved on.
    pub(super) fn schedule(&self) -> Schedule {
        let exposure_us = self.exposure_us;
        let dark = Point { role: Role::Dark(0), delay_us: 0.0, exposure_us, frames: DARK_FRAMES };
        let setting =
            |(index, delay_us)| Point { role: Role::Sweep(index), delay_us, exposure_us, frames: 1 };
        let settings = (0..).zip(self.delay_us.values()).map(setting);
        Schedule { points: std::iter::once(dark).chain(settings).collect() }
    }
}

#[cfg(test)]
mod tests {
    use crate::config::Plan;

    #[test]
    fn the_default_film_is_the_documented_one_and_its_delays_follow_their_law() {
        let page = include_str!("../../../docs/reference/plan.md");
        let mut blocks = page.split("```toml\n").filter_map(|rest| rest.split("```").next());
        let documented = blocks.find(|block| block.contains("kind = \"film\"")).unwrap();
        let documented = Plan::parse(documented).unwrap();
        let default = Plan::parse("kind = \"film\"").unwrap();
        assert_eq!(format!("{:?}", documented.film), format!("{:?}", default.film));
        assert_eq!((&documented.name, &default.name), (&"film".to_owned(), &"film".to_owned()));
        for (delay_us, k) in default.film.delay_us.values().into_iter().zip(-7..) {
            let law_us = 1500.0 * f64::from(k).signum() * (f64::from(k).abs() / 7.0).powf(1.7);
            assert!((delay_us - law_us).abs() < 0.5 || k == 0, "{delay_us} is not {law_us}");
        }
    }

    #[test]
    fn a_film_has_a_dark_image_and_one_frame_a_setting() {
        let plan = Plan::parse("kind = \"film\"\n[film]\ndelay_us = [100, 0]\nexposure_us = 200").unwrap();
        let schedule = plan.schedule(16_667.0);
        assert_eq!((schedule.dark_len(), schedule.sweep_len(), schedule.points.len()), (1, 2, 3));
        assert_eq!((schedule.points[1].delay_us, schedule.points[1].frames), (100.0, 1));
        assert!(schedule.points.iter().all(|point| point.exposure_us == 200.0));
    }

    #[test]
    fn bad_films_are_refused_with_field_and_place() {
        let cases = [
            ("[film]\ndelay_us = [1]", "2 to 256"),
            ("[film]\ndelay_us = [1, 2, 1]", "twice"),
            ("[film]\ndelay_us = [1, inf]", "finite"),
            ("[film]\nexposure_us = 0", "greater than 0"),
            ("[film]\ncycles = 0", "1 to 86400"),
            ("[film]\nmax_jitter_us = nan", "greater than 0"),
            ("[film]\norder = \"up\"", "unknown field"),
            ("[sweep]\naverage = 2", "[film]"),
        ];
        for (text, expected) in cases {
            let error = Plan::parse(&format!("kind = \"film\"\n{text}")).unwrap_err();
            assert!(error.message.contains(expected), "{text:?}: {}", error.message);
            assert!(error.span.is_some(), "{text:?} has no place");
        }
        let error = Plan::parse("kind = \"sweep\"\n[film]\ncycles = 3").unwrap_err();
        assert!(error.message.contains("[sweep]"), "{}", error.message);
    }
}
