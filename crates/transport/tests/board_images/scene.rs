//! A simulated board: an independent model of projector, board and camera.

use ndarray::{Array2, Array3, Axis};
use rand_distr::{Distribution, Normal, StandardNormal};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;
use rayon::prelude::*;
use raysweep_transport::plane::board::images::{CodedPictures, Phases, SensorNoise};

pub const ELECTRONS_PER_DN: f64 = 1.66;
pub const READ_NOISE_E: f64 = 9.0;
pub const WHITE_DN: f64 = 2500.0;
pub const FULL_SCALE_DN: f32 = 4095.0;
pub const BLACK_LEVEL_DN: f64 = 64.0;

pub fn noise() -> SensorNoise {
    SensorNoise { electrons_per_dn: ELECTRONS_PER_DN, read_noise_e: READ_NOISE_E }
}

pub fn random(seed: u64) -> Xoshiro256PlusPlus {
    Xoshiro256PlusPlus::seed_from_u64(seed)
}

/// `1 + share x` with a standard normal `x` at each pixel.
pub fn uneven(shape: (usize, usize), share: f64, seed: u64) -> Array2<f64> {
    let mut random = random(seed);
    let normal = Normal::new(1.0, share).unwrap();
    Array2::from_shape_simple_fn(shape, || normal.sample(&mut random))
}

/// One frame of the light `[t, s]` in DN: shot noise, read noise, black level, 12 bits.
pub fn photographed(light_dn: &Array2<f64>, seed: u64) -> Array2<f32> {
    photographed_on(light_dn, &Array2::from_elem(light_dn.dim(), BLACK_LEVEL_DN), seed)
}

/// [`photographed`] with a dark image.
pub fn photographed_on(light_dn: &Array2<f64>, dark_dn: &Array2<f64>, seed: u64) -> Array2<f32> {
    let mut random = random(seed);
    ndarray::Zip::from(light_dn).and(dark_dn).map_collect(|light, dark| {
        // Shot noise of many electrons is normal; of a few it is far below the read noise.
        let electrons = light * ELECTRONS_PER_DN;
        let variance = electrons.max(0.0) + READ_NOISE_E.powi(2);
        let noise: f64 = StandardNormal.sample(&mut random);
        let dn = (electrons + variance.sqrt() * noise) / ELECTRONS_PER_DN + dark;
        dn.round().clamp(0.0, 4095.0) as f32
    })
}

/// Frames of the same light, each brighter or darker by `jitter`.
pub fn frames(light_dn: &Array2<f64>, n: usize, jitter: f64, seed: u64) -> Array3<f32> {
    let mut of_frames = random(seed);
    let normal = Normal::new(1.0, jitter).unwrap();
    let frames: Vec<Array2<f32>> = (0..n as u64)
        .map(|frame| photographed(&(light_dn * normal.sample(&mut of_frames)), seed * 1000 + frame))
        .collect();
    let views: Vec<_> = frames.iter().map(|frame| frame.view()).collect();
    ndarray::stack(Axis(0), &views).unwrap()
}

/// Light of one row over the board.
#[derive(Clone, Copy)]
pub enum Profile {
    /// Even from `up` rows above to `down` rows below.
    FlatTop {
        up: f64,
        down: f64,
    },
    Gaussian {
        sigma: f64,
    },
}

const STEP: f64 = 0.004;
const REACH: f64 = 12.0;

/// Light of one row up to each position relative to it.
pub struct Cumulative(Vec<f64>);

impl Cumulative {
    /// The board scatters by a Gaussian of `scatter_rows`.
    pub fn new(profile: Profile, scatter_rows: f64) -> Self {
        let n = (2.0 * REACH / STEP) as usize;
        let at = |i: usize| (i as f64 + 0.5) * STEP - REACH;
        let density: Vec<f64> = (0..n)
            .map(|i| match profile {
                Profile::FlatTop { up, down } => {
                    f64::from(u8::from((-up..down).contains(&at(i)))) / (up + down)
                }
                Profile::Gaussian { sigma } => (-(at(i) / sigma).powi(2) / 2.0).exp(),
            })
            .collect();
        let width = (5.0 * scatter_rows / STEP) as usize;
        let weights: Vec<f64> = (0..=2 * width)
            .map(|i| {
                let x = (i as f64 - width as f64) * STEP / scatter_rows.max(STEP);
                (-x * x / 2.0).exp()
            })
            .collect();
        let blurred = (0..n).map(|i| {
            let near = weights.iter().enumerate();
            near.map(|(j, weight)| weight * density.get((i + j).wrapping_sub(width)).unwrap_or(&0.0))
                .sum::<f64>()
        });
        let mut total = 0.0;
        let mut sums = vec![0.0];
        for light in blurred {
            total += light;
            sums.push(total);
        }
        Self(sums.into_iter().map(|sum| sum / total).collect())
    }

    fn until(&self, x: f64) -> f64 {
        let i = ((x + REACH) / STEP).clamp(0.0, (self.0.len() - 2) as f64);
        let low = i as usize;
        self.0[low] + (i - low as f64).min(1.0) * (self.0[low + 1] - self.0[low])
    }

    /// Share of the light of row `v` that falls on a pixel one row high whose centre is at `v + x`.
    pub fn share(&self, x: f64) -> f64 {
        self.until(x + 0.5) - self.until(x - 0.5)
    }
}

/// A board before projector and camera.
pub struct Scene {
    pub shape: (usize, usize),
    pub projector_rows: usize,
    /// Position in projector rows of each pixel's centre.
    pub centre: Array2<f64>,
    pub row: Cumulative,
    /// DN of white at each pixel: vignetting of 20 % and PRNU of 1 %.
    pub white: Array2<f64>,
    /// Brightness of each projector row, uneven by 1 %.
    pub brightness: Vec<f64>,
    /// A picture with few lit rows is brighter by this factor.
    pub boost: f64,
    /// Share of a second image of each row, 6 rows below it.
    pub ghost: f64,
    /// Share of each row's light that is spread over the whole board.
    pub haze: f64,
}

impl Scene {
    pub fn new(shape: (usize, usize), first_row: f64, degrees: f64, row: Cumulative, seed: u64) -> Self {
        let projector_rows = 720;
        let middle = |pixel: usize, of: usize| 2.0 * pixel as f64 / (of - 1) as f64 - 1.0;
        let slope = degrees.to_radians().tan();
        let centre = Array2::from_shape_fn(shape, |(t, s)| {
            let (x, y) = (middle(s, shape.1), middle(t, shape.0));
            let bend = 0.3 * x * x + 0.1 * x * y;
            first_row + 1.002 * t as f64 + slope * (s as f64 - shape.1 as f64 / 2.0) + bend
        });
        let prnu = uneven(shape, 0.01, seed * 7 + 1);
        let white = Array2::from_shape_fn(shape, |(t, s)| {
            let far = (middle(s, shape.1).powi(2) + middle(t, shape.0).powi(2)) / 2.0;
            WHITE_DN * (1.0 - 0.2 * far) * prnu[[t, s]]
        });
        let brightness = uneven((1, projector_rows), 0.01, seed * 7 + 2).into_iter().collect();
        Self { shape, projector_rows, centre, row, white, brightness, boost: 1.0, ghost: 0.0, haze: 0.0 }
    }

    /// The light of a picture in which the rows `on` are lit.
    pub fn picture(&self, on: impl Fn(usize) -> bool + Sync) -> Array2<f64> {
        let mut light = Array2::zeros(self.shape);
        let lit = (0..self.projector_rows).filter(|&v| on(v)).count() as f64 / self.projector_rows as f64;
        light.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(t, mut light)| {
            for (s, light) in light.iter_mut().enumerate() {
                let centre = self.centre[[t, s]];
                let near = (centre - 10.0).max(0.0) as usize
                    ..((centre + 10.0).max(0.0) as usize).min(self.projector_rows);
                let sharp: f64 = near
                    .filter(|&v| on(v))
                    .map(|v| {
                        let x = centre - v as f64;
                        let share =
                            (1.0 - self.ghost) * self.row.share(x) + self.ghost * self.row.share(x - 6.0);
                        self.brightness[v] * share
                    })
                    .sum();
                *light = self.white[[t, s]] * ((1.0 - self.haze) * sharp + self.haze * lit);
            }
        });
        light
    }

    /// True response of a pixel about row `own_row`, for rows of equal brightness.
    pub fn response(&self, t: usize, s: usize, own_row: i64) -> [f64; 16] {
        let shares =
            std::array::from_fn(|i| self.row.share(self.centre[[t, s]] - (own_row + i as i64 - 7) as f64));
        let sum: f64 = shares.iter().sum();
        shares.map(|share| share / sum)
    }

    /// True place: the centroid of the response.
    pub fn place(&self, t: usize, s: usize) -> f64 {
        let own_row = self.centre[[t, s]].round() as i64;
        let moment: f64 = self.response(t, s, own_row).iter().zip(-7..).map(|(k, d)| k * f64::from(d)).sum();
        own_row as f64 + moment
    }

    /// Mean of `n` frames, black level subtracted.
    fn mean(&self, light: &Array2<f64>, n: usize, seed: u64) -> Array2<f32> {
        let sum = (0..n as u64)
            .into_par_iter()
            .map(|frame| photographed(light, seed * 100 + frame))
            .reduce(|| Array2::zeros(self.shape), |a, b| a + b);
        sum / n as f32 - BLACK_LEVEL_DN as f32
    }

    pub fn pictures(&self, frames: usize, seed: u64) -> Pictures {
        let stack = |images: Vec<Array2<f32>>| {
            let views: Vec<_> = images.iter().map(|image| image.view()).collect();
            ndarray::stack(Axis(0), &views).unwrap()
        };
        let phases = (0..16).map(|m| {
            let light = self.picture(|v| v % 16 == m) * self.boost;
            self.mean(&light, frames, seed * 100 + m as u64)
        });
        let phases = stack(phases.collect());
        let code = (0..14).map(|n| {
            let bit = 6 - n / 2;
            let gray = |v: usize| ((v / 8) ^ (v / 16)) >> bit & 1;
            let light = self.picture(|v| gray(v) != n % 2);
            self.mean(&light, 1, seed * 100 + 20 + n as u64)
        });
        Pictures { phases, frames, code: stack(code.collect()) }
    }

    /// Frames of white and of black.
    pub fn white_and_black(&self, seed: u64) -> [Array3<f32>; 2] {
        let white = self.picture(|_| true);
        [frames(&white, 32, 0.0, seed * 10 + 1), frames(&Array2::zeros(self.shape), 32, 0.0, seed * 10 + 2)]
    }
}

pub struct Pictures {
    pub phases: Array3<f32>,
    pub frames: usize,
    pub code: Array3<f32>,
}

impl Pictures {
    pub fn phases(&self) -> Phases<'_> {
        Phases { images: self.phases.view(), frames: self.frames }
    }

    pub fn code(&self) -> CodedPictures<'_> {
        CodedPictures { images: self.code.view(), lines_per_block: 8 }
    }
}
