//! The demultiplexer compared with the optimality conditions, the reference solver and itself.

#![allow(clippy::unwrap_used)] // helpers outside #[test] functions are tests too

mod common;
mod stepping;

use common::{corner, ideal_stack, paper_sweep, photographed, timing};
use ndarray::{Array1, Array2, Array3, Axis, s};
use proptest::prelude::*;
use raysweep_transport::plane::{
    Demux, PlaneError, Prior, RowModel, RowTiming, Setting, SimdLevel, SlotKind, Transport, reach, reference,
    relative_rows,
};
use raysweep_transport::quality::{median_profile_error, relative_l2};
use stepping::by_stepping_through_time;

/// The objective of one camera row, assembled from its definition.
struct Objective {
    model: RowModel,
    differences: Array2<f64>,
    prior: Prior,
}

impl Objective {
    fn new(timing: &RowTiming, settings: &[Setting], prior: Prior, t: usize) -> Self {
        let model = RowModel::new(timing, settings, &reach(timing, settings).unwrap(), t);
        let differences = prior.differences(&model.slots);
        Self { model, differences, prior }
    }

    /// Positive definite even if the settings leave rows undetermined, as the reference solver requires.
    fn h(&self) -> Array2<f64> {
        let mut h = self.model.weights.t().dot(&self.model.weights)
            + self.prior.alpha() * self.differences.t().dot(&self.differences);
        h.diag_mut().mapv_inplace(|diagonal| if diagonal > 0.0 { diagonal * (1.0 + 1e-12) } else { 1.0 });
        h
    }

    fn c(&self, samples: &Array1<f64>) -> Array1<f64> {
        self.model.weights.t().dot(samples) - self.prior.beta() / 2.0
    }

    fn reference(&self, samples: &Array1<f64>) -> Array1<f64> {
        reference::minimise(self.h().view(), &self.c(samples).to_vec()).into()
    }

    fn value(&self, x: &Array1<f64>, samples: &Array1<f64>) -> f64 {
        let misfit = self.model.weights.dot(x) - samples;
        let rough = self.differences.dot(x);
        misfit.dot(&misfit) + self.prior.alpha() * rough.dot(&rough) + self.prior.beta() * x.sum()
    }

    /// Largest violation of `x >= 0`, `gradient >= 0`, `x * gradient = 0`, over `||2A'I - beta||_inf`.
    fn kkt_residual(&self, x: &Array1<f64>, samples: &Array1<f64>) -> f64 {
        let misfit = self.model.weights.dot(x) - samples;
        let gradient = 2.0 * self.model.weights.t().dot(&misfit)
            + 2.0 * self.prior.alpha() * self.differences.t().dot(&self.differences.dot(x))
            + self.prior.beta();
        let violation = x.iter().zip(&gradient).map(|(&x, &gradient)| match x {
            x if x > 0.0 => gradient.abs(),
            x => (-gradient).max(0.0) - x,
        });
        let scale = self.c(samples).iter().fold(f64::MIN_POSITIVE, |scale, c| scale.max(2.0 * c.abs()));
        violation.fold(0.0, f64::max) / scale
    }

    /// The own slots of `x`, in the order of a transport's rows.
    fn profile(&self, estimate: &Transport, t: usize, column: usize) -> Array1<f64> {
        let own = self.model.slots.iter().filter(|slot| slot.kind == SlotKind::Own);
        own.map(|slot| f64::from(estimate.t[[(slot.u - estimate.u_min) as usize, t, column]])).collect()
    }
}

fn noisy_corner() -> Array3<f32> {
    photographed(&ideal_stack(&corner(), &paper_sweep()), 2)
}

fn samples(stack: &Array3<f32>, t: usize, column: usize) -> Array1<f64> {
    stack.slice(s![.., t, column]).mapv(f64::from)
}

#[test]
fn every_instruction_set_equals_the_reference_on_the_corner() {
    let stack = noisy_corner();
    for prior in [Prior::PAPER, Prior::SPLIT] {
        let demux = Demux::new(timing(), paper_sweep(), prior).unwrap();
        let estimates: Vec<(SimdLevel, Transport)> = SimdLevel::available()
            .into_iter()
            .map(|level| (level, demux.with_simd(level).solve(stack.view(), None).unwrap()))
            .collect();
        let mut errors = Vec::new();
        for t in [0, 40, 64, 127] {
            let objective = Objective::new(&timing(), &paper_sweep(), prior, t);
            for column in (0..128).step_by(3) {
                let samples = samples(&stack, t, column);
                let expected = objective.reference(&samples);
                let residual = objective.kkt_residual(&expected, &samples);
                assert!(residual <= 1e-9, "{prior:?} {t} {column}: KKT residual {residual}");
                let best = objective.value(&expected, &samples);
                for (level, estimate) in &estimates {
                    let x = objective.profile(estimate, t, column);
                    let gap = (objective.value(&x, &samples) - best) / best;
                    assert!(gap <= 1e-6, "{} {prior:?} {t} {column}: objective gap {gap}", level.name());
                    let error = &x - &expected;
                    errors.push((error.dot(&error) / expected.dot(&expected)).sqrt());
                }
            }
        }
        errors.sort_by(f64::total_cmp);
        assert!(errors[errors.len() / 2] <= 1e-3, "median {}", errors[errors.len() / 2]);
        assert!(errors[errors.len() - 1] <= 1e-2, "largest {}", errors[errors.len() - 1]);
    }
}

fn largest_difference(a: &Array3<f32>, b: &Array3<f32>) -> f32 {
    assert_eq!(a.dim(), b.dim());
    a.iter().zip(b).fold(0.0, |largest, (a, b)| largest.max((a - b).abs()))
}

#[test]
fn a_start_from_another_estimate_ends_at_the_same_minimum() {
    let corner = ideal_stack(&corner(), &paper_sweep());
    let demux = Demux::new(timing(), paper_sweep(), Prior::PAPER).unwrap();
    let earlier = demux.solve(photographed(&corner, 5).view(), None).unwrap();
    let stack = photographed(&corner, 6);
    let cold = demux.solve(stack.view(), None).unwrap();
    let warm = demux.solve_from(&earlier, stack.view(), None, &|| true).unwrap();
    assert!(largest_difference(&cold.t, &earlier.t) > 1e-3);
    assert!(largest_difference(&cold.t, &warm.t) < 1e-6);

    let narrow = demux.solve(stack.slice(s![.., .., ..5]), None).unwrap();
    let refused = demux.solve_from(&narrow, stack.view(), None, &|| true);
    assert!(matches!(refused, Err(PlaneError::Shape { array: "estimate", .. })));
}

#[test]
fn some_rows_are_solved_as_all_are_and_predict_their_images() {
    let ideal = ideal_stack(&corner(), &paper_sweep());
    let demux = Demux::new(timing(), paper_sweep(), Prior::SPLIT).unwrap();
    let rows = [3, 64, 65, 127];
    let band = ideal.select(Axis(1), &rows);
    let some = demux.solve_rows(&rows, band.view(), None, &|| true).unwrap();
    let all = demux.solve(ideal.view(), None).unwrap();
    assert_eq!(some.t, all.t.select(Axis(1), &rows));
    assert_eq!(some.exists, all.exists.select(Axis(1), &rows));

    let predicted = demux.predict_rows(&rows, &some).unwrap();
    // Minus 0.65 % of the light, which comes from beyond the reach.
    let flat = |images: Array3<f32>| images.into_shape_with_order((75, 4 * 128)).unwrap();
    let error = relative_l2(flat(predicted).view(), flat(band.as_standard_layout().into_owned()).view());
    assert!(error < 0.02, "{error}");
    assert_eq!(demux.predict_rows(&[128], &some), Err(PlaneError::Rows { row: 128, camera_rows: 128 }));
}

#[test]
fn channels_are_columns() {
    // Red, green and blue of the same pixels, interleaved as in a camera's frames.
    let red = noisy_corner().slice_move(s![.., .., ..11]);
    let rgb = ndarray::stack(Axis(3), &[red.view(), (&red * 0.5).view(), (&red * 0.1).view()]).unwrap();
    let interleaved = rgb.to_shape((75, 128, 33)).unwrap();
    let demux = Demux::new(timing(), paper_sweep(), Prior::SPLIT).unwrap();
    let estimate = demux.solve(interleaved.view(), None).unwrap();
    for channel in 0..3 {
        let alone = demux.solve(rgb.index_axis(Axis(3), channel), None).unwrap();
        let of_channel = estimate.t.slice(s![.., .., channel..;3]).to_owned();
        assert!(largest_difference(&of_channel, &alone.t) < 1e-6);
    }
}

#[test]
fn direct_light_between_rows_is_found_where_it_is_said_to_be() {
    // 30 % of each pixel's direct light in the row below, due to imperfect rectification; edges of exposures cut the
    // rows.
    let settings: Vec<Setting> = (0..60)
        .map(|k| Setting::new(-1500.0 + 50.7 * f64::from(k), 600.0 + 7.0 * f64::from(k % 4)))
        .collect();
    let mut transport = Array3::zeros((128, 128, 2));
    for t in 0..128 {
        for v in 0..128_usize {
            let distance = v.abs_diff(t) as f32;
            transport[[v, t, 0]] = 0.02 * (-distance / 20.0).exp();
            transport[[v, t, 1]] = transport[[v, t, 0]];
        }
        transport[[t, t, 0]] += 0.7;
        transport[[t, t, 1]] += 1.0;
        if t < 127 {
            transport[[t + 1, t, 0]] += 0.3;
        }
    }
    let stack = ideal_stack(&transport, &settings);
    let centred = Demux::new(timing(), settings, Prior::SPLIT).unwrap();
    let truth = relative_rows(transport.view(), &centred.reach());
    let u0 = Array2::from_shape_fn((128, 2), |(_, s)| if s == 0 { 0.3 } else { 0.0 });
    let estimate = centred.with_spike(u0.clone()).unwrap().solve(stack.view(), None).unwrap();
    let error = |t: &Array3<f32>, s: usize| {
        median_profile_error(t.slice(s![.., .., s..=s]), truth.slice(s![.., .., s..=s]))
    };
    assert!(error(&estimate.t, 0) < 0.01, "{}", error(&estimate.t, 0));
    assert!(error(&estimate.t, 1) < 0.01, "{}", error(&estimate.t, 1));
    let misplaced = centred.solve(stack.view(), None).unwrap();
    assert!(error(&misplaced.t, 0) > 0.1, "{}", error(&misplaced.t, 0));
    // The last row's neighbour does not exist: its 30 % are beyond the projector.
    let last = estimate.t.slice(s![.., 127, 0]);
    assert!((last[-centred.reach().start() as usize] - 0.72).abs() < 0.02, "{last}");

    let far = centred.with_spike(u0.mapv(|u0| 4.0 * u0));
    assert!(matches!(far, Err(PlaneError::OutOfRange { field: "u0_rows", .. })));
    let narrow = centred.with_spike(Array2::zeros((128, 3))).unwrap().solve(stack.view(), None);
    assert!(matches!(narrow, Err(PlaneError::Shape { array: "u0_rows", .. })));
}

#[test]
fn the_number_of_threads_does_not_change_a_bit() {
    let stack = noisy_corner();
    let demux = Demux::new(timing(), paper_sweep(), Prior::SPLIT).unwrap();
    let solve_with = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| demux.solve(stack.view(), None).unwrap())
    };
    let bits = |estimate: Transport| estimate.t.mapv(f32::to_bits);
    let one = bits(solve_with(1));
    assert!(one == bits(solve_with(2)));
    assert!(one == bits(solve_with(3)));
}

#[test]
fn other_rows_do_not_change_a_bit_of_a_row() {
    // Rows that share a model, in tiles of many rows; pixels of several models, some with missing samples.
    let timing = RowTiming::new(720, 22.22, 50_000.0 / 3.0).unwrap().centred(60).unwrap();
    let settings = paper_sweep();
    let stack = noisy_corner().slice_move(s![.., 30..90, 20..61]);
    let u0 = Array2::from_shape_fn((60, 41), |(t, s)| 0.02 * ((t / 7 + s / 5) % 3) as f32);
    let mut valid = Array3::from_elem(stack.dim(), true);
    valid.slice_mut(s![10..20, 22..25, 7..30]).fill(false);
    valid.slice_mut(s![15..17, 23, 9]).fill(true);
    let demux = Demux::new(timing, settings, Prior::SPLIT).unwrap().with_spike(u0).unwrap();
    let whole = demux.solve(stack.view(), Some(valid.view())).unwrap();
    for height in [1, 7, 32] {
        for first in (0..60).step_by(height) {
            let rows: Vec<usize> = (first..60.min(first + height)).collect();
            let some = s![.., first..first + rows.len(), ..];
            let part = demux.solve_rows(&rows, stack.slice(some), Some(valid.slice(some)), &|| true);
            assert!(part.unwrap().t == whole.t.select(Axis(1), &rows), "rows {rows:?}");
        }
    }
}

#[test]
fn no_light_gives_no_transport() {
    for prior in [Prior::PAPER, Prior::SPLIT] {
        let demux = Demux::new(timing(), paper_sweep(), prior).unwrap();
        let estimate = demux.solve(Array3::zeros((75, 128, 3)).view(), None).unwrap();
        assert!(estimate.t.iter().all(|&light| light == 0.0));
        assert!(!estimate.saturated.iter().any(|&saturated| saturated));
    }
}

#[test]
fn rows_that_do_not_exist_are_masked_and_zero() {
    let estimate = Demux::new(timing(), paper_sweep(), Prior::SPLIT)
        .unwrap()
        .solve(noisy_corner().slice(s![.., .., ..4]), None)
        .unwrap();
    for ((index, t), &exists) in estimate.exists.indexed_iter() {
        assert_eq!(exists, (0..128).contains(&(t as i32 + index as i32 - 94)));
        assert!(exists || estimate.t.slice(s![index, t, ..]).iter().all(|&light| light == 0.0));
    }
}

#[test]
fn masked_samples_without_light_have_no_influence() {
    let stack = noisy_corner().slice_move(s![.., .., ..16]);
    let demux = Demux::new(timing(), paper_sweep(), Prior::SPLIT).unwrap();
    let plain = demux.solve(stack.view(), None).unwrap();

    // Two neighbours lack the same settings, one pixel others, and one pixel all of them.
    let mut valid = Array3::from_elem(stack.dim(), true);
    valid.slice_mut(s![30..40, 50, 4..6]).fill(false);
    valid.slice_mut(s![0..74;7, 50, 9]).fill(false);
    valid.slice_mut(s![.., 51, 2]).fill(false);
    let mut spoiled = stack.clone();
    spoiled.zip_mut_with(&valid, |sample, &valid| *sample = if valid { *sample } else { 0.0 });
    let masked = demux.solve(spoiled.view(), Some(valid.view())).unwrap();

    let flagged: Vec<(usize, usize)> =
        masked.saturated.indexed_iter().filter(|(_, flag)| **flag).map(|(pixel, _)| pixel).collect();
    assert_eq!(flagged, [(50, 4), (50, 5), (50, 9), (51, 2)]);
    assert!(masked.t.slice(s![.., 51, 2]).iter().all(|&light| light == 0.0));
    for t in (0..128).filter(|t| ![50, 51].contains(t)) {
        assert!(masked.t.index_axis(Axis(1), t) == plain.t.index_axis(Axis(1), t));
    }
    for column in [4, 5, 9] {
        let used: Vec<usize> = (0..75).filter(|&n| valid[[n, 50, column]]).collect();
        let mut objective = Objective::new(&timing(), &paper_sweep(), Prior::SPLIT, 50);
        objective.model.weights = objective.model.weights.select(Axis(0), &used);
        let samples = samples(&stack, 50, column).select(Axis(0), &used);
        let expected = objective.reference(&samples);
        let error = objective.profile(&masked, 50, column) - &expected;
        assert!(error.iter().all(|error| error.abs() < 1e-6), "column {column}");
    }
}

#[test]
fn a_mask_of_whole_settings_equals_leaving_them_out() {
    let stack = noisy_corner().slice_move(s![.., .., ..8]);
    let demux = Demux::new(timing(), paper_sweep(), Prior::SPLIT).unwrap();
    let kept: Vec<usize> = (0..75).filter(|n| n % 5 != 3).collect();
    let mut valid = Array3::from_elem(stack.dim(), false);
    kept.iter().for_each(|&n| valid.index_axis_mut(Axis(0), n).fill(true));
    let known = Array3::from_shape_fn(stack.dim(), |at| if valid[at] { stack[at] } else { 0.0 });
    let masked = demux.solve(known.view(), Some(valid.view())).unwrap();

    let settings = kept.iter().map(|&n| paper_sweep()[n].clone()).collect();
    let fewer = demux.with_settings(settings).unwrap();
    assert_eq!(fewer.reach(), demux.reach());
    let fewer = fewer.solve(stack.select(Axis(0), &kept).view(), None).unwrap();
    assert!((&fewer.t - &masked.t).iter().all(|error| error.abs() < 1e-6));
}

#[test]
fn exposures_over_the_retrace_see_what_the_clock_says() {
    // Camera rows 592..720 of the paper's projector; the light of the top rows differs from that of the bottom rows.
    let timing = RowTiming::new(720, 22.22, 50_000.0 / 3.0).unwrap().window(592, 128).unwrap();
    let light_of_row =
        |row: usize| if row < 100 { 0.01 } else { 0.002 + if row == 592 + 108 { 0.7 } else { 0.0 } };
    let settings = paper_sweep();
    let objective = Objective::new(&timing, &settings, Prior::SPLIT, 108);
    let truth: Array1<f64> =
        objective.model.slots.iter().map(|slot| light_of_row((700 + slot.u) as usize)).collect();
    let stepped: Array1<f64> = settings
        .iter()
        .map(|setting| by_stepping_through_time(&timing, setting, 108, light_of_row))
        .collect();
    let predicted = objective.model.weights.dot(&truth);
    for (n, (predicted, stepped)) in predicted.iter().zip(&stepped).enumerate() {
        assert!((predicted - stepped).abs() < 1e-3 * stepped.max(0.1), "{n}: {predicted} is not {stepped}");
    }

    // The next frame's light must not be assigned to the last rows of this one.
    let mut stack = Array3::zeros((75, 128, 1));
    stack.slice_mut(s![.., 108, 0]).assign(&stepped.mapv(|sample| sample as f32));
    let estimate = Demux::new(timing, settings, Prior::SPLIT).unwrap().solve(stack.view(), None).unwrap();
    let profile = objective.profile(&estimate, 108, 0);
    let own_truth = truth.slice(s![..profile.len()]);
    assert!((&profile - &own_truth).iter().all(|error| error.abs() < 1e-3), "{profile}");
    assert!((estimate.total()[[108, 0]] as f64 - own_truth.sum()).abs() < 2e-3);
    let expected = objective.reference(&stepped);
    assert!(objective.kkt_residual(&expected, &stepped) <= 1e-9);
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    /// Small projectors with a short retrace, exposures up to two periods, several measured delays per setting: the
    /// weights agree with the clock, the reference is optimal, and the solver equals it.
    #[test]
    fn random_rigs(
        (rows, retrace_us) in (3_usize..14, 0.0..90.0),
        points in prop::collection::vec((-0.9..0.9, 5.0..500.0), 1..12),
        light in prop::collection::vec(0.0..1.0_f32, 14),
        noise in prop::collection::vec(-0.1..0.1_f32, 12),
        prior in prop_oneof![Just(Prior::PAPER), Just(Prior::SPLIT)],
    ) {
        let row_time_us = 20.0;
        let timing = RowTiming::new(rows, row_time_us, rows as f64 * row_time_us + retrace_us).unwrap();
        let settings: Vec<Setting> = points
            .iter()
            .map(|&(delay, exposure_us)| Setting::new(delay * timing.period_us(), exposure_us))
            .collect();
        let Ok(demux) = Demux::new(timing.clone(), settings.clone(), prior) else {
            // Every delay may fall into the retrace or beyond the border.
            prop_assert_eq!(reach(&timing, &settings), Err(PlaneError::NothingSeen));
            return Ok(());
        };
        let by_clock = |n: usize, t: usize| {
            by_stepping_through_time(&timing, &settings[n], t, |row| f64::from(light[row]))
        };
        let stack = Array3::from_shape_fn((settings.len(), rows, 1), |(n, t, _)| by_clock(n, t) as f32 + noise[n]);
        let estimate = demux.solve(stack.view(), None).unwrap();
        for t in 0..rows {
            for (n, setting) in settings.iter().enumerate() {
                let weights = timing.weights(t, setting);
                let weighted: f64 = weights.iter().zip(&light).map(|(w, &light)| w * f64::from(light)).sum();
                prop_assert!((weighted - by_clock(n, t)).abs() < 0.01, "{weighted} is not {}", by_clock(n, t));
            }
            let objective = Objective::new(&timing, &settings, prior, t);
            let samples = samples(&stack, t, 0);
            let expected = objective.reference(&samples);
            let residual = objective.kkt_residual(&expected, &samples);
            prop_assert!(residual <= 1e-9, "row {t}: KKT residual {residual}, {expected} for {samples}");

            // Few settings leave directions flat, so the value is compared rather than T, and only if the transport
            // contains all unknowns, because wrapped ones may replace own ones.
            let x = objective.profile(&estimate, t, 0);
            if x.len() == expected.len() {
                let (value, best) = (objective.value(&x, &samples), objective.value(&expected, &samples));
                prop_assert!(value - best <= 1e-6 * best.max(1e-3), "row {t}: {value} against {best}");
            }
        }
    }
}

#[test]
fn one_setting_alone_still_gives_the_minimum() {
    // Three unknowns, one sample: H is singular, and its inverse is pure rounding. Five periods of three rows.
    let timing = RowTiming::new(3, 20.0, 60.0).unwrap();
    let settings = [Setting::new(0.0, 306.2)];
    let demux = Demux::new(timing.clone(), settings.to_vec(), Prior::SPLIT).unwrap();
    let stack = Array3::from_elem((1, 3, 1), 1.3);
    let estimate = demux.solve(stack.view(), None).unwrap();
    for t in 0..3 {
        let objective = Objective::new(&timing, &settings, Prior::SPLIT, t);
        let samples = samples(&stack, t, 0);
        let best = objective.value(&objective.reference(&samples), &samples);
        let value = objective.value(&objective.profile(&estimate, t, 0), &samples);
        assert!(value - best <= 1e-6 * best, "row {t}: {value} against {best}");
    }
}

#[test]
fn arrays_that_do_not_fit_are_refused() {
    let demux = Demux::new(timing(), paper_sweep(), Prior::SPLIT).unwrap();
    let shape_error = |stack: (usize, usize, usize), valid: (usize, usize, usize)| {
        let valid = Array3::from_elem(valid, true);
        match demux.solve(Array3::zeros(stack).view(), Some(valid.view())) {
            Err(PlaneError::Shape { array, .. }) => array,
            other => panic!("{other:?}"),
        }
    };
    assert_eq!(shape_error((74, 128, 2), (75, 128, 2)), "stack");
    assert_eq!(shape_error((75, 127, 2), (75, 128, 2)), "stack");
    assert_eq!(shape_error((75, 128, 2), (75, 128, 3)), "valid");

    let mut stack = Array3::zeros((75, 128, 2));
    stack[[7, 8, 1]] = f32::NAN;
    let refused = demux.solve(stack.view(), None);
    assert_eq!(refused, Err(PlaneError::NotFinite { setting: 7, row: 8, column: 1 }));
    assert!(Demux::new(timing(), paper_sweep(), Prior::Split { alpha: f64::NAN, beta: 0.0 }).is_err());
    assert!(Demux::new(timing(), vec![], Prior::SPLIT).is_err());
}
