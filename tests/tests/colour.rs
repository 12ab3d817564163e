//! Colour on the plane rig: an RGB scene through a Bayer mosaic, against the scene and against monochrome cameras.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::path::Path;

use ndarray::{Array2, Array3, Array4, ArrayD, Axis, s};
use raysweep::control::Control;
use raysweep_proto::{ErrorCode, RunParams};
use raysweep_session::products::Products;
use raysweep_sim::scene::{Scene, SceneSize};
use raysweep_tests::{Bench, rig_text};

const SIDE: usize = 64;
const PLAN: &str = "kind = \"sweep\"\n[sweep]\naverage = 8\n\
    [[product]]\nkind = \"regular\"\n\
    [[product]]\nkind = \"epipolar\"\n\
    [[product]]\nkind = \"band\"\nname = \"indirect\"\nfrom_rows = 1\nto_rows = 20\n\
    [[product]]\nkind = \"uncertainty\"\nname = \"sd\"\nfrom_rows = 0\nto_rows = 0\n\
    [[product]]\nkind = \"captured\"\nname = \"film\"\n";
/// Pixels beside an edge of albedo whose colour no mosaic can tell.
const RIM_PX: usize = 2;

/// A bench before a scene `[v, t, s, c]`, with a camera of this format.
fn bench(transport: Array4<f32>, format: &str) -> Bench {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("scene.npz");
    Scene::from_transport(transport, None).unwrap().save(&file).unwrap();
    let rig = rig_text(SIDE, &format!("scene = {file:?}\nseed = 7"), "");
    Bench::new(&rig.replace("[camera]\n", &format!("[camera]\npixel_format = \"{format}\"\n")))
}

fn run(bench: &Bench, plan: &str) -> std::path::PathBuf {
    let ended = bench.run(plan);
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    ended.session
}

fn array(session: &Path, name: &str) -> ArrayD<f32> {
    Products::new(session.join("products")).read_array(name).unwrap()
}

fn image(session: &Path, name: &str) -> Array3<f32> {
    let array = array(session, name);
    let array = if array.ndim() == 2 { array.insert_axis(Axis(2)) } else { array };
    array.into_dimensionality().unwrap()
}

/// The light of rows whose distance from a pixel's own satisfies `is_in`, `[t, s, c]`.
fn light(transport: &Array4<f32>, is_in: impl Fn(usize) -> bool) -> Array3<f32> {
    let (_, rows, columns, channels) = transport.dim();
    let mut sum = Array3::zeros((rows, columns, channels));
    for ((v, t, s, c), light) in transport.indexed_iter() {
        if is_in(v.abs_diff(t)) {
            sum[[t, s, c]] += light;
        }
    }
    sum
}

/// Pixels further than [`RIM_PX`] from any edge of an image.
fn inside(image: &Array3<f32>) -> Array2<bool> {
    let most = image.fold(0.0_f32, |most, value| most.max(*value));
    Array2::from_shape_fn((SIDE, SIDE), |(t, s)| {
        let near = |at: usize| at.saturating_sub(RIM_PX)..(at + RIM_PX + 1).min(SIDE);
        let around = image.slice(s![near(t), near(s), ..]);
        around.axis_iter(Axis(2)).all(|plane| {
            let (least, greatest) = plane.fold((f32::MAX, f32::MIN), |(a, b), v| (a.min(*v), b.max(*v)));
            greatest - least < 0.1 * most
        })
    })
}

/// Root mean square of the difference, as a share of that of the truth, in a channel.
fn error(found: &Array3<f32>, truth: &Array3<f32>, counted: &Array2<bool>, channels: (usize, usize)) -> f64 {
    let (mut difference, mut all) = (0.0, 0.0);
    for ((t, s), _) in counted.indexed_iter().filter(|(_, is)| **is) {
        let (found, truth) = (f64::from(found[[t, s, channels.0]]), f64::from(truth[[t, s, channels.1]]));
        difference += (found - truth).powi(2);
        all += truth * truth;
    }
    (difference / all).sqrt()
}

#[test]
fn an_rgb_scene_is_as_right_as_through_three_monochrome_cameras() {
    let size = SceneSize { rows: SIDE, columns: SIDE };
    let scene = Scene::builtin_rgb("candle", size, 7).unwrap().transport;
    let counted = inside(&light(&scene, |_| true));
    assert!(counted.iter().filter(|is| **is).count() > SIDE * SIDE / 4);
    let colour_bench = bench(scene.clone(), "BayerGB12");
    let session = run(&colour_bench, PLAN);
    let truth: [(&str, Array3<f32>); 3] = [
        ("regular", light(&scene, |_| true)),
        ("epipolar", light(&scene, |u| u == 0)),
        ("indirect", light(&scene, |u| (1..=20).contains(&u))),
    ];
    for channel in 0..3 {
        let alone = scene.slice(s![.., .., .., channel..=channel]).to_owned();
        let bench = bench(alone, "Mono12");
        let mono = run(&bench, PLAN);
        for (name, truth) in &truth {
            let of_colour = error(&image(&session, name), truth, &counted, (channel, channel));
            let of_mono = error(&image(&mono, name), truth, &counted, (0, channel));
            println!("{name}, channel {channel}: {of_colour:.4}, monochrome {of_mono:.4}");
            assert!(of_colour < 1.5 * of_mono, "{name}, channel {channel}: {of_colour} and {of_mono}");
        }
    }
    // What is written: shapes, axes, channels, pictures.
    assert_eq!(array(&session, "film").shape(), [15, SIDE, SIDE, 3]);
    assert_eq!(array(&session, "sd").shape(), [SIDE, SIDE, 3]);
    assert!(array(&session, "sd").iter().all(|sd| *sd >= 0.0));
    let about = std::fs::read_to_string(session.join("products/film.json")).unwrap();
    let about: serde_json::Value = serde_json::from_str(&about).unwrap();
    assert_eq!(about["axes"], serde_json::json!(["k", "t", "s", "rgb"]));
    let picture = std::fs::File::open(session.join("products/film/0003.png")).unwrap();
    let picture = png::Decoder::new(std::io::BufReader::new(picture)).read_info().unwrap();
    assert_eq!(picture.info().color_type, png::ColorType::Rgb);
}

#[test]
fn a_grey_scene_has_no_coloured_fringes() {
    let size = SceneSize { rows: SIDE, columns: SIDE };
    let scene = Scene::builtin("v-groove", size, 7).unwrap().transport;
    let bench = bench(scene.broadcast((SIDE, SIDE, SIDE, 3)).unwrap().to_owned(), "BayerRG12");
    let session = run(&bench, PLAN);
    let regular = image(&session, "regular");
    let white = light(&scene, |_| true).fold(0.0_f32, |most, value| most.max(*value));
    let mut chroma: Vec<f32> = Vec::new();
    for pixel in regular.rows() {
        let grey = pixel.sum() / 3.0;
        chroma.push(pixel.iter().fold(0.0_f32, |most, value| most.max((value - grey).abs())) / white);
    }
    chroma.sort_by(f32::total_cmp);
    let share = |q: f64| chroma[(q * (chroma.len() - 1) as f64) as usize];
    println!("chroma over white: median {:.4}, 99 % {:.4}, most {:.4}", share(0.5), share(0.99), share(1.0));
    assert!(share(0.5) < 0.01 && share(0.99) < 0.13, "{} {}", share(0.5), share(0.99));
}

#[test]
fn a_plan_for_a_monochrome_camera_is_refused_before_anything_moves() {
    let bench = bench(Array4::from_elem((SIDE, SIDE, SIDE, 3), 0.01), "BayerRG12");
    let stage = |options: &str| {
        let plan =
            format!("{PLAN}[[stage]]\nname = \"hot-pixels\"\n{options}\n[[stage]]\nname = \"demux\"\n");
        bench.runner.run(RunParams { plan, ..RunParams::default() })
    };
    for options in ["", "step_px = 1"] {
        let refused = stage(options).unwrap_err();
        let said = refused.to_string();
        assert_eq!(refused.name(), Some(ErrorCode::InvalidPlan), "{said}");
        assert!(said.contains("step_px = 1: must be 2") && said.contains("BayerRG12"), "{said}");
    }
}
