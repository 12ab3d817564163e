//! How sharp a picture is.

use std::borrow::Cow;
use std::collections::VecDeque;

use ndarray::{Array2, ArrayView1, ArrayView2};
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
    before: Option<Array2<u16>>,
    scores: VecDeque<f64>,
    best: f64,
}

impl FocusMeter {
    /// The focus of the next picture, given by the counts of its region and their mean. With a mosaic, `step` is 2, so
    /// that only pixels of one colour are compared. `None` for the first picture, and where the mean is underexposed.
    pub fn add(
        &mut self,
        region: ArrayView2<u16>,
        mean_dn: f64,
        scale: &CountScale,
        step: usize,
    ) -> Option<Focus> {
        let size = region.dim();
        if mean_dn < scale.underexposed_dn() || size.0.min(size.1) <= 2 * step {
            self.restart();
            return None;
        }
        let before = self.before.take().filter(|before| before.dim() == size);
        let product = before.as_ref().map(|before| mean_product(before.view(), region, step));
        // The memory of the picture before is used again.
        let mut own = before.unwrap_or_else(|| Array2::zeros(size));
        own.assign(&region);
        self.before = Some(own);
        // Of a flat picture only noise is left, whose product may be negative.
        let score = (product? / (mean_dn - scale.black_dn).powi(2)).max(0.0);
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

/// Mean of the products of Sobel's gradients of two images of one size, without their border.
fn mean_product(one: ArrayView2<u16>, other: ArrayView2<u16>, step: usize) -> f64 {
    let (rows, columns) = one.dim();
    let size = (rows - 2 * step, columns - 2 * step);
    // Row by row, so that gradients do not leave the processor's cache.
    let memory = || [vec![0.0; 2 * size.1], vec![0.0; 2 * size.1]];
    let products = (0..size.0).into_par_iter().map_init(memory, |[a, b], t| {
        for (image, gradients) in [(one, &mut *a), (other, &mut *b)] {
            let near = [0, step, 2 * step].map(|down| counts(image.row(t + down)));
            let (across, along) = gradients.split_at_mut(size.1);
            sobel([&near[0], &near[1], &near[2]], step, across, along);
        }
        dot(a, b)
    });
    products.sum::<f64>() / (size.0 * size.1) as f64
}

/// The counts of a row, one after the other.
fn counts(row: ArrayView1<'_, u16>) -> Cow<'_, [u16]> {
    row.to_slice().map_or_else(|| row.to_vec().into(), Cow::from)
}

/// Sobel's gradient of a row, to the right and down, from the rows above, at and below it, as long as `across`. Sums of
/// counts are exact as integers, and as numbers below 2^24.
fn sobel(rows: [&[u16]; 3], step: usize, across: &mut [f32], along: &mut [f32]) {
    let length = across.len();
    let along = &mut along[..length];
    // The pixels around each, as rows of one length: bounds are checked here, and not for each pixel.
    let around = rows.map(|row| [0, step, 2 * step].map(|right| &row[right..][..length]));
    let [[up_left, up, up_right], [left, _, right], [down_left, down, down_right]] = around;
    for s in 0..length {
        let at = |pixels: &[u16]| i32::from(pixels[s]);
        let sum = |a, middle, b| at(a) + 2 * at(middle) + at(b);
        across[s] = (sum(up_right, right, down_right) - sum(up_left, left, down_left)) as f32;
        along[s] = (sum(down_left, down, down_right) - sum(up_left, up, up_right)) as f32;
    }
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
    use rand_xoshiro::Xoshiro256PlusPlus;
    use rand_xoshiro::rand_core::{Rng, SeedableRng};

    use super::*;

    const SCALE: CountScale = CountScale { black_dn: 64.0, saturation_dn: 3972.0, full_dn: 4095 };

    fn add(meter: &mut FocusMeter, picture: &Array2<u16>) -> Option<Focus> {
        let mean_dn = picture.iter().map(|&dn| f64::from(dn)).sum::<f64>() / picture.len() as f64;
        meter.add(picture.view(), mean_dn, &SCALE, 1)
    }

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
            assert_eq!(add(&mut meter, &picture(1)), None);
            add(&mut meter, &picture(2)).unwrap().score
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
            last = add(&mut meter, &stripes(width, 20.0, seed));
        }
        let rising = last.unwrap();
        assert_eq!((rising.tendency, rising.best), (Tendency::Rising, rising.score));
        for (seed, width) in (9..18).map(|step| (step, 4.0 + 0.5 * (step - 9) as f64)) {
            last = add(&mut meter, &stripes(width, 20.0, seed));
        }
        assert_eq!(last.unwrap().tendency, Tendency::Falling);
        assert!(last.unwrap().best > last.unwrap().score);
        let same: Vec<Tendency> = (18..66)
            .filter_map(|seed| Some(add(&mut meter, &stripes(6.0, 20.0, seed))?.tendency))
            .skip(COMPARED)
            .collect();
        let moving = same.iter().filter(|tendency| **tendency != Tendency::Steady).count();
        assert!(moving <= same.len() / 10, "{moving} of {}", same.len());
        meter.restart();
        assert_eq!(add(&mut meter, &stripes(4.0, 0.0, 0)), None);
        // Black, and too small.
        assert_eq!(add(&mut meter, &Array2::from_elem((64, 64), 64)), None);
        meter.restart();
        let small = Array2::from_elem((2, 64), 100);
        assert_eq!((add(&mut meter, &small), add(&mut meter, &small)), (None, None));
    }

    /// Sobel's operator as it is defined, pixel by pixel, on a part of an image, with the neighbours of both steps.
    #[test]
    fn the_score_is_that_of_the_definition() {
        const KERNEL: [[f64; 3]; 3] = [[-1.0, 0.0, 1.0], [-2.0, 0.0, 2.0], [-1.0, 0.0, 1.0]];
        let mut random = Xoshiro256PlusPlus::seed_from_u64(3);
        let mut picture = || Array2::from_shape_fn((23, 31), |_| (random.next_u64() >> 48) as u16);
        let pictures = [picture(), picture()];
        for step in [1, 2] {
            let part = |picture: &Array2<u16>| picture.slice(ndarray::s![2..20, 3..29]).to_owned();
            let [one, other] = [part(&pictures[0]), part(&pictures[1])];
            let gradient = |image: &Array2<u16>, t: usize, s: usize, is_down: bool| -> f64 {
                let of = |a: usize, b: usize| f64::from(image[[t + a * step, s + b * step]]);
                let weight = |a: usize, b: usize| if is_down { KERNEL[b][a] } else { KERNEL[a][b] };
                (0..9).map(|at| weight(at / 3, at % 3) * of(at / 3, at % 3)).sum()
            };
            let (rows, columns) = (18 - 2 * step, 26 - 2 * step);
            let pixels = (0..rows).flat_map(|t| (0..columns).map(move |s| (t, s)));
            let products = pixels.flat_map(|(t, s)| [false, true].map(|is_down| (t, s, is_down)));
            let sum: f64 =
                products.map(|(t, s, d)| gradient(&one, t, s, d) * gradient(&other, t, s, d)).sum();
            let expected = sum / (rows * columns) as f64;
            let regions = [&pictures[0], &pictures[1]].map(|it| it.slice(ndarray::s![2..20, 3..29]));
            let found = mean_product(regions[0], regions[1], step);
            assert!((found / expected - 1.0).abs() < 1e-4, "step {step}: {found} for {expected}");
        }
    }
}
