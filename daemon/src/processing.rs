//! The stages and folds of a plan, and what is known of the points that they work on.

use ndarray::Array2;
use raysweep_core::SettingsId;
use raysweep_pipeline::{
    Entry, Fold, Product, Registry, RegistryError, Role, Schedule, Stage, StageError, SweepGeometry, Unit,
    run_stages,
};
use raysweep_session::ledger::{PointEntry, State};
use raysweep_session::stack::{ArrayName, Stack};

use crate::config::{ConfigError, Plan, RigFile};

/// A plan on a rig: everything that acquisition and processing have in common.
#[derive(Clone)]
pub struct Task {
    /// The plan.
    pub plan: Plan,
    /// Its points.
    pub schedule: Schedule,
    /// What turns counts into light transport.
    pub geometry: SweepGeometry,
}

/// Share of the converter's range from which on a mean counts as saturated: the noise of single frames must not have
/// been cut off.
const SATURATION: f64 = 0.97;

impl Task {
    /// A plan on a rig whose camera has `size` (rows, columns) and sees projector row `first_row` with its row 0.
    pub fn new(plan: Plan, rig: &RigFile, first_row: usize, size: (usize, usize)) -> Self {
        let schedule = plan.schedule(rig.vsync.period_us);
        let geometry = SweepGeometry {
            raster: rig.raster(),
            first_row,
            height: size.0,
            width: size.1,
            white_dn: rig.camera.white_dn,
            saturation_dn: SATURATION * f64::from(rig.camera.pixel_format.max_value()),
        };
        Self { plan, schedule, geometry }
    }

    /// The stages and folds that the plan names.
    ///
    /// # Errors
    /// With the place in the plan's text of the stage that cannot be made.
    pub fn processing(&self, registry: &Registry, plan_text: &str) -> Result<Processing, ConfigError> {
        let mut processing = Processing { stages: Vec::new(), folds: Vec::new() };
        for stage in &self.plan.stage {
            let options = serde_json::Value::Object(stage.options.clone());
            let made = registry
                .make(&stage.name, options, &self.schedule, &self.geometry)
                .map_err(|error: RegistryError| ConfigError::at(plan_text, &["stage"], error.to_string()))?;
            match made {
                Entry::Stage(stage) => processing.stages.push(stage),
                Entry::Fold(fold) => processing.folds.push(fold),
            }
        }
        Ok(processing)
    }
}

/// The stages and folds of a plan.
pub struct Processing {
    /// Work on each unit alone.
    pub stages: Vec<Box<dyn Stage>>,
    /// Work on all units in order.
    pub folds: Vec<Box<dyn Fold>>,
}

impl Processing {
    /// Passes points that are stored already through the stages into the folds: those whose stage fails are left out
    /// and named in the result.
    ///
    /// # Errors
    /// When a stored point cannot be read.
    pub fn feed_stored(
        &mut self,
        task: &Task,
        state: &State,
        stack: &Stack,
    ) -> raysweep_session::Result<Vec<StageError>> {
        let mut failed = Vec::new();
        for (ordinal, point) in (0..).zip(&task.schedule.points) {
            let (array, index) = place(point.role);
            let Some(entry) = state.point(array, index) else { continue };
            let unit = unit_of(ordinal, entry, stack.read_point(array, index)?);
            match run_stages(&self.stages, &unit) {
                Ok(image) => self.push(&unit, &image),
                Err(error) => failed.push(error),
            }
        }
        Ok(failed)
    }

    /// Gives the folds a unit's image.
    pub fn push(&mut self, unit: &Unit, image: &Array2<f32>) {
        for fold in &mut self.folds {
            fold.push(unit, image.view());
        }
    }

    /// The products of all folds, and what went wrong in those that have none.
    pub fn finish(&mut self) -> (Vec<Product>, Vec<String>) {
        let (mut products, mut problems) = (Vec::new(), Vec::new());
        for fold in &mut self.folds {
            match fold.finish() {
                Ok(made) => products.extend(made),
                Err(error) => problems.push(error.to_string()),
            }
        }
        (products, problems)
    }
}

/// Where in the stack a point lies.
pub fn place(role: Role) -> (ArrayName, usize) {
    match role {
        Role::Sweep(index) => (ArrayName::Sum, index as usize),
        Role::Dark(index) => (ArrayName::Dark, index as usize),
        Role::Regular => (ArrayName::Regular, 0),
    }
}

fn unit_of(ordinal: u32, entry: &PointEntry, sum: Array2<u32>) -> Unit {
    Unit {
        id: SettingsId { point: ordinal, attempt: entry.attempt },
        frames: entry.frames,
        exposure_us: entry.exposure_us,
        delays_us: entry.delays_us.clone(),
        sum: std::sync::Arc::new(sum),
        counts: entry.counts.clone(),
    }
}
