//! Runs the stages of a plan, demultiplexes their images, and makes products from the transport.

use std::any::Any;
use std::fmt::Display;
use std::panic::{AssertUnwindSafe, catch_unwind};

use ndarray::Array2;
use raysweep_pipeline::{
    Assembly, DEMUX, DemuxFold, Findings, ImageRows, InStrips, NotSolved, Product, ProductSpec, Solved,
    Stages, Strip, SweepStack, SweepSummary, Unit, message_of, run_stages,
};
use raysweep_session::STRIP_ROWS;
use raysweep_session::ledger::State;
use raysweep_session::stack::{ArrayName, Stack, crc32};
use raysweep_transport::plane::Transport;

use super::task::{PlaneTask, place, unit_of};

/// The stages and products of a plan.
pub struct Processing {
    /// Stages, which process each unit alone.
    pub stages: Stages,
    /// Demultiplexes all units; `None` if the plan has no `demux`, or it has panicked.
    pub demux: Option<DemuxFold>,
    /// Products made from the transport.
    pub products: Vec<ProductSpec>,
    /// What has failed so far, and why.
    pub problems: Vec<String>,
}

impl Processing {
    /// Stages alone: the units are not combined.
    pub fn without_demux(stages: Stages) -> Self {
        Self { stages, demux: None, products: Vec::new(), problems: Vec::new() }
    }

    /// Passes stored points through the stages into the demultiplexer, while `go_on` returns true. A point whose stage
    /// fails, or that has been damaged since the session was checked, is left out and listed among the problems.
    pub fn feed_stored(&mut self, task: &PlaneTask, state: &State, stack: &Stack, go_on: &dyn Fn() -> bool) {
        for (ordinal, point) in (0..).zip(&task.schedule.points) {
            let (array, index) = place(point.role);
            let Some(entry) = state.point(array, index).filter(|_| go_on()) else { continue };
            let clipped = entry.clipped_crc32.map(|crc| (ArrayName::Clipped, crc));
            let read = |(array, crc)| match stack.read_point(array, index) {
                Ok(image) if crc32(image.view()) == crc => Ok(image),
                Ok(_) => Err("its checksum differs from the ledger's".to_owned()),
                Err(error) => Err(error.to_string()),
            };
            let sum_and_clipped = read((array, entry.crc32))
                .and_then(|sum| clipped.map(read).transpose().map(|clipped| (sum, clipped)));
            let (sum, clipped) = match sum_and_clipped {
                Ok(read) => read,
                Err(why) => {
                    self.problems.push(format!("{} {index} is damaged ({why})", array.as_str()));
                    continue;
                }
            };
            let unit = unit_of(ordinal, entry, sum, clipped);
            match run_stages(&self.stages, &unit) {
                Ok(image) => self.push(&unit, &image),
                Err(error) => self.problems.push(error.to_string()),
            }
        }
    }

    /// Gives the demultiplexer a unit's image. If it panics, it is dropped, with its products.
    pub fn push(&mut self, unit: &Unit, image: &Array2<f32>) {
        let Some(demux) = &mut self.demux else { return };
        let has_stages = !self.stages.is_empty();
        let push = || {
            demux.push(unit, image.view());
            if has_stages {
                demux.note_filled(unit, image.view());
            }
        };
        if let Err(panic) = catch_unwind(AssertUnwindSafe(push)) {
            self.problems.push(panicked(DEMUX, &*panic));
            self.demux = None;
        }
    }

    /// The sweep so far, if there is enough of it for an estimate.
    pub fn snapshot(&self) -> Option<DemuxFold> {
        self.demux.as_ref()?.snapshot()
    }

    /// Stops keeping images: [`Self::finish_in_strips`] reads them again.
    pub fn keep_no_images(&mut self) {
        if let Some(demux) = &mut self.demux {
            demux.keep_no_images();
        }
    }

    /// [`Self::finish`] and [`Self::make_named`] after [`Self::keep_no_images`]: stack and transport go to `write`,
    /// strip by strip. Also returns what has failed.
    pub fn finish_in_strips(
        self,
        images: &dyn ImageRows,
        go_on: &(dyn Fn() -> bool + Sync),
        write: &mut dyn FnMut(&Findings, &Strip) -> Result<(), String>,
    ) -> (Option<SweepSummary>, Vec<Product>, Vec<String>) {
        let Self { demux, products: specs, mut problems, .. } = self;
        let Some(demux) = demux else { return (None, Vec::new(), problems) };
        let mut assemblies: Vec<Assembly> = specs.into_iter().map(Assembly::new).collect();
        let mut take = |findings: &Findings, strip: Strip| {
            write(findings, &strip).map_err(|what| NotSolved { of: DEMUX, what })?;
            assemblies.retain_mut(|assembly| {
                let Strip { first_row, stack, transport } = &strip;
                let product = assembly.name().to_owned();
                let added = caught(&product, || assembly.add(*first_row, stack, transport));
                added.map_err(|problem| problems.push(problem)).is_ok()
            });
            Ok(())
        };
        let strips = InStrips { images, strip_rows: STRIP_ROWS, take: &mut take };
        let summary = match caught(DEMUX, || demux.finish_in_strips(strips, go_on)) {
            Ok(summary) => summary,
            Err(problem) => {
                problems.push(problem);
                return (None, Vec::new(), problems);
            }
        };
        let mut products = Vec::new();
        for assembly in assemblies {
            let product = assembly.name().to_owned();
            match caught(&product, || assembly.finish()) {
                Ok(product) => products.push(product),
                Err(problem) => problems.push(problem),
            }
        }
        (Some(summary), products, problems)
    }

    /// Computes the transport. Returns early, soon after `go_on` returns false.
    pub fn finish(&mut self, go_on: &(dyn Fn() -> bool + Sync)) -> Option<Solved> {
        let demux = self.demux.take()?;
        let solved = caught(DEMUX, || demux.finish(go_on));
        solved.map_err(|problem| self.problems.push(problem)).ok()
    }

    /// The products that the plan names.
    pub fn make_named(
        &mut self,
        stack: &SweepStack,
        transport: &Transport,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Vec<Product> {
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

fn panicked(name: &str, panic: &(dyn Any + Send)) -> String {
    format!("{name} panicked: {}", message_of(panic))
}
