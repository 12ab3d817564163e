//! Direct and global light from checkerboards that are drawn pixel by pixel, blurred numerically, and seen with noise.

#![allow(clippy::unwrap_used)] // helpers outside #[test] functions are tests too

use ndarray::Array2;
use rand_distr::{Distribution, Normal, Uniform};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;
use raysweep_core::Pattern;
use raysweep_transport::plane::separation::{CheckerboardSums, SeparatedSettings, separate};

const SIDE: usize = 48;
/// Pixels of the projector that a camera pixel sees, and the first one.
const SEEN: (usize, usize) = (3, 60);
const PICTURE: (usize, usize) = (400, 400);

/// A scene of camera pixels that each see a few pixels of the projector.
struct Scene {
    direct: Array2<f64>,
    /// Light that all pixels of the projector send alike.
    global: Array2<f64>,
    /// Light that comes back around the place: its share, and the length over which it decays, in projector rows.
    scattered: Array2<f64>,
    length_px: f64,
    /// Light of the projector's black.
    black: f64,
    /// Width of the box that blurs the picture along rows and columns.
    blur_px: usize,
}

impl Scene {
    fn new(seed: u64) -> Self {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
        let mut map = |from: f64, to: f64| {
            let light = Uniform::new(from, to).unwrap();
            Array2::from_shape_simple_fn((SIDE, SIDE), || light.sample(&mut random))
        };
        let (direct, global) = (map(0.2, 1.0), map(0.0, 0.8));
        let scattered = Array2::zeros((SIDE, SIDE));
        Self { direct, global, scattered, length_px: 5.0, black: 0.0, blur_px: 1 }
    }

    /// The image under a pattern, without noise.
    fn image(&self, pattern: &Pattern) -> Array2<f64> {
        let weights = pattern.pixel_weights(PICTURE).unwrap().unwrap();
        let lit =
            |x: usize, y: usize| f64::from(weights[y * PICTURE.0 + x]) * (1.0 - self.black) + self.black;
        let mean_of_all = weights.iter().map(|&weight| f64::from(weight)).sum::<f64>() / weights.len() as f64;
        let all =
            self.black + (1.0 - self.black) * if (mean_of_all - 0.5).abs() < 0.1 { 0.5 } else { mean_of_all };
        Array2::from_shape_fn((SIDE, SIDE), |(t, s)| {
            let place = |at: usize| SEEN.1 + SEEN.0 * at;
            let reach = self.blur_px / 2;
            let over = |x0: usize, y0: usize, width: usize, height: usize| {
                let pixels = (y0..y0 + height).flat_map(|y| (x0..x0 + width).map(move |x| (x, y)));
                pixels.map(|(x, y)| lit(x, y)).sum::<f64>() / (width * height) as f64
            };
            let side = SEEN.0 + 2 * reach;
            let own = over(place(s) - reach, place(t) - reach, side, side);
            let around = (self.scattered[[t, s]] > 0.0).then(|| {
                let (mut sum, mut total) = (0.0, 0.0);
                for away in -50_i32..=50 {
                    let weight = (-f64::from(away.abs()) / self.length_px).exp();
                    let y = (place(t) + 1).checked_add_signed(away as isize).unwrap();
                    sum += weight * lit(place(s) + 1, y);
                    total += weight;
                }
                sum / total
            });
            self.direct[[t, s]] * own
                + self.global[[t, s]] * all
                + self.scattered[[t, s]] * around.unwrap_or(0.0)
        })
    }

    /// Separates what a camera with this noise sees.
    fn separated(
        &self,
        (size_px, shifts): (u32, u32),
        noise: f64,
        seed: u64,
    ) -> (SeparatedSettings, [Array2<f64>; 2]) {
        let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
        let noise = Normal::new(0.0, noise).unwrap();
        let mut sums = CheckerboardSums::new(size_px, (SIDE, SIDE));
        let mut extremes =
            [f64::INFINITY, f64::NEG_INFINITY].map(|start| Array2::from_elem((SIDE, SIDE), start));
        for pattern in Pattern::shifted_checkerboards(size_px, shifts).unwrap() {
            let Pattern::Checkerboard { shift_px, .. } = pattern else { panic!("{pattern:?}") };
            let image = self.image(&pattern).mapv(|light| light + noise.sample(&mut random));
            extremes[0].zip_mut_with(&image, |least, &light| *least = least.min(light));
            extremes[1].zip_mut_with(&image, |most, &light| *most = most.max(light));
            sums.add(shift_px, image.mapv(|light| light as f32).view()).unwrap();
        }
        (separate(&[sums], self.black, f64::INFINITY).unwrap(), extremes)
    }
}

fn mean_of(found: &Array2<f32>, truth: &Array2<f64>) -> f64 {
    found.iter().zip(truth).map(|(&found, truth)| f64::from(found) - truth).sum::<f64>() / truth.len() as f64
}

fn largest(found: &Array2<f32>, truth: &Array2<f64>) -> f64 {
    found.iter().zip(truth).map(|(&found, truth)| (f64::from(found) - truth).abs()).fold(0.0, f64::max)
}

#[test]
fn without_noise_direct_and_global_light_are_those_of_the_scene() {
    for (size, black, blur_px) in [
        ((24, 128), 0.0, 1),
        ((24, 128), 0.1, 1),
        ((24, 288), 0.0, 9),
        ((16, 128), 0.05, 5),
        ((24, 32), 0.0, 5),
    ] {
        let scene = Scene { black, blur_px, ..Scene::new(3) };
        let (found, _) = scene.separated(size, 1e-9, 1);
        let light = &found.settings[0];
        let (direct, global) = (largest(&light.direct, &scene.direct), largest(&light.global, &scene.global));
        assert!(direct < 0.03, "{size:?}, black {black}, blur {blur_px}: direct light off by {direct}");
        assert!(global < 0.03, "{size:?}, black {black}, blur {blur_px}: global light off by {global}");
        // A camera pixel and the blur, as a box.
        let blur = found.blur_px.unwrap().map(|px| (px - (SEEN.0 + blur_px - 1) as f64).abs());
        assert!(blur.iter().all(|error| *error < 3.5), "blur off by {blur:?}");
        assert!(found.is_spread.iter().all(|marked| !marked), "nothing spreads in this scene");
    }
}

#[test]
fn noise_has_no_share_in_direct_light_and_errors_are_as_stated() {
    const NOISE: f64 = 0.02;
    let (direct, global) = (Array2::from_elem((SIDE, SIDE), 0.3), Array2::from_elem((SIDE, SIDE), 0.1));
    let scene = Scene { direct, global, ..Scene::new(3) };
    let (clean, _) = scene.separated((24, 128), 1e-9, 1);
    let (noisy, [least, most]) = scene.separated((24, 128), NOISE, 2);
    let (clean, noisy) = (&clean.settings[0], &noisy.settings[0]);
    let clean_direct = clean.direct.mapv(f64::from);
    let bias = mean_of(&noisy.direct, &clean_direct);
    assert!(bias.abs() < 0.2 * NOISE, "{} standard deviations", bias / NOISE);
    let plain = (&most - &least).mean().unwrap() - 0.3;
    assert!(plain > 2.0 * NOISE, "the plain difference of extremes is off by {} only", plain / NOISE);
    for (what, found, sd, truth) in [
        ("direct", &noisy.direct, &noisy.direct_sd, clean_direct),
        ("global", &noisy.global, &noisy.global_sd, clean.global.mapv(f64::from)),
    ] {
        let errors =
            found.iter().zip(sd).zip(&truth).map(|((&found, &sd), truth)| (f64::from(found) - truth, sd));
        let covered = errors.filter(|(error, sd)| error.abs() < f64::from(*sd)).count() as f64;
        let covered = covered / truth.len() as f64;
        assert!((0.63..0.73).contains(&covered), "{what}: one sd covers {covered}");
    }
    // Where there is no light, little is found.
    let dark = Scene { direct: Array2::zeros((SIDE, SIDE)), global: Array2::zeros((SIDE, SIDE)), ..scene };
    let (found, _) = dark.separated((24, 128), NOISE, 3);
    let bias = found.settings[0].direct.mapv(f64::from).mean().unwrap();
    assert!(bias.abs() < 0.3 * NOISE, "{} standard deviations in the dark", bias / NOISE);
    assert!(found.blur_px.is_none(), "nothing is seen of the board");
}

#[test]
fn light_that_spreads_within_a_square_is_marked_and_smaller_squares_tell_it_apart() {
    let mut scene = Scene { global: Array2::zeros((SIDE, SIDE)), ..Scene::new(5) };
    // Below is an opaque wall, above a translucent body, which reflects nothing directly.
    for ((t, s), scattered) in scene.scattered.indexed_iter_mut() {
        if t < SIDE / 2 {
            *scattered = std::mem::take(&mut scene.direct[[t, s]]);
        }
    }
    let left = |size| {
        let (found, _) = scene.separated(size, 1e-3, 1);
        let direct = found.settings[0].direct.mapv(f64::from);
        let translucent = ndarray::s![4..SIDE / 2 - 4, ..];
        let marked = |rows| found.is_spread.slice(rows).iter().filter(|marked| **marked).count() as f64;
        let [body, wall] = [translucent, ndarray::s![SIDE / 2 + 4..SIDE - 4, ..]].map(marked);
        let share = direct.slice(translucent).sum() / scene.scattered.slice(translucent).sum();
        let pixels = ((SIDE / 2 - 8) * SIDE) as f64;
        let mut lengths: Vec<f32> = found.spread_px.slice(translucent).iter().copied().collect();
        lengths.sort_by(f32::total_cmp);
        (share, body / pixels, wall / pixels, lengths[lengths.len() / 2])
    };
    let (large, body, wall, length_px) = left((24, 128));
    // 1 / (1 + w^2) with w = pi 5 / 24.
    assert!((large - 0.70).abs() < 0.05, "{large} of light over 5 rows is taken for direct");
    assert!(body > 0.95 && wall < 0.01, "{body} of the body and {wall} of the wall are marked");
    assert!((length_px - 5.0).abs() < 1.5, "light seems to spread over {length_px} pixels");
    let (small, ..) = left((8, 128));
    assert!(small < 0.3, "{small} with small squares");
}

#[test]
fn what_does_not_belong_together_is_refused() {
    let sums = |size_px, side: usize, images| {
        let mut sums = CheckerboardSums::new(size_px, (side, side));
        for _ in 0..images {
            sums.add((0, 0), Array2::zeros((side, side)).view()).unwrap();
        }
        sums
    };
    let refused =
        |settings: &[CheckerboardSums], black, dark| separate(settings, black, dark).unwrap_err().to_string();
    assert!(refused(&[], 0.0, 1.0).contains("images"));
    assert!(refused(&[sums(8, 4, 0)], 0.0, 1.0).contains("images"));
    assert!(refused(&[sums(8, 4, 2), sums(8, 5, 2)], 0.0, 1.0).contains("setting has shape"));
    assert!(refused(&[sums(8, 4, 2), sums(8, 4, 3)], 0.0, 1.0).contains("the same for all settings"));
    assert!(refused(&[sums(8, 4, 2)], 1.0, 1.0).contains("black"));
    assert!(refused(&[sums(8, 4, 2)], f64::NAN, 1.0).contains("black"));
    assert!(refused(&[sums(8, 4, 2)], 0.0, 0.0).contains("dark_images"));
    let mut board = CheckerboardSums::new(8, (4, 4));
    assert!(
        board.add((0, 0), Array2::zeros((4, 5)).view()).unwrap_err().to_string().contains("image has shape")
    );
}
