use std::ops::RangeInclusive;

use ndarray::{Array1, Array2, Array3, ArrayView1, ArrayView2, ArrayView3, Axis, s};
use rayon::prelude::*;

use super::error::check_shape;
use super::noise::check_shapes;
use super::{
    NoiseModel, PlaneError, Prior, RowModel, RowTiming, Setting, Slot, SlotKind, Transport, cholesky,
};

/// How uncertain a transport is through the noise of its stack.
///
/// Where `T > 0`, the estimate is linear in the samples: with `F` the free rows of a pixel, `T_F = H_FF^-1 (A_F' I -
/// beta/2)`, `H = A'A + alpha D'D`. So the covariance of the free rows is `H_FF^-1 A_F' S A_F H_FF^-1`, with `S` the
/// diagonal covariance of the samples, and all other rows have none. Rows of the next or previous frame, whose
/// estimates were dropped, count as free.
///
/// It is the spread of repeated measurements about their mean, and holds nothing else: not the bias of the prior,
/// which smooths what the settings cannot tell apart, nor that of coupling, nor errors of delays, beam, or alignment.
#[derive(Debug, Clone)]
pub struct Uncertainty<'a> {
    /// The timing of the stack.
    pub timing: &'a RowTiming,
    /// The settings of the stack.
    pub settings: &'a [Setting],
    /// The prior that the transport was estimated with.
    pub prior: Prior,
    /// The noise of a frame.
    pub noise: NoiseModel,
    /// Frames that each setting's image is the mean of.
    pub frames: &'a [usize],
}

/// A stack and what is known about its samples.
#[derive(Debug, Clone, Copy)]
pub struct Samples<'a> {
    /// The stack that the transport was estimated from, `[settings, t, s]`.
    pub stack: ArrayView3<'a, f32>,
    /// Which samples were used, of the same shape; `None` for all.
    pub valid: Option<ArrayView3<'a, bool>>,
    /// [`super::Coupled::variance_ratio`] if the stack was coupled, `[t, s]`.
    pub variance_ratio: Option<ArrayView2<'a, f32>>,
}

/// Condition of `H`, scaled to a unit diagonal, up to which the row's inverse serves all pixels.
const WELL_CONDITIONED: f64 = 1e8;
/// Relative increase of the diagonal of `H`: rows that nothing determines become very uncertain, not singular.
const RIDGE: f64 = 1e-12;

impl Uncertainty<'_> {
    /// Standard deviation of the light in each band of relative rows, `[bands, t, s]`, in the units of the transport.
    ///
    /// A band is a list of ranges, so that the light around the direct row is one: the non-epipolar image of
    /// [`Transport::non_epipolar`] with width 1 is `[i32::MIN..=-1, 1..=i32::MAX]`.
    ///
    /// # Errors
    /// Those of [`RowTiming::check`] and [`Prior::check`]; [`PlaneError::Shape`] if an array does not fit;
    /// [`PlaneError::NotConvex`]; [`PlaneError::OutOfRange`] for a negative noise or a setting without frames.
    pub fn of_bands(
        &self,
        transport: &Transport,
        samples: &Samples,
        bands: &[Vec<RangeInclusive<i32>>],
    ) -> Result<Array3<f32>, PlaneError> {
        let (_, rows, columns) = transport.t.dim();
        let expected = [self.timing.camera_rows(), columns];
        check_shape("transport", "[camera rows, columns]", &[rows, columns], &expected)?;
        self.of_bands_in_rows(0, transport, samples, bands)
    }

    /// [`Self::of_bands`] in the camera rows from `first_row` on that `transport` and `samples` hold alone.
    ///
    /// # Errors
    /// Those of [`Self::of_bands`]; [`PlaneError::Rows`] for rows that the camera does not have.
    pub fn of_bands_in_rows(
        &self,
        first_row: usize,
        transport: &Transport,
        samples: &Samples,
        bands: &[Vec<RangeInclusive<i32>>],
    ) -> Result<Array3<f32>, PlaneError> {
        self.check(first_row, transport, samples)?;
        let (_, rows, columns) = transport.t.dim();
        let mut sd = Array3::zeros((bands.len(), rows, columns));
        sd.axis_iter_mut(Axis(1)).into_par_iter().enumerate().try_for_each(|(t, mut sd)| {
            let row = Row::new(self, transport, bands, first_row + t);
            let profiles = transport.t.index_axis(Axis(1), t);
            let valid = samples.valid.map(|valid| valid.index_axis_move(Axis(1), t));
            // The change of each band of each column with each sample, [columns * bands, settings].
            let gains = row.solve(profiles, valid)?.dot(&row.weights.t());
            for (column, gains) in gains.axis_chunks_iter(Axis(0), bands.len().max(1)).enumerate() {
                let pixel = Pixel::new(self, samples, t, column);
                let variances = gains.rows().into_iter().map(|gains| pixel.variance_of(gains));
                sd.column_mut(column).iter_mut().zip(variances).for_each(|(sd, v)| *sd = v.sqrt() as f32);
            }
            Ok(())
        })?;
        Ok(sd)
    }

    fn check(&self, first_row: usize, transport: &Transport, samples: &Samples) -> Result<(), PlaneError> {
        self.timing.check(self.settings)?;
        self.prior.check()?;
        self.noise.check()?;
        check_shapes(samples.stack, samples.valid, self.frames)?;
        let (_, rows, columns) = transport.t.dim();
        let (end, camera_rows) = (first_row + rows, self.timing.camera_rows());
        if end > camera_rows {
            return Err(PlaneError::Rows { row: end - 1, camera_rows });
        }
        let expected = [self.settings.len(), rows, columns];
        check_shape("stack", "[settings, camera rows, columns]", samples.stack.shape(), &expected)?;
        let ratio = samples.variance_ratio;
        ratio.map_or(Ok(()), |ratio| {
            check_shape("variance_ratio", "[camera rows, columns]", ratio.shape(), &[rows, columns])
        })
    }
}

/// The problem of one camera row, with its unknowns scaled so that `H` of all settings has a unit diagonal: smoothness
/// far from `u = 0` weighs a million times more than the data.
struct Row {
    /// `A`, `[settings, slots]`.
    weights: Array2<f64>,
    /// `alpha D'D`, `[slots, slots]`.
    smoothness: Array2<f64>,
    /// Index of each slot in the profile, `None` for a wrapped one.
    profile_index: Vec<Option<usize>>,
    /// 1 in the slots of each band, `[bands, slots]`.
    bands: Array2<f64>,
}

impl Row {
    fn new(of: &Uncertainty, transport: &Transport, bands: &[Vec<RangeInclusive<i32>>], t: usize) -> Self {
        let reach = transport.u_min..=transport.u_max();
        let RowModel { slots, mut weights } = RowModel::new(of.timing, of.settings, &reach, t);
        let differences = of.prior.differences(&slots);
        let mut smoothness = of.prior.alpha() * differences.t().dot(&differences);
        let mut indicators = Array2::from_shape_fn((bands.len(), slots.len()), |(band, slot)| {
            let inside = bands[band].iter().any(|range| range.contains(&slots[slot].u));
            f64::from(slots[slot].kind == SlotKind::Own && inside)
        });
        for slot in 0..slots.len() {
            let diagonal = weights.column(slot).dot(&weights.column(slot)) + smoothness[[slot, slot]];
            let scale = if diagonal > 0.0 { diagonal.sqrt().recip() } else { 1.0 };
            weights.column_mut(slot).mapv_inplace(|weight| weight * scale);
            smoothness.column_mut(slot).mapv_inplace(|entry| entry * scale);
            smoothness.row_mut(slot).mapv_inplace(|entry| entry * scale);
            indicators.column_mut(slot).mapv_inplace(|indicator| indicator * scale);
        }
        let profile_index = |slot: &Slot| match slot.kind {
            SlotKind::Own => Some((slot.u - transport.u_min) as usize),
            SlotKind::Wrapped => None,
        };
        let profile_index = slots.iter().map(profile_index).collect();
        Self { weights, smoothness, profile_index, bands: indicators }
    }

    /// Solves `H_FF y_F = b_F`, 0 elsewhere, for each pixel and each band's indicator `b`: `[columns * bands, slots]`.
    fn solve(
        &self,
        profiles: ArrayView2<f32>,
        valid: Option<ArrayView2<bool>>,
    ) -> Result<Array2<f64>, PlaneError> {
        let settings = self.weights.nrows();
        let (bands, slots) = self.bands.dim();
        let mut solutions = Array2::zeros((profiles.ncols() * bands, slots));
        let complete = System::new(self, (0..settings).collect())?;
        let mut masked: Option<System> = None;
        for (column, profile) in profiles.columns().into_iter().enumerate() {
            let is_used = |n: &usize| valid.is_none_or(|valid| valid[[*n, column]]);
            let used: Vec<usize> = (0..settings).filter(is_used).collect();
            let system = if used.len() == settings {
                &complete
            } else {
                // Neighbouring pixels of a highlight mostly lose the same settings.
                match masked.take().filter(|system| system.settings == used) {
                    Some(known) => masked.insert(known),
                    None => masked.insert(System::new(self, used)?),
                }
            };
            let is_free = |slot: &usize| self.profile_index[*slot].is_none_or(|index| profile[index] > 0.0);
            let (free, fixed): (Vec<usize>, Vec<usize>) = (0..slots).partition(is_free);
            let solution = system.solve_free(&self.bands, &free, &fixed)?;
            solutions.slice_mut(s![column * bands..(column + 1) * bands, ..]).assign(&solution);
        }
        Ok(solutions)
    }
}

/// One pixel's samples; masked ones are 0 without variance.
struct Pixel {
    light: Array1<f64>,
    /// Before coupling.
    variance: Array1<f64>,
    variance_ratio: f64,
}

impl Pixel {
    fn new(of: &Uncertainty, samples: &Samples, t: usize, column: usize) -> Self {
        let index = |n| [n, t, column];
        let is_valid = |n| samples.valid.is_none_or(|valid| valid[index(n)]);
        let light = |n| if is_valid(n) { f64::from(samples.stack[index(n)]) } else { 0.0 };
        let light = Array1::from_shape_fn(of.settings.len(), light);
        let variance = |n| if is_valid(n) { of.noise.variance(light[n], of.frames[n]) } else { 0.0 };
        Self {
            variance: Array1::from_shape_fn(of.settings.len(), variance),
            light,
            variance_ratio: samples.variance_ratio.map_or(1.0, |ratio| f64::from(ratio[[t, column]])),
        }
    }

    /// Variance of a sum of the samples, each times its gain.
    fn variance_of(&self, gains: ArrayView1<f64>) -> f64 {
        let independent = (&gains * &gains).dot(&self.variance);
        if self.variance_ratio == 1.0 {
            return independent;
        }
        // Coupling leaves the noise of the pixel's total, by which the whole profile is scaled.
        let scaling = (gains.dot(&self.light) / self.light.sum()).powi(2) * self.variance.sum();
        self.variance_ratio * independent + (1.0 - self.variance_ratio) * scaling
    }
}

/// The quadratic part of the objective for some of the settings.
struct System {
    settings: Vec<usize>,
    h: Array2<f64>,
    /// The inverse of `H`, unless too little would remain of it in floating point.
    inverse: Option<Array2<f64>>,
}

impl System {
    fn new(row: &Row, settings: Vec<usize>) -> Result<Self, PlaneError> {
        let weights = row.weights.select(Axis(0), &settings);
        let mut h = weights.t().dot(&weights) + &row.smoothness;
        h.diag_mut().mapv_inplace(|diagonal| if diagonal > 0.0 { diagonal + RIDGE } else { 1.0 });
        let inverse = solve(h.clone(), Array2::eye(h.nrows()))?;
        let condition = inverse.diag().iter().fold(1.0, |most, &entry| f64::max(most, entry));
        Ok(Self { settings, h, inverse: (condition < WELL_CONDITIONED).then_some(inverse) })
    }

    /// Solves `H_FF y_F = b_F` for each row `b` of `right_sides`; 0 in the fixed slots.
    fn solve_free(
        &self,
        right_sides: &Array2<f64>,
        free: &[usize],
        fixed: &[usize],
    ) -> Result<Array2<f64>, PlaneError> {
        match &self.inverse {
            // On the side of the fewer slots: the forces on the fixed ones that hold them at 0.
            Some(inverse) if fixed.len() < free.len() => {
                let unheld = right_sides.dot(inverse);
                let to_fixed = inverse.select(Axis(0), fixed);
                let forces =
                    solve(to_fixed.select(Axis(1), fixed), unheld.select(Axis(1), fixed).reversed_axes())?;
                Ok(unheld - forces.t().dot(&to_fixed))
            }
            _ => {
                let h = self.h.select(Axis(0), free).select(Axis(1), free);
                let solution = solve(h, right_sides.select(Axis(1), free).reversed_axes())?;
                let mut all = Array2::zeros(right_sides.raw_dim());
                free.iter()
                    .zip(solution.rows())
                    .for_each(|(&slot, values)| all.column_mut(slot).assign(&values));
                Ok(all)
            }
        }
    }
}

/// Solves `matrix x = b` for each column `b` of `right_sides`; `matrix` is symmetric positive definite.
fn solve(matrix: Array2<f64>, right_sides: Array2<f64>) -> Result<Array2<f64>, PlaneError> {
    let n = matrix.nrows();
    let mut factor: Vec<f64> = matrix.iter().copied().collect();
    cholesky::factor(&mut factor, n).map_err(|cholesky::NotPositiveDefinite| PlaneError::NotConvex)?;
    let mut solutions = right_sides;
    for mut column in solutions.columns_mut() {
        let mut values = column.to_vec();
        cholesky::solve(&factor, n, &mut values);
        column.assign(&Array1::from(values));
    }
    Ok(solutions)
}
