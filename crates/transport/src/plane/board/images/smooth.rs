use nalgebra::{DMatrix, DVector};
use ndarray::{Array2, Axis};
use rayon::prelude::*;

/// A value at a pixel.
#[derive(Debug, Clone, Copy)]
pub(super) struct SmoothPoint {
    pub t: usize,
    pub s: usize,
    pub value: f64,
}

/// A polynomial over the image: products of Legendre polynomials in `t` and `s`.
#[derive(Debug, Clone)]
pub(super) struct SmoothMap {
    shape: (usize, usize),
    /// Degrees in `t` and `s` of each term.
    terms: Vec<(usize, usize)>,
    coefficients: Vec<f64>,
}

/// Highest degrees in `t` and `s`, and of their sum.
const DEGREES: (usize, usize, usize) = (5, 3, 5);
/// Pixels that a degree of the polynomial takes: smaller images get lower degrees.
const PIXELS_PER_DEGREE: usize = 24;
/// Weight 0 (Tukey's biweight) at this many standard deviations.
const TUKEY_SIGMAS: f64 = 4.685;

impl SmoothMap {
    /// The robust fit to points of an image of this shape; `None` if they do not determine it.
    pub fn fit(shape: (usize, usize), points: &[SmoothPoint]) -> Option<Self> {
        let degree_t = (shape.0 / PIXELS_PER_DEGREE).clamp(1, DEGREES.0);
        let degree_s = (shape.1 / PIXELS_PER_DEGREE).clamp(1, DEGREES.1);
        let terms: Vec<(usize, usize)> = (0..=degree_t)
            .flat_map(|i| (0..=degree_s).map(move |j| (i, j)))
            .filter(|(i, j)| i + j <= DEGREES.2)
            .collect();
        let mut map = Self { shape, coefficients: vec![0.0; terms.len()], terms };
        let rows: Vec<Vec<f64>> = points.iter().map(|point| map.basis(point.t, point.s)).collect();
        let mut weights = vec![1.0; points.len()];
        for step in 0..12 {
            map.solve(&rows, points, &weights)?;
            let residuals: Vec<f64> = rows.iter().zip(points).map(|(row, p)| p.value - map.of(row)).collect();
            let sigma = super::robust_sd(&residuals, 0.0).max(1e-9);
            for (weight, residual) in weights.iter_mut().zip(residuals) {
                let z = residual.abs() / sigma;
                // The first steps keep every point, but distant ones weigh little: a start for the biweight.
                *weight = match step < 6 {
                    true => 1.0 / z.max(1.0),
                    false => (1.0 - (z / TUKEY_SIGMAS).powi(2)).max(0.0).powi(2),
                };
            }
        }
        Some(map)
    }

    /// The map at pixel `[t, s]`.
    pub fn at(&self, t: usize, s: usize) -> f64 {
        self.of(&self.basis(t, s))
    }

    /// The map at every pixel, `[t, s]`.
    pub fn image(&self) -> Array2<f32> {
        let mut image = Array2::zeros(self.shape);
        let of_columns: Vec<[f64; DEGREES.1 + 1]> =
            (0..self.shape.1).map(|s| legendre(s, self.shape.1)).collect();
        image.axis_iter_mut(Axis(0)).into_par_iter().enumerate().for_each(|(t, mut row)| {
            let of_row: [f64; DEGREES.0 + 1] = legendre(t, self.shape.0);
            let mut in_s = [0.0; DEGREES.1 + 1];
            for (&(i, j), coefficient) in self.terms.iter().zip(&self.coefficients) {
                in_s[j] += coefficient * of_row[i];
            }
            for (value, of_column) in row.iter_mut().zip(&of_columns) {
                *value = in_s.iter().zip(of_column).map(|(a, b)| a * b).sum::<f64>() as f32;
            }
        });
        image
    }

    fn basis(&self, t: usize, s: usize) -> Vec<f64> {
        let of_row: [f64; DEGREES.0 + 1] = legendre(t, self.shape.0);
        let of_column: [f64; DEGREES.1 + 1] = legendre(s, self.shape.1);
        self.terms.iter().map(|&(i, j)| of_row[i] * of_column[j]).collect()
    }

    fn of(&self, basis: &[f64]) -> f64 {
        self.coefficients.iter().zip(basis).map(|(a, b)| a * b).sum()
    }

    fn solve(&mut self, rows: &[Vec<f64>], points: &[SmoothPoint], weights: &[f64]) -> Option<()> {
        let n = self.terms.len();
        if points.len() < 2 * n {
            return None;
        }
        let mut normal = DMatrix::zeros(n, n);
        let mut right = DVector::zeros(n);
        for ((row, point), &weight) in rows.iter().zip(points).zip(weights) {
            for (i, a) in row.iter().enumerate() {
                right[i] += weight * a * point.value;
                for (j, b) in row[..=i].iter().enumerate() {
                    normal[(i, j)] += weight * a * b;
                }
            }
        }
        normal.fill_upper_triangle_with_lower_triangle();
        self.coefficients = normal.cholesky()?.solve(&right).iter().copied().collect();
        Some(())
    }
}

/// Legendre polynomials of degrees `0..N` at a pixel, with -1 and 1 at the first and last of `pixels`.
fn legendre<const N: usize>(pixel: usize, pixels: usize) -> [f64; N] {
    let x = if pixels > 1 { 2.0 * pixel as f64 / (pixels - 1) as f64 - 1.0 } else { 0.0 };
    let mut values = [1.0; N];
    values[1] = x;
    for n in 2..N {
        let k = n as f64;
        values[n] = ((2.0 * k - 1.0) * x * values[n - 1] - (k - 1.0) * values[n - 2]) / k;
    }
    values
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bent_map_is_found_among_outliers() {
        let truth = |t: usize, s: usize| {
            let (x, y) = (t as f64 / 200.0, s as f64 / 160.0);
            300.0 + 200.0 * x + 2.0 * y + 0.5 * x * y * y - 0.3 * x.powi(4)
        };
        let points: Vec<SmoothPoint> = (0..200)
            .flat_map(|t| (0..160).map(move |s| (t, s)))
            .enumerate()
            .map(|(n, (t, s))| {
                // One in 20 is read 16 rows too high.
                let outlier = if n % 20 == 7 { 16.0 } else { 0.0 };
                let noise = 0.01 * (n as f64 * 12.9898).sin();
                SmoothPoint { t, s, value: truth(t, s) + outlier + noise }
            })
            .collect();
        let map = SmoothMap::fit((200, 160), &points).unwrap();
        let image = map.image();
        for (t, s) in [(0, 0), (199, 0), (100, 80), (0, 159), (199, 159)] {
            assert!((map.at(t, s) - truth(t, s)).abs() < 3e-3, "{} {}", map.at(t, s), truth(t, s));
            assert!((f64::from(image[[t, s]]) - map.at(t, s)).abs() < 1e-4);
        }
    }

    #[test]
    fn points_on_one_line_do_not_determine_a_map() {
        let points: Vec<SmoothPoint> = (0..100).map(|t| SmoothPoint { t, s: 3, value: t as f64 }).collect();
        assert!(SmoothMap::fit((100, 100), &points).is_none());
    }
}
