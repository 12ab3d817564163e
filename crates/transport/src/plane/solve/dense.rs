//! Dense solver for the linear systems of pivoting, with one pixel's system in each lane of the vector registers.
//!
//! Benefit: nalgebra takes 2.1 to 2.4 times as long for the same systems one by one (on average 43 and 58 rows,
//! AVX-512; benchmark `demux`).

use aligned_vec::{AVec, avec};
use pulp::Simd;

use super::quadratic::Padded;
use super::simd::MAX_LANES;

/// Rows and columns of the blocks in which matrices are factored: sums of 4 x 2 fit in the registers at every vector
/// width.
const BLOCK: usize = 4;

/// Number of vectors in a sum of columns; they fit in the registers at every vector width.
const SUMS: usize = 8;

/// Memory for the systems of all lanes; arrays interleave the lanes' values. Lanes share the symmetric matrix `M`, of
/// which each uses its own rows and columns `K`. The result of a lane is the same to the bit whatever the other lanes
/// do.
pub(super) struct Dense<S: Simd> {
    simd: S,
    /// `K` of each lane, padded with the index of `M`'s row of zeros.
    rows: Vec<u32>,
    /// Number of rows in each lane's `K`.
    counts: [usize; MAX_LANES],
    /// `[n][n][lanes]` for the current size; allocated for the largest size so far.
    matrix: AVec<f64>,
    rhs: AVec<f64>,
    reciprocals: AVec<f64>,
}

impl<S: Simd> Dense<S> {
    /// Memory for systems of up to `slots` unknowns.
    #[inline(always)]
    pub fn new(simd: S, slots: usize) -> Self {
        const { assert!(S::F64_LANES <= MAX_LANES) };
        let padded = slots.next_multiple_of(BLOCK) * S::F64_LANES;
        Self {
            simd,
            rows: vec![0; padded],
            counts: [0; MAX_LANES],
            matrix: avec![0.0; 0],
            rhs: avec![0.0; padded],
            reciprocals: avec![0.0; padded],
        }
    }

    /// Solves `M_KK x = -b_K` for the given lanes. Each lane has a mark of 1 or 0 for each slot, where `K` consists
    /// of the slots whose mark is `marked`, and its `b`.
    #[inline(always)]
    pub fn solve<'a>(
        &mut self,
        symmetric: &Padded,
        marked: f64,
        lanes: impl Iterator<Item = (&'a [f64], &'a [f64])>,
    ) {
        self.counts = [0; MAX_LANES];
        for (lane, (marks, b)) in lanes.enumerate() {
            self.list(lane, marked, marks, b);
        }
        self.gather(symmetric);
        self.factor();
        self.substitute();
    }

    /// Adds `M x` to `y`, which contains `b`, and writes `x` into the slots of `K`.
    #[inline(always)]
    pub fn spread(&self, lane: usize, symmetric: &Padded, y: &mut [f64]) {
        let vectors = S::as_mut_simd_f64s(y).0;
        let mut blocks = vectors.chunks_exact_mut(SUMS);
        let mut first = 0;
        for block in &mut blocks {
            self.add_columns::<SUMS>(lane, symmetric, first, block);
            first += SUMS;
        }
        for vector in blocks.into_remainder() {
            self.add_columns::<1>(lane, symmetric, first, std::slice::from_mut(vector));
            first += 1;
        }
        for k in 0..self.counts[lane] {
            let at = k * S::F64_LANES + lane;
            y[self.rows[at] as usize] = self.rhs[at];
        }
    }

    /// Adds `C` vectors of `M x`, starting at vector `first`.
    #[inline(always)]
    fn add_columns<const C: usize>(&self, lane: usize, symmetric: &Padded, first: usize, to: &mut [S::f64s]) {
        let (simd, lanes) = (self.simd, S::F64_LANES);
        let mut sums: [S::f64s; C] = std::array::from_fn(|c| to[c]);
        for k in 0..self.counts[lane] {
            let at = k * lanes + lane;
            let row = symmetric.row(self.rows[at] as usize);
            let row = &S::as_simd_f64s(row).0[first..first + C];
            let x = simd.splat_f64s(self.rhs[at]);
            for c in 0..C {
                sums[c] = simd.mul_add_e_f64s(row[c], x, sums[c]);
            }
        }
        to.copy_from_slice(&sums);
    }

    /// Lists a lane's marked slots and their right-hand sides.
    #[inline(always)]
    fn list(&mut self, lane: usize, marked: f64, marks: &[f64], b: &[f64]) {
        let lanes = S::F64_LANES;
        let mut count = 0;
        for (slot, (&mark, &b)) in marks.iter().zip(b).enumerate() {
            // Written in any case and kept only if marked, to avoid a branch that is hard to predict.
            let at = count * lanes + lane;
            (self.rows[at], self.rhs[at]) = (slot as u32, -b);
            count += usize::from(mark == marked);
        }
        self.counts[lane] = count;
    }

    /// Size of the systems: that of the largest lane, rounded up to whole blocks.
    #[inline(always)]
    fn size(&self) -> usize {
        self.counts.iter().copied().max().unwrap_or(0).next_multiple_of(BLOCK)
    }

    /// Copies each lane's rows and columns from `symmetric`, padded with the identity.
    #[inline(always)]
    fn gather(&mut self, symmetric: &Padded) {
        let lanes = S::F64_LANES;
        let n = self.size();
        if self.matrix.len() < n * n * lanes {
            self.matrix.resize(n * n * lanes, 0.0);
        }
        for (lane, &count) in self.counts[..lanes].iter().enumerate() {
            for at in (count..n).map(|k| k * lanes + lane) {
                (self.rows[at], self.rhs[at]) = (symmetric.slots as u32, 0.0);
            }
        }
        for k in 0..n {
            let rows: [&[f64]; MAX_LANES] = std::array::from_fn(|lane| match lane < lanes {
                true => symmetric.row(self.rows[k * lanes + lane] as usize),
                false => &[],
            });
            let line = &mut self.matrix[k * n * lanes..(k * n + k + 1) * lanes];
            for (cells, columns) in line.chunks_exact_mut(lanes).zip(self.rows.chunks_exact(lanes)) {
                for lane in 0..lanes {
                    cells[lane] = rows[lane][columns[lane] as usize];
                }
            }
            for lane in 0..lanes {
                self.matrix[(k * n + k) * lanes + lane] += f64::from(k >= self.counts[lane]);
            }
        }
    }

    /// Cholesky factors of all lanes' matrices, by blocks of 4 x 4 from left to right.
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
                // Solve the block with the factor of its diagonal block.
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
            // The diagonal block: subtract the products of its own rows, then factor it.
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
                        // A pivot that is not positive gives NaN here, which no later step accepts as a minimum.
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
}

/// Subtracts from the block at column `to` of four rows, `n` apart, their products with four columns, over the first
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

/// [`subtract_products`] for the rows with themselves, over their first `length` entries, at column `length`.
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
