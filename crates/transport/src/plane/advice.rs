//! What error a plan must expect, and which plan of the same length must expect less: before anything is captured.

use std::ops::RangeInclusive;

use ndarray::{Array1, Array2, ArrayView1, Axis};

use super::{PlaneError, Prior, RowModel, RowTiming, Setting, SlotKind, cholesky, reach};

/// Noise of the camera, in the units of the transport: 1 is what a white pixel collects in one row time.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Noise {
    /// Standard deviation of a dark sample of one frame, quantisation included.
    pub read: f64,
    /// Variance of one frame's sample per light collected: the reciprocal of the electrons of a white pixel's row.
    pub gain: f64,
    /// Frames averaged per setting.
    pub frames: u32,
}

impl Noise {
    /// Variance of the mean of the frames where `light` is collected.
    fn variance(&self, light: f64) -> f64 {
        (self.read.powi(2) + self.gain * light.max(0.0)) / f64::from(self.frames.max(1))
    }
}

/// Expected errors of a white pixel in the middle of the frame, in white units.
///
/// They are those of the linear estimator `H^-1 A' I` with `H = A'A + alpha D'D`: `T >= 0` and beta, which only help
/// (the paper's prior, which smears the own row without them, by a factor of 3), are left out, and timing, beam and white level are taken as true. The pixel receives 1 from its own row and
/// [`INDIRECT_PER_ROW`] from all others; around that, neighbouring rows differ such that the prior's weighted
/// differences have the standard deviation [`ROUGHNESS`]. So the error has two parts: the samples' noise, and what
/// smoothing takes away or settings do not see.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ExpectedError {
    /// Standard deviation of the pixel's own row, `u = 0`.
    pub epipolar: f64,
    /// Of the sum over `1 <= |u| <= 10`.
    pub short_range: f64,
    /// Of the sum over `|u| > 10` within the reach.
    pub long_range: f64,
    /// Of the profile: the square root of the expected sum of squared errors of all rows.
    pub profile: f64,
}

/// Indirect light that a white pixel is taken to receive from each row: 0.38 in all from a 128-row scene. A rendered
/// corner of two boards has 0.0026 per direct light of 1.
pub const INDIRECT_PER_ROW: f64 = 0.003;

/// Standard deviation of `|u| (T(u+1) - T(u))` that profiles are taken to have. The rendered corner has 0.011 per direct
/// light of 1.
pub const ROUGHNESS: f64 = 0.01;

/// Farthest row that counts as short-range.
const SHORT_RANGE_ROWS: i32 = 10;

/// The error to expect from `settings`, one delay each, when the rows of `reach` are estimated.
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
    let RowModel { slots, weights } = RowModel::new(timing, settings, reach, timing.camera_rows() / 2);
    let differences = prior.differences(&slots);
    let n = slots.len();
    let mut h = weights.t().dot(&weights) + prior.alpha() * differences.t().dot(&differences);
    // Rows that nothing determines must not make it singular.
    h.diag_mut().mapv_inplace(|diagonal| if diagonal > 0.0 { diagonal * (1.0 + 1e-12) } else { 1.0 });
    let mut factor: Vec<f64> = h.into_iter().collect();
    cholesky::factor(&mut factor, n).map_err(|cholesky::NotPositiveDefinite| PlaneError::NotConvex)?;
    let solve_rows = |right_sides: &Array2<f64>| {
        let mut solutions = right_sides.to_owned();
        for mut row in solutions.rows_mut() {
            let mut solution = row.to_vec();
            cholesky::solve(&factor, n, &mut solution);
            row.assign(&ArrayView1::from(&solution));
        }
        solutions
    };

    // Each row: what one independent cause of error with standard deviation 1 does to the profile.
    let truth = Array1::from_iter(slots.iter().map(|slot| match slot.u {
        0 => 1.0,
        _ => INDIRECT_PER_ROW,
    }));
    let deviations = weights.dot(&truth).mapv(|light| noise.variance(light).sqrt()).insert_axis(Axis(1));
    let by_noise = solve_rows(&weights) * deviations;
    let by_roughness = solve_rows(&differences) * (prior.alpha() * ROUGHNESS);
    let smoothed = differences.t().dot(&differences.dot(&truth)) * prior.alpha();
    let by_smoothing = solve_rows(&smoothed.insert_axis(Axis(0)));

    let causes = [by_noise, by_roughness, by_smoothing];
    let profiles = || causes.iter().flat_map(|profiles| profiles.rows());
    let own = |slot: usize, rows: &RangeInclusive<i32>| {
        slots[slot].kind == SlotKind::Own && rows.contains(&slots[slot].u.abs())
    };
    let band = |rows: RangeInclusive<i32>| {
        let sum = |profile: ArrayView1<f64>| -> f64 {
            (0..n).filter(|&slot| own(slot, &rows)).map(|slot| profile[slot]).sum()
        };
        profiles().map(|profile| sum(profile).powi(2)).sum::<f64>().sqrt()
    };
    let all = 0..=i32::MAX;
    let squares = |profile: ArrayView1<f64>| -> f64 {
        (0..n).filter(|&slot| own(slot, &all)).map(|slot| profile[slot].powi(2)).sum()
    };
    Ok(ExpectedError {
        epipolar: band(0..=0),
        short_range: band(1..=SHORT_RANGE_ROWS),
        long_range: band(SHORT_RANGE_ROWS + 1..=i32::MAX),
        profile: profiles().map(squares).sum::<f64>().sqrt(),
    })
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

/// Power by which delays thin out away from 0 in the grids that are dense there.
const DENSITY: f64 = 1.7;

/// The grid of at most as many points as `plan`, over the same delays, with the smallest expected error of the profile,
/// and that error: `plan` itself, or one or two of its exposures with more delays, even or dense near 0
/// (`± d_max (k/h)^1.7`). Errors are those over the reach of `plan`, so that a grid that sees less of it pays for it.
///
/// # Errors
/// Those of [`reach`] and [`expected_error`].
pub fn better_plan(
    timing: &RowTiming,
    plan: &SweepGrid,
    prior: &Prior,
    noise: &Noise,
) -> Result<(SweepGrid, ExpectedError), PlaneError> {
    let settings = plan.settings();
    let reach = reach(timing, &settings)?;
    let mut best = (plan.clone(), expected_error(timing, &settings, &reach, prior, noise)?);
    for grid in alternatives(plan) {
        let expected = expected_error(timing, &grid.settings(), &reach, prior, noise)?;
        if expected.profile < best.1.profile {
            best = (grid, expected);
        }
    }
    Ok(best)
}

fn alternatives(plan: &SweepGrid) -> Vec<SweepGrid> {
    let points = plan.delays_us.len() * plan.exposures_us.len();
    let farthest_us = plan.delays_us.iter().fold(0.0_f64, |farthest, delay_us| farthest.max(delay_us.abs()));
    let shortest_us = plan.exposures_us.iter().copied().fold(f64::INFINITY, f64::min);
    let longest_us = plan.exposures_us.iter().copied().fold(0.0, f64::max);
    let mut exposures = vec![vec![shortest_us]];
    if longest_us > shortest_us {
        exposures.extend([vec![longest_us], vec![shortest_us, longest_us]]);
    }
    let mut grids = Vec::new();
    for exposures_us in exposures {
        // On each side of a delay of 0.
        let half = (points / exposures_us.len()).saturating_sub(1) / 2;
        if half == 0 {
            continue;
        }
        for power in [1.0, DENSITY] {
            let place = |k: i32| f64::from(k.signum()) * (f64::from(k.abs()) / half as f64).powf(power);
            let delays_us = (-(half as i32)..=half as i32).map(|k| farthest_us * place(k)).collect();
            grids.push(SweepGrid { delays_us, exposures_us: exposures_us.clone() });
        }
    }
    grids
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

    /// 15 electrons of read noise and 4884 electrons of a white pixel's row.
    fn noise(frames: u32) -> Noise {
        Noise { read: 15.0 / 4884.0, gain: 1.0 / 4884.0, frames }
    }

    #[test]
    fn one_row_by_hand() {
        // One row, seen whole by four settings: the mean of four samples of variance 0.01 + 0.04.
        let timing = RowTiming::new(1, 20.0, 100.0).unwrap();
        let settings = vec![Setting::new(0.0, 20.0); 4];
        let noise = Noise { read: 0.1, gain: 0.04, frames: 1 };
        let expected = expected_error(&timing, &settings, &(0..=0), &Prior::SPLIT, &noise).unwrap();
        assert!((expected.epipolar - (0.05_f64 / 4.0).sqrt()).abs() < 1e-9, "{expected:?}");
        assert_eq!((expected.short_range, expected.profile), (0.0, expected.epipolar));
        let twice =
            expected_error(&timing, &settings, &(0..=0), &Prior::SPLIT, &Noise { frames: 4, ..noise });
        assert!((twice.unwrap().epipolar - expected.epipolar / 2.0).abs() < 1e-9);
    }

    #[test]
    fn the_solver_errs_as_much_as_expected() {
        // Noise decides with the usual alpha, smoothing with the second.
        solver_errs_as_expected(0.1);
        solver_errs_as_expected(30.0);
    }

    fn solver_errs_as_expected(alpha: f64) {
        // A profile so bright that T >= 0 never binds, of the roughness that is assumed, in many pixels.
        const PIXELS: usize = 300;
        let (timing, settings) = (timing().window(64, 1).unwrap(), paper_grid().settings());
        let prior = Prior::Split { alpha, beta: 0.0 };
        let noise = noise(8);
        let demux = Demux::new(timing.clone(), settings.clone(), prior).unwrap();
        let expected = expected_error(&timing, &settings, &demux.reach(), &prior, &noise).unwrap();

        let mut random = Xoshiro256PlusPlus::seed_from_u64(3);
        let mut normal = move || -> f64 { StandardNormal.sample(&mut random) };
        let rows = timing.projector_rows();
        let mut truth = Array2::zeros((rows, PIXELS));
        for mut profile in truth.columns_mut() {
            // Outwards from beside the own row, each row differs from the one before by its share of the roughness.
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
        // 300 pixels know a standard deviation to 4 %.
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
            let own = expected_error(
                &timing(),
                &paper_grid().settings(),
                &(-94..=94),
                &Prior::SPLIT,
                &noise(frames),
            );
            let (grid, expected) =
                better_plan(&timing(), &paper_grid(), &Prior::SPLIT, &noise(frames)).unwrap();
            assert!(grid.exposures_us.len() <= 2 && grid.delays_us.len() * grid.exposures_us.len() <= 75);
            assert!(expected.profile < own.unwrap().profile);
            assert_eq!(grid.delays_us.first().copied(), Some(-1500.0));
            assert!(grid.delays_us.is_sorted() && grid.delays_us.contains(&0.0));
        }
    }

    #[test]
    fn a_plan_too_short_for_alternatives_stays() {
        let plan = SweepGrid { delays_us: vec![0.0], exposures_us: vec![600.0, 900.0] };
        assert_eq!(better_plan(&timing(), &plan, &Prior::SPLIT, &noise(1)).unwrap().0, plan);
    }
}
