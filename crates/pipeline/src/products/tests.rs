use ndarray::{Axis, s};
use raysweep_core::Raster;
use raysweep_transport::plane::predict;
use serde_json::{Map, Value, json};

use ndarray::{Array2, Array3};
use raysweep_transport::plane::{NoiseModel, Prior, RowTiming, Setting, Transport};

use super::*;
use crate::product::Product;
use crate::schedule::{Point, PointRole, Schedule, Spot, SweepGeometry};
use crate::stack::SweepStack;

/// A camera with 6 rows and 3 columns that sees the rows of a 10-row projector starting at row 2.
fn geometry() -> SweepGeometry {
    let raster = Raster { rows: 10, row_time_us: 20.0, period_us: 2000.0, first_row_us: 0.0 };
    SweepGeometry {
        raster,
        row_table_us: None,
        beam_sigma_rows: None,
        spot: Spot::Uniform,
        projector_columns: None,
        first_row: 2,
        row_pitch: 1.0,
        camera_row_time_us: 20.0,
        height: 6,
        width: 3,
        white_dn: 1000.0,
        black_dn: 0.0,
        calibration: None,
        saturation_dn: 4000.0,
    }
}

/// Two exposures at three delays, and a third at one.
fn schedule() -> Schedule {
    let grid = [100.0, 200.0].into_iter().flat_map(|us| [-60.0, 0.0, 60.0].map(|delay_us| (delay_us, us)));
    let points = (0..).zip(grid.chain([(0.0, 300.0)])).map(|(index, (delay_us, exposure_us))| Point {
        role: PointRole::Sweep(index),
        delay_us,
        exposure_us,
        frames: 1,
    });
    Schedule { points: points.collect() }
}

fn timing() -> RowTiming {
    RowTiming::new(10, 20.0, 2000.0).unwrap().window(2, 6).unwrap()
}

/// Values with few bits, so that their sums are exact in any order.
fn transport() -> Transport {
    let row = |index: usize, t: usize| timing().row_exists(index as i32 - 4, t);
    let t = Array3::from_shape_fn((9, 6, 3), |(index, t, s)| match row(index, t) {
        true => ((5 * index + 3 * t + s) % 17) as f32 / 16.0,
        false => 0.0,
    });
    let exists = Array2::from_shape_fn((9, 6), |(index, t)| row(index, t));
    Transport::measured(t, -4, exists)
}

/// The camera's images of the transport, without noise.
fn stack() -> SweepStack {
    let points = schedule().points;
    let settings: Vec<Setting> =
        points.iter().map(|point| Setting::new(point.delay_us, point.exposure_us)).collect();
    // As seen by a camera with as many rows as the projector, of which ours is a window.
    let all = Array3::from_shape_fn((10, 10, 3), |(v, t, s)| {
        let known = t.checked_sub(2).zip((v + 4).checked_sub(t));
        known.and_then(|(t, index)| transport().t.get([index, t, s]).copied()).unwrap_or(0.0)
    });
    let whole = RowTiming::new(10, 20.0, 2000.0).unwrap();
    let seen = |setting| predict(&whole, all.view(), setting).unwrap().slice_move(s![2..8, ..]);
    let images: Vec<_> = settings.iter().map(seen).collect();
    let views: Vec<_> = images.iter().map(|image| image.view()).collect();
    let images = ndarray::stack(Axis(0), &views).unwrap();
    SweepStack {
        exposures_us: points.iter().map(|point| point.exposure_us).collect(),
        ..SweepStack::new(timing(), Prior::SPLIT, settings, images)
    }
}

fn spec(table: &Value) -> Result<ProductSpec, ProductError> {
    let mut options = table.as_object().unwrap().clone();
    let take = |options: &mut Map<String, Value>, key: &str| {
        options.remove(key).map(|value| value.as_str().unwrap().to_owned())
    };
    let (kind, name) = (take(&mut options, "kind").unwrap(), take(&mut options, "name"));
    ProductSpec::new(&kind, name.as_deref(), &options, &schedule(), &geometry())
}

fn image(table: Value) -> Array2<f32> {
    match spec(&table).unwrap().make(&stack(), &transport()).unwrap() {
        Product::Image { image, .. } => image,
        other => panic!("{other:?}"),
    }
}

#[test]
fn bands_of_both_sides_add_up_to_the_total() {
    let parts = [
        json!({ "kind": "band", "from_rows": 0, "to_rows": 0 }),
        json!({ "kind": "band", "from_rows": 1, "to_rows": 2, "side": "above" }),
        json!({ "kind": "band", "from_rows": 1, "to_rows": 2, "side": "below" }),
        json!({ "kind": "band", "from_rows": 3 }),
    ];
    let sum = parts.into_iter().map(image).reduce(|a, b| a + b).unwrap();
    assert_eq!(sum, transport().total());
    let near = image(json!({ "kind": "band", "from_rows": 0, "to_rows": 2 }));
    assert_eq!(near, image(json!({ "kind": "epipolar", "width_rows": 5 })));
    let far = image(json!({ "kind": "band", "from_rows": 3, "to_rows": u32::MAX }));
    assert_eq!(far, image(json!({ "kind": "non-epipolar", "width_rows": 5 })));
    // u = -2 and -1 have the indices 2 and 3.
    let above = image(json!({ "kind": "band", "from_rows": 1, "to_rows": 2, "side": "above" }));
    assert_eq!(above, transport().t.slice(s![2..4, .., ..]).sum_axis(Axis(0)));
}

#[test]
fn a_band_and_what_lies_on_either_side_of_it_are_all_light() {
    for (from, to) in (0..6).flat_map(|from| (from..6).map(move |to| (from, to))) {
        let inner = match from {
            0 => Array2::zeros((6, 3)),
            _ => image(json!({ "kind": "band", "from_rows": 0, "to_rows": from - 1 })),
        };
        let band = image(json!({ "kind": "band", "from_rows": from, "to_rows": to }));
        let outer = image(json!({ "kind": "band", "from_rows": to + 1 }));
        assert_eq!(inner + band + outer, transport().total(), "{from} to {to}");
    }
}

#[test]
fn relighting_by_all_rows_by_pieces_and_by_complementary_stripes_agree() {
    let all = image(json!({ "kind": "relight", "rows": [{ "first": 0, "last": 9 }] }));
    assert_eq!(all, transport().total());
    let ideal = json!({ "kind": "relight", "beam": "ideal", "rows": [{ "first": 0, "last": 9 }] });
    assert_eq!(image(ideal), all, "the rig's beam is ideal");
    let unknown = json!({ "kind": "relight", "beam": "wide", "rows": [{ "first": 0, "last": 9 }] });
    assert_eq!(spec(&unknown).unwrap_err().path, ["beam"]);
    let overlapping = json!([{ "first": 0, "last": 9, "weight": 0.5 }, { "first": 0, "last": 6, "weight": 0.5 },
        { "first": 7, "last": 9, "weight": 0.5 }]);
    assert_eq!(image(json!({ "kind": "relight", "rows": overlapping })), all);
    let stripes = |phase: usize, lit: usize| {
        image(
            json!({ "kind": "relight", "stripes": { "period_rows": 4, "lit_rows": lit, "phase_rows": phase } }),
        )
    };
    assert_eq!(stripes(3, 1) + stripes(0, 3), all);
    // Rows 3 and 7, which are u = 1 and 5 of camera row 0.
    assert_eq!(stripes(3, 1)[[0, 2]], transport().t[[5, 0, 2]]);
}

#[test]
fn a_line_lights_each_row_of_the_cameras_once() {
    let line = spec(&json!({ "kind": "relight", "line": { "height_rows": 2, "step_rows": 2 } })).unwrap();
    assert_eq!(line.images(&geometry()), 3);
    let Product::Sequence { images, at, .. } = line.make(&stack(), &transport()).unwrap() else { panic!() };
    assert_eq!((images.dim(), at.as_slice()), ((3, 6, 3), [2.0, 4.0, 6.0].as_slice()));
    let camera_rows = image(json!({ "kind": "relight", "rows": [{ "first": 2, "last": 7 }] }));
    assert_eq!(images.sum_axis(Axis(0)), camera_rows);
}

#[test]
fn a_delay_profile_is_what_the_forward_model_says_of_its_pixels() {
    let table = json!({ "kind": "delay-profile", "region": [2, 4, 1, 3], "exposure_us": 200 });
    let Product::Profile(profile) = spec(&table).unwrap().make(&stack(), &transport()).unwrap() else {
        panic!()
    };
    assert_eq!((profile.name.as_str(), profile.exposure_us), ("delay_profile_t2_4_s1_3", 200.0));
    assert_eq!(profile.measured.delays_us, [-60.0, 0.0, 60.0]);
    for (index, light) in profile.measured.light.iter().enumerate() {
        let mean = f64::from(stack().images.slice(s![3 + index, 2..4, 1..3]).mean().unwrap());
        let predicted = profile.predicted.light[index];
        assert!(mean > 0.5 && (light - mean).abs() < 1e-6, "{light} is not {mean}");
        assert!((predicted - mean).abs() < 1e-6, "{predicted} is not {mean}");
    }
    let shortest = spec(&json!({ "kind": "delay-profile", "pixel": [5, 0] })).unwrap();
    let Product::Profile(profile) = shortest.make(&stack(), &transport()).unwrap() else { panic!() };
    assert_eq!(profile.exposure_us, 100.0);
    assert_eq!(profile.measured.light[0], f64::from(stack().images[[0, 5, 0]]));
}

#[test]
fn captured_images_are_those_of_the_stack_by_delay() {
    let make = |stack: &SweepStack, table: Value| spec(&table).unwrap().make(stack, &transport());
    let mut stack = stack();
    // Taken so far from the planned delays that their order is another.
    for (n, delay_us) in [(0, 61.5), (2, -58.0)] {
        stack.settings[n].delays_us = vec![delay_us - 1.0, delay_us + 1.0];
    }
    let film = make(&stack, json!({ "kind": "captured" })).unwrap();
    let Product::Sequence { name, at, images, .. } = film else { panic!() };
    assert_eq!((name.as_str(), at.as_slice()), ("captured_100us", [-58.0, 0.0, 61.5].as_slice()));
    assert_eq!(images, stack.images.select(Axis(0), &[2, 1, 0]));
    let one = make(&stack, json!({ "kind": "captured", "delay_us": -60.004, "exposure_us": 100.0 })).unwrap();
    let Product::Image { name, about, image, .. } = one else { panic!() };
    let planned = stack.images.index_axis(Axis(0), 0).to_owned();
    assert_eq!((name.as_str(), image), ("captured_-60us_100us", planned));
    assert!(about.contains("delay of -60 µs (measured 61.5)"), "{about}");
    assert_eq!(spec(&json!({ "kind": "captured" })).unwrap().images(&geometry()), 3);
    stack.keep(|n| n != 0);
    let missing = make(&stack, json!({ "kind": "captured", "delay_us": -60 })).unwrap_err();
    assert!(missing.what.contains("the image at -60 µs delay"), "{missing}");
}

#[test]
fn a_captured_image_is_a_bound_where_it_saturates() {
    let mut stack = stack();
    let mut valid = Array3::from_elem(stack.images.dim(), true);
    valid[[1, 4, 2]] = false;
    valid[[4, 0, 0]] = false;
    stack.valid = Some(valid);
    let table = json!({ "kind": "captured", "delay_us": 0 });
    let Product::Image { mask, .. } = spec(&table).unwrap().make(&stack, &transport()).unwrap() else {
        panic!()
    };
    assert_eq!(
        (mask[[4, 2]], mask[[0, 0]]),
        (mask::BOUND_ONLY, mask::MEASURED),
        "the other is another image's"
    );
}

#[test]
fn bands_are_the_sums_of_their_rows() {
    let table = json!({ "kind": "bands", "from_rows": -3, "to_rows": 3, "width_rows": 3, "step_rows": 2 });
    let bands = spec(&table).unwrap();
    let film = bands.make(&stack(), &transport()).unwrap();
    let Product::Sequence { name, at, images, mask, .. } = film else { panic!() };
    assert_eq!((name.as_str(), at.as_slice()), ("bands_-3_to_3_3", [-3.0, -1.0, 1.0, 3.0].as_slice()));
    for (image, first) in images.outer_iter().zip([0, 2, 4, 6]) {
        assert_eq!(image, transport().t.slice(s![first..first + 3, .., ..]).sum_axis(Axis(0)));
    }
    assert_eq!((bands.images(&geometry()), mask[[0, 0]]), (4, mask::MEASURED));
    let beyond = spec(&json!({ "kind": "bands", "from_rows": 6, "to_rows": 9 })).unwrap().beyond((-4, 4));
    assert!(beyond.unwrap().contains("not within the reach of rows -4 to 4"));
    // Where no setting tells the rows next to the pixel's own apart, they are one band.
    let one_band = SweepStack { one_band: true, ..stack() };
    let single = spec(&json!({ "kind": "bands", "from_rows": -4, "to_rows": 3 })).unwrap();
    let Product::Sequence { at, images, .. } = single.make(&one_band, &transport()).unwrap() else {
        panic!()
    };
    assert_eq!(at, [-4.0, -3.0, 0.0, 3.0]);
    assert_eq!(images.index_axis(Axis(0), 2), transport().t.slice(s![2..7, .., ..]).sum_axis(Axis(0)));
    // No row is lost, though bands that divide these rows reach further.
    let wide = json!({ "kind": "bands", "from_rows": -3, "to_rows": 3, "width_rows": 3, "step_rows": 3 });
    let Product::Sequence { at, images, .. } = spec(&wide).unwrap().make(&one_band, &transport()).unwrap()
    else {
        panic!()
    };
    assert_eq!((at.as_slice(), images.len_of(Axis(0))), ([0.0].as_slice(), 1));
    assert_eq!(images.index_axis(Axis(0), 0), transport().t.sum_axis(Axis(0)));
}

#[test]
fn a_cross_section_cuts_its_three_images() {
    let stack =
        SweepStack { regular: Some(Array2::from_shape_fn((6, 3), |(t, s)| (10 * t + s) as f32)), ..stack() };
    let cut = |table: Value| {
        let Product::CrossSection(section) = spec(&table).unwrap().make(&stack, &transport()).unwrap() else {
            panic!()
        };
        section
    };
    let wide =
        |line: ndarray::ArrayView1<f32>| line.iter().map(|light| f64::from(*light)).collect::<Vec<_>>();
    let row = cut(json!({ "kind": "cross-section", "row": 4 }));
    let expected = [
        ("s", vec![0.0, 1.0, 2.0]),
        ("regular", vec![40.0, 41.0, 42.0]),
        ("captured", wide(stack.images.slice(s![1, 4, ..]))),
        ("sharpened", wide(transport().t.slice(s![4, 4, ..]))),
    ];
    assert_eq!((row.name.as_str(), row.columns().as_slice()), ("cross_section_t4", expected.as_slice()));
    let column = cut(json!({ "kind": "cross-section", "column": 1, "exposure_us": 200 }));
    assert_eq!(
        (column.along, &column.curves[1]),
        ("t", &("captured", wide(stack.images.slice(s![4, .., 1]))))
    );
}

#[test]
fn saturated_pixels_are_left_out_of_a_profile_and_said_to_be() {
    let mut stack = stack();
    let mut valid = Array3::from_elem(stack.images.dim(), true);
    valid[[1, 0, 0]] = false;
    stack.valid = Some(valid);
    stack.images[[0, 0, 0]] = 1e9;
    let make = |table: Value| spec(&table).unwrap().make(&stack, &transport());
    let Product::Profile(profile) = make(json!({ "kind": "delay-profile", "region": [0, 1, 0, 2] })).unwrap()
    else {
        panic!()
    };
    assert_eq!(profile.measured.light[0], f64::from(stack.images[[0, 0, 1]]));
    assert!(profile.about.contains("1 pixels that saturate"), "{}", profile.about);
    assert!(make(json!({ "kind": "delay-profile", "pixel": [0, 0] })).is_err(), "it saturates");
    assert!(make(json!({ "kind": "delay-profile", "pixel": [0, 0], "exposure_us": 200 })).is_ok());
}

/// Rows `rows` of stack and transport.
fn strip(stack: &SweepStack, rows: std::ops::Range<usize>) -> (SweepStack, Transport) {
    let (stack, transport) = (stack.clone(), transport());
    let cut = SweepStack {
        images: stack.images.slice(s![.., rows.clone(), ..]).to_owned(),
        valid: stack.valid.map(|valid| valid.slice(s![.., rows.clone(), ..]).to_owned()),
        regular: stack.regular.map(|regular| regular.slice(s![rows.clone(), ..]).to_owned()),
        variance_ratio: stack.variance_ratio.map(|ratio| ratio.slice(s![rows.clone(), ..]).to_owned()),
        ..stack
    };
    let t = transport.t.slice(s![.., rows.clone(), ..]).to_owned();
    let exists = transport.exists.slice(s![.., rows]).to_owned();
    let transport = Transport::measured(t, transport.u_min, exists);
    (cut, transport)
}

#[test]
fn products_of_strips_have_the_bits_of_the_whole() {
    let mut stack = stack();
    // Sums of thirds depend on their order.
    stack.images.mapv_inplace(|light| light / 3.0);
    stack.regular = Some(stack.images.sum_axis(Axis(0)));
    let mut valid = Array3::from_elem(stack.images.dim(), true);
    valid[[1, 4, 2]] = false;
    stack.valid = Some(valid);
    stack.noise = Some(NoiseModel { read_variance: 1e-4, gain: 1e-4 });
    stack.variance_ratio = Some(Array2::from_shape_fn((6, 3), |(t, s)| 1.0 / (1 + t + s) as f32));
    for table in [
        json!({ "kind": "regular" }),
        json!({ "kind": "epipolar", "width_rows": 3 }),
        json!({ "kind": "non-epipolar" }),
        json!({ "kind": "band", "from_rows": 1, "side": "below" }),
        json!({ "kind": "relight", "rows": [{ "first": 1, "last": 8, "weight": 0.3 }] }),
        json!({ "kind": "relight", "stripes": { "period_rows": 3, "lit_rows": 2, "phase_rows": 1 } }),
        json!({ "kind": "relight", "line": { "height_rows": 2, "step_rows": 2 } }),
        json!({ "kind": "bands", "from_rows": -2, "to_rows": 4, "width_rows": 3 }),
        json!({ "kind": "captured" }),
        json!({ "kind": "captured", "delay_us": 60, "exposure_us": 200 }),
        json!({ "kind": "cross-section", "row": 3 }),
        json!({ "kind": "cross-section", "column": 2 }),
        json!({ "kind": "delay-profile", "pixel": [3, 1] }),
        json!({ "kind": "delay-profile", "region": [1, 6, 0, 3] }),
        json!({ "kind": "uncertainty", "from_rows": 1, "to_rows": 3 }),
        json!({ "kind": "prior-bias", "from_rows": 1, "to_rows": 3 }),
        json!({ "kind": "uncertainty", "stripes": { "period_rows": 3, "lit_rows": 2 } }),
        json!({ "kind": "prior-bias", "rows": [{ "first": 1, "last": 3 }], "beam": "ideal" }),
    ] {
        let spec = spec(&table).unwrap();
        let whole = spec.make(&stack, &transport()).unwrap();
        for cuts in [vec![0, 4, 6], vec![0, 1, 2, 3, 4, 5, 6]] {
            let mut assembly = Assembly::new(spec.clone());
            for rows in cuts.windows(2) {
                let (stack, transport) = strip(&stack, rows[0]..rows[1]);
                assembly.add(rows[0], &stack, &transport).unwrap();
            }
            let assembled = assembly.finish().unwrap();
            assert_eq!(format!("{assembled:?}"), format!("{whole:?}"), "{table}");
        }
    }
}

#[test]
fn what_was_not_taken_is_not_made() {
    let mut stack = stack();
    stack.images = stack.images.slice(s![..1, .., ..]).to_owned();
    stack.settings.truncate(1);
    stack.exposures_us.truncate(1);
    stack.dark_frames.truncate(1);
    for table in [json!({ "kind": "regular" }), json!({ "kind": "delay-profile", "pixel": [0, 0] })] {
        assert!(spec(&table).unwrap().make(&stack, &transport()).is_err(), "{table}");
    }
}

#[test]
fn bad_tables_are_refused_by_field_and_value() {
    let cases = [
        (json!({ "kind": "epipola" }), "kind"),
        (json!({ "kind": "epipolar", "width_rows": 4 }), "width_rows"),
        (json!({ "kind": "epipolar", "width_rows": -1 }), "width_rows"),
        (json!({ "kind": "epipolar", "width_rows": "wide" }), "width_rows"),
        (json!({ "kind": "non-epipolar", "width": 3 }), "width"),
        (json!({ "kind": "regular", "width_rows": 1 }), "width_rows"),
        (json!({ "kind": "band" }), ""),
        (json!({ "kind": "band", "from_rows": 5, "to_rows": 4 }), "to_rows"),
        (json!({ "kind": "band", "from_rows": 5, "side": "left" }), "side"),
        (json!({ "kind": "bands", "from_rows": 1 }), ""),
        (json!({ "kind": "bands", "from_rows": 1, "to_rows": 0 }), "to_rows"),
        (json!({ "kind": "bands", "from_rows": -70000, "to_rows": 0 }), "from_rows"),
        (json!({ "kind": "bands", "from_rows": 0, "to_rows": 4, "width_rows": 2 }), "width_rows"),
        (json!({ "kind": "bands", "from_rows": 0, "to_rows": 4, "step_rows": 0 }), "step_rows"),
        (json!({ "kind": "captured", "delay_us": 10 }), "delay_us"),
        (json!({ "kind": "captured", "delay_us": 60, "exposure_us": 300 }), "delay_us"),
        (json!({ "kind": "captured", "exposure_us": 150 }), "exposure_us"),
        (json!({ "kind": "cross-section" }), "row"),
        (json!({ "kind": "cross-section", "row": 1, "column": 1 }), "row"),
        (json!({ "kind": "cross-section", "row": 6 }), "row"),
        (json!({ "kind": "cross-section", "column": 3 }), "column"),
        (json!({ "kind": "relight" }), ""),
        (json!({ "kind": "relight", "rows": [], "stripes": {} }), ""),
        (json!({ "kind": "relight", "rows": [] }), "rows"),
        (
            json!({ "kind": "relight", "rows": [{ "first": 0, "last": 1 }, { "first": 4, "last": 10 }] }),
            "rows.1.last",
        ),
        (json!({ "kind": "relight", "rows": [{ "first": 5, "last": 4 }] }), "rows.0.last"),
        (json!({ "kind": "relight", "rows": [{ "first": 10, "last": 12 }] }), "rows.0.first"),
        (json!({ "kind": "relight", "rows": [{ "first": 0, "last": 1, "weight": -0.5 }] }), "rows.0.weight"),
        (json!({ "kind": "relight", "stripes": { "period_rows": 0, "lit_rows": 1 } }), "stripes.period_rows"),
        (json!({ "kind": "relight", "stripes": { "period_rows": 4, "lit_rows": 5 } }), "stripes.lit_rows"),
        (
            json!({ "kind": "relight", "stripes": { "period_rows": 4, "lit_rows": 1, "phase_rows": 4 } }),
            "stripes.phase_rows",
        ),
        (json!({ "kind": "relight", "line": { "height_rows": 1, "step_rows": 0 } }), "line.step_rows"),
        (json!({ "kind": "relight", "line": { "height_rows": 11, "step_rows": 1 } }), "line.height_rows"),
        (json!({ "kind": "uncertainty" }), ""),
        (json!({ "kind": "uncertainty", "rows": [{ "first": 10, "last": 12 }] }), "rows.0.first"),
        (json!({ "kind": "uncertainty", "line": { "height_rows": 1, "step_rows": 1 } }), "line"),
        (json!({ "kind": "prior-bias", "from_rows": 1, "stripes": {} }), ""),
        (json!({ "kind": "delay-profile" }), "pixel"),
        (json!({ "kind": "delay-profile", "pixel": [6, 0] }), "pixel"),
        (json!({ "kind": "delay-profile", "pixel": [0] }), "pixel"),
        (json!({ "kind": "delay-profile", "region": [0, 6, 0, 4] }), "region"),
        (json!({ "kind": "delay-profile", "region": [3, 3, 0, 1] }), "region"),
        (json!({ "kind": "delay-profile", "pixel": [0, 0], "exposure_us": 150 }), "exposure_us"),
        (json!({ "kind": "delay-profile", "pixel": [0, 0], "exposure_us": 300 }), "exposure_us"),
        (json!({ "kind": "regular", "name": "../x" }), "name"),
        (json!({ "kind": "regular", "name": "" }), "name"),
        (json!({ "kind": "regular", "name": "x".repeat(65) }), "name"),
        (json!({ "kind": "regular", "name": "transport" }), "name"),
    ];
    let mut shown = String::new();
    for (table, path) in cases {
        let error = spec(&table).expect_err(&table.to_string());
        assert_eq!(error.path.join("."), path, "{table}: {error}");
        shown.push_str(&format!("{table}\n{error}\n\n"));
    }
    insta::assert_snapshot!(shown);
}

#[test]
fn names_tell_products_of_one_kind_apart() {
    let name = |table: Value| spec(&table).unwrap().name().to_owned();
    assert_eq!(name(json!({ "kind": "epipolar" })), "epipolar");
    assert_eq!(name(json!({ "kind": "epipolar", "width_rows": 5 })), "epipolar_5");
    assert_eq!(name(json!({ "kind": "non-epipolar", "width_rows": 5 })), "non_epipolar_5");
    assert_eq!(name(json!({ "kind": "band", "from_rows": 11 })), "band_from_11");
    assert_eq!(
        name(json!({ "kind": "band", "from_rows": 1, "to_rows": 3, "side": "below" })),
        "band_1_to_3_below"
    );
    assert_eq!(name(json!({ "kind": "delay-profile", "pixel": [1, 2] })), "delay_profile_t1_s2");
    assert_eq!(name(json!({ "kind": "band", "from_rows": 1, "name": "far-1_a" })), "far-1_a");
}

#[test]
fn rows_that_nothing_tells_apart_are_one_band() {
    let stack = SweepStack { one_band: true, ..stack() };
    let image = |table: Value| {
        let Product::Image { image, about, .. } = spec(&table).unwrap().make(&stack, &transport()).unwrap()
        else {
            panic!("{table} is no image")
        };
        (image, about)
    };
    let transport = transport();
    let (epipolar, about) = image(json!({ "kind": "epipolar" }));
    assert_eq!(epipolar, transport.epipolar(5));
    assert!(about.contains("|u| <= 2"), "{about}");
    assert_eq!(image(json!({ "kind": "non-epipolar" })).0, transport.non_epipolar(5));
    let band = |table: Value| image(table).0;
    assert_eq!(band(json!({ "kind": "band", "from_rows": 0, "to_rows": 1 })), transport.epipolar(5));
    assert_eq!(band(json!({ "kind": "band", "from_rows": 1, "to_rows": 2 })), transport.epipolar(5));
    assert_eq!(
        band(json!({ "kind": "band", "from_rows": 1, "to_rows": 4 })),
        transport.band(-4..=-3) + transport.band(3..=4)
    );
    assert_eq!(band(json!({ "kind": "band", "from_rows": 0 })), transport.total());
}
