//! Products by name, requested in the plan and afterwards, compared with each other, the transport and the scene.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::collections::BTreeMap;
use std::path::Path;

use ndarray::{Array2, Array3, s};
use raysweep::control::Control;
use raysweep_processing::{self as process, Asked, ProcessError};
use raysweep_proto::{ErrorCode, RunParams};
use raysweep_session::products::Products;
use raysweep_session::stack::ArrayName;
use raysweep_session::{Session, manifest};
use raysweep_tests::{Bench, Ended, PRODUCTS, corner_rig, data, rig_text, with_products};
use raysweep_transport::plane::{RowTiming, Setting, predict};

const PLAN: &str = "kind = \"sweep\"\nname = \"products\"\n[sweep]\naverage = 2\n\
                    delay_us = { start = -200, stop = 200, count = 5 }\nexposure_us = [100, 250]\n";

fn bench() -> Bench {
    Bench::new(&rig_text(24, "scene = \"mix\"\nscene_rows = 24\nscene_columns = 16\nseed = 4", ""))
}

fn asked(products: &[&str], only: bool) -> Asked {
    Asked { products: products.iter().map(|&product| product.to_owned()).collect(), only, ..Asked::default() }
}

/// Files of a session's products, by their paths.
fn files(session: &Path) -> BTreeMap<String, Vec<u8>> {
    let folder = session.join("products");
    let named = |path: std::path::PathBuf| {
        let name = path.strip_prefix(&folder).unwrap().to_str().unwrap().to_owned();
        (name, std::fs::read(&path).unwrap())
    };
    Products::new(&folder).files().into_iter().map(named).collect()
}

fn array<D: ndarray::Dimension>(ended: &Ended, name: &str) -> ndarray::Array<f32, D> {
    ndarray_npy::read_npy(ended.session.join("products").join(format!("{name}.npy"))).unwrap()
}

#[test]
fn products_made_after_the_fact_have_the_bits_of_those_in_the_plan() {
    let planned_bench = bench();
    let planned = planned_bench.run(&with_products(&PRODUCTS, PLAN));
    let expected = files(&planned.session);
    // Two products have the same names as default ones, so only the others can be added.
    let late_bench = bench();
    let late = late_bench.run(PLAN);
    let before = files(&late.session);
    let made = process::process_asked(&late.session, &asked(&PRODUCTS[2..], false)).unwrap();
    assert_eq!(made.problems, [""; 0]);
    let after = files(&late.session);
    for (name, bytes) in &expected {
        assert!(after[name] == *bytes, "{name} differs");
    }
    for (name, bytes) in &before {
        assert!(after[name] == *bytes, "{name} is another than before");
    }
    assert!(expected.len() > 20 && after.contains_key("short_range.exr"), "{:?}", after.keys());
    let session = Session::open(&late.session).unwrap();
    assert!(manifest::verify(&session).unwrap().is_empty());
    let listed = manifest::read(&session).unwrap().files;
    assert!(
        ["line.exr", "line/contact_sheet.png", "captured_100us.mp4", "delay_profile_t12_s8.csv"]
            .iter()
            .all(|name| listed.contains_key(&format!("products/{name}")))
    );
    let report = std::fs::read_to_string(late.session.join("report.html")).unwrap();
    for shown in ["epipolar_5", "short_range", "Sequence line", "cross_section_t11", "delay_profile_t12_s8"] {
        assert!(report.contains(shown), "the report lacks {shown}");
    }
}

#[test]
fn only_what_is_asked_for_is_made_and_the_rest_stays() {
    let bench = bench();
    let ended = bench.run(PLAN);
    std::fs::remove_file(ended.session.join("products/short_range.npy")).unwrap();
    process::process_asked(&ended.session, &asked(&[r#"kind = "epipolar", width_rows = 3"#], true)).unwrap();
    let after = files(&ended.session);
    assert!(after.contains_key("epipolar_3.exr") && after.contains_key("long_range.npy"));
    assert!(!after.contains_key("short_range.npy"), "the plan's products are not made again");
    assert!(manifest::verify(&Session::open(&ended.session).unwrap()).unwrap().is_empty());
}

#[test]
fn relighting_and_bands_are_sums_of_the_transport() {
    let bench = bench();
    let all = [
        r#"kind = "relight", rows = [{ first = 0, last = 23 }], name = "all""#,
        r#"kind = "relight", rows = [{ first = 7, last = 7, weight = 2 }], name = "row""#,
        r#"kind = "band", from_rows = 0, name = "everything""#,
    ];
    let ended = bench.run(&with_products(&all, PLAN));
    let transport: Array3<f32> = array(&ended, "transport");
    let total = transport.mapv(f64::from).sum_axis(ndarray::Axis(0)).mapv(|light| light as f32);
    assert!(total.iter().any(|&light| light > 0.1));
    assert_eq!(array::<ndarray::Ix2>(&ended, "all"), total);
    assert_eq!(array::<ndarray::Ix2>(&ended, "everything"), total);
    let row: Array2<f32> = array(&ended, "row");
    let u_min = -(transport.dim().0 as i32 / 2);
    for t in 0..24 {
        let index = usize::try_from(7 - t as i32 - u_min).ok().filter(|&index| index < transport.dim().0);
        let expected = index.map_or(Array2::zeros((1, 16)).row(0).to_owned(), |index| {
            transport.slice(s![index, t, ..]).mapv(|light| 2.0 * light)
        });
        assert_eq!(row.row(t), expected, "camera row {t}");
    }
}

#[test]
fn a_delay_profile_is_that_of_the_scene() {
    let bench = Bench::new(&corner_rig("[sim.sensor]\nnoise = false\n"));
    let products = [
        r#"kind = "delay-profile", pixel = [60, 40], name = "pixel""#,
        r#"kind = "delay-profile", region = [30, 50, 70, 90], exposure_us = 900, name = "region""#,
    ];
    let sweep = "kind = \"sweep\"\n[sweep]\naverage = 2\n\
                 delay_us = { start = -1200, stop = 1200, count = 9 }\nexposure_us = [600, 900]\n";
    let ended = bench.run(&with_products(&products, sweep));
    let mut npz = ndarray_npy::NpzReader::new(std::fs::File::open(data("p2r_corner.npz")).unwrap()).unwrap();
    let scene: Array3<f32> = npz.by_name("T").unwrap();
    let timing = RowTiming::new(128, 22.22, 16_666.667).unwrap();
    let (_, state) = ended.open();
    for (name, first, region) in [("pixel", 0, [60, 61, 40, 41]), ("region", 9, [30, 50, 70, 90])] {
        let profile: Array2<f32> = array(&ended, name);
        assert_eq!(profile.dim(), (9, 5));
        let [t0, t1, s0, s1] = region;
        let brightest = profile.column(1).iter().fold(0.0_f32, |a, &b| a.max(b));
        let mut area = 0.0;
        for delay in 0..9 {
            let entry = state.point(ArrayName::Sum, first + delay).unwrap();
            let setting = Setting { delays_us: entry.delays_us.clone(), exposure_us: entry.exposure_us };
            let image = predict(&timing, scene.view(), &setting).unwrap();
            let expected = image.slice(s![t0..t1, s0..s1]).mean().unwrap();
            let (measured, predicted) = (profile[[delay, 1]], profile[[delay, 2]]);
            println!("{name} {delay}: scene {expected}, measured {measured}, predicted {predicted}");
            assert!((measured - expected).abs() < 4e-4, "quantised to 4e-4: {measured}, {expected}");
            assert!((predicted - expected).abs() < 0.02 * brightest, "{predicted}, {expected}");
            if delay > 0 {
                let width_us = profile[[delay, 0]] - profile[[delay - 1, 0]];
                area += width_us * (profile[[delay, 3]] + profile[[delay - 1, 3]]) / 2.0;
            }
        }
        assert!((area - 1.0).abs() < 1e-4, "the normalised profile has the area {area}");
    }
}

#[test]
fn what_cannot_be_had_is_refused_before_anything_moves() {
    let bench = bench();
    let cases: [(&[&str], &str); 5] = [
        (&[r#"kind = "epipolar", width_rows = 4"#], "product.0.width_rows"),
        (&[r#"kind = "regular", name = "../../escape""#], "product.0.name"),
        (&[r#"kind = "regular""#, r#"kind = "epipolar", name = "regular""#], "product.1.name"),
        (&[r#"kind = "epipolar""#, r#"kind = "epipolar", width_rows = 1"#], "product.1"),
        (&[r#"kind = "delay-profile", pixel = [24, 0]"#], "product.0.pixel"),
    ];
    for (products, field) in cases {
        let plan = with_products(products, PLAN);
        let error = bench.runner.run(RunParams { plan, ..RunParams::default() }).unwrap_err();
        let data = error.data.clone().unwrap();
        assert_eq!(
            (error.name(), data.field.as_deref()),
            (Some(ErrorCode::InvalidPlan), Some(field)),
            "{error}"
        );
        assert!(data.span.is_some(), "{error} has no place");
    }
    let no_transport = format!("product = []\n{PLAN}[[stage]]\nname = \"hot-pixels\"\n");
    assert_eq!(bench.run(&no_transport).state, "complete", "nothing asked, nothing needed");
    let needs = with_products(&[r#"kind = "epipolar""#], PLAN) + "[[stage]]\nname = \"hot-pixels\"\n";
    let error = bench.runner.run(RunParams { plan: needs, ..RunParams::default() }).unwrap_err();
    assert_eq!(error.data.unwrap().field.as_deref(), Some("product"));

    let ended = bench.run(PLAN);
    let before = files(&ended.session);
    for argument in [
        r#"kind = "epipolar", width_rows = 2"#,
        r#"kind = "epipolar""#,
        r#"kind = "band", from_rows = nan"#,
        r#"kind = "epipolar" }]"#,
        r#"width_rows = 3"#,
    ] {
        let error = process::process_asked(&ended.session, &asked(&[argument], false)).unwrap_err();
        assert!(matches!(error, ProcessError::Product(_)), "{argument}: {error}");
    }
    assert!(files(&ended.session) == before, "a refusal has written files");
}
