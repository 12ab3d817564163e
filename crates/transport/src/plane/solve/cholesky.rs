//! Cholesky factors and inverses of small dense matrices. All inner loops run over contiguous memory.
//!
//! Benefit: nalgebra takes about 9 times as long to invert the `H` of 75 settings (128 and 189 rows, AVX-512;
//! benchmark `demux`).

use std::mem;

use aligned_vec::{AVec, avec};
use pulp::{Arch, Simd, WithSimd};

use super::simd::MAX_LANES;

/// Number of pivots for which the inversion goes through the matrix once; their factors fit in the registers of
/// AVX-512 and AVX2.
const PIVOTS: usize = 8;

/// A matrix is not positive definite.
#[derive(Debug)]
pub struct NotPositiveDefinite;

/// Replaces the lower triangle of the row-major `n` x `n` matrix `a` by its Cholesky factor; the upper triangle is
/// not read.
pub fn factor(a: &mut [f64], n: usize) -> Result<(), NotPositiveDefinite> {
    for i in 0..n {
        let (above, rest) = a.split_at_mut(i * n);
        let row = &mut rest[..n];
        for j in 0..i {
            let pivot_row = &above[j * n..j * n + j + 1];
            row[j] = (row[j] - dot(&row[..j], &pivot_row[..j])) / pivot_row[j];
        }
        let pivot = row[i] - dot(&row[..i], &row[..i]);
        if pivot.is_nan() || pivot <= 0.0 {
            return Err(NotPositiveDefinite);
        }
        row[i] = pivot.sqrt();
    }
    Ok(())
}

/// Replaces `b` by the solution of `L L' x = b`, with `L` the factor of an `n` x `n` matrix.
pub fn solve(l: &[f64], n: usize, b: &mut [f64]) {
    for i in 0..n {
        let row = &l[i * n..i * n + i + 1];
        b[i] = (b[i] - dot(&row[..i], &b[..i])) / row[i];
    }
    for i in (0..n).rev() {
        let row = &l[i * n..i * n + i + 1];
        b[i] /= row[i];
        let x = b[i];
        b[..i].iter_mut().zip(row).for_each(|(b, l)| *b -= x * l);
    }
}

/// Replaces the lower triangle of the symmetric positive definite `n` x `n` matrix `a` by that of its inverse; the
/// upper triangle is neither read nor written. If the matrix is refused, it is unchanged.
pub fn invert(a: &mut [f64], n: usize) -> Result<(), NotPositiveDefinite> {
    // Not a closure: those that borrow are called, not inlined, and would run without the machine's vectors.
    Arch::new().dispatch(Inversion { a, n })
}

/// The arguments of [`invert`].
struct Inversion<'a> {
    a: &'a mut [f64],
    n: usize,
}

impl WithSimd for Inversion<'_> {
    type Output = Result<(), NotPositiveDefinite>;

    /// Computes the factor `L`, `L^-1` and `L'^-1 L^-1` in one pass. Each pivot `k` gives a row `w`: row `k` of
    /// `-L^-1` up to the diagonal and column `k` of `L` after it. `w'w` is then subtracted from the whole matrix, row
    /// and column `k` of which were set to zero. That leaves what is still to be factored below and to the right of
    /// the pivot, the numerators of the next rows of `-L^-1` below and to the left, and above minus the inverse, as
    /// the sum of these products. The matrix is read and written once for several pivots.
    #[inline(always)]
    fn with_simd<S: Simd>(self, simd: S) -> Self::Output {
        const { assert!(S::F64_LANES <= MAX_LANES) };
        let Self { a, n } = self;
        // Whole vectors, and an odd number of the widest: columns would otherwise share few sets of the cache.
        let stride = n.next_multiple_of(MAX_LANES) | MAX_LANES;
        let mut matrix: AVec<f64> = avec![0.0; n * stride];
        let mut pivots: AVec<f64> = avec![0.0; PIVOTS * stride];
        // Slices, because indexing the vectors themselves is slow in test builds.
        let (matrix, pivots) = (&mut matrix[..], &mut pivots[..]);
        for (i, row) in matrix.chunks_exact_mut(stride).enumerate() {
            row[..=i].copy_from_slice(&a[i * n..=i * n + i]);
        }
        for first in (0..n).step_by(PIVOTS) {
            // The last pivots may be fewer; rows of zeros change nothing.
            pivots.fill(0.0);
            for k in first..n.min(first + PIVOTS) {
                let (before, rest) = pivots.split_at_mut((k - first) * stride);
                let w = &mut rest[..stride];
                let (left, below) = matrix[k * stride..].split_at_mut(k);
                w[..k].copy_from_slice(left);
                left.fill(0.0);
                w[k..n].iter_mut().zip(below.iter_mut().step_by(stride)).for_each(|(w, a)| *w = mem::take(a));
                // Their products are still to be subtracted: here now, and not again from the row once it is zero.
                for before in before.chunks_exact_mut(stride) {
                    subtract::<S, 1>(simd, w, k, before, stride);
                    before[k] = 0.0;
                }
                let pivot = w[k];
                if pivot.is_nan() || pivot <= 0.0 {
                    return Err(NotPositiveDefinite);
                }
                let reciprocal = pivot.sqrt().recip();
                w.iter_mut().for_each(|w| *w *= reciprocal);
                w[k] = -reciprocal;
            }
            for (i, row) in matrix.chunks_exact_mut(stride).enumerate() {
                let row = &mut row[..(i + 1).next_multiple_of(MAX_LANES)];
                subtract::<S, PIVOTS>(simd, row, i, pivots, stride);
            }
        }
        for (i, row) in matrix.chunks_exact(stride).enumerate() {
            a[i * n..=i * n + i].iter_mut().zip(row).for_each(|(a, negative)| *a = -negative);
        }
        Ok(())
    }
}

/// Subtracts from row `i` of a matrix its part of `w'w` for each of the `C` rows `w` in `pivots`.
#[inline(always)]
fn subtract<S: Simd, const C: usize>(simd: S, row: &mut [f64], i: usize, pivots: &[f64], stride: usize) {
    let row = S::as_mut_simd_f64s(row).0;
    // Filled in a loop, because `array::from_fn` is not inlined in test builds.
    let mut factors = [simd.splat_f64s(0.0); C];
    let mut ws: [&[S::f64s]; C] = [&[]; C];
    for (c, w) in pivots.chunks_exact(stride).enumerate() {
        factors[c] = simd.splat_f64s(w[i]);
        ws[c] = &S::as_simd_f64s(w).0[..row.len()];
    }
    for j in 0..row.len() {
        let mut entry = row[j];
        for c in 0..C {
            entry = simd.negate_mul_add_e_f64s(factors[c], ws[c][j], entry);
        }
        row[j] = entry;
    }
}

/// Scalar product with eight partial sums, which the compiler can keep in vector registers.
#[inline(always)]
fn dot(a: &[f64], b: &[f64]) -> f64 {
    let mut sums = [0.0; 8];
    let (a_chunks, b_chunks) = (a.chunks_exact(8), b.chunks_exact(8));
    let tail: f64 = a_chunks.remainder().iter().zip(b_chunks.remainder()).map(|(a, b)| a * b).sum();
    for (a, b) in a_chunks.zip(b_chunks) {
        for lane in 0..8 {
            sums[lane] += a[lane] * b[lane];
        }
    }
    sums.iter().sum::<f64>() + tail
}

#[cfg(test)]
mod tests {
    use std::cmp::Ordering;

    use super::super::simd::SimdLevel;
    use super::*;

    #[test]
    fn solves_what_it_factored() {
        for n in [1, 2, 7, 8, 9, 30] {
            // A diagonally dominant matrix and a known solution.
            let a = |i: usize, j: usize| if i == j { n as f64 } else { 1.0 / (1.0 + i.abs_diff(j) as f64) };
            let x: Vec<f64> = (0..n).map(|i| (i as f64 * 0.7).sin()).collect();
            let mut b: Vec<f64> = (0..n).map(|i| (0..n).map(|j| a(i, j) * x[j]).sum()).collect();
            let mut l: Vec<f64> = (0..n * n).map(|k| a(k / n, k % n)).collect();
            factor(&mut l, n).unwrap();
            solve(&l, n, &mut b);
            assert!(b.iter().zip(&x).all(|(b, x)| (b - x).abs() < 1e-12), "n = {n}");
        }
    }

    #[test]
    fn the_inverse_undoes_the_matrix() {
        for n in [1, 2, 7, 8, 9, 30] {
            let a = |i: usize, j: usize| if i == j { n as f64 } else { 1.0 / (1.0 + i.abs_diff(j) as f64) };
            let mut inverse: Vec<f64> = (0..n * n).map(|k| a(k / n, k % n)).collect();
            invert(&mut inverse, n).unwrap();
            for (i, j) in (0..n).flat_map(|i| (0..n).map(move |j| (i, j))) {
                let product: f64 = (0..n).map(|k| a(i, k) * inverse[k.max(j) * n + k.min(j)]).sum();
                assert!((product - f64::from(i == j)).abs() < 1e-12, "n = {n}");
            }
        }
    }

    #[test]
    fn the_inverse_agrees_with_the_factor_for_every_instruction_set() {
        for n in (1..=40).chain([75, 128, 189]) {
            // The values above the diagonal must not matter.
            let entry = |i: usize, j: usize| match i.cmp(&j) {
                Ordering::Less => f64::NAN,
                Ordering::Equal => 1.01,
                Ordering::Greater => (-0.1 * (i - j) as f64).exp(),
            };
            let a: Vec<f64> = (0..n * n).map(|k| entry(k / n, k % n)).collect();
            let mut l = a.clone();
            factor(&mut l, n).unwrap();
            for level in SimdLevel::available() {
                let mut inverse = a.clone();
                level.run(Inversion { a: &mut inverse, n }).unwrap();
                for j in 0..n {
                    let mut column = vec![0.0; n];
                    column[j] = 1.0;
                    solve(&l, n, &mut column);
                    let is_close = |i: usize| (inverse[i * n + j] - column[i]).abs() < 1e-12 * column[j];
                    assert!((j..n).all(is_close), "n = {n}, {level:?}");
                }
            }
        }
    }

    #[test]
    fn refuses_an_indefinite_matrix() {
        assert!(factor(&mut [1.0, 0.0, 2.0, 1.0], 2).is_err());
        assert!(factor(&mut [f64::NAN], 1).is_err());
        for n in [1, 2, 8, 9, 30] {
            for (i, j, entry) in [(n - 1, n - 1, -1e-9), (n - 1, 0, 2.0), (n - 1, n / 2, f64::NAN)] {
                let mut a: Vec<f64> = (0..n * n).map(|k| f64::from(k / n == k % n)).collect();
                a[i * n + j] = entry;
                let is_refused = n > 1 || entry != 2.0;
                assert_eq!(invert(&mut a, n).is_err(), is_refused, "n = {n}, {entry}");
            }
        }
    }
}
