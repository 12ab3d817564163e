//! Predicts the error of a plan before anything is captured, and finds plans of the same length with a smaller error.

use std::ops::RangeInclusive;

use ndarray::{Array1, Array2, Axis};
use rayon::prelude::*;

use super::solve::cholesky;
use super::{PlaneError, Prior, RowModel, RowTiming, Setting, SlotKind, reach};

/// Noise of the camera, in the units of the transport: 1 is the light that a white pixel collects in one row time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Noise {
    /// Standard deviation of a dark sample of one frame, quantisation included.
    pub read: f64,
    /// Variance of one frame's sample per unit of light: the reciprocal of the electrons that a white pixel collects
    /// per row.
    pub gain: f64,
    /// Frames averaged per setting.
    pub frames: u32,
    /// Number of frames averaged in the dark image that is subtracted from all images of one exposure, which
    /// therefore share its noise; `None` if no dark image is subtracted.
    pub dark_frames: Option<u32>,
}

impl Noise {
    /// Variance of the mean of the frames when `light` is collected.
    fn variance(&self, light: f64) -> f64 {
        (self.read.powi(2) + self.gain * light.max(0.0)) / f64::from(self.frames.max(1))
    }

    /// Variance of the dark image.
    fn dark_variance(&self) -> f64 {
        self.dark_frames.map_or(0.0, |frames| self.read.powi(2) / f64::from(frames.max(1)))
    }
}

/// Expected errors of a white pixel in the middle of the frame, in white units.
///
/// They are the errors of the linear estimator `H^-1 A' I` with `H = A'A + alpha D'D`. `T >= 0` and beta are left
/// out; they only reduce the error (for the paper's prior, which blurs the pixel's own row without them, by a factor
/// of 3). Timing, beam and white level are assumed to be exact. The pixel receives 1 from its own row and
/// [`INDIRECT_PER_ROW`] from each other row. Around that, neighbouring rows differ such that the prior's weighted
/// differences have the standard deviation [`ROUGHNESS`]. The error therefore has two parts: the noise of the samples
/// and of the dark images, and the bias from smoothing and from rows that the settings do not see.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExpectedError {
    /// Standard error of the pixel's own row, `u = 0`.
    pub epipolar: f64,
    /// Standard error of the sum over `1 <= |u| <= 10`.
    pub short_range: f64,
    /// Standard error of the sum over `|u| > 10` within the reach.
    pub long_range: f64,
    /// Error of the profile: the square root of the expected sum of squared errors of all rows.
    pub profile: f64,
}

/// Indirect light that a white pixel is assumed to receive from each row: 0.38 in total from a scene of 128 rows. In
/// a rendered corner of two boards it is 0.0026 per direct light of 1.
pub const INDIRECT_PER_ROW: f64 = 0.003;

/// Assumed standard deviation of `|u| (T(u+1) - T(u))`. In the rendered corner it is 0.011 per direct light of 1.
pub const ROUGHNESS: f64 = 0.01;

/// Farthest row that counts as short-range.
const SHORT_RANGE_ROWS: i32 = 10;

/// The expected error of `settings`, one delay each, when the rows of `reach` are estimated.
///
/// # Errors
/// Those of [`RowTiming::check`]; [`PlaneError::NotConvex`].
pub fn expected_error(
    timing: &RowTiming,
    settings: &[Setting],
    reach: &RangeInclusive<i32>,
    prior: &Prior,
    noise: &Noise,
) -> Result<ExpectedError, PlaneError> {
    timing.check(settings)?;
    let RowModel { slots, weights } = RowModel::typical(timing, settings, reach, timing.camera_rows() / 2);
    let differences = prior.differences(&slots);
    let smoothness = differences.t().dot(&differences) * prior.alpha();
    let n = slots.len();
    let mut h = weights.t().dot(&weights) + &smoothness;
    // Undetermined rows must not make it singular.
    h.diag_mut().mapv_inplace(|diagonal| if diagonal > 0.0 { diagonal * (1.0 + 1e-12) } else { 1.0 });
    let mut inverse: Vec<f64> = h.into_iter().collect();
    cholesky::invert(&mut inverse, n).map_err(|cholesky::NotPositiveDefinite| PlaneError::NotConvex)?;
    let inverse = Array2::from_shape_fn((n, n), |(i, j)| inverse[i.max(j) * n + i.min(j)]);

    let truth = Array1::from_iter(slots.iter().map(|slot| match slot.u {
        0 => 1.0,
        _ => INDIRECT_PER_ROW,
    }));
    // Errors of the right-hand side `A'I` of `H T = A'I`: its covariance,
    let variances = weights.dot(&truth).mapv(|light| noise.variance(light)).insert_axis(Axis(1));
    let mut wrong = weights.t().dot(&(&weights * &variances));
    wrong.scaled_add(prior.alpha() * ROUGHNESS.powi(2), &smoothness);
    for exposed in of_each_exposure(settings, &weights) {
        add_square(&mut wrong, noise.dark_variance(), &exposed);
    }
    // and the bias from smoothing, which exists even without noise.
    add_square(&mut wrong, 1.0, &smoothness.dot(&truth));

    let covariance_half = inverse.dot(&wrong);
    let own = |rows: RangeInclusive<i32>| {
        slots
            .iter()
            .map(move |slot| f64::from(slot.kind == SlotKind::Own && rows.contains(&slot.u.abs())))
            .collect::<Array1<f64>>()
    };
    let band = |rows: RangeInclusive<i32>| {
        let solved = inverse.dot(&own(rows));
        solved.dot(&wrong.dot(&solved)).max(0.0).sqrt()
    };
    let squares = (&covariance_half * &inverse).sum_axis(Axis(1));
    Ok(ExpectedError {
        epipolar: band(0..=0),
        short_range: band(1..=SHORT_RANGE_ROWS),
        long_range: band(SHORT_RANGE_ROWS + 1..=i32::MAX),
        profile: squares.dot(&own(0..=i32::MAX)).sqrt(),
    })
}

/// Sums of the weights of the settings of each exposure: the effect of an error of its dark image on `A'I`.
fn of_each_exposure(settings: &[Setting], weights: &Array2<f64>) -> Vec<Array1<f64>> {
    let mut sums: Vec<(f64, Array1<f64>)> = Vec::new();
    for (setting, weights) in settings.iter().zip(weights.rows()) {
        match sums.iter_mut().find(|(exposure_us, _)| *exposure_us == setting.exposure_us) {
            Some((_, sum)) => *sum += &weights,
            None => sums.push((setting.exposure_us, weights.to_owned())),
        }
    }
    sums.into_iter().map(|(_, sum)| sum).collect()
}

/// Adds `factor x x'`.
fn add_square(to: &mut Array2<f64>, factor: f64, x: &Array1<f64>) {
    for (mut row, &x_i) in to.rows_mut().into_iter().zip(x) {
        row.scaled_add(factor * x_i, x);
    }
}

/// The light that the pixel of [`ExpectedError`] collects with a setting.
pub fn white_light(timing: &RowTiming, setting: &Setting) -> f64 {
    let (weights, own_row) = timing.typical_weights(timing.camera_rows() / 2, setting);
    let own = weights[own_row];
    own + INDIRECT_PER_ROW * (weights.iter().sum::<f64>() - own)
}

/// A sweep: every delay with every exposure.
#[derive(Debug, Clone, PartialEq)]
pub struct SweepGrid {
    /// Delays, ascending.
    pub delays_us: Vec<f64>,
    /// Exposures, ascending.
    pub exposures_us: Vec<f64>,
}

impl SweepGrid {
    /// The settings of the grid, delays fastest.
    pub fn settings(&self) -> Vec<Setting> {
        let delays = |&exposure_us: &f64| {
            self.delays_us.iter().map(move |&delay_us| Setting::new(delay_us, exposure_us))
        };
        self.exposures_us.iter().flat_map(delays).collect()
    }
}

/// The expected error of a sweep, and a better sweep if there is one.
#[derive(Debug, Clone, PartialEq)]
pub struct Advice {
    /// Expected error of the sweep.
    pub expected: ExpectedError,
    /// A better sweep of at most as many points that is worth the change, and its expected error.
    pub better: Option<(SweepGrid, ExpectedError)>,
}

/// Another sweep is worth the change if its expected error of the profile is below this share of the plan's.
const WORTHWHILE: f64 = 0.9;

/// Largest allowed ratio between the other sweep's error of a band and the plan's.
const HARMLESS: f64 = 1.1;

/// Predicts the error of `plan`. Among the grids of at most as many points over the same delays and exposures, finds
/// the one with the smallest expected error of the profile, provided that it is smaller by 10 % and that no band's
/// error is larger by 10 %. The candidates use the longest exposure alone and two to four of the exposures, with
/// delays that are evenly spaced or denser near 0 (`± d_max (k/h)^p`); all have the same reach as `plan`.
///
/// `usable` returns the settings of a grid whose images will be usable, or `None` if the rig cannot acquire the grid.
///
/// # Errors
/// Those of [`reach`] and [`expected_error`]; [`PlaneError::NoDelays`] if no setting of `plan` is usable.
pub fn advise(
    timing: &RowTiming,
    plan: &SweepGrid,
    prior: &Prior,
    noise: &Noise,
    usable: impl Fn(&SweepGrid) -> Option<Vec<Setting>> + Sync,
) -> Result<Advice, PlaneError> {
    let reach = reach(timing, &plan.settings())?;
    let foresee = |settings: &[Setting]| expected_error(timing, settings, &reach, prior, noise);
    let expected = foresee(&usable(plan).unwrap_or_default())?;
    let worthwhile = |other: &ExpectedError| {
        other.profile <= WORTHWHILE * expected.profile
            && other.epipolar <= HARMLESS * expected.epipolar
            && other.short_range <= HARMLESS * expected.short_range
            && other.long_range <= HARMLESS * expected.long_range
    };
    let foreseen = alternatives(plan)
        .into_par_iter()
        .filter_map(|grid| {
            let settings = usable(&grid).filter(|settings| !settings.is_empty())?;
            Some(foresee(&settings).map(|expected| (grid, expected)))
        })
        .collect::<Result<Vec<_>, _>>()?;
    let worthwhile = foreseen.into_iter().filter(|(_, expected)| worthwhile(expected));
    let better = worthwhile.min_by(|(_, a), (_, b)| a.profile.total_cmp(&b.profile));
    Ok(Advice { expected, better })
}

/// Exponents by which the delays of the denser grids spread out away from 0.
const DENSITIES: [f64; 2] = [1.3, 1.7];

/// Largest number of exposures in candidate grids.
const MAX_EXPOSURES: usize = 4;

fn alternatives(plan: &SweepGrid) -> Vec<SweepGrid> {
    let points = plan.delays_us.len() * plan.exposures_us.len();
    let (first_us, last_us) = range_of(&plan.delays_us);
    let (shortest_us, longest_us) = range_of(&plan.exposures_us);
    // Rows that only the longest exposure reaches would be lost without it.
    let mut exposures = vec![vec![longest_us]];
    if longest_us > shortest_us {
        exposures.extend((2..=MAX_EXPOSURES).map(|count| even(shortest_us, longest_us, count)));
    }
    let mut grids = Vec::new();
    for exposures_us in exposures {
        let delays = points / exposures_us.len();
        if delays > 1 && first_us < last_us {
            let delays_us = even(first_us, last_us, delays);
            grids.push(SweepGrid { delays_us, exposures_us: exposures_us.clone() });
        }
        // Number of delays on each side of 0.
        let half = delays.saturating_sub(1) / 2;
        if half > 0 && first_us < 0.0 && last_us > 0.0 {
            for density in DENSITIES {
                // Rounded: more digits are neither readable nor used by any camera.
                let place = |far_us: f64, k: usize| {
                    (far_us * (k as f64 / half as f64).powf(density) * 10.0).round() / 10.0
                };
                let before = (1..=half).rev().map(|k| place(first_us, k));
                let delays_us = before.chain((0..=half).map(|k| place(last_us, k))).collect();
                grids.push(SweepGrid { delays_us, exposures_us: exposures_us.clone() });
            }
        }
    }
    grids
}

fn range_of(values: &[f64]) -> (f64, f64) {
    values
        .iter()
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), &value| (low.min(value), high.max(value)))
}

/// `count` evenly spaced values from `first` to `last`, at least two.
fn even(first: f64, last: f64, count: usize) -> Vec<f64> {
    (0..count).map(|k| first + (last - first) * k as f64 / (count - 1) as f64).collect()
}

#[cfg(test)]
mod tests {
    use rand_distr::{Distribution, StandardNormal};
    use rand_xoshiro::Xoshiro256PlusPlus;
    use rand_xoshiro::rand_core::SeedableRng;

    use super::super::Demux;
    use super::*;

    const TAU_US: f64 = 22.22;

    fn timing() -> RowTiming {
        RowTiming::new(128, TAU_US, 50_000.0 / 3.0).unwrap()
    }

    fn paper_grid() -> SweepGrid {
        SweepGrid {
            delays_us: (0..15).map(|k| -1500.0 + 3000.0 / 14.0 * f64::from(k)).collect(),
            exposures_us: (0..5).map(|k| 600.0 + 150.0 * f64::from(k)).collect(),
        }
    }

    /// 15 electrons of read noise, and 4884 electrons that a white pixel collects per row.
    fn noise(frames: u32) -> Noise {
        Noise { read: 15.0 / 4884.0, gain: 1.0 / 4884.0, frames, dark_frames: None }
    }

    #[test]
    fn one_row_by_hand() {
        // One row, seen completely by four settings: the mean of four samples of variance 0.01 + 0.04.
        let timing = RowTiming::new(1, 20.0, 100.0).unwrap();
        let settings = vec![Setting::new(0.0, 20.0); 4];
        let noise = Noise { read: 0.1, gain: 0.04, frames: 1, dark_frames: None };
        let epipolar = |settings: &[Setting], noise: &Noise| {
            let expected = expected_error(&timing, settings, &(0..=0), &Prior::SPLIT, noise).unwrap();
            assert_eq!((expected.short_range, expected.profile), (0.0, expected.epipolar));
            expected.epipolar
        };
        let close = |found: f64, variance: f64| assert!((found - variance.sqrt()).abs() < 1e-9, "{found}");
        close(epipolar(&settings, &noise), 0.05 / 4.0);
        close(epipolar(&settings, &Noise { frames: 4, ..noise }), 0.05 / 16.0);
        // All four settings share the dark image of five frames; a fifth setting, which sees half of the row, has
        // another.
        let noise = Noise { dark_frames: Some(5), ..noise };
        close(epipolar(&settings, &noise), 0.05 / 4.0 + 0.01 / 5.0);
        let fifth = [settings, vec![Setting::new(0.0, 10.0)]].concat();
        let dark = (4.0 * 4.0 + 0.5 * 0.5) * 0.01 / 5.0;
        close(epipolar(&fifth, &noise), (4.0 * 0.05 + 0.25 * 0.03 + dark) / 4.25_f64.powi(2));
    }

    #[test]
    fn white_light_by_hand() {
        // Rows 63, 64, 65 completely and half of rows 62 and 66.
        let light = white_light(&timing(), &Setting::new(0.0, 4.0 * TAU_US));
        assert!((light - (1.0 + 3.0 * INDIRECT_PER_ROW)).abs() < 1e-9);
        let beside = white_light(&timing(), &Setting::new(500.0, 4.0 * TAU_US));
        assert!((beside - 4.0 * INDIRECT_PER_ROW).abs() < 1e-9);
    }

    #[test]
    fn the_solver_errs_as_much_as_expected() {
        // Noise dominates with the usual alpha, smoothing with the second.
        solver_errs_as_expected(0.1);
        solver_errs_as_expected(30.0);
    }

    fn solver_errs_as_expected(alpha: f64) {
        // Many pixels with a profile so bright that T >= 0 never binds, with the assumed roughness.
        const PIXELS: usize = 300;
        let (timing, settings) = (timing().window(64, 1).unwrap(), paper_grid().settings());
        let prior = Prior::Split { alpha, beta: 0.0 };
        let noise = Noise { dark_frames: Some(1), ..noise(8) };
        let demux = Demux::new(timing.clone(), settings.clone(), prior).unwrap();
        let expected = expected_error(&timing, &settings, &demux.reach(), &prior, &noise).unwrap();

        let mut random = Xoshiro256PlusPlus::seed_from_u64(3);
        let mut normal = move || -> f64 { StandardNormal.sample(&mut random) };
        let rows = timing.projector_rows();
        let mut truth = Array2::zeros((rows, PIXELS));
        for mut profile in truth.columns_mut() {
            // Outwards from the own row, each row differs from the previous one by its share of the roughness.
            let sides = [(64 + 1..rows).collect::<Vec<_>>(), (0..64).rev().collect()];
            for side in sides {
                let mut light = 1.0;
                for (distance, v) in (1..).zip(side) {
                    profile[v] = light;
                    light += ROUGHNESS * normal() / (f64::from(distance) + 0.5);
                }
            }
            profile[64] = 1.0;
        }
        let shares: Vec<f64> = settings.iter().flat_map(|setting| timing.weights(0, setting)).collect();
        let weights = Array2::from_shape_vec((settings.len(), rows), shares).unwrap();
        let assumed = Array1::from_shape_fn(rows, |v| if v == 64 { 1.0 } else { INDIRECT_PER_ROW });
        let deviations = weights.dot(&assumed).mapv(|light| noise.variance(light).sqrt());
        let mut stack = weights.dot(&truth);
        for (mut samples, deviation) in stack.rows_mut().into_iter().zip(&deviations) {
            samples.mapv_inplace(|sample| sample + deviation * normal());
        }
        for mut samples in stack.exact_chunks_mut((15, PIXELS)) {
            let dark = Array1::from_shape_fn(PIXELS, |_| noise.read * normal());
            samples -= &dark;
        }
        let stack = stack.mapv(|sample| sample as f32).insert_axis(Axis(1));
        let found = demux.solve(stack.view(), None).unwrap();

        let error = |first: usize, last: usize, pixel: usize| -> f64 {
            (first..=last).map(|v| f64::from(found.t[[v, 0, pixel]]) - truth[[v, pixel]]).sum()
        };
        let deviation = |error: &dyn Fn(usize) -> f64| {
            ((0..PIXELS).map(|pixel| error(pixel).powi(2)).sum::<f64>() / PIXELS as f64).sqrt()
        };
        assert_eq!((found.u_min, found.t.len_of(Axis(0))), (-64, 128));
        let measured = [
            deviation(&|pixel| error(64, 64, pixel)),
            deviation(&|pixel| error(54, 63, pixel) + error(65, 74, pixel)),
            deviation(&|pixel| error(0, 53, pixel) + error(75, 127, pixel)),
        ];
        // 300 pixels determine a standard deviation to 4 %.
        let foreseen = [expected.epipolar, expected.short_range, expected.long_range];
        for (measured, foreseen) in measured.into_iter().zip(foreseen) {
            assert!((measured / foreseen - 1.0).abs() < 0.15, "{measured} is not {foreseen}");
        }
    }

    #[test]
    fn the_papers_prior_is_expected_to_smear_the_own_row() {
        let settings = paper_grid().settings();
        let expect = |prior| expected_error(&timing(), &settings, &(-64..=63), &prior, &noise(8)).unwrap();
        let (paper, split) = (expect(Prior::PAPER), expect(Prior::SPLIT));
        assert!(paper.epipolar > 10.0 * split.epipolar, "{paper:?} {split:?}");
        // What the own row loses, its neighbours gain.
        assert!(
            (paper.short_range / paper.epipolar - 1.0).abs() < 0.1 && paper.long_range < 0.1 * paper.epipolar
        );
    }

    #[test]
    fn more_delays_beat_more_exposures() {
        for frames in [1, 8] {
            let noise = Noise { dark_frames: Some(frames), ..noise(frames) };
            let own = |grid: &SweepGrid| {
                expected_error(&timing(), &grid.settings(), &(-94..=94), &Prior::SPLIT, &noise).unwrap()
            };
            let advice =
                advise(&timing(), &paper_grid(), &Prior::SPLIT, &noise, |grid| Some(grid.settings()))
                    .unwrap();
            let (grid, expected) = advice.better.unwrap();
            assert_eq!((advice.expected, expected), (own(&paper_grid()), own(&grid)));
            assert!(grid.delays_us.len() > 15 && grid.delays_us.len() * grid.exposures_us.len() <= 75);
            assert!(expected.profile < WORTHWHILE * advice.expected.profile);
            assert!(expected.long_range <= HARMLESS * advice.expected.long_range);
            assert_eq!(grid.delays_us.first().copied(), Some(-1500.0));
            assert!(grid.delays_us.is_sorted() && grid.delays_us.contains(&0.0));
        }
    }

    #[test]
    fn what_the_rig_cannot_take_is_not_advised() {
        let advise = |usable: &(dyn Fn(&SweepGrid) -> Option<Vec<Setting>> + Sync)| {
            advise(&timing(), &paper_grid(), &Prior::SPLIT, &noise(8), usable)
        };
        let own = paper_grid();
        assert_eq!(advise(&|grid| (*grid == own).then(|| grid.settings())).unwrap().better, None);
        let long = |grid: &SweepGrid| *grid == own || grid.exposures_us == [1200.0];
        assert_ne!(advise(&|grid| Some(grid.settings())).unwrap().better.unwrap().0.exposures_us, [1200.0]);
        let (grid, _) = advise(&|grid| long(grid).then(|| grid.settings())).unwrap().better.unwrap();
        assert_eq!(grid.exposures_us, [1200.0]);
        // Settings that are not usable do not count, and a plan without usable settings has no error.
        let few = advise(&|grid| Some(grid.settings().into_iter().step_by(3).collect())).unwrap();
        assert!(few.expected.profile > advise(&|grid| Some(grid.settings())).unwrap().expected.profile);
        assert_eq!(advise(&|_| None), Err(PlaneError::NoDelays { index: 0 }));
    }

    #[test]
    fn delays_to_one_side_stay_there() {
        let plan =
            SweepGrid { delays_us: vec![0.0, 500.0, 1000.0, 2000.0], exposures_us: vec![300.0, 600.0] };
        let grids = alternatives(&plan);
        assert_eq!(grids.len(), 4);
        for grid in grids {
            assert_eq!((grid.delays_us[0], grid.delays_us.last().copied()), (0.0, Some(2000.0)));
            assert_eq!(reach(&timing(), &grid.settings()), reach(&timing(), &plan.settings()));
        }
    }

    #[test]
    fn a_plan_too_short_for_alternatives_stays() {
        let plan = SweepGrid { delays_us: vec![0.0], exposures_us: vec![600.0, 900.0] };
        assert_eq!(alternatives(&plan), []);
    }
}
