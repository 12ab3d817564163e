use ndarray::{Array2, ArrayView3};
use rayon::prelude::*;

use super::super::{RowTiming, Setting};
use super::beam::{in_sample, log, with_direct_light};
use super::{CalibrateError, Optics, Sample};

/// Delays of all settings that are compared: the objective is close to a parabola over them.
const SHIFTS_US: [f64; 5] = [-3.0, -1.5, 0.0, 1.5, 3.0];

/// How often they are placed about another shift, in search of the minimum.
const ROUNDS: usize = 4;

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
/// a common shift of all delays, which is moved until it contains its minimum. It also contains a common error of the
/// pixels' places. The camera rows `rows`, ascending, of `stack` and `valid` are as for [`Sample::of_rows`].
///
/// The estimate is good to a few tenths of a microsecond if the response of the pixels is known; a wrong beam moves it.
///
/// # Errors
/// [`CalibrateError::NoDirectLight`] without enough direct light; [`CalibrateError::NoEdge`] if the objective has no
/// minimum within 12 us; those of [`Sample::of_rows`].
pub fn latency(
    timing: &RowTiming,
    settings: &[Setting],
    rows: &[usize],
    stack: ArrayView3<f32>,
    valid: Option<ArrayView3<bool>>,
) -> Result<LatencyEstimate, CalibrateError> {
    let sample = |shift_us: f64| {
        let settings = settings.iter().map(|setting| setting.earlier(shift_us)).collect();
        Ok::<_, CalibrateError>(Sample::of_rows(timing.clone(), settings, rows, stack, valid)?.thinned())
    };
    let kept = with_direct_light(&sample(0.0)?, 0.0)?;
    let pixels: Vec<(usize, usize)> = kept.pixels().collect();
    let objectives = |shift_us: f64| {
        let sample = sample(shift_us)?.keep(|pixel| pixels.contains(&pixel));
        Ok::<_, CalibrateError>(
            in_sample(&sample, &Optics::default())?.into_iter().map(log).collect::<Vec<_>>(),
        )
    };
    let mut around_us = 0.0;
    for _ in 0..ROUNDS {
        let shifts_us = SHIFTS_US.map(|shift_us| around_us + shift_us);
        let by_shift: Vec<Vec<f64>> = shifts_us.into_par_iter().map(objectives).collect::<Result<_, _>>()?;
        let by_shift =
            Array2::from_shape_fn((shifts_us.len(), pixels.len()), |(n, pixel)| by_shift[n][pixel]);
        match minimum(&by_shift) {
            Minimum::At { shift_us, standard_error_us } => {
                let late_us = around_us + shift_us;
                return Ok(LatencyEstimate { late_us, standard_error_us, pixels: pixels.len() });
            }
            Minimum::Later => around_us += SHIFTS_US[4],
            Minimum::Earlier => around_us -= SHIFTS_US[4],
        }
    }
    Err(CalibrateError::NoEdge)
}

/// Where the mean objective of the pixels is smallest.
enum Minimum {
    At {
        shift_us: f64,
        standard_error_us: f64,
    },
    /// Beyond the last shift.
    Later,
    /// Before the first shift.
    Earlier,
}

/// The minimum of the mean parabola over [`SHIFTS_US`]; `by_shift` is `[shifts, pixels]`.
fn minimum(by_shift: &Array2<f64>) -> Minimum {
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
    let shift_us = -b_sum / (2.0 * c_sum);
    if !(c_sum > 0.0 && shift_us.abs() <= SHIFTS_US[4]) {
        return if b_sum < 0.0 { Minimum::Later } else { Minimum::Earlier };
    }
    let scatter: f64 = b.iter().zip(&c).map(|(b, c)| (b + 2.0 * c * shift_us).powi(2)).sum();
    Minimum::At { shift_us, standard_error_us: scatter.sqrt() / (2.0 * c_sum) }
}
