//! The stages and folds of a plan, and what is known of the points that they work on.

use std::any::Any;
use std::fmt::Display;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::sync::Arc;

use ndarray::Array2;
use raysweep_core::SettingsId;
use raysweep_pipeline::{
    Assembly, DemuxOptions, Entry, FilmSolver, Findings, Fold, FoldError, ImageRows, InStrips, Point,
    Product, ProductSpec, Registry, RegistryError, Role, Schedule, Snapshot, Stage, Strip, SweepGeometry,
    Unit, message_of, run_stages,
};
use raysweep_session::STRIP_ROWS;
use raysweep_session::ledger::{PointEntry, State};
use raysweep_session::stack::{ArrayName, Stack, crc32};
use serde_json::Value;

use crate::config::{ConfigError, Plan, PlanKind, RigFile};

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
pub(crate) const SATURATION: f64 = 0.97;

impl Task {
    /// A plan on a rig whose camera has `size` (rows, columns) and sees projector row `first_row` with its row 0.
    pub fn new(plan: Plan, rig: &RigFile, first_row: usize, size: (usize, usize)) -> Self {
        let schedule = plan.schedule(rig.vsync.period_us);
        let geometry = SweepGeometry {
            raster: rig.raster(),
            row_table_us: rig.projector.row_table.as_deref().map(Into::into),
            beam_sigma_rows: rig.projector.beam_sigma_rows,
            spot: rig.projector.spot(),
            projector_columns: rig.camera.projector_columns,
            first_row,
            row_pitch: rig.camera.row_pitch,
            camera_row_time_us: rig.camera_row_time_us(),
            height: size.0,
            width: size.1,
            white_dn: rig.camera.white_dn(),
            saturation_dn: SATURATION * f64::from(rig.camera.pixel_format.max_value()),
        };
        Self { plan, schedule, geometry }
    }

    /// Whether it is a film.
    pub fn is_film(&self) -> bool {
        self.plan.kind == PlanKind::Film
    }

    /// How many points it stores: the sweep's, or the film's cycles.
    pub fn points(&self) -> usize {
        if self.is_film() { self.plan.film.cycles as usize } else { self.schedule.sweep_len() }
    }

    /// The points of the sweep, or the settings of the film's cycle, with their ordinals.
    pub fn settings(&self) -> impl Iterator<Item = (u32, &Point)> {
        (0..).zip(&self.schedule.points).filter(|(_, point)| matches!(point.role, Role::Sweep(_)))
    }

    /// The options of `demux` as the plan states them.
    ///
    /// # Errors
    /// When it has others.
    pub fn demux_options(&self) -> Result<DemuxOptions, ConfigError> {
        let Some(stage) = self.plan.stage.iter().find(|stage| stage.name == "demux") else {
            return Ok(DemuxOptions::default());
        };
        serde_json::from_value(Value::Object(stage.options.clone())).map_err(|error| ConfigError {
            message: format!("stage demux: {error}"),
            field: Some("stage".into()),
            span: None,
        })
    }

    /// What makes transports of a film's cycles.
    ///
    /// # Errors
    /// When delays and exposure make no model on this rig.
    pub fn film_solver(&self) -> Result<FilmSolver, ConfigError> {
        let made = FilmSolver::new(self.demux_options()?, &self.schedule, &self.geometry);
        made.map_err(|error| ConfigError {
            message: error.to_string(),
            field: Some("film".into()),
            span: None,
        })
    }

    /// The stages, folds and products that the plan names; of a film, the stages alone.
    ///
    /// # Errors
    /// With the place in the plan's text of the stage or product that cannot be made.
    pub fn processing(&self, registry: &Registry, plan_text: &str) -> Result<Processing, ConfigError> {
        let mut stages = Vec::new();
        let mut folds: Vec<Box<dyn Fold>> = Vec::new();
        for (index, stage) in self.plan.stage.iter().enumerate() {
            let place = index.to_string();
            let refused = |message: String| ConfigError::at(plan_text, &["stage", &place, "name"], message);
            let options = serde_json::Value::Object(stage.options.clone());
            let made = registry
                .make(&stage.name, options, &self.schedule, &self.geometry)
                .map_err(|error: RegistryError| refused(error.to_string()))?;
            match made {
                Entry::Fold(fold) if self.is_film() && fold.name() != "demux" => {
                    let name = fold.name();
                    return Err(refused(format!("{name} is not for films: their only fold is demux")));
                }
                // Each cycle has a transport of its own, which no fold over the whole run makes.
                Entry::Fold(_) if self.is_film() => {}
                Entry::Fold(fold) if folds.iter().any(|other| other.name() == fold.name()) => {
                    let name = fold.name();
                    return Err(refused(format!(
                        "{name} stands twice: its products would overwrite each other; keep one"
                    )));
                }
                Entry::Stage(stage) => stages.push(stage),
                Entry::Fold(fold) => folds.push(fold),
            }
        }
        // After the folds, which refuse a rig that no product could be made on.
        let products = self.products(plan_text)?;
        Ok(Processing { stages: stages.into(), folds, products, problems: Vec::new() })
    }

    /// What is made of the transport: the products that the plan names.
    ///
    /// # Errors
    /// With the place in the plan's text of the product that cannot be made.
    pub(crate) fn products(&self, plan_text: &str) -> Result<Vec<ProductSpec>, ConfigError> {
        let Some(tables) = &self.plan.product else { return Ok(ProductSpec::defaults()) };
        if !tables.is_empty() && !self.plan.stage.iter().any(|stage| stage.name == "demux") {
            let what = "products are made of the light transport: add a [[stage]] with name = \"demux\"";
            return Err(ConfigError::at(plan_text, &["product"], what));
        }
        let mut specs = Vec::new();
        for (index, table) in tables.iter().enumerate() {
            table.append_to(&mut specs, plan_text, index, &self.schedule, &self.geometry)?;
        }
        Ok(specs)
    }
}

/// The stages, folds and products of a plan.
pub struct Processing {
    /// Work on each unit alone.
    pub stages: Arc<[Box<dyn Stage>]>,
    /// Work on all units in order.
    pub folds: Vec<Box<dyn Fold>>,
    /// What is made of the transport of the folds.
    pub products: Vec<ProductSpec>,
    /// What could not be done so far, and why.
    pub problems: Vec<String>,
}

impl Processing {
    /// Passes points that are stored already through the stages into the folds, for as long as `go_on` says yes. A
    /// point whose stage fails is left out, and named among the problems; so are points whose data are damaged, which
    /// are returned: they must be acquired again.
    pub fn feed_stored(
        &mut self,
        task: &Task,
        state: &State,
        stack: &Stack,
        go_on: &dyn Fn() -> bool,
    ) -> Vec<SettingsId> {
        let mut damaged = Vec::new();
        for (ordinal, point) in (0..).zip(&task.schedule.points) {
            let (array, index) = place(point.role);
            let Some(entry) = state.point(array, index).filter(|_| go_on()) else { continue };
            let sum = match stack.read_point(array, index) {
                Ok(sum) if crc32(sum.view()) == entry.crc32 => sum,
                read => {
                    let why = read
                        .err()
                        .map_or("its checksum is not the ledger's".into(), |error| error.to_string());
                    self.problems.push(format!(
                        "{} {index} is damaged ({why}): `raysweep resume` acquires it again",
                        array.as_str()
                    ));
                    damaged.push(SettingsId { point: ordinal, attempt: state.next_attempt(array, index) });
                    continue;
                }
            };
            let unit = unit_of(ordinal, entry, sum);
            match run_stages(&self.stages, &unit) {
                Ok(image) => self.push(&unit, &image),
                Err(error) => self.problems.push(error.to_string()),
            }
        }
        damaged
    }

    /// Gives the folds a unit's image. A fold that panics is out, with its products; the others go on.
    pub fn push(&mut self, unit: &Unit, image: &Array2<f32>) {
        let problems = &mut self.problems;
        self.folds.retain_mut(|fold| {
            let pushed = catch_unwind(AssertUnwindSafe(|| fold.push(unit, image.view())));
            pushed.map_err(|panic| problems.push(panicked(fold.name(), &*panic))).is_ok()
        });
    }

    /// What the first fold that estimates while units come has so far.
    pub fn snapshot(&self) -> Option<Box<dyn Snapshot>> {
        // A picture for between is no reason to lose a fold, let alone the run.
        self.folds.iter().find_map(|fold| catch_unwind(AssertUnwindSafe(|| fold.snapshot())).ok().flatten())
    }

    /// Keeps no images from now on: [`Self::finish_in_strips`] reads them again.
    pub fn keep_no_images(&mut self) {
        self.folds.iter_mut().for_each(|fold| fold.keep_no_images());
    }

    /// [`Self::finish`] and [`Self::make_named`] after [`Self::keep_no_images`]: the transport goes into `write`, strip by strip, and is not among
    /// the products.
    pub fn finish_in_strips(
        mut self,
        images: &dyn ImageRows,
        go_on: &(dyn Fn() -> bool + Sync),
        write: &mut dyn FnMut(&Findings, &Strip) -> Result<(), String>,
    ) -> (Vec<Product>, Vec<String>) {
        let mut products = Vec::new();
        let mut assemblies: Vec<Assembly> = self.products.drain(..).map(Assembly::new).collect();
        let mut strips_taken = 0;
        for fold in &mut self.folds {
            let name = fold.name().to_owned();
            let problems = &mut self.problems;
            let mut take = |findings: &Findings, strip: Strip| {
                write(findings, &strip).map_err(|what| FoldError { fold: name.clone(), what })?;
                assemblies.retain_mut(|assembly| {
                    let Strip { first_row, stack, transport } = &strip;
                    let product = assembly.name().to_owned();
                    let added = caught(&product, || assembly.add(*first_row, stack, transport));
                    added.map_err(|problem| problems.push(problem)).is_ok()
                });
                strips_taken += 1;
                Ok(())
            };
            let strips = InStrips { images, strip_rows: STRIP_ROWS, take: &mut take };
            match caught(&name, || fold.finish_in_strips(strips, go_on)) {
                Ok(made) => products.extend(made),
                Err(problem) => {
                    // Images of which rows are lacking are none.
                    assemblies.clear();
                    self.problems.push(problem);
                }
            }
        }
        for assembly in assemblies.into_iter().filter(|_| strips_taken > 0) {
            let product = assembly.name().to_owned();
            match caught(&product, || assembly.finish()) {
                Ok(product) => products.push(product),
                Err(problem) => self.problems.push(problem),
            }
        }
        (products, self.problems)
    }

    /// The products of all folds. Ends early soon after `go_on` says no.
    pub fn finish(&mut self, go_on: &(dyn Fn() -> bool + Sync)) -> Vec<Product> {
        let mut products = Vec::new();
        for fold in &mut self.folds {
            let name = fold.name().to_owned();
            match caught(&name, || fold.finish(go_on)) {
                Ok(made) => products.extend(made),
                Err(problem) => self.problems.push(problem),
            }
        }
        products
    }

    /// The products that the plan names, if the folds have made what they are made of.
    pub fn make_named(&mut self, made: &[Product], go_on: &(dyn Fn() -> bool + Sync)) -> Vec<Product> {
        let transport = made.iter().find_map(|product| match product {
            Product::Transport(transport) => Some(&**transport),
            _ => None,
        });
        let stack = made.iter().find_map(|product| match product {
            Product::Stack(stack) => Some(&**stack),
            _ => None,
        });
        let Some((transport, stack)) = transport.zip(stack) else { return Vec::new() };
        let mut products = Vec::new();
        for spec in self.products.iter().take_while(|_| go_on()) {
            match caught(spec.name(), || spec.make(stack, transport)) {
                Ok(product) => products.push(product),
                Err(problem) => self.problems.push(problem),
            }
        }
        products
    }
}

/// What `make` gives; as a problem, what kept `name` from being made: an error or a panic.
fn caught<T, E: Display>(name: &str, make: impl FnOnce() -> Result<T, E>) -> Result<T, String> {
    match catch_unwind(AssertUnwindSafe(make)) {
        Ok(made) => made.map_err(|error| error.to_string()),
        Err(panic) => Err(panicked(name, &*panic)),
    }
}

fn panicked(fold: &str, panic: &(dyn Any + Send)) -> String {
    format!("{fold} panicked: {}", message_of(panic))
}

/// Where in the stack a point lies.
pub fn place(role: Role) -> (ArrayName, usize) {
    match role {
        Role::Sweep(index) => (ArrayName::Sum, index as usize),
        Role::Dark(index) => (ArrayName::Dark, index as usize),
        Role::Regular => (ArrayName::Regular, 0),
    }
}

/// A stored point as the pipeline gave it.
pub(crate) fn unit_of(ordinal: u32, entry: &PointEntry, sum: Array2<u32>) -> Unit {
    Unit {
        id: SettingsId { point: ordinal, attempt: entry.attempt },
        frames: entry.frames,
        exposure_us: entry.exposure_us,
        delays_us: entry.delays_us.clone(),
        last_exposure_ns: None,
        sum: Arc::new(sum),
        counts: entry.counts.clone(),
    }
}
