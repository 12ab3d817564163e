//! `plan.toml`: what to acquire and what to make of it.

use raysweep_pipeline::{Point, Role, Schedule};
use serde::Deserialize;
use serde_json::{Map, Value};

use super::{BatchesPlan, ConfigError, FilmPlan, ProductTable, ResponsePlan, span_of};

/// A plan.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plan {
    /// What kind of acquisition it is.
    pub kind: PlanKind,
    /// Names the session.
    #[serde(default = "default_name")]
    pub name: String,
    /// `[sweep]`, where it is one.
    #[serde(default)]
    pub sweep: Sweep,
    /// `[film]`, where it is one.
    #[serde(default)]
    pub film: FilmPlan,
    /// `[batches]`, where it is a flying dot's.
    #[serde(default)]
    pub batches: BatchesPlan,
    /// `[response]`, where it is a mirror's.
    #[serde(default)]
    pub response: ResponsePlan,
    /// `[[stage]]`: stages in order, then folds; none: `demux`.
    #[serde(default = "default_stages")]
    pub stage: Vec<StageTable>,
    /// `[[product]]`: what to make of the transport; left out: [`raysweep_pipeline::ProductSpec::defaults`].
    pub product: Option<Vec<ProductTable>>,
}

/// The kinds of acquisition.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum PlanKind {
    /// A delay-exposure sweep of the plane rig.
    Sweep,
    /// A short sweep again and again, each time with a light transport of its own.
    Film,
    /// Batches of frames of a flying dot.
    Batches,
    /// Chirps of a mirror, from which its resonances are identified.
    Response,
}

impl PlanKind {
    const ALL: [Self; 4] = [Self::Sweep, Self::Film, Self::Batches, Self::Response];

    /// Its name in plans, which is also that of its table.
    pub fn name(self) -> &'static str {
        match self {
            Self::Sweep => "sweep",
            Self::Film => "film",
            Self::Batches => "batches",
            Self::Response => "response",
        }
    }
}

/// `[sweep]`: the grid of delays and exposures; the defaults are the paper's.
#[derive(Debug, Clone, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Sweep {
    /// t_d.
    pub delay_us: Axis,
    /// t_e.
    pub exposure_us: Axis,
    /// Frames averaged at each point.
    pub average: u32,
    /// Frames whose measured delay is further off do not count and are taken again.
    pub max_jitter_us: f64,
}

impl Default for Sweep {
    fn default() -> Self {
        Self {
            delay_us: Axis::Range { start: -1500.0, stop: 1500.0, count: 15 },
            exposure_us: Axis::Range { start: 600.0, stop: 1200.0, count: 5 },
            average: 8,
            max_jitter_us: 50.0,
        }
    }
}

/// Values along one axis of the sweep.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(
    untagged,
    expecting = "a list of numbers, or { start = .., stop = .., count = .. }",
    deny_unknown_fields
)]
pub enum Axis {
    /// These, in this order.
    List(Vec<f64>),
    /// Evenly spaced, both ends included.
    Range {
        /// First value.
        start: f64,
        /// Last value.
        stop: f64,
        /// How many.
        count: usize,
    },
}

impl Axis {
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

    pub(super) fn len(&self) -> usize {
        match self {
            Self::List(values) => values.len(),
            Self::Range { count, .. } => *count,
        }
    }
}

/// One `[[stage]]`: its name and the options that the stage itself reads.
#[derive(Debug, Clone, Deserialize)]
pub struct StageTable {
    /// The name it is registered by.
    pub name: String,
    /// Everything else in its table.
    #[serde(flatten)]
    pub options: Map<String, Value>,
}

fn default_name() -> String {
    "sweep".into()
}

fn default_stages() -> Vec<StageTable> {
    vec![StageTable { name: "demux".into(), options: Map::new() }]
}

/// Fewest frames of a dark image: its noise is in all images of its exposure, so it should hardly have any.
const MIN_DARK_AVERAGE: u32 = 8;
/// Most values along an axis.
const MAX_AXIS: usize = 1024;
/// Most points of a sweep.
const MAX_POINTS: usize = 8192;
/// Most frames of a point: their sum fits 32 bits at 16 bits a pixel.
const MAX_AVERAGE: u32 = 65_536;

impl Plan {
    /// Reads a plan.
    ///
    /// # Errors
    /// With the place in the text, for anything that is not a plan that can be run.
    pub fn parse(text: &str) -> Result<Self, ConfigError> {
        let mut plan: Self = toml::from_str(text).map_err(|error| ConfigError::parse(&error))?;
        let (own_name, is_named) = (plan.kind.name(), span_of(text, &["name"]).is_some());
        if !is_named {
            plan.name = own_name.into();
        }
        if plan.kind == PlanKind::Batches && span_of(text, &["stage"]).is_none() {
            plan.stage = vec![StageTable { name: "denoise".into(), options: Map::new() }];
        }
        plan.check(text)?;
        Ok(plan)
    }

    /// Frames whose measured delay is further off do not count.
    pub fn max_jitter_us(&self) -> f64 {
        match self.kind {
            PlanKind::Sweep => self.sweep.max_jitter_us,
            PlanKind::Film => self.film.max_jitter_us,
            // A flying dot has no line to be late for.
            PlanKind::Batches | PlanKind::Response => f64::INFINITY,
        }
    }

    /// Whether it can be run; `text` is what it was read from.
    ///
    /// # Errors
    /// Those of [`Self::parse`].
    pub(crate) fn check(&self, text: &str) -> Result<(), ConfigError> {
        let sweep = &self.sweep;
        let own = self.kind.name();
        let others = PlanKind::ALL.map(PlanKind::name).into_iter().filter(|other| *other != own);
        for other in others {
            if span_of(text, &[other]).is_some() {
                let message = format!("kind = \"{own}\" has no [{other}]: give [{own}], or another kind");
                return Err(ConfigError::at(text, &[other], message));
            }
        }
        let unused = ["stage", "product"].into_iter().find(|key| span_of(text, &[*key]).is_some());
        if let (PlanKind::Response, Some(key)) = (self.kind, unused) {
            let message = format!("kind = \"response\" has no [[{key}]]: leave it out");
            return Err(ConfigError::at(text, &[key], message));
        }
        self.film.check(text)?;
        self.batches.check(text)?;
        self.response.check(text)?;
        if self.name.trim().is_empty() {
            return Err(ConfigError::at(text, &["name"], "name is empty: give the session a name"));
        }
        for (key, axis) in [("delay_us", &sweep.delay_us), ("exposure_us", &sweep.exposure_us)] {
            if !(1..=MAX_AXIS).contains(&axis.len()) {
                let message = format!("sweep.{key} has {} values: 1 to {MAX_AXIS} are allowed", axis.len());
                return Err(ConfigError::at(text, &["sweep", key, "count"], message));
            }
            if let Some(value) = axis.values().into_iter().find(|value| !value.is_finite()) {
                let message = format!("sweep.{key} contains {value}: give finite microseconds");
                return Err(ConfigError::at(text, &["sweep", key], message));
            }
        }
        if let Some(value) = sweep.exposure_us.values().into_iter().find(|&exposure_us| exposure_us <= 0.0) {
            let message = format!("sweep.exposure_us contains {value}: exposures are longer than 0 us");
            return Err(ConfigError::at(text, &["sweep", "exposure_us"], message));
        }
        let points = sweep.delay_us.len() * sweep.exposure_us.len();
        if points > MAX_POINTS {
            let message =
                format!("the sweep has {points} points: at most {MAX_POINTS} are allowed; split it");
            return Err(ConfigError::at(text, &["sweep"], message));
        }
        for (index, stage) in self.stage.iter().enumerate() {
            // Options have passed through a form without NaN and infinity, in which these are null; TOML has no null.
            if let Some((key, _)) = stage.options.iter().find(|(_, value)| value.is_null()) {
                let message = format!("stage {}: {key} is not a finite number", stage.name);
                return Err(ConfigError::at(text, &["stage", &index.to_string(), key], message));
            }
        }
        for (index, product) in self.product.iter().flatten().enumerate() {
            product.check(text, index)?;
        }
        if !(1..=MAX_AVERAGE).contains(&sweep.average) {
            let message = format!("sweep.average = {}: 1 to {MAX_AVERAGE} frames are allowed", sweep.average);
            return Err(ConfigError::at(text, &["sweep", "average"], message));
        }
        if !(sweep.max_jitter_us > 0.0 && sweep.max_jitter_us.is_finite()) {
            let message =
                format!("sweep.max_jitter_us = {}: give microseconds greater than 0", sweep.max_jitter_us);
            return Err(ConfigError::at(text, &["sweep", "max_jitter_us"], message));
        }
        Ok(())
    }

    /// The points of the plan: dark images of each exposure, the regular image, then the sweep with the exposure in
    /// the outer loop, because some cameras take long to change it.
    pub fn schedule(&self, period_us: f64) -> Schedule {
        if self.kind == PlanKind::Film {
            return self.film.schedule();
        }
        let frames = self.sweep.average;
        let point = |role, delay_us, exposure_us| {
            let frames = if matches!(role, Role::Dark(_)) { frames.max(MIN_DARK_AVERAGE) } else { frames };
            Point { role, delay_us, exposure_us, frames }
        };
        let exposures = self.sweep.exposure_us.values();
        let delays = self.sweep.delay_us.values();

        let mut dark_exposures: Vec<f64> = Vec::new();
        for &exposure_us in exposures.iter().chain([&period_us]) {
            if !dark_exposures.contains(&exposure_us) {
                dark_exposures.push(exposure_us);
            }
        }
        let mut points: Vec<Point> =
            (0..).zip(&dark_exposures).map(|(index, &us)| point(Role::Dark(index), 0.0, us)).collect();
        points.push(point(Role::Regular, 0.0, period_us));
        let grid = exposures
            .iter()
            .flat_map(|&exposure_us| delays.iter().map(move |&delay_us| (delay_us, exposure_us)));
        points.extend(
            (0..)
                .zip(grid)
                .map(|(index, (delay_us, exposure_us))| point(Role::Sweep(index), delay_us, exposure_us)),
        );
        Schedule { points }
    }
}

#[cfg(test)]
mod tests {
    use raysweep_pipeline::{ProductSpec, Registry};

    use super::*;
    use crate::config::RigFile;
    use crate::processing::Task;

    #[test]
    fn every_key_but_kind_has_a_default_and_it_is_the_papers_sweep() {
        let plan = Plan::parse("kind = \"sweep\"").unwrap();
        let schedule = plan.schedule(16_667.0);
        assert_eq!(schedule.sweep_len(), 75);
        assert_eq!(schedule.dark_len(), 6);
        let sweep: Vec<_> = schedule.points.iter().filter(|p| matches!(p.role, Role::Sweep(_))).collect();
        assert_eq!((sweep[0].delay_us, sweep[0].exposure_us), (-1500.0, 600.0));
        assert_eq!((sweep[14].delay_us, sweep[15].exposure_us), (1500.0, 750.0));
        assert_eq!(plan.stage[0].name, "demux");
    }

    #[test]
    fn bad_plans_are_refused_with_field_and_place() {
        let cases = [
            ("kind = \"swep\"", "sweep"),
            ("kind = \"sweep\"\naverage = 8", "unknown field"),
            ("kind = \"sweep\"\n[sweep]\naverage = 0", "1 to 65536"),
            ("kind = \"sweep\"\n[sweep]\ndelay_us = { start = 0, stop = 1, count = 0 }", "1 to 1024"),
            ("kind = \"sweep\"\n[sweep]\ndelay_us = { start = 0, stop = 1 }", "list of numbers"),
            ("kind = \"sweep\"\n[sweep]\nexposure_us = [0]", "longer than 0"),
            ("kind = \"sweep\"\n[sweep]\ndelay_us = [nan]", "finite"),
            ("kind = \"sweep\"\n[sweep]\nmax_jitter_us = -1", "greater than 0"),
            ("kind = \"sweep\"\nname = \"  \"", "empty"),
            ("kind = \"sweep\"\n[[stage]]\nname = \"demux\"\nalpha = nan", "alpha is not a finite number"),
            ("kind = \"sweep\"\n[[stage]]\nprior = \"split\"", "name"),
            ("kind = \"sweep\"\n[[product]]\nname = \"a\"", "kind"),
            ("kind = \"sweep\"\n[[product]]\nkind = \"band\"\nfrom_rows = inf", "from_rows is not a finite"),
        ];
        for (text, expected) in cases {
            let error = Plan::parse(text).unwrap_err();
            assert!(error.message.contains(expected), "{text:?}: {}", error.message);
            assert!(error.span.is_some(), "{text:?} has no place");
        }
    }

    #[test]
    fn the_documented_plan_file_is_the_defaults() {
        let page = include_str!("../../../docs/reference/plan.md");
        let documented = page.split("```toml\n").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
        let (documented, default) =
            (Plan::parse(documented).unwrap(), Plan::parse("kind = \"sweep\"").unwrap());
        assert_eq!(format!("{:?}", documented.sweep), format!("{:?}", default.sweep));
        assert_eq!(documented.schedule(16_667.0), default.schedule(16_667.0));
        assert_eq!((&documented.name, &documented.stage[0].name), (&default.name, &default.stage[0].name));
        let rig = RigFile::parse(include_str!("../../../deploy/rigs/plane-sim.toml")).unwrap();
        let task = Task::new(documented, &rig, 0, (128, 128));
        let processing = task.processing(&Registry::default(), page).unwrap();
        assert_eq!(processing.products, ProductSpec::defaults());
    }
}
