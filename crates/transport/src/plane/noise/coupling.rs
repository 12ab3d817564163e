use ndarray::{Array2, Array3, ArrayView3, ArrayViewMut1, ArrayViewMut2, Axis, s};
use rayon::prelude::*;

use super::super::PlaneError;
use super::{NoiseModel, check_shapes};

/// Spatial coupling: averages neighbouring pixels of a stack that see the same kind of light, before
/// [`super::super::Demux`] solves each pixel by itself.
///
/// Neighbours on one surface receive the same light from the same relative rows, except for their albedo. A
/// neighbour's stack is therefore scaled to the pixel's own total over the settings, which cancels texture, and
/// compared with the pixel's. Differences beyond the noise of both are treated as bias, and the larger the bias, the
/// smaller the neighbour's weight. This is a joint bilateral filter (Petschnigg et al., "Digital Photography with
/// Flash and No-Flash Image Pairs", SIGGRAPH 2004) that compares whole vectors, as non-local means does (Buades et
/// al., "A Non-Local Algorithm for Image Denoising", CVPR 2005); here the vector is the stack. As noise vanishes, the
/// filter becomes the identity.
///
/// A pixel depends only on those up to [`Self::radius_px`] rows and columns away: a tile with that halo gives the
/// same bits as the whole image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Coupling {
    /// The window is `2 radius_px + 1` pixels wide and high; 0 leaves the stack unchanged. Time grows with its area.
    pub radius_px: usize,
}

impl Default for Coupling {
    /// 7 x 7 pixels: wider windows find few more similar pixels.
    fn default() -> Self {
        Self { radius_px: 3 }
    }
}

/// The result of [`Coupling::apply`].
#[derive(Debug, Clone, PartialEq)]
pub struct Coupled {
    /// Same shape and units as the input stack. Masked samples are unchanged.
    pub stack: Array3<f32>,
    /// Share of the noise variance that remains in each pixel, `[t, s]`: 1 if no neighbour contributed, 1/49 if all
    /// of a 7 x 7 window did. It applies to the profile's shape; the noise of a pixel's total over the settings
    /// stays.
    pub variance_ratio: Array2<f32>,
}

/// How fast a neighbour's weight falls with its bias. Chosen on the corner and on the simulator's scenes together,
/// where 30 gives results that mostly lie within 12 % of these.
const BIAS_WEIGHT: f32 = 10.0;
/// A pixel's total must exceed its own noise by this factor for the pixel to be scaled to others.
const MIN_TOTAL_SD: f32 = 3.0;
/// Columns that are computed together: two vectors on the machine with the narrowest vectors.
const LANES: usize = 8;
type Lanes = [f32; LANES];
/// Keeps quotients defined where neither the light nor the model has any noise.
const MIN_VARIANCE: f32 = 1e-20;

impl Coupling {
    /// Averages similar neighbours in `stack`, `[settings, t, s]`, whose images are means of `frames[setting]`
    /// frames.
    ///
    /// `valid`, of the same shape, tells which samples may be used: invalid ones are neither changed nor used, and
    /// pixels are compared over the settings that are valid in both. A pixel whose total does not exceed its noise is
    /// neither changed nor used. Rows are processed in parallel, with the same bits for any number of threads.
    ///
    /// # Errors
    /// [`PlaneError::Shape`] if `valid` or `frames` do not fit; [`PlaneError::NotFinite`] for a NaN or an infinity,
    /// masked or not; [`PlaneError::OutOfRange`] for a negative noise or a setting without frames.
    pub fn apply(
        &self,
        stack: ArrayView3<f32>,
        valid: Option<ArrayView3<bool>>,
        noise: &NoiseModel,
        frames: &[usize],
    ) -> Result<Coupled, PlaneError> {
        noise.check()?;
        check_shapes(stack, valid, frames)?;
        if let Some(((setting, row, column), _)) =
            stack.indexed_iter().find(|(_, sample)| !sample.is_finite())
        {
            return Err(PlaneError::NotFinite { setting, row, column });
        }
        let noise = frames.iter().map(|&frames| SampleNoise::new(noise, frames)).collect();
        let images = Images { stack, valid, noise, radius_px: self.radius_px };
        let (_, rows, columns) = stack.dim();
        let mut coupled = Coupled { stack: stack.to_owned(), variance_ratio: Array2::ones((rows, columns)) };
        let out = coupled.stack.axis_iter_mut(Axis(1)).into_par_iter();
        let ratios = coupled.variance_ratio.axis_iter_mut(Axis(0)).into_par_iter();
        // The compiler uses vectors as wide as the machine's; the bits are the same at any width.
        let arch = pulp::Arch::new();
        out.zip(ratios).enumerate().for_each(|(t, (out, ratio))| {
            arch.dispatch(
                #[inline(always)]
                || images.couple_row(t, out, ratio),
            );
        });
        Ok(coupled)
    }
}

/// Data shared by all rows.
struct Images<'a> {
    stack: ArrayView3<'a, f32>,
    valid: Option<ArrayView3<'a, bool>>,
    noise: Vec<SampleNoise>,
    radius_px: usize,
}

impl Images<'_> {
    /// Couples camera row `t`: `out` `[settings, columns]` contains its samples, `ratio` `[columns]` ones.
    #[inline(always)]
    fn couple_row(&self, t: usize, mut out: ArrayViewMut2<f32>, mut ratio: ArrayViewMut1<f32>) {
        let (settings, rows, columns) = self.stack.dim();
        let window = t.saturating_sub(self.radius_px)..=(t + self.radius_px).min(rows - 1);
        let window: Vec<Row> = window.map(|t| self.row(t)).collect();
        let own = &window[t.min(self.radius_px)];
        for first in (0..columns).step_by(LANES) {
            let mut means = Means::new(settings);
            for other in &window {
                for shift in 0..=2 * self.radius_px {
                    let neighbours = Neighbours::compare(
                        &self.noise,
                        |n| own.at(n, first + self.radius_px),
                        |n| other.at(n, first + shift),
                    );
                    means.add(&neighbours, |n| other.at(n, first + shift));
                }
            }
            for lane in 0..LANES.min(columns - first) {
                let column = first + lane;
                if means.weight[lane] > 0.0 {
                    ratio[column] = means.variance[lane] / means.weight[lane].powi(2);
                }
                for n in 0..settings {
                    let valid = own.at(n, column + self.radius_px).1[0] > 0.0;
                    if valid && means.weights[n][lane] > 0.0 {
                        out[[n, column]] = means.sums[n][lane] / means.weights[n][lane];
                    }
                }
            }
        }
    }

    /// Camera row `t`, padded with masked samples for windows that reach beyond the border.
    fn row(&self, t: usize) -> Row {
        let (settings, _, columns) = self.stack.dim();
        // Lanes may begin at any column.
        let width = columns + 2 * self.radius_px + LANES;
        let mut row = Row { width, samples: vec![0.0; settings * width], valid: vec![0.0; settings * width] };
        for n in 0..settings {
            let inner = n * width + self.radius_px..n * width + self.radius_px + columns;
            let samples = self.stack.slice(s![n, t, ..]);
            row.samples[inner.clone()].iter_mut().zip(samples).for_each(|(to, &from)| *to = from);
            match self.valid {
                None => row.valid[inner].fill(1.0),
                Some(valid) => {
                    let valid = valid.slice_move(s![n, t, ..]);
                    row.valid[inner].iter_mut().zip(valid).for_each(|(to, &from)| *to = f32::from(from));
                }
            }
        }
        row
    }
}

/// A camera row, `[settings, width]`, flat.
struct Row {
    width: usize,
    samples: Vec<f32>,
    /// 1 for a valid sample, 0 for a masked one.
    valid: Vec<f32>,
}

impl Row {
    /// Samples of one setting starting at column `first` of the padded row, and their validity.
    #[inline(always)]
    fn at(&self, setting: usize, first: usize) -> (Lanes, Lanes) {
        let first = setting * self.width + first;
        let lanes = |values: &[f32]| {
            let values = &values[first..first + LANES];
            std::array::from_fn(|lane| values[lane])
        };
        (lanes(&self.samples), lanes(&self.valid))
    }
}

/// The [`NoiseModel`] for the mean of one setting's frames.
#[derive(Clone, Copy)]
struct SampleNoise {
    read_variance: f32,
    gain: f32,
}

impl SampleNoise {
    fn new(noise: &NoiseModel, frames: usize) -> Self {
        let frames = frames as f64;
        Self { read_variance: (noise.read_variance / frames) as f32, gain: (noise.gain / frames) as f32 }
    }

    #[inline(always)]
    fn variance(self, sample: f32) -> f32 {
        self.read_variance + self.gain * sample.max(0.0)
    }
}

/// One neighbour of each of several pixels.
struct Neighbours {
    /// Factor that scales the neighbour to the pixel's total over the settings valid in both.
    scale: Lanes,
    /// Weight of the neighbour; 0 if it cannot be used.
    weight: Lanes,
    /// Variance of the scaled neighbour relative to that of the pixel.
    variance: Lanes,
}

impl Neighbours {
    /// Compares pixels with neighbours; `own` and `other` return samples and validity of a setting.
    #[inline(always)]
    fn compare(
        noise: &[SampleNoise],
        own: impl Fn(usize) -> (Lanes, Lanes),
        other: impl Fn(usize) -> (Lanes, Lanes),
    ) -> Self {
        let [mut own_total, mut own_variance, mut other_total, mut other_variance, mut settings] =
            [[0.0; LANES]; 5];
        for (n, noise) in noise.iter().enumerate() {
            let ((own, own_valid), (other, other_valid)) = (own(n), other(n));
            for lane in 0..LANES {
                let shared = own_valid[lane] * other_valid[lane];
                settings[lane] += shared;
                own_total[lane] += shared * own[lane];
                other_total[lane] += shared * other[lane];
                own_variance[lane] += shared * noise.variance(own[lane]);
                other_variance[lane] += shared * noise.variance(other[lane]);
            }
        }
        let scale: Lanes = std::array::from_fn(|lane| {
            let stands_out = |total: f32, variance: f32| total > MIN_TOTAL_SD * variance.sqrt();
            let own_stands_out = stands_out(own_total[lane], own_variance[lane]);
            // Too few common settings determine neither the scale nor the difference.
            let comparable = 2.0 * settings[lane] >= noise.len() as f32;
            match comparable && own_stands_out && stands_out(other_total[lane], other_variance[lane]) {
                true => own_total[lane] / other_total[lane],
                false => 0.0,
            }
        });

        let mut squares = [0.0; LANES];
        for (n, noise) in noise.iter().enumerate() {
            let ((own, own_valid), (other, other_valid)) = (own(n), other(n));
            for lane in 0..LANES {
                let difference = own[lane] - scale[lane] * other[lane];
                let variance =
                    noise.variance(own[lane]) + scale[lane] * scale[lane] * noise.variance(other[lane]);
                let shared = own_valid[lane] * other_valid[lane];
                squares[lane] += shared * difference * difference / (variance + MIN_VARIANCE);
            }
        }

        let mut neighbours = Self { scale, weight: [0.0; LANES], variance: [0.0; LANES] };
        for lane in 0..LANES {
            if scale[lane] > 0.0 {
                let variance =
                    scale[lane] * scale[lane] * other_variance[lane] / (own_variance[lane] + MIN_VARIANCE);
                // The excess of the squares over noise, in units of the noise of both; the scale takes one degree of
                // freedom. Chance alone gives a few tenths, which are harmless once squared.
                let bias = (squares[lane] / (settings[lane] - 1.0).max(1.0) - 1.0).max(0.0);
                let spread = variance + BIAS_WEIGHT * bias * bias * (1.0 + variance);
                neighbours.weight[lane] = 1.0 / (spread + MIN_VARIANCE);
                neighbours.variance[lane] = variance;
            }
        }
        neighbours
    }
}

/// The weighted means of several pixels during summation.
struct Means {
    /// Sum for each setting, and the weights in it.
    sums: Vec<Lanes>,
    weights: Vec<Lanes>,
    /// Sum of the weights of all neighbours, and the variance that they contribute.
    weight: Lanes,
    variance: Lanes,
}

impl Means {
    fn new(settings: usize) -> Self {
        let zeros = vec![[0.0; LANES]; settings];
        Self { sums: zeros.clone(), weights: zeros, weight: [0.0; LANES], variance: [0.0; LANES] }
    }

    /// Adds a neighbour of each pixel; `samples` returns samples and validity of a setting.
    #[inline(always)]
    fn add(&mut self, neighbours: &Neighbours, samples: impl Fn(usize) -> (Lanes, Lanes)) {
        let Neighbours { scale, weight, variance } = neighbours;
        for lane in 0..LANES {
            self.weight[lane] += weight[lane];
            self.variance[lane] += weight[lane] * weight[lane] * variance[lane];
        }
        for (n, (sums, weights)) in self.sums.iter_mut().zip(&mut self.weights).enumerate() {
            let (samples, valid) = samples(n);
            for lane in 0..LANES {
                let weight = valid[lane] * weight[lane];
                sums[lane] += weight * scale[lane] * samples[lane];
                weights[lane] += weight;
            }
        }
    }
}
