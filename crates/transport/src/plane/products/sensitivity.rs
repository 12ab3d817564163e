use ndarray::{Array1, Array2};

use super::super::board::CalibrationParameter;
use super::super::model::{PLACE_STEPS, RESPONSE_ROWS, ResponseClass, collected_rows, drawn};
use super::super::solve::tiles::Problem;
use super::super::{FIRST_RESPONSE_ROW, RowTiming, Setting, Shares, Slot};

/// Steps of the finite differences: far below the width of an edge, far above rounding.
const STEP_US: f64 = 0.1;
const STEP_SHARE: f64 = 1e-3;

/// The change `dA/dq T` of the samples of pixels of camera row `t`, `[pixels, samples]`, with each parameter of the
/// calibration, in the order of [`CalibrationParameter::ALL`]. `light` is that of the problem's unknowns, `[pixels,
/// slots]`.
pub(super) fn changes(
    timing: &RowTiming,
    settings: &[Setting],
    problem: &Problem,
    (t, columns): (usize, &[usize]),
    light: &Array2<f64>,
) -> [Array2<f64>; CalibrationParameter::ALL.len()] {
    let slots = &problem.model.slots;
    let predicted = light.dot(&problem.weights.t());
    let class = timing
        .response()
        .map(|response| response.classes(t, columns.iter().copied(), PLACE_STEPS).swap_remove(0));
    let change = |weights: Array2<f64>, step: f64| (light.dot(&weights.t()) - &predicted) / step;
    let at_other_times = |settings: &[Setting]| weights_of(timing, settings, slots, t, class.as_ref());
    let of_response = |derivative: fn(&Shares) -> Shares| match &class {
        Some(class) => {
            let derivative = derivative(&class.shares);
            let shares = std::array::from_fn(|d| class.shares[d] + STEP_SHARE * derivative[d]);
            let class = ResponseClass { shares, ..class.clone() };
            change(weights_of(timing, settings, slots, t, Some(&class)), STEP_SHARE)
        }
        // Only a calibration measures responses; a beam's place and width have no covariance.
        None => Array2::zeros(predicted.dim()),
    };
    CalibrationParameter::ALL.map(|parameter| match parameter {
        CalibrationParameter::Latency => {
            let later: Vec<Setting> = settings.iter().map(|setting| setting.earlier(STEP_US)).collect();
            change(at_other_times(&later), STEP_US)
        }
        CalibrationParameter::ExposureOffset => {
            let longer: Vec<Setting> = settings.iter().map(|setting| setting.longer(STEP_US)).collect();
            change(at_other_times(&longer), STEP_US)
        }
        CalibrationParameter::Place => of_response(moved),
        CalibrationParameter::Width => of_response(widened),
        CalibrationParameter::White => predicted.clone(),
    })
}

/// Weights of the slots, `[settings, slots]`; 0 for slots that are not seen.
fn weights_of(
    timing: &RowTiming,
    settings: &[Setting],
    slots: &[Slot],
    t: usize,
    class: Option<&ResponseClass>,
) -> Array2<f64> {
    let drawn = drawn(timing, settings, t);
    let mut weights = Array2::zeros((settings.len(), slots.len()));
    match class {
        Some(class) => {
            for (mut weights, drawn) in weights.rows_mut().into_iter().zip(drawn.rows()) {
                let light = collected_rows(drawn, &class.shares, 0, timing.projector_rows());
                let row = |slot: &Slot| (class.own_row + i64::from(slot.u)) as usize;
                weights.assign(&slots.iter().map(|slot| light[row(slot)]).collect::<Array1<f64>>());
            }
        }
        None => {
            for (mut weights, setting) in weights.rows_mut().into_iter().zip(settings) {
                let seen = timing.weights(t, setting);
                let row = |slot: &Slot| (timing.camera().own_row(t) as i64 + i64::from(slot.u)) as usize;
                weights.assign(&slots.iter().map(|slot| seen[row(slot)]).collect::<Array1<f64>>());
            }
        }
    }
    weights
}

/// Derivative of a response to its place: light moves down by one row.
fn moved(shares: &Shares) -> Shares {
    let at = |d: Option<usize>| d.and_then(|d| shares.get(d)).copied().unwrap_or(0.0);
    std::array::from_fn(|d| (at(d.checked_sub(1)) - at(Some(d + 1))) / 2.0)
}

/// Derivative of a response to the factor that widens it about its centroid.
fn widened(shares: &Shares) -> Shares {
    let row = |d: usize| d as f64 + f64::from(FIRST_RESPONSE_ROW);
    let centroid: f64 = (0..RESPONSE_ROWS).map(|d| shares[d] * row(d)).sum();
    moved(&std::array::from_fn(|d| shares[d] * (row(d) - centroid)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn moments(shares: &Shares) -> [f64; 3] {
        let row = |d: usize| d as f64 + f64::from(FIRST_RESPONSE_ROW);
        [0, 1, 2].map(|power| (0..RESPONSE_ROWS).map(|d| shares[d] * row(d).powi(power)).sum())
    }

    #[test]
    fn responses_move_and_widen_by_what_they_should() {
        let mut shares = [0.0; RESPONSE_ROWS];
        (shares[6], shares[7], shares[8], shares[9]) = (0.2, 0.4, 0.3, 0.1);
        let [_, first, second] = moments(&shares);
        let variance = second - first * first;
        let [sum, centroid, _] = moments(&moved(&shares));
        assert!(sum.abs() < 1e-12 && (centroid - 1.0).abs() < 1e-12);
        let [sum, centroid, square] = moments(&widened(&shares));
        assert!(sum.abs() < 1e-12 && centroid.abs() < 1e-12);
        // The second moment about the centroid grows with the square of the factor.
        assert!((square - 2.0 * first * centroid - 2.0 * variance).abs() < 1e-12);
    }
}
