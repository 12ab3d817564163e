use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::sync::Arc;

use ndarray::{Array1, Array2, Array3, ArrayView1, ArrayView2, ArrayView3, ArrayViewMut2, Axis, s};
use rayon::prelude::*;

use super::super::PlaneError;
use super::super::error::check_shape;
use super::super::model::{FlyingSpot, RowModel, RowTiming, Setting, SlotKind, Transport, reach};
use super::censored::minimise_censored;
use super::pivot::{Start, minimise};
use super::quadratic::Quadratic;
use super::tiles::{Objectives, Problem, Row, Spike, Tile};
use super::{Prior, SimdLevel};

/// Demultiplexes delay-exposure stacks: for each pixel, the exact minimiser of
/// `||A T - I||^2 + alpha ||D T||^2 + beta sum(T)` over `T >= 0` (the paper's section 4).
///
/// All pixels of a camera row share one model, and rows with the same model share its factors, so that a pixel costs
/// only a few small triangular systems. With a [`super::super::PixelResponse`], pixels of a row that look at the same
/// place between rows share a model, and other rows do not. Tiles of pixels are solved in parallel. The result is the same to the bit for
/// any number of threads, and a row's result does not depend on which other rows are solved. Channels are treated as
/// pixels: an RGB stack is solved as one with three times the columns, a Bayer mosaic without demosaicing.
#[derive(Debug, Clone)]
pub struct Demux {
    timing: RowTiming,
    settings: Vec<Setting>,
    prior: Prior,
    reach: RangeInclusive<i32>,
    u0_rows: Option<Arc<Array2<f32>>>,
    spot: Option<Arc<FlyingSpot>>,
    bracket: Option<Arc<Bracket>>,
    simd: SimdLevel,
}

/// An image under less light than those of the stack, taken for the pixels that saturate there.
#[derive(Debug, Clone)]
pub struct Bracket {
    /// Delays and exposure.
    pub setting: Setting,
    /// The level of its light as a share of the stack's, in `0..=1`.
    pub light: f64,
    /// `[t, s]` of all camera rows, in the units of the stack: divided by `light`, dark image subtracted.
    pub image: Array2<f32>,
    /// Which of its pixels are not saturated, `[t, s]`; the others are lower bounds.
    pub valid: Array2<bool>,
}

impl Demux {
    /// A demultiplexer for stacks taken with these settings, in this order.
    ///
    /// # Errors
    /// Those of [`reach`] and [`Prior::check`].
    pub fn new(timing: RowTiming, settings: Vec<Setting>, prior: Prior) -> Result<Self, PlaneError> {
        prior.check()?;
        let reach = reach(&timing, &settings)?;
        Ok(Self {
            timing,
            settings,
            prior,
            reach,
            u0_rows: None,
            spot: None,
            bracket: None,
            simd: SimdLevel::best(),
        })
    }

    /// The same unknowns and prior with other settings: those of the points captured so far, or the planned ones with
    /// the measured delays. The reach stays the same, so that every transport of a plan has the same shape.
    ///
    /// # Errors
    /// Those of [`RowTiming::check`].
    pub fn with_settings(&self, settings: Vec<Setting>) -> Result<Self, PlaneError> {
        self.timing.check(&settings)?;
        Ok(Self { settings, ..self.clone() })
    }

    /// The same unknowns and settings with another prior.
    ///
    /// # Errors
    /// Those of [`Prior::check`].
    pub fn with_prior(&self, prior: Prior) -> Result<Self, PlaneError> {
        prior.check()?;
        Ok(Self { prior, ..self.clone() })
    }

    /// The same unknowns, settings and prior with another timing, for example one with another beam.
    ///
    /// # Errors
    /// Those of [`RowTiming::check`].
    pub fn with_timing(&self, timing: RowTiming) -> Result<Self, PlaneError> {
        timing.check(&self.settings)?;
        Ok(Self { timing, ..self.clone() })
    }

    /// Sets the position of each pixel's direct light, `u0_rows[t, s]` in projector rows from the pixel's own,
    /// -1..=1: the remaining error of rectification. Direct light between two rows is shared between them, `1 - |u0|`
    /// in row 0 and `|u0|` in its neighbour, and estimated as one unknown. Without this call it lies in row 0.
    ///
    /// # Errors
    /// [`PlaneError::OutOfRange`] for an offset outside -1..=1.
    pub fn with_spike(&self, u0_rows: Array2<f32>) -> Result<Self, PlaneError> {
        if let Some(&value) = u0_rows.iter().find(|u0| !(-1.0..=1.0).contains(*u0)) {
            return Err(PlaneError::OutOfRange {
                field: "u0_rows",
                value: value.into(),
                allowed: "within -1 to 1: rectify camera and projector better",
            });
        }
        // Where camera rows look between projector rows anyway, the offset adds to the place.
        let timing = match self.timing.displaced(u0_rows.view())? {
            Some(displaced) => displaced,
            None => self.timing.clone(),
        };
        Ok(Self { timing, u0_rows: Some(Arc::new(u0_rows)), ..self.clone() })
    }

    /// Sets the moment of direct light within its row, which matters for settings with an edge on the row. Valid for
    /// beams no wider than a row, and for camera rows that look at the middle of projector rows.
    ///
    /// # Errors
    /// [`PlaneError::OutOfRange`] for a column outside 0..=1, or for camera rows that look between projector rows.
    pub fn with_spot(&self, spot: FlyingSpot) -> Result<Self, PlaneError> {
        if self.timing.response().is_some() {
            let allowed =
                "a whole number of projector rows for each camera row: a flying spot is modelled there only";
            return Err(PlaneError::OutOfRange {
                field: "row_pitch",
                value: self.timing.camera().pitch,
                allowed,
            });
        }
        if let Some(&value) = spot.columns.iter().find(|column| !(0.0..=1.0).contains(*column)) {
            let allowed = "from 0 to 1: divide the projector's column by its width";
            return Err(PlaneError::OutOfRange { field: "columns", value: value.into(), allowed });
        }
        Ok(Self { spot: Some(Arc::new(spot)), ..self.clone() })
    }

    /// Adds an image under less light, which is used for pixels with saturated samples only: its squared error joins
    /// their objective with the weight `light`.
    ///
    /// # Errors
    /// Those of [`RowTiming::check`]; [`PlaneError::OutOfRange`] for a level outside 0..=1; [`PlaneError::Shape`].
    pub fn with_bracket(&self, bracket: Bracket) -> Result<Self, PlaneError> {
        self.timing.check(std::slice::from_ref(&bracket.setting))?;
        if !(bracket.light > 0.0 && bracket.light <= 1.0) {
            let allowed = "above 0 and at most 1: take the bracket under less light than the sweep";
            return Err(PlaneError::OutOfRange { field: "light", value: bracket.light, allowed });
        }
        let (rows, columns) = bracket.image.dim();
        let expected = [self.timing.camera_rows(), columns];
        check_shape("image of the bracket", "[camera rows, columns]", &[rows, columns], &expected)?;
        check_shape("valid of the bracket", "[camera rows, columns]", bracket.valid.shape(), &expected)?;
        Ok(Self { bracket: Some(Arc::new(bracket)), ..self.clone() })
    }

    /// The same, solved with the given instructions instead of the fastest.
    pub fn with_simd(&self, simd: SimdLevel) -> Self {
        Self { simd, ..self.clone() }
    }

    /// The relative rows that are estimated.
    pub fn reach(&self) -> RangeInclusive<i32> {
        self.reach.clone()
    }

    /// The timing of projector and camera rows.
    pub fn timing(&self) -> &RowTiming {
        &self.timing
    }

    /// The settings, in the order of the stack.
    pub fn settings(&self) -> &[Setting] {
        &self.settings
    }

    /// Position of direct light, `[t, s]`, as set by [`Self::with_spike`].
    pub fn u0_rows(&self) -> Option<&Array2<f32>> {
        self.u0_rows.as_deref()
    }

    /// The prior.
    pub fn prior(&self) -> Prior {
        self.prior
    }

    /// Condition number (2-norm) of the objective's quadratic part `H = A'A + alpha D'D` for one camera row.
    ///
    /// # Errors
    /// [`PlaneError::NotConvex`].
    pub fn condition(&self, row: usize) -> Result<f64, PlaneError> {
        let model = RowModel::typical(&self.timing, &self.settings, &self.reach, row);
        let quadratic = Quadratic::new(model.weights.view(), &model.slots, &self.prior)?;
        Ok(largest_eigenvalue(quadratic.h()) * largest_eigenvalue(quadratic.inverse()?))
    }

    /// Estimates the transport from `stack`, shape `[settings, camera_rows, columns]`, in units of the light that a
    /// white pixel collects per row dwell. Black level and ambient light must already be subtracted.
    ///
    /// `valid`, of the same shape, tells which samples are exact. The others are saturated: their light is at least what
    /// they show, and only what the prediction lacks is squared; 0 or less says nothing. A pixel with such samples is
    /// flagged in [`Transport::saturated`], and the rows that no exact sample sees in [`Transport::lower_bounds`]. It
    /// takes many times longer, because its model differs from its row's.
    ///
    /// # Errors
    /// [`PlaneError::Shape`] if an array does not fit the timing and the settings; [`PlaneError::NotFinite`] for a
    /// NaN or an infinity, even if masked; [`PlaneError::NotConvex`].
    pub fn solve(
        &self,
        stack: ArrayView3<f32>,
        valid: Option<ArrayView3<bool>>,
    ) -> Result<Transport, PlaneError> {
        self.solve_while(stack, valid, &|| true)
    }

    /// [`Self::solve`] for as long as `go_on` returns true; it is called before every few camera rows.
    ///
    /// # Errors
    /// Those of [`Self::solve`]; [`PlaneError::Stopped`] once `go_on` returns false.
    pub fn solve_while(
        &self,
        stack: ArrayView3<f32>,
        valid: Option<ArrayView3<bool>>,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Transport, PlaneError> {
        self.run(&self.all_rows(), stack, valid, None, go_on)
    }

    /// [`Self::solve_while`] starting from an estimate, which is faster if the light has changed little since. The
    /// minimum is the same, but not to the bit.
    ///
    /// # Errors
    /// Those of [`Self::solve_while`]; [`PlaneError::Shape`] if the estimate has another reach or size.
    pub fn solve_from(
        &self,
        estimate: &Transport,
        stack: ArrayView3<f32>,
        valid: Option<ArrayView3<bool>>,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Transport, PlaneError> {
        self.run(&self.all_rows(), stack, valid, Some(estimate), go_on)
    }

    /// [`Self::solve_while`] for some camera rows, ascending: a sample of the image, or a part of an image that is
    /// larger than the memory. The stack and the transport contain only these rows.
    ///
    /// # Errors
    /// Those of [`Self::solve_while`]; [`PlaneError::Rows`] for rows that do not exist in the camera.
    pub fn solve_rows(
        &self,
        rows: &[usize],
        stack: ArrayView3<f32>,
        valid: Option<ArrayView3<bool>>,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Transport, PlaneError> {
        self.run(rows, stack, valid, None, go_on)
    }

    /// The images that the model predicts for the settings, `[settings, rows, columns]`, from a transport of these
    /// camera rows. Light from beyond the reach is not included.
    ///
    /// # Errors
    /// [`PlaneError::Shape`] if the transport does not fit the rows and the reach; [`PlaneError::Rows`].
    pub fn predict_rows(&self, rows: &[usize], transport: &Transport) -> Result<Array3<f32>, PlaneError> {
        self.check_rows(rows)?;
        let columns = transport.t.len_of(Axis(2));
        let expected = [self.reach.clone().count(), rows.len(), columns];
        check_shape("transport", "[reach, camera rows, columns]", transport.t.shape(), &expected)?;
        self.timing.check_columns(columns)?;
        let mut images = Array3::zeros((self.settings.len(), rows.len(), columns));
        images.axis_iter_mut(Axis(1)).into_par_iter().zip(rows).enumerate().for_each(
            |(at, (mut image, &row))| {
                let profiles = transport.t.index_axis(Axis(1), at);
                for (model, columns) in
                    RowModel::of_pixels(&self.timing, &self.settings, &self.reach, row, columns)
                {
                    let own = model
                        .slots
                        .iter()
                        .zip(model.weights.columns())
                        .filter(|(slot, _)| slot.kind == SlotKind::Own);
                    let mut sums = Array2::<f64>::zeros((self.settings.len(), columns.len()));
                    for (slot, weights) in own {
                        let light =
                            profiles.row((slot.u - self.reach.start()) as usize).select(Axis(0), &columns);
                        for (mut sums, &weight) in sums.rows_mut().into_iter().zip(weights) {
                            if weight != 0.0 {
                                sums.zip_mut_with(&light, |sum, &light| *sum += weight * f64::from(light));
                            }
                        }
                    }
                    for (sums, &column) in sums.columns().into_iter().zip(&columns) {
                        image.column_mut(column).zip_mut_with(&sums, |image, &sum| *image = sum as f32);
                    }
                }
            },
        );
        Ok(images)
    }

    fn all_rows(&self) -> Vec<usize> {
        (0..self.timing.camera_rows()).collect()
    }

    fn check_rows(&self, rows: &[usize]) -> Result<(), PlaneError> {
        let camera_rows = self.timing.camera_rows();
        match rows.iter().find(|&&row| row >= camera_rows) {
            Some(&row) => Err(PlaneError::Rows { row, camera_rows }),
            None => Ok(()),
        }
    }

    fn run(
        &self,
        rows: &[usize],
        stack: ArrayView3<f32>,
        valid: Option<ArrayView3<bool>>,
        estimate: Option<&Transport>,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Transport, PlaneError> {
        self.check_rows(rows)?;
        let columns = stack.len_of(Axis(2));
        let expected = [self.settings.len(), rows.len(), columns];
        let axes = "[settings, camera rows, columns]";
        check_shape("stack", axes, stack.shape(), &expected)?;
        valid.map_or(Ok(()), |valid| check_shape("valid", axes, valid.shape(), &expected))?;
        let u_min = *self.reach.start();
        let shape = [self.reach.clone().count(), rows.len(), columns];
        if let Some(estimate) = estimate {
            check_shape("estimate", "[reach, camera rows, columns]", estimate.t.shape(), &shape)?;
        }
        if let Some(u0_rows) = &self.u0_rows {
            let expected = [self.timing.camera_rows(), columns];
            check_shape("u0_rows", "[camera rows, columns]", u0_rows.shape(), &expected)?;
        }
        if let Some(spot) = &self.spot {
            spot.check((self.timing.camera_rows(), columns))?;
        }
        if let Some(bracket) = &self.bracket {
            check_shape("image of the bracket", "[columns]", &[bracket.image.ncols()], &[columns])?;
        }
        if let Some(((setting, row, column), _)) =
            stack.indexed_iter().find(|(_, sample)| !sample.is_finite())
        {
            return Err(PlaneError::NotFinite { setting, row: rows[row], column });
        }

        let mut t = Array3::zeros(shape);
        let mut solved: Vec<Row<Data>> = t
            .axis_iter_mut(Axis(1))
            .zip(rows)
            .enumerate()
            .map(|(at, (profiles, &row))| {
                let stack = stack.index_axis_move(Axis(1), at);
                let valid = valid.map(|valid| valid.index_axis_move(Axis(1), at));
                let u0_rows = self.u0_rows.as_ref().map(|u0_rows| u0_rows.row(row));
                let estimate = estimate.map(|estimate| estimate.t.index_axis(Axis(1), at));
                let bracket = self.bracket.as_ref().map(|of| (of.image.row(row), of.valid.row(row)));
                let (bounds, no_edge, lit) = (Vec::new(), Vec::new(), None);
                let data = Data { stack, bracket, estimate, profiles, bounds, no_edge, lit };
                Row::new(row, columns, valid, u0_rows, data)
            })
            .collect();
        let bracket_setting = self.bracket.iter().map(|bracket| &bracket.setting);
        let settings: Vec<Setting> = self.settings.iter().chain(bracket_setting).cloned().collect();
        let objectives = Objectives {
            timing: &self.timing,
            settings: &settings,
            bracket_light: self.bracket.as_ref().map(|bracket| bracket.light),
            prior: self.prior,
            reach: &self.reach,
            spot: self.spot.as_deref(),
        };
        objectives.for_each_tile(
            &mut solved,
            go_on,
            &|problem: &Problem, tile: &Tile, rows: &mut [Row<Data>]| self.solve_tile(problem, tile, rows),
        )?;
        let mut lower_bounds = BTreeMap::new();
        let mut no_edge = Array2::from_elem((rows.len(), columns), false);
        for (at, row) in solved.into_iter().enumerate() {
            lower_bounds.extend(row.data.bounds.into_iter().map(|(column, bounds)| ([at, column], bounds)));
            row.data.no_edge.into_iter().for_each(|column| no_edge[[at, column]] = true);
        }
        let exists = Array2::from_shape_fn((shape[0], rows.len()), |(index, at)| {
            self.timing.row_exists(u_min + index as i32, rows[at])
        });
        let saturated = Array2::from_shape_fn((rows.len(), columns), |(at, column)| {
            valid.is_some_and(|valid| valid.slice(s![.., at, column]).iter().any(|valid| !valid))
        });
        Ok(Transport { t, u_min, exists, saturated, lower_bounds, no_edge })
    }

    fn solve_tile(&self, problem: &Problem, tile: &Tile, rows: &mut [Row<Data>]) -> Result<(), PlaneError> {
        let places: Vec<(usize, usize)> = problem.places(*self.reach.start()).collect();
        let minima = match &tile.valid {
            None => {
                let minima = self.minima(problem, tile, &places, rows);
                if let ([row], Some(_), false) = (&mut *rows, self.timing.response(), tile.pixels.is_empty())
                {
                    row.data.lit = Some(self.lit_by_most(&places, &minima));
                }
                minima
            }
            Some(valid) => self.censored_minima(problem, tile, valid.view(), rows)?,
        };
        if !problem.has_edge() {
            tile.pixels.iter().for_each(|&(at, column)| rows[at].data.no_edge.push(column));
        }

        let place_of = |slot: usize| places.iter().find(|(own, _)| *own == slot).map(|(_, place)| *place);
        for &(slot, place) in &places {
            for (&x, &(at, column)) in minima.column(slot).iter().zip(&tile.pixels) {
                rows[at].data.profiles[[place, column]] = x as f32;
            }
        }
        if let Some(Spike { own, neighbour, share }) = problem.spike {
            let [own_place, neighbour] = [Some(own), neighbour].map(|slot| place_of(slot?));
            for (&direct, &(at, column)) in minima.column(own).iter().zip(&tile.pixels) {
                let profiles = &mut rows[at].data.profiles;
                own_place
                    .into_iter()
                    .for_each(|own| profiles[[own, column]] = (direct * (1.0 - share)) as f32);
                neighbour.into_iter().for_each(|place| profiles[[place, column]] += (direct * share) as f32);
            }
        }
        Ok(())
    }

    /// The minima of pixels all of whose samples are exact, `[pixels, slots]`.
    fn minima(
        &self,
        problem: &Problem,
        tile: &Tile,
        places: &[(usize, usize)],
        rows: &[Row<Data>],
    ) -> Array2<f64> {
        let Tile { pixels, runs, .. } = tile;
        let samples = samples_of(problem, tile, rows);
        let linear = problem.quadratic.linear(problem.weights.view(), samples.view());
        let estimated = rows.iter().all(|row| row.data.estimate.is_some());
        let mut free = estimated.then(|| {
            let mut free = Array2::from_elem(linear.dim(), true);
            for (mut free, &(at, column)) in free.rows_mut().into_iter().zip(pixels) {
                let Some(estimate) = rows[at].data.estimate else { continue };
                places.iter().for_each(|&(slot, place)| free[slot] = estimate[[place, column]] > 0.0);
            }
            free
        });
        if let ([Row { data: Data { lit: Some(lit), .. }, .. }], None) = (rows, &free) {
            let mut marks = Array2::from_elem(linear.dim(), true);
            places.iter().for_each(|&(slot, place)| marks.column_mut(slot).fill(lit[place]));
            free = Some(marks);
        }
        let start = free.as_ref().map_or(Start::Runs(runs), |free| Start::Free(free.view()));
        minimise(self.simd, &problem.quadratic, linear, &start)
    }

    /// The places, `[reach]`, that send light to most pixels.
    fn lit_by_most(&self, places: &[(usize, usize)], minima: &Array2<f64>) -> Vec<bool> {
        let mut lit = vec![true; self.reach.clone().count()];
        for &(slot, place) in places {
            lit[place] =
                2 * minima.column(slot).iter().filter(|&&light| light > 0.0).count() > minima.nrows();
        }
        lit
    }

    /// The minima of pixels with censored samples, `[pixels, slots]`; notes what is only a lower bound.
    fn censored_minima(
        &self,
        problem: &Problem,
        tile: &Tile,
        valid: ArrayView1<bool>,
        rows: &mut [Row<Data>],
    ) -> Result<Array2<f64>, PlaneError> {
        let samples = samples_of(problem, tile, rows);
        let mut minima = Array2::zeros((samples.nrows(), problem.model.slots.len()));
        for (k, &(at, column)) in tile.pixels.iter().enumerate() {
            let (mut own, mut exact) = (samples.row(k).to_vec(), valid.to_vec());
            if let Some((image, valid)) = rows[at].data.bracket {
                own.push(f64::from(image[column]) * problem.bracket_scale());
                exact.push(valid[column]);
            }
            let (own, exact) = (Array1::from(own), Array1::from(exact));
            let solved = minimise_censored(self.simd, problem, &self.prior, own.view(), exact.view())?;
            minima.row_mut(k).assign(&solved);
            // A pixel that was not calibrated has no light at all, not even a bound.
            let is_lit = own.iter().zip(&exact).any(|(&sample, is_exact)| !is_exact && sample > 0.0);
            if let Some(bounds) = self.lower_bounds(problem, exact.view()).filter(|_| is_lit) {
                rows[at].data.bounds.push((column, bounds));
            }
        }
        Ok(minima)
    }

    /// Which rows of the profile, `[reach]`, are only lower bounds, if any.
    fn lower_bounds(&self, problem: &Problem, exact: ArrayView1<bool>) -> Option<Vec<bool>> {
        let of_slots = problem.lower_bounds(exact);
        let mut bounds = vec![false; self.reach.clone().count()];
        for (slot, place) in problem.places(*self.reach.start()) {
            // Direct light between two rows is one unknown, in the slot of row 0.
            let is_neighbour = |spike: &Spike| spike.neighbour == Some(slot) && of_slots[spike.own];
            bounds[place] = of_slots[slot] || problem.spike.as_ref().is_some_and(is_neighbour);
        }
        bounds.contains(&true).then_some(bounds)
    }
}

/// The samples of a tile's pixels, `[pixels, settings]`.
fn samples_of(problem: &Problem, tile: &Tile, rows: &[Row<Data>]) -> Array2<f64> {
    let mut samples = Array2::zeros((tile.pixels.len(), problem.settings.len()));
    for (samples, &setting) in samples.columns_mut().into_iter().zip(&problem.settings) {
        for (sample, &(at, column)) in samples.into_iter().zip(&tile.pixels) {
            *sample = f64::from(rows[at].data.stack[[setting, column]]);
        }
    }
    samples
}

/// A camera row to be solved.
struct Data<'a> {
    /// `[settings, columns]`
    stack: ArrayView2<'a, f32>,
    /// Image and validity of the bracket, `[columns]`.
    bracket: Option<(ArrayView1<'a, f32>, ArrayView1<'a, bool>)>,
    /// Starting point of the solver, `[reach, columns]`.
    estimate: Option<ArrayView2<'a, f32>>,
    /// The row's part of the transport, `[reach, columns]`.
    profiles: ArrayViewMut2<'a, f32>,
    /// Columns with rows that are only lower bounds, and which of them, `[reach]`.
    bounds: Vec<(usize, Vec<bool>)>,
    /// Columns in which no exposure tells rows near `u = 0` apart.
    no_edge: Vec<usize>,
    /// Where pixels have measured responses: the places, `[reach]`, that send light to most of those solved last. The
    /// next few, which have an objective of their own, start from there.
    lit: Option<Vec<bool>>,
}

/// Largest eigenvalue of a symmetric positive definite matrix, by power iteration to about 1 %.
fn largest_eigenvalue(matrix: ArrayView2<f64>) -> f64 {
    // An asymmetric start is not orthogonal to any eigenvector.
    let mut vector = Array1::from_shape_fn(matrix.nrows(), |i| 1.0 + (i as f64 * 0.7).sin());
    let mut eigenvalue = 0.0;
    for _ in 0..200 {
        let next = matrix.dot(&vector);
        eigenvalue = next.dot(&next).sqrt() / vector.dot(&vector).sqrt();
        vector = next / eigenvalue;
    }
    eigenvalue
}
