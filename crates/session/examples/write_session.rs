//! Writes a complete session of a 15 x 5 delay-exposure sweep without noise into a data folder and prints its
//! path:
//!
//! `cargo run -p raysweep-session --example write_session -- DATA_FOLDER [SCENE.npy]`
//!
//! SCENE is float32 `[v, t, s]`, the image under each single projector row; without it, a small analytic
//! scene is used. The example shows how the parts of the crate work together, and creates test data for
//! readers in other languages.

use std::collections::BTreeMap;
use std::error::Error;
use std::fs::File;
use std::path::Path;

use ndarray::{Array2, Array3, ArrayView3, Axis, s};
use ndarray_npy::ReadNpyExt;
use raysweep_core::Counts;
use raysweep_session::ledger::{EndEntry, EndState, Entry, Ledger, PointEntry, SessionEntry};
use raysweep_session::report::{
    Block, ContactSheet, Guide, Marker, NoteLevel, Picture, Plot, Report, Section, Series, SeriesStyle,
    Table, ToneMap,
};
use raysweep_session::stack::{ArrayName, Contents, Stack, StackShape};
use raysweep_session::{Session, durable, manifest, transport};
use serde_json::{Map, Value, json};

const ROW_TIME_US: f64 = 22.22;
const FRAMES: u32 = 8;
const WHITE_DN: f64 = 400.0;
const BLACK_DN: f64 = 16.0;

fn main() -> Result<(), Box<dyn Error>> {
    let mut arguments = std::env::args().skip(1);
    let root = arguments.next().ok_or("usage: write_session DATA_FOLDER [SCENE.npy]")?;
    let scene = match arguments.next() {
        Some(path) => Array3::<f32>::read_npy(File::open(path)?)?,
        None => analytic_scene(24, 20, 70),
    };
    let delays_us: Vec<f64> = (0..15).map(|index| -1500.0 + 3000.0 / 14.0 * f64::from(index)).collect();
    let exposures_us = [600.0, 750.0, 900.0, 1050.0, 1200.0];
    let session = acquire(Path::new(&root), &scene, &delays_us, &exposures_us)?;
    process(&session, &scene, &delays_us, &exposures_us)?;
    println!("{}", session.dir().display());
    Ok(())
}

/// Direct light in its own row over a texture, and an indirect tail that is stronger from below.
fn analytic_scene(projector_rows: usize, rows: usize, columns: usize) -> Array3<f32> {
    Array3::from_shape_fn((projector_rows, rows, columns), |(v, t, s)| {
        let u = v as f32 - t as f32;
        let texture = 0.6 + 0.4 * ((s as f32 * 0.3).sin() * (t as f32 * 0.5).cos());
        let tail = 0.04 * (-(u - 2.0).powi(2) / 18.0).exp();
        texture * (if u == 0.0 { 1.0 } else { 0.0 } + tail)
    })
}

fn acquire(
    root: &Path,
    scene: &Array3<f32>,
    delays_us: &[f64],
    exposures_us: &[f64],
) -> Result<Session, Box<dyn Error>> {
    let (_, rows, columns) = scene.dim();
    let shape = StackShape {
        contents: Contents::Sweep {
            points: delays_us.len() * exposures_us.len(),
            exposures: exposures_us.len(),
        },
        rows,
        columns,
    };
    let header = SessionEntry {
        format: raysweep_session::ledger::FORMAT,
        name: "v-groove".into(),
        kind: "sweep".into(),
        operator: Some("Ada".into()),
        sample: Some("printed V-groove".into()),
        note: None,
        tags: vec!["example".into()],
        created: "2026-03-04T05:06:07Z".parse()?,
        software: concat!("raysweep ", env!("CARGO_PKG_VERSION")).into(),
        shape,
        first_row: 0,
    };
    let started = header.created;
    let (session, mut ledger) = Session::create(root, header, "kind = \"sweep\"\n", "kind = \"plane\"\n")?;
    ledger.append(&Entry::Run { started, resumed: false })?;
    let stack = session.stack()?;
    let mut store = |array, index, exposure_us, delay_us, image: &Array2<f32>| {
        store_point(&stack, &mut ledger, array, index, (exposure_us, delay_us), image)
    };
    for (exposure_index, &exposure_us) in exposures_us.iter().enumerate() {
        store(ArrayName::Dark, exposure_index, exposure_us, 0.0, &Array2::zeros((rows, columns)))?;
        for (delay_index, &delay_us) in delays_us.iter().enumerate() {
            let index = exposure_index * delays_us.len() + delay_index;
            store(
                ArrayName::Sum,
                index,
                exposure_us,
                delay_us,
                &expose(scene.view(), delay_us, exposure_us),
            )?;
        }
    }
    store(ArrayName::Regular, 0, 16_666.0, 0.0, &scene.sum_axis(Axis(0)))?;
    ledger.append(&Entry::End(EndEntry::new(EndState::Complete, shape.points(), 0, Vec::new())))?;
    Ok(session)
}

/// The image of one setting: each projector row, weighted with the share of its dwell time within the
/// exposure.
fn expose(scene: ArrayView3<f32>, delay_us: f64, exposure_us: f64) -> Array2<f32> {
    let (_, rows, columns) = scene.dim();
    let mut image = Array2::zeros((rows, columns));
    for ((v, t, s), &value) in scene.indexed_iter() {
        let lit_us = (v as f64 - t as f64) * ROW_TIME_US;
        let start_us = (lit_us - ROW_TIME_US / 2.0).max(delay_us - exposure_us / 2.0);
        let end_us = (lit_us + ROW_TIME_US / 2.0).min(delay_us + exposure_us / 2.0);
        image[[t, s]] += value * ((end_us - start_us).max(0.0) / ROW_TIME_US) as f32;
    }
    image
}

fn store_point(
    stack: &Stack,
    ledger: &mut Ledger,
    array: ArrayName,
    index: usize,
    (exposure_us, delay_us): (f64, f64),
    image: &Array2<f32>,
) -> Result<(), raysweep_session::Error> {
    let counts = image.mapv(|value| {
        u32::try_from((f64::from(FRAMES) * (BLACK_DN + WHITE_DN * f64::from(value))).round() as i64)
            .unwrap_or(0)
    });
    let crc32 = stack.write(array, index, counts.view())?;
    let delays_us = match array {
        ArrayName::Sum => (0..FRAMES).map(|frame| delay_us + f64::from(frame) * 0.1 - 0.35).collect(),
        ArrayName::Dark | ArrayName::Regular | ArrayName::Clipped => Vec::new(),
    };
    ledger.append(&Entry::Point(PointEntry {
        array,
        index,
        attempt: 0,
        frames: FRAMES,
        exposure_us,
        delay_us,
        delays_us,
        counts: Counts {
            expected: u64::from(FRAMES) + 1,
            averaged: FRAMES.into(),
            settling: 1,
            ..Counts::default()
        },
        crc32,
        clipped_crc32: None,
        exposed: None,
    }))
}

fn process(
    session: &Session,
    scene: &Array3<f32>,
    delays_us: &[f64],
    exposures_us: &[f64],
) -> Result<(), Box<dyn Error>> {
    let transport = relative_rows(scene);
    let (depth, rows, _) = transport.dim();
    let u_min = 1 - rows as i64;
    let details = to_map(json!({
        "axes": ["u", "t", "s"], "u_min": u_min, "u_max": u_min + depth as i64 - 1, "row_time_us": ROW_TIME_US,
        "prior": "none: the truth of the scene",
    }));
    transport::write(&session.transport_path(), transport.view(), &details)?;
    let epipolar = transport.index_axis(Axis(0), rows - 1);
    let non_epipolar = &transport.sum_axis(Axis(0)) - &epipolar;
    let regular = transport.sum_axis(Axis(0));
    let products = session.products();
    products.volume("transport", transport.view(), &details)?;
    let metadata =
        |what: &str| to_map(json!({ "what": what, "units": "1 = white Lambertian", "axes": ["t", "s"] }));
    products.image("epipolar", epipolar, &metadata("light of the pixel's own row, u = 0"))?;
    products.image("non_epipolar", non_epipolar.view(), &metadata("light of all other rows"))?;
    products.image("regular", regular.view(), &metadata("all rows lit"))?;
    let tint = ndarray::stack(Axis(2), &[regular.view(), epipolar, non_epipolar.view()])?;
    products.rgb("composite", tint.view(), &metadata("R all, G epipolar, B non-epipolar"))?;

    let report = make_report(session, &transport, delays_us, exposures_us)?;
    durable::write(&session.report_path(), report.to_html()?.as_bytes())?;
    let software = BTreeMap::from([("raysweep".to_owned(), env!("CARGO_PKG_VERSION").to_owned())]);
    let settings = to_map(json!({ "camera": { "shutter": "rolling" }, "row_time_us": ROW_TIME_US }));
    manifest::write(session, &session.state()?, software, settings)?;
    Ok(())
}

/// Converts `[v, t, s]` to `[u, t, s]` with u = v - t; rows that do not exist stay 0.
fn relative_rows(scene: &Array3<f32>) -> Array3<f32> {
    let (projector_rows, rows, columns) = scene.dim();
    let mut transport = Array3::zeros((projector_rows + rows - 1, rows, columns));
    for ((v, t, s), &value) in scene.indexed_iter() {
        transport[[v + rows - 1 - t, t, s]] = value;
    }
    transport
}

fn make_report(
    session: &Session,
    transport: &Array3<f32>,
    delays_us: &[f64],
    exposures_us: &[f64],
) -> Result<Report, raysweep_session::Error> {
    let (_, rows, columns) = transport.dim();
    let state = session.state()?;
    let frames = session
        .stack()?
        .read(ArrayName::Sum)?
        .mapv(|sum| ((f64::from(sum) / f64::from(FRAMES) - BLACK_DN) / WHITE_DN) as f32);
    let epipolar = transport.index_axis(Axis(0), rows - 1);
    let regular = transport.sum_axis(Axis(0));
    let non_epipolar = &regular - &epipolar;
    let scale = |image: &Array2<f32>| ToneMap::percentile(&[image.view()], 99.5);
    let pixels = [(rows / 4, columns / 3), (rows / 2, columns / 2), (3 * rows / 4, 3 * columns / 4)];
    let markers = (1..)
        .zip(pixels)
        .map(|(number, (row, column))| Marker { label: number.to_string(), row, column })
        .collect();
    let view = scale(&regular);
    let images = vec![
        Picture::grey(epipolar, view).with_caption("Epipolar").with_markers(markers),
        Picture::grey(non_epipolar.view(), scale(&non_epipolar)).with_caption("Non-epipolar"),
        Picture::grey(regular.view(), view).with_caption("Regular"),
    ];

    let sheet_scale = ToneMap::percentile(&frames.axis_iter(Axis(0)).collect::<Vec<_>>(), 99.5);
    let thumbnails = frames.axis_iter(Axis(0)).map(|frame| Some(Picture::thumbnail(frame, sheet_scale)));
    let sheet = ContactSheet {
        column_title: "delay / µs".into(),
        columns: delays_us.iter().map(|delay_us| format!("{delay_us:.0}")).collect(),
        row_title: "exposure / µs".into(),
        rows: exposures_us.iter().map(|exposure_us| format!("{exposure_us:.0}")).collect(),
        pictures: thumbnails.collect(),
    };

    let profile = |(number, (row, column)): (usize, (usize, usize))| {
        let values = frames.slice(s![..delays_us.len(), row, column]);
        let points = delays_us.iter().copied().zip(values.iter().map(|&value| f64::from(value))).collect();
        Series::line(format!("{number} ({row}, {column})"), points)
    };
    let profiles = Plot {
        title: format!("Delay profiles at {} µs", exposures_us[0]),
        x_label: "delay / µs".into(),
        y_label: "intensity".into(),
        series: (1..).zip(pixels).map(profile).collect(),
        guides: vec![Guide { x: 0.0, label: "u = 0".into() }],
    };
    let jitter = Plot {
        title: "VSYNC jitter".into(),
        x_label: "edge minus fitted clock / µs".into(),
        y_label: "edges".into(),
        series: vec![Series {
            name: "edges".into(),
            style: SeriesStyle::Bars,
            points: (-12..=12)
                .map(|bin| 0.25 * f64::from(bin))
                .map(|x| (x, (90.0 * (-x * x / 0.9).exp()).round()))
                .collect(),
        }],
        guides: Vec::new(),
    };
    let count = |name: &str, value: u64| vec![name.to_owned(), value.to_string()];
    let losses = Table {
        headers: vec!["frames".into(), "count".into()],
        rows: vec![
            count("expected", state.counts.expected),
            count("averaged", state.counts.averaged),
            count("settling", state.counts.settling),
            count("cancelled", state.counts.cancelled),
            count("lost", state.counts.lost_total()),
        ],
    };
    let pair = |key: &str, value: &str| (key.to_owned(), value.to_owned());
    let section =
        |title: &str, intro: &str, blocks| Section { title: title.into(), intro: intro.into(), blocks };
    Ok(Report {
        title: state.session.name.clone(),
        subtitle: format!("{} · {} · {}", state.session.kind, state.session.created, state.session.software),
        facts: vec![
            pair("Operator", "Ada"),
            pair("Sample", "printed V-groove"),
            pair(
                "Points",
                &format!("{} of {}", state.stored(ArrayName::Sum).count(), state.session.shape.points()),
            ),
            pair("Frames", &state.counts.averaged.to_string()),
            pair("Frame", &format!("{columns} × {rows}")),
            pair("Lost", &state.counts.lost_total().to_string()),
        ],
        sections: vec![
            section(
                "Light transport",
                "Light that arrives from the pixel's own projector row, from all others, and both together.",
                vec![Block::Pictures(images)],
            ),
            section(
                "Sweep",
                "Every stored image, averaged, black level subtracted.",
                vec![Block::ContactSheet(sheet)],
            ),
            section(
                "Profiles",
                "At the pixels that are marked above.",
                vec![Block::Plots(vec![profiles, jitter])],
            ),
            section(
                "Frames",
                "expected = averaged + settling + cancelled + lost",
                vec![
                    Block::Note(NoteLevel::Info, "This session has no noise: it shows the layout.".into()),
                    Block::Table(losses),
                ],
            ),
            section(
                "Settings",
                "",
                vec![Block::Facts(vec![
                    pair("row time", "22.22 µs"),
                    pair("frames averaged", "8"),
                    pair("black level", "16 DN"),
                    pair("white", "400 DN per row dwell"),
                ])],
            ),
        ],
    })
}

fn to_map(value: Value) -> Map<String, Value> {
    match value {
        Value::Object(map) => map,
        _ => Map::new(),
    }
}
