//! Fits that a few wrong dots do not move.

use crate::dots::sensor::median;

/// Ratio of a normal distribution's standard deviation to its median deviation.
const SD_OVER_MEDIAN: f64 = 1.4826;

/// Distance in standard deviations from which a dot has no weight; 95 % efficient without outliers (Huber and
/// Ronchetti, Robust Statistics, 2009).
const TUKEY: f64 = 4.685;

/// More steps than a fit takes to settle.
const MOST_STEPS: usize = 50;

/// Standard deviation of most of these distances, from their median deviation from 0; they are reordered.
pub(super) fn spread_of(distances: &mut [f64]) -> f64 {
    distances.iter_mut().for_each(|distance| *distance = distance.abs());
    SD_OVER_MEDIAN * median(distances)
}

/// Iteratively reweighted least squares with Tukey's biweight: from `begin`, `distances` of all dots and a weighted
/// `fit` take turns until the weights settle. Returns the fit and the weights, 0 for outliers.
pub(super) fn reweighted<M>(
    begin: M,
    distances: impl Fn(&M, &mut Vec<f64>),
    fit: impl Fn(&M, &[f64]) -> M,
) -> (M, Vec<f64>) {
    let mut model = begin;
    let (mut far, mut sorted) = (Vec::new(), Vec::new());
    let mut weights: Vec<f64> = Vec::new();
    for _ in 0..MOST_STEPS {
        distances(&model, &mut far);
        sorted.clone_from(&far);
        // Of exact data, all dots are good.
        let limit = (TUKEY * spread_of(&mut sorted)).max(1e-9);
        let fresh: Vec<f64> = far.iter().map(|far| (1.0 - (far / limit).powi(2)).max(0.0).powi(2)).collect();
        let moved = weights.iter().zip(&fresh).map(|(before, now)| (before - now).abs()).fold(0.0, f64::max);
        let is_settled = !weights.is_empty() && moved < 1e-6;
        weights = fresh;
        if is_settled {
            break;
        }
        model = fit(&model, &weights);
    }
    (model, weights)
}
