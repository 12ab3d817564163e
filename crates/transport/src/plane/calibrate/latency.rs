use ndarray::{Array2, ArrayView3};
use rayon::prelude::*;

use super::super::{RowTiming, Setting};
use super::beam::{in_sample, log, with_direct_light};
use super::{CalibrateError, Optics, Sample};

/// Delays of all settings that are compared: the objective is close to a parabola over them.
const SHIFTS_US: [f64; 5] = [-3.0, -1.5, 0.0, 1.5, 3.0];

/// By how much the light of a sweep is later than its timing says.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LatencyEstimate {
    /// Time to subtract from the delays of all settings, or to add to the start of all rows.
    pub late_us: f64,
    /// Its standard error, from the scatter of the pixels.
    pub standard_error_us: f64,
    /// Number of sampled pixels with direct light, on which the estimate is based.
    pub pixels: usize,
}

/// Measures how much later than `timing` says the light of a sweep arrived, from the sweep itself: the time at which
/// the model fits the pixels with direct light best, by a parabola through the mean logarithm of their objectives over
/// a common shift of all delays. It also contains a common error of the pixels' places.
///
/// The estimate is good to a few tenths of a microsecond if the response of the pixels is known; a wrong beam moves it.
///
/// # Errors
/// [`CalibrateError::NoDirectLight`] without enough direct light; [`CalibrateError::NoEdge`] if the objective has no
/// minimum within 3 us; those of [`Sample::new`].
pub fn latency(
    timing: &RowTiming,
    settings: &[Setting],
    stack: ArrayView3<f32>,
    valid: Option<ArrayView3<bool>>,
) -> Result<LatencyEstimate, CalibrateError> {
    let sample = |shift_us: f64| {
        let shifted = |setting: &Setting| Setting {
            delays_us: setting.delays_us.iter().map(|delay_us| delay_us - shift_us).collect(),
            exposure_us: setting.exposure_us,
        };
        let settings = settings.iter().map(shifted).collect();
        Ok::<_, CalibrateError>(Sample::new(timing.clone(), settings, stack, valid)?.thinned())
    };
    let kept = with_direct_light(&sample(0.0)?, 0.0)?;
    let pixels: Vec<(usize, usize)> = kept.pixels().collect();
    let objectives = |shift_us: f64| {
        let sample = sample(shift_us)?.keep(|pixel| pixels.contains(&pixel));
        Ok::<_, CalibrateError>(
            in_sample(&sample, &Optics::default())?.into_iter().map(log).collect::<Vec<_>>(),
        )
    };
    let by_shift: Vec<Vec<f64>> = SHIFTS_US.into_par_iter().map(objectives).collect::<Result<_, _>>()?;
    let by_shift = Array2::from_shape_fn((SHIFTS_US.len(), pixels.len()), |(n, pixel)| by_shift[n][pixel]);
    // The least-squares parabola a + b x + c x^2 of each pixel over symmetric shifts.
    let squares: f64 = SHIFTS_US.iter().map(|x| x * x).sum();
    let mean_square = squares / SHIFTS_US.len() as f64;
    let spread: f64 = SHIFTS_US.iter().map(|x| (x * x - mean_square).powi(2)).sum();
    let slopes = |weight: &dyn Fn(f64) -> f64| {
        let of_pixel = |values: ndarray::ArrayView1<f64>| {
            values.iter().zip(SHIFTS_US).map(|(value, x)| weight(x) * value).sum::<f64>()
        };
        by_shift.columns().into_iter().map(of_pixel).collect::<Vec<f64>>()
    };
    let (b, c) = (slopes(&|x| x / squares), slopes(&|x| (x * x - mean_square) / spread));
    let (b_sum, c_sum) = (b.iter().sum::<f64>(), c.iter().sum::<f64>());
    let late_us = -b_sum / (2.0 * c_sum);
    if !(c_sum > 0.0 && late_us.abs() <= SHIFTS_US[4]) {
        return Err(CalibrateError::NoEdge);
    }
    let scatter: f64 = b.iter().zip(&c).map(|(b, c)| (b + 2.0 * c * late_us).powi(2)).sum();
    let standard_error_us = scatter.sqrt() / (2.0 * c_sum);
    Ok(LatencyEstimate { late_us, standard_error_us, pixels: pixels.len() })
}
