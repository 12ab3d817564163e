//! Divides an image's pixels into tiles that share an objective, for [`super::Demux`] and
//! [`super::super::Uncertainty`].

use std::collections::{BTreeMap, BTreeSet};
use std::ops::RangeInclusive;
use std::sync::OnceLock;

use ndarray::{Array1, Array2, ArrayView1, ArrayView2, Axis, s};
use rayon::prelude::*;

use super::super::PlaneError;
use super::super::model::{FlyingSpot, MIN_WEIGHT, RowModel, RowTiming, Setting, Slot, SlotKind};
use super::Prior;
use super::pivot::RUN_PX;
use super::quadratic::Quadratic;

/// Number of pixels that are solved together: their vectors fit in the cache together with the model.
const TILE_PX: usize = 512;

/// Number of objectives held at a time: few enough for the memory, enough for all threads.
const PROBLEMS: usize = 16;

/// Steps of the position of direct light per projector row: pixels within one step share an objective.
const SPIKE_STEPS: f32 = 64.0;

/// Rows as near as this to the pixel's own are told apart only by exposures that begin or end there.
const NEAR_ROWS: i32 = 2;

/// Memory in bytes for the objectives held at a time when solving on `threads` threads, for pixels that see
/// `reach_rows` projector rows: for each its matrix, the inverse, and the settings' weights or their inputs.
pub fn objectives_bytes(reach_rows: u64, threads: u64) -> u64 {
    let matrix_bytes = 8 * reach_rows.pow(2);
    3 * matrix_bytes * PROBLEMS as u64 * threads
}

/// The inputs of the objectives of all pixels.
#[derive(Clone, Copy)]
pub struct Objectives<'a> {
    pub timing: &'a RowTiming,
    /// The settings of the stack; the bracket's follows them if there is one.
    pub settings: &'a [Setting],
    /// The level of the bracket's light, as a share of white.
    pub bracket_light: Option<f64>,
    pub prior: Prior,
    pub reach: &'a RangeInclusive<i32>,
    pub spot: Option<&'a FlyingSpot>,
}

/// A camera row and the data to process.
pub struct Row<'a, T> {
    /// Its index in the camera.
    t: usize,
    columns: usize,
    /// `[settings, columns]`
    valid: Option<ArrayView2<'a, bool>>,
    /// `[columns]`
    u0_rows: Option<ArrayView1<'a, f32>>,
    pub data: T,
    /// Columns grouped by their direct light, once it is known.
    groups: BTreeMap<Direct, Vec<usize>>,
}

/// Position and time of direct light: the position in steps, and its weights as bits if the row is not lit evenly.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Direct {
    step: i32,
    weights: Option<Vec<u64>>,
}

/// The objective of pixels with the same direct light and the same samples.
pub struct Problem<'a> {
    pub model: &'a RowModel,
    /// The indices of the samples in use: settings of the stack, and possibly the bracket after them.
    pub settings: Vec<usize>,
    /// Of these samples, `[samples, slots]`.
    pub weights: Array2<f64>,
    pub quadratic: Quadratic,
    pub spike: Option<Spike>,
    bracket: Option<BracketRow>,
}

/// The part of a bracket in a [`Problem`].
struct BracketRow {
    /// Weight of its squared error; 1 for an image of the stack. It is the level of its light, because the variance of
    /// shot noise, in units of white, is that much larger.
    light: f64,
    /// `[slots]`
    weights: Array1<f64>,
    /// The objective of all samples and the bracket, once a pixel has needed it.
    quadratic: OnceLock<Result<Quadratic, PlaneError>>,
}

/// Direct light between two rows: one unknown, in the slot of row 0, that represents light in both rows.
#[derive(Clone, Copy)]
pub struct Spike {
    /// The slot of row 0.
    pub own: usize,
    /// The slot of the row on the other side, if the projector has this row.
    pub neighbour: Option<usize>,
    /// The neighbour's share of the light.
    pub share: f64,
}

/// Pixels that share an objective, each given by the index of its row and its column.
#[derive(Default)]
pub struct Tile {
    pub pixels: Vec<(usize, usize)>,
    /// Lengths of the runs of pixels: neighbours in one row, so that an image solved in parts gives the same result
    /// as one solved as a whole.
    pub runs: Vec<usize>,
    /// Which samples of the stack are exact, `[settings]`, the same in all pixels; `None` if all are. The others are
    /// lower bounds.
    pub valid: Option<Array1<bool>>,
}

/// The processing of a tile, whose pixels lie in these rows.
pub trait TileWork<T>: Fn(&Problem, &Tile, &mut [Row<T>]) -> Result<(), PlaneError> + Sync {}
impl<T, F: Fn(&Problem, &Tile, &mut [Row<T>]) -> Result<(), PlaneError> + Sync> TileWork<T> for F {}

impl Objectives<'_> {
    /// Calls `work` for all pixels of some camera rows, ascending, for as long as `go_on` returns true. Tiles are
    /// processed in parallel. The run of each pixel does not depend on which rows are combined.
    ///
    /// # Errors
    /// Those of `work`; [`PlaneError::NotConvex`]; [`PlaneError::Stopped`].
    pub fn for_each_tile<T: Send>(
        &self,
        rows: &mut [Row<T>],
        go_on: &(dyn Fn() -> bool + Sync),
        work: &impl TileWork<T>,
    ) -> Result<(), PlaneError> {
        if self.timing.response().is_some() {
            rows.iter().try_for_each(|row| self.timing.check_columns(row.columns))?;
            return rows.par_iter_mut().try_for_each(|row| self.for_responding_row(row, go_on, work));
        }
        // Neighbouring rows with the same model form a class. Classes are processed one at a time, so that factors
        // are kept no longer than needed.
        let mut classes: Vec<(RowModel, &mut [Row<T>])> = Vec::new();
        let mut rest = rows;
        while let Some(first) = rest.first() {
            let model = self.model(first.t);
            let alike = rest.iter().take_while(|row| row.t == first.t || self.model(row.t) == model).count();
            let (class, after) = rest.split_at_mut(alike);
            classes.push((model, class));
            rest = after;
        }
        classes.into_par_iter().try_for_each(|(model, rows)| self.for_class(&model, rows, go_on, work))
    }

    fn model(&self, t: usize) -> RowModel {
        RowModel::new(self.timing, self.settings, self.reach, t)
    }

    /// Processes a row whose pixels have responses: those that look at the same place between rows share an objective.
    /// Direct light lies at `u = 0` by definition.
    fn for_responding_row<T>(
        &self,
        row: &mut Row<T>,
        go_on: &(dyn Fn() -> bool + Sync),
        work: &impl TileWork<T>,
    ) -> Result<(), PlaneError> {
        let direct = Direct { step: 0, weights: None };
        let models = RowModel::of_pixels(self.timing, self.settings, self.reach, row.t, row.columns);
        for (model, columns) in models {
            if !go_on() {
                return Err(PlaneError::Stopped);
            }
            let problem = self.problem(&model, &direct)?;
            row.groups.insert(direct.clone(), columns);
            self.for_group(&problem, &direct, std::slice::from_mut(row), work)?;
        }
        Ok(())
    }

    /// Processes rows with the same model.
    fn for_class<T: Send>(
        &self,
        model: &RowModel,
        rows: &mut [Row<T>],
        go_on: &(dyn Fn() -> bool + Sync),
        work: &impl TileWork<T>,
    ) -> Result<(), PlaneError> {
        for row in &mut *rows {
            row.groups = self.group(model, row)?;
        }
        let directs: BTreeSet<Direct> = rows.iter().flat_map(|row| row.groups.keys().cloned()).collect();
        let directs: Vec<Direct> = directs.into_iter().collect();
        // Rows of narrow images share a tile.
        let columns = rows.first().map_or(1, |row| row.columns.max(1));
        let tile_rows = (TILE_PX / columns).max(1);
        for directs in directs.chunks(PROBLEMS) {
            let problems: Vec<Problem> =
                directs.par_iter().map(|direct| self.problem(model, direct)).collect::<Result<_, _>>()?;
            rows.par_chunks_mut(tile_rows).try_for_each(|rows| {
                directs.iter().zip(&problems).try_for_each(|(direct, problem)| match go_on() {
                    true => self.for_group(problem, direct, rows, work),
                    false => Err(PlaneError::Stopped),
                })
            })?;
        }
        Ok(())
    }

    /// Processes the pixels of these rows that have this direct light.
    fn for_group<T>(
        &self,
        problem: &Problem,
        direct: &Direct,
        rows: &mut [Row<T>],
        work: &impl TileWork<T>,
    ) -> Result<(), PlaneError> {
        let mut tile = Tile::default();
        for at in 0..rows.len() {
            let Some(columns) = rows[at].groups.remove(direct) else { continue };
            let valid = rows[at].valid;
            let is_whole =
                |column: &usize| valid.is_none_or(|valid| valid.column(*column).iter().all(|v| *v));
            let (whole, masked): (Vec<usize>, Vec<usize>) =
                columns.iter().partition(|column| is_whole(column));
            for columns in whole.chunks(TILE_PX) {
                tile.add(at, columns);
                if tile.pixels.len() >= TILE_PX {
                    work(problem, &std::mem::take(&mut tile), rows)?;
                }
            }
            let Some(valid) = valid else { continue };
            // Neighbouring pixels of a highlight mostly lack the same samples.
            for alike in masked.chunk_by(|&a, &b| valid.column(a) == valid.column(b)) {
                let mut tile = Tile { valid: Some(valid.column(alike[0]).to_owned()), ..Tile::default() };
                tile.add(at, alike);
                work(problem, &tile, rows)?;
            }
        }
        work(problem, &tile, rows)
    }

    /// The objective of pixels of this model with this direct light.
    fn problem<'a>(&self, model: &'a RowModel, direct: &Direct) -> Result<Problem<'a>, PlaneError> {
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
        let last = weights.nrows() - 1;
        let bracket = self.bracket_light.map(|light| {
            let of_bracket = weights.row(last).to_owned();
            weights.remove_index(Axis(0), last);
            BracketRow { light, weights: of_bracket, quadratic: OnceLock::new() }
        });
        let quadratic = Quadratic::new(weights.view(), &model.slots, &self.prior)?;
        Ok(Problem { model, settings: (0..weights.nrows()).collect(), weights, quadratic, spike, bracket })
    }

    /// Groups the columns of a row by position and time of their direct light.
    fn group<T>(&self, model: &RowModel, row: &Row<T>) -> Result<BTreeMap<Direct, Vec<usize>>, PlaneError> {
        let own = slot_of(model, 0);
        let uneven = match self.spot.zip(own) {
            Some((spot, own)) => {
                let even = model.weights.column(own);
                Some((spot, spot.weights(self.timing, self.settings, row.t, even)?))
            }
            None => None,
        };
        let mut by_part: BTreeMap<(i32, Option<usize>), Vec<usize>> = BTreeMap::new();
        for column in 0..row.columns {
            let u0_rows = row.u0_rows.filter(|_| own.is_some()).map_or(0.0, |u0_rows| u0_rows[column]);
            let part = uneven.as_ref().map(|(spot, weights)| (spot.part(row.t, column), weights));
            let part = part.and_then(|(part, weights)| weights[part].as_ref().map(|_| part));
            by_part.entry(((u0_rows * SPIKE_STEPS).round() as i32, part)).or_default().push(column);
        }
        // Parts that are drawn in the same way have the same weights, in other rows too.
        let mut groups: BTreeMap<Direct, Vec<usize>> = BTreeMap::new();
        for ((step, part), columns) in by_part {
            let weights = part.zip(uneven.as_ref()).and_then(|(part, (_, weights))| weights[part].as_ref());
            let weights = weights.map(|weights| weights.iter().map(|weight| weight.to_bits()).collect());
            groups.entry(Direct { step, weights }).or_default().extend(columns);
        }
        Ok(groups)
    }
}

impl<'a, T> Row<'a, T> {
    /// A camera row of `columns` columns. `valid`, `[settings, columns]`, tells which samples are used; `u0_rows`,
    /// `[columns]`, is the position of direct light.
    pub fn new(
        t: usize,
        columns: usize,
        valid: Option<ArrayView2<'a, bool>>,
        u0_rows: Option<ArrayView1<'a, f32>>,
        data: T,
    ) -> Self {
        Self { t, columns, valid, u0_rows, data, groups: BTreeMap::new() }
    }
}

impl Tile {
    fn add(&mut self, row: usize, columns: &[usize]) {
        self.pixels.extend(columns.iter().map(|&column| (row, column)));
        self.runs.extend(columns.chunks(RUN_PX).map(<[usize]>::len));
    }
}

impl<'a> Problem<'a> {
    /// The same problem for pixels with only some of the samples: `used`, `[settings]` or one more for the bracket.
    pub fn of_samples(&self, used: ArrayView1<bool>, prior: &Prior) -> Result<Self, PlaneError> {
        let bracket =
            self.bracket.as_ref().filter(|_| used.len() > self.settings.len() && used[used.len() - 1]);
        let rows = self.rows();
        let rows = if bracket.is_some() { rows.view() } else { rows.slice(s![..self.settings.len(), ..]) };
        let whole = match bracket {
            None => &self.quadratic,
            Some(bracket) => bracket
                .quadratic
                .get_or_init(|| Quadratic::new(rows, &self.model.slots, prior))
                .as_ref()
                .map_err(Clone::clone)?,
        };
        let (settings, dropped): (Vec<usize>, Vec<usize>) = (0..rows.nrows()).partition(|&n| used[n]);
        let weights = rows.select(Axis(0), &settings);
        let quadratic = if dropped.is_empty() {
            whole.clone()
        } else {
            match whole.without(rows.select(Axis(0), &dropped).view()) {
                Some(quadratic) => quadratic,
                None => Quadratic::new(weights.view(), &self.model.slots, prior)?,
            }
        };
        Ok(Self { model: self.model, settings, weights, quadratic, spike: self.spike, bracket: None })
    }

    /// The weights of all samples as they enter the objective, `[samples, slots]`: those of the stack, then the
    /// bracket's, scaled by [`Self::bracket_scale`].
    pub fn rows(&self) -> Array2<f64> {
        let mut rows = self.weights.clone();
        if let Some(BracketRow { weights, .. }) = &self.bracket {
            let scaled = weights * self.bracket_scale();
            rows.append(Axis(0), scaled.insert_axis(Axis(0)).view()).unwrap_or_default();
        }
        rows
    }

    /// Factor of the bracket's sample and weights in the objective.
    pub fn bracket_scale(&self) -> f64 {
        self.bracket.as_ref().map_or(1.0, |bracket| bracket.light.sqrt())
    }

    /// Which slots a pixel knows only as lower bounds: some sample sees them, but no exact one does. `valid` tells
    /// which samples are exact, `[settings]`, or one more for the bracket.
    pub fn lower_bounds(&self, valid: ArrayView1<bool>) -> Vec<bool> {
        let rows = self.rows();
        let scale = |n: usize| if n < self.settings.len() { 1.0 } else { self.bracket_scale() };
        let sees = |n: usize, slot: usize| rows[[n, slot]] >= MIN_WEIGHT * scale(n);
        let seen = |slot: usize, exact: bool| (0..valid.len()).any(|n| valid[n] == exact && sees(n, slot));
        (0..rows.ncols()).map(|slot| !seen(slot, true) && seen(slot, false)).collect()
    }

    /// Whether some exposure begins or ends so near the pixel's own row that it tells the rows `|u| <= 2` apart.
    pub fn has_edge(&self) -> bool {
        let own = |slot: &Slot| slot.kind == SlotKind::Own && slot.u.abs() <= NEAR_ROWS;
        let near: Vec<usize> = (0..self.weights.ncols()).filter(|&n| own(&self.model.slots[n])).collect();
        self.weights.rows().into_iter().any(|weights| {
            let of_near = near.iter().map(|&slot| weights[slot]);
            let (least, most) =
                of_near.fold((f64::INFINITY, 0.0_f64), |(least, most), w| (least.min(w), most.max(w)));
            most - least >= MIN_WEIGHT
        })
    }

    /// The slots that are part of the profile, `[slot, relative row - u_min]`.
    pub fn places(&self, u_min: i32) -> impl Iterator<Item = (usize, usize)> {
        let own = self.model.slots.iter().enumerate().filter(|(_, slot)| slot.kind == SlotKind::Own);
        own.map(move |(slot, own)| (slot, (own.u - u_min) as usize))
    }
}

fn slot_of(model: &RowModel, u: i32) -> Option<usize> {
    model.slots.iter().position(|slot| *slot == Slot { u, kind: SlotKind::Own })
}
