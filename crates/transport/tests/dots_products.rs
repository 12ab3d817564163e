//! Calibration and products compared with direct sums over dense images.

#![allow(clippy::unwrap_used)] // helpers outside #[test] functions are tests too

use ndarray::{Array2, Array3, Axis, Zip, s};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use raysweep_transport::dots::calibrate::{Centroids, Confusion, Footprints, Fundamental, PointSpreads};
use raysweep_transport::dots::product::{
    EpipolarMask, MaskRule, Separation, column_energies, compensate, coverage, dual, epipolar, fill_holes,
    floodlit, pattern_weights, relight, relight_sequence, shadow_dot, shadow_neighbours,
};
use raysweep_transport::dots::{Batch, BatchArrays, ColumnOutcome, DotsError, FrameShape, SparseColumn};

/// A column with the pixels above `least` and the means of the rest, computed without the denoiser.
fn column(shape: FrameShape, image: &Array3<f32>, least: f32) -> SparseColumn {
    let channels = shape.channels();
    let mut column =
        SparseColumn { outcome: ColumnOutcome { discs: 1, capped: false }, ..SparseColumn::default() };
    let mut rest = vec![(0.0_f64, 0_usize); shape.blocks() * channels];
    for (pixel, value) in image.rows().into_iter().enumerate() {
        if value.iter().any(|&value| value > least) {
            let word = (pixel / 32) as u32;
            if column.words.last() != Some(&word) {
                column.words.push(word);
                column.masks.push(0);
            }
            *column.masks.last_mut().unwrap() |= 1 << (pixel % 32);
            column.values.extend(value);
        } else {
            let side = shape.block_px();
            let block = pixel / shape.width() / side * shape.block_columns() + pixel % shape.width() / side;
            for (channel, &value) in value.iter().enumerate() {
                let (sum, count) = &mut rest[block * channels + channel];
                (*sum, *count) = (*sum + f64::from(value), *count + 1);
            }
        }
    }
    column.residual = rest.iter().map(|(sum, count)| (sum / (*count).max(1) as f64) as f32).collect();
    column
}

fn batch(shape: FrameShape, images: &[Array3<f32>], least: f32) -> Batch {
    let mut arrays = BatchArrays::default();
    images.iter().for_each(|image| arrays.push(&column(shape, image, least)));
    Batch::new(shape, arrays).unwrap()
}

fn centroids_of(batch: &Batch) -> Centroids {
    Centroids::new(batch, &Footprints::new(batch, 0.5).unwrap()).unwrap()
}

/// The images that a batch represents: values in masks, means elsewhere.
fn dense(batch: &Batch) -> Vec<Array3<f64>> {
    let shape = batch.shape();
    let image = |dot: usize| {
        let column = batch.column(dot);
        let mut image =
            Array3::from_shape_fn((shape.height(), shape.width(), shape.channels()), |(row, at, channel)| {
                let block = row / shape.block_px() * shape.block_columns() + at / shape.block_px();
                f64::from(column.residual()[block * shape.channels() + channel])
            });
        for (pixel, value) in column.pixels() {
            for (channel, &value) in value.iter().enumerate() {
                image[[pixel / shape.width(), pixel % shape.width(), channel]] = value.into();
            }
        }
        image
    };
    (0..batch.dots()).map(image).collect()
}

fn random_images(shape: FrameShape, dots: usize, seed: u64) -> Vec<Array3<f32>> {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
    let mut unit = || (random.next_u64() >> 40) as f32 / (1 << 24) as f32;
    let size = (shape.height(), shape.width(), shape.channels());
    (0..dots)
        .map(|_| {
            let (y, x, radius) = (unit() * size.0 as f32, unit() * size.1 as f32, 4.0 + 12.0 * unit());
            Array3::from_shape_fn(size, |(row, column, channel)| {
                let near = (row as f32 - y).hypot(column as f32 - x) < radius;
                unit() - 0.4 + if near { 20.0 * unit() + channel as f32 } else { 0.0 }
            })
        })
        .collect()
}

fn assert_near(image: &Array3<f32>, expected: &Array3<f64>, tolerance: f64) {
    assert_eq!(image.dim(), expected.dim());
    Zip::indexed(image).and(expected).for_each(|at, &value, &expected| {
        assert!(
            (f64::from(value) - expected).abs() <= tolerance * (1.0 + expected.abs()),
            "{at:?}: {value} {expected}"
        );
    });
}

fn sum(images: &[Array3<f64>]) -> Array3<f64> {
    images.iter().fold(Array3::zeros(images[0].dim()), |sum, image| sum + image)
}

#[test]
fn relighting_is_the_weighted_sum_and_white_the_floodlit_one() {
    for channels in [1, 3] {
        let shape = FrameShape::new(70, 96, channels).unwrap();
        let batch = batch(shape, &random_images(shape, 12, 1), 0.61);
        let images = dense(&batch);
        assert_near(&floodlit(&batch), &sum(&images), 1e-6);

        let weights =
            Array2::from_shape_fn((12, 3), |(dot, colour)| (dot as f32 - 4.0) * 0.3 + colour as f32);
        let relit = relight(&batch, weights.view()).unwrap();
        let expected = images.iter().enumerate().fold(Array3::zeros((70, 96, 3)), |sum, (dot, image)| {
            sum + Array3::from_shape_fn((70, 96, 3), |(row, column, colour)| {
                image[[row, column, colour.min(channels - 1)]] * f64::from(weights[[dot, colour]])
            })
        });
        assert_near(&relit, &expected, 1e-6);
        let double = relight(&batch, (&weights * 2.0).view()).unwrap();
        assert_eq!(double, relit * 2.0);
        let refused = relight(&batch, Array2::zeros((11, 3)).view()).unwrap_err();
        assert!(matches!(refused, DotsError::Shape { array: "weights", .. }));
    }
}

#[test]
fn patterns_are_looked_up_at_the_centroids() {
    let shape = FrameShape::new(96, 96, 1).unwrap();
    let batch = batch(shape, &random_images(shape, 12, 2), 0.61);
    let centroids = Centroids::new(&batch, &Footprints::new(&batch, 0.3).unwrap()).unwrap();
    // Interpolation reproduces a linear function of position and colour, whatever the size of the pattern.
    for size in [96, 24] {
        let scale = 96.0 / size as f32;
        let plane = Array3::from_shape_fn((size, size, 3), |(row, column, colour)| {
            let (y, x) = ((row as f32 + 0.5) * scale - 0.5, (column as f32 + 0.5) * scale - 0.5);
            0.01 * x + 0.02 * y + colour as f32
        });
        let weights = pattern_weights(&centroids, plane.view()).unwrap();
        for (xy, weights) in centroids.xy.iter().zip(weights.rows()) {
            let [x, y] = xy.unwrap();
            // Away from the border, where the nearest pixel is repeated.
            if [x, y].iter().all(|at| (8.0..88.0).contains(at)) {
                let expected = (0.01 * x + 0.02 * y) as f32;
                (0..3).for_each(|colour| assert!((weights[colour] - expected - colour as f32).abs() < 1e-5));
            }
        }
    }
    let white = Array3::<f32>::ones((10, 14, 3));
    let dark = Array3::<f32>::zeros((10, 14, 3));
    let film: Vec<_> =
        relight_sequence(&batch, &centroids, [white.view(), dark.view()]).map(Result::unwrap).collect();
    let light = floodlit(&batch).mapv(f64::from);
    assert_near(&film[0].slice(s![.., .., ..1]).to_owned(), &light, 1e-5);
    assert!(film[1].iter().all(|&value| value == 0.0));
}

#[test]
fn shadow_dots_are_the_extremes_over_images_with_one_dot_missing() {
    for channels in [1, 3] {
        let shape = FrameShape::new(40, 64, channels).unwrap();
        let batch = batch(shape, &random_images(shape, 9, 3), 0.61);
        let light = sum(&dense(&batch));
        let (mut largest, mut least) = (light.mapv(|_| f64::NEG_INFINITY), light.mapv(|_| f64::INFINITY));
        for dot in 0..9 {
            let mut without = light.clone();
            for (pixel, value) in batch.column(dot).pixels() {
                (0..channels).for_each(|channel| {
                    without[[pixel / 64, pixel % 64, channel]] -= f64::from(value[channel])
                });
            }
            largest.zip_mut_with(&without, |most, &value| *most = most.max(value));
            least.zip_mut_with(&without, |least, &value| *least = least.min(value));
        }
        let Separation { direct, global } = shadow_dot(&batch, &floodlit(&batch)).unwrap();
        assert_near(&direct, &(&largest - &least), 1e-5);
        assert_near(&global, &(&least * 9.0 / 8.0), 1e-5);
    }
}

#[test]
fn confusion_is_the_dense_popcount() {
    let shape = FrameShape::new(70, 96, 1).unwrap();
    let batch = batch(shape, &random_images(shape, 30, 4), 0.61);
    let footprints = Footprints::new(&batch, 0.4).unwrap();
    let confusion = Confusion::new(&footprints);
    let binary: Vec<Vec<bool>> = (0..30)
        .map(|dot| {
            let peak = batch.column(dot).pixels().map(|(_, value)| value[0]).fold(0.0, f32::max);
            let mut binary = vec![false; shape.pixels()];
            batch.column(dot).pixels().for_each(|(pixel, value)| binary[pixel] = value[0] >= 0.4 * peak);
            binary
        })
        .collect();
    let mut overlapping = 0;
    for (i, one) in binary.iter().enumerate() {
        for (j, other) in binary.iter().enumerate() {
            let expected = one.iter().zip(other).filter(|(one, other)| **one && **other).count() as u32;
            assert_eq!(confusion.overlap_px(i, j), expected, "{i} {j}");
            assert_eq!(confusion.neighbours(i).contains(&(j as u32)), expected > 0);
            overlapping += u32::from(i != j && expected > 0);
        }
    }
    assert!(overlapping > 20);
}

/// A scan of round overlapping dots, 8 pixels apart with radius 8, over frames of 160 x 160; shifted by `shift_px`
/// where the scene lies off the plane. Direct light is `albedo` times the dot, global light a share of all dots'
/// light.
struct Scan {
    shape: FrameShape,
    images: Vec<Array3<f32>>,
    direct: Array3<f64>,
    centres: Vec<[f64; 2]>,
}

fn scan(shift_px: impl Fn(f64) -> f64, global: f64) -> Scan {
    let shape = FrameShape::new(160, 160, 1).unwrap();
    let centres: Vec<[f64; 2]> =
        (0..256).map(|dot| [20.0 + 8.0 * (dot % 16) as f64, 20.0 + 8.0 * (dot / 16) as f64]).collect();
    let mut direct = Array3::zeros((160, 160, 1));
    let images = centres.iter().map(|[x, y]| {
        let x = x + shift_px(*x);
        Array3::from_shape_fn((160, 160, 1), |(row, column, channel)| {
            let distance = (row as f64 - y).hypot(column as f64 - x) / 8.0;
            let light = 1000.0 * (1.0 - distance.powi(4)).max(0.0);
            direct[[row, column, channel]] += light;
            (light + global) as f32
        })
    });
    let images = images.collect();
    Scan { shape, images, direct, centres }
}

/// The region where direct light is most of a dot's light, away from the rim of the scan.
fn middle(image: &Array3<f64>) -> f64 {
    image.slice(s![40..120, 40..120, ..]).sum()
}

#[test]
fn neighbours_give_the_direct_light_of_overlapping_dots_on_and_off_the_plane() {
    let plane = scan(|_| 0.0, 0.0);
    let footprints = Footprints::new(&batch(plane.shape, &plane.images, 1.0), 0.01).unwrap();
    let confusion = Confusion::new(&footprints);
    // A groove: dots land up to 12 pixels from their position on the plane.
    for scan in [scan(|_| 0.0, 2.0), scan(|x| 12.0 - 0.2 * (x - 80.0).abs(), 2.0)] {
        let batch = batch(scan.shape, &scan.images, 3.0);
        let of_truth =
            |separation: &Separation| middle(&separation.direct.mapv(f64::from)) / middle(&scan.direct);
        let naive = of_truth(&shadow_dot(&batch, &floodlit(&batch)).unwrap());
        let separation = shadow_neighbours(&batch, &floodlit(&batch), &confusion).unwrap();
        assert!((0.25..0.6).contains(&naive), "naive: {naive}");
        assert!((of_truth(&separation) - 1.0).abs() < 0.02, "{}", of_truth(&separation));
        let global = middle(&separation.global.mapv(f64::from)) / (6400.0 * 256.0 * 2.0);
        assert!((global - 1.0).abs() < 0.01, "{global}");
        assert_near(&(&separation.direct + &separation.global), &sum(&dense(&batch)), 1e-5);
    }
}

/// A mirror to the left of the camera: epipolar lines are rows.
fn level_lines() -> Fundamental {
    // l = F' m = (0, 1, -m_y) for m = (x, y).
    Fundamental::from_rows([[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])
}

#[test]
fn masks_split_the_floodlit_image_as_dense_masks_do() {
    let shape = FrameShape::new(70, 96, 1).unwrap();
    // Without any residual, whose light has no position within its block, every pixel is exact.
    let bright = |image: &Array3<f32>| image.mapv(|light| if light > 0.61 { light } else { 0.0 });
    let images: Vec<_> = random_images(shape, 6, 5).iter().map(bright).collect();
    let batch = batch(shape, &images, 0.61);
    let fundamental = level_lines();
    let mirror: Vec<_> = (0..6).map(|dot| (dot > 0).then_some([0.0, 10.0 * dot as f64])).collect();
    for rule in [MaskRule::Plateau, MaskRule::Printed] {
        for sigma_px in [0.0, 40.0] {
            // Distances refer to frames 1024 pixels wide; here they are 8 and 3.75 pixels.
            let mask = EpipolarMask { distance_px: 8.0 * 1024.0 / 96.0, sigma_px, rule };
            let separation = epipolar(&batch, &floodlit(&batch), &fundamental, &mirror, &mask).unwrap();
            let sigma = sigma_px * 96.0 / 1024.0;
            let weight = |distance: f64| {
                let gaussian =
                    |d: f64| if sigma > 0.0 { (-d * d / (2.0 * sigma * sigma)).exp() } else { 0.0 };
                match rule {
                    MaskRule::Plateau => {
                        if distance <= 8.0 {
                            1.0
                        } else {
                            gaussian(distance - 8.0)
                        }
                    }
                    MaskRule::Printed => match distance <= 8.0 {
                        true if sigma == 0.0 => 1.0,
                        true => gaussian(distance),
                        false => 0.0,
                    },
                }
            };
            let mut direct = Array3::<f64>::zeros((70, 96, 1));
            for dot in 1..6 {
                let line = 10.0 * dot as f64;
                for (pixel, value) in batch.column(dot).pixels() {
                    direct[[pixel / 96, pixel % 96, 0]] +=
                        weight(((pixel / 96) as f64 - line).abs()) * f64::from(value[0]);
                }
            }
            Zip::from(&separation.direct).and(&direct).for_each(|&value, &expected| {
                assert!((f64::from(value) - expected).abs() <= 1e-4, "{value} {expected}");
            });
            assert_near(&(&separation.direct + &separation.global), &sum(&dense(&batch)), 1e-5);
        }
    }
}

#[test]
fn a_residual_is_direct_as_far_as_the_mask_covers_its_blocks() {
    let lines = [(0.5, -0.8, 20.0), (-0.6, -0.9, 150.0), (1.0, 0.02, -90.0), (0.0, 1.0, -60.0)];
    for ((x, y, through), side) in lines.into_iter().flat_map(|line| [4, 8, 32].map(|side| (line, side))) {
        let shape = FrameShape::new(160, 192, 1).unwrap().with_block_px(side).unwrap();
        let even = Array3::from_elem((160, 192, 1), 1.0);
        // All light is residual.
        let batch = batch(shape, &[even.clone(), even], 2.0);
        let line = |dot: f64| [x, y, through + 40.0 * dot];
        // m = (dot, 0) selects the line.
        let fundamental = Fundamental::from_rows([[0.0, 0.0, 40.0], [0.0; 3], line(0.0)]);
        let mirror = [Some([0.0, 0.0]), Some([1.0, 0.0])];
        let (distance, sigma) = (12.0, 4.0);
        let scale = 1024.0 / 192.0;
        let mask =
            EpipolarMask { distance_px: distance * scale, sigma_px: sigma * scale, rule: MaskRule::Plateau };
        let direct = epipolar(&batch, &floodlit(&batch), &fundamental, &mirror, &mask).unwrap().direct;
        for (block, value) in direct.exact_chunks((side, side, 1)).into_iter().enumerate() {
            let share = |line: [f64; 3]| {
                let weight = |pixel: usize| {
                    let (down, right) = (block / shape.block_columns(), block % shape.block_columns());
                    let (row, column) = (down * side + pixel / side, right * side + pixel % side);
                    let length = line[0].hypot(line[1]);
                    let away =
                        (line[0] * column as f64 + line[1] * row as f64 + line[2]).abs() / length - distance;
                    if away <= 0.0 { 1.0 } else { (-0.5 * (away / sigma).powi(2)).exp() }
                };
                (0..side * side).map(weight).sum::<f64>() / (side * side) as f64
            };
            let expected = share(line(0.0)) + share(line(1.0));
            let value = f64::from(value[[side / 2, side / 3, 0]]);
            assert!((value - expected).abs() < 0.05, "block {block}: {value} {expected}");
        }
    }
}

#[test]
fn a_mask_of_the_dots_own_width_keeps_the_planes_light_and_the_printed_one_a_fifth() {
    let plane = scan(|_| 0.0, 0.0);
    let batch = batch(plane.shape, &plane.images, 3.0);
    let fundamental = level_lines();
    let mirror: Vec<_> = plane.centres.iter().map(|&centre| Some(centre)).collect();
    let share = |rule| {
        // The paper's d_thresh and sigma for its dots, which have a radius of 16 pixels of 1024; here 8 of 160.
        let scale = 8.0 * 1024.0 / 160.0 / 16.0;
        let mask = EpipolarMask { distance_px: 19.0 * scale, sigma_px: 2.0 * scale, rule };
        let separation = epipolar(&batch, &floodlit(&batch), &fundamental, &mirror, &mask).unwrap();
        f64::from(separation.direct.sum()) / plane.direct.sum()
    };
    assert!(share(MaskRule::Plateau) >= 0.98, "{}", share(MaskRule::Plateau));
    assert!((share(MaskRule::Printed) - 0.2).abs() < 0.05, "{}", share(MaskRule::Printed));
    let radius_px = PointSpreads::new(&batch, &centroids_of(&batch)).unwrap().radius_px().unwrap();
    assert!((7.5..=9.5).contains(&radius_px), "{radius_px}");
}

#[test]
fn overlapping_dots_are_compensated_by_their_spreads() {
    let plane = scan(|_| 0.0, 0.0);
    let batch = batch(plane.shape, &plane.images, 3.0);
    let spreads = PointSpreads::new(&batch, &centroids_of(&batch)).unwrap();
    assert!(spreads.unimodal.iter().all(|&unimodal| unimodal));
    let light = floodlit(&batch);
    let even = compensate(&light, &coverage(&spreads)).unwrap();
    let ripple = |image: &Array3<f32>| {
        let middle = image.slice(s![40..120, 40..120, 0]);
        middle.std(0.0) / middle.mean().unwrap()
    };
    assert!(ripple(&light) > 0.05, "{}", ripple(&light));
    assert!(ripple(&even) < 0.01, "{}", ripple(&even));
}

#[test]
fn a_dot_on_a_boundary_of_textures_is_taken_for_a_pillbox() {
    let mut plane = scan(|_| 0.0, 0.0);
    // A black line through the first dot; the remaining light there is still in the mask.
    plane.images[0].slice_mut(s![12..29, 19..22, ..]).fill(5.0);
    let two = batch(plane.shape, &plane.images[..2], 3.0);
    let spreads = PointSpreads::new(&two, &centroids_of(&two)).unwrap();
    assert_eq!(spreads.unimodal, [false, true]);
    assert!(spreads.columns.column(0).pixels().all(|(_, value)| value == [1.0]));
}

#[test]
fn centroids_are_the_dots_centres_and_drift_is_their_shift() {
    let at = |right: f64| scan(|_| right, 0.0);
    let centroids = |scan: &Scan| {
        let batch = batch(scan.shape, &scan.images, 3.0);
        Centroids::new(&batch, &Footprints::new(&batch, 0.5).unwrap()).unwrap()
    };
    let (plane, later) = (at(0.0), at(1.5));
    for (xy, centre) in centroids(&plane).xy.iter().zip(&plane.centres) {
        let [x, y] = xy.unwrap();
        assert!((x - centre[0]).abs() < 0.05 && (y - centre[1]).abs() < 0.05);
    }
    let drift = centroids(&later).drift_from(&centroids(&plane)).unwrap();
    assert!(
        (drift.right_px - 1.5).abs() < 0.05 && drift.down_px.abs() < 0.05 && drift.rms_px < 0.1,
        "{drift:?}"
    );
    assert_eq!(drift.dots, 256);

    let dark = batch(plane.shape, &vec![Array3::zeros((160, 160, 1)); 256], 3.0);
    let unseen = Centroids::new(&dark, &Footprints::new(&dark, 0.5).unwrap()).unwrap();
    assert!(unseen.xy.iter().all(Option::is_none));
    assert!(matches!(unseen.drift_from(&unseen), Err(DotsError::TooFew { .. })));
}

#[test]
fn the_plane_is_its_own_dual_and_samples_stay() {
    let plane = scan(|_| 0.0, 1.0);
    let batch = batch(plane.shape, &plane.images, 3.0);
    let centroids = Centroids::new(&batch, &Footprints::new(&batch, 0.5).unwrap()).unwrap();
    let energies = column_energies(&batch);
    for (energy, image) in energies.iter().zip(dense(&batch)) {
        assert!((energy / image.sum() - 1.0).abs() < 1e-6);
    }
    let whole = dual(&batch, &centroids, &energies, (160, 160)).unwrap();
    assert!(whole.image.iter().all(|&value| (value - 1.0).abs() < 1e-6));
    assert_eq!(whole.known.iter().filter(|&&known| known).count(), 256);

    // A dot on a dark patch is dark in the dual, and only there and in its surroundings.
    let half: Vec<f64> = energies
        .iter()
        .enumerate()
        .map(|(dot, energy)| if dot == 100 { 2.0 * energy } else { *energy })
        .collect();
    let patched = dual(&batch, &centroids, &half, (160, 160)).unwrap();
    let [x, y] = centroids.xy[100].unwrap().map(|at| at.round() as usize);
    assert!((patched.image[[y, x, 0]] - 0.5).abs() < 1e-6 && patched.known[[y, x]]);
    assert!((patched.image[[y + 20, x, 0]] - 1.0).abs() < 1e-6);
}

#[test]
fn holes_are_filled_from_what_is_known_and_nothing_ends_as_nothing() {
    let mut image =
        Array3::from_shape_fn((20, 30, 2), |(row, column, channel)| (row + column * channel) as f32);
    let original = image.clone();
    let known = Array2::from_shape_fn((20, 30), |(row, column)| row % 7 == 0 && column % 5 == 2);
    Zip::from(image.lanes_mut(Axis(2))).and(&known).for_each(|mut pixel, &known| {
        if !known {
            pixel.fill(f32::NAN);
        }
    });
    fill_holes(&mut image, &known);
    assert!(image.iter().all(|value| value.is_finite()));
    Zip::from(image.lanes(Axis(2))).and(original.lanes(Axis(2))).and(&known).for_each(|now, then, &known| {
        assert!(!known || now == then);
    });
    // As if each step processed the whole image.
    let mut plain = original.clone();
    let mut filled = known.clone();
    while filled.iter().any(|&filled| !filled) {
        let (before, was_filled) = (plain.clone(), filled.clone());
        for (row, column) in (0..20_usize).flat_map(|row| (0..30_usize).map(move |column| (row, column))) {
            let near = [(0, 1), (2, 1), (1, 0), (1, 2)].map(|(down, right)| (row + down, column + right));
            let near = near
                .into_iter()
                .filter_map(|(row, column)| Some((row.checked_sub(1)?, column.checked_sub(1)?)));
            let near: Vec<_> = near.filter(|&at| was_filled.get(at) == Some(&true)).collect();
            if !was_filled[[row, column]] && !near.is_empty() {
                filled[[row, column]] = true;
                for channel in 0..2 {
                    let sum: f32 = near.iter().map(|&(row, column)| before[[row, column, channel]]).sum();
                    plain[[row, column, channel]] = sum / near.len() as f32;
                }
            }
        }
    }
    assert!(Zip::from(&image).and(&plain).all(|filled, plain| (filled - plain).abs() < 1e-4));

    let mut nothing = Array3::zeros((5, 5, 1));
    fill_holes(&mut nothing, &Array2::from_elem((5, 5), false));
    assert!(nothing.iter().all(|&value| value == 0.0));
    let shape = FrameShape::new(32, 32, 1).unwrap();
    let empty = Batch::new(shape, BatchArrays::default()).unwrap();
    let centroids = Centroids::new(&empty, &Footprints::new(&empty, 0.5).unwrap()).unwrap();
    let image = dual(&empty, &centroids, &[], (8, 8)).unwrap();
    assert!(image.image.iter().all(|&value| value == 0.0) && image.known.iter().all(|&known| !known));
}

#[test]
fn two_scanned_planes_calibrate_the_lines_of_a_third() {
    // The mirror's rays meet planes at different positions; the nearer the plane, the farther apart.
    let plane = |shift: f64| {
        let scan = scan(|_| shift, 0.0);
        let batch = batch(scan.shape, &scan.images, 3.0);
        Centroids::new(&batch, &Footprints::new(&batch, 0.5).unwrap()).unwrap()
    };
    let first = plane(0.0).xy;
    let fit = Fundamental::from_planes(&first, &plane(12.0).xy).unwrap();
    for third in [-6.0, 6.0].map(plane) {
        for (place, [x, y]) in first.iter().zip(third.xy).filter_map(|(place, at)| Some(((*place)?, at?))) {
            let [l1, l2, l3] = fit.fundamental.epipolar_line(place);
            let distance = (l1 * x + l2 * y + l3).abs() / l1.hypot(l2);
            assert!(distance < 0.3, "{distance}");
        }
    }
    assert!(matches!(Fundamental::from_planes(&first, &first), Err(DotsError::Planar { .. })));
}

#[test]
fn products_are_the_same_for_any_number_of_threads() {
    let shape = FrameShape::new(150, 96, 3).unwrap();
    let batch = batch(shape, &random_images(shape, 20, 6), 0.61);
    let fundamental = level_lines();
    let all = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let confusion = Confusion::new(&Footprints::new(&batch, 0.7).unwrap());
            let mirror = vec![Some([0.0, 30.0]); 20];
            let mask = EpipolarMask { distance_px: 100.0, sigma_px: 10.0, rule: MaskRule::Plateau };
            let separations = [
                shadow_dot(&batch, &floodlit(&batch)).unwrap(),
                shadow_neighbours(&batch, &floodlit(&batch), &confusion).unwrap(),
                epipolar(&batch, &floodlit(&batch), &fundamental, &mirror, &mask).unwrap(),
            ];
            (floodlit(&batch), confusion, separations)
        })
    };
    assert_eq!(all(1), all(3));
}

#[test]
fn the_light_of_a_column_is_that_of_its_image_in_a_cut_last_row_of_blocks_too() {
    for (channels, side) in [(1, 4), (3, 4), (1, 16), (3, 32)] {
        let shape = FrameShape::new(75, 64, channels).unwrap().with_block_px(side).unwrap();
        let images = random_images(shape, 4, 5);
        let energies = column_energies(&batch(shape, &images, 0.61));
        for (energy, image) in energies.iter().zip(&images) {
            let expected = image.mapv(f64::from).sum() / channels as f64;
            assert!((energy / expected - 1.0).abs() < 1e-5, "{energy} {expected}");
        }
    }
}

#[test]
fn damaged_columns_are_refused() {
    let shape = FrameShape::new(64, 64, 1).unwrap();
    let sound = batch(shape, &random_images(shape, 3, 7), 0.61).arrays().clone();
    let refused = |damage: &dyn Fn(&mut BatchArrays)| {
        let mut arrays = sound.clone();
        damage(&mut arrays);
        Batch::new(shape, arrays).unwrap_err()
    };
    assert!(Batch::new(shape, sound.clone()).is_ok());
    assert!(matches!(refused(&|arrays| arrays.masks[5] = 0), DotsError::Damaged { index: 5, .. }));
    assert!(matches!(refused(&|arrays| arrays.words.swap(0, 1)), DotsError::Damaged { .. }));
    assert!(matches!(refused(&|arrays| *arrays.words.last_mut().unwrap() = 128), DotsError::Damaged { .. }));
    assert!(matches!(refused(&|arrays| arrays.word_offsets.swap(1, 2)), DotsError::Damaged { .. }));
    assert!(matches!(
        refused(&|arrays| {
            arrays.values.pop();
        }),
        DotsError::Shape { array: "values", .. }
    ));
    assert!(matches!(
        refused(&|arrays| {
            arrays.residual.pop();
        }),
        DotsError::Shape { .. }
    ));
    assert!(matches!(
        refused(&|arrays| {
            arrays.capped.pop();
        }),
        DotsError::Shape { .. }
    ));
}
