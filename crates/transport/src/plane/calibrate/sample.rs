use std::ops::RangeInclusive;

use ndarray::{Array2, ArrayView3, Axis, concatenate, s};
use rayon::prelude::*;

use super::super::model::{ResponseClass, WIDEST_RESPONSE_SIGMA_ROWS, collected_rows, drawn};
use super::super::{Beam, PlaneError, Prior, RowModel, RowTiming, Setting, Shares, Slot, reach};
use super::problem::RowProblem;
use super::{CalibrateError, SpikeMap};

/// Largest number of camera rows in a sample, and of pixels per row.
const ROWS: usize = 16;
const PIXELS_PER_ROW: usize = 64;

/// Samples with fewer pixels are not thinned.
const MIN_PIXELS_TO_THIN: usize = 256;

/// Steps of a pixel's measured place per projector row: coarser than for the solution, because each class is solved for
/// several priors.
const PLACE_STEPS: f32 = 8.0;

/// A Gaussian beam is cut off here, as the tails beyond contain less than a millionth of the light.
const BEAM_REACH_SIGMAS: f64 = 5.0;

/// Resolution of the position of direct light in rows; a finer step would only cost time.
const U0_STEP_ROWS: f64 = 1.0 / 32.0;

/// Pixels spread evenly over a stack, from which calibration is computed: at most 64 in each of 16 camera rows.
///
/// The choice depends only on the image's size and the mask. Pixels with masked samples are left out.
#[derive(Debug, Clone)]
pub struct Sample {
    pub(super) timing: RowTiming,
    pub(super) settings: Vec<Setting>,
    pub(super) reach: RangeInclusive<i32>,
    pub(super) columns: usize,
    pub(super) classes: Vec<SampledClass>,
}

/// Pixels of neighbouring rows of the sample that share a model, which is factored once for all of them.
#[derive(Debug, Clone)]
pub(super) struct SampledClass {
    /// Camera row and column, ascending.
    pub pixels: Vec<(usize, usize)>,
    /// Shape `[pixels, settings]`.
    pub intensities: Array2<f64>,
    pub slots: Vec<Slot>,
    /// Weight of every projector row for the first pixel with an ideal beam, shape `[settings, projector rows]`.
    ideal: Array2<f64>,
    own_row: i64,
    /// How far below its own row it looks, in rows.
    fraction: f64,
    /// The measured response of its pixels.
    shares: Option<Shares>,
}

/// What is known or assumed about the light of the projector's rows.
#[derive(Debug, Clone, Default)]
pub struct Optics {
    /// Standard deviation in rows of the beam's Gaussian profile; 0 if each row lights only itself.
    pub beam_sigma_rows: f64,
    /// Position of direct light; `None` for `u = 0` everywhere.
    pub spike: Option<SpikeMap>,
}

impl Optics {
    fn u0(&self, (t, s): (usize, usize)) -> f64 {
        self.spike.as_ref().map_or(0.0, |spike| f64::from(spike.u0[[t, s]]))
    }
}

impl Sample {
    /// The camera rows from which an image with `camera_rows` rows is sampled.
    pub fn rows_of(camera_rows: usize) -> impl Iterator<Item = usize> {
        strata(camera_rows, ROWS).map(|rows| (rows.start + rows.end) / 2)
    }

    /// Takes a sample of `stack`, shape `[settings, camera_rows, columns]`, in the units of [`super::super::Demux`];
    /// `valid`, of the same shape, is false where a sample may not be used.
    ///
    /// # Errors
    /// Those of [`reach`]; [`PlaneError::Shape`]; [`PlaneError::NotFinite`] for a chosen sample;
    /// [`CalibrateError::NoPixels`] if no pixel is free of masked samples.
    pub fn new(
        timing: RowTiming,
        settings: Vec<Setting>,
        stack: ArrayView3<f32>,
        valid: Option<ArrayView3<bool>>,
    ) -> Result<Self, CalibrateError> {
        let rows: Vec<usize> = (0..timing.camera_rows()).collect();
        Self::of_rows(timing, settings, &rows, stack, valid)
    }

    /// [`Self::new`] for a stack with only some camera rows, ascending: at least those of [`Self::rows_of`].
    ///
    /// # Errors
    /// Those of [`Self::new`]; [`PlaneError::Rows`] for a row that is missing.
    pub fn of_rows(
        timing: RowTiming,
        settings: Vec<Setting>,
        held: &[usize],
        stack: ArrayView3<f32>,
        valid: Option<ArrayView3<bool>>,
    ) -> Result<Self, CalibrateError> {
        let reach = reach(&timing, &settings)?;
        let (_, _, columns) = stack.dim();
        let height = timing.camera_rows();
        let expected = [settings.len(), held.len(), columns];
        for (array, shape) in
            [Some(("stack", stack.shape())), valid.as_ref().map(|valid| ("valid", valid.shape()))]
                .into_iter()
                .flatten()
        {
            if shape != expected {
                let axes = "[settings, camera rows, columns]";
                let (actual, expected) = (shape.to_vec(), expected.to_vec());
                return Err(PlaneError::Shape { array, axes, actual, expected }.into());
            }
        }
        timing.check_columns(columns)?;
        let usable = |at: usize, column: &usize| {
            valid.is_none_or(|valid| valid.slice(s![.., at, *column]).iter().all(|v| *v))
        };
        let unspread = timing.clone().with_beam(Beam::Ideal)?;
        let rows = Self::rows_of(height)
            .enumerate()
            .collect::<Vec<_>>()
            .into_par_iter()
            .map(|(index, t)| {
                let missing = |_| PlaneError::Rows { row: t, camera_rows: held.len() };
                let at = held.binary_search(&t).map_err(missing)?;
                // Golden-ratio positions in the strata: no two rows sample the same columns, and no pattern is
                // aliased.
                let place = (index as f64 * 0.618_033_988_75).fract();
                let columns: Vec<usize> = strata(columns, PIXELS_PER_ROW)
                    .filter_map(|columns| {
                        let first = columns.start + (place * columns.len() as f64) as usize;
                        (first..columns.end).chain(columns.start..first).find(|column| usable(at, column))
                    })
                    .collect();
                let intensities = Array2::from_shape_fn((columns.len(), settings.len()), |(pixel, n)| {
                    f64::from(stack[[n, at, columns[pixel]]])
                });
                if let Some(((pixel, setting), _)) =
                    intensities.indexed_iter().find(|(_, value)| !value.is_finite())
                {
                    return Err(PlaneError::NotFinite { setting, row: t, column: columns[pixel] });
                }
                let ideal = drawn(&timing, &settings, t);
                let pixels = columns.iter().map(|&column| (t, column)).collect();
                let Some(response) = timing.measured_response() else {
                    let model = RowModel::new(&unspread, &settings, &reach, t);
                    let slots = RowModel::new(&timing, &settings, &reach, t).slots;
                    let own_row = timing.camera().own_row(t) as i64;
                    let fraction = timing.camera().place(t) - own_row as f64;
                    let class =
                        SampledClass { pixels, intensities, slots, ideal, own_row, fraction, shares: None };
                    return Ok(vec![(model, class)]);
                };
                let classes = response.classes(t, columns.iter().copied(), PLACE_STEPS);
                let of_class = |class: ResponseClass| {
                    let model = RowModel::measured(ideal.view(), &reach, &class);
                    let ResponseClass { own_row, shares, columns: alike } = class;
                    let kept: Vec<usize> =
                        (0..columns.len()).filter(|&at| alike.contains(&columns[at])).collect();
                    let class = SampledClass {
                        pixels: alike.into_iter().map(|column| (t, column)).collect(),
                        intensities: intensities.select(Axis(0), &kept),
                        slots: model.slots.clone(),
                        ideal: ideal.clone(),
                        own_row,
                        fraction: 0.0,
                        shares: Some(shares),
                    };
                    (model, class)
                };
                Ok(classes.into_iter().map(of_class).collect())
            })
            .collect::<Result<Vec<Vec<_>>, PlaneError>>()?
            .concat();
        let mut classes: Vec<(RowModel, SampledClass)> = Vec::new();
        for (model, row) in rows.into_iter().filter(|(_, row)| !row.pixels.is_empty()) {
            match classes.last_mut() {
                Some((same, class))
                    if *same == model && class.slots == row.slots && class.fraction == row.fraction =>
                {
                    class.append(row)
                }
                _ => classes.push((model, row)),
            }
        }
        let classes: Vec<SampledClass> = classes.into_iter().map(|(_, class)| class).collect();
        if classes.is_empty() {
            return Err(CalibrateError::NoPixels);
        }
        Ok(Self { timing, settings, reach, columns, classes })
    }

    /// A quarter of the rows and half the pixels of each, unless that leaves too few: enough where every pixel is
    /// solved many times.
    pub(super) fn thinned(&self) -> Self {
        if self.pixels().count() <= MIN_PIXELS_TO_THIN {
            return self.clone();
        }
        let mut rows: Vec<usize> = self.pixels().map(|(t, _)| t).collect();
        rows.dedup();
        let rows: Vec<usize> = rows.iter().copied().skip(rows.len().min(2) - 1).step_by(4).collect();
        let mut place_in_row = (0, 0);
        self.keep(|(t, _)| {
            place_in_row = (t, if place_in_row.0 == t { place_in_row.1 + 1 } else { 0 });
            rows.contains(&t) && place_in_row.1 % 2 == 0
        })
    }

    /// The sample reduced to the pixels for which `kept` returns true; it is called in order.
    pub(super) fn keep(&self, mut kept: impl FnMut((usize, usize)) -> bool) -> Self {
        let classes = self.classes.iter().map(|class| class.keep(&mut kept));
        let classes = classes.filter(|class| !class.pixels.is_empty()).collect();
        Self { classes, ..self.clone() }
    }

    /// The pixels of the sample, `(t, s)`, in the order of all per-pixel results.
    pub fn pixels(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        self.classes.iter().flat_map(|class| class.pixels.iter().copied())
    }
}

impl SampledClass {
    fn append(&mut self, row: Self) {
        self.pixels.extend(row.pixels);
        self.intensities = concatenate![Axis(0), self.intensities, row.intensities];
    }

    fn keep(&self, mut kept: impl FnMut((usize, usize)) -> bool) -> Self {
        let kept: Vec<usize> = (0..self.pixels.len()).filter(|&pixel| kept(self.pixels[pixel])).collect();
        Self {
            pixels: kept.iter().map(|&pixel| self.pixels[pixel]).collect(),
            intensities: self.intensities.select(Axis(0), &kept),
            ..self.clone()
        }
    }

    /// Index of the slot of relative row `u` in the projector's own frame.
    pub fn slot(&self, u: i32) -> Option<usize> {
        self.slots.iter().position(|slot| slot.u == u)
    }

    /// `A`, shape `[settings, slots]`, with a Gaussian beam: a row receives light while the rows around it are drawn.
    /// A measured response takes the place of the beam.
    pub fn weights(&self, beam_sigma_rows: f64) -> Array2<f64> {
        if let Some(shares) = &self.shares {
            let mut weights = Array2::zeros((self.ideal.nrows(), self.slots.len()));
            for (mut weights, drawn) in weights.rows_mut().into_iter().zip(self.ideal.rows()) {
                let light = collected_rows(drawn, shares, 0, drawn.len());
                let lit = |slot: &Slot| (self.own_row + i64::from(slot.u)) as usize;
                weights.iter_mut().zip(&self.slots).for_each(|(to, slot)| *to = light[lit(slot)]);
            }
            return weights;
        }
        let is_wide = beam_sigma_rows > WIDEST_RESPONSE_SIGMA_ROWS;
        let beam = between_rows(beam_shares(beam_sigma_rows), if is_wide { 0.0 } else { self.fraction });
        let projector_rows = self.ideal.ncols();
        let mut weights = Array2::zeros((self.ideal.nrows(), self.slots.len()));
        for (mut weights, slot) in weights.columns_mut().into_iter().zip(&self.slots) {
            let lit = self.own_row + i64::from(slot.u);
            for &(offset_rows, share) in beam.iter().rev() {
                if let Ok(drawn) = usize::try_from(lit + offset_rows)
                    && drawn < projector_rows
                {
                    weights.scaled_add(share, &self.ideal.column(drawn));
                }
            }
        }
        weights
    }

    /// Groups the pixels by problem: one problem for each position of direct light, with the indices of its pixels.
    /// The paper's prior does not model direct light, so it has a single problem.
    pub fn problems(
        &self,
        prior: &Prior,
        optics: &Optics,
    ) -> Result<Vec<(RowProblem, Vec<usize>)>, PlaneError> {
        let differences = prior.differences(&self.slots);
        let weights = self.weights(optics.beam_sigma_rows);
        let step = |pixel: usize| match prior {
            Prior::Paper { .. } => 0,
            Prior::Split { .. } => (optics.u0(self.pixels[pixel]) / U0_STEP_ROWS).round() as i32,
        };
        let mut places: Vec<i32> = (0..self.pixels.len()).map(step).collect();
        places.sort_unstable();
        places.dedup();
        let problem = |place: i32| {
            let weights = self.with_spike_at(&weights, f64::from(place) * U0_STEP_ROWS);
            let pixels = (0..self.pixels.len()).filter(|&pixel| step(pixel) == place).collect();
            Ok((RowProblem::new(weights, differences.clone(), prior)?, pixels))
        };
        places.into_iter().map(problem).collect()
    }

    /// `weights` with the light of the direct row divided between row 0 and its neighbour on the side of `u0_rows`.
    fn with_spike_at(&self, weights: &Array2<f64>, u0_rows: f64) -> Array2<f64> {
        let mut placed = weights.clone();
        let neighbour = self.slot(if u0_rows < 0.0 { -1 } else { 1 });
        if let (Some(own), Some(neighbour)) = (self.slot(0), neighbour) {
            let share = u0_rows.abs().min(1.0);
            let mixed = (1.0 - share) * &weights.column(own) + share * &weights.column(neighbour);
            placed.column_mut(own).assign(&mixed);
        }
        placed
    }
}

/// Shares of a row's light that reach the row `offset` away; they sum to 1.
fn beam_shares(sigma_rows: f64) -> Vec<(i64, f64)> {
    if sigma_rows <= 0.0 {
        return vec![(0, 1.0)];
    }
    let reach = (BEAM_REACH_SIGMAS * sigma_rows).ceil() as i64;
    let share = |offset: i64| (-0.5 * (offset as f64 / sigma_rows).powi(2)).exp();
    let total: f64 = (-reach..=reach).map(share).sum();
    (-reach..=reach).map(|offset| (offset, share(offset) / total)).collect()
}

/// The shares for a pixel that looks `fraction` of a row below its own row: its light is divided between the two rows.
fn between_rows(beam: Vec<(i64, f64)>, fraction: f64) -> Vec<(i64, f64)> {
    if fraction == 0.0 {
        return beam;
    }
    let side = fraction.signum() as i64;
    let divided = |(offset, share): (i64, f64)| {
        [(offset, share * (1.0 - fraction.abs())), (offset + side, share * fraction.abs())]
    };
    beam.into_iter().flat_map(divided).collect()
}

/// `0..length` divided into at most `count` non-empty ranges of nearly the same length.
fn strata(length: usize, count: usize) -> impl Iterator<Item = std::ops::Range<usize>> {
    let count = count.min(length);
    (0..count).map(move |index| index * length / count..(index + 1) * length / count)
}
