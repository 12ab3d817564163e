//! The simple solver that the fast one must equal: one pixel at a time, one row freed at a time.

use ndarray::{Array2, ArrayView2};

use super::cholesky;
use super::quadratic::RIDGE;

/// Minimises `x'Hx - 2 c'x` over `x >= 0` by the active-set method of Lawson and Hanson ("Solving Least Squares
/// Problems", 1974, algorithm NNLS) on the normal equations.
///
/// `h` is symmetric positive definite, shape `[n, n]`; `c` has `n` elements.
pub fn minimise(h: ArrayView2<f64>, c: &[f64]) -> Vec<f64> {
    let n = c.len();
    let scale = c.iter().fold(0.0_f64, |largest, c| largest.max(c.abs()));
    let mut x = vec![0.0; n];
    let mut free = vec![false; n];
    // Rows that were freed because of rounding errors only; freeing them again would never end.
    let mut refused = vec![false; n];
    loop {
        let descent: Vec<f64> = (0..n).map(|i| c[i] - dot_row(h, i, &x)).collect();
        let candidates = (0..n).filter(|&i| !free[i] && !refused[i] && descent[i] > 1e-12 * scale);
        let Some(entering) = candidates.max_by(|&a, &b| descent[a].total_cmp(&descent[b])) else { return x };
        free[entering] = true;
        let mut solution = stationary_point(h, c, &free);
        if solution[entering] <= 0.0 {
            free[entering] = false;
            refused[entering] = true;
            continue;
        }
        refused.fill(false);
        // Move towards the stationary point; whenever a row reaches 0 first, fix it there and recompute the target.
        while let Some(leaving) = first_to_reach_zero(&x, &solution, &free) {
            let step = x[leaving] / (x[leaving] - solution[leaving]);
            for i in 0..n {
                x[i] += step * (solution[i] - x[i]);
                if free[i] && x[i] <= 0.0 {
                    (x[i], free[i]) = (0.0, false);
                }
            }
            (x[leaving], free[leaving]) = (0.0, false);
            solution = stationary_point(h, c, &free);
        }
        x = solution;
    }
}

/// Minimises `x'Hx - 2 c'x` over `x >= 0` for a pixel in which some samples are only lower bounds: of these, only what
/// the prediction lacks is squared, `max(0, bound - weights x)^2`. Each gets an unknown of its own, its light beyond
/// the bound, with which it is an exact sample: a problem for [`minimise`].
///
/// `h`, shape `[n, n]`, and `c`, `n` elements, are those of all samples, as if the bounds were exact; `weights`, shape
/// `[bounds, n]`, and `bounds` are those of the censored samples.
pub fn minimise_censored(
    h: ArrayView2<f64>,
    c: &[f64],
    weights: ArrayView2<f64>,
    bounds: &[f64],
) -> Vec<f64> {
    let (k, n) = weights.dim();
    let augmented =
        Array2::from_shape_fn((n + k, n + k), |(i, j)| match (i.checked_sub(n), j.checked_sub(n)) {
            (None, None) => h[[i, j]],
            (Some(beyond), None) => -weights[[beyond, j]],
            (None, Some(beyond)) => -weights[[beyond, i]],
            (Some(a), Some(b)) => f64::from(u8::from(a == b)) * (1.0 + RIDGE),
        });
    let c: Vec<f64> = c.iter().copied().chain(bounds.iter().map(|bound| -bound)).collect();
    let mut x = minimise(augmented.view(), &c);
    x.truncate(n);
    x
}

/// The minimum over the free rows, with 0 in all other rows.
fn stationary_point(h: ArrayView2<f64>, c: &[f64], free: &[bool]) -> Vec<f64> {
    let rows: Vec<usize> = (0..c.len()).filter(|&i| free[i]).collect();
    let mut matrix: Vec<f64> = rows.iter().flat_map(|&i| rows.iter().map(move |&j| h[[i, j]])).collect();
    let mut values: Vec<f64> = rows.iter().map(|&i| c[i]).collect();
    let mut x = vec![0.0; c.len()];
    if cholesky::factor(&mut matrix, rows.len()).is_ok() {
        cholesky::solve(&matrix, rows.len(), &mut values);
        rows.iter().zip(values).for_each(|(&i, value)| x[i] = value);
    }
    x
}

fn first_to_reach_zero(x: &[f64], solution: &[f64], free: &[bool]) -> Option<usize> {
    let step = |&i: &usize| x[i] / (x[i] - solution[i]);
    (0..x.len()).filter(|&i| free[i] && solution[i] <= 0.0).min_by(|a, b| step(a).total_cmp(&step(b)))
}

fn dot_row(h: ArrayView2<f64>, i: usize, x: &[f64]) -> f64 {
    h.row(i).iter().zip(x).map(|(h, x)| h * x).sum()
}

#[cfg(test)]
mod tests {
    use ndarray::array;
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn by_hand() {
        // Unconstrained minimum (2, -1); with x1 = 0 the minimum of x0^2 - 2 x0 is at 1.
        let h = array![[1.0, 1.0], [1.0, 3.0]];
        assert_eq!(minimise(h.view(), &[1.0, -1.0]), [1.0, 0.0]);
        assert_eq!(minimise(h.view(), &[-1.0, -2.0]), [0.0, 0.0]);
        let free = minimise(h.view(), &[2.0, 4.0]);
        assert!((free[0] - 1.0).abs() < 1e-12 && (free[1] - 1.0).abs() < 1e-12);
    }

    proptest! {
        /// With three unknowns all sets of zero rows can be tried.
        #[test]
        fn equals_trying_all_active_sets(a in prop::collection::vec(-1.0..1.0, 12), c in prop::array::uniform3(-1.0..1.0)) {
            let a = Array2::from_shape_vec((4, 3), a).unwrap();
            let h = a.t().dot(&a) + 0.05 * Array2::<f64>::eye(3);
            let objective = |x: &[f64]| (0..3).map(|i| x[i] * (dot_row(h.view(), i, x) - 2.0 * c[i])).sum::<f64>();
            let best = (0..8)
                .map(|set| stationary_point(h.view(), &c, &[set & 1 > 0, set & 2 > 0, set & 4 > 0]))
                .filter(|x| x.iter().all(|&x| x >= 0.0))
                .map(|x| objective(&x))
                .fold(f64::INFINITY, f64::min);
            let x = minimise(h.view(), &c);
            prop_assert!(x.iter().all(|&x| x >= 0.0));
            prop_assert!((objective(&x) - best).abs() < 1e-12, "{} is not {best}", objective(&x));
        }
    }
}
