//! Runs the stages and folds of a plan, and makes products from their results.

use std::any::Any;
use std::fmt::Display;
use std::panic::{AssertUnwindSafe, catch_unwind};

use ndarray::Array2;
use raysweep_core::SettingsId;
use raysweep_pipeline::{
    Assembly, Findings, Fold, FoldError, ImageRows, InStrips, Product, ProductSpec, Snapshot, Strip, Unit,
    message_of, run_stages,
};
use raysweep_session::STRIP_ROWS;
use raysweep_session::ledger::State;
use raysweep_session::stack::{Stack, crc32};

use super::{PlaneTask, Stages, place, unit_of};

/// The stages, folds and products of a plan.
pub struct Processing {
    /// Stages, which process each unit alone.
    pub stages: Stages,
    /// Folds, which process all units in order.
    pub folds: Vec<Box<dyn Fold>>,
    /// Products made from the transport of the folds.
    pub products: Vec<ProductSpec>,
    /// What has failed so far, and why.
    pub problems: Vec<String>,
}

impl Processing {
    /// Stages alone: the units are not combined.
    pub fn without_folds(stages: Stages) -> Self {
        Self { stages, folds: Vec::new(), products: Vec::new(), problems: Vec::new() }
    }

    /// Passes stored points through the stages into the folds, while `go_on` returns true. A point whose stage fails
    /// is left out and listed among the problems; so are points with damaged data, which are returned because they
    /// must be acquired again.
    pub fn feed_stored(
        &mut self,
        task: &PlaneTask,
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
                        .map_or("its checksum differs from the ledger's".into(), |error| error.to_string());
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

    /// Gives the folds a unit's image. A fold that panics is dropped, with its products; the others continue.
    pub fn push(&mut self, unit: &Unit, image: &Array2<f32>) {
        let problems = &mut self.problems;
        self.folds.retain_mut(|fold| {
            let pushed = catch_unwind(AssertUnwindSafe(|| fold.push(unit, image.view())));
            pushed.map_err(|panic| problems.push(panicked(fold.name(), &*panic))).is_ok()
        });
    }

    /// Snapshot of the first fold that provides interim estimates.
    pub fn snapshot(&self) -> Option<Box<dyn Snapshot>> {
        // A failed snapshot must not cost the fold, let alone the run.
        self.folds.iter().find_map(|fold| catch_unwind(AssertUnwindSafe(|| fold.snapshot())).ok().flatten())
    }

    /// Stops the folds from keeping images: [`Self::finish_in_strips`] reads them again.
    pub fn keep_no_images(&mut self) {
        self.folds.iter_mut().for_each(|fold| fold.keep_no_images());
    }

    /// [`Self::finish`] and [`Self::make_named`] after [`Self::keep_no_images`]: the transport goes to `write`, strip
    /// by strip, and is not among the products.
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
                    // Drop images that lack rows.
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

    /// The products of all folds. Returns early, soon after `go_on` returns false.
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

    /// The products that the plan names, if the folds have made what they need.
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

/// Runs `make`; turns an error or a panic into a problem that says what kept `name` from being made.
fn caught<T, E: Display>(name: &str, make: impl FnOnce() -> Result<T, E>) -> Result<T, String> {
    match catch_unwind(AssertUnwindSafe(make)) {
        Ok(made) => made.map_err(|error| error.to_string()),
        Err(panic) => Err(panicked(name, &*panic)),
    }
}

fn panicked(fold: &str, panic: &(dyn Any + Send)) -> String {
    format!("{fold} panicked: {}", message_of(panic))
}
