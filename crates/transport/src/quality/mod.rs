//! Metrics that compare an estimated transport with a known one.

mod edge;
mod fidelity;

pub use edge::{EdgeError, EdgeResponse, slanted_edge};
pub use fidelity::{psnr_db, snr_db, ssim};

use ndarray::{ArrayView, ArrayView3, Axis, Dimension, Zip};

/// Relative l2 error of a whole array, `||estimate - truth|| / ||truth||`; used for example for the image at `u = 0`.
///
/// Infinite if the truth is 0 everywhere and the estimate is not. Both arrays have the same shape.
pub fn relative_l2<D: Dimension>(estimate: ArrayView<f32, D>, truth: ArrayView<f32, D>) -> f64 {
    let mut error = 0.0;
    let mut size = 0.0;
    Zip::from(estimate).and(truth).for_each(|&estimate, &truth| {
        error += (f64::from(estimate) - f64::from(truth)).powi(2);
        size += f64::from(truth).powi(2);
    });
    if error == 0.0 { 0.0 } else { (error / size).sqrt() }
}

/// Median over pixels of the relative l2 error of the profile over `u`; arrays `[u, t, s]` of the same shape. Pixels
/// whose true profile is 0 are left out; NaN if no pixel remains.
pub fn median_profile_error(estimate: ArrayView3<f32>, truth: ArrayView3<f32>) -> f64 {
    let mut errors: Vec<f64> = estimate
        .lanes(Axis(0))
        .into_iter()
        .zip(truth.lanes(Axis(0)))
        .filter(|(_, truth)| truth.iter().any(|&value| value != 0.0))
        .map(|(estimate, truth)| relative_l2(estimate, truth))
        .collect();
    errors.sort_by(f64::total_cmp);
    match errors.len() {
        0 => f64::NAN,
        count if count % 2 == 1 => errors[count / 2],
        count => (errors[count / 2 - 1] + errors[count / 2]) / 2.0,
    }
}

/// Share of all light that comes from rows `|u| <= half_width_rows`; `transport` is `[u, t, s]` with `u_min` at
/// index 0. NaN without light.
pub fn share_near(transport: ArrayView3<f32>, u_min: i32, half_width_rows: u32) -> f64 {
    let light = transport.fold_axis(Axis(1), 0.0, |sum, &value| sum + f64::from(value)).sum_axis(Axis(1));
    let near = light
        .indexed_iter()
        .filter(|(index, _)| (u_min + *index as i32).unsigned_abs() <= half_width_rows)
        .map(|(_, light)| light);
    near.sum::<f64>() / light.sum()
}

#[cfg(test)]
mod tests {
    use ndarray::{Array3, array};

    use super::*;

    #[test]
    fn relative_l2_by_hand() {
        assert_eq!(relative_l2(array![3.0, 5.0].view(), array![3.0, 4.0].view()), 0.2);
        assert_eq!(relative_l2(array![0.0].view(), array![0.0].view()), 0.0);
        assert_eq!(relative_l2(array![1.0].view(), array![0.0].view()), f64::INFINITY);
    }

    #[test]
    fn the_median_skips_dark_pixels() {
        // Profiles over u of four pixels: errors 0.5, 0.1 and 0.3, and one pixel without light.
        let truth = array![[[1.0, 10.0, 0.0, 0.0]], [[0.0, 0.0, 10.0, 0.0]]];
        let estimate = array![[[1.5, 11.0, 0.0, 7.0]], [[0.0, 0.0, 7.0, 0.0]]];
        assert!((median_profile_error(estimate.view(), truth.view()) - 0.3).abs() < 1e-6);
        assert!(median_profile_error(estimate.view(), Array3::zeros((2, 1, 4)).view()).is_nan());
    }

    #[test]
    fn share_counts_from_the_direct_row() {
        let transport = Array3::from_shape_fn((6, 2, 2), |(u, ..)| [1.0, 2.0, 4.0, 8.0, 16.0, 32.0][u]);
        assert_eq!(share_near(transport.view(), -2, 0), 4.0 / 63.0);
        assert_eq!(share_near(transport.view(), -2, 1), 14.0 / 63.0);
        assert_eq!(share_near(transport.view(), -2, 9), 1.0);
    }
}
