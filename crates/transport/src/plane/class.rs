//! Camera rows that have the same model: their pixels in tiles that share an objective.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;

use ndarray::{Array2, ArrayView1, ArrayView2, ArrayViewMut2, Axis};
use rayon::prelude::*;

use super::calibrate::FlyingSpot;
use super::pivot::{RUN_PX, Start, minimise};
use super::quadratic::Quadratic;
use super::{PlaneError, Prior, RowModel, SimdLevel, Slot, SlotKind};

/// Pixels that are solved together: as many as keep their vectors in the cache beside the model.
const TILE_PX: usize = 512;

/// Objectives that are held at a time: few enough for the memory, enough for all threads.
const PROBLEMS: usize = 16;

/// Steps, per projector row, of the place of direct light: pixels within one step share an objective.
const SPIKE_STEPS: f32 = 64.0;

/// A camera row's data; columns are those of the image.
pub(super) struct Row<'a> {
    /// `[settings, columns]`
    pub stack: ArrayView2<'a, f32>,
    /// `[settings, columns]`
    pub valid: Option<ArrayView2<'a, bool>>,
    /// `[columns]`
    pub u0_rows: Option<ArrayView1<'a, f32>>,
    /// A flying spot, and the weights `[settings]` of direct light for each part of its width where they are not even.
    pub spot: Option<(&'a FlyingSpot, Vec<Option<Vec<f64>>>)>,
    /// What to start from, `[reach, columns]`.
    pub estimate: Option<ArrayView2<'a, f32>>,
    /// The result, `[reach, columns]`.
    pub profiles: ArrayViewMut2<'a, f32>,
}

/// Solves camera rows that have the same model.
pub(super) struct ClassSolver<'a> {
    model: &'a RowModel,
    prior: &'a Prior,
    simd: SimdLevel,
    /// Where in the reach each slot's value goes.
    places: Vec<Option<usize>>,
}

/// Where and when direct light arrives: the place in steps, and its weights as bits where they are not even.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Direct {
    step: i32,
    weights: Option<Vec<u64>>,
}

/// A row, and its columns by their direct light.
struct Grouped<'r, 'a> {
    row: &'r mut Row<'a>,
    groups: BTreeMap<Direct, Vec<usize>>,
}

/// The objective of pixels with the same direct light and the same valid samples.
struct Problem {
    /// Which of the stack's settings count.
    settings: Vec<usize>,
    /// `[settings, slots]`
    weights: Array2<f64>,
    quadratic: Quadratic,
    spike: Option<Spike>,
}

/// Direct light between rows: one unknown, in the slot of row 0, that stands for light in two rows.
#[derive(Clone, Copy)]
struct Spike {
    /// The slot of row 0.
    own: usize,
    /// The slot of the row on the other side, if the projector has it.
    neighbour: Option<usize>,
    /// The neighbour's share of the light.
    share: f64,
}

/// Pixels that share an objective, each as the index of its row and its column.
#[derive(Default)]
struct Tile {
    pixels: Vec<(usize, usize)>,
    /// Lengths of the runs that they come in: neighbours in one row, so that an image which is solved in parts is solved as
    /// it would be in one.
    runs: Vec<usize>,
}

impl<'a> ClassSolver<'a> {
    /// A solver for the rows of this model.
    pub fn new(model: &'a RowModel, prior: &'a Prior, reach: &RangeInclusive<i32>, simd: SimdLevel) -> Self {
        let place = |slot: &Slot| (slot.kind == SlotKind::Own).then(|| (slot.u - reach.start()) as usize);
        Self { model, prior, simd, places: model.slots.iter().map(place).collect() }
    }

    /// Weight of a pixel's own row in each setting; nothing where the projector has no such row.
    pub fn direct_weights(&self) -> Option<ArrayView1<'_, f64>> {
        Some(self.model.weights.column(slot_of(self.model, 0)?))
    }

    /// Solves all pixels of some rows for as long as `go_on` says yes.
    ///
    /// # Errors
    /// [`PlaneError::NotConvex`]; [`PlaneError::Stopped`].
    pub fn solve(&self, rows: &mut [Row], go_on: &(dyn Fn() -> bool + Sync)) -> Result<(), PlaneError> {
        // Rows of narrow images fill a tile together.
        let columns = rows.first().map_or(1, |row| row.stack.ncols().max(1));
        let tile_rows = (TILE_PX / columns).max(1);
        let mut rows: Vec<Grouped> = rows.iter_mut().map(Grouped::new).collect();
        let directs: BTreeSet<Direct> = rows.iter().flat_map(|row| row.groups.keys().cloned()).collect();
        let directs: Vec<Direct> = directs.into_iter().collect();
        for directs in directs.chunks(PROBLEMS) {
            let problems: Vec<Problem> = directs
                .par_iter()
                .map(|direct| Problem::new(self.model, self.prior, direct))
                .collect::<Result<_, _>>()?;
            rows.par_chunks_mut(tile_rows).try_for_each(|rows| {
                directs.iter().zip(&problems).try_for_each(|(direct, problem)| match go_on() {
                    true => self.solve_group(problem, direct, rows),
                    false => Err(PlaneError::Stopped),
                })
            })?;
        }
        Ok(())
    }

    /// Solves the pixels of these rows that have this direct light.
    fn solve_group(
        &self,
        problem: &Problem,
        direct: &Direct,
        rows: &mut [Grouped],
    ) -> Result<(), PlaneError> {
        let mut tile = Tile::default();
        for at in 0..rows.len() {
            let Some(columns) = rows[at].groups.remove(direct) else { continue };
            let valid = rows[at].row.valid;
            let is_whole =
                |column: &usize| valid.is_none_or(|valid| valid.column(*column).iter().all(|v| *v));
            let (whole, masked): (Vec<usize>, Vec<usize>) =
                columns.iter().partition(|column| is_whole(column));
            for columns in whole.chunks(TILE_PX) {
                tile.add(at, columns);
                if tile.pixels.len() >= TILE_PX {
                    self.solve_tile(problem, &std::mem::take(&mut tile), rows);
                }
            }
            if let Some(valid) = valid {
                self.solve_masked(problem, valid, at, &masked, rows)?;
            }
        }
        self.solve_tile(problem, &tile, rows);
        Ok(())
    }

    /// Solves pixels that lack samples. Neighbouring pixels of a highlight mostly lack the same ones.
    fn solve_masked(
        &self,
        problem: &Problem,
        valid: ArrayView2<bool>,
        at: usize,
        columns: &[usize],
        rows: &mut [Grouped],
    ) -> Result<(), PlaneError> {
        for alike in columns.chunk_by(|&a, &b| valid.column(a) == valid.column(b)) {
            let problem = problem.masked(valid.column(alike[0]), self.model, self.prior)?;
            let mut tile = Tile::default();
            tile.add(at, alike);
            self.solve_tile(&problem, &tile, rows);
        }
        Ok(())
    }

    fn solve_tile(&self, problem: &Problem, tile: &Tile, rows: &mut [Grouped]) {
        let Problem { settings, weights, quadratic, spike } = problem;
        let Tile { pixels, runs } = tile;
        let mut samples = Array2::zeros((pixels.len(), settings.len()));
        for (samples, &setting) in samples.columns_mut().into_iter().zip(settings) {
            for (sample, &(at, column)) in samples.into_iter().zip(pixels) {
                *sample = f64::from(rows[at].row.stack[[setting, column]]);
            }
        }
        let linear = quadratic.linear(weights.view(), samples.view());
        let free = rows.iter().all(|Grouped { row, .. }| row.estimate.is_some()).then(|| {
            Array2::from_shape_fn(linear.dim(), |(pixel, slot)| {
                let (at, column) = pixels[pixel];
                let estimate = self.places[slot].zip(rows[at].row.estimate);
                estimate.is_none_or(|(place, estimate)| estimate[[place, column]] > 0.0)
            })
        });
        let start = free.as_ref().map_or(Start::Runs(runs), |free| Start::Free(free.view()));
        let minima = minimise(self.simd, quadratic, linear, &start);

        for (minima, place) in minima.columns().into_iter().zip(&self.places) {
            let Some(place) = *place else { continue };
            for (&x, &(at, column)) in minima.iter().zip(pixels) {
                rows[at].row.profiles[[place, column]] = x as f32;
            }
        }
        if let Some(Spike { own, neighbour, share }) = *spike {
            let [own_place, neighbour] = [Some(own), neighbour].map(|slot| self.places[slot?]);
            for (&direct, &(at, column)) in minima.column(own).iter().zip(pixels) {
                let profiles = &mut rows[at].row.profiles;
                own_place
                    .into_iter()
                    .for_each(|own| profiles[[own, column]] = (direct * (1.0 - share)) as f32);
                neighbour.into_iter().for_each(|place| profiles[[place, column]] += (direct * share) as f32);
            }
        }
    }
}

impl<'r, 'a> Grouped<'r, 'a> {
    fn new(row: &'r mut Row<'a>) -> Self {
        let mut by_part: BTreeMap<(i32, Option<usize>), Vec<usize>> = BTreeMap::new();
        for column in 0..row.stack.ncols() {
            let step = row.u0_rows.map_or(0.0, |u0_rows| (u0_rows[column] * SPIKE_STEPS).round());
            let part = row.spot.as_ref().map(|(spot, weights)| (spot.part(column), weights));
            let uneven = part.and_then(|(part, weights)| weights[part].as_ref().map(|_| part));
            by_part.entry((step as i32, uneven)).or_default().push(column);
        }
        // Parts of rows that are drawn alike have the same weights.
        let mut groups: BTreeMap<Direct, Vec<usize>> = BTreeMap::new();
        for ((step, part), columns) in by_part {
            let weights = part.zip(row.spot.as_ref()).and_then(|(part, (_, weights))| weights[part].as_ref());
            let weights = weights.map(|weights| weights.iter().map(|weight| weight.to_bits()).collect());
            groups.entry(Direct { step, weights }).or_default().extend(columns);
        }
        Self { row, groups }
    }
}

impl Tile {
    fn add(&mut self, row: usize, columns: &[usize]) {
        self.pixels.extend(columns.iter().map(|&column| (row, column)));
        self.runs.extend(columns.chunks(RUN_PX).map(<[usize]>::len));
    }
}

impl Problem {
    fn new(model: &RowModel, prior: &Prior, direct: &Direct) -> Result<Self, PlaneError> {
        let mut weights = model.weights.clone();
        let own = slot_of(model, 0);
        if let Some((own, direct)) = own.zip(direct.weights.as_ref()) {
            weights.column_mut(own).iter_mut().zip(direct).for_each(|(to, &bits)| *to = f64::from_bits(bits));
        }
        let spike = own.filter(|_| direct.step != 0).map(|own| Spike {
            own,
            neighbour: slot_of(model, direct.step.signum()),
            share: f64::from(direct.step.unsigned_abs()) / f64::from(SPIKE_STEPS),
        });
        if let Some(Spike { own, neighbour, share }) = spike {
            let other = neighbour.map(|neighbour| weights.column(neighbour).to_owned());
            let mut column = weights.column_mut(own);
            column *= 1.0 - share;
            other.into_iter().for_each(|other| column.scaled_add(share, &other));
        }
        let quadratic = Quadratic::new(weights.view(), &model.slots, prior)?;
        Ok(Self { settings: (0..weights.nrows()).collect(), weights, quadratic, spike })
    }

    /// The same for pixels of which only some samples are valid.
    fn masked(&self, valid: ArrayView1<bool>, model: &RowModel, prior: &Prior) -> Result<Self, PlaneError> {
        let (settings, dropped): (Vec<usize>, Vec<usize>) = self.settings.iter().partition(|&&n| valid[n]);
        let weights = self.weights.select(Axis(0), &settings);
        let downdated = self.quadratic.without(self.weights.select(Axis(0), &dropped).view());
        let quadratic = match downdated {
            Some(quadratic) => quadratic,
            None => Quadratic::new(weights.view(), &model.slots, prior)?,
        };
        Ok(Self { settings, weights, quadratic, spike: self.spike })
    }
}

fn slot_of(model: &RowModel, u: i32) -> Option<usize> {
    model.slots.iter().position(|slot| *slot == Slot { u, kind: SlotKind::Own })
}
