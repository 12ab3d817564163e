//! A film on a plane rig: its settings, stages and solver.

use std::sync::Arc;

use raysweep_config::{ConfigError, FilmPlan, Plan, ProductTable};
use raysweep_pipeline::{FilmSolver, Point, PointRole, ProductSpec, Schedule, Stages, mask};
use raysweep_session::film::TransportFilm;
use raysweep_session::stack::Contents;
use raysweep_session::{Result, Session};
use raysweep_transport::plane::Transport;
use serde_json::json;

use crate::plane::{KnownRig, PlaneTask, mask_bits, planned_products};

/// Frames of the dark image: its noise enters every cycle, so it averages many.
const DARK_FRAMES: u32 = 32;

/// A film on a plane rig.
#[derive(Clone)]
pub struct FilmTask {
    /// The plan's own table.
    pub film: FilmPlan,
    /// The dark image, the settings of a cycle, and the model.
    pub task: Arc<PlaneTask>,
    products: Vec<ProductTable>,
}

impl FilmTask {
    /// A film on a rig; see [`PlaneTask::new`].
    pub fn new(plan: &Plan, film: FilmPlan, rig: &KnownRig<'_>) -> Self {
        let task = PlaneTask::new(plan, schedule(&film), film.max_jitter_us, rig);
        Self { film, task: Arc::new(task), products: plan.products.clone().unwrap_or_default() }
    }

    /// The same task with another film, if the plan allows it.
    pub fn with_film(&self, film: FilmPlan) -> Option<Self> {
        let is_possible = film.is_possible();
        let mut task = (*self.task).clone();
        task.schedule = schedule(&film);
        is_possible.then(|| Self { film, task: Arc::new(task), products: self.products.clone() })
    }

    /// What its session stores.
    pub fn contents(&self) -> Contents {
        let (settings, exposures) = (self.task.settings().count(), self.task.schedule.dark_len());
        Contents::Film { cycles: self.points(), settings, exposures }
    }

    /// Number of cycles to store.
    pub fn points(&self) -> usize {
        self.film.cycles as usize
    }

    /// The stages that the plan names. Each cycle has its own transport, so its solver takes the place of `demux`.
    ///
    /// # Errors
    /// With the position in the plan's text of the stage that cannot be made.
    pub fn stages(&self) -> std::result::Result<Stages, ConfigError> {
        let (stages, _) = self.task.made_stages()?;
        Ok(stages)
    }

    /// The products that the plan names; none if it names none, because a film may have tens of thousands of cycles.
    ///
    /// # Errors
    /// With the position in the plan's text of the product that cannot be made.
    pub fn products(&self) -> std::result::Result<Vec<ProductSpec>, ConfigError> {
        let specs = planned_products(&self.products, &self.task)?;
        for (index, spec) in specs.iter().enumerate() {
            if let Some(what) = self.cannot_make(spec) {
                return Err(self.task.refuse(&["product", &index.to_string(), "kind"], what));
            }
        }
        Ok(specs)
    }

    /// Why a product cannot be made of this film, if it cannot.
    pub(super) fn cannot_make(&self, spec: &ProductSpec) -> Option<String> {
        let is_short = self.points() < FilmSolver::FIRST_CYCLES && spec.needs_noise();
        let short = is_short.then(|| {
            format!(
                "product {}: film.cycles = {}: must be at least {}, whose mean shows the noise",
                spec.name(),
                self.points(),
                FilmSolver::FIRST_CYCLES
            )
        });
        spec.not_of_a_film().or(short)
    }

    /// The solver that computes the transport of each cycle.
    ///
    /// # Errors
    /// When the delays and exposure give no model on this rig.
    pub fn solver(&self) -> std::result::Result<FilmSolver, ConfigError> {
        let task = &self.task;
        FilmSolver::new(task.demux_options()?, &task.schedule, &task.geometry)
            .map_err(|error| task.refuse(&["film"], error.to_string()))
    }
}

/// The dark image, then the settings of one cycle in the plan's order. There is no regular image: by the time it
/// could be compared, the scene has moved.
fn schedule(film: &FilmPlan) -> Schedule {
    let exposure_us = film.exposure_us;
    let dark = Point { role: PointRole::Dark(0), delay_us: 0.0, exposure_us, frames: DARK_FRAMES };
    let setting =
        |(index, delay_us)| Point { role: PointRole::Sweep(index), delay_us, exposure_us, frames: 1 };
    let settings = (0..).zip(film.delay_us.values()).map(setting);
    Schedule { points: std::iter::once(dark).chain(settings).collect() }
}

/// Creates the empty series of a film's transports; replaces an existing one.
///
/// # Errors
/// When the session cannot be written.
pub fn create_transports(
    session: &Session,
    task: &FilmTask,
    reach_rows: (i32, i32),
) -> Result<TransportFilm> {
    let geometry = &task.task.geometry;
    let (u_min, u_max) = reach_rows;
    let mut attributes = task.task.metadata();
    attributes.insert("u_min".into(), json!(u_min));
    attributes.insert("u_max".into(), json!(u_max));
    attributes.insert(
        "about".into(),
        json!("light from projector row v = t + first_row + u to camera pixel (t, s), by cycle; 0 where the projector has no such row, NaN where the cycle was not estimated"),
    );
    let cycle = [(u_max - u_min + 1) as usize, geometry.height, geometry.width];
    TransportFilm::create(&session.transport_film_path(), task.points(), cycle, &attributes, &mask_bits())
}

/// Writes the transport of a cycle, with its mask.
///
/// # Errors
/// When the session cannot be written.
pub fn write_transport(transports: &TransportFilm, cycle: usize, transport: &Transport) -> Result<()> {
    let mask = mask::of_transport(transport, 0..transport.exists.ncols());
    transports.write(cycle, transport.t.view(), mask.view())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_film_has_a_dark_image_and_one_frame_a_setting() {
        let plan = Plan::parse("kind = \"film\"\n[film]\ndelay_us = [100, 0]\nexposure_us = 200").unwrap();
        let raysweep_config::Procedure::Film(film) = plan.procedure else { panic!("{plan:?}") };
        let schedule = schedule(&film);
        assert_eq!((schedule.dark_len(), schedule.sweep_len(), schedule.points.len()), (1, 2, 3));
        assert_eq!((schedule.points[1].delay_us, schedule.points[1].frames), (100.0, 1));
        assert!(schedule.points.iter().all(|point| point.exposure_us == 200.0));
    }
}
