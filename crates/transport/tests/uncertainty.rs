//! The predicted uncertainty compared with repeated measurements and with the estimate's change with each sample.

#![allow(clippy::unwrap_used)] // helpers outside #[test] functions are tests too

#[allow(dead_code)]
mod common;

use std::ops::{Range, RangeInclusive};

use common::{ELECTRONS_PER_COUNT, READ_NOISE_ELECTRONS, WHITE_COUNTS};
use common::{corner, ideal_stack, paper_sweep, photographed_in, timing};
use ndarray::{Array1, Array2, Array3, Axis, concatenate, s};
use rand_distr::{Distribution, Normal};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;
use raysweep_transport::plane::{
    Coupling, DarkImage, Demux, LightSums, NoiseModel, PixelResponse, PlaneError, Prior, RESPONSE_ROWS,
    RelitBeam, RowModel, RowTiming, Samples, Setting, SlotKind, Transport, Uncertainty, reach, reference,
    relight,
};

/// The noise of one frame of the test camera.
fn camera_noise() -> NoiseModel {
    let white_electrons = WHITE_COUNTS * ELECTRONS_PER_COUNT;
    NoiseModel {
        read_variance: (READ_NOISE_ELECTRONS / white_electrons).powi(2),
        gain: 1.0 / white_electrons,
    }
}

/// Epipolar image, non-epipolar image, short-range band, long-range band, and all light.
fn bands() -> [Vec<RangeInclusive<i32>>; 5] {
    let all = i32::MIN..=i32::MAX;
    [vec![0..=0], vec![i32::MIN..=-1, 1..=i32::MAX], vec![1..=6], vec![-30..=-7], vec![all]]
}

fn light(transport: &Transport, band: &[RangeInclusive<i32>]) -> Array2<f32> {
    let images = band.iter().map(|range| transport.band(range.clone()));
    images.reduce(|sum, image| sum + image).unwrap()
}

/// 68 % of the deviations of repeated measurements from their mean are below this many predicted standard deviations,
/// for each band. Of the corner's camera rows `rows`, the outer `margin` are left out.
fn spread(rows: Range<usize>, margin: usize, frames: usize, coupling: Option<Coupling>) -> [f64; 5] {
    const REPEATS: u64 = 8;
    let ideal = ideal_stack(&corner(), &paper_sweep()).slice(s![.., rows.clone(), ..]).to_owned();
    let timing = timing().window(rows.start, rows.len()).unwrap();
    let demux = Demux::new(timing.clone(), paper_sweep(), Prior::SPLIT).unwrap();
    let frames = vec![frames; 75];
    let noise = camera_noise();
    let of = Uncertainty {
        timing: &timing,
        settings: &paper_sweep(),
        prior: Prior::SPLIT,
        noise,
        frames: &frames,
        delay_sds_us: &[0.0; 75],
        darks: &[],
        calibration: None,
    };
    let measure = |seed| {
        let mut stack = photographed_in(frames[0], &ideal, seed);
        let mut variance_ratio = None;
        if let Some(coupling) = coupling {
            let coupled = coupling.apply(stack.view(), None, &noise, &frames).unwrap();
            (stack, variance_ratio) = (coupled.stack, Some(coupled.variance_ratio));
        }
        let estimate = demux.solve(stack.view(), None).unwrap();
        let variance_ratio = variance_ratio.as_ref().map(|ratio| ratio.view());
        let samples = Samples { stack: stack.view(), valid: None, variance_ratio, u0_rows: None };
        let sd = of.of_bands(&estimate, &samples, &bands()).unwrap();
        let lights = bands().map(|band| light(&estimate, &band).insert_axis(Axis(0)));
        let lights = concatenate(Axis(0), &lights.each_ref().map(|light| light.view())).unwrap();
        let inner = s![.., margin..rows.len() - margin, ..];
        (lights.slice_move(inner), sd.slice_move(inner))
    };
    let measured: Vec<(Array3<f32>, Array3<f32>)> = (0..REPEATS).map(measure).collect();
    let mean =
        measured.iter().fold(Array3::<f32>::zeros(measured[0].0.raw_dim()), |sum, (light, _)| sum + light)
            / REPEATS as f32;
    // Measurements are closer to their own mean than to the true one.
    let nearer = (1.0 - 1.0 / REPEATS as f64).sqrt();
    std::array::from_fn(|band| {
        let mut deviations: Vec<f64> = Vec::new();
        for (light, sd) in &measured {
            let deviation = (light - &mean).index_axis_move(Axis(0), band);
            let lit = deviation.into_iter().zip(sd.index_axis(Axis(0), band)).filter(|(_, sd)| **sd > 0.0);
            deviations.extend(lit.map(|(deviation, sd)| f64::from(deviation.abs() / sd) / nearer));
        }
        deviations.sort_by(f64::total_cmp);
        deviations[deviations.len() * 68 / 100]
    })
}

#[test]
fn repeated_measurements_spread_as_predicted() {
    // Measured: 0.94 to 1.15.
    for (rows, frames) in [(62..64, 8), (20..22, 8), (62..64, 1)] {
        let spread = spread(rows.clone(), 0, frames, None);
        assert!(spread.iter().all(|spread| (0.85..1.2).contains(spread)), "{rows:?}, {frames}: {spread:?}");
    }
}

#[test]
fn coupled_measurements_spread_as_predicted() {
    // Measured: 0.98 to 1.30; neighbours are chosen by the same noise that averaging them should reduce.
    for frames in [1, 8] {
        let spread = spread(56..66, 3, frames, Some(Coupling::default()));
        assert!(spread.iter().all(|spread| (0.8..1.4).contains(spread)), "{frames}: {spread:?}");
    }
}

/// Repeated measurements of two camera rows, each with dark images of its own: for each band, the share of the
/// deviations from their mean within one standard deviation, as stated with and without the dark images.
#[test]
fn dark_images_that_images_share_are_part_of_the_uncertainty() {
    const REPEATS: u64 = 40;
    let rows = 62..64;
    let ideal = ideal_stack(&corner(), &paper_sweep()).slice(s![.., rows.clone(), ..;8]).to_owned();
    let timing = timing().window(rows.start, rows.len()).unwrap();
    let settings = paper_sweep();
    let demux = Demux::new(timing.clone(), settings.clone(), Prior::SPLIT).unwrap();
    let frames = [8; 75];
    // The paper's sweep has 5 exposures of 15 delays each.
    let darks: Vec<DarkImage> =
        (0..5).map(|e| DarkImage { settings: (15 * e..15 * (e + 1)).collect(), frames: 8 }).collect();
    let bands =
        [vec![0..=0], vec![-10..=-1, 1..=10], vec![i32::MIN..=-11, 11..=i32::MAX], vec![i32::MIN..=i32::MAX]];
    let measured: Vec<[Array3<f32>; 3]> = (0..REPEATS)
        .map(|seed| {
            let mut stack = photographed_in(8, &ideal, seed);
            let dark = photographed_in(8, &Array3::zeros((5, 2, ideal.dim().2)), 1000 + seed);
            for n in 0..75 {
                let lit = &stack.index_axis(Axis(0), n) - &dark.index_axis(Axis(0), n / 15);
                stack.index_axis_mut(Axis(0), n).assign(&lit);
            }
            let estimate = demux.solve(stack.view(), None).unwrap();
            let samples = Samples { stack: stack.view(), valid: None, variance_ratio: None, u0_rows: None };
            let noise = camera_noise();
            let sd = |darks: &[DarkImage]| {
                let of = Uncertainty {
                    timing: &timing,
                    settings: &settings,
                    prior: Prior::SPLIT,
                    noise,
                    frames: &frames,
                    delay_sds_us: &[0.0; 75],
                    darks,
                    calibration: None,
                };
                of.of_bands(&estimate, &samples, &bands).unwrap()
            };
            [lights(&estimate, &bands), sd(&darks), sd(&[])]
        })
        .collect();
    let (with, without) = (within(&measured, 1), within(&measured, 2));
    println!("with dark images {with:.3?}, without {without:.3?}");
    assert!(with.iter().all(|share| (0.63..0.73).contains(share)), "{with:?}");
    // Without them, the light of all rows together errs more than it should.
    assert!(without[3] < 0.6, "{without:?}");
}

/// The light of each band, `[bands, t, s]`.
fn lights(transport: &Transport, bands: &[Vec<RangeInclusive<i32>>; 4]) -> Array3<f32> {
    let lights = bands.each_ref().map(|band| light(transport, band).insert_axis(Axis(0)));
    concatenate(Axis(0), &lights.each_ref().map(|light| light.view())).unwrap()
}

/// For each band, the share of the deviations of repeated measurements, the first of each, from their mean within one
/// standard deviation, as that with the index `stated` has it.
fn within(measured: &[[Array3<f32>; 3]], stated: usize) -> [f64; 4] {
    let repeats = measured.len() as f32;
    let mean =
        measured.iter().fold(Array3::<f32>::zeros(measured[0][0].raw_dim()), |sum, [light, ..]| sum + light)
            / repeats;
    let nearer = (1.0 - 1.0 / repeats).sqrt();
    std::array::from_fn(|band| {
        let (mut inside, mut all) = (0.0, 0.0);
        for one in measured {
            let deviation = (&one[0] - &mean).index_axis_move(Axis(0), band);
            for (deviation, sd) in
                deviation.iter().zip(one[stated].index_axis(Axis(0), band)).filter(|(_, sd)| **sd > 0.0)
            {
                all += 1.0;
                inside += f64::from(u8::from(deviation.abs() < nearer * sd));
            }
        }
        inside / all
    })
}

/// Repeated measurements in which each image is early or late by 1.5 us, a third of a frame's jitter: for each band,
/// the share of the deviations within one standard deviation, as stated with and without the errors of delays.
#[test]
fn jitter_that_no_stamp_shows_is_part_of_the_uncertainty() {
    const REPEATS: u64 = 40;
    const SD_US: f64 = 1.5;
    let rows = 62..64;
    let timing = timing().window(rows.start, rows.len()).unwrap();
    // Edges over direct light, as in edges.toml.
    let mut settings = paper_sweep();
    settings.truncate(60);
    settings.extend((0..15).map(|n| Setting::new(222.23 + 11.11 * f64::from(n), 600.0)));
    let demux = Demux::new(timing.clone(), settings.clone(), Prior::SPLIT).unwrap();
    let bands =
        [vec![0..=0], vec![-10..=-1, 1..=10], vec![i32::MIN..=-11, 11..=i32::MAX], vec![i32::MIN..=i32::MAX]];
    let measured: Vec<[Array3<f32>; 3]> = (0..REPEATS)
        .map(|seed| {
            let mut random = Xoshiro256PlusPlus::seed_from_u64(500 + seed);
            let jitter = Normal::new(0.0, SD_US).unwrap();
            let taken: Vec<Setting> =
                settings.iter().map(|setting| setting.earlier(jitter.sample(&mut random))).collect();
            let ideal = ideal_stack(&corner(), &taken).slice(s![.., rows.clone(), ..;8]).to_owned();
            let stack = photographed_in(8, &ideal, seed);
            let estimate = demux.solve(stack.view(), None).unwrap();
            let samples = Samples { stack: stack.view(), valid: None, variance_ratio: None, u0_rows: None };
            let sd = |delay_sd_us: f64| {
                let of = Uncertainty {
                    timing: &timing,
                    settings: &settings,
                    prior: Prior::SPLIT,
                    noise: camera_noise(),
                    frames: &[8; 75],
                    delay_sds_us: &[delay_sd_us; 75],
                    darks: &[],
                    calibration: None,
                };
                of.of_bands(&estimate, &samples, &bands).unwrap()
            };
            [lights(&estimate, &bands), sd(SD_US), sd(0.0)]
        })
        .collect();
    let (with, without) = (within(&measured, 1), within(&measured, 2));
    println!("with jitter {with:.3?}, without {without:.3?}");
    assert!(with.iter().all(|share| (0.6..0.76).contains(share)), "{with:?}");
    assert!(without[0] < 0.6, "{without:?}");
}

/// A profile of 31 rows around `u = 0`: a direct spike over a hill of indirect light that is cut off at 0.
fn profile(pixel: usize) -> impl Fn(i32) -> f64 {
    let centre = 3.0 + 2.0 * pixel as f64;
    move |u| match u {
        0 => 0.6,
        u => (0.05 - 0.001 * (f64::from(u) - centre).powi(2)).max(0.0),
    }
}

/// The brightness of a projector row in a relit image.
fn brightness(v: i32) -> f64 {
    f64::from(v % 5) / 3.0
}

#[test]
fn equals_the_change_of_the_estimate_with_each_sample() {
    let timing = RowTiming::new(32, 22.22, 16_667.0).unwrap().window(16, 1).unwrap();
    let settings: Vec<Setting> = (0..24)
        .map(|n| Setting::new(-250.0 + 45.0 * f64::from(n % 12), 150.0 + 80.0 * f64::from(n / 12)))
        .collect();
    let reach = reach(&timing, &settings).unwrap();
    let frames: Vec<usize> = (0..24).map(|n| 1 + n % 3).collect();
    let noise = camera_noise();
    let bands = [vec![0..=0], vec![i32::MIN..=-1, 1..=i32::MAX], vec![2..=5]];
    // Undetermined rows, for which no inverse can be shared, use the other code path.
    for (prior, masked) in [
        (Prior::SPLIT, vec![]),
        (Prior::SPLIT, vec![3, 17]),
        (Prior::PAPER, vec![]),
        (Prior::Split { alpha: 1e-9, beta: 0.01 }, vec![]),
    ] {
        let model = RowModel::new(&timing, &settings, &reach, 0);
        let used: Vec<usize> = (0..24).filter(|n| !masked.contains(n)).collect();
        let weights = model.weights.select(Axis(0), &used);
        let differences = prior.differences(&model.slots);
        let mut h = weights.t().dot(&weights) + prior.alpha() * differences.t().dot(&differences);
        h.diag_mut().mapv_inplace(|diagonal| diagonal * (1.0 + 1e-12));
        let estimate = |samples: &Array1<f64>| -> Array1<f64> {
            reference::minimise(h.view(), &(weights.t().dot(samples) - prior.beta() / 2.0).to_vec()).into()
        };
        for pixel in 0..4 {
            let truth: Array1<f64> = model.slots.iter().map(|slot| profile(pixel)(slot.u)).collect();
            let all_samples = model.weights.dot(&truth).mapv(|light| light + 0.003 * (90.0 * light).sin());
            let samples = all_samples.select(Axis(0), &used);
            let base = estimate(&samples);
            let mut variances = [0.0; 3];
            let mut relit_variance = 0.0;
            for (index, &n) in used.iter().enumerate() {
                let step = 1e-7;
                let mut changed = samples.clone();
                changed[index] += step;
                let change = (estimate(&changed) - &base) / step;
                for (variance, band) in variances.iter_mut().zip(&bands) {
                    let inside = |u: i32| band.iter().any(|range| range.contains(&u));
                    let slots = model.slots.iter().zip(&change).filter(|(slot, _)| inside(slot.u));
                    let gain: f64 = slots.map(|(_, change)| change).sum();
                    *variance += gain * gain * noise.variance(samples[index], frames[n]);
                }
                let slots = model.slots.iter().zip(&change).filter(|(slot, _)| slot.kind == SlotKind::Own);
                let gain: f64 = slots.map(|(slot, change)| brightness(16 + slot.u) * change).sum();
                relit_variance += gain * gain * noise.variance(samples[index], frames[n]);
            }

            let t = Array3::from_shape_fn((base.len(), 1, 1), |(index, ..)| base[index] as f32);
            let exists = Array2::from_elem((base.len(), 1), true);
            let transport = Transport::measured(t, *reach.start(), exists);
            let stack = Array3::from_shape_fn((24, 1, 1), |(n, ..)| all_samples[n] as f32);
            let valid = Array3::from_shape_fn((24, 1, 1), |(n, ..)| !masked.contains(&n));
            let samples = Samples {
                stack: stack.view(),
                valid: Some(valid.view()),
                variance_ratio: None,
                u0_rows: None,
            };
            let of = Uncertainty {
                timing: &timing,
                settings: &settings,
                prior,
                noise,
                frames: &frames,
                delay_sds_us: &[0.0; 24],
                darks: &[],
                calibration: None,
            };
            let sd = of.of_bands(&transport, &samples, &bands).unwrap();
            for (sd, variance) in sd.iter().zip(variances) {
                let (sd, expected) = (f64::from(*sd), variance.sqrt());
                assert!(
                    (sd / expected - 1.0).abs() < 1e-3,
                    "{prior:?}, {masked:?}, {pixel}: {sd}, {expected}"
                );
            }
            let weights = Array1::from_shape_fn(32, |v| brightness(v as i32));
            let relit = LightSums::Relit { weights: weights.view(), beam: RelitBeam::AsLit };
            let sd = f64::from(of.of_sums_in_rows(0, &transport, &samples, &relit).unwrap()[[0, 0, 0]]);
            assert!((sd / relit_variance.sqrt() - 1.0).abs() < 1e-3, "{prior:?}, {masked:?}, {pixel}: {sd}");
        }
    }
}

#[test]
fn dark_pixels_are_certain_and_misfits_are_refused() {
    let timing = timing().window(60, 2).unwrap();
    let stack = Array3::<f32>::zeros((75, 2, 3));
    let transport =
        Demux::new(timing.clone(), paper_sweep(), Prior::SPLIT).unwrap().solve(stack.view(), None).unwrap();
    let samples = Samples { stack: stack.view(), valid: None, variance_ratio: None, u0_rows: None };
    let of = |frames: &[usize], samples: &Samples| {
        let settings = paper_sweep();
        let noise = camera_noise();
        let of = Uncertainty {
            timing: &timing,
            settings: &settings,
            prior: Prior::SPLIT,
            noise,
            frames,
            delay_sds_us: &[0.0; 75],
            darks: &[],
            calibration: None,
        };
        of.of_bands(&transport, samples, &bands())
    };
    assert_eq!(of(&[1; 75], &samples), Ok(Array3::zeros((5, 2, 3))));
    let other = Array3::<f32>::zeros((75, 2, 4));
    let misfit = Samples { stack: other.view(), ..samples };
    assert!(matches!(of(&[1; 75], &misfit), Err(PlaneError::Shape { array: "stack", .. })));
    assert!(matches!(of(&[1; 74], &samples), Err(PlaneError::Shape { array: "frames", .. })));
    assert!(matches!(of(&[0; 75], &samples), Err(PlaneError::OutOfRange { field: "frames", .. })));
}

#[test]
fn direct_light_between_rows_is_judged_where_it_lies() {
    let timing = RowTiming::new(32, 22.22, 16_667.0).unwrap().window(16, 1).unwrap();
    // Edges cut the rows around u = 0.
    let settings: Vec<Setting> = (0..24)
        .map(|n| Setting::new(-250.0 + 45.3 * f64::from(n % 12), 150.0 + 83.0 * f64::from(n / 12)))
        .collect();
    let bands = [vec![0..=0], vec![i32::MIN..=-1, 1..=i32::MAX], vec![-1..=1]];
    let centred = Demux::new(timing.clone(), settings.clone(), Prior::SPLIT).unwrap();
    let model = RowModel::new(&timing, &settings, &centred.reach(), 0);
    for u0 in [0.3_f32, -0.4] {
        let light = |u: i32| match u {
            0 => 0.6 * (1.0 - f64::from(u0.abs())),
            u => profile(0)(u) + if u == u0.signum() as i32 { 0.6 * f64::from(u0.abs()) } else { 0.0 },
        };
        let truth: Array1<f64> = model.slots.iter().map(|slot| light(slot.u)).collect();
        let stack =
            model.weights.dot(&truth).mapv(|light| light as f32 + 0.003 * (90.0 * light as f32).sin());
        let stack = stack.into_shape_with_order((24, 1, 1)).unwrap();
        let u0_rows = Array2::from_elem((1, 1), u0);
        let demux = centred.with_spike(u0_rows.clone()).unwrap();
        let transport = demux.solve(stack.view(), None).unwrap();
        let light = |stack: &Array3<f32>| {
            let transport = demux.solve(stack.view(), None).unwrap();
            bands.each_ref().map(|band| f64::from(light_of(&transport, band)))
        };
        let frames = [1; 24];
        let mut variances = [0.0; 3];
        for n in 0..24 {
            let step = 1e-3_f32;
            let [less, more] = [-step, step].map(|step| {
                let mut changed = stack.clone();
                changed[[n, 0, 0]] += step;
                light(&changed)
            });
            let noise = camera_noise().variance(f64::from(stack[[n, 0, 0]]), 1);
            for ((variance, less), more) in variances.iter_mut().zip(less).zip(more) {
                *variance += ((more - less) / (2.0 * f64::from(step))).powi(2) * noise;
            }
        }
        let of = Uncertainty {
            timing: &timing,
            settings: &settings,
            prior: Prior::SPLIT,
            noise: camera_noise(),
            frames: &frames,
            delay_sds_us: &[0.0; 24],
            darks: &[],
            calibration: None,
        };
        let sd = |u0_rows| {
            let samples = Samples { stack: stack.view(), valid: None, variance_ratio: None, u0_rows };
            of.of_bands(&transport, &samples, &bands).unwrap()
        };
        let (with, without) = (sd(Some(u0_rows.view())), sd(None));
        for (band, variance) in variances.into_iter().enumerate() {
            let ratio = |sd: &Array3<f32>| f64::from(sd[[band, 0, 0]]) / variance.sqrt();
            assert!((ratio(&with) - 1.0).abs() < 0.02, "u0 {u0}, band {band}: {}", ratio(&with));
        }
        let off = (f64::from(without[[0, 0, 0]]) / variances[0].sqrt() - 1.0).abs();
        assert!(off > 0.1, "u0 {u0}: {off}");
    }
}

fn light_of(transport: &Transport, band: &[RangeInclusive<i32>]) -> f32 {
    light(transport, band)[[0, 0]]
}

/// Pixels with measured responses at fractions of rows, lit as their responses spread rows, or each by its own alone:
/// repeated measurements of a relit image spread as predicted, and the image with all rows lit is as certain as all
/// light.
#[test]
fn relit_images_spread_as_predicted() {
    const REPEATS: u64 = 60;
    let rows = 62..64;
    let columns = 16;
    let place = Array2::from_shape_fn((2, columns), |(t, s)| 62.3 + t as f32 + 0.05 * s as f32);
    let mut beam = [0.0; RESPONSE_ROWS];
    (beam[6], beam[7], beam[8]) = (0.2, 0.7, 0.1);
    let response = PixelResponse::with_beam(place, &beam).unwrap();
    let timing = timing().window(rows.start, rows.len()).unwrap().with_response(response).unwrap();
    let scene = ideal_stack(&corner(), &paper_sweep());
    let ideal = scene.slice(s![.., rows, ..8 * columns; 8]).to_owned();
    let demux = Demux::new(timing.clone(), paper_sweep(), Prior::SPLIT).unwrap();
    let frames = [8; 75];
    let of = Uncertainty {
        timing: &timing,
        settings: &paper_sweep(),
        prior: Prior::SPLIT,
        noise: camera_noise(),
        frames: &frames,
        delay_sds_us: &[0.0; 75],
        darks: &[],
        calibration: None,
    };
    let stripes = Array1::from_shape_fn(timing.projector_rows(), |v| f64::from(u8::from(v % 7 < 3)));
    let all = Array1::ones(timing.projector_rows());
    for beam in [RelitBeam::AsLit, RelitBeam::Ideal] {
        let measure = |seed| {
            let stack = photographed_in(8, &ideal, seed);
            let estimate = demux.solve(stack.view(), None).unwrap();
            let samples = Samples { stack: stack.view(), valid: None, variance_ratio: None, u0_rows: None };
            let sd = |weights: &Array1<f64>| {
                let relit = LightSums::Relit { weights: weights.view(), beam };
                of.of_sums_in_rows(0, &estimate, &samples, &relit).unwrap().index_axis_move(Axis(0), 0)
            };
            if beam == RelitBeam::Ideal {
                let total = of.of_bands(&estimate, &samples, &[vec![i32::MIN..=i32::MAX]]).unwrap();
                assert_eq!(sd(&all), total.index_axis(Axis(0), 0));
            }
            (relight(&timing, &estimate, stripes.view(), beam).unwrap(), sd(&stripes))
        };
        let measured: Vec<_> = (0..REPEATS).map(measure).collect();
        let mean = measured.iter().fold(Array2::<f32>::zeros((2, columns)), |sum, (light, _)| sum + light)
            / REPEATS as f32;
        let within = measured.iter().flat_map(|(light, sd)| {
            (light - &mean).into_iter().zip(sd.clone()).map(|(deviation, sd)| deviation.abs() < sd)
        });
        let share = within.filter(|&within| within).count() as f64 / (REPEATS as usize * mean.len()) as f64;
        println!("{beam:?}: {share:.3} within one standard deviation");
        assert!((0.63..0.73).contains(&share), "{beam:?}: {share}");
    }
}

/// On a tilted rig, pixels of one camera row look at projector rows far apart: each has the bound of its own, and the same
/// whether its camera row is judged alone or with others.
#[test]
fn the_bias_of_a_relit_image_is_bounded_at_every_pixel_of_a_tilted_rig() {
    let (rows, columns) = (62..66, 16);
    let place = Array2::from_shape_fn((4, columns), |(t, s)| 40.3 + t as f32 + 3.0 * s as f32);
    let mut beam = [0.0; RESPONSE_ROWS];
    (beam[6], beam[7], beam[8]) = (0.2, 0.7, 0.1);
    let response = PixelResponse::with_beam(place, &beam).unwrap();
    let timing = timing().window(rows.start, rows.len()).unwrap().with_response(response).unwrap();
    let demux = Demux::new(timing.clone(), paper_sweep(), Prior::SPLIT).unwrap();
    let stack = Array3::from_elem((75, 4, columns), 0.4_f32);
    let estimate = demux.solve(stack.view(), None).unwrap();
    let model = Uncertainty {
        timing: &timing,
        settings: &paper_sweep(),
        prior: Prior::SPLIT,
        noise: camera_noise(),
        frames: &[8; 75],
        delay_sds_us: &[0.0; 75],
        darks: &[],
        calibration: None,
    };
    let family = model.bias_of_family().unwrap();
    // Near the pixels' own rows, and at either end of the projector, which no camera row of the family sees.
    let lightings = [55..58, 0..2, 126..128];
    for (lit, beam) in lightings.iter().flat_map(|lit| [(lit, RelitBeam::AsLit), (lit, RelitBeam::Ideal)]) {
        let lit = Array1::from_shape_fn(timing.projector_rows(), |v| f64::from(u8::from(lit.contains(&v))));
        let sums = LightSums::Relit { weights: lit.view(), beam };
        let bounds = |rows: Range<usize>| {
            let (t, exists) = (s![.., rows.clone(), ..], s![.., rows.clone()]);
            let part = Transport::measured(
                estimate.t.slice(t).to_owned(),
                estimate.u_min,
                estimate.exists.slice(exists).to_owned(),
            );
            let samples = Samples { stack: stack.slice(t), valid: None, variance_ratio: None, u0_rows: None };
            let bounds = model.prior_bias_in_rows(rows.start, &part, &samples, &sums, &family).unwrap();
            bounds.index_axis_move(Axis(0), 0)
        };
        let whole = bounds(0..4);
        assert!(whole.iter().all(|&bound| bound > 0.0), "{beam:?}: {whole:.4}");
        for t in 0..4 {
            assert_eq!(bounds(t..t + 1).row(0), whole.row(t));
        }
    }
}
