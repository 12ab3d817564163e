//! Block principal pivoting of many pixels at once, one in each lane of the vector registers.

use aligned_vec::{AVec, avec};
use ndarray::{ArrayView1, ArrayView2};
use pulp::{Simd, WithSimd};

use super::narrow::NarrowWork;
use super::pivot::{MAX_STEPS, PATIENCE, TOLERANCE};
use super::quadratic::Quadratic;

/// Rows and columns of the blocks in which matrices are factored: 4 x 2 sums stay in registers at every vector width.
const BLOCK: usize = 4;

/// Lanes of the widest registers, AVX-512's.
const MAX_LANES: usize = 8;

/// Minimises `x'Hx - 2 c'x` over `x >= 0` for pixels that share `H`, as [`super::pivot::Pivoting`] does for one.
///
/// Each lane works through pixels of its own: once it has a minimum it takes the next pixel, and starts it from the
/// free rows of the one before, while the other lanes go on. So lanes never wait for the slowest pixel of a group.
pub(super) struct Lanes<'a, F> {
    /// The objective that all pixels share.
    pub quadratic: &'a Quadratic,
    /// `c` of each pixel, `[pixels, slots]`, in standard layout.
    pub linear: ArrayView2<'a, f64>,
    /// `H^-1 c` of each pixel, `[pixels, slots]`, in standard layout.
    pub unconstrained: ArrayView2<'a, f64>,
    /// The free slots that each pixel starts from, `[pixels, slots]`; without them, those of the lane's last pixel.
    pub start: Option<ArrayView2<'a, bool>>,
    /// Takes a pixel's minimum: its number, and its slots' values. Pixels come in no particular order.
    pub minimum: F,
}

impl<F: FnMut(usize, &mut dyn Iterator<Item = f64>)> WithSimd for Lanes<'_, F> {
    /// The pixels that pivoting gave up on, left to the reference solver.
    type Output = Vec<usize>;

    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Vec<usize> {
        const { assert!(S::F64_LANES <= MAX_LANES) };
        let Self { quadratic, linear, unconstrained, start, mut minimum } = self;
        let (pixels, slots) = linear.dim();
        let mut work = Work::new(simd, slots, quadratic);
        let mut given_up = Vec::new();
        let mut next = 0;
        loop {
            for lane in 0..S::F64_LANES {
                if work.lanes[lane].is_none() && next < pixels {
                    let start = start.as_ref().map(|start| start.row(next));
                    work.load(lane, next, linear.row(next), unconstrained.row(next), start);
                    next += 1;
                }
            }
            if work.lanes.iter().all(Option::is_none) {
                return given_up;
            }
            work.solve();
            work.exchange(|lane, pixel, work| minimum(pixel, &mut work.profile(lane)), &mut given_up);
        }
    }
}

/// A lane's pixel, and how its pivoting goes.
#[derive(Clone, Copy)]
struct Lane {
    pixel: usize,
    largest_c: f64,
    fewest: usize,
    patience: usize,
    steps: usize,
}

/// The state of all lanes. Arrays over slots hold the lanes' values side by side, `[slots][lanes]`.
struct Work<'a, S: Simd> {
    simd: S,
    slots: usize,
    h: &'a [f64],
    /// The inverse of `H`, where it may be used.
    inverse: Option<&'a [f64]>,
    lanes: Vec<Option<Lane>>,
    /// Whether a slot is free in a lane; it starts as the lane's last pixel left it.
    free: Vec<bool>,
    c: AVec<f64>,
    unconstrained: AVec<f64>,
    /// The minimiser in free slots and half the gradient in the others: each is 0 where the other is not.
    y: AVec<f64>,
    /// The slots that are solved for, in each lane from the top, then `slots` for want of more.
    rows: Vec<u32>,
    /// How many they are.
    counts: Vec<usize>,
    /// `[n][n][lanes]`, as large as it was ever needed.
    matrix: AVec<f64>,
    rhs: AVec<f64>,
    reciprocals: AVec<f64>,
    /// Solves the systems instead, where there are few settings for many rows.
    narrow: Option<NarrowWork<'a, S>>,
}

impl<'a, S: Simd> Work<'a, S> {
    #[inline(always)]
    fn new(simd: S, slots: usize, quadratic: &'a Quadratic) -> Self {
        let lanes = S::F64_LANES;
        let zeros = |length: usize| avec![0.0; length * lanes];
        let padded = slots.next_multiple_of(BLOCK);
        Self {
            simd,
            slots,
            h: quadratic.padded_h(),
            inverse: quadratic.padded_inverse(),
            lanes: vec![None; lanes],
            free: vec![true; slots * lanes],
            c: zeros(slots),
            unconstrained: zeros(slots),
            y: zeros(slots),
            rows: vec![0; padded * lanes],
            counts: vec![0; lanes],
            matrix: zeros(slots),
            rhs: zeros(padded),
            reciprocals: zeros(padded),
            narrow: quadratic.narrow().map(|narrow| NarrowWork::new(simd, narrow)),
        }
    }

    /// Gives a lane its next pixel.
    #[inline(always)]
    fn load(
        &mut self,
        lane: usize,
        pixel: usize,
        c: ArrayView1<f64>,
        unconstrained: ArrayView1<f64>,
        start: Option<ArrayView1<bool>>,
    ) {
        let lanes = S::F64_LANES;
        let mut largest_c = 0.0_f64;
        for (slot, (&c, &unconstrained)) in c.iter().zip(unconstrained).enumerate() {
            self.c[slot * lanes + lane] = c;
            self.unconstrained[slot * lanes + lane] = unconstrained;
            largest_c = largest_c.max(c.abs());
        }
        for (slot, &free) in start.iter().flatten().enumerate() {
            self.free[slot * lanes + lane] = free;
        }
        self.lanes[lane] = Some(Lane { pixel, largest_c, fewest: usize::MAX, patience: PATIENCE, steps: 0 });
    }

    /// A lane's minimiser.
    fn profile(&self, lane: usize) -> impl Iterator<Item = f64> {
        let lanes = S::F64_LANES;
        (lane..self.y.len()).step_by(lanes).map(|at| if self.free[at] { self.y[at].max(0.0) } else { 0.0 })
    }

    /// Sets `y` in all lanes, by whichever of the settings, the free slots and the others are fewer.
    #[inline(always)]
    fn solve(&mut self) {
        if let Some(narrow) = &mut self.narrow {
            narrow.solve(&self.free, &self.c, &mut self.y);
            return;
        }
        let lanes = S::F64_LANES;
        let mut free = [0; MAX_LANES];
        for flags in self.free.chunks_exact(lanes) {
            (0..lanes).for_each(|lane| free[lane] += usize::from(flags[lane]));
        }
        let busy = || (0..lanes).filter(|&lane| self.lanes[lane].is_some());
        let most_free = busy().map(|lane| free[lane]).max().unwrap_or(0);
        let most_zero = busy().map(|lane| self.slots - free[lane]).max().unwrap_or(0);
        match self.inverse.filter(|_| most_zero <= most_free) {
            Some(inverse) => {
                // x = H^-1 (c + g) with g != 0 only in the zero slots, where x = 0 determines it.
                self.list(false);
                self.gather(inverse, |work, at| -work.unconstrained[at]);
                self.factor();
                self.substitute();
                self.y.copy_from_slice(&self.unconstrained);
                self.spread(inverse);
            }
            None => {
                self.list(true);
                let h = self.h;
                self.gather(h, |work, at| work.c[at]);
                self.factor();
                self.substitute();
                self.y.iter_mut().zip(self.c.iter()).for_each(|(y, c)| *y = -c);
                self.spread(h);
            }
        }
    }

    /// Lists the slots of each busy lane that are free, or those that are not.
    #[inline(always)]
    fn list(&mut self, wanted: bool) {
        let lanes = S::F64_LANES;
        let mut counts = [0; MAX_LANES];
        let busy: [bool; MAX_LANES] = std::array::from_fn(|lane| lane < lanes && self.lanes[lane].is_some());
        for (slot, flags) in self.free.chunks_exact(lanes).enumerate() {
            for lane in 0..lanes {
                // Written in any case and kept if it counts: no branch to mispredict.
                self.rows[counts[lane] * lanes + lane] = slot as u32;
                counts[lane] += usize::from(flags[lane] == wanted && busy[lane]);
            }
        }
        self.counts.copy_from_slice(&counts[..lanes]);
        let n = self.size();
        for (lane, &count) in counts[..lanes].iter().enumerate() {
            (count..n).for_each(|k| self.rows[k * lanes + lane] = self.slots as u32);
        }
    }

    /// Size of the systems: rows of the largest, in whole blocks.
    #[inline(always)]
    fn size(&self) -> usize {
        self.counts.iter().copied().max().unwrap_or(0).next_multiple_of(BLOCK)
    }

    /// Collects each lane's rows and columns of `symmetric` and its right-hand side, padded by the identity.
    #[inline(always)]
    fn gather(&mut self, symmetric: &[f64], rhs: impl Fn(&Self, usize) -> f64) {
        let lanes = S::F64_LANES;
        let (stride, n) = (self.slots + 1, self.size());
        if self.matrix.len() < n * n * lanes {
            self.matrix.resize(n * n * lanes, 0.0);
        }
        for k in 0..n {
            let rows: [&[f64]; MAX_LANES] = std::array::from_fn(|lane| match lane < lanes {
                true => {
                    let start = self.rows[k * lanes + lane] as usize * stride;
                    &symmetric[start..start + stride]
                }
                false => &[],
            });
            let line = &mut self.matrix[k * n * lanes..(k * n + k + 1) * lanes];
            for (cells, columns) in line.chunks_exact_mut(lanes).zip(self.rows.chunks_exact(lanes)) {
                for lane in 0..lanes {
                    cells[lane] = rows[lane][columns[lane] as usize];
                }
            }
            for lane in 0..lanes {
                let padding = k >= self.counts[lane];
                self.matrix[(k * n + k) * lanes + lane] += f64::from(padding);
                let at = self.rows[k * lanes + lane] as usize * lanes + lane;
                self.rhs[k * lanes + lane] = if padding { 0.0 } else { rhs(self, at) };
            }
        }
    }

    /// Cholesky factors of all lanes' matrices, blocks of 4 x 4 from left to right.
    #[inline(always)]
    fn factor(&mut self) {
        let n = self.size();
        let simd = self.simd;
        let matrix = S::as_mut_simd_f64s(&mut self.matrix).0;
        let reciprocals = S::as_mut_simd_f64s(&mut self.reciprocals).0;
        let one = simd.splat_f64s(1.0);
        for i in (0..n).step_by(BLOCK) {
            let (above, rest) = matrix.split_at_mut(i * n);
            let rows = &mut rest[..BLOCK * n];
            for j in (0..i).step_by(BLOCK) {
                let columns = &above[j * n..(j + BLOCK) * n];
                subtract_products(simd, rows, columns, n, j, j);
                // The block against the factor of its own columns.
                for c in 0..BLOCK {
                    for r in 0..BLOCK {
                        let mut value = rows[r * n + j + c];
                        for k in 0..c {
                            value = simd.negate_mul_add_e_f64s(
                                rows[r * n + j + k],
                                above[(j + c) * n + j + k],
                                value,
                            );
                        }
                        rows[r * n + j + c] = simd.mul_f64s(value, reciprocals[j + c]);
                    }
                }
            }
            // The diagonal block: less the products of its own rows, then factored by itself.
            subtract_own_products(simd, rows, n, i);
            for r in 0..BLOCK {
                for c in 0..=r {
                    let mut value = rows[r * n + i + c];
                    for k in 0..c {
                        value = simd.negate_mul_add_e_f64s(rows[r * n + i + k], rows[c * n + i + k], value);
                    }
                    if c < r {
                        rows[r * n + i + c] = simd.mul_f64s(value, reciprocals[i + c]);
                    } else {
                        // A pivot that is not positive gives NaN here, which no later step mistakes for a minimum.
                        let pivot = simd.sqrt_f64s(value);
                        rows[r * n + i + c] = pivot;
                        reciprocals[i + c] = simd.div_f64s(one, pivot);
                    }
                }
            }
        }
    }

    /// Replaces the right-hand sides by the solutions.
    #[inline(always)]
    fn substitute(&mut self) {
        let n = self.size();
        let simd = self.simd;
        let matrix = S::as_simd_f64s(&self.matrix).0;
        let reciprocals = S::as_simd_f64s(&self.reciprocals).0;
        let rhs = S::as_mut_simd_f64s(&mut self.rhs).0;
        for i in 0..n {
            let (known, rest) = rhs.split_at_mut(i);
            let row = &matrix[i * n..i * n + i];
            let mut sums = [simd.splat_f64s(0.0); 4];
            let (quads, tail) = (row.chunks_exact(4), row.chunks_exact(4).remainder());
            for (l, x) in quads.zip(known.chunks_exact(4)) {
                for k in 0..4 {
                    sums[k] = simd.mul_add_e_f64s(l[k], x[k], sums[k]);
                }
            }
            let done = i - tail.len();
            for (k, &l) in tail.iter().enumerate() {
                sums[k] = simd.mul_add_e_f64s(l, known[done + k], sums[k]);
            }
            let sum = simd.add_f64s(simd.add_f64s(sums[0], sums[1]), simd.add_f64s(sums[2], sums[3]));
            rest[0] = simd.mul_f64s(simd.sub_f64s(rest[0], sum), reciprocals[i]);
        }
        for i in (0..n).rev() {
            let (before, rest) = rhs.split_at_mut(i);
            let x = simd.mul_f64s(rest[0], reciprocals[i]);
            rest[0] = x;
            for (b, &l) in before.iter_mut().zip(&matrix[i * n..i * n + i]) {
                *b = simd.negate_mul_add_e_f64s(l, x, *b);
            }
        }
    }

    /// Adds the columns of `symmetric`, times the solutions, to `y`, and puts the solutions themselves in their slots.
    #[inline(always)]
    fn spread(&mut self, symmetric: &[f64]) {
        let lanes = S::F64_LANES;
        let simd = self.simd;
        let slots = self.slots;
        // The solutions by slot, in the matrix's room, and the slots where any lane has one.
        let dense = &mut self.matrix[..slots * lanes];
        dense.fill(0.0);
        let mut any = vec![false; slots];
        for lane in 0..lanes {
            for k in 0..self.counts[lane] {
                let slot = self.rows[k * lanes + lane] as usize;
                dense[slot * lanes + lane] = self.rhs[k * lanes + lane];
                any[slot] = true;
            }
        }
        let used: Vec<usize> = (0..slots).filter(|&slot| any[slot]).collect();
        let x = S::as_simd_f64s(dense).0;
        let y = S::as_mut_simd_f64s(&mut self.y).0;
        let whole = slots - slots % BLOCK;
        for i in (0..whole).step_by(BLOCK) {
            let mut sums = [y[i], y[i + 1], y[i + 2], y[i + 3]];
            let rows = &symmetric[i * (slots + 1)..(i + BLOCK) * (slots + 1)];
            let (row0, rows) = rows.split_at(slots + 1);
            let (row1, rows) = rows.split_at(slots + 1);
            let (row2, row3) = rows.split_at(slots + 1);
            for &j in &used {
                let x = x[j];
                sums[0] = simd.mul_add_e_f64s(simd.splat_f64s(row0[j]), x, sums[0]);
                sums[1] = simd.mul_add_e_f64s(simd.splat_f64s(row1[j]), x, sums[1]);
                sums[2] = simd.mul_add_e_f64s(simd.splat_f64s(row2[j]), x, sums[2]);
                sums[3] = simd.mul_add_e_f64s(simd.splat_f64s(row3[j]), x, sums[3]);
            }
            y[i..i + BLOCK].copy_from_slice(&sums);
        }
        for i in whole..slots {
            for &j in &used {
                y[i] = simd.mul_add_e_f64s(simd.splat_f64s(symmetric[i * (slots + 1) + j]), x[j], y[i]);
            }
        }
        for lane in 0..lanes {
            for k in 0..self.counts[lane] {
                self.y[self.rows[k * lanes + lane] as usize * lanes + lane] = self.rhs[k * lanes + lane];
            }
        }
    }

    /// Looks at every lane: a minimum goes out, and where slots have the wrong sign they change sides.
    #[inline(always)]
    fn exchange(&mut self, mut minimum: impl FnMut(usize, usize, &Self), given_up: &mut Vec<usize>) {
        let lanes = S::F64_LANES;
        let mut largest_x = [0.0_f64; MAX_LANES];
        // The sum is NaN or infinite if any of its terms is.
        let mut sum = [0.0_f64; MAX_LANES];
        for (y, free) in self.y.chunks_exact(lanes).zip(self.free.chunks_exact(lanes)) {
            for lane in 0..lanes {
                let x = if free[lane] { y[lane].abs() } else { 0.0 };
                largest_x[lane] = largest_x[lane].max(x);
                sum[lane] += y[lane];
            }
        }
        let x_limit = largest_x.map(|x| -TOLERANCE * x);
        let g_limit: [f64; MAX_LANES] = std::array::from_fn(|lane| {
            let state = self.lanes.get(lane).copied().flatten();
            state.map_or(f64::NEG_INFINITY, |state| -TOLERANCE * state.largest_c)
        });
        let (mut count, mut last) = ([0_usize; MAX_LANES], [0_usize; MAX_LANES]);
        for (slot, (y, free)) in self.y.chunks_exact(lanes).zip(self.free.chunks_exact(lanes)).enumerate() {
            for lane in 0..lanes {
                let wrong = y[lane] < if free[lane] { x_limit[lane] } else { g_limit[lane] };
                count[lane] += usize::from(wrong);
                last[lane] = if wrong { slot } else { last[lane] };
            }
        }
        let mut exchange_all = [false; MAX_LANES];
        for lane in 0..lanes {
            let Some(mut state) = self.lanes[lane] else { continue };
            let finite = sum[lane].is_finite();
            state.steps += 1;
            if count[lane] == 0 || !finite || state.steps == MAX_STEPS {
                match finite && count[lane] == 0 {
                    true => minimum(lane, state.pixel, self),
                    false => given_up.push(state.pixel),
                }
                self.lanes[lane] = None;
                continue;
            }
            if count[lane] < state.fewest {
                (state.fewest, state.patience) = (count[lane], PATIENCE);
                exchange_all[lane] = true;
            } else if state.patience > 0 {
                state.patience -= 1;
                exchange_all[lane] = true;
            } else {
                // Exchanging only the last row cannot cycle (Murty), so the count falls below `fewest` at last.
                let at = last[lane] * lanes + lane;
                self.free[at] = !self.free[at];
            }
            self.lanes[lane] = Some(state);
        }
        for (y, free) in self.y.chunks_exact(lanes).zip(self.free.chunks_exact_mut(lanes)) {
            for lane in 0..lanes {
                let wrong = y[lane] < if free[lane] { x_limit[lane] } else { g_limit[lane] };
                free[lane] ^= wrong && exchange_all[lane];
            }
        }
    }
}

/// Subtracts from the block at column `to` of four rows, `n` apart, their products with four columns over the first
/// `length` entries.
#[inline(always)]
fn subtract_products<S: Simd>(
    simd: S,
    rows: &mut [S::f64s],
    columns: &[S::f64s],
    n: usize,
    length: usize,
    to: usize,
) {
    let column = |c: usize| &columns[c * n..c * n + length];
    if S::REGISTER_COUNT >= 32 {
        let sums = products(simd, rows, n, [column(0), column(1), column(2), column(3)]);
        subtract(simd, rows, n, to, sums);
    } else {
        let sums = products(simd, rows, n, [column(0), column(1)]);
        subtract(simd, rows, n, to, sums);
        let sums = products(simd, rows, n, [column(2), column(3)]);
        subtract(simd, rows, n, to + 2, sums);
    }
}

/// [`subtract_products`] of the rows with themselves, over their first `length` entries, at column `length`.
#[inline(always)]
fn subtract_own_products<S: Simd>(simd: S, rows: &mut [S::f64s], n: usize, length: usize) {
    let column = |c: usize| &rows[c * n..c * n + length];
    let left = products(simd, rows, n, [column(0), column(1)]);
    let right = products(simd, rows, n, [column(2), column(3)]);
    subtract(simd, rows, n, length, left);
    subtract(simd, rows, n, length + 2, right);
}

#[inline(always)]
fn subtract<S: Simd, const C: usize>(
    simd: S,
    rows: &mut [S::f64s],
    n: usize,
    to: usize,
    sums: [[S::f64s; C]; BLOCK],
) {
    for (r, sums) in sums.into_iter().enumerate() {
        for (c, sum) in sums.into_iter().enumerate() {
            rows[r * n + to + c] = simd.sub_f64s(rows[r * n + to + c], sum);
        }
    }
}

/// The products of four rows, `n` apart, with `C` columns, over the columns' length.
#[inline(always)]
fn products<S: Simd, const C: usize>(
    simd: S,
    rows: &[S::f64s],
    n: usize,
    columns: [&[S::f64s]; C],
) -> [[S::f64s; C]; BLOCK] {
    let mut sums = [[simd.splat_f64s(0.0); C]; BLOCK];
    let length = columns[0].len();
    let columns = columns.map(|column| &column[..length]);
    let rows: [&[S::f64s]; BLOCK] = std::array::from_fn(|r| &rows[r * n..r * n + length]);
    for k in 0..length {
        for r in 0..BLOCK {
            for c in 0..C {
                sums[r][c] = simd.mul_add_e_f64s(rows[r][k], columns[c][k], sums[r][c]);
            }
        }
    }
    sums
}

#[cfg(test)]
mod tests {
    use ndarray::{Array1, Array2};
    use proptest::prelude::*;

    use super::super::{Prior, SimdLevel, Slot, SlotKind, reference};
    use super::*;

    /// Solves pixels at every level that the machine has, and compares each with the reference.
    fn equals_the_reference(
        weights: &Array2<f64>,
        intensities: &Array2<f64>,
        prior: Prior,
        start: Option<&Array2<bool>>,
    ) {
        let first = -(weights.ncols() as i32) / 2;
        let slots: Vec<Slot> =
            (first..).take(weights.ncols()).map(|u| Slot { u, kind: SlotKind::Own }).collect();
        let quadratic = Quadratic::new(weights.view(), &slots, &prior).unwrap();
        let linear = quadratic.linear(weights.view(), intensities.view());
        let unconstrained = linear.dot(&quadratic.inverse());
        for level in SimdLevel::available() {
            let mut x = Array2::from_elem(linear.dim(), f64::NAN);
            let given_up = level.run(Lanes {
                quadratic: &quadratic,
                linear: linear.view(),
                unconstrained: unconstrained.view(),
                start: start.map(|start| start.view()),
                minimum: |pixel: usize, profile: &mut dyn Iterator<Item = f64>| {
                    x.row_mut(pixel).iter_mut().for_each(|x| *x = profile.next().unwrap());
                    assert!(profile.next().is_none());
                },
            });
            assert_eq!(given_up, [] as [usize; 0]);
            for (c, x) in linear.rows().into_iter().zip(x.rows()) {
                let expected = reference::minimise(quadratic.h(), &c.to_vec());
                let tolerance = 1e-8 * (1.0 + expected.iter().fold(0.0_f64, |a, b| a.max(b.abs())));
                for (x, expected) in x.iter().zip(&expected) {
                    assert!((x - expected).abs() < tolerance, "{}: {x} is not {expected}", level.name());
                }
            }
        }
    }

    fn random(seed: u64) -> impl FnMut() -> f64 {
        // A linear congruential generator (Knuth's MMIX) is random enough for weights.
        let mut state = seed.wrapping_mul(2).wrapping_add(1);
        move || {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 11) as f64 / (1_u64 << 53) as f64
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(100))]

        /// Any number of unknowns, settings and pixels; both sides of the pivoting, lanes that run out of pixels.
        #[test]
        fn any_size(slots in 1..40_usize, settings in 1..24_usize, pixels in 1..40_usize, beta in 0.0..2.0, split: bool, warm: bool, seed: u64) {
            let mut random = random(seed);
            let weights = Array2::from_shape_simple_fn((settings, slots), || (2.0 * random() - 1.0).max(0.0));
            let intensities = Array2::from_shape_simple_fn((pixels, settings), || 4.0 * random() - 1.0);
            let start = warm.then(|| Array2::from_shape_simple_fn((pixels, slots), || random() < 0.5));
            let prior = if split { Prior::Split { alpha: 0.01, beta } } else { Prior::Paper { alpha: 0.01, beta } };
            equals_the_reference(&weights, &intensities, prior, start.as_ref());
        }
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(60))]

        /// Few settings for many slots, which are solved along their chains: both priors, boxes and anything else, rows
        /// that no setting sees.
        #[test]
        fn few_settings(slots in 30..90_usize, settings in 1..9_usize, pixels in 1..20_usize, beta in 0.0..1.0, split: bool, warm: bool, boxes: bool, seed: u64) {
            let mut random = random(seed);
            let weights = match boxes {
                true => Array2::from_shape_fn((settings, slots), |(n, u)| f64::from((n * slots / settings).abs_diff(u) < 9)),
                false => Array2::from_shape_simple_fn((settings, slots), || (2.0 * random() - 1.0).max(0.0)),
            };
            let intensities = Array2::from_shape_simple_fn((pixels, settings), || 4.0 * random() - 1.0);
            let start = warm.then(|| Array2::from_shape_simple_fn((pixels, slots), || random() < 0.5));
            let prior = if split { Prior::Split { alpha: 0.1, beta } } else { Prior::Paper { alpha: 0.01, beta } };
            let all: Vec<Slot> = (-(slots as i32) / 2..).take(slots).map(|u| Slot { u, kind: SlotKind::Own }).collect();
            let quadratic = Quadratic::new(weights.view(), &all, &prior).unwrap();
            prop_assert_eq!(quadratic.narrow().is_some(), 3 * (settings + 1 + usize::from(split)) <= slots);
            equals_the_reference(&weights, &intensities, prior, start.as_ref());
        }
    }

    #[test]
    fn the_largest_size() {
        // Boxes as of a sweep with 512 settings over 1024 rows.
        let weights =
            Array2::from_shape_fn((512, 1024), |(n, u)| f64::from((2 * n).abs_diff(u) < 20 + 10 * (n % 3)));
        let mut random = random(7);
        let light = Array2::from_shape_simple_fn((3, 1024), || (random() - 0.8).max(0.0));
        let intensities = light.dot(&weights.t()).mapv_into(|light| light + 0.02 * (random() - 0.5));
        for prior in [Prior::PAPER, Prior::SPLIT] {
            let slots: Vec<Slot> = (-512..512).map(|u| Slot { u, kind: SlotKind::Own }).collect();
            let quadratic = Quadratic::new(weights.view(), &slots, &prior).unwrap();
            let linear = quadratic.linear(weights.view(), intensities.view());
            let unconstrained = linear.dot(&quadratic.inverse());
            let mut solved = 0;
            let given_up = SimdLevel::best().run(Lanes {
                quadratic: &quadratic,
                linear: linear.view(),
                unconstrained: unconstrained.view(),
                start: None,
                minimum: |pixel: usize, x: &mut dyn Iterator<Item = f64>| {
                    // The conditions of the minimum, because the reference would take minutes.
                    let x: Array1<f64> = x.collect();
                    let gradient = quadratic.h().dot(&x) - linear.row(pixel);
                    let scale = linear.row(pixel).iter().fold(0.0_f64, |most, c| most.max(c.abs()));
                    for (x, gradient) in x.iter().zip(&gradient) {
                        let violation = if *x > 0.0 { gradient.abs() } else { -gradient };
                        assert!(*x >= 0.0 && violation <= 1e-9 * scale, "{prior:?}: {violation} of {scale}");
                    }
                    solved += 1;
                },
            });
            assert_eq!((given_up.len(), solved), (0, 3));
        }
    }

    #[test]
    fn numbers_out_of_range_are_given_up_and_not_looped_over() {
        let slots = [Slot { u: 0, kind: SlotKind::Own }, Slot { u: 1, kind: SlotKind::Own }];
        let quadratic = Quadratic::new(Array2::eye(2).view(), &slots, &Prior::PAPER).unwrap();
        let linear = ndarray::array![[f64::NAN, 1.0], [1.0, 1.0]];
        for level in SimdLevel::available() {
            let mut solved = Vec::new();
            let given_up = level.run(Lanes {
                quadratic: &quadratic,
                linear: linear.view(),
                unconstrained: linear.view(),
                start: None,
                minimum: |pixel: usize, _: &mut dyn Iterator<Item = f64>| solved.push(pixel),
            });
            assert_eq!((given_up, solved), (vec![0], vec![1]));
        }
    }
}
