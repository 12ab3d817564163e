//! `[sweep]`: the grid of delays and exposures, and `[[sweep.extra]]`: further ones.

use std::fmt;

use serde::Deserialize;
use serde::de::value::{MapAccessDeserializer, SeqAccessDeserializer};
use serde::de::{Deserializer, MapAccess, SeqAccess, Visitor};

use super::rows::{KnownRows, OwnRowEdges};
use crate::Places;
use crate::document::{Document, counted};
use crate::whole::whole;

/// `[sweep]`: the grid of delays and exposures; the defaults are the paper's, and on a calibrated rig those of
/// [`SweepPlan::chosen`].
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SweepPlan {
    /// Delays t_d.
    pub delay_us: Axis,
    /// Exposures t_e.
    pub exposure_us: Axis,
    /// Frames averaged per point.
    #[serde(deserialize_with = "whole::<_, 1, 65_536>")]
    pub average: u32,
    /// Frames whose measured delay deviates by more than this are dropped and taken again.
    pub max_jitter_us: f64,
    /// `[[sweep.extra]]`: further grids, taken after the first.
    pub extra: Vec<GridPlan>,
    /// One more image under less light, for pixels that saturate; `None`: not taken.
    pub bracket: Option<BracketPlan>,
    /// Height of a projector row on the scene, for results in millimetres; `None`: not known.
    pub mm_per_row: Option<f64>,
}

/// `[[sweep.extra]]`: a further grid of delays and exposures.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GridPlan {
    /// Delays t_d.
    pub delay_us: Axis,
    /// Exposures t_e.
    pub exposure_us: Axis,
}

/// `sweep.bracket`: the image under less light.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BracketPlan {
    /// Level of the grey picture that the projector shows, as a share of white.
    pub light: f64,
}

impl Default for SweepPlan {
    fn default() -> Self {
        Self {
            delay_us: Axis::Range { start: -1500.0, stop: 1500.0, count: 15 },
            exposure_us: Axis::Range { start: 600.0, stop: 1200.0, count: 5 },
            average: 8,
            max_jitter_us: 50.0,
            extra: Vec::new(),
            bracket: None,
            mm_per_row: None,
        }
    }
}

/// Values along one axis of the sweep.
#[derive(Debug, Clone, PartialEq)]
pub enum Axis {
    /// A list of values, in this order.
    List(Vec<f64>),
    /// Evenly spaced values, both ends included.
    Range {
        /// First value.
        start: f64,
        /// Last value.
        stop: f64,
        /// Number of values.
        count: usize,
    },
}

/// The keys of a range.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RangeKeys {
    start: f64,
    stop: f64,
    count: usize,
}

struct AxisVisitor;

impl<'de> Visitor<'de> for AxisVisitor {
    type Value = Axis;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a list of numbers or { start = .., stop = .., count = .. }")
    }

    fn visit_seq<A: SeqAccess<'de>>(self, values: A) -> Result<Axis, A::Error> {
        Deserialize::deserialize(SeqAccessDeserializer::new(values)).map(Axis::List)
    }

    fn visit_map<A: MapAccess<'de>>(self, keys: A) -> Result<Axis, A::Error> {
        let RangeKeys { start, stop, count } = Deserialize::deserialize(MapAccessDeserializer::new(keys))?;
        Ok(Axis::Range { start, stop, count })
    }
}

impl<'de> Deserialize<'de> for Axis {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(AxisVisitor)
    }
}

impl Axis {
    /// The first value that occurs more than once.
    pub(crate) fn repeated(&self) -> Option<f64> {
        let mut values = self.values();
        values.sort_by(f64::total_cmp);
        values.windows(2).find(|pair| pair[0] == pair[1]).map(|pair| pair[0])
    }

    /// The values in order.
    pub fn values(&self) -> Vec<f64> {
        match *self {
            Self::List(ref values) => values.clone(),
            Self::Range { start, count: 1, .. } => vec![start],
            Self::Range { start, stop, count } => {
                (0..count).map(|k| start + (stop - start) * k as f64 / (count - 1) as f64).collect()
            }
        }
    }

    /// The values as an evenly spaced range, if they are one, else as a list.
    pub fn of_values(values: Vec<f64>) -> Self {
        if let [start, _, .., stop] = *values {
            let range = Self::Range { start, stop, count: values.len() };
            if range.values() == values {
                return range;
            }
        }
        Self::List(values)
    }

    /// Number of values.
    #[allow(clippy::len_without_is_empty, reason = "an axis without values is refused")]
    pub fn len(&self) -> usize {
        match self {
            Self::List(values) => values.len(),
            Self::Range { count, .. } => *count,
        }
    }
}

impl fmt::Display for Axis {
    /// As a plan states it.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Range { start, stop, count } => {
                write!(f, "{{ start = {start}, stop = {stop}, count = {count} }}")
            }
            Self::List(values) => {
                let values: Vec<String> = values.iter().map(f64::to_string).collect();
                write!(f, "[{}]", values.join(", "))
            }
        }
    }
}

/// The settings of a calibrated rig: a grid of 60, and 15 whose opening edge steps over the pixel's own row.
const DELAYS_ROWS: f64 = 67.5;
const EXPOSURES_ROWS: [f64; 4] = [27.0, 36.0, 45.0, 54.0];
const EDGES_ROWS: f64 = 3.5;

/// Maximum number of values along an axis.
const MAX_AXIS: u64 = 1024;
/// Maximum number of points of a sweep.
const MAX_POINTS: usize = 8192;
/// Maximum number of frames of a point: with 16 bits per pixel, their sum fits into 32 bits.
const MAX_AVERAGE: u64 = 65_536;

impl SweepPlan {
    /// Whether this table is valid in a plan.
    pub fn is_possible(&self) -> bool {
        let Ok(mut document) = Document::parse("") else { return false };
        self.check(&mut document);
        document.finish(Some(())).is_ok()
    }

    /// The plan with the settings that suit a calibrated rig; `None` if it states settings itself (`places` are those of
    /// its text), or the paper's suit.
    pub fn chosen(&self, places: &Places, rows: KnownRows) -> Option<Self> {
        let is_stated = |key| places.has(&["sweep", key]);
        if ["delay_us", "exposure_us", "extra"].into_iter().any(is_stated)
            || rows.own_row_edges == OwnRowEdges::Mislead
        {
            return None;
        }
        let exposures_us = EXPOSURES_ROWS.map(|of| rows.exposure_us(of));
        let shortest_us = exposures_us[0];
        let farthest_us = rows.exposure_us(DELAYS_ROWS);
        let [first_us, last_us] = [-EDGES_ROWS, EDGES_ROWS].map(|edge| rows.opening_us(shortest_us, edge));
        let edges = GridPlan {
            delay_us: Axis::Range { start: first_us, stop: last_us, count: 15 },
            exposure_us: Axis::List(vec![shortest_us]),
        };
        let chosen = Self {
            delay_us: Axis::Range { start: -farthest_us, stop: farthest_us, count: 15 },
            exposure_us: Axis::of_values(exposures_us.to_vec()),
            extra: vec![edges],
            ..self.clone()
        };
        // Rounded values of very short rows may coincide.
        Some(chosen).filter(Self::is_possible)
    }

    /// The grids in the order of acquisition.
    pub fn grids(&self) -> impl Iterator<Item = GridPlan> + '_ {
        let own = GridPlan { delay_us: self.delay_us.clone(), exposure_us: self.exposure_us.clone() };
        std::iter::once(own).chain(self.extra.iter().cloned())
    }

    /// Its tables in a plan.
    pub fn to_toml(&self) -> String {
        let Self { delay_us, exposure_us, average, max_jitter_us, extra, bracket, mm_per_row } = self;
        let bracket = bracket
            .map_or_else(String::new, |bracket| format!("bracket = {{ light = {} }}\n", bracket.light));
        let mm_per_row = mm_per_row.map_or_else(String::new, |mm| format!("mm_per_row = {mm}\n"));
        let own = format!(
            "[sweep]\ndelay_us = {delay_us}\nexposure_us = {exposure_us}\naverage = {average}\nmax_jitter_us = {max_jitter_us}\n{mm_per_row}{bracket}"
        );
        let extra = extra.iter().map(|GridPlan { delay_us, exposure_us }| {
            format!("\n[[sweep.extra]]\ndelay_us = {delay_us}\nexposure_us = {exposure_us}\n")
        });
        std::iter::once(own).chain(extra).collect()
    }

    /// Delay and exposure of each point: grid after grid, with the exposure in the outer loop, because some cameras
    /// take long to change it.
    pub fn settings_us(&self) -> Vec<(f64, f64)> {
        self.grids().flat_map(|grid| grid.settings_us()).collect()
    }

    /// The exposures, each once, in the order of acquisition.
    pub fn exposures_us(&self) -> Vec<f64> {
        let mut exposures = Vec::new();
        for exposure_us in self.grids().flat_map(|grid| grid.exposure_us.values()) {
            if !exposures.contains(&exposure_us) {
                exposures.push(exposure_us);
            }
        }
        exposures
    }

    pub(super) fn check(&self, document: &mut Document<'_>) {
        let indices: Vec<String> = (0..self.extra.len()).map(|index| index.to_string()).collect();
        let extra = indices.iter().map(|index| vec!["sweep", "extra", index.as_str()]);
        let mut are_grids = true;
        for (grid, path) in self.grids().zip(std::iter::once(vec!["sweep"]).chain(extra)) {
            are_grids &= grid.check(&path, document);
        }
        let lengths = self.grids().map(|grid| grid.delay_us.len().saturating_mul(grid.exposure_us.len()));
        let points = lengths.fold(0, usize::saturating_add);
        if are_grids && points > MAX_POINTS {
            let message =
                format!("the sweep has {points} points: at most {MAX_POINTS} are allowed; split it");
            document.refuse(&["sweep"], message);
        }
        if !(1..=MAX_AVERAGE).contains(&self.average.into()) {
            let message = format!("sweep.average = {}: must be from 1 to {MAX_AVERAGE} frames", self.average);
            document.refuse(&["sweep", "average"], message);
        }
        document.check_positive(&["sweep", "max_jitter_us"], self.max_jitter_us, "microseconds");
        if let Some(mm) = self.mm_per_row
            && !(1e-3..=1e3).contains(&mm)
        {
            let message = format!(
                "sweep.mm_per_row = {mm}: must be from 0.001 to 1000 mm of the scene for one projector row"
            );
            document.refuse(&["sweep", "mm_per_row"], message);
        }
        if let Some(BracketPlan { light }) = self.bracket
            && !(light > 0.0 && light < 1.0)
        {
            let message = format!(
                "sweep.bracket.light = {light}: must be more than 0 and less than 1, a share of white; 0.125 suits highlights of up to 8 times the limit"
            );
            document.refuse(&["sweep", "bracket", "light"], message);
        }
    }
}

impl GridPlan {
    fn settings_us(&self) -> Vec<(f64, f64)> {
        let delays = self.delay_us.values();
        let of_exposure = |exposure_us: f64| {
            delays.iter().map(move |&delay_us| (delay_us, exposure_us)).collect::<Vec<_>>()
        };
        self.exposure_us.values().into_iter().flat_map(of_exposure).collect()
    }

    /// Whether the axes have usable lengths; refuses wrong lengths and values of the table at `path`.
    fn check(&self, path: &[&str], document: &mut Document<'_>) -> bool {
        let mut is_grid = true;
        for (key, axis) in [("delay_us", &self.delay_us), ("exposure_us", &self.exposure_us)] {
            let at = |inner: &[&'static str]| -> Vec<String> {
                path.iter().chain([&key]).chain(inner).map(|&key| key.to_owned()).collect()
            };
            let name = at(&[]).join(".");
            let mut refuse = |path: Vec<String>, message: String| {
                document.refuse(&path.iter().map(String::as_str).collect::<Vec<_>>(), message);
            };
            if !(1..=MAX_AXIS).contains(&(axis.len() as u64)) {
                let message = format!("{name} has {}: give 1 to {MAX_AXIS}", counted(axis.len(), "value"));
                refuse(at(&["count"]), message);
                is_grid = false;
                continue;
            }
            if let Axis::Range { start, stop, count: 1 } = axis
                && start != stop
            {
                let places: Vec<String> = at(&["count"]);
                let message = format!(
                    "{name} = {axis}: one value cannot be both {start} and {stop}: give count = 2 or more, or a list with the value"
                );
                document.refuse_new(&places.iter().map(String::as_str).collect::<Vec<_>>(), message);
                continue;
            }
            let values = axis.values();
            if let Some(value) = values.iter().find(|value| !value.is_finite()) {
                refuse(at(&[]), format!("{name} contains {value}: must be finite"));
            }
            if let Some(value) = values.iter().find(|&&value| key == "exposure_us" && value <= 0.0) {
                refuse(at(&[]), format!("{name} contains {value}: must be more than 0 microseconds"));
            }
            if let Some(value) = axis.repeated().filter(|_| values.iter().all(|value| value.is_finite())) {
                let path: Vec<&str> = path.iter().copied().chain([key]).collect();
                let message = format!("{name} contains {value} more than once: give each value once");
                document.refuse_new(&path, message);
            }
        }
        is_grid
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::plan::Procedure;
    use crate::plan::tests::{documented, parse};

    #[test]
    fn every_key_but_kind_has_a_default_and_it_is_the_papers_sweep() {
        let sweep = SweepPlan::default();
        assert_eq!(sweep.delay_us.values().len() * sweep.exposure_us.values().len(), 75);
        assert_eq!((sweep.delay_us.values()[0], sweep.delay_us.values()[14]), (-1500.0, 1500.0));
        assert_eq!(sweep.exposure_us.values(), [600.0, 750.0, 900.0, 1050.0, 1200.0]);
        assert_eq!(parse("kind = \"sweep\"").unwrap().stages[0].name, "demux");
    }

    #[test]
    fn a_calibrated_rig_gets_edges_on_its_rows_where_they_tell_something() {
        use OwnRowEdges::{Divide, Mislead};
        let sweep_of = |text: &str| {
            let plan = parse(text).unwrap();
            let Procedure::Sweep(sweep) = plan.procedure else { panic!("{plan:?}") };
            (sweep, plan.places)
        };
        let chosen = |text: &str, row_time_us, own_row_edges| {
            let (sweep, places) = sweep_of(text);
            sweep.chosen(&places, KnownRows { row_time_us, own_row_edges })
        };
        let few = "kind = \"sweep\"\n[sweep]\naverage = 3\n";
        let (edges, _) = sweep_of(include_str!("../../../../deploy/plans/edges.toml"));
        let sweep = chosen(few, 22.22, Divide).unwrap();
        assert_eq!(sweep, SweepPlan { average: 3, ..edges });
        // What a session states is not chosen again.
        let stated = crate::plan::with_tables(few, &sweep.to_toml()).unwrap();
        assert_eq!((sweep_of(&stated).0, chosen(&stated, 14.8, Divide)), (sweep, None));
        let settings = chosen(few, 14.8, Divide).unwrap().settings_us();
        assert_eq!((settings[0], settings[60], settings.len()), ((-1000.0, 400.0), (148.2, 400.0), 75));
        assert_eq!(chosen(few, 22.22, Mislead), None);
        assert_eq!(chosen(few, 1.0, Divide), None, "exposures of 45 and 54 rows are the same");
        assert_eq!(chosen("kind = \"sweep\"\n[sweep]\nexposure_us = [600]\n", 22.22, Divide), None);
    }

    #[test]
    fn a_bracket_is_a_share_of_white() {
        let sweep =
            |light: &str| parse(&format!("kind = \"sweep\"\n[sweep]\nbracket = {{ light = {light} }}"));
        assert!(sweep("0.125").is_ok());
        for light in ["0.0", "1.0", "-0.5", "nan"] {
            let error = sweep(light).unwrap_err().to_string();
            assert!(error.contains("sweep.bracket.light"), "{error}");
        }
        assert!(parse("kind = \"sweep\"\n[sweep]\nbracket = { level = 0.1 }").is_err());
    }

    #[test]
    fn the_documented_plan_file_is_the_defaults() {
        let (documented, default) = (parse(documented("sweep")).unwrap(), parse("kind = \"sweep\"").unwrap());
        assert_eq!(documented.procedure, default.procedure);
        assert_eq!((&documented.name, &documented.stages[0].name), (&default.name, &default.stages[0].name));
    }

    #[test]
    fn a_sweep_is_written_as_it_is_read() {
        let extra = GridPlan {
            delay_us: Axis::of_values(vec![-1.5, 0.0, 7.25]),
            exposure_us: Axis::List(vec![600.0]),
        };
        let sweep = SweepPlan { extra: vec![extra], ..SweepPlan::default() };
        assert_eq!(
            sweep.to_toml(),
            "[sweep]\ndelay_us = { start = -1500, stop = 1500, count = 15 }\nexposure_us = { start = 600, stop = 1200, count = 5 }\naverage = 8\nmax_jitter_us = 50\n\n[[sweep.extra]]\ndelay_us = [-1.5, 0, 7.25]\nexposure_us = [600]\n"
        );
        let plan = parse(&format!("kind = \"sweep\"\n{}", sweep.to_toml())).unwrap();
        assert_eq!(plan.procedure, Procedure::Sweep(sweep));
        let even = Axis::of_values(vec![-1500.0, 0.0, 1500.0]);
        assert_eq!(even, Axis::Range { start: -1500.0, stop: 1500.0, count: 3 });
    }

    #[test]
    fn a_range_of_one_value_has_one_end() {
        let text = |stop| {
            format!(
                "kind = \"sweep\"\n[sweep]\nexposure_us = [600]\ndelay_us = {{ start = -1500, stop = {stop}, count = 1 }}"
            )
        };
        let refused = parse(&text(1500)).unwrap_err();
        assert_eq!(refused.first().field.as_deref(), Some("sweep.delay_us.count"));
        assert!(refused.to_string().contains("both -1500 and 1500"), "{refused}");
        assert!(parse(&text(-1500)).is_ok());
        let stored = crate::plan::Plan::parse_stored(&text(1500));
        assert!(stored.is_ok(), "sessions stay readable: {stored:?}");
    }

    #[test]
    fn extra_settings_follow_the_grid_and_are_checked_as_it_is() {
        let text = "kind = \"sweep\"\n[sweep]\ndelay_us = [0, 1]\nexposure_us = [600]\n[[sweep.extra]]\n";
        let plan = parse(&format!("{text}delay_us = [5]\nexposure_us = [700, 600]")).unwrap();
        let Procedure::Sweep(sweep) = plan.procedure else { panic!("{plan:?}") };
        assert_eq!(sweep.settings_us(), [(0.0, 600.0), (1.0, 600.0), (5.0, 700.0), (5.0, 600.0)]);
        assert_eq!(sweep.exposures_us(), [600.0, 700.0]);
        let refused = parse(&format!("{text}delay_us = []\nexposure_us = [0]")).unwrap_err().to_string();
        assert!(refused.contains("sweep.extra.0.delay_us has 0 values"), "{refused}");
        assert!(refused.contains("sweep.extra.0.exposure_us contains 0"), "{refused}");
    }
}
