//! Cholesky factors of small dense matrices, computed row by row, so that every inner loop runs over contiguous
//! memory.
//!
//! Benefit: nalgebra takes 2.2 to 2.9 times as long to invert the `H` of 75 settings (128 and 189 rows, AVX-512;
//! benchmark `demux`).

/// A matrix is not positive definite.
#[derive(Debug)]
pub struct NotPositiveDefinite;

/// Replaces the lower triangle of the row-major `n` x `n` matrix `a` by its Cholesky factor; the upper triangle is
/// not read.
#[inline(always)]
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
/// upper triangle is left undefined.
#[inline(always)]
pub fn invert(a: &mut [f64], n: usize) -> Result<(), NotPositiveDefinite> {
    factor(a, n)?;
    // Row by row, so that all inner loops run along rows: first L^-1, which is also lower triangular,
    let mut inverse = vec![0.0; n * n];
    for i in 0..n {
        let (above, rest) = inverse.split_at_mut(i * n);
        let row = &mut rest[..n];
        row[i] = 1.0;
        for k in 0..i {
            let factor = a[i * n + k];
            row[..=k].iter_mut().zip(&above[k * n..]).for_each(|(row, above)| *row -= factor * above);
        }
        let reciprocal = a[i * n + i].recip();
        row[..=i].iter_mut().for_each(|row| *row *= reciprocal);
    }
    // then L'^-1 times L^-1, of which only the lower triangle is needed.
    for i in (0..n).rev() {
        let (upto, below) = inverse.split_at_mut((i + 1) * n);
        let row = &mut upto[i * n..=i * n + i];
        for k in i + 1..n {
            let factor = a[k * n + i];
            row.iter_mut().zip(&below[(k - i - 1) * n..]).for_each(|(row, below)| *row -= factor * below);
        }
        let reciprocal = a[i * n + i].recip();
        row.iter_mut().for_each(|row| *row *= reciprocal);
    }
    a.copy_from_slice(&inverse);
    Ok(())
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
    fn refuses_an_indefinite_matrix() {
        assert!(factor(&mut [1.0, 0.0, 2.0, 1.0], 2).is_err());
        assert!(factor(&mut [f64::NAN], 1).is_err());
    }
}
