use super::*;
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use ndarray::{Array2, Array3, ArrayView2, array};

fn page(blocks: Vec<Block>) -> String {
    let section = Section { title: "S".into(), intro: String::new(), blocks };
    Report { title: "R".into(), sections: vec![section], ..Report::default() }.to_html().unwrap()
}

/// The decoded pixels of the pictures in a page, with their width.
fn pictures(html: &str) -> Vec<(u32, Vec<u8>)> {
    html.split("data:image/png;base64,")
        .skip(1)
        .map(|rest| {
            let bytes = STANDARD.decode(&rest[..rest.find('"').unwrap()]).unwrap();
            let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
            let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
            let info = reader.next_frame(&mut pixels).unwrap();
            (info.width, pixels)
        })
        .collect()
}

#[test]
fn grey_levels_are_those_of_srgb() {
    // IEC 61966-2-1: linear 0.214 is level 0.5 (127.5), linear 0.0031308 level 0.04045 (10.3).
    let image = array![[0.0, 0.5 * 0.214_041, 0.5, 7.0, -1.0, f32::NAN, 0.5 * 0.003_130_8]];
    let html = page(vec![Block::Pictures(vec![Picture::grey(image.view(), ToneMap { white: 0.5 })])]);
    let (width, levels) = pictures(&html).remove(0);
    assert_eq!(width, 7);
    assert!((127..=128).contains(&levels[1]));
    assert_eq!([levels[0], levels[2], levels[3], levels[4], levels[5], levels[6]], [0, 255, 255, 0, 0, 10]);
    assert!(html.contains("white = 0.5 · 7 × 1 px<"), "the scale is stated");
}

#[test]
fn images_one_after_the_other_are_toned_and_reduced_as_if_they_were_there_at_once() {
    // More pixels than samples, and sizes that are not multiples of the step.
    let image = |seed: usize| {
        Array2::from_shape_fn((701, 811), |(t, s)| ((t * 811 + s + seed) * 2_654_435_761 % 10_007) as f32)
    };
    let images = [image(1), image(2), image(3)];
    let flat: Vec<f32> = images.iter().flatten().copied().collect();
    let mut sampled: Vec<f32> = flat.into_iter().step_by(2).collect();
    sampled.sort_by(f32::total_cmp);
    let mut samples = ToneSamples::new(3 * 701 * 811);
    images.iter().for_each(|image| samples.add(image.view()));
    for percent in [99.5, 70.0] {
        let white = sampled[(percent / 100.0 * (sampled.len() - 1) as f64).round() as usize];
        assert_eq!(samples.percentile(percent).white, white);
    }
    let tone_map = samples.percentile(90.0);
    let png = |image: ArrayView2<f32>| Picture::thumbnail(image, tone_map).to_png().unwrap();
    assert!(png(images[1].view()) == png(Picture::reduced(images[1].view()).view()));
}

#[test]
fn a_percentile_leaves_that_share_of_the_pixels_in_range() {
    let ramp = Array2::from_shape_fn((100, 100), |(t, s)| (t * 100 + s) as f32);
    let white = ToneMap::percentile(&[ramp.view()], 99.0).white;
    assert!((9899.0..=9901.0).contains(&white), "{white}");
    let odd = array![[f32::NAN, f32::INFINITY, 3.0]];
    assert_eq!(ToneMap::percentile(&[odd.view()], 50.0).white, 3.0);
    assert_eq!(ToneMap::percentile(&[Array2::zeros((2, 2)).view()], 99.0).white, 1.0);
    assert_eq!(ToneMap::percentile(&[], 99.0).white, 1.0);
}

#[test]
fn a_large_picture_is_reduced_by_averaging() {
    let image = Array2::from_shape_fn((3, 2050), |(_, s)| (s % 3) as f32);
    let html = page(vec![Block::Pictures(vec![Picture::grey(image.view(), ToneMap { white: 2.0 })])]);
    let (width, levels) = pictures(&html).remove(0);
    assert_eq!(width, 684);
    assert!(levels[..683].iter().all(|&level| level == 188), "the mean of 0, 1 and 2 is half of white");
    assert!(html.contains("shown 1:3"));
}

#[test]
fn an_animation_holds_every_picture_in_order() {
    let images = [0.0, 1.0, 0.25].map(|light: f32| Array2::from_elem((2, 3), light));
    let views: Vec<_> = images.iter().map(|image| image.view().insert_axis(ndarray::Axis(2))).collect();
    let picture = Picture::animation(&views, ToneMap { white: 1.0 }).unwrap();
    let html = page(vec![Block::Pictures(vec![picture])]);
    let encoded = html.split("data:image/png;base64,").nth(1).unwrap().split('"').next().unwrap();
    let mut reader =
        png::Decoder::new(std::io::Cursor::new(STANDARD.decode(encoded).unwrap())).read_info().unwrap();
    assert_eq!(reader.info().animation_control.unwrap().num_frames, 3);
    let mut pixels = vec![0; reader.output_buffer_size().unwrap()];
    let mut shown = Vec::new();
    while reader.next_frame(&mut pixels).is_ok() {
        shown.push(pixels.clone());
    }
    assert_eq!(shown, [vec![0; 6], vec![255; 6], vec![137; 6]]);
    assert!(Picture::animation(&[], ToneMap { white: 1.0 }).is_none());
}

#[test]
fn colours_keep_their_places() {
    let mut image = Array3::<f32>::zeros((1, 2, 3));
    image[[0, 0, 0]] = 1.0;
    image[[0, 1, 2]] = 1.0;
    let html = page(vec![Block::Pictures(vec![Picture::rgb(image.view(), ToneMap { white: 1.0 })])]);
    assert_eq!(pictures(&html), [(2, vec![255, 0, 0, 0, 0, 255])]);
    let odd = Array3::<f32>::zeros((1, 2, 2));
    let block = Block::Pictures(vec![Picture::rgb(odd.view(), ToneMap { white: 1.0 })]);
    let section = Section { blocks: vec![block], ..Section::default() };
    assert!(Report { sections: vec![section], ..Report::default() }.to_html().is_err());
}

#[test]
fn a_contact_sheet_shows_what_is_missing_in_its_place() {
    let level = |value| Some(Picture::thumbnail(array![[value]].view(), ToneMap { white: 1.0 }));
    let sheet = ContactSheet {
        column_title: "delay / µs".into(),
        columns: vec!["-5".into(), "5".into()],
        row_title: "exposure / µs".into(),
        rows: vec!["600".into(), "700".into()],
        pictures: vec![level(1.0), None, level(0.0)],
    };
    let html = page(vec![Block::ContactSheet(sheet)]);
    let levels: Vec<_> = pictures(&html).into_iter().map(|(_, pixels)| pixels[0]).collect();
    assert_eq!(levels, [255, 0]);
    assert!(html.contains("exposure / µs 600, delay / µs 5: missing"));
    assert!(html.contains("exposure / µs 700, delay / µs 5: missing"));
    assert!(html.contains("hatched: 2 missing"));
}

#[test]
fn labels_of_crosses_lie_within_the_picture() {
    let image = Array2::<f32>::zeros((100, 100));
    let text = |row, column| {
        let marker = Marker { label: "4".into(), row, column };
        let picture = Picture::grey(image.view(), ToneMap { white: 1.0 }).with_markers(vec![marker]);
        let html = page(vec![Block::Pictures(vec![picture])]);
        let svg = html.split("class=\"markers\"").nth(1).unwrap();
        svg.split("<text ").nth(1).unwrap().split("</text>").next().unwrap().to_owned()
    };
    let inside = text(50, 50);
    assert!(inside.starts_with("x=\"53\" y=\"48.8\" fill"), "{inside}");
    let right = text(50, 99);
    assert!(right.starts_with("x=\"97\" y=\"48.8\" text-anchor=\"end\""), "{right}");
    let top = text(0, 50);
    assert!(top.starts_with("x=\"53\" y=\"6.66\" fill"), "{top}");
}

#[test]
fn texts_are_escaped_everywhere() {
    let evil = "<script>alert(\"x\")</script>";
    let picture = Picture::grey(array![[1.0]].view(), ToneMap { white: 1.0 });
    let marker = Marker { label: evil.into(), row: 0, column: 0 };
    let plot = Plot {
        title: evil.into(),
        x_label: evil.into(),
        y_label: evil.into(),
        series: vec![Series::line(evil, vec![(0.0, 1.0)]), Series::line(evil, vec![(1.0, 1.0)])],
        guides: vec![Guide { x: 0.0, label: evil.into() }],
    };
    let sheet = ContactSheet {
        column_title: evil.into(),
        columns: vec![evil.into()],
        row_title: evil.into(),
        rows: vec![evil.into()],
        pictures: vec![Some(picture.clone())],
    };
    let section = Section {
        title: evil.into(),
        intro: evil.into(),
        blocks: vec![
            Block::Facts(vec![(evil.into(), evil.into())]),
            Block::Table(Table { headers: vec![evil.into()], rows: vec![vec![evil.into()]] }),
            Block::Pictures(vec![picture.with_caption(evil).with_markers(vec![marker])]),
            Block::ContactSheet(sheet),
            Block::Plots(vec![plot]),
            Block::Note(NoteLevel::Error, evil.into()),
        ],
    };
    let report = Report {
        title: evil.into(),
        subtitle: evil.into(),
        facts: vec![(evil.into(), evil.into())],
        sections: vec![section],
    };
    let html = report.to_html().unwrap();
    assert!(!html.contains("<script"));
    assert!(html.matches("&lt;script").count() >= 22, "{}", html.matches("&lt;script").count());
}

#[test]
fn a_page_loads_nothing() {
    let plot = Plot { series: vec![Series::line("a", vec![(0.0, 1.0), (1.0, 3.0)])], ..Plot::default() };
    let html = page(vec![Block::Plots(vec![plot])]);
    for loader in ["<link", "<script", "@import", "url(", " href="] {
        assert!(!html.contains(loader), "{loader}");
    }
    assert!(html.contains("currentColor") && !html.contains("#010203"), "plots take the page's ink");
}

#[test]
fn plots_survive_values_that_are_no_numbers() {
    let nothing = vec![(f64::NAN, 1.0), (1.0, f64::INFINITY)];
    for (style, points) in [
        (SeriesStyle::Line, nothing.clone()),
        (SeriesStyle::Bars, Vec::new()),
        (SeriesStyle::Dots, vec![(2.0, 0.0)]),
        (SeriesStyle::Bars, vec![(1.0, -3.0), (1.0, 5.0)]),
        (SeriesStyle::Line, vec![(1e300, -1e300), (-1e300, 1e300)]),
        (SeriesStyle::Line, vec![(1e-300, 1e-300), (2e-300, 3e-300)]),
        (SeriesStyle::Line, nothing.into_iter().chain([(0.0, 1e9)]).collect()),
    ] {
        let empty = !points.iter().any(|(x, y)| x.is_finite() && y.is_finite());
        let series = vec![Series { name: "a".into(), style, points: points.clone() }];
        let guides = vec![Guide { x: f64::NAN, label: String::new() }];
        let html = page(vec![Block::Plots(vec![Plot { series, guides, ..Plot::default() }])]);
        assert_eq!(html.contains("no data"), empty, "{points:?}");
    }
}

#[test]
fn a_contact_sheet_of_a_whole_sweep_stays_small() {
    // Noise compresses worst.
    let noise = |seed: usize| {
        Array2::from_shape_fn((128, 128), |(t, s)| {
            ((t * 128 + s + seed * 16_384).wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 40) as f32
                / (1 << 24) as f32
        })
    };
    let pictures = (0..75).map(|seed| Some(Picture::thumbnail(noise(seed).view(), ToneMap { white: 1.0 })));
    let sheet = ContactSheet {
        columns: (0..15).map(|column| column.to_string()).collect(),
        rows: (0..5).map(|row| row.to_string()).collect(),
        pictures: pictures.collect(),
        ..ContactSheet::default()
    };
    let html = page(vec![Block::ContactSheet(sheet)]);
    assert!(html.len() < 2_000_000, "{}", html.len());
}

#[test]
fn numbers_have_three_digits() {
    for (value, text) in [
        (0.0, "0"),
        (0.834_56, "0.835"),
        (1.0, "1"),
        (-1285.7, "-1286"),
        (20.0, "20"),
        (0.000_012_3, "1.23e-5"),
        (1.5e7, "1.50e7"),
    ] {
        assert_eq!(style::short(value), text);
    }
}
