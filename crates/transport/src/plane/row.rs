//! One camera row: its pixels in groups that share a model.

use std::collections::BTreeMap;
use std::ops::RangeInclusive;

use ndarray::{Array2, ArrayView1, ArrayView2, ArrayViewMut2, Axis};

use super::calibrate::FlyingSpot;
use super::lanes::Lanes;
use super::pivot::{Outcome, Pivoting};
use super::quadratic::Quadratic;
use super::{PlaneError, Prior, RowModel, SimdLevel, Slot, SlotKind, reference};

/// Pixels that are solved together: as many as keep their vectors in the cache beside the model.
const TILE_PX: usize = 512;

/// Steps, per projector row, of the place of direct light: pixels within one step share a model.
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
    pub spot: Option<(&'a FlyingSpot, &'a [Option<Vec<f64>>])>,
    /// What to start from, `[reach, columns]`.
    pub estimate: Option<ArrayView2<'a, f32>>,
    /// The result, `[reach, columns]`.
    pub profiles: ArrayViewMut2<'a, f32>,
}

/// Solves camera rows that have the same model.
pub(super) struct RowSolver<'a> {
    model: &'a RowModel,
    prior: &'a Prior,
    simd: SimdLevel,
    /// Where in the reach each slot's value goes.
    places: Vec<Option<usize>>,
    /// Of pixels whose direct light lies in their own row.
    centred: Problem,
}

/// The objective of pixels whose direct light lies in the same place.
struct Problem {
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

impl<'a> RowSolver<'a> {
    /// Factors the model of a class of rows.
    ///
    /// # Errors
    /// [`PlaneError::NotConvex`].
    pub fn new(
        model: &'a RowModel,
        prior: &'a Prior,
        reach: &RangeInclusive<i32>,
        simd: SimdLevel,
    ) -> Result<Self, PlaneError> {
        let place = |slot: &Slot| (slot.kind == SlotKind::Own).then(|| (slot.u - reach.start()) as usize);
        let centred = Problem::new(model, prior, None, None)?;
        Ok(Self { model, prior, simd, places: model.slots.iter().map(place).collect(), centred })
    }

    /// Solves all pixels of a row.
    ///
    /// # Errors
    /// [`PlaneError::NotConvex`].
    pub fn solve(&self, mut row: Row) -> Result<(), PlaneError> {
        // By where and when direct light arrives.
        let mut groups: BTreeMap<(i32, Option<usize>), Vec<usize>> = BTreeMap::new();
        for column in 0..row.stack.ncols() {
            let step = row.u0_rows.map_or(0.0, |u0_rows| (u0_rows[column] * SPIKE_STEPS).round());
            let uneven = row.spot.map(|(spot, weights)| (spot.part(column), weights));
            let part = uneven.and_then(|(part, weights)| weights[part].as_ref().map(|_| part));
            groups.entry((step as i32, part)).or_default().push(column);
        }
        for ((step, part), columns) in groups {
            let spike = self.spike(step as f32 / SPIKE_STEPS);
            let direct = part.zip(row.spot).and_then(|(part, (_, weights))| weights[part].as_deref());
            if spike.is_none() && direct.is_none() {
                self.solve_group(&self.centred, &columns, &mut row)?;
            } else {
                let problem = Problem::new(self.model, self.prior, direct, spike)?;
                self.solve_group(&problem, &columns, &mut row)?;
            }
        }
        Ok(())
    }

    /// Weight of the pixel's own row in each setting; nothing where the projector has no such row.
    pub fn direct_weights(&self) -> Option<ArrayView1<'_, f64>> {
        Some(self.model.weights.column(slot_of(self.model, 0)?))
    }

    fn spike(&self, u0_rows: f32) -> Option<Spike> {
        let own = slot_of(self.model, 0).filter(|_| u0_rows != 0.0)?;
        let neighbour = slot_of(self.model, u0_rows.signum() as i32);
        Some(Spike { own, neighbour, share: f64::from(u0_rows.abs()) })
    }

    fn solve_group(&self, problem: &Problem, columns: &[usize], row: &mut Row) -> Result<(), PlaneError> {
        let whole =
            |column: usize| row.valid.is_none_or(|valid| valid.column(column).iter().all(|valid| *valid));
        let (whole, masked): (Vec<usize>, Vec<usize>) = columns.iter().partition(|&&column| whole(column));
        whole.chunks(TILE_PX).for_each(|tile| self.solve_tile(problem, tile, row));
        self.solve_masked(problem, &masked, row)
    }

    /// Solves pixels that have all samples.
    fn solve_tile(&self, problem: &Problem, columns: &[usize], row: &mut Row) {
        let Problem { weights, quadratic, .. } = problem;
        let intensities = Array2::from_shape_fn((columns.len(), weights.nrows()), |(pixel, setting)| {
            f64::from(row.stack[[setting, columns[pixel]]])
        });
        let linear = quadratic.linear(weights.view(), intensities.view());
        let unconstrained = linear.dot(&quadratic.inverse());
        let start = row.estimate.map(|estimate| {
            Array2::from_shape_fn(linear.dim(), |(pixel, slot)| {
                self.places[slot].is_none_or(|place| estimate[[place, columns[pixel]]] > 0.0)
            })
        });
        let profiles = &mut row.profiles;
        let given_up = self.simd.run(Lanes {
            quadratic,
            linear: linear.view(),
            unconstrained: unconstrained.view(),
            start: start.as_ref().map(|start| start.view()),
            minimum: |pixel: usize, x: &mut dyn Iterator<Item = f64>| {
                self.write(problem, x, columns[pixel], profiles);
            },
        });
        for pixel in given_up {
            let x = reference::minimise(quadratic.h(), &linear.row(pixel).to_vec());
            self.write(problem, &mut x.into_iter(), columns[pixel], profiles);
        }
    }

    /// Solves pixels that lack samples, each with a model of its own. Neighbouring pixels of a highlight mostly lack the
    /// same ones.
    fn solve_masked(&self, problem: &Problem, columns: &[usize], row: &mut Row) -> Result<(), PlaneError> {
        let Some(valid) = row.valid else { return Ok(()) };
        let mut pivoting = Pivoting::new(self.model.slots.len());
        let mut last: Option<(Vec<usize>, Array2<f64>, Quadratic)> = None;
        for &column in columns {
            let (used, dropped): (Vec<usize>, Vec<usize>) =
                (0..valid.nrows()).partition(|&setting| valid[[setting, column]]);
            let known = last.take().filter(|(settings, ..)| *settings == used);
            let (_, weights, quadratic) = match known {
                Some(known) => last.insert(known),
                None => {
                    let weights = problem.weights.select(Axis(0), &used);
                    let downdated =
                        problem.quadratic.without(problem.weights.select(Axis(0), &dropped).view());
                    let quadratic = match downdated {
                        Some(quadratic) => quadratic,
                        None => Quadratic::new(weights.view(), &self.model.slots, self.prior)?,
                    };
                    last.insert((used.clone(), weights, quadratic))
                }
            };
            let samples =
                Array2::from_shape_fn((1, used.len()), |(_, n)| f64::from(row.stack[[used[n], column]]));
            let linear = quadratic.linear(weights.view(), samples.view());
            let unconstrained = linear.dot(&quadratic.inverse()).into_raw_vec_and_offset().0;
            let c = linear.into_raw_vec_and_offset().0;
            let x = match pivoting.minimise(quadratic, &c, &unconstrained) {
                Outcome::Minimum => pivoting.x.clone(),
                Outcome::GaveUp => reference::minimise(quadratic.h(), &c),
            };
            self.write(problem, &mut x.into_iter(), column, &mut row.profiles);
        }
        Ok(())
    }

    /// Puts a pixel's minimum into its profile.
    fn write(
        &self,
        problem: &Problem,
        x: &mut dyn Iterator<Item = f64>,
        column: usize,
        profiles: &mut ArrayViewMut2<f32>,
    ) {
        let mut direct = 0.0;
        for ((slot, place), x) in self.places.iter().enumerate().zip(x) {
            let Some(place) = *place else { continue };
            match problem.spike {
                Some(spike) if spike.own == slot => {
                    direct = x;
                    profiles[[place, column]] = (x * (1.0 - spike.share)) as f32;
                }
                _ => profiles[[place, column]] = x as f32,
            }
        }
        if let Some(Spike { neighbour: Some(neighbour), share, .. }) = problem.spike
            && let Some(place) = self.places[neighbour]
        {
            profiles[[place, column]] += (direct * share) as f32;
        }
    }
}

fn slot_of(model: &RowModel, u: i32) -> Option<usize> {
    model.slots.iter().position(|slot| *slot == Slot { u, kind: SlotKind::Own })
}

impl Problem {
    /// `direct`, if given, takes the place of the weights of row 0.
    fn new(
        model: &RowModel,
        prior: &Prior,
        direct: Option<&[f64]>,
        spike: Option<Spike>,
    ) -> Result<Self, PlaneError> {
        let mut weights = model.weights.clone();
        if let Some((direct, own)) = direct.zip(slot_of(model, 0)) {
            weights.column_mut(own).iter_mut().zip(direct).for_each(|(to, &direct)| *to = direct);
        }
        if let Some(Spike { own, neighbour, share }) = spike {
            let other = neighbour.map(|neighbour| weights.column(neighbour).to_owned());
            let mut column = weights.column_mut(own);
            column *= 1.0 - share;
            other.into_iter().for_each(|other| column.scaled_add(share, &other));
        }
        let quadratic = Quadratic::new(weights.view(), &model.slots, prior)?;
        Ok(Self { weights, quadratic, spike })
    }
}
