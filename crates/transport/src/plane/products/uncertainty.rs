use std::ops::RangeInclusive;

use ndarray::{Array1, Array2, Array3, ArrayView1, ArrayView2, ArrayView3, ArrayViewMut2, Axis};

use super::super::error::check_shape;
use super::super::noise::check_shapes;
use super::super::solve::pivot::minimise_free;
use super::super::solve::tiles::{Objectives, Problem, Row, Spike, Tile};
use super::super::{NoiseModel, PlaneError, Prior, RowTiming, Setting, SimdLevel, SlotKind, Transport};

/// The uncertainty of a transport due to the noise of its stack.
///
/// Where `T > 0`, the estimate is linear in the samples: with `F` the free rows of a pixel,
/// `T_F = H_FF^-1 (A_F' I - beta/2)`, `H = A'A + alpha D'D`. The covariance of the free rows is therefore
/// `H_FF^-1 A_F' S A_F H_FF^-1`, with `S` the diagonal covariance of the samples, and that of all other rows is 0.
/// Rows of the next or previous frame, whose estimates were dropped, count as free.
///
/// It is the spread of repeated measurements around their mean, and includes nothing else: neither the bias of the
/// prior, which smooths what the settings cannot resolve, nor that of coupling, nor errors of delays, beam, or
/// alignment.
#[derive(Debug, Clone)]
pub struct Uncertainty<'a> {
    /// The timing of the stack.
    pub timing: &'a RowTiming,
    /// The settings of the stack.
    pub settings: &'a [Setting],
    /// The prior that the transport was estimated with.
    pub prior: Prior,
    /// The noise of a single frame.
    pub noise: NoiseModel,
    /// Number of frames averaged in each setting's image.
    pub frames: &'a [usize],
}

/// A stack and the known properties of its samples.
#[derive(Debug, Clone, Copy)]
pub struct Samples<'a> {
    /// The stack that the transport was estimated from, `[settings, t, s]`.
    pub stack: ArrayView3<'a, f32>,
    /// Which samples were used, of the same shape; `None` for all.
    pub valid: Option<ArrayView3<'a, bool>>,
    /// [`super::super::Coupled::variance_ratio`] if the stack was coupled, `[t, s]`.
    pub variance_ratio: Option<ArrayView2<'a, f32>>,
    /// Assumed position of direct light, as in [`super::super::Demux::with_spike`] but for these rows alone,
    /// `[t, s]`; `None` for row 0.
    pub u0_rows: Option<ArrayView2<'a, f32>>,
}

/// Light of a row below this share of the direct light that reaches it is attributed to rounding.
const ROUNDING: f32 = 1e-6;

impl Uncertainty<'_> {
    /// Standard deviation of the light in each band of relative rows, `[bands, t, s]`, in the units of the transport.
    ///
    /// A band is a list of ranges, so that a band may exclude the direct row: the non-epipolar image of
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

    /// [`Self::of_bands`] for `transport` and `samples` that contain only the camera rows starting at `first_row`.
    ///
    /// # Errors
    /// Those of [`Self::of_bands`]; [`PlaneError::Rows`] for rows that do not exist in the camera.
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
        if bands.is_empty() {
            return Ok(sd);
        }
        let mut judged: Vec<Row<Data>> = sd
            .axis_iter_mut(Axis(1))
            .enumerate()
            .map(|(t, sd)| {
                let valid = samples.valid.map(|valid| valid.index_axis_move(Axis(1), t));
                let u0_rows = samples.u0_rows.map(|u0_rows| u0_rows.index_axis_move(Axis(0), t));
                let profiles = transport.t.index_axis(Axis(1), t);
                Row::new(first_row + t, columns, valid, u0_rows, Data { t, profiles, sd })
            })
            .collect();
        let reach = transport.u_min..=transport.u_max();
        let Self { timing, settings, prior, .. } = *self;
        let objectives =
            Objectives { timing, settings, bracket_light: None, prior, reach: &reach, spot: None };
        let work = |problem: &Problem, tile: &Tile, rows: &mut [Row<Data>]| {
            let masked =
                tile.valid.as_ref().map(|valid| problem.of_samples(valid.view(), &prior)).transpose()?;
            let problem = masked.as_ref().unwrap_or(problem);
            let gains = problem.gains(bands, transport.u_min, tile, rows)?;
            for (gains, &(at, column)) in gains.axis_chunks_iter(Axis(0), bands.len()).zip(&tile.pixels) {
                let Data { t, sd, .. } = &mut rows[at].data;
                let pixel = Pixel::new(self, samples, &problem.settings, *t, column);
                let variances = gains.rows().into_iter().map(|gains| pixel.variance_of(gains));
                sd.column_mut(column).iter_mut().zip(variances).for_each(|(sd, v)| *sd = v.sqrt() as f32);
            }
            Ok(())
        };
        objectives.for_each_tile(&mut judged, &|| true, &work)?;
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
        for (name, map) in [("variance_ratio", ratio), ("u0_rows", samples.u0_rows)] {
            map.map_or(Ok(()), |map| {
                check_shape(name, "[camera rows, columns]", map.shape(), &[rows, columns])
            })?;
        }
        Ok(())
    }
}

/// A camera row to be processed.
struct Data<'a> {
    /// Its index in the stack.
    t: usize,
    /// The row's part of the transport, `[reach, columns]`.
    profiles: ArrayView2<'a, f32>,
    /// The result, `[bands, columns]`.
    sd: ArrayViewMut2<'a, f32>,
}

impl Problem<'_> {
    /// The derivative of each band of each pixel of a tile with respect to each sample, `[pixels * bands, settings]`.
    fn gains(
        &self,
        bands: &[Vec<RangeInclusive<i32>>],
        u_min: i32,
        tile: &Tile,
        rows: &[Row<Data>],
    ) -> Result<Array2<f64>, PlaneError> {
        let sums = self.sums(bands);
        let places: Vec<(usize, usize)> = self.places(u_min).collect();
        let shape = (tile.pixels.len() * bands.len(), self.model.slots.len());
        let mut linear = Array2::zeros(shape);
        let mut free = Array2::from_elem(shape, true);
        let of_pixels = linear.axis_chunks_iter_mut(Axis(0), bands.len());
        let of_pixels = of_pixels.zip(free.axis_chunks_iter_mut(Axis(0), bands.len()));
        for ((mut linear, mut free), &(at, column)) in of_pixels.zip(&tile.pixels) {
            linear.assign(&sums);
            let lit = self.lit(&places, rows[at].data.profiles.column(column));
            free.rows_mut().into_iter().for_each(|mut free| free.assign(&lit));
        }
        let solutions = minimise_free(SimdLevel::best(), &self.quadratic, linear, free.view());
        match solutions.iter().all(|entry| entry.is_finite()) {
            true => Ok(solutions.dot(&self.weights.t())),
            false => Err(PlaneError::NotConvex),
        }
    }

    /// The weight of each unknown in the light of each band, `[bands, slots]`.
    fn sums(&self, bands: &[Vec<RangeInclusive<i32>>]) -> Array2<f64> {
        let slots = &self.model.slots;
        let mut sums = Array2::from_shape_fn((bands.len(), slots.len()), |(band, slot)| {
            let inside = bands[band].iter().any(|range| range.contains(&slots[slot].u));
            f64::from(u8::from(slots[slot].kind == SlotKind::Own && inside))
        });
        if let Some(Spike { own, neighbour, share }) = self.spike {
            for mut sums in sums.rows_mut() {
                sums[own] =
                    (1.0 - share) * sums[own] + neighbour.map_or(0.0, |neighbour| share * sums[neighbour]);
            }
        }
        sums
    }

    /// The unknowns that are free in a pixel's profile, by slot. Those that are not part of the profile count as
    /// free.
    fn lit(&self, places: &[(usize, usize)], profile: ArrayView1<f32>) -> Array1<bool> {
        let mut light = Array1::from_elem(self.model.slots.len(), 1.0_f32);
        places.iter().for_each(|&(slot, place)| light[slot] = profile[place]);
        if let Some(Spike { own, neighbour: Some(neighbour), share }) = self.spike {
            // Direct light that falls on the neighbour's row does not count as the neighbour's own light.
            let share = share as f32;
            let direct = if share < 1.0 { light[own] / (1.0 - share) } else { light[neighbour] };
            light[own] = direct;
            light[neighbour] -= direct * (share + ROUNDING);
        }
        light.mapv(|light| light > 0.0)
    }
}

/// The samples of one pixel.
struct Pixel {
    light: Array1<f64>,
    /// Before coupling.
    variance: Array1<f64>,
    variance_ratio: f64,
}

impl Pixel {
    /// The samples of the given settings.
    fn new(of: &Uncertainty, samples: &Samples, settings: &[usize], t: usize, column: usize) -> Self {
        let light: Array1<f64> = settings.iter().map(|&n| f64::from(samples.stack[[n, t, column]])).collect();
        let variances =
            settings.iter().zip(&light).map(|(&n, &light)| of.noise.variance(light, of.frames[n]));
        Self {
            variance: variances.collect(),
            light,
            variance_ratio: samples.variance_ratio.map_or(1.0, |ratio| f64::from(ratio[[t, column]])),
        }
    }

    /// Variance of the sum of the samples weighted by `gains`.
    fn variance_of(&self, gains: ArrayView1<f64>) -> f64 {
        let independent = (&gains * &gains).dot(&self.variance);
        if self.variance_ratio == 1.0 {
            return independent;
        }
        // Coupling keeps the noise of the pixel's total, by which the whole profile is scaled.
        let scaling = (gains.dot(&self.light) / self.light.sum()).powi(2) * self.variance.sum();
        self.variance_ratio * independent + (1.0 - self.variance_ratio) * scaling
    }
}
