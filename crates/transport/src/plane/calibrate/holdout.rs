use ndarray::{Array1, Array2, ArrayView1, Axis, s};
use rayon::prelude::*;

use super::super::{PlaneError, Prior, Setting, reach};
use super::{CalibrateError, Optics, Sample};

/// Number of groups into which the settings are divided; each is predicted from the others.
const FOLDS: usize = 5;

/// Smallest mean squared residual, that of a millionth of white light: far below any camera's noise. It only keeps
/// the logarithm of a perfect prediction finite.
const LEAST_SQUARE: f64 = 1e-12;

/// A prior and its error in predicting images that were held out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Candidate {
    /// The prior.
    pub prior: Prior,
    /// Root mean square of the held-out residuals of a typical pixel (geometric mean over pixels); 1.0 is the light
    /// of a white surface per row dwell.
    pub residual: f64,
    /// Mean over pixels of `ln(squared residual / squared residual under the default)`. Each pixel counts relative to
    /// its own noise, so neither bright pixels nor those that no prior fits dominate.
    pub log_ratio: f64,
    /// Standard error of `log_ratio`, due to the choice of pixels and to the choice of settings in each fold.
    pub standard_error: f64,
}

/// The held-out errors of all candidates, and the prior that they favour.
#[derive(Debug, Clone, PartialEq)]
pub struct Choice {
    /// All candidates in the order given, the default first.
    pub curve: Vec<Candidate>,
    /// Index in `curve` of the chosen one.
    pub chosen: usize,
}

impl Choice {
    /// The best candidate, unless the default is within one standard error of it.
    fn new(curve: Vec<Candidate>) -> Self {
        let mut choice = Self { curve, chosen: 0 };
        let best = choice.best();
        if choice.curve[best].log_ratio < -choice.curve[best].standard_error {
            choice.chosen = best;
        }
        choice
    }

    /// The chosen prior.
    pub fn prior(&self) -> Prior {
        self.curve[self.chosen].prior
    }

    /// The choice and its reason, as a sentence for the report.
    pub fn reason(&self) -> String {
        let name =
            |prior: Prior| format!("{} (alpha {}, beta {})", prior.name(), prior.alpha(), prior.beta());
        let best = self.best();
        let (chosen, default) = (self.curve[self.chosen], self.curve[0]);
        let change = |candidate: Candidate| 100.0 * ((candidate.log_ratio / 2.0).exp() - 1.0);
        if self.chosen != 0 {
            return format!(
                "{} predicts held-out settings {:.1} % better than the default {}, by {:.1} standard errors",
                name(chosen.prior),
                -change(chosen),
                name(default.prior),
                -chosen.log_ratio / chosen.standard_error,
            );
        }
        if best == 0 {
            return format!("the default {} predicts held-out settings best", name(default.prior));
        }
        format!(
            "the default {} stays: {} predicts held-out settings only {:.1} % better, within one standard error",
            name(default.prior),
            name(self.curve[best].prior),
            -change(self.curve[best]),
        )
    }

    fn best(&self) -> usize {
        let order = |&a: &usize, &b: &usize| self.curve[a].log_ratio.total_cmp(&self.curve[b].log_ratio);
        (0..self.curve.len()).min_by(order).unwrap_or(0)
    }
}

/// The priors compared if a plan names none: the default first, then split priors over two decades of `alpha` and one
/// of `beta`, and the paper's.
pub fn candidates() -> Vec<Prior> {
    let split = |alpha, beta| Prior::Split { alpha, beta };
    vec![
        Prior::SPLIT,
        split(0.01, 0.001),
        split(0.03, 0.001),
        split(0.3, 0.001),
        split(1.0, 0.001),
        split(0.1, 0.01),
        Prior::PAPER,
        Prior::Paper { alpha: 0.1, beta: 0.01 },
    ]
}

/// Chooses between priors by held-out settings: each fifth of the settings, spread over the plan's delays and
/// exposures, is predicted from the transport estimated from the others. Settings that are the only ones to see some
/// row are never held out.
///
/// The first candidate is the default. Another one is chosen only if it predicts better by more than one standard
/// error.
///
/// # Errors
/// [`CalibrateError::NoCandidates`], [`CalibrateError::TooFewSettings`], those of [`Prior::check`], and
/// [`PlaneError::NotConvex`].
pub fn choose_prior(
    sample: &Sample,
    optics: &Optics,
    candidates: &[Prior],
) -> Result<Choice, CalibrateError> {
    candidates.iter().try_for_each(Prior::check)?;
    let sample = sample.thinned();
    let folds = folds(&sample)?;
    let errors: Vec<Array2<f64>> = candidates
        .par_iter()
        .map(|prior| held_out(&sample, prior, optics, &folds))
        .collect::<Result<_, _>>()?;
    let default = errors.first().ok_or(CalibrateError::NoCandidates)?;
    let default = log_residuals(default);
    let curve: Vec<Candidate> = candidates
        .iter()
        .zip(&errors)
        .map(|(&prior, errors)| {
            let log = log_residuals(errors);
            let (log_ratio, standard_error) = log.ratio_to(&default);
            let residual = (log.by_pixel.mean().unwrap_or_default() / 2.0).exp();
            Candidate { prior, residual, log_ratio, standard_error }
        })
        .collect();
    Ok(Choice::new(curve))
}

/// Logarithms of mean squared held-out residuals: for each pixel, and for the typical pixel of each fold.
pub(super) struct LogResiduals {
    pub by_pixel: Array1<f64>,
    by_fold: Array1<f64>,
}

/// From the result of [`held_out`].
pub(super) fn log_residuals(errors: &Array2<f64>) -> LogResiduals {
    let log = |error: f64| error.max(LEAST_SQUARE).ln();
    LogResiduals {
        by_pixel: errors.mean_axis(Axis(1)).unwrap_or_default().mapv_into(log),
        by_fold: errors.mapv(log).mean_axis(Axis(0)).unwrap_or_default(),
    }
}

impl LogResiduals {
    /// Mean over pixels of the logarithm of the ratio to `other`, and its standard error. This includes the scatter
    /// of pixels and that of folds, because both are samples.
    pub fn ratio_to(&self, other: &Self) -> (f64, f64) {
        let by_pixel = &self.by_pixel - &other.by_pixel;
        let by_fold = &self.by_fold - &other.by_fold;
        let standard_error = standard_error(by_pixel.view()).hypot(standard_error(by_fold.view()));
        (by_pixel.mean().unwrap_or_default(), standard_error)
    }
}

fn standard_error(values: ArrayView1<f64>) -> f64 {
    if values.len() < 2 { 0.0 } else { values.std(1.0) / (values.len() as f64).sqrt() }
}

/// Indices of the settings of each fold. Neighbouring delays lie in different folds, as do neighbouring exposures of
/// one delay.
pub(super) fn folds(sample: &Sample) -> Result<Vec<Vec<usize>>, CalibrateError> {
    let settings = &sample.settings;
    let mean_delay_us =
        |setting: &Setting| setting.delays_us.iter().sum::<f64>() / setting.delays_us.len() as f64;
    let mut order: Vec<usize> = (0..settings.len()).collect();
    order.sort_by(|&a, &b| {
        let (a, b) = (&settings[a], &settings[b]);
        a.exposure_us.total_cmp(&b.exposure_us).then(mean_delay_us(a).total_cmp(&mean_delay_us(b)))
    });
    let mut folds = vec![Vec::new(); FOLDS];
    let same_exposure = |a: &usize, b: &usize| settings[*a].exposure_us == settings[*b].exposure_us;
    for (group, members) in order.chunk_by(same_exposure).enumerate() {
        for (rank, &n) in members.iter().enumerate() {
            folds[(rank + 2 * group) % FOLDS].push(n);
        }
    }
    let seen: Vec<Vec<bool>> = settings
        .iter()
        .map(|setting| {
            let rows = reach(&sample.timing, std::slice::from_ref(setting)).ok();
            sample.reach.clone().map(|u| rows.as_ref().is_some_and(|rows| rows.contains(&u))).collect()
        })
        .collect();
    for fold in &mut folds {
        let others: Vec<usize> = (0..settings.len()).filter(|n| !fold.contains(n)).collect();
        let seen_by_others = |row: usize| others.iter().any(|&n| seen[n][row]);
        let alone = |n: usize| seen[n].iter().enumerate().any(|(row, &sees)| sees && !seen_by_others(row));
        fold.retain(|&n| !alone(n));
    }
    folds.retain(|fold| !fold.is_empty());
    let can_be_held_out = folds.iter().map(Vec::len).sum();
    match can_be_held_out {
        0 | 1 => Err(CalibrateError::TooFewSettings { settings: settings.len(), can_be_held_out }),
        _ => Ok(folds),
    }
}

/// Mean squared residual of each pixel in the settings of each fold if it is estimated from all other folds, shape
/// `[pixels, folds]`.
pub(super) fn held_out(
    sample: &Sample,
    prior: &Prior,
    optics: &Optics,
    folds: &[Vec<usize>],
) -> Result<Array2<f64>, PlaneError> {
    let settings = sample.settings.len();
    let by_class: Vec<Array2<f64>> = sample
        .classes
        .par_iter()
        .map(|class| {
            let mut errors = Array2::zeros((class.pixels.len(), folds.len()));
            for (problem, pixels) in class.problems(prior, optics)? {
                let intensities = class.intensities.select(Axis(0), &pixels);
                let whole = problem.minimise(intensities.view(), None);
                let by_fold = errors.axis_iter_mut(Axis(1)).into_par_iter().zip(folds);
                by_fold.try_for_each(|(mut errors, held)| {
                    let kept: Vec<usize> = (0..settings).filter(|n| !held.contains(n)).collect();
                    let part = problem.without(&kept, held)?;
                    let x = part.minimise(intensities.select(Axis(1), &kept).view(), Some(&whole));
                    let predicted = x.dot(&problem.weights.select(Axis(0), held).t());
                    let residual = predicted - intensities.select(Axis(1), held);
                    for (residual, &pixel) in residual.rows().into_iter().zip(&pixels) {
                        errors[pixel] = residual.dot(&residual) / held.len() as f64;
                    }
                    Ok::<_, PlaneError>(())
                })?;
            }
            Ok(errors)
        })
        .collect::<Result<_, PlaneError>>()?;
    let mut all = Array2::zeros((sample.pixels().count(), folds.len()));
    let mut first = 0;
    for class in by_class {
        all.slice_mut(s![first..first + class.nrows(), ..]).assign(&class);
        first += class.nrows();
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use ndarray::Array3;

    use super::super::super::RowTiming;
    use super::*;

    fn candidate(prior: Prior, log_ratio: f64, standard_error: f64) -> Candidate {
        Candidate { prior, residual: 0.003, log_ratio, standard_error }
    }

    #[test]
    fn noise_does_not_switch_priors() {
        let default = candidate(Prior::SPLIT, 0.0, 0.0);
        let chosen = |log_ratio, standard_error| {
            let choice = Choice::new(vec![default, candidate(Prior::PAPER, log_ratio, standard_error)]);
            (choice.prior(), choice.reason())
        };
        let (prior, reason) = chosen(0.2, 0.1);
        assert_eq!(prior, Prior::SPLIT);
        assert!(reason.ends_with("predicts held-out settings best"), "{reason}");
        let (prior, reason) = chosen(-0.2, 0.21);
        assert_eq!(prior, Prior::SPLIT);
        assert!(reason.contains("only 9.5 % better"), "{reason}");
        let (prior, reason) = chosen(-0.2, 0.1);
        assert_eq!(prior, Prior::PAPER);
        assert!(reason.contains("9.5 % better") && reason.ends_with("by 2.0 standard errors"), "{reason}");
    }

    #[test]
    fn folds_are_spread_over_the_plan_and_lose_sight_of_no_row() {
        let timing = RowTiming::new(128, 22.22, 50_000.0 / 3.0).unwrap();
        let settings: Vec<Setting> = (0..75)
            .map(|n| Setting::new(-1500.0 + 3000.0 / 14.0 * (n % 15) as f64, 600.0 + 150.0 * (n / 15) as f64))
            .collect();
        let stack = Array3::zeros((75, 128, 4));
        let sample = Sample::new(timing.clone(), settings.clone(), stack.view(), None).unwrap();
        let folds = folds(&sample).unwrap();
        assert_eq!(folds.len(), 5);
        for fold in &folds {
            let rest: Vec<Setting> =
                (0..75).filter(|n| !fold.contains(n)).map(|n| settings[n].clone()).collect();
            assert_eq!(reach(&timing, &rest), reach(&timing, &settings));
            for exposure in 0..5 {
                let delays: Vec<usize> =
                    fold.iter().filter(|&n| n / 15 == exposure).map(|n| n % 15).collect();
                assert!((2..=3).contains(&delays.len()), "{fold:?}");
                assert!(delays.is_sorted_by(|a, b| a + 5 == *b), "{fold:?}");
            }
        }
        let mut held: Vec<usize> = folds.concat();
        held.sort_unstable();
        // Only the longest exposures at the ends of the sweep see the outermost rows.
        assert_eq!(held, (0..75).filter(|n| ![60, 74].contains(n)).collect::<Vec<_>>());
    }
}
