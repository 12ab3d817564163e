//! Estimates of each pixel's properties from simulated images of the board, against the truth.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod scene;

use std::time::Instant;

use ndarray::{Array2, Array3, ArrayView2, Axis};
use rand_distr::{Distribution, Normal};
use raysweep_transport::plane::FIRST_RESPONSE_ROW;
use raysweep_transport::plane::board::images::{
    BlackFrames, CappedFrames, DarkFit, ImagesError, LightLevel, Linearity, Narrower, Responses, RowPlaces,
    SaturationLimit, WhiteMap, ambient, compare_responses, locate_columns, locate_rows, photon_transfer,
    prnu,
};

use scene::{
    BLACK_LEVEL_DN, Cumulative, ELECTRONS_PER_DN, FULL_SCALE_DN, Pictures, Profile, READ_NOISE_E, Scene,
    WHITE_DN, frames, noise, photographed, photographed_on, random, uneven,
};

const FLAT_TOP: Profile = Profile::FlatTop { up: 0.5, down: 1.2 };

/// Share of errors within one standard deviation.
fn within_one_sd(errors: impl IntoIterator<Item = f64>) -> f64 {
    let (mut within, mut all) = (0.0, 0.0);
    for z in errors {
        all += 1.0;
        within += f64::from(u8::from(z.abs() < 1.0));
    }
    within / all
}

fn median(values: impl IntoIterator<Item = f64>) -> f64 {
    let mut values: Vec<f64> = values.into_iter().collect();
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

fn black(shape: (usize, usize)) -> Array2<f32> {
    Array2::from_elem(shape, BLACK_LEVEL_DN as f32)
}

#[test]
fn the_dark_image_is_a_line_over_exposure() {
    let shape = (64, 64);
    let exposures = [60.0, 600.0, 750.0, 900.0, 1050.0, 1200.0, 3600.0];
    let offset = uneven(shape, 0.02, 1) * 5.0;
    let mut slope = uneven(shape, 0.1, 2) * 1e-3;
    let hot = [(3, 4), (20, 40), (63, 0)];
    hot.iter().for_each(|&at| slope[at] = 0.05);
    let noisy = (10, 10);
    let runs: Vec<Array3<f32>> = exposures
        .iter()
        .enumerate()
        .map(|(run, &exposure_us)| {
            let dark = &offset + &(&slope * exposure_us) + BLACK_LEVEL_DN;
            let mut frames = Array3::zeros((16, shape.0, shape.1));
            for (n, mut frame) in frames.axis_iter_mut(Axis(0)).enumerate() {
                let seed = 7000 + 100 * run as u64 + n as u64;
                frame.assign(&photographed_on(&Array2::zeros(shape), &dark, seed));
                frame[noisy] += if n % 2 == 0 { 30.0 } else { -30.0 };
            }
            frames
        })
        .collect();
    let capped: Vec<CappedFrames> = exposures
        .iter()
        .zip(&runs)
        .map(|(&exposure_us, frames)| CappedFrames { exposure_us, frames: frames.view() })
        .collect();
    let fit = DarkFit::new(&capped).unwrap();
    let z = |estimate: &Array2<f32>, truth: &Array2<f64>, sd: ArrayView2<f32>| {
        let errors = estimate.iter().zip(truth).zip(sd);
        let errors: Vec<f64> = errors.map(|((e, t), sd)| (f64::from(*e) - t) / f64::from(*sd)).collect();
        within_one_sd(errors)
    };
    let sd = |n: usize| fit.covariance.index_axis(Axis(0), n).mapv(f32::sqrt);
    let shares = [
        z(&fit.offset_dn, &(&offset + BLACK_LEVEL_DN), sd(0).view()),
        z(&fit.slope_dn_per_us, &slope, sd(2).view()),
        z(&fit.image(600.0), &(&offset + &(&slope * 600.0) + BLACK_LEVEL_DN), fit.image_sd(600.0).view()),
    ];
    println!("dark: within 1 sd {shares:.3?}, read noise {:?}", fit.read_noise_dn);
    assert!(shares.iter().all(|share| (0.65..0.72).contains(share)), "{shares:?}");
    let read_noise = ((READ_NOISE_E / ELECTRONS_PER_DN).powi(2) + 1.0 / 12.0).sqrt();
    assert!((fit.read_noise_dn.value / read_noise - 1.0).abs() < 0.01);
    let found: Vec<_> = fit.hot.indexed_iter().filter(|(_, hot)| **hot).map(|(at, _)| at).collect();
    assert_eq!(found, [(3, 4), (10, 10), (20, 40), (63, 0)]);

    let refused = DarkFit::new(&capped[..1]).unwrap_err();
    assert!(matches!(refused, ImagesError::TooFew { given: 1, needed: 2, .. }), "{refused}");
}

/// Frames of black, three greys and white.
fn levels(shape: (usize, usize), seed: u64) -> Vec<Array3<f32>> {
    let white = Scene::new(shape, 296.0, 0.3, Cumulative::new(FLAT_TOP, 0.0), seed).white;
    let counts = [(0.0, 32), (0.25, 8), (0.5, 8), (0.75, 8), (1.0, 32)];
    let levels = counts
        .iter()
        .enumerate()
        .map(|(n, &(grey, count))| frames(&(&white * grey), count, 0.005, 1000 * seed + n as u64));
    levels.collect()
}

#[test]
fn gain_and_read_noise_by_photon_transfer() {
    let shape = (64, 64);
    let dark = black(shape);
    let (mut of_gain, mut of_noise) = (Vec::new(), Vec::new());
    for seed in 1..=24 {
        let frames = levels(shape, seed);
        let levels: Vec<LightLevel> = frames
            .iter()
            .map(|f| LightLevel { light: 1.0, frames: f.view(), dark_dn: dark.view() })
            .collect();
        let found = photon_transfer(&levels, FULL_SCALE_DN, None).unwrap();
        let gain = found.electrons_per_dn;
        let read = found.read_noise_e;
        assert!((gain.value / ELECTRONS_PER_DN - 1.0).abs() < 0.03, "{gain:?}");
        assert!((read.value - READ_NOISE_E).abs() < 0.4, "{read:?}");
        of_gain.push((gain.value - ELECTRONS_PER_DN) / gain.sd);
        of_noise.push((read.value - READ_NOISE_E) / read.sd);
        if seed == 1 {
            println!("photon transfer: {gain:?}, {read:?}");
        }
    }
    let shares = [within_one_sd(of_gain), within_one_sd(of_noise)];
    println!("photon transfer: within 1 sd {shares:.2?}");
    // 24 seeds: 68 % +- 10 %.
    assert!(shares.iter().all(|share| (0.45..0.9).contains(share)), "{shares:?}");
}

#[test]
fn photon_transfer_refuses_noise_that_falls_with_light() {
    let shape = (64, 64);
    let dark = black(shape);
    let light = Array2::from_elem(shape, 1000.0);
    let noisy = frames(&Array2::zeros(shape), 8, 0.0, 1);
    let quiet = frames(&light, 8, 0.0, 2).mapv(|dn| ((dn - 1064.0) / 20.0).round() + 1064.0);
    let levels = [&noisy, &quiet].map(|f| LightLevel { light: 1.0, frames: f.view(), dark_dn: dark.view() });
    let refused = photon_transfer(&levels, FULL_SCALE_DN, None).unwrap_err();
    assert!(matches!(refused, ImagesError::NoShotNoise { fall } if fall > 0.0), "{refused}");
    let saturated = LightLevel { light: 1.0, frames: quiet.view(), dark_dn: dark.view() };
    assert!(matches!(photon_transfer(&[saturated], 1000.0, None), Err(ImagesError::TooFew { .. })));
}

#[test]
fn non_uniformity_without_shading_and_rows() {
    let mut z = Vec::new();
    for seed in 1..=12 {
        let scene = Scene::new((128, 128), 296.0, 0.3, Cumulative::new(FLAT_TOP, 0.0), seed);
        let white = frames(&scene.picture(|_| true), 32, 0.0, seed);
        let mean = white.mean_axis(Axis(0)).unwrap() - BLACK_LEVEL_DN as f32;
        let found = prnu(mean.view(), None, 32, noise()).unwrap();
        assert!((found.value - 0.01).abs() < 4e-4, "{found:?}");
        z.push((found.value - 0.01) / found.sd);
    }
    println!("prnu: within 1 sd {:.2}", within_one_sd(z));
}

/// What the camera gives for light, if `DN (1 + a DN)` is proportional to it.
fn bent(light: &Array2<f64>, a: f64) -> Array2<f64> {
    light.mapv(|light| if a == 0.0 { light } else { ((1.0 + 4.0 * a * light).sqrt() - 1.0) / (2.0 * a) })
}

#[test]
fn bends_of_the_response_are_found() {
    let shape = (64, 64);
    let dark = black(shape);
    let mut z = Vec::new();
    for (n, bend) in [-0.006, 0.011, 0.0].iter().cycle().take(24).enumerate() {
        let seed = n as u64 + 1;
        let a = bend / f64::from(FULL_SCALE_DN);
        let grey = uneven(shape, 0.01, seed) * 1200.0;
        let passes = [1.0, 2.0, 3.0].map(|light| {
            // The bend belongs to the sensor, behind the shot noise, but noise is small against it.
            frames(&bent(&(&grey * light), a), 8, 1e-4, 100 * seed + light as u64)
        });
        let levels: Vec<LightLevel> = passes
            .iter()
            .zip([1.0, 2.0, 3.0])
            .map(|(frames, light)| LightLevel { light, frames: frames.view(), dark_dn: dark.view() })
            .collect();
        let found = Linearity::new(&levels, FULL_SCALE_DN, None).unwrap().per_dn;
        let error = (found.value - a) * f64::from(FULL_SCALE_DN);
        assert!(error.abs() < 5e-4, "bend {bend}: {error}");
        z.push((found.value - a) / found.sd);
        if n == 0 {
            let mut images = passes[2].to_owned();
            let zero_dn = Array2::from_elem(shape, BLACK_LEVEL_DN as f32);
            Linearity::new(&levels, FULL_SCALE_DN, None).unwrap().straighten(images.view_mut(), &zero_dn);
            let light = f64::from(images.index_axis(Axis(0), 0).mean().unwrap()) - BLACK_LEVEL_DN;
            let ratio = light / (3.0 * grey.mean().unwrap());
            assert!((ratio - 1.0).abs() < 1e-3, "{ratio}");
        }
    }
    let share = within_one_sd(z);
    println!("linearity: within 1 sd {share:.2}");
    assert!((0.45..0.9).contains(&share), "{share}");
}

#[test]
fn gamma_is_refused() {
    let shape = (64, 64);
    let dark = black(shape);
    let grey = uneven(shape, 0.01, 1) * 1200.0;
    let passes = [1.0, 2.0, 3.0].map(|light| {
        let curved = (&grey * light).mapv(|dn| 4031.0 * (dn / 4031.0_f64).powf(1.0 / 1.1));
        frames(&curved, 8, 0.0, 10 + light as u64)
    });
    let levels: Vec<LightLevel> = passes
        .iter()
        .zip([1.0, 2.0, 3.0])
        .map(|(frames, light)| LightLevel { light, frames: frames.view(), dark_dn: dark.view() })
        .collect();
    let refused = Linearity::new(&levels, FULL_SCALE_DN, None).unwrap_err();
    assert!(matches!(refused, ImagesError::Curved { bend, .. } if bend > 0.03), "{refused}");
    println!("{refused}");
}

#[test]
fn saturation_lies_below_each_pixels_plateau() {
    let shape = (32, 32);
    let dark = black(shape);
    // Pixels of the upper half fill at 3900 DN, the others are cut off by 12 bits; one column is dark.
    let ladder = [1.0, 2.0, 3.0, 4.0].map(|light| {
        let mut frames = frames(&Array2::from_elem(shape, 1200.0 * light), 8, 0.0, light as u64);
        let read = Normal::new(0.0_f64, 5.4).unwrap();
        let mut random = random(99 + light as u64);
        for ((_, t, s), dn) in frames.indexed_iter_mut() {
            if s == 0 {
                *dn = BLACK_LEVEL_DN as f32 + 100.0 * light as f32;
            } else if t < 16 && *dn > 3880.0 {
                *dn = (3900.0 + read.sample(&mut random)).round() as f32;
            }
        }
        frames
    });
    let levels: Vec<LightLevel> = ladder
        .iter()
        .zip([1.0, 2.0, 3.0, 4.0])
        .map(|(frames, light)| LightLevel { light, frames: frames.view(), dark_dn: dark.view() })
        .collect();
    let found = SaturationLimit::new(&levels, FULL_SCALE_DN, 5.4).unwrap();
    assert!((found.seen - 31.0 / 32.0).abs() < 1e-9, "{}", found.seen);
    for s in 1..32 {
        let [full_well, cut_off] = [found.limit_dn[[3, s]], found.limit_dn[[20, s]]];
        assert!(
            (3860..3890).contains(&full_well) && (4060..4080).contains(&cut_off),
            "{full_well} {cut_off}"
        );
    }
    assert!(f64::from(found.limit_dn[[3, 0]]) <= found.plateau_dn);
}

#[test]
fn white_is_found_within_its_sd_and_bad_ones_are_refused() {
    let scene = Scene::new((128, 128), 296.0, 0.3, Cumulative::new(FLAT_TOP, 0.0), 1);
    let truth = scene.picture(|_| true);
    let [white, black] = scene.white_and_black(1);
    let map = WhiteMap::new(white.view(), black.view(), FULL_SCALE_DN, noise()).unwrap();
    map.check(FULL_SCALE_DN).unwrap();
    let pixels = map.white_dn.iter().zip(&truth).zip(&map.sd_dn);
    let share = within_one_sd(pixels.map(|((w, t), sd)| (f64::from(*w) - t) / f64::from(*sd)));
    println!("white: within 1 sd {share:.3}, level {:?}", map.level_dn);
    assert!((0.66..0.70).contains(&share), "{share}");
    assert!(map.coverage == 1.0 && map.saturated == 0.0);

    let refused = |light: Array2<f64>| {
        let frames = frames(&light, 4, 0.0, 3);
        WhiteMap::new(frames.view(), black.view(), FULL_SCALE_DN, noise())
            .unwrap()
            .check(FULL_SCALE_DN)
            .unwrap_err()
    };
    let mut part = truth.clone();
    part.slice_mut(ndarray::s![.., 55..]).fill(0.0);
    let error = refused(part);
    println!("{error}");
    assert!(matches!(error, ImagesError::Coverage { coverage, .. } if (coverage - 0.43).abs() < 0.01));
    let error = refused(&truth * 1.7);
    println!("{error}");
    assert!(matches!(error, ImagesError::Saturated { share, .. } if share > 0.01));
    let error = refused(&truth * 0.15);
    println!("{error}");
    assert!(matches!(error, ImagesError::Dim { level, .. } if level < 0.1));
}

struct Measured {
    scene: Scene,
    pictures: Pictures,
    white: WhiteMap,
    places: RowPlaces,
    responses: Responses,
}

fn measure(scene: Scene, frames: usize, seed: u64) -> Result<Measured, ImagesError> {
    let pictures = scene.pictures(frames, seed);
    let [white, black] = scene.white_and_black(seed);
    let white = WhiteMap::new(white.view(), black.view(), FULL_SCALE_DN, noise())?;
    let places = locate_rows(&pictures.phases(), &pictures.code(), white.lit().view(), scene.projector_rows)?;
    let responses = Responses::new(&pictures.phases(), &white, &places, scene.projector_rows)?;
    responses.checks.check()?;
    Ok(Measured { scene, pictures, white, places, responses })
}

/// Errors of a pixel's response: relative l2, and each share over its standard deviation where it is not nearly 0.
fn response_errors(measured: &Measured, t: usize, s: usize) -> (f64, Vec<f64>) {
    let Measured { scene, responses, .. } = measured;
    let truth = scene.response(t, s, responses.place[[t, s]].round() as i64);
    let found = responses.response.slice(ndarray::s![.., t, s]);
    let sd = responses.response_sd.slice(ndarray::s![.., t, s]);
    let square: f64 = found.iter().zip(&truth).map(|(f, t)| (f64::from(*f) - t).powi(2)).sum();
    let norm: f64 = truth.iter().map(|t| t * t).sum();
    let z =
        found.iter().zip(&truth).zip(sd).map(|((f, t), sd)| (f64::from(*f) - t) / f64::from(*sd)).collect();
    ((square / norm).sqrt(), z)
}

#[test]
fn responses_and_places() {
    let shape = (128, 128);
    let cases = [
        ("flat-top, 0.2 degrees", FLAT_TOP, 0.0, 0.2),
        ("flat-top, 0.5 degrees", FLAT_TOP, 0.0, 0.5),
        ("Gaussian 0.6", Profile::Gaussian { sigma: 0.6 }, 0.0, 0.3),
        ("flat-top, scattered 0.3", FLAT_TOP, 0.3, -0.4),
        ("flat-top, scattered 0.7", FLAT_TOP, 0.7, 0.3),
    ];
    let (mut z_place, mut z_share) = (Vec::new(), Vec::new());
    for (n, (name, profile, scatter, degrees)) in cases.into_iter().enumerate() {
        let seed = n as u64 + 1;
        let scene = Scene::new(shape, 296.3, degrees, Cumulative::new(profile, scatter), seed);
        let measured = measure(scene, 4, seed).unwrap();
        let pixels: Vec<(usize, usize)> = ndarray::indices(shape).into_iter().collect();
        let error = |&(t, s): &(usize, usize)| {
            f64::from(measured.responses.place[[t, s]]) - measured.scene.place(t, s)
        };
        let worst = pixels.iter().map(|at| error(at).abs()).fold(0.0, f64::max);
        let rms = (pixels.iter().map(|at| error(at).powi(2)).sum::<f64>() / pixels.len() as f64).sqrt();
        let l2 = median(pixels.iter().map(|&(t, s)| response_errors(&measured, t, s).0));
        let of_place: Vec<f64> =
            pixels.iter().map(|at| error(at) / f64::from(measured.responses.place_sd[*at])).collect();
        let of_share: Vec<f64> =
            pixels.iter().flat_map(|&(t, s)| response_errors(&measured, t, s).1[5..11].to_vec()).collect();
        println!(
            "{name}: response {:.2} % (median l2), place {rms:.4} rms, {worst:.3} worst; within 1 sd: place {:.2}, \
             response {:.2}; {:?}",
            100.0 * l2,
            within_one_sd(of_place.iter().copied()),
            within_one_sd(of_share.iter().copied()),
            measured.responses.checks
        );
        z_place.extend(of_place);
        z_share.extend(of_share);
        assert!(l2 < 0.01, "{name}: {l2}");
        assert!(rms < 0.03 && worst < 0.05, "{name}: {rms} {worst}");
        assert_eq!(measured.places.misread, 0.0);
        // Pixels at the edges of the image have neighbours on one side only.
        let of_column = |s: usize| (0..shape.0).map(|t| error(&(t, s))).sum::<f64>() / shape.0 as f64;
        let edges = [0, 1, shape.1 - 2, shape.1 - 1].map(of_column);
        println!("{name}: places at the edges of the image off by {edges:.4?}");
        assert!(edges.iter().all(|edge| edge.abs() < 0.007), "{name}: {edges:?}");
        // The response's centroid is the place, and its shares sum to 1.
        for &(t, s) in pixels.iter().step_by(97) {
            let shares = measured.responses.response.slice(ndarray::s![.., t, s]);
            let place = measured.responses.place[[t, s]];
            let centroid: f32 = shares.iter().zip(FIRST_RESPONSE_ROW..).map(|(k, d)| k * d as f32).sum();
            assert!((place.round() + centroid - place).abs() < 0.005 && (shares.sum() - 1.0).abs() < 1e-5);
        }
    }
    let shares = [within_one_sd(z_place), within_one_sd(z_share)];
    println!("within 1 sd: place {:.3}, response {:.3}", shares[0], shares[1]);
    assert!(shares.iter().all(|share| (0.55..0.8).contains(share)), "{shares:?}");
}

#[test]
fn rows_beyond_the_picture_have_no_share() {
    let mut scene = Scene::new((128, 128), -2.0, 0.2, Cumulative::new(FLAT_TOP, 0.3), 3);
    scene.projector_rows = 124;
    let measured = measure(scene, 4, 3).unwrap();
    let (mut border, mut errors) = (0, Vec::new());
    for ((t, s), place) in measured.responses.place.indexed_iter().filter(|(_, place)| !place.is_nan()) {
        errors.push((f64::from(*place) - measured.scene.place(t, s)).abs());
        let own_row = place.round() as i32;
        for (share, d) in
            measured.responses.response.slice(ndarray::s![.., t, s]).iter().zip(FIRST_RESPONSE_ROW..)
        {
            let exists = (0..124).contains(&(own_row + d));
            assert!(exists || *share == 0.0);
            border += usize::from(!exists);
        }
        assert!((measured.responses.response.slice(ndarray::s![.., t, s]).sum() - 1.0).abs() < 1e-5);
    }
    let worst = errors.iter().copied().fold(0.0, f64::max);
    println!("border of the picture: place {:.4} (median), {worst:.3} worst", median(errors));
    assert!(border > 1000 && worst < 0.1);
}

#[test]
fn columns_are_located_with_blocks_of_16() {
    // The board turned by 90 degrees: 128 columns of 1280 from 600 on.
    let mut scene = Scene::new((128, 128), 600.4, 0.3, Cumulative::new(FLAT_TOP, 0.0), 4);
    scene.projector_rows = 1280;
    scene.brightness = vec![1.0; 1280];
    let code: Vec<Array2<f32>> = (0..14)
        .map(|n| {
            let gray = |v: usize| ((v / 16) ^ (v / 32)) >> (6 - n / 2) & 1;
            let light = scene.picture(|v| gray(v) != n % 2);
            frames(&light, 1, 0.0, 500 + n as u64).index_axis_move(Axis(0), 0)
        })
        .collect();
    let views: Vec<_> = code.iter().map(|image| image.t()).collect();
    let code = ndarray::stack(Axis(0), &views).unwrap();
    let code =
        raysweep_transport::plane::board::images::CodedPictures { images: code.view(), lines_per_block: 16 };
    let lit = Array2::from_elem((128, 128), true);
    let columns = locate_columns(&code, lit.view(), 1280).unwrap();
    for ((t, s), column) in columns.indexed_iter() {
        let truth = (scene.place(s, t) + 0.5) / 1280.0;
        assert!((f64::from(*column) - truth).abs() * 1280.0 < 3.2, "{t} {s}: {column} {truth}");
    }
    // 6 bits name 64 blocks of 16 columns, but there are 80.
    let mut short = code;
    short.images = code.images.slice_move(ndarray::s![2.., .., ..]);
    assert!(matches!(locate_columns(&short, lit.view(), 1280), Err(ImagesError::OutOfRange { .. })));
}

#[test]
fn unlit_pixels_have_no_place() {
    let mut scene = Scene::new((128, 128), 296.3, 0.3, Cumulative::new(FLAT_TOP, 0.0), 5);
    scene.white.slice_mut(ndarray::s![.., 100..]).fill(0.0);
    let measured = measure(scene, 4, 5).unwrap();
    for ((_, s), place) in measured.responses.place.indexed_iter() {
        assert_eq!(place.is_nan(), s >= 100);
    }
    assert!((measured.white.coverage - 100.0 / 128.0).abs() < 1e-6);
    assert_eq!(measured.pictures.phases.len_of(Axis(0)), 16);
}

#[test]
fn projectors_that_change_the_picture_are_refused() {
    let refused = |change: fn(&mut Scene)| {
        let mut scene = Scene::new((128, 128), 296.3, 0.3, Cumulative::new(FLAT_TOP, 0.0), 6);
        change(&mut scene);
        let error = measure(scene, 4, 6).err().unwrap();
        println!("{error}");
        error
    };
    let error = refused(|scene| scene.boost = 1.21);
    assert!(matches!(error, ImagesError::SumOfPhases { sum, .. } if (sum - 1.21).abs() < 0.01));
    let error = refused(|scene| scene.ghost = 0.35);
    assert!(matches!(error, ImagesError::TwoPeaks { share, .. } if share > 0.9));
    let error = refused(|scene| scene.haze = 0.4);
    assert!(matches!(error, ImagesError::FarLight { share, .. } if (share - 0.075).abs() < 0.01));
    // A picture that is scaled without interpolation: places jump.
    let error = refused(|scene| scene.centre.mapv_inplace(|p| p + 0.5 * (p / 24.0).fract()));
    assert!(matches!(error, ImagesError::NotSmooth { rms, .. } if rms > 0.1));
}

#[test]
fn the_board_that_scatters_less_is_taken() {
    let scene = |scatter, first_row, seed| {
        Scene::new((128, 128), first_row, 0.5, Cumulative::new(FLAT_TOP, scatter), seed)
    };
    let little = measure(scene(0.3, 296.3, 7), 4, 7).unwrap().responses;
    let much = measure(scene(0.7, 291.8, 8), 4, 8).unwrap().responses;
    let alike = measure(scene(0.3, 291.8, 9), 4, 9).unwrap().responses;
    let compared = compare_responses(&little, &much).unwrap();
    println!("{compared}");
    assert_eq!(compared.narrower, Narrower::First);
    // 0.7^2 - 0.3^2 = 0.4 rows^2.
    assert!((compared.difference.value - 0.4).abs() < 0.02, "{compared:?}");
    let turned = compare_responses(&much, &little).unwrap();
    assert_eq!((turned.narrower, turned.difference.value), (Narrower::Second, -compared.difference.value));
    let same = compare_responses(&little, &alike).unwrap();
    println!("{same}");
    assert_eq!(same.narrower, Narrower::Neither);
}

struct Room {
    level: Array2<f64>,
    frequency_hz: f64,
    share: f64,
    phase: f64,
}

const ROW_TIME_US: f64 = 18.61;

/// Frames of a run at 60 Hz that begins at `start_s`, with every eighth frame lost, and their times.
fn black_frames(room: &Room, exposure_us: f64, n: usize, start_s: f64, seed: u64) -> (Array3<f32>, Vec<f64>) {
    let times: Vec<f64> =
        (0..).filter(|frame| frame % 8 != 7).take(n).map(|frame| start_s + f64::from(frame) / 60.0).collect();
    let frames: Vec<Array2<f32>> = times
        .iter()
        .enumerate()
        .map(|(n, time)| {
            let mut light = room.level.clone();
            for (t, mut row) in light.axis_iter_mut(Axis(0)).enumerate() {
                // The integral of the lamp over the row's exposure, and half a DN of the projector's black.
                let open = time + t as f64 * ROW_TIME_US * 1e-6;
                let omega = std::f64::consts::TAU * room.frequency_hz;
                let until = |x: f64| x + room.share / omega * (omega * x + room.phase).sin();
                let lit_us = 1e6 * (until(open + exposure_us * 1e-6) - until(open));
                row.mapv_inplace(|level| level * lit_us + 0.5);
            }
            photographed(&light, 10_000 * seed + n as u64)
        })
        .collect();
    let views: Vec<_> = frames.iter().map(|frame| frame.view()).collect();
    (ndarray::stack(Axis(0), &views).unwrap(), times)
}

#[test]
fn flicker_and_level_of_the_room() {
    let shape = (180, 64);
    let dark = black(shape);
    let [mut of_frequency, mut of_share, mut of_phase, mut of_level] = [const { Vec::new() }; 4];
    for (n, frequency_hz) in [100.02, 99.0, 101.37, 217.3, 119.2, 100.0, 83.1, 300.9].into_iter().enumerate()
    {
        let seed = n as u64 + 1;
        let level = uneven(shape, 0.05, seed) * 0.026;
        let room = Room { level, frequency_hz, share: 0.31, phase: 0.4 * n as f64 };
        let (short, short_s) = black_frames(&room, 1200.0, 64, 5.0, 2 * seed);
        let (long, long_s) = black_frames(&room, 3600.0, 32, 7.013, 2 * seed + 1);
        let runs =
            [(&short, &short_s, 1200.0), (&long, &long_s, 3600.0)].map(|(frames, times, exposure_us)| {
                BlackFrames { exposure_us, frames: frames.view(), dark_dn: dark.view(), opened_s: times }
            });
        let start = Instant::now();
        let found = ambient(&runs, ROW_TIME_US, 60.0, noise(), None).unwrap();
        let flicker = found.flicker.expect("flicker");
        println!("{frequency_hz} Hz in {:?}: {flicker:?}", start.elapsed());
        assert!((flicker.frequency_hz.value - frequency_hz).abs() < 0.02 && flicker.alias_hz.is_none());
        assert!((flicker.share.value - 0.31).abs() < 0.003);
        assert!(flicker.separable);
        of_frequency.push((flicker.frequency_hz.value - frequency_hz) / flicker.frequency_hz.sd);
        of_share.push((flicker.share.value - 0.31) / flicker.share.sd);
        let truth = std::f64::consts::TAU * frequency_hz * flicker.reference_s + room.phase;
        let error =
            (flicker.phase_rad.value - truth + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU);
        of_phase.push((error - std::f64::consts::PI) / flicker.phase_rad.sd);
        let pixels = found.level_dn_per_us.iter().zip(&room.level).zip(&found.level_sd);
        of_level.extend(pixels.map(|((found, truth), sd)| (f64::from(*found) - truth) / f64::from(*sd)));
        let black = f64::from(found.projector_black_dn.mean().unwrap());
        assert!((black - 0.5).abs() < 0.05, "{black}");
        found.check(WHITE_DN, 18.88).unwrap();
    }
    let shares = [of_frequency, of_share, of_phase].map(within_one_sd);
    let of_level = within_one_sd(of_level);
    println!("within 1 sd: frequency, share, phase {shares:.2?}; level {of_level:.3}");
    assert!((0.66..0.70).contains(&of_level), "{of_level}");
}

#[test]
fn flicker_near_a_multiple_of_the_frame_rate_is_named() {
    let shape = (180, 64);
    let dark = black(shape);
    let found = |frequency_hz: f64, share: f64, level: f64| {
        let room = Room { level: Array2::from_elem(shape, level), frequency_hz, share, phase: 0.3 };
        let (short, short_s) = black_frames(&room, 1200.0, 64, 5.0, 77);
        let run = BlackFrames {
            exposure_us: 1200.0,
            frames: short.view(),
            dark_dn: dark.view(),
            opened_s: &short_s,
        };
        ambient(&[run], ROW_TIME_US, 60.0, noise(), None).unwrap()
    };
    let near = found(120.2, 0.5, 0.5);
    println!("{:?}", near.flicker);
    assert!(!near.flicker.unwrap().separable);
    let error = near.check(WHITE_DN, 18.88).unwrap_err();
    println!("{error}");
    assert!(matches!(error, ImagesError::Flicker { frequency_hz, .. } if (frequency_hz - 120.2).abs() < 0.3));
    // A steady lamp does not flicker, nor does the dark.
    assert_eq!(found(100.0, 0.0, 0.026).flicker, None);
    assert_eq!(found(100.0, 0.0, 0.0).flicker, None);
}

/// Time and accuracy at full size: `cargo test -p raysweep-transport --test board_images -- --ignored --nocapture`.
#[test]
#[ignore = "takes half a minute to simulate"]
fn full_size() {
    let shape = (720, 1280);
    let scene = Scene::new(shape, -1.0, 0.3, Cumulative::new(FLAT_TOP, 0.0), 11);
    let pictures = scene.pictures(4, 11);
    let [white, black] = scene.white_and_black(11);
    let start = Instant::now();
    let white = WhiteMap::new(white.view(), black.view(), FULL_SCALE_DN, noise()).unwrap();
    println!("white: {:?}", start.elapsed());
    let places = locate_rows(&pictures.phases(), &pictures.code(), white.lit().view(), 720).unwrap();
    println!("white, places: {:?}", start.elapsed());
    let responses = Responses::new(&pictures.phases(), &white, &places, 720).unwrap();
    println!("white, places, responses: {:?}; {:?}", start.elapsed(), responses.checks);
    let measured = Measured { scene, pictures, white, places, responses };
    let seen: Vec<(usize, usize)> = ndarray::indices(shape)
        .into_iter()
        .step_by(37)
        .filter(|&at| !measured.responses.place[at].is_nan())
        .collect();
    let l2 = median(seen.iter().map(|&(t, s)| response_errors(&measured, t, s).0));
    let error = median(
        seen.iter()
            .map(|&(t, s)| (f64::from(measured.responses.place[[t, s]]) - measured.scene.place(t, s)).abs()),
    );
    println!("response {:.2} %, place {error:.4} rows (medians)", 100.0 * l2);
    assert!(l2 < 0.01 && error < 0.01);
}
