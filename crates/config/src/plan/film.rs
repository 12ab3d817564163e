//! `[film]`: the settings of a film's cycle.

use serde::Deserialize;

use super::Axis;
use super::rows::{KnownRows, OwnRowEdges};
use crate::Places;
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

/// The settings of a calibrated rig whose edges are known: the delays above, in its rows.
const EXPOSURE_ROWS: f64 = 27.0;
const FAR_ROWS: [f64; 4] = [67.5, 45.0, 28.8, 18.9];
const EDGES_ROWS: [f64; 3] = [-0.5, 0.5, 1.5];
/// Those of a rig whose edges mislead: none lies within 3 rows of the pixel's own.
const WIDE_ROWS: [f64; 7] = [67.5, 51.5, 37.5, 25.5, 16.5, 9.5, 4.5];

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

    /// The plan with the settings that suit a calibrated rig; `None` if it states settings itself (`places` are those of
    /// its text).
    pub fn chosen(&self, places: &Places, rows: KnownRows) -> Option<Self> {
        if ["delay_us", "exposure_us"].into_iter().any(|key| places.has(&["film", key])) {
            return None;
        }
        let exposure_us = rows.exposure_us(EXPOSURE_ROWS);
        let of_rows = |far: &[f64], edges: &[f64]| -> Vec<f64> {
            let far = far.iter().map(|&of| rows.exposure_us(of));
            far.chain(edges.iter().map(|&edge| rows.opening_us(exposure_us, edge))).collect()
        };
        let side_us = match rows.own_row_edges {
            OwnRowEdges::Divide => of_rows(&FAR_ROWS, &EDGES_ROWS),
            OwnRowEdges::Mislead => of_rows(&WIDE_ROWS, &[]),
        };
        let mut delays_us: Vec<f64> =
            side_us.into_iter().flat_map(|delay_us| [-delay_us, delay_us]).chain([0.0]).collect();
        delays_us.sort_by(f64::total_cmp);
        let chosen = Self { delay_us: Axis::of_values(delays_us), exposure_us, ..self.clone() };
        // Rounded values of very short rows may coincide.
        Some(chosen).filter(Self::is_possible)
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
    use crate::plan::with_tables;
    use crate::plan::{Plan, Procedure};

    fn film(plan: Plan) -> FilmPlan {
        let Procedure::Film(film) = plan.procedure else { panic!("{plan:?}") };
        film
    }

    #[test]
    fn a_calibrated_rig_gets_edges_on_its_rows_only_where_they_tell_something() {
        let chosen = |text: &str, own_row_edges| {
            let plan = parse(text).unwrap();
            let places = plan.places.clone();
            film(plan).chosen(&places, KnownRows { row_time_us: 22.22, own_row_edges })
        };
        let text = "kind = \"film\"\n[film]\ncycles = 3\n";
        let nearest_rows = |film: &FilmPlan| {
            let edges = film
                .delay_us
                .values()
                .into_iter()
                .map(|us| (us.abs() - film.exposure_us / 2.0).abs() / 22.22);
            edges.fold(f64::INFINITY, f64::min)
        };
        let divided = chosen(text, OwnRowEdges::Divide).unwrap();
        assert!((nearest_rows(&divided) - 0.5).abs() < 0.001 && divided.cycles == 3);
        let wide = chosen(text, OwnRowEdges::Mislead).unwrap();
        assert!(nearest_rows(&wide) > 3.0 && wide.delay_us.len() == 15);
        let stated = with_tables(text, &wide.to_toml()).unwrap();
        assert_eq!((film(parse(&stated).unwrap()), chosen(&stated, OwnRowEdges::Divide)), (wide, None));
    }

    #[test]
    fn the_default_film_is_the_documented_one() {
        let (documented, default) = (parse(documented("film")).unwrap(), parse("kind = \"film\"").unwrap());
        assert_eq!((&documented.name, &default.name), (&"film".to_owned(), &"film".to_owned()));
        assert_eq!(film(documented), film(default));
    }
}
