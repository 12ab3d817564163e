use std::ops::RangeInclusive;

use ndarray::{Array1, Array2, Array3, ArrayView1, ArrayView2, ArrayView3, ArrayViewMut2, Axis, s};
use rayon::prelude::*;

use super::pivot::{Outcome, Pivoting};
use super::quadratic::Quadratic;
use super::{PlaneError, Prior, RowModel, RowTiming, Setting, Slot, SlotKind, Transport};
use super::{reach, reference};

/// Demultiplexes delay-exposure stacks: for each pixel, the exact minimiser of
/// `||A T - I||^2 + alpha ||D T||^2 + beta sum(T)` over `T >= 0` (the paper's section 4).
///
/// All pixels of a camera row share one model, factored once, so a pixel costs a few small triangular systems. Rows
/// are solved in parallel, and a row's result does not depend on how many threads there are.
#[derive(Debug, Clone)]
pub struct Demux {
    timing: RowTiming,
    settings: Vec<Setting>,
    prior: Prior,
    reach: RangeInclusive<i32>,
}

impl Demux {
    /// A demultiplexer for stacks taken with these settings, in this order.
    ///
    /// # Errors
    /// Those of [`reach`] and [`Prior::check`].
    pub fn new(timing: RowTiming, settings: Vec<Setting>, prior: Prior) -> Result<Self, PlaneError> {
        prior.check()?;
        let reach = reach(&timing, &settings)?;
        Ok(Self { timing, settings, prior, reach })
    }

    /// The same unknowns and prior for other settings: those of the points captured so far, or the planned ones with
    /// the delays that were measured. The reach stays, so that every transport of a plan has the same shape.
    ///
    /// # Errors
    /// Those of [`RowTiming::check`].
    pub fn with_settings(&self, settings: Vec<Setting>) -> Result<Self, PlaneError> {
        self.timing.check(&settings)?;
        Ok(Self { settings, ..self.clone() })
    }

    /// The relative rows that are estimated.
    pub fn reach(&self) -> RangeInclusive<i32> {
        self.reach.clone()
    }

    /// Condition number (2-norm) of the objective's quadratic part `H = A'A + alpha D'D` for one camera row.
    ///
    /// # Errors
    /// [`PlaneError::NotConvex`].
    pub fn condition(&self, row: usize) -> Result<f64, PlaneError> {
        let model = RowModel::new(&self.timing, &self.settings, &self.reach, row);
        let quadratic = Quadratic::new(model.weights.view(), &model.slots, &self.prior)?;
        Ok(largest_eigenvalue(&quadratic.h) * largest_eigenvalue(&quadratic.inverse))
    }

    /// Estimates the transport from `stack`, shape `[settings, camera_rows, columns]`, in units of the light that a
    /// white pixel collects per row dwell, black level and ambient light already subtracted.
    ///
    /// `valid`, of the same shape, tells which samples may be used; saturated ones may not. A pixel with masked
    /// samples is estimated from the others and flagged in [`Transport::saturated`]; it takes many times longer,
    /// because it cannot share the row's model.
    ///
    /// # Errors
    /// [`PlaneError::Shape`] if an array does not fit the timing and the settings; [`PlaneError::NotFinite`] for a
    /// NaN or an infinity, masked or not; [`PlaneError::NotConvex`].
    pub fn solve(
        &self,
        stack: ArrayView3<f32>,
        valid: Option<ArrayView3<bool>>,
    ) -> Result<Transport, PlaneError> {
        self.solve_while(stack, valid, &|| true)
    }

    /// [`Self::solve`] for as long as `go_on` says yes; it is asked before each camera row.
    ///
    /// # Errors
    /// Those of [`Self::solve`]; [`PlaneError::Stopped`] once `go_on` said no.
    pub fn solve_while(
        &self,
        stack: ArrayView3<f32>,
        valid: Option<ArrayView3<bool>>,
        go_on: &(dyn Fn() -> bool + Sync),
    ) -> Result<Transport, PlaneError> {
        let columns = stack.len_of(Axis(2));
        let rows = self.timing.camera_rows();
        let shape_of = |array, shape: &[usize]| {
            let expected = vec![self.settings.len(), rows, columns];
            let axes = "[settings, camera rows, columns]";
            match shape == expected {
                true => Ok(()),
                false => Err(PlaneError::Shape { array, axes, actual: shape.to_vec(), expected }),
            }
        };
        shape_of("stack", stack.shape())?;
        valid.map_or(Ok(()), |valid| shape_of("valid", valid.shape()))?;
        if let Some(((setting, row, column), _)) =
            stack.indexed_iter().find(|(_, sample)| !sample.is_finite())
        {
            return Err(PlaneError::NotFinite { setting, row, column });
        }

        let u_min = *self.reach.start();
        let rows_in_reach = self.reach.clone().count();
        let mut t = Array3::zeros((rows_in_reach, rows, columns));
        t.axis_iter_mut(Axis(1)).into_par_iter().enumerate().try_for_each(|(row, profiles)| {
            if !go_on() {
                return Err(PlaneError::Stopped);
            }
            let intensities = stack.index_axis(Axis(1), row).mapv(f64::from);
            self.solve_row(row, intensities, valid.map(|valid| valid.index_axis_move(Axis(1), row)), profiles)
        })?;
        let exists = Array2::from_shape_fn((rows_in_reach, rows), |(index, row)| {
            self.timing.row_exists(u_min + index as i32, row)
        });
        let saturated = Array2::from_shape_fn((rows, columns), |(row, column)| {
            valid.is_some_and(|valid| valid.slice(s![.., row, column]).iter().any(|valid| !valid))
        });
        Ok(Transport { t, u_min, exists, saturated })
    }

    /// Solves one camera row: `intensities` and `valid` `[settings, columns]`, `profiles` `[U, columns]`.
    fn solve_row(
        &self,
        row: usize,
        intensities: Array2<f64>,
        valid: Option<ArrayView2<bool>>,
        mut profiles: ArrayViewMut2<f32>,
    ) -> Result<(), PlaneError> {
        let model = RowModel::new(&self.timing, &self.settings, &self.reach, row);
        let quadratic = Quadratic::new(model.weights.view(), &model.slots, &self.prior)?;
        let linear = quadratic.linear(model.weights.view(), intensities.t());
        let unconstrained = linear.dot(&quadratic.inverse);
        let mut pivoting = Pivoting::new(model.slots.len());
        let mut masked = MaskedQuadratic { demux: self, model: &model, last: None };

        for (column, mut profile) in profiles.axis_iter_mut(Axis(1)).enumerate() {
            let mask = valid.map(|valid| valid.index_axis_move(Axis(1), column));
            let x = match mask.filter(|mask| mask.iter().any(|valid| !valid)) {
                None => minimise(&mut pivoting, &quadratic, linear.row(column), unconstrained.row(column)),
                Some(mask) => masked.minimise(&mut pivoting, intensities.column(column), mask)?,
            };
            for (Slot { u, kind }, x) in model.slots.iter().zip(x) {
                if *kind == SlotKind::Own {
                    profile[(u - self.reach.start()) as usize] = x as f32;
                }
            }
        }
        Ok(())
    }
}

/// Of a symmetric positive definite matrix, by power iteration to about 1 %.
fn largest_eigenvalue(matrix: &Array2<f64>) -> f64 {
    // A start without symmetry is orthogonal to no eigenvector.
    let mut vector = Array1::from_shape_fn(matrix.nrows(), |i| 1.0 + (i as f64 * 0.7).sin());
    let mut eigenvalue = 0.0;
    for _ in 0..200 {
        let next = matrix.dot(&vector);
        eigenvalue = next.dot(&next).sqrt() / vector.dot(&vector).sqrt();
        vector = next / eigenvalue;
    }
    eigenvalue
}

/// The minimiser of one pixel: by pivoting, or by the reference solver in the rare case that it does not end.
fn minimise(
    pivoting: &mut Pivoting,
    quadratic: &Quadratic,
    c: ArrayView1<f64>,
    unconstrained: ArrayView1<f64>,
) -> Vec<f64> {
    let (c, unconstrained) = (c.to_vec(), unconstrained.to_vec());
    match pivoting.minimise(quadratic, &c, &unconstrained) {
        Outcome::Minimum => pivoting.x.clone(),
        Outcome::GaveUp => reference::minimise(quadratic.h.view(), &c),
    }
}

/// The objective of the latest mask. Neighbouring pixels of a highlight mostly lose the same settings.
struct MaskedQuadratic<'a> {
    demux: &'a Demux,
    model: &'a RowModel,
    last: Option<(Vec<usize>, Array2<f64>, Quadratic)>,
}

impl MaskedQuadratic<'_> {
    fn minimise(
        &mut self,
        pivoting: &mut Pivoting,
        intensities: ArrayView1<f64>,
        valid: ArrayView1<bool>,
    ) -> Result<Vec<f64>, PlaneError> {
        let used: Vec<usize> = valid.indexed_iter().filter(|(_, valid)| **valid).map(|(n, _)| n).collect();
        let known = self.last.take().filter(|(settings, ..)| *settings == used);
        let (_, weights, quadratic) = match known {
            Some(known) => self.last.insert(known),
            None => {
                let weights = self.model.weights.select(Axis(0), &used);
                let quadratic = Quadratic::new(weights.view(), &self.model.slots, &self.demux.prior)?;
                self.last.insert((used.clone(), weights, quadratic))
            }
        };
        let samples = intensities.select(Axis(0), &used).insert_axis(Axis(0));
        let linear = quadratic.linear(weights.view(), samples.view());
        let unconstrained = linear.dot(&quadratic.inverse);
        Ok(minimise(pivoting, quadratic, linear.row(0), unconstrained.row(0)))
    }
}
