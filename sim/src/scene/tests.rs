use super::*;
use ndarray::{Array1, Array5, array};
use ndarray_npy::NpzWriter;
use std::fs::File;
use texture::Dice;

const SMALL: SceneSize = SceneSize { rows: 36, columns: 33 };

fn scenes() -> impl Iterator<Item = (&'static str, Scene)> {
    BUILTIN_NAMES.into_iter().map(|name| (name, Scene::builtin(name, SMALL, 3).unwrap()))
}

fn random_pattern(rows: usize, columns: usize, seed: u64) -> Array2<f32> {
    let mut dice = Dice::new(seed);
    Array2::from_shape_fn((rows, columns), |_| dice.between(0.0, 1.0) as f32)
}

/// Largest difference relative to the largest value of `b`.
fn difference(a: &Array3<f32>, b: &Array3<f32>) -> f32 {
    let largest = b.fold(0.0_f32, |m, &v| m.max(v.abs()));
    (a - b).fold(0.0_f32, |m, &v| m.max(v.abs())) / largest
}

fn bits(values: impl IntoIterator<Item = f32>) -> Vec<u32> {
    values.into_iter().map(f32::to_bits).collect()
}

#[test]
fn light_is_finite_and_not_negative_at_any_size() {
    for (rows, columns) in [(16, 16), (17, 40), (60, 21), (64, 64)] {
        for name in BUILTIN_NAMES {
            let scene = Scene::builtin(name, SceneSize { rows, columns }, 7).unwrap();
            assert_eq!(scene.transport.dim(), (rows, rows, columns, 1));
            assert!(scene.transport.iter().all(|&value| value.is_finite() && value >= 0.0), "{name}");
            let flood = scene.transport.sum_axis(Axis(0));
            let brightest = flood.fold(0.0_f32, |a, &b| a.max(b));
            assert!((0.3..1.6).contains(&brightest), "{name} {rows}x{columns}: {brightest}");
            let columns = scene.projector_column.unwrap();
            assert!(columns.iter().all(|u| (0.0..=1.0).contains(u)), "{name}");
        }
    }
}

/// For every object, row transport and response to a pattern agree.
#[test]
fn a_row_rendered_alone_is_that_row_of_the_transport() {
    for name in BUILTIN_NAMES {
        let scene = Scene::builtin_rgb(name, SMALL, 3).unwrap();
        for row in [0, 7, 17, 18, 35] {
            let mut pattern = Array2::zeros((SMALL.rows, 5));
            pattern.row_mut(row).fill(1.0);
            let image = scene.render_columns(pattern.view()).unwrap();
            let expected = scene.transport.index_axis(Axis(0), row).to_owned();
            let off = difference(&image, &expected);
            assert!(off < 1e-5, "{name}, row {row}: {off}");
        }
    }
}

#[test]
fn rendering_is_linear() {
    for (name, scene) in scenes() {
        let window = scene.full_window();
        let [p, q] = [1, 2].map(|seed| random_pattern(SMALL.rows, 50, seed));
        let render = |pattern: &Array2<f32>| scene.render(pattern.view(), &window).unwrap();
        let together = render(&(&p * 0.5 + &q * 2.0));
        let off = difference(&together, &(render(&p) * 0.5 + render(&q) * 2.0));
        assert!(off < 1e-5, "{name}: {off}");
    }
}

/// The images under projector columns 0..k and k.. add up to the image under all columns.
#[test]
fn parts_of_the_columns_add_up() {
    for (name, scene) in scenes() {
        let window = scene.full_window();
        let left = Array2::from_shape_fn((SMALL.rows, 40), |(_, column)| f32::from(column < 17));
        let right = 1.0 - &left;
        let parts =
            scene.render(left.view(), &window).unwrap() + scene.render(right.view(), &window).unwrap();
        let white = scene.render(Array2::ones((SMALL.rows, 1)).view(), &window).unwrap();
        assert!(difference(&parts, &white) < 1e-5, "{name}");
        assert!(difference(&scene.render(left.view(), &window).unwrap(), &white) > 0.1, "{name}");
    }
}

/// A single projector column lights directly only the pixels assigned to that column.
#[test]
fn projector_columns_are_where_direct_light_comes_from() {
    let scene = Scene::builtin("v-groove", SceneSize { rows: 32, columns: 64 }, 1).unwrap();
    let columns = scene.projector_column.clone().unwrap();
    let lit = Array2::from_shape_fn((32, 4), |(row, column)| f32::from(row == 5 && column == 2));
    let image = scene.render(lit.view(), &scene.full_window()).unwrap();
    for s in 0..64 {
        let u = columns[[5, s]];
        if (0.52..0.73).contains(&u) {
            assert!(image[[5, s, 0]] > 0.5 * scene.transport[[5, 5, s, 0]], "{s}");
        } else if !(0.48..0.77).contains(&u) {
            assert!(image[[5, s, 0]] < 0.2 * scene.transport[[5, 5, s, 0]], "{s}");
        }
    }
}

#[test]
fn quarters_of_the_mix_have_their_own_half_of_the_projector() {
    let scene = Scene::builtin("mix", SMALL, 3).unwrap();
    let right = Array2::from_shape_fn((SMALL.rows, 2), |(_, column)| column as f32);
    let image = scene.render(right.view(), &scene.full_window()).unwrap();
    let half = SMALL.columns / 2;
    assert!(image.slice(s![.., ..half, ..]).iter().all(|&value| value == 0.0));
    let flood = scene.transport.sum_axis(Axis(0));
    let lit = flood.slice(s![.., half.., ..]).to_owned();
    assert!(difference(&image.slice(s![.., half.., ..]).to_owned(), &lit) < 1e-5);
}

#[test]
fn seeds_repeat_and_differ() {
    for name in BUILTIN_NAMES {
        let [a, b, c] = [5, 5, 6].map(|seed| Scene::builtin(name, SMALL, seed).unwrap().transport);
        assert!(a == b && a != c, "{name}");
    }
}

#[test]
fn bits_do_not_depend_on_the_threads() {
    let pattern = random_pattern(SMALL.rows, 50, 1);
    for name in BUILTIN_NAMES {
        let [one, two] = [1, 2].map(|threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
            pool.install(|| {
                let scene = Scene::builtin(name, SMALL, 2).unwrap();
                let image = scene.render(pattern.view(), &scene.full_window()).unwrap();
                (bits(scene.transport), bits(image))
            })
        });
        assert!(one == two, "{name}");
    }
}

/// Fractions of a pixel's light at u = 0 and at |u| > 2.
fn shares(scene: &Scene, row: usize, column: usize) -> (f32, f32) {
    let profile = scene.transport.slice(s![.., row, column, 0]);
    let total = profile.sum();
    let far =
        profile.iter().enumerate().filter(|(v, _)| v.abs_diff(row) > 2).map(|(_, value)| value).sum::<f32>();
    (profile[row] / total, far / total)
}

#[test]
fn pages_are_lit_by_their_own_row() {
    let size = SceneSize { rows: 96, columns: 96 };
    for (name, row, column) in
        [("v-groove", 4, 50), ("v-groove", 92, 20), ("mirror-ball", 90, 8), ("candle", 5, 60)]
    {
        let (direct, _) = shares(&Scene::builtin(name, size, 1).unwrap(), row, column);
        assert!(direct > 0.8, "{name} [{row}, {column}]: {direct}");
    }
}

#[test]
fn mirror_ball_has_pixels_with_two_peaks() {
    let scene = Scene::builtin("mirror-ball", SceneSize { rows: 96, columns: 96 }, 1).unwrap();
    let two_peaks = |row: usize, column: usize| {
        let profile = scene.transport.slice(s![.., row, column, 0]);
        let elsewhere = profile.iter().enumerate().any(|(v, &value)| v.abs_diff(row) > 4 && value > 0.1);
        profile[row] > 0.2 && elsewhere
    };
    let count = (0..96 * 96).filter(|k| two_peaks(k / 96, k % 96)).count();
    assert!(count > 40, "{count}");
}

/// The fraction of far light decreases with shorter mean free path and with absorption: skim milk scatters every
/// 0.8 mm, marble every 0.4 mm, whole milk every 0.3 mm; skin absorbs, and ketchup returns little but its surface
/// reflection.
#[test]
fn media_can_be_told_apart_by_their_profiles() {
    let scene = Scene::builtin("slab", SceneSize { rows: 96, columns: 128 }, 1).unwrap();
    let far = |name: &str| {
        let (_, columns) = slab_materials(128).into_iter().find(|(material, _)| *material == name).unwrap();
        shares(&scene, 48, (columns.start + columns.end) / 2).1
    };
    let order = ["skim milk", "marble", "whole milk", "skin1", "ketchup"].map(far);
    assert!(order.windows(2).all(|pair| pair[0] > 1.05 * pair[1]), "{order:?}");
    let candle = Scene::builtin("candle", SceneSize { rows: 96, columns: 128 }, 1).unwrap();
    assert!(shares(&candle, 60, 66).1 > 0.3);
}

/// A profile depends on the medium and the row pitch, not on how much of the frame the scene fills.
#[test]
fn slab_profiles_do_not_depend_on_the_scene_size() {
    let profile = |rows: usize, seed: u64| {
        let scene = Scene::builtin("slab", SceneSize { rows, columns: 64 }, seed).unwrap();
        let far = scene.transport.slice(s![rows / 2 - 8..rows / 2 + 8, rows / 2, 5, 0]).to_vec();
        let total: f32 = far.iter().sum();
        far.into_iter().map(|value| value / total).collect::<Array1<f32>>()
    };
    let off = (profile(32, 1) - profile(160, 1)).fold(0.0_f32, |m, v| m.max(v.abs()));
    // The uneven surface differs between sizes.
    assert!(off < 0.02, "{off}");
}

#[test]
fn window_is_a_part_of_the_image() {
    let window = Window { rows: 4..20, columns: 3..30 };
    for (name, scene) in scenes() {
        for columns in [1, 20] {
            let pattern = random_pattern(SMALL.rows, columns, 4);
            let all = scene.render(pattern.view(), &scene.full_window()).unwrap();
            let part = scene.render(pattern.view(), &window).unwrap();
            assert!(part == all.slice(s![4..20, 3..30, ..]), "{name}");
        }
    }
}

#[test]
fn the_smallest_and_odd_sizes_have_light() {
    for name in BUILTIN_NAMES {
        for (rows, columns) in [(8, 8), (8, 19), (17, 8), (13, 11)] {
            let scene = Scene::builtin(name, SceneSize { rows, columns }, 3).unwrap();
            assert!(scene.transport.sum() > 0.0, "{name} at {rows} x {columns}");
        }
    }
}

#[test]
fn unfit_requests_say_why() {
    let message = |error: SceneError| error.to_string();
    let unknown = message(Scene::builtin("teapot", SMALL, 0).unwrap_err());
    assert!(unknown.contains("\"teapot\"") && BUILTIN_NAMES.iter().all(|name| unknown.contains(name)));
    for (rows, columns) in [(0, 40), (40, 0), (7, 40), (4000, 4000), (usize::MAX, usize::MAX)] {
        let error = Scene::builtin("slab", SceneSize { rows, columns }, 0).unwrap_err();
        assert!(matches!(error, SceneError::Size { .. }) && message(error).contains(&rows.to_string()));
    }

    let scene = Scene::from_transport(Array4::ones((4, 4, 3, 1)), None).unwrap();
    let window = scene.full_window();
    let render = |pattern: Array2<f32>| scene.render(pattern.view(), &window);
    assert_eq!(render(array![[1.0, 1.0], [0.0, 0.0], [0.5, 0.5], [0.0, 0.0]]).unwrap()[[0, 0, 0]], 1.5);
    let changing = render(array![[1.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]]).unwrap_err();
    assert!(matches!(changing, SceneError::RowsOnly { columns: 2 }));
    let unfit = |pattern| matches!(render(pattern), Err(SceneError::Pattern { expected: 4, .. }));
    assert!(
        unfit(Array2::ones((5, 1)))
            && unfit(Array2::ones((4, 0)))
            && unfit(Array2::from_elem((4, 1), f32::NAN))
    );
    for window in [Window { rows: 0..5, columns: 0..1 }, Window { rows: 0..1, columns: 2..2 }] {
        let error = scene.render(Array2::ones((4, 1)).view(), &window).unwrap_err();
        assert!(matches!(error, SceneError::Window { height: 4, width: 3, .. }));
    }

    let lay = |transport, columns| Scene::from_transport(transport, columns).unwrap_err();
    assert!(matches!(lay(Array4::ones((4, 4, 3, 2)), None), SceneError::Layout { .. }));
    assert!(matches!(lay(Array4::ones((4, 0, 3, 1)), None), SceneError::Layout { .. }));
    assert!(matches!(
        lay(Array4::ones((4, 4, 3, 1)), Some(Array2::zeros((3, 4)))),
        SceneError::Layout { .. }
    ));
}

#[test]
fn scenes_survive_the_file() {
    let folder = tempfile::tempdir().unwrap();
    for (scene, name) in [
        (Scene::builtin("mix", SMALL, 1).unwrap(), "mono.npz"),
        (Scene::builtin_rgb("mix", SMALL, 1).unwrap(), "rgb.npz"),
        (Scene::from_transport(Array4::ones((4, 5, 3, 1)), None).unwrap(), "rows.npz"),
    ] {
        let path = folder.path().join(name);
        scene.save(&path).unwrap();
        let loaded = Scene::load(&path).unwrap();
        assert!(
            loaded.transport == scene.transport && loaded.projector_column == scene.projector_column,
            "{name}"
        );
    }
    let error = Scene::load(&folder.path().join("absent.npz")).unwrap_err();
    assert!(matches!(error, SceneError::Open { .. }) && error.to_string().contains("absent.npz"));
    let scene = Scene::from_transport(Array4::ones((4, 5, 3, 1)), None).unwrap();
    assert!(matches!(scene.save(&folder.path().join("no/folder.npz")), Err(SceneError::Write { .. })));
}

#[test]
fn float64_is_converted_and_unseen_columns_become_usable() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("scene.npz");
    let mut npz = NpzWriter::new(File::create(&path).unwrap());
    npz.add_array("T", &Array3::<f64>::from_elem((2, 2, 3), 0.25)).unwrap();
    let mut uv = Array3::<f64>::from_elem((2, 3, 2), 0.75);
    uv[[0, 0, 0]] = f64::NAN;
    uv[[0, 1, 0]] = 1.25;
    npz.add_array("proj_uv", &uv).unwrap();
    npz.finish().unwrap();
    let scene = Scene::load(&path).unwrap();
    assert_eq!(scene.transport, Array4::from_elem((2, 2, 3, 1), 0.25));
    assert_eq!(scene.projector_column.unwrap(), array![[0.5, 1.0, 0.75], [0.75, 0.75, 0.75]]);
}

#[test]
fn bad_files_name_themselves_and_the_trouble() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bad.npz");
    let fails = |expected: &[&str]| {
        let message = Scene::load(&path).unwrap_err().to_string();
        assert!(
            message.contains("bad.npz") && expected.iter().all(|part| message.contains(part)),
            "{message} lacks one of {expected:?}"
        );
    };
    macro_rules! written {
        ($($name:literal: $array:expr),+) => {{
            let mut npz = NpzWriter::new(File::create(&path).unwrap());
            $(npz.add_array($name, &$array).unwrap();)+
            npz.finish().unwrap();
        }};
    }
    let good = Array3::<f32>::ones((2, 2, 3));

    written!("direct": Array2::<f32>::ones((2, 2)), "depth_z": Array2::<f32>::ones((2, 2)));
    fails(&["no array T", "direct", "depth_z"]);
    written!("T": Array3::<u8>::ones((2, 2, 3)));
    fails(&["array T", "u1", "float32"]);
    written!("T": Array2::<f32>::ones((2, 2)));
    fails(&["array T", "[2, 2]", "[V, H, W]"]);
    written!("T": Array4::<f32>::ones((2, 2, 3, 4)));
    fails(&["array T", "[2, 2, 3, 4]"]);
    written!("T": Array5::<f32>::ones((2, 2, 3, 3, 1)));
    fails(&["array T", "[2, 2, 3, 3, 1]"]);
    written!("T": Array3::<f32>::ones((2, 0, 3)));
    fails(&["array T", "[2, 0, 3]"]);
    for value in [f32::NAN, f32::INFINITY, -1e-3] {
        let mut transport = good.clone();
        transport[[1, 0, 2]] = value;
        written!("T": transport);
        fails(&["array T", "(1, 0, 2, 0)", &value.to_string()]);
    }
    written!("T": Array3::<f64>::from_elem((2, 2, 3), 1e300));
    fails(&["array T", "inf"]);
    written!("T": good, "proj_uv": Array3::<f32>::zeros((3, 2, 2)));
    fails(&["array proj_uv", "[3, 2, 2]", "[2, 3, 2]"]);
    written!("T": good, "proj_uv": Array3::<i16>::zeros((2, 3, 2)));
    fails(&["array proj_uv", "i2"]);

    written!("T": Array3::<f32>::ones((8, 8, 8)));
    let whole = std::fs::read(&path).unwrap();
    for length in [0, 10, whole.len() / 2, whole.len() - 1] {
        std::fs::write(&path, &whole[..length]).unwrap();
        fails(&["not a readable .npz"]);
    }
    let mut flipped = whole.clone();
    flipped[whole.len() / 2] ^= 0x10;
    std::fs::write(&path, &flipped).unwrap();
    fails(&["not a readable .npz"]);
    std::fs::write(&path, "this is text").unwrap();
    fails(&["not a readable .npz"]);
}
