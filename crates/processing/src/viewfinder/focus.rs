//! How sharp a picture is.

use std::collections::VecDeque;

use ndarray::{ArrayView1, ArrayView2};
use rayon::prelude::*;

use super::levels::CountScale;

/// Scores that tell which way the focus goes: the newer half against the older.
const COMPARED: usize = 8;
/// Halves that differ by fewer standard errors do not differ: by chance, one in eighty does (Student's t, 6 degrees of
/// freedom).
const SIGMAS: f64 = 3.5;

/// Which way the focus goes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Tendency {
    /// The picture becomes sharper.
    Rising,
    /// The picture becomes less sharp.
    Falling,
    /// Neither can be told from noise.
    Steady,
}

/// How sharp a picture is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Focus {
    /// Tenengrad: mean of the squared gradient by Sobel's operator, over the square of the mean light. Exposure and gain
    /// do not change it. At least 0.
    pub score: f64,
    /// The best so far.
    pub best: f64,
    /// Which way it goes.
    pub tendency: Tendency,
}

/// Measures the focus of successive pictures.
///
/// The gradient of each picture is multiplied by that of the picture before, not by itself: noise, which differs between
/// them, then adds nothing to the score.
#[derive(Debug, Default)]
pub struct FocusMeter {
    before: Option<Gradients>,
    scores: VecDeque<f64>,
    best: f64,
}

impl FocusMeter {
    /// The focus of the next picture, given by the counts of its region. With a mosaic, `step` is 2, so that only
    /// pixels of one colour are compared. `None` for the first picture, and where the mean is underexposed.
    pub fn add(&mut self, region: ArrayView2<u16>, scale: &CountScale, step: usize) -> Option<Focus> {
        let sum: u64 = region.iter().map(|&dn| u64::from(dn)).sum();
        let mean = sum as f64 / region.len() as f64 - scale.black_dn;
        let Some(own) =
            Gradients::new(region, step).filter(|_| mean >= scale.underexposed_dn() - scale.black_dn)
        else {
            self.restart();
            return None;
        };
        let product = self.before.as_ref().and_then(|before| before.mean_product(&own));
        self.before = Some(own);
        // Of a flat picture only noise is left, whose product may be negative.
        let score = (product? / (mean * mean)).max(0.0);
        self.best = self.best.max(score);
        self.scores.push_back(score);
        if self.scores.len() > COMPARED {
            self.scores.pop_front();
        }
        Some(Focus { score, best: self.best, tendency: tendency(&self.scores) })
    }

    /// Forgets the best and the picture before, as after a change of picture, region or exposure.
    pub fn restart(&mut self) {
        *self = Self::default();
    }
}

/// Sobel's gradient of an image without its border.
#[derive(Debug)]
struct Gradients {
    /// Rows and columns.
    size: (usize, usize),
    /// To the right, then down: row by row, one after the other.
    rows: Vec<f32>,
}

impl Gradients {
    /// `None` if the image is too small.
    fn new(image: ArrayView2<u16>, step: usize) -> Option<Self> {
        let (rows, columns) = image.dim();
        let size = (rows.checked_sub(2 * step)?, columns.checked_sub(2 * step)?);
        if size.0 * size.1 == 0 {
            return None;
        }
        let mut gradients = vec![0.0; 2 * size.0 * size.1];
        gradients.par_chunks_mut(2 * size.1).enumerate().for_each(|(t, gradients)| {
            let [up, own, down] = [0, step, 2 * step].map(|down| light(image.row(t + down)));
            let smooth: Vec<f32> =
                up.iter().zip(&own).zip(&down).map(|((up, own), down)| up + 2.0 * own + down).collect();
            let fall: Vec<f32> = up.iter().zip(&down).map(|(up, down)| down - up).collect();
            let (across, along) = gradients.split_at_mut(size.1);
            let sides = smooth[2 * step..].iter().zip(&smooth);
            across.iter_mut().zip(sides).for_each(|(across, (right, left))| *across = right - left);
            let sides = fall[2 * step..].iter().zip(&fall).zip(&fall[step..]);
            let sums = along.iter_mut().zip(sides);
            sums.for_each(|(along, ((right, left), own))| *along = right + 2.0 * own + left);
        });
        Some(Self { size, rows: gradients })
    }

    /// Mean of the products of the gradients of two images; `None` if they differ in size.
    fn mean_product(&self, other: &Self) -> Option<f64> {
        let length = 2 * self.size.1;
        let rows = || self.rows.par_chunks(length).zip(other.rows.par_chunks(length));
        let sum = || rows().map(|(own, other)| dot(own, other)).sum::<f64>();
        (self.size == other.size).then(|| sum() / (self.size.0 * self.size.1) as f64)
    }
}

/// The counts of a row as numbers.
fn light(row: ArrayView1<u16>) -> Vec<f32> {
    let numbers = |row: &[u16]| row.iter().map(|&dn| f32::from(dn)).collect();
    row.as_slice().map_or_else(|| numbers(&row.to_vec()), numbers)
}

/// Numbers that are added up side by side, as vector units do.
const LANES: usize = 16;

fn dot(a: &[f32], b: &[f32]) -> f64 {
    let mut sums = [0.0_f32; LANES];
    let (a, b) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    let rest: f32 = a.remainder().iter().zip(b.remainder()).map(|(a, b)| a * b).sum();
    for (a, b) in a.zip(b) {
        sums.iter_mut().zip(a.iter().zip(b)).for_each(|(sum, (a, b))| *sum += a * b);
    }
    sums.iter().map(|&sum| f64::from(sum)).sum::<f64>() + f64::from(rest)
}

fn tendency(scores: &VecDeque<f64>) -> Tendency {
    if scores.len() < COMPARED {
        return Tendency::Steady;
    }
    let half = COMPARED / 2;
    let of = |from: usize| {
        let scores = || scores.iter().skip(from).take(half);
        let mean = scores().sum::<f64>() / half as f64;
        (mean, scores().map(|score| (score - mean).powi(2)).sum::<f64>() / (half - 1) as f64)
    };
    let ((older, older_variance), (newer, newer_variance)) = (of(0), of(half));
    let error = ((older_variance + newer_variance) / half as f64).sqrt();
    match newer - older {
        change if change.abs() <= SIGMAS * error => Tendency::Steady,
        change if change > 0.0 => Tendency::Rising,
        _ => Tendency::Falling,
    }
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;
    use rand_xoshiro::Xoshiro256PlusPlus;
    use rand_xoshiro::rand_core::{Rng, SeedableRng};

    use super::*;

    const SCALE: CountScale = CountScale { black_dn: 64.0, saturation_dn: 3972.0, full_dn: 4095 };

    /// Stripes that rise over `width` pixels, with uniform noise of this width.
    fn stripes(width: f64, noise_dn: f64, seed: u64) -> Array2<u16> {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
        Array2::from_shape_fn((64, 64), |(_, s)| {
            let phase = (s as f64 / 16.0).fract();
            let light = (((phase - 0.5).abs() * 16.0 - 4.0) / width).clamp(-0.5, 0.5) + 0.5;
            let noise = noise_dn * ((random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64 - 0.5);
            (64.0 + 1000.0 * light + noise + 400.0).round() as u16
        })
    }

    #[test]
    fn noise_adds_nothing_and_brightness_changes_nothing() {
        let score = |noise_dn: f64, scale: f64| {
            let mut meter = FocusMeter::default();
            let picture = |seed| {
                stripes(4.0, noise_dn, seed).mapv(|dn| (64.0 + scale * (f64::from(dn) - 64.0)).round() as u16)
            };
            assert_eq!(meter.add(picture(1).view(), &SCALE, 1), None);
            meter.add(picture(2).view(), &SCALE, 1).unwrap().score
        };
        let clean = score(0.0, 1.0);
        // A slope of 250 per pixel over half of the columns: (8 x 250)^2 where both neighbours lie on the slope.
        assert!((0.5..3.0).contains(&clean), "{clean}");
        assert!((score(0.0, 2.0) / clean - 1.0).abs() < 0.01);
        // Without the picture before, this noise would add 24 x 300^2 / 12, 180,000 of some million.
        assert!((score(300.0, 1.0) / clean - 1.0).abs() < 0.03, "{} of {clean}", score(300.0, 1.0));
    }

    #[test]
    fn the_tendency_follows_the_edges_and_restarts() {
        let mut meter = FocusMeter::default();
        let mut last = None;
        for (seed, width) in (0..9).map(|step| (step, 8.0 - 0.5 * step as f64)) {
            last = meter.add(stripes(width, 20.0, seed).view(), &SCALE, 1);
        }
        let rising = last.unwrap();
        assert_eq!((rising.tendency, rising.best), (Tendency::Rising, rising.score));
        for (seed, width) in (9..18).map(|step| (step, 4.0 + 0.5 * (step - 9) as f64)) {
            last = meter.add(stripes(width, 20.0, seed).view(), &SCALE, 1);
        }
        assert_eq!(last.unwrap().tendency, Tendency::Falling);
        assert!(last.unwrap().best > last.unwrap().score);
        let same: Vec<Tendency> = (18..66)
            .filter_map(|seed| Some(meter.add(stripes(6.0, 20.0, seed).view(), &SCALE, 1)?.tendency))
            .skip(COMPARED)
            .collect();
        let moving = same.iter().filter(|tendency| **tendency != Tendency::Steady).count();
        assert!(moving <= same.len() / 10, "{moving} of {}", same.len());
        meter.restart();
        assert_eq!(meter.add(stripes(4.0, 0.0, 0).view(), &SCALE, 1), None);
        // Black, and too small.
        assert_eq!(meter.add(Array2::from_elem((64, 64), 64).view(), &SCALE, 1), None);
        meter.restart();
        let small = Array2::from_elem((2, 64), 100);
        assert_eq!((meter.add(small.view(), &SCALE, 1), meter.add(small.view(), &SCALE, 1)), (None, None));
    }
}
