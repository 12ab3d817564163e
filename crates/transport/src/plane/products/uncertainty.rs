use std::collections::{BTreeMap, BTreeSet};
use std::ops::{Range, RangeInclusive};

use ndarray::{
    Array1, Array2, Array3, ArrayView1, ArrayView2, ArrayView3, ArrayViewMut1, ArrayViewMut2, Axis,
};
use rayon::prelude::*;

use super::super::advice::{BiasBound, BiasOfFamily, Noise, bias_sizes};
use super::super::board::{CalibrationCovariance, CalibrationParameter};
use super::super::error::check_shape;
use super::super::noise::check_shapes;
use super::super::solve::pivot::minimise_free;
use super::super::solve::tiles::{Objectives, Problem, Row, Spike, Tile};
use super::super::{NoiseModel, PlaneError, Prior, RowTiming, Setting, SimdLevel, SlotKind, Transport};
use super::relight::{LitClass, LitRows, RelitBeam};
use super::sensitivity::changes;

/// The uncertainty of a transport due to the noise of its stack and the errors of the calibration.
///
/// Where `T > 0`, the estimate is linear in the samples: with `F` the free rows of a pixel,
/// `T_F = H_FF^-1 (A_F' I - beta/2)`, `H = A'A + alpha D'D`. The covariance of the free rows is therefore
/// `H_FF^-1 A_F' S A_F H_FF^-1`, with `S` the diagonal covariance of the samples, and that of all other rows is 0.
/// Rows of the next or previous frame, whose estimates were dropped, count as free.
///
/// `S` also contains the noise of the dark images: all images of one exposure share that of theirs, so that it adds up
/// over them in long bands. Errors of a calibration change the light that the model predicts by `J = dA/dq T` for each
/// parameter `q`, and add `J C J'` with the covariance `C` of the parameters. An error of an image's delay changes all
/// its samples together, in the same way.
///
/// It is the spread of repeated measurements, each with a calibration of its own if that is given, around their mean.
/// It does not include the bias of the prior, which smooths what the settings cannot resolve (see
/// [`Self::prior_bias_in_rows`]), nor that of coupling.
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
    /// Standard deviation of the delay of each setting's image, in microseconds, independent of each other.
    pub delay_sds_us: &'a [f64],
    /// The dark images that were subtracted; a setting has at most one.
    pub darks: &'a [DarkImage],
    /// Errors of the calibration that the timing contains; `None` for those of noise alone.
    pub calibration: Option<&'a CalibrationCovariance>,
}

/// A dark image that was subtracted from images of several settings, which share its noise.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DarkImage {
    /// Indices of the settings.
    pub settings: Vec<usize>,
    /// Number of frames averaged in it.
    pub frames: usize,
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
        self.of_sums_in_rows(0, transport, samples, &LightSums::Bands(bands))
    }

    /// Standard deviation of sums of the light, `[sums, t, s]`, in the units of the transport. `transport` and
    /// `samples` contain only the camera rows starting at `first_row`.
    ///
    /// # Errors
    /// Those of [`Self::of_bands`]; [`PlaneError::Rows`] for rows that do not exist in the camera.
    pub fn of_sums_in_rows(
        &self,
        first_row: usize,
        transport: &Transport,
        samples: &Samples,
        sums: &LightSums,
    ) -> Result<Array3<f32>, PlaneError> {
        self.for_each_tile(first_row, transport, samples, sums, &|problem, tile, rows, sums| {
            let gains = problem.solutions(sums, transport.u_min, tile, rows)?.dot(&problem.weights.t());
            let light = problem.light(transport.u_min, tile, rows);
            let t = first_row + rows[tile.pixels[0].0].data.t;
            let systematic = self.systematic(t, problem, tile, &light, &gains);
            let of_pixels = gains.axis_chunks_iter(Axis(0), sums.len());
            let of_pixels = of_pixels.zip(systematic.axis_chunks_iter(Axis(0), sums.len()));
            for ((gains, systematic), &(at, column)) in of_pixels.zip(&tile.pixels) {
                let Data { t, out, .. } = &mut rows[at].data;
                let pixel = Pixel::new(self, samples, &problem.settings, *t, column);
                let each = out.column_mut(column).into_iter().zip(gains.rows()).zip(systematic);
                for ((sd, gains), systematic) in each {
                    // Errors that neighbours share are the same after coupling.
                    *sd = (pixel.variance_of(gains) + systematic).sqrt() as f32;
                }
            }
            Ok(())
        })
    }

    /// The family of [`super::super::advice`], photographed with these settings and this noise, and solved,
    /// for [`Self::prior_bias_in_rows`].
    ///
    /// # Errors
    /// Those of [`Self::of_bands`].
    pub fn bias_of_family(&self) -> Result<BiasOfFamily, PlaneError> {
        self.timing.check(self.settings)?;
        self.prior.check()?;
        self.noise.check()?;
        let mean = |frames: &mut dyn ExactSizeIterator<Item = usize>| {
            let count = frames.len().max(1) as f64;
            (frames.sum::<usize>() as f64 / count).round().max(1.0) as u32
        };
        let noise = Noise {
            read: self.noise.read_variance.sqrt(),
            gain: self.noise.gain,
            frames: mean(&mut self.frames.iter().copied()),
            dark_frames: (!self.darks.is_empty())
                .then(|| mean(&mut self.darks.iter().map(|dark| dark.frames))),
        };
        BiasOfFamily::new(self.timing, self.prior, self.settings, &noise)
    }

    /// A bound on the bias that the prior gives to each sum, `[sums, t, s]`: a multiple of the bias that the estimate
    /// itself shows, and of the pixel's whole light.
    ///
    /// The estimate does not show how rough the truth is, so the multiples are taken from transports that are known,
    /// those of `family`, which is that of the same model. The bound holds for 99 % of them and is meant for 95 % of the
    /// pixels of other scenes.
    ///
    /// # Errors
    /// Those of [`Self::of_sums_in_rows`].
    pub fn prior_bias_in_rows(
        &self,
        first_row: usize,
        transport: &Transport,
        samples: &Samples,
        sums: &LightSums,
        family: &BiasOfFamily,
    ) -> Result<Array3<f32>, PlaneError> {
        self.check(first_row, transport, samples)?;
        let (_, rows, columns) = transport.t.dim();
        let bounds =
            Sums::new(sums, self.timing, first_row..first_row + rows, columns)?.bias_bounds(family)?;
        let prior = self.prior;
        self.for_each_tile(first_row, transport, samples, sums, &|problem, tile, rows, sums| {
            let solutions = problem.solutions(sums, transport.u_min, tile, rows)?;
            let links = prior.links(&problem.model.slots);
            let estimates = problem.light(transport.u_min, tile, rows);
            let sizes = bias_sizes(&prior, &links, &solutions, &estimates, sums.len());
            for (index, &(at, column)) in tile.pixels.iter().enumerate() {
                let light = estimates.row(index).sum();
                let Data { t, out, .. } = &mut rows[at].data;
                let own_row = sums.class(*t, column).map(|class| class.own_row);
                let bounds = bounds.get(&own_row).map_or(&[][..], Vec::as_slice);
                for (sum, (out, bound)) in out.column_mut(column).into_iter().zip(bounds).enumerate() {
                    let size = sizes[index * sums.len() + sum];
                    *out = (bound.of_size * size + bound.of_light * light) as f32;
                }
            }
            Ok(())
        })
    }

    /// Calls `work` for the pixels of the camera rows starting at `first_row`, and returns its results,
    /// `[sums, t, s]`.
    fn for_each_tile(
        &self,
        first_row: usize,
        transport: &Transport,
        samples: &Samples,
        sums: &LightSums,
        work: &(impl for<'r> Fn(&Problem, &Tile, &mut [Row<Data<'r>>], &Sums) -> Result<(), PlaneError> + Sync),
    ) -> Result<Array3<f32>, PlaneError> {
        self.check(first_row, transport, samples)?;
        let (_, rows, columns) = transport.t.dim();
        let sums = Sums::new(sums, self.timing, first_row..first_row + rows, columns)?;
        let mut out = Array3::zeros((sums.len(), rows, columns));
        if sums.len() == 0 {
            return Ok(out);
        }
        let mut judged: Vec<Row<Data>> = out
            .axis_iter_mut(Axis(1))
            .enumerate()
            .map(|(t, out)| {
                let valid = samples.valid.map(|valid| valid.index_axis_move(Axis(1), t));
                let u0_rows = samples.u0_rows.map(|u0_rows| u0_rows.index_axis_move(Axis(0), t));
                let profiles = transport.t.index_axis(Axis(1), t);
                Row::new(first_row + t, columns, valid, u0_rows, Data { t, profiles, out })
            })
            .collect();
        let reach = transport.u_min..=transport.u_max();
        let Self { timing, settings, prior, .. } = *self;
        let objectives =
            Objectives { timing, settings, bracket_light: None, prior, reach: &reach, spot: None };
        let of_samples = |problem: &Problem, tile: &Tile, rows: &mut [Row<Data>]| {
            if tile.pixels.is_empty() {
                return Ok(());
            }
            let masked =
                tile.valid.as_ref().map(|valid| problem.of_samples(valid.view(), &prior)).transpose()?;
            work(masked.as_ref().unwrap_or(problem), tile, rows, &sums)
        };
        objectives.for_each_tile(&mut judged, &|| true, &of_samples)?;
        Ok(out)
    }

    /// Variance of each sum of each pixel of a tile in camera row `t` through errors of the calibration and of delays,
    /// `[pixels * sums]`.
    fn systematic(
        &self,
        t: usize,
        problem: &Problem,
        tile: &Tile,
        light: &Array2<f64>,
        gains: &Array2<f64>,
    ) -> Array1<f64> {
        let delay_sds_us: Array1<f64> = problem.settings.iter().map(|&n| self.delay_sds_us[n]).collect();
        if self.calibration.is_none() && delay_sds_us.iter().all(|&sd_us| sd_us == 0.0) {
            return Array1::zeros(gains.nrows());
        }
        let columns: Vec<usize> = tile.pixels.iter().map(|&(_, column)| column).collect();
        let settings: Vec<Setting> = problem.settings.iter().map(|&n| self.settings[n].clone()).collect();
        let changes = changes(self.timing, &settings, problem, (t, &columns), light);
        let bands = gains.nrows() / tile.pixels.len();
        let by_time = &changes[CalibrationParameter::Latency as usize];
        Array1::from_shape_fn(gains.nrows(), |row| {
            let (gains, pixel) = (gains.row(row), row / bands);
            let of_delays = (&gains * &by_time.row(pixel) * &delay_sds_us).mapv(|light| light * light).sum();
            let of_calibration = self.calibration.map_or(0.0, |covariance| {
                covariance.variance_of(&changes.each_ref().map(|change| gains.dot(&change.row(pixel))))
            });
            of_delays + of_calibration
        })
    }

    fn check(&self, first_row: usize, transport: &Transport, samples: &Samples) -> Result<(), PlaneError> {
        self.timing.check(self.settings)?;
        self.prior.check()?;
        self.noise.check()?;
        check_shapes(samples.stack, samples.valid, self.frames)?;
        check_shape("delay_sds_us", "[settings]", &[self.delay_sds_us.len()], &[self.settings.len()])?;
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

/// Weighted sums of a pixel's light over relative rows.
#[derive(Debug, Clone, Copy)]
pub enum LightSums<'a> {
    /// Bands: lists of ranges, whose rows all have the weight 1.
    Bands(&'a [Vec<RangeInclusive<i32>>]),
    /// One: the image that [`super::relight_rows`] makes with these weights of the projector's rows.
    Relit {
        /// `[projector rows]`
        weights: ArrayView1<'a, f64>,
        /// Whether rows spread.
        beam: RelitBeam,
    },
}

/// The same with the weights of each pixel.
enum Sums<'a> {
    /// Over relative rows, each with weight 1.
    Bands(&'a [Vec<RangeInclusive<i32>>]),
    /// One, over all rows: the light under some of the projector's.
    Relit {
        /// Classes by camera row, from the first one.
        rows: Vec<Vec<LitClass>>,
        /// That of a pixel in the middle of the image, whichever rows these are.
        typical: LitClass,
    },
}

impl<'a> Sums<'a> {
    fn new(
        of: &LightSums<'a>,
        timing: &RowTiming,
        camera_rows: Range<usize>,
        columns: usize,
    ) -> Result<Self, PlaneError> {
        Ok(match *of {
            LightSums::Bands(bands) => Self::Bands(bands),
            LightSums::Relit { weights, beam } => {
                let lit = LitRows::new(timing, columns, weights, beam)?;
                let rows = camera_rows.map(|t| lit.classes(t)).collect();
                Self::Relit { rows, typical: lit.typical() }
            }
        })
    }

    fn len(&self) -> usize {
        match self {
            Self::Bands(bands) => bands.len(),
            Self::Relit { .. } => 1,
        }
    }

    /// The class of a pixel, its camera row counted from the first one; `None` if its weights do not depend on it.
    fn class(&self, t: usize, column: usize) -> Option<&LitClass> {
        match self {
            Self::Bands(_) => None,
            Self::Relit { rows, .. } => {
                rows[t].iter().find(|class| class.columns.binary_search(&column).is_ok())
            }
        }
    }

    /// The bounds of each sum by the projector row that pixels look at; `None` if the weights do not depend on it.
    fn bias_bounds(
        &self,
        family: &BiasOfFamily,
    ) -> Result<BTreeMap<Option<i64>, Vec<BiasBound>>, PlaneError> {
        match self {
            Self::Bands(bands) => {
                let bounds = (0..bands.len()).map(|index| family.bound(|u| self.weight(index, None, u)));
                Ok(BTreeMap::from([(None, bounds.collect::<Result<_, _>>()?)]))
            }
            Self::Relit { rows, typical } => {
                let own_rows: BTreeSet<i64> = rows.iter().flatten().map(|class| class.own_row).collect();
                let of_row = |own_row| {
                    let class = typical.at(own_row);
                    family.bound(|u| class.weight(u)).map(|bound| (Some(own_row), vec![bound]))
                };
                own_rows.into_par_iter().map(of_row).collect()
            }
        }
    }

    /// What the light of relative row `u` of a pixel of this class counts for.
    fn weight(&self, index: usize, class: Option<&LitClass>, u: i32) -> f64 {
        match self {
            Self::Bands(bands) => f64::from(u8::from(bands[index].iter().any(|range| range.contains(&u)))),
            Self::Relit { .. } => class.map_or(0.0, |class| class.weight(u)),
        }
    }
}

/// A camera row to be processed.
struct Data<'a> {
    /// Its index in the stack.
    t: usize,
    /// The row's part of the transport, `[reach, columns]`.
    profiles: ArrayView2<'a, f32>,
    /// The result, `[sums, columns]`.
    out: ArrayViewMut2<'a, f32>,
}

impl Problem<'_> {
    /// `H_FF^-1 e` for the weights `e` of each sum and the free rows `F` of each pixel of a tile, `[pixels * sums,
    /// slots]`. Times the weights it is the derivative of the sum with respect to each sample.
    fn solutions(
        &self,
        sums: &Sums,
        u_min: i32,
        tile: &Tile,
        rows: &[Row<Data>],
    ) -> Result<Array2<f64>, PlaneError> {
        let places: Vec<(usize, usize)> = self.places(u_min).collect();
        let shape = (tile.pixels.len() * sums.len(), self.model.slots.len());
        let mut linear = Array2::zeros(shape);
        let mut free = Array2::from_elem(shape, true);
        let of_pixels = linear.axis_chunks_iter_mut(Axis(0), sums.len());
        let of_pixels = of_pixels.zip(free.axis_chunks_iter_mut(Axis(0), sums.len()));
        for ((mut linear, mut free), &(at, column)) in of_pixels.zip(&tile.pixels) {
            let class = sums.class(rows[at].data.t, column);
            for (index, row) in linear.rows_mut().into_iter().enumerate() {
                self.put_weights(row, |u| sums.weight(index, class, u));
            }
            let lit = self.lit(&places, rows[at].data.profiles.column(column));
            free.rows_mut().into_iter().for_each(|mut free| free.assign(&lit));
        }
        let solutions = minimise_free(SimdLevel::best(), &self.quadratic, linear, free.view());
        match solutions.iter().all(|entry| entry.is_finite()) {
            true => Ok(solutions),
            false => Err(PlaneError::NotConvex),
        }
    }

    /// The weight of each unknown, `[slots]`, in a sum in which the light of relative row `u` has the weight
    /// `weight(u)`.
    fn put_weights(&self, mut of_slots: ArrayViewMut1<f64>, weight: impl Fn(i32) -> f64) {
        for (of_slot, slot) in of_slots.iter_mut().zip(&self.model.slots) {
            *of_slot = if slot.kind == SlotKind::Own { weight(slot.u) } else { 0.0 };
        }
        if let Some(Spike { own, neighbour, share }) = self.spike {
            of_slots[own] = (1.0 - share) * of_slots[own]
                + neighbour.map_or(0.0, |neighbour| share * of_slots[neighbour]);
        }
    }

    /// The unknowns that are free in a pixel's profile, by slot. Those that are not part of the profile count as
    /// free.
    fn lit(&self, places: &[(usize, usize)], profile: ArrayView1<f32>) -> Array1<bool> {
        self.unknowns(places, profile, 1.0).mapv(|light| light > 0.0)
    }

    /// The light of each unknown of the pixels of a tile, `[pixels, slots]`; 0 for those that are not part of profiles.
    fn light(&self, u_min: i32, tile: &Tile, rows: &[Row<Data>]) -> Array2<f64> {
        let places: Vec<(usize, usize)> = self.places(u_min).collect();
        let mut light = Array2::zeros((tile.pixels.len(), self.model.slots.len()));
        for (mut light, &(at, column)) in light.rows_mut().into_iter().zip(&tile.pixels) {
            let unknowns = self.unknowns(&places, rows[at].data.profiles.column(column), 0.0);
            light.assign(&unknowns.mapv(|light| f64::from(light.max(0.0))));
        }
        light
    }

    /// The light of each unknown in a pixel's profile; `otherwise` for those that are not part of the profile.
    fn unknowns(&self, places: &[(usize, usize)], profile: ArrayView1<f32>, otherwise: f32) -> Array1<f32> {
        let mut light = Array1::from_elem(self.model.slots.len(), otherwise);
        places.iter().for_each(|&(slot, place)| light[slot] = profile[place]);
        if let Some(Spike { own, neighbour: Some(neighbour), share }) = self.spike {
            // Direct light that falls on the neighbour's row does not count as the neighbour's own light.
            let share = share as f32;
            let direct = if share < 1.0 { light[own] / (1.0 - share) } else { light[neighbour] };
            light[own] = direct;
            light[neighbour] -= direct * (share + ROUNDING);
        }
        light
    }
}

/// The samples of one pixel.
struct Pixel {
    light: Array1<f64>,
    /// Before coupling, without that of dark images.
    variance: Array1<f64>,
    /// For each dark image, 1 for the samples from which it was subtracted, and its variance.
    darks: Vec<(Array1<f64>, f64)>,
    variance_ratio: f64,
}

impl Pixel {
    /// The samples of the given settings.
    fn new(of: &Uncertainty, samples: &Samples, settings: &[usize], t: usize, column: usize) -> Self {
        let light: Array1<f64> = settings.iter().map(|&n| f64::from(samples.stack[[n, t, column]])).collect();
        let variances =
            settings.iter().zip(&light).map(|(&n, &light)| of.noise.variance(light, of.frames[n]));
        let dark = |dark: &DarkImage| {
            let subtracted = settings.iter().map(|n| f64::from(u8::from(dark.settings.contains(n))));
            (subtracted.collect(), of.noise.variance(0.0, dark.frames))
        };
        Self {
            variance: variances.collect(),
            darks: of.darks.iter().map(dark).collect(),
            light,
            variance_ratio: samples.variance_ratio.map_or(1.0, |ratio| f64::from(ratio[[t, column]])),
        }
    }

    /// Variance of the sum of the samples weighted by `gains`.
    fn variance_of(&self, gains: ArrayView1<f64>) -> f64 {
        let independent = self.independent(gains);
        if self.variance_ratio == 1.0 {
            return independent;
        }
        // Coupling keeps the noise of the pixel's total, by which the whole profile is scaled.
        let of_total = self.independent(Array1::ones(gains.len()).view());
        let scaling = (gains.dot(&self.light) / self.light.sum()).powi(2) * of_total;
        self.variance_ratio * independent + (1.0 - self.variance_ratio) * scaling
    }

    /// The same before coupling.
    fn independent(&self, gains: ArrayView1<f64>) -> f64 {
        let darks = self.darks.iter().map(|(subtracted, variance)| variance * gains.dot(subtracted).powi(2));
        (&gains * &gains).dot(&self.variance) + darks.sum::<f64>()
    }
}
