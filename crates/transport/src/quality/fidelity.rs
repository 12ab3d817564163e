use ndarray::{Array2, ArrayView, ArrayView2, Dimension, Zip};

/// The paper's window: 11 pixels of a Gaussian with a sigma of 1.5.
const WINDOW_PX: usize = 11;
const WINDOW_SIGMA_PX: f64 = 1.5;

/// Signal-to-noise ratio in dB: `10 log10(sum truth^2 / sum (estimate - truth)^2)`; infinite without error. Both arrays
/// have the same shape.
pub fn snr_db<D: Dimension>(estimate: ArrayView<f32, D>, truth: ArrayView<f32, D>) -> f64 {
    let size: f64 = truth.iter().map(|&truth| f64::from(truth).powi(2)).sum();
    10.0 * (size / squared_error(estimate, truth)).log10()
}

/// Peak signal-to-noise ratio in dB, for images whose largest possible value is `peak`; infinite without error. Both
/// arrays have the same shape.
pub fn psnr_db<D: Dimension>(estimate: ArrayView<f32, D>, truth: ArrayView<f32, D>, peak: f64) -> f64 {
    let size = truth.len() as f64 * peak * peak;
    10.0 * (size / squared_error(estimate, truth)).log10()
}

fn squared_error<D: Dimension>(estimate: ArrayView<f32, D>, truth: ArrayView<f32, D>) -> f64 {
    let mut error = 0.0;
    Zip::from(estimate).and(truth).for_each(|&estimate, &truth| {
        error += (f64::from(estimate) - f64::from(truth)).powi(2);
    });
    error
}

/// Structural similarity (Wang et al. 2004) of two images `[rows, columns]` of the same shape, whose values span
/// `range`: the mean over all positions of a window of 11 x 11 pixels, Gaussian with sigma 1.5, K1 = 0.01, K2 = 0.03.
/// NaN for images smaller than the window.
pub fn ssim(one: ArrayView2<f32>, other: ArrayView2<f32>, range: f64) -> f64 {
    let (c1, c2) = ((0.01 * range).powi(2), (0.03 * range).powi(2));
    let (a, b) = (one.mapv(f64::from), other.mapv(f64::from));
    let (mean_a, mean_b) = (blurred(&a), blurred(&b));
    let (squares_a, squares_b) = (blurred(&(&a * &a)), blurred(&(&b * &b)));
    let products = blurred(&(&a * &b));
    let mut sum = 0.0;
    for (at, &product) in products.indexed_iter() {
        let (a, b) = (mean_a[at], mean_b[at]);
        let (variance_a, variance_b) = (squares_a[at] - a * a, squares_b[at] - b * b);
        let likeness = (2.0 * a * b + c1) * (2.0 * (product - a * b) + c2);
        sum += likeness / ((a * a + b * b + c1) * (variance_a + variance_b + c2));
    }
    sum / products.len() as f64
}

/// Weighted means over the window, at all positions where it lies within the image.
fn blurred(image: &Array2<f64>) -> Array2<f64> {
    let middle = (WINDOW_PX / 2) as f64;
    let weight = |at: usize| (-0.5 * ((at as f64 - middle) / WINDOW_SIGMA_PX).powi(2)).exp();
    let sum: f64 = (0..WINDOW_PX).map(weight).sum();
    let weights: [f64; WINDOW_PX] = std::array::from_fn(|at| weight(at) / sum);
    let (rows, columns) = image.dim();
    let (rows, columns) = (rows.saturating_sub(WINDOW_PX - 1), columns.saturating_sub(WINDOW_PX - 1));
    let mean =
        |values: &dyn Fn(usize) -> f64| -> f64 { (0..WINDOW_PX).map(|at| weights[at] * values(at)).sum() };
    let along = Array2::from_shape_fn((image.nrows(), columns), |(row, column)| {
        mean(&|at| image[[row, column + at]])
    });
    Array2::from_shape_fn((rows, columns), |(row, column)| mean(&|at| along[[row + at, column]]))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ratios_are_those_of_known_errors() {
        let truth = Array2::from_elem((4, 5), 2.0_f32);
        let estimate = truth.mapv(|truth| truth + 0.2);
        assert!((snr_db(estimate.view(), truth.view()) - 20.0).abs() < 1e-4);
        assert!((psnr_db(estimate.view(), truth.view(), 20.0) - 40.0).abs() < 1e-4);
        assert_eq!(snr_db(truth.view(), truth.view()), f64::INFINITY);
    }

    #[test]
    fn similarity_of_even_images_is_that_of_their_levels() {
        let (one, other) = (Array2::from_elem((16, 16), 100.0_f32), Array2::from_elem((16, 16), 150.0_f32));
        let c1 = (0.01_f64 * 255.0).powi(2);
        let expected = (2.0 * 100.0 * 150.0 + c1) / (100.0 * 100.0 + 150.0 * 150.0 + c1);
        assert!((ssim(one.view(), other.view(), 255.0) - expected).abs() < 1e-12);
        assert_eq!(ssim(one.view(), one.view(), 255.0), 1.0);
        assert!(ssim(Array2::zeros((5, 50)).view(), Array2::zeros((5, 50)).view(), 1.0).is_nan());
    }

    #[test]
    fn similarity_is_that_of_the_windows_one_by_one() {
        let image = |seed: usize| {
            Array2::from_shape_fn((14, 17), |(row, column)| ((row * 7 + column * 13 + seed * 31) % 23) as f32)
        };
        let (one, other) = (image(1), image(2) * 0.7 + 3.0);
        let gaussian = |at: usize| (-0.5 * ((at as f64 - 5.0) / 1.5).powi(2)).exp();
        let norm: f64 = (0..121).map(|at| gaussian(at / 11) * gaussian(at % 11)).sum();
        let mut expected = 0.0;
        for (top, left) in (0..4).flat_map(|top| (0..7).map(move |left| (top, left))) {
            let mean = |of: &dyn Fn(f64, f64) -> f64| -> f64 {
                let at = |at: usize| {
                    let place = [top + at / 11, left + at % 11];
                    gaussian(at / 11) * gaussian(at % 11) / norm * of(one[place].into(), other[place].into())
                };
                (0..121).map(at).sum()
            };
            let (a, b) = (mean(&|a, _| a), mean(&|_, b| b));
            let (var_a, var_b) = (mean(&|x, _| (x - a).powi(2)), mean(&|_, y| (y - b).powi(2)));
            let covariance = mean(&|x, y| (x - a) * (y - b));
            let (c1, c2) = (0.23_f64.powi(2), 0.69_f64.powi(2));
            expected +=
                (2.0 * a * b + c1) * (2.0 * covariance + c2) / ((a * a + b * b + c1) * (var_a + var_b + c2));
        }
        assert!((ssim(one.view(), other.view(), 23.0) - expected / 28.0).abs() < 1e-9);
    }
}
