//! Block principal pivoting of many pixels that share a quadratic: exact in finitely many steps (Kim and Park, "Fast
//! Nonnegative Matrix Factorization: An Active-Set-Like Method and Comparisons", 2011, section 4).
//!
//! All pixels advance one step at a time. Before each step they are sorted by the size of their systems, so that
//! pixels sharing vector registers have the same amount of work. The result of a pixel is the same to the bit
//! whatever the other pixels are, so pixels may be combined in any way.

use aligned_vec::{AVec, avec};
use ndarray::{Array1, Array2, ArrayView2, Axis};
use pulp::{Simd, WithSimd};

use super::dense::Dense;
use super::narrow::NarrowWork;
use super::quadratic::{Padded, Quadratic};
use super::{SimdLevel, reference};

/// Full exchanges allowed without progress before the backup rule takes over (Kim and Park recommend 3).
const PATIENCE: usize = 3;

/// Steps after which a pixel is left to the reference solver; ordinary pixels take about five.
const MAX_STEPS: usize = 300;

/// Infeasibility below this share of the problem's own scale is attributed to rounding.
const TOLERANCE: f64 = 1e-11;

/// Length of runs for [`Start::Runs`]: shorter runs need more means to be solved, the pixels of longer ones differ
/// more.
pub const RUN_PX: usize = 64;

/// The initial set of free slots.
pub enum Start<'a> {
    /// The given slots, `[pixels, slots]`.
    Free(ArrayView2<'a, bool>),
    /// The pixels form consecutive runs of these lengths. Each starts from the free slots of the minimum for its
    /// run's mean, which has less noise than a neighbour's.
    Runs(&'a [usize]),
}

/// Minimises `x'Hx - 2 c'x` over `x >= 0` for pixels that share `H`. `linear` contains their `c`, `[pixels, slots]`
/// in standard layout; the result contains their `x`.
pub fn minimise(simd: SimdLevel, quadratic: &Quadratic, linear: Array2<f64>, start: &Start) -> Array2<f64> {
    if linear.is_empty() {
        return linear;
    }
    let unconstrained = unconstrained(quadratic, &linear);
    let mut slope = linear;
    slope.mapv_inplace(|c| -c);
    let mut free = Free::all(slope.nrows(), quadratic);
    match start {
        Start::Free(start) => free.set(*start),
        Start::Runs(lengths) => {
            let mut means = Free::all(lengths.len(), quadratic);
            let [mut slope, unconstrained] =
                [&slope, &unconstrained].map(|pixels| means_of_runs(pixels.view(), lengths));
            simd.run(Pivoting::new(quadratic, &unconstrained, &mut slope, &mut means));
            let numbers = lengths.iter().enumerate();
            let runs = numbers.flat_map(|(run, &length)| std::iter::repeat_n(run, length));
            runs.enumerate().for_each(|(pixel, run)| free.of_mut(pixel).copy_from_slice(means.of(run)));
        }
    }
    let given_up = simd.run(Pivoting::new(quadratic, &unconstrained, &mut slope, &mut free));
    for pixel in given_up {
        let c: Vec<f64> = slope.row(pixel).iter().map(|slope| -slope).collect();
        slope.row_mut(pixel).assign(&Array1::from(reference::minimise(quadratic.h(), &c)));
    }
    slope
}

/// Minimises `x'Hx - 2 c'x` with `x = 0` in all slots that are not free and any sign of `x` in the others. `free` is
/// `[pixels, slots]`; `linear` as in [`minimise`].
pub fn minimise_free(
    simd: SimdLevel,
    quadratic: &Quadratic,
    linear: Array2<f64>,
    free: ArrayView2<bool>,
) -> Array2<f64> {
    if linear.is_empty() {
        return linear;
    }
    let unconstrained = unconstrained(quadratic, &linear);
    let mut slope = linear;
    slope.mapv_inplace(|c| -c);
    let mut marks = Free::all(slope.nrows(), quadratic);
    marks.set(free);
    simd.run(Pivoting { aim: Aim::Free, ..Pivoting::new(quadratic, &unconstrained, &mut slope, &mut marks) });
    slope
}

/// The minima without constraints, `[pixels, slots]`. The chain solver does without them.
fn unconstrained(quadratic: &Quadratic, linear: &Array2<f64>) -> Array2<f64> {
    quadratic
        .dense()
        .map_or_else(|| Array2::zeros(linear.dim()), |inverse| linear.dot(&inverse.padded.view()))
}

fn means_of_runs(pixels: ArrayView2<f64>, lengths: &[usize]) -> Array2<f64> {
    let mut means = Array2::zeros((lengths.len(), pixels.ncols()));
    let mut rest = pixels;
    for (mut mean, &length) in means.rows_mut().into_iter().zip(lengths) {
        let (run, after) = rest.split_at(Axis(0), length);
        run.rows().into_iter().for_each(|pixel| mean += &pixel);
        mean /= length as f64;
        rest = after;
    }
    means
}

/// Marks of each pixel's slots: 1 for free slots, 0 for the others and for the padding of the quadratic's rows.
struct Free {
    stride: usize,
    marks: AVec<f64>,
}

impl Free {
    fn all(pixels: usize, quadratic: &Quadratic) -> Self {
        let (slots, stride) = (quadratic.slots(), quadratic.padded_h().stride);
        let mut free = Self { stride, marks: avec![0.0; pixels * stride] };
        free.marks.chunks_exact_mut(stride).for_each(|marks| marks[..slots].fill(1.0));
        free
    }

    fn set(&mut self, free: ArrayView2<bool>) {
        for (marks, free) in self.marks.chunks_exact_mut(self.stride).zip(free.rows()) {
            marks.iter_mut().zip(free).for_each(|(mark, &free)| *mark = f64::from(u8::from(free)));
        }
    }

    fn of(&self, pixel: usize) -> &[f64] {
        &self.marks[pixel * self.stride..(pixel + 1) * self.stride]
    }

    fn of_mut(&mut self, pixel: usize) -> &mut [f64] {
        &mut self.marks[pixel * self.stride..(pixel + 1) * self.stride]
    }

    fn count(&self, pixel: usize) -> usize {
        self.of(pixel).iter().filter(|mark| **mark == 1.0).count()
    }
}

/// The kind of minimum to compute.
#[derive(Clone, Copy)]
enum Aim {
    /// Over `x >= 0`.
    NonNegative,
    /// With the given free slots.
    Free,
}

/// The pivoting of a set of pixels.
struct Pivoting<'a> {
    aim: Aim,
    quadratic: &'a Quadratic,
    slots: usize,
    /// `H^-1 c`, `[pixels][slots]`.
    unconstrained: &'a [f64],
    /// Half the gradient at `x = 0`, `-c`, `[pixels][slots]`; overwritten with the minima.
    slope: &'a mut [f64],
    /// The free slots, in the end those of the minima.
    free: &'a mut Free,
}

/// The unknowns of a step's systems.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Side {
    /// `x` in the free slots `F`: `H_FF x_F = c_F`.
    Free,
    /// Half the gradient `g` in the slots that are not free, such that `x = H^-1 (c + g)` is zero there.
    Zero,
}

/// The state of a pixel's pivoting.
struct Pixel {
    number: usize,
    largest_c: f64,
    fewest: usize,
    patience: usize,
    steps: usize,
    /// Kind and size of the next step's system.
    side: Side,
    size: usize,
    state: State,
}

#[derive(PartialEq, Eq)]
enum State {
    Exchanging,
    Minimum,
    GaveUp,
}

impl<'a> Pivoting<'a> {
    /// Arrays are `[pixels, slots]` in standard layout.
    fn new(
        quadratic: &'a Quadratic,
        unconstrained: &'a Array2<f64>,
        slope: &'a mut Array2<f64>,
        free: &'a mut Free,
    ) -> Self {
        Self {
            aim: Aim::NonNegative,
            quadratic,
            slots: quadratic.slots(),
            unconstrained: unconstrained.as_slice().unwrap_or_default(),
            slope: slope.as_slice_mut().unwrap_or_default(),
            free,
        }
    }

    /// Sorts the pixels so that the next systems of neighbours are of the same kind and about the same size.
    fn sort(&self, pixels: &mut [Pixel]) {
        for pixel in &mut *pixels {
            let free = self.free.count(pixel.number);
            let zero = self.slots - free;
            let inverted =
                zero <= free && self.quadratic.dense().is_some_and(|inverse| inverse.is_well_conditioned);
            (pixel.side, pixel.size) = if inverted { (Side::Zero, zero) } else { (Side::Free, free) };
        }
        pixels.sort_unstable_by_key(|pixel| (pixel.side, pixel.size, pixel.number));
    }

    /// The matrix of a side's systems, the mark of the slots solved for, and the pixel's initial values in all slots.
    fn system(&self, side: Side, pixel: usize) -> (&Padded, f64, &[f64]) {
        let own = pixel * self.slots..(pixel + 1) * self.slots;
        match (side, self.quadratic.dense()) {
            (Side::Zero, Some(inverse)) => (&inverse.padded, 0.0, &self.unconstrained[own]),
            _ => (self.quadratic.padded_h(), 1.0, &self.slope[own]),
        }
    }
}

impl WithSimd for Pivoting<'_> {
    /// The pixels that pivoting gave up on, which the reference solver must handle.
    type Output = Vec<usize>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Vec<usize> {
        let slots = self.slots;
        let mut dense = Dense::new(simd, slots);
        let mut narrow = self.quadratic.narrow().map(|narrow| NarrowWork::new(simd, narrow));
        // The minimiser in free slots and half the gradient in the others: each is 0 where the other is not.
        let mut y = avec![0.0; self.free.stride];
        let mut exchanged = avec![0.0; self.free.stride];
        let mut given_up = Vec::new();
        let mut pixels: Vec<Pixel> = self.slope.chunks_exact(slots).enumerate().map(Pixel::new).collect();
        while !pixels.is_empty() {
            self.sort(&mut pixels);
            let batches =
                pixels.chunk_by_mut(|a, b| a.side == b.side).flat_map(|alike| alike.chunks_mut(S::F64_LANES));
            for batch in batches {
                let of = |pixel: &Pixel| self.system(pixel.side, pixel.number);
                let lanes = batch.iter().map(|pixel| (self.free.of(pixel.number), of(pixel).2));
                match &mut narrow {
                    Some(narrow) => narrow.solve(lanes),
                    None => dense.solve(of(&batch[0]).0, of(&batch[0]).1, lanes),
                }
                for (lane, pixel) in batch.iter_mut().enumerate() {
                    match &narrow {
                        Some(narrow) => narrow.take(lane, &mut y),
                        None => {
                            let (symmetric, _, before) = self.system(pixel.side, pixel.number);
                            y[..slots].copy_from_slice(before);
                            y[slots..].fill(0.0);
                            dense.spread(lane, symmetric, &mut y);
                        }
                    }
                    let least = match self.aim {
                        Aim::NonNegative => {
                            let costs = pixel.side == Side::Free && narrow.is_none();
                            pixel.exchange(simd, &y, costs, self.free.of_mut(pixel.number), &mut exchanged);
                            0.0
                        }
                        Aim::Free => {
                            pixel.state = State::Minimum;
                            f64::NEG_INFINITY
                        }
                    };
                    match pixel.state {
                        State::Exchanging => {}
                        State::GaveUp => given_up.push(pixel.number),
                        State::Minimum => {
                            let to = &mut self.slope[pixel.number * slots..(pixel.number + 1) * slots];
                            let free = self.free.of(pixel.number);
                            for ((x, y), free) in to.iter_mut().zip(y.iter()).zip(free) {
                                *x = if *free == 1.0 { y.max(least) } else { 0.0 };
                            }
                        }
                    }
                }
            }
            pixels.retain(|pixel| pixel.state == State::Exchanging);
        }
        given_up
    }
}

impl Pixel {
    fn new((number, slope): (usize, &[f64])) -> Self {
        let largest_c = slope.iter().fold(0.0_f64, |most, slope| most.max(slope.abs()));
        Self {
            number,
            largest_c,
            fewest: usize::MAX,
            patience: PATIENCE,
            steps: 0,
            side: Side::Free,
            size: 0,
            state: State::Exchanging,
        }
    }

    /// Finds slots with the wrong sign in a step's `y` and exchanges them. `free_costs`: the cost of a step grows
    /// with the number of free slots.
    #[inline(always)]
    fn exchange<S: Simd>(
        &mut self,
        simd: S,
        y: &[f64],
        free_costs: bool,
        free: &mut [f64],
        exchanged: &mut [f64],
    ) {
        let zero = simd.splat_f64s(0.0);
        let one = simd.splat_f64s(1.0);
        let (mut largest_x, mut sum, mut wrong) = (zero, zero, zero);
        let ys = S::as_simd_f64s(y).0;
        for (&y, &free) in ys.iter().zip(S::as_simd_f64s(free).0) {
            largest_x = simd.max_f64s(largest_x, simd.mul_f64s(free, simd.abs_f64s(y)));
            sum = simd.add_f64s(sum, y);
        }
        let x_limit = simd.splat_f64s(-TOLERANCE * simd.reduce_max_f64s(largest_x));
        let slope_limit = simd.splat_f64s(-TOLERANCE * self.largest_c);
        let to = S::as_mut_simd_f64s(exchanged).0;
        for ((&y, &free), to) in ys.iter().zip(S::as_simd_f64s(free).0).zip(to) {
            let limit = simd.select_f64s(simd.less_than_f64s(zero, free), x_limit, slope_limit);
            let is_wrong = simd.select_f64s(simd.less_than_f64s(y, limit), one, zero);
            wrong = simd.add_f64s(wrong, is_wrong);
            *to = simd.abs_f64s(simd.sub_f64s(free, is_wrong));
        }
        let wrong = simd.reduce_sum_f64s(wrong) as usize;
        self.steps += 1;
        // The sum is NaN or infinite if any of its terms is.
        if !simd.reduce_sum_f64s(sum).is_finite() || wrong > 0 && self.steps == MAX_STEPS {
            self.state = State::GaveUp;
        } else if wrong == 0 {
            self.state = State::Minimum;
        } else if wrong < self.fewest {
            (self.fewest, self.patience) = (wrong, PATIENCE);
            exchange_most(y, free_costs, free, exchanged);
        } else if self.patience > 0 {
            self.patience -= 1;
            exchange_most(y, free_costs, free, exchanged);
        } else if let Some(last) = (0..free.len()).rev().find(|&slot| free[slot] != exchanged[slot]) {
            // Exchanging only the last row cannot cycle (Murty), so the count eventually falls below `fewest`.
            free[last] = exchanged[last];
        }
    }
}

/// Exchanges all slots. If free slots make steps expensive, only the best of neighbouring slots becomes free: this is
/// usually enough, and the others would mostly have to be removed again.
#[inline(always)]
fn exchange_most(y: &[f64], free_costs: bool, free: &mut [f64], exchanged: &mut [f64]) {
    if free_costs {
        let neighbourhoods = y.windows(3).zip(free.windows(3));
        for ((y, free), exchanged) in neighbourhoods.zip(&mut exchanged[1..]) {
            let is_outdone_by = |other: usize| (free[other] == 0.0) & (y[other] < y[1]);
            let stays = (free[1] == 0.0) & (is_outdone_by(0) | is_outdone_by(2));
            *exchanged = if stays { 0.0 } else { *exchanged };
        }
    }
    free.copy_from_slice(exchanged);
}

#[cfg(test)]
mod tests {
    use ndarray::{Array2, ArrayView2, s};
    use proptest::prelude::*;
    use rand_xoshiro::Xoshiro256PlusPlus;
    use rand_xoshiro::rand_core::{Rng, SeedableRng};

    use super::super::super::{Slot, SlotKind};
    use super::super::Prior;
    use super::*;

    fn slots(count: usize) -> Vec<Slot> {
        (-(count as i32) / 2..).take(count).map(|u| Slot { u, kind: SlotKind::Own }).collect()
    }

    /// Solves pixels at every level that the machine supports, and compares each with the reference.
    fn equals_the_reference(quadratic: &Quadratic, linear: &Array2<f64>, start: &Start) {
        for level in SimdLevel::available() {
            let x = minimise(level, quadratic, linear.clone(), start);
            for (c, x) in linear.rows().into_iter().zip(x.rows()) {
                let expected = reference::minimise(quadratic.h(), &c.to_vec());
                let tolerance = 1e-8 * (1.0 + expected.iter().fold(0.0_f64, |a, b| a.max(b.abs())));
                for (x, expected) in x.iter().zip(&expected) {
                    assert!((x - expected).abs() < tolerance, "{}: {x} is not {expected}", level.name());
                }
            }
        }
    }

    /// Solves pixels one by one, and compares the results bit for bit with those of all pixels together.
    fn equals_itself_alone(quadratic: &Quadratic, linear: &Array2<f64>, start: &Array2<bool>) {
        for level in SimdLevel::available() {
            let together = minimise(level, quadratic, linear.clone(), &Start::Free(start.view()));
            for (pixel, expected) in together.rows().into_iter().enumerate() {
                let alone = |pixels: ArrayView2<f64>| {
                    let start = start.slice(s![pixel..=pixel, ..]);
                    minimise(level, quadratic, pixels.to_owned(), &Start::Free(start))
                };
                assert_eq!(alone(linear.slice(s![pixel..=pixel, ..])).row(0), expected, "{}", level.name());
            }
        }
    }

    fn random(seed: u64) -> impl FnMut() -> f64 {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
        move || (random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(100))]

        /// Any number of unknowns, settings and pixels; both sides of the pivoting, lanes without a pixel.
        #[test]
        fn any_size(slot_count in 1..40_usize, settings in 1..24_usize, pixels in 1..40_usize, beta in 0.0..2.0, split: bool, warm: bool, run in 1..9_usize, seed: u64) {
            let mut random = random(seed);
            let weights = Array2::from_shape_simple_fn((settings, slot_count), || (2.0 * random() - 1.0).max(0.0));
            let samples = Array2::from_shape_simple_fn((pixels, settings), || 4.0 * random() - 1.0);
            let free = Array2::from_shape_simple_fn((pixels, slot_count), || random() < 0.5);
            let prior = if split { Prior::Split { alpha: 0.01, beta } } else { Prior::Paper { alpha: 0.01, beta } };
            let quadratic = Quadratic::new(weights.view(), &slots(slot_count), &prior).unwrap();
            let linear = quadratic.linear(weights.view(), samples.view());
            let runs: Vec<usize> = (0..pixels).step_by(run).map(|first| run.min(pixels - first)).collect();
            let start = if warm { Start::Free(free.view()) } else { Start::Runs(&runs) };
            equals_the_reference(&quadratic, &linear, &start);
            equals_itself_alone(&quadratic, &linear, &free);
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]

        /// Few settings for many slots, which are solved along their chains: both priors, boxes and arbitrary
        /// weights, rows that no setting sees.
        #[test]
        fn few_settings(slot_count in 30..90_usize, settings in 1..9_usize, pixels in 1..20_usize, beta in 0.0..1.0, split: bool, warm: bool, boxes: bool, seed: u64) {
            let mut random = random(seed);
            let weights = match boxes {
                true => Array2::from_shape_fn((settings, slot_count), |(n, u)| f64::from((n * slot_count / settings).abs_diff(u) < 9)),
                false => Array2::from_shape_simple_fn((settings, slot_count), || (2.0 * random() - 1.0).max(0.0)),
            };
            let samples = Array2::from_shape_simple_fn((pixels, settings), || 4.0 * random() - 1.0);
            let free = Array2::from_shape_simple_fn((pixels, slot_count), || random() < 0.5);
            let prior = if split { Prior::Split { alpha: 0.1, beta } } else { Prior::Paper { alpha: 0.01, beta } };
            let quadratic = Quadratic::new(weights.view(), &slots(slot_count), &prior).unwrap();
            prop_assert_eq!(quadratic.narrow().is_some(), 3 * (settings + 1 + usize::from(split)) <= slot_count);
            let linear = quadratic.linear(weights.view(), samples.view());
            let runs = [pixels];
            let start = if warm { Start::Free(free.view()) } else { Start::Runs(&runs) };
            equals_the_reference(&quadratic, &linear, &start);
            equals_itself_alone(&quadratic, &linear, &free);
        }
    }

    #[test]
    fn the_largest_size() {
        // Boxes as of a sweep with 512 settings over 1024 rows.
        let weights =
            Array2::from_shape_fn((512, 1024), |(n, u)| f64::from((2 * n).abs_diff(u) < 20 + 10 * (n % 3)));
        let mut random = random(7);
        let light = Array2::from_shape_simple_fn((3, 1024), || (random() - 0.8).max(0.0));
        let samples = light.dot(&weights.t()).mapv_into(|light| light + 0.02 * (random() - 0.5));
        for prior in [Prior::PAPER, Prior::SPLIT] {
            let quadratic = Quadratic::new(weights.view(), &slots(1024), &prior).unwrap();
            let linear = quadratic.linear(weights.view(), samples.view());
            let minima = minimise(SimdLevel::best(), &quadratic, linear.clone(), &Start::Runs(&[2, 1]));
            for (x, c) in minima.rows().into_iter().zip(linear.rows()) {
                // Checks the optimality conditions, because the reference would take minutes.
                let gradient = quadratic.h().dot(&x) - c;
                let scale = c.iter().fold(0.0_f64, |most, c| most.max(c.abs()));
                for (x, gradient) in x.iter().zip(&gradient) {
                    let violation = if *x > 0.0 { gradient.abs() } else { -gradient };
                    assert!(*x >= 0.0 && violation <= 1e-9 * scale, "{prior:?}: {violation} of {scale}");
                }
            }
        }
    }

    #[test]
    fn numbers_out_of_range_are_given_up_and_not_looped_over() {
        let quadratic = Quadratic::new(Array2::eye(2).view(), &slots(2), &Prior::PAPER).unwrap();
        for level in SimdLevel::available() {
            let mut slope = ndarray::array![[f64::NAN, -1.0], [-1.0, -1.0]];
            let unconstrained = -&slope;
            let mut free = Free::all(2, &quadratic);
            let given_up = level.run(Pivoting::new(&quadratic, &unconstrained, &mut slope, &mut free));
            assert_eq!(given_up, [0]);
            assert!(slope.row(1).iter().all(|x| *x > 0.0), "{slope}");
        }
    }
}
