//! A sweep on a plane rig: its points and products.

use std::sync::Arc;

use raysweep_config::{ConfigError, Plan, ProductTable, SweepPlan};
use raysweep_core::Pattern;
use raysweep_pipeline::{Point, PointRole, ProductSpec, Schedule};
use raysweep_session::stack::Contents;

use crate::plane::{KnownRig, PlaneTask, Processing, planned_products};

/// Minimum number of frames of a dark image: its noise enters all images of its exposure, so it must be small.
const MIN_DARK_AVERAGE: u32 = 8;
/// Minimum number of frames of the image under less light, whose noise is that of the highlights.
const MIN_BRACKET_AVERAGE: u32 = 8;

/// A sweep on a plane rig.
#[derive(Clone)]
pub struct SweepTask {
    /// The plan's own table.
    pub sweep: SweepPlan,
    /// Its points and model.
    pub task: Arc<PlaneTask>,
    products: Option<Vec<ProductTable>>,
}

impl SweepTask {
    /// A sweep on a rig; see [`PlaneTask::new`].
    pub fn new(plan: &Plan, sweep: SweepPlan, rig: &KnownRig<'_>) -> Self {
        let schedule = schedule(&sweep, rig.file.vsync.period_us);
        let task = PlaneTask::new(plan, schedule, sweep.max_jitter_us, rig);
        Self { sweep, task: Arc::new(task), products: plan.products.clone() }
    }

    /// The same task with another sweep, if the plan allows it and the products can be made from it.
    pub fn with_sweep(&self, sweep: SweepPlan) -> Option<Self> {
        let is_possible = sweep.is_possible();
        let mut task = (*self.task).clone();
        task.schedule = schedule(&sweep, task.geometry.raster.period_us);
        let other = Self { sweep, task: Arc::new(task), products: self.products.clone() };
        (is_possible && other.products().is_ok()).then_some(other)
    }

    /// What its session stores.
    pub fn contents(&self) -> Contents {
        Contents::Sweep { points: self.points(), exposures: self.task.schedule.dark_len() }
    }

    /// Number of images to store, without dark and regular ones.
    pub fn points(&self) -> usize {
        self.task.schedule.sweep_len() + usize::from(self.sweep.bracket.is_some())
    }

    /// The picture under which the image for pixels that saturate is taken, if the plan asks for it.
    pub fn bracket_picture(&self) -> Option<Pattern> {
        self.sweep.bracket.map(|bracket| Pattern::Grey { level: bracket.light as f32 })
    }

    /// The stages and products that the plan names.
    ///
    /// # Errors
    /// With the position in the plan's text of the stage or product that cannot be made.
    pub fn processing(&self) -> Result<Processing, ConfigError> {
        let (stages, demux) = self.task.made_stages()?;
        // After `demux`, which refuses a rig on which no product could be made.
        let products = self.products()?;
        Ok(Processing { stages, demux, products, problems: Vec::new() })
    }

    /// The products that the plan names, made from the transport.
    fn products(&self) -> Result<Vec<ProductSpec>, ConfigError> {
        let Some(tables) = &self.products else { return Ok(ProductSpec::defaults()) };
        if !tables.is_empty() && self.task.demux_table().is_none() {
            let what = "products need the light transport: add a [[stage]] with name = \"demux\"";
            return Err(self.task.refuse(&["product"], what));
        }
        planned_products(tables, &self.task)
    }
}

/// The points of a sweep: dark images of each exposure, the regular image, then the settings, and last the bracket: the
/// shortest exposure about direct light.
fn schedule(sweep: &SweepPlan, period_us: f64) -> Schedule {
    let frames = sweep.average;
    let point = |role, delay_us, exposure_us| {
        let frames = match role {
            PointRole::Dark(_) => frames.max(MIN_DARK_AVERAGE),
            PointRole::Bracket(_) => frames.max(MIN_BRACKET_AVERAGE),
            PointRole::Regular | PointRole::Sweep(_) => frames,
        };
        Point { role, delay_us, exposure_us, frames }
    };
    let mut dark_exposures = sweep.exposures_us();
    if !dark_exposures.contains(&period_us) {
        dark_exposures.push(period_us);
    }
    let mut points: Vec<Point> =
        (0..).zip(&dark_exposures).map(|(index, &us)| point(PointRole::Dark(index), 0.0, us)).collect();
    points.push(point(PointRole::Regular, 0.0, period_us));
    let settings = (0..).zip(sweep.settings_us());
    points.extend(
        settings
            .map(|(index, (delay_us, exposure_us))| point(PointRole::Sweep(index), delay_us, exposure_us)),
    );
    let shortest_us = sweep.exposures_us().into_iter().fold(f64::INFINITY, f64::min);
    let index = sweep.settings_us().len() as u32;
    points.extend(sweep.bracket.map(|_| point(PointRole::Bracket(index), 0.0, shortest_us)));
    Schedule { points }
}
