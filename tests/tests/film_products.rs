//! Products of films: videos of the plan's kinds of light, compared with plain sums over the stored transports.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::path::Path;
use std::process::Command;

use ndarray::{Array3, Axis, Zip, s};
use raysweep::control::Control;
use raysweep_pipeline::mask;
use raysweep_processing::{Asked, ProcessError, process_asked};
use raysweep_session::film::TransportFilm;
use raysweep_session::{Session, manifest};
use raysweep_tests::{Bench, Ended, rig_text, with_products};
use serde_json::Value;

const ROWS: usize = 24;
const COLUMNS: usize = 16;

const PRODUCTS: [&str; 5] = [
    r#"kind = "epipolar""#,
    r#"kind = "non-epipolar", width_rows = 3, name = "indirect""#,
    r#"kind = "band", from_rows = 2, to_rows = 5, side = "below", name = "below""#,
    r#"kind = "relight", stripes = { period_rows = 7, lit_rows = 3, phase_rows = 2 }, beam = "ideal", name = "stripes""#,
    r#"kind = "relight", rows = [{ first = 350, last = 362, weight = 0.5 }, { first = 360, last = 370 }], beam = "ideal", name = "piece""#,
];

fn plan(cycles: u32) -> String {
    format!("kind = \"film\"\n[film]\ncycles = {cycles}\n")
}

/// A pendulum; some frames are lost, so that some cycles are not stored.
fn bench() -> Bench {
    let sim = format!(
        "scene = \"pendulum\"\nscene_rows = {ROWS}\nscene_columns = {COLUMNS}\nseed = 8\nmotion_period_s = 2"
    );
    Bench::new(&rig_text(720, &sim, "[sim.camera]\ndropped = 0.03\n"))
}

fn complete(bench: &Bench, plan: &str) -> Ended {
    let ended = bench.run(plan);
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    ended
}

fn video(session: &Path, name: &str) -> Array3<f32> {
    ndarray_npy::read_npy(session.join(format!("products/{name}.npy"))).unwrap()
}

/// Files of its products.
fn made(ended: &Ended) -> Vec<std::path::PathBuf> {
    std::fs::read_dir(ended.session.join("products")).unwrap().map(|entry| entry.unwrap().path()).collect()
}

fn metadata(session: &Path, name: &str) -> Value {
    serde_json::from_slice(&std::fs::read(session.join(format!("products/{name}.json"))).unwrap()).unwrap()
}

/// The weight that each of [`PRODUCTS`] gives the light of projector row `v` in a pixel whose own row is `own`.
fn weight(product: usize, v: i64, own: i64) -> f64 {
    let u = v - own;
    let is = |holds: bool| if holds { 1.0 } else { 0.0 };
    match product {
        0 => is(u == 0),
        1 => is(u.abs() > 1),
        2 => is((2..=5).contains(&u)),
        3 => is((v - 2).rem_euclid(7) < 3),
        _ => 0.5 * is((350..=362).contains(&v)) + is((360..=370).contains(&v)),
    }
}

const NAMES: [&str; 5] = ["epipolar", "indirect", "below", "stripes", "piece"];

#[test]
fn each_image_is_the_sum_of_its_cycles_transport_over_the_rows_that_it_names() {
    let bench = bench();
    let ended = complete(&bench, &with_products(&PRODUCTS, &plan(12)));
    let (session, state) = ended.open();
    let stored: Vec<usize> = state.cycles().map(|entry| entry.cycle).collect();
    assert!((2..12).contains(&stored.len()), "some cycles are lost, and not all: {stored:?}");
    let film = TransportFilm::open(&session.transport_film_path()).unwrap();
    let number = |key: &str| film.attributes()[key].as_i64().unwrap();
    let (u_min, first_row) = (number("u_min"), number("first_row"));
    for (product, name) in NAMES.iter().enumerate() {
        let images = video(&ended.session, name);
        assert_eq!(images.dim(), (stored.len(), ROWS, COLUMNS));
        let (mut most, mut light) = (0.0_f64, 0.0_f64);
        for (image, &cycle) in images.outer_iter().zip(&stored) {
            let transport = film.read(cycle).unwrap().unwrap().t;
            for ((t, s), &value) in image.indexed_iter() {
                let own = first_row + t as i64;
                let profile = (0_i64..).zip(transport.index_axis(Axis(1), t).column(s).to_vec());
                let expected: f64 = profile
                    .map(|(index, lit)| weight(product, own + u_min + index, own) * f64::from(lit))
                    .sum();
                most = most.max((f64::from(value) - expected).abs());
                light = light.max(expected);
            }
        }
        println!("{name}: largest difference {most:.1e}, brightest pixel {light:.2}");
        assert!(light > 0.01, "{name} shows nothing");
        assert!(most < 1e-5, "{name}: {most}");
        let about = metadata(&ended.session, name);
        assert_eq!(about["k"]["at"], serde_json::json!(stored));
        assert_eq!(about["k"]["start_s"].as_array().unwrap().len(), stored.len());
    }
    assert!(manifest::verify(&session).unwrap().is_empty());
    let report = std::fs::read_to_string(session.report_path()).unwrap();
    assert!(NAMES.iter().all(|name| report.contains(&format!("Product {name}"))));
}

#[test]
fn videos_show_the_pictures_at_the_pace_of_the_cycles() {
    let bench = bench();
    let ended = complete(&bench, &with_products(&PRODUCTS[..1], &plan(6)));
    let folder = ended.session.join("products");
    let images = video(&ended.session, "epipolar").len_of(Axis(0));
    let pictures = std::fs::read_dir(folder.join("epipolar")).unwrap().map(|entry| entry.unwrap().path());
    let pngs = pictures.filter(|path| path.extension().is_some_and(|extension| extension == "png")).count();
    assert_eq!(pngs, images);
    let fields = "stream=nb_read_frames,width,height,avg_frame_rate";
    let arguments = ["-v", "error", "-count_frames", "-show_entries", fields, "-of", "json"];
    let probed = Command::new("ffprobe").args(arguments).arg(folder.join("epipolar.mp4")).output();
    let probed = probed.expect("ffprobe: `cargo xtask test` installs it");
    let probed: Value = serde_json::from_slice(&probed.stdout).unwrap();
    let stream = &probed["streams"][0];
    assert_eq!((&stream["width"], &stream["height"]), (&COLUMNS.into(), &ROWS.into()));
    assert_eq!(stream["nb_read_frames"], images.to_string());
    let rate: Vec<f64> =
        stream["avg_frame_rate"].as_str().unwrap().split('/').map(|part| part.parse().unwrap()).collect();
    // 15 settings at 60 Hz; a lost cycle makes the pace of the others lower.
    let pace = metadata(&ended.session, "epipolar")["images_per_s"].as_f64().unwrap();
    assert!((rate[0] / rate[1] - pace).abs() < 0.01 && pace <= 4.01, "{rate:?}, {pace}");
}

#[test]
fn products_asked_for_later_have_the_bits_of_those_in_the_plan() {
    let (planned, late) = (bench(), bench());
    let judged = r#"kind = "uncertainty", from_rows = 0, to_rows = 0, name = "sd""#;
    let planned = complete(&planned, &with_products(&[&PRODUCTS[..3], &[judged]].concat(), &plan(8)));
    let late = complete(&late, &plan(8));
    assert!(made(&late).is_empty(), "a film without products has none");
    let products = PRODUCTS[1..3].iter().chain([&judged]).map(|&product| product.to_owned()).collect();
    let asked = Asked { products, only: true, ..Asked::default() };
    process_asked(&late.session, &asked).unwrap();
    for name in ["indirect", "below", "sd"] {
        assert_eq!(video(&late.session, name), video(&planned.session, name));
        let mask =
            |ended: &Ended| std::fs::read(ended.session.join(format!("products/{name}_mask.npy"))).unwrap();
        assert!(mask(&late) == mask(&planned));
    }
    assert!(!late.session.join("products/epipolar.npy").exists());
    assert!(manifest::verify(&Session::open(&late.session).unwrap()).unwrap().is_empty());
}

#[test]
fn what_a_film_cannot_show_is_refused_before_anything_moves() {
    let bench = bench();
    for (product, part) in [
        (r#"kind = "regular""#, "a film's products are"),
        (r#"kind = "delay-profile", pixel = [3, 3]"#, "a film's products are"),
        (r#"kind = "relight", line = { height_rows = 2, step_rows = 3 }"#, "use rows or stripes"),
        (r#"kind = "epipolar", width_rows = 2"#, "odd"),
        (r#"kind = "uncertainty", from_rows = 0"#, "film.cycles = 2"),
    ] {
        let refused = bench.runner.check(&with_products(&[product], &plan(2))).unwrap_err();
        assert!(refused.message.contains(part), "{product}: {}", refused.message);
        let field = refused.data.unwrap().field.unwrap();
        assert!(field.starts_with("product.0."), "{field}");
    }
    let ended = complete(&bench, &plan(2));
    for (product, part) in
        [(r#"kind = "regular""#, "a film's products are"), (r#"kind = "band", from_rows = 5000"#, "beyond")]
    {
        let asked = Asked { products: vec![product.into()], ..Asked::default() };
        match process_asked(&ended.session, &asked) {
            Err(ProcessError::Product(error)) => assert!(error.contains(part), "{product}: {error}"),
            other => panic!("{product}: {other:?}"),
        }
    }
    assert!(made(&ended).is_empty());
}

/// Of a scene that does not move, cycles differ by what the product `uncertainty` states.
#[test]
fn cycles_scatter_as_their_uncertainty_says() {
    let sim = "scene = \"v-groove\"\nscene_rows = 64\nscene_columns = 48\nseed = 3";
    let bench = Bench::new(&rig_text(720, sim, ""));
    let products = [
        r#"kind = "band", from_rows = 0, to_rows = 0, name = "direct""#,
        r#"kind = "uncertainty", from_rows = 0, to_rows = 0, name = "direct-sd""#,
        r#"kind = "prior-bias", from_rows = 0, to_rows = 0, name = "direct-bias""#,
        r#"kind = "relight", stripes = { period_rows = 16, lit_rows = 6 }, name = "striped""#,
        r#"kind = "uncertainty", stripes = { period_rows = 16, lit_rows = 6 }, name = "striped-sd""#,
    ];
    let ended = complete(&bench, &with_products(&products, &plan(40)));
    let bounds = video(&ended.session, "direct-bias");
    let positive = bounds.iter().filter(|bound| bound.is_finite() && **bound > 0.0).count();
    assert!(10 * positive > 9 * bounds.len(), "{positive} of {}", bounds.len());
    for name in ["direct", "striped"] {
        let [light, sd] = ["", "-sd"].map(|end| video(&ended.session, &format!("{name}{end}")));

        // Those from which the film learns are solved by another model.
        let (light, sd) = (light.slice(s![4.., .., ..]), sd.slice(s![4.., .., ..]));
        let mean = light.mean_axis(Axis(0)).unwrap();
        let nearer = (1.0 - 1.0 / light.len_of(Axis(0)) as f32).sqrt();
        let within = light.outer_iter().zip(sd.outer_iter()).map(|(light, sd)| {
            Zip::from(light)
                .and(sd)
                .and(&mean)
                .fold(0, |sum, light, sd, mean| sum + usize::from((light - mean).abs() < sd * nearer))
        });
        let share = within.sum::<usize>() as f64 / light.len() as f64;
        println!("{name}: {share:.3} within one standard deviation");
        assert!((0.6..0.76).contains(&share), "{name}: {share}");
    }
}

/// Where direct light saturates, a film says that it is a bound, in the transport and in each product that contains it.
#[test]
fn what_saturates_is_marked_in_each_cycle() {
    let sim = format!("scene = \"mix\"\nscene_rows = {ROWS}\nscene_columns = {COLUMNS}\nseed = 3");
    // Counts end below what the brightest pixels send.
    let bench = Bench::new(&rig_text(720, &sim, "[sim.truth]\nwhite_dn = 7000\n"));
    let products = [
        r#"kind = "epipolar""#,
        r#"kind = "band", from_rows = 5, to_rows = 9, name = "beside""#,
        // Far above all rows that the camera looks at, and farther than the film reaches.
        r#"kind = "relight", rows = [{ first = 300, last = 310 }], name = "above""#,
        r#"kind = "relight", rows = [{ first = 0, last = 3 }], name = "beyond""#,
    ];
    let ended = complete(&bench, &with_products(&products, &plan(6)));
    let (session, _) = ended.open();
    let film = TransportFilm::open(&session.transport_film_path()).unwrap();
    let u_min = film.attributes()["u_min"].as_i64().unwrap();
    let mask = |name: &str| -> Array3<u8> {
        ndarray_npy::read_npy(ended.session.join(format!("products/{name}_mask.npy"))).unwrap()
    };
    let (epipolar, beside) = (mask("epipolar"), mask("beside"));
    let bounds = epipolar.iter().filter(|bits| **bits & mask::BOUND_ONLY != 0).count();
    assert!((1..epipolar.len()).contains(&bounds), "{bounds} of {}", epipolar.len());
    for (cycle, (epipolar, beside)) in epipolar.outer_iter().zip(beside.outer_iter()).enumerate() {
        let stored = film.read(cycle).unwrap().unwrap().mask;
        for ((t, s), bits) in epipolar.indexed_iter() {
            let is_bound = |u: i64| stored[[(u - u_min) as usize, t, s]] & mask::BOUND_ONLY != 0;
            assert_eq!(bits & mask::BOUND_ONLY != 0, is_bound(0), "cycle {cycle}, pixel {t}, {s}");
            let any = (-9..=9).any(|u: i64| u.abs() >= 5 && is_bound(u));
            assert_eq!(beside[[t, s]] & mask::BOUND_ONLY != 0, any);
        }
    }
    assert!(mask("above").iter().all(|bits| *bits == mask::MEASURED), "no row that saturates is lit");
    assert!(mask("beyond").iter().all(|bits| *bits == mask::MEASURED | mask::OUTSIDE_REACH));
    let names = metadata(&ended.session, "epipolar")["mask"].clone();
    assert_eq!(names["bound only"], mask::BOUND_ONLY);
    let picture = std::fs::read(ended.session.join("products/epipolar/0000.exr")).unwrap();
    assert!(picture.windows(5).any(|bytes| bytes == b"mask\0"), "the EXR file has the channel");
}
