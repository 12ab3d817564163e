use super::*;
use exr::prelude::read_first_flat_layer_from_file;
use ndarray::{Array2, Array3};
use ndarray_npy::{ReadNpyExt, read_npy};
use serde_json::json;
use std::fs;

fn metadata() -> Map<String, Value> {
    let value = json!({ "what": "Größe in µm", "delay_us": [-1500.0, 0.5], "average": 8, "zebra": null, "axes": ["t", "s"],
        "a_key_that_is_longer_than_the_thirty_one_bytes_of_a_short_name": true });
    value.as_object().cloned().unwrap()
}

fn image(rows: usize, columns: usize) -> Array2<f32> {
    let mut image = Array2::from_shape_fn((rows, columns), |(t, s)| t as f32 * 100.0 + s as f32 / 3.0 - 5.0);
    image[[0, 0]] = f32::INFINITY;
    image
}

fn products() -> (tempfile::TempDir, Products) {
    let dir = tempfile::tempdir().unwrap();
    let products = Products::new(dir.path().join("products"));
    (dir, products)
}

fn exr_channels(path: &Path) -> Vec<(String, Vec<f32>)> {
    let image = read_first_flat_layer_from_file(path).unwrap();
    let channels = image.layer_data.channel_data.list;
    channels
        .iter()
        .map(|channel| (channel.name.to_string(), channel.sample_data.values_as_f32().collect()))
        .collect()
}

#[test]
fn an_image_is_the_same_in_exr_and_npy_with_its_metadata() {
    let (_dir, products) = products();
    let values = image(20, 33);
    products.image("epipolar", values.view(), &metadata()).unwrap();
    let path = |extension: &str| products.dir().join(format!("epipolar.{extension}"));
    assert_eq!(products.read_image("epipolar").unwrap(), values);
    assert_eq!(exr_channels(&path("exr")), [("Y".to_owned(), values.iter().copied().collect())]);
    let sidecar: Value = serde_json::from_slice(&fs::read(path("json")).unwrap()).unwrap();
    assert_eq!(sidecar, Value::Object(metadata()));

    let header = read_first_flat_layer_from_file(path("exr")).unwrap().layer_data.attributes;
    let text = |key: &str| {
        let name = exr::prelude::Text::from(key);
        let exr::prelude::attribute::AttributeValue::Text(text) = &header.other[&name] else {
            panic!("{key}")
        };
        String::from_utf8(text.as_slice().to_vec()).unwrap()
    };
    assert_eq!(text("raysweep.what"), "Größe in µm");
    assert_eq!(text("raysweep.delay_us"), "[-1500.0,0.5]");
    assert_eq!(text("raysweep.average"), "8");
}

#[test]
fn a_sequence_has_a_layer_for_each_image() {
    let (_dir, products) = products();
    let values = Array3::from_shape_fn((3, 5, 4), |(k, t, s)| (100 * k + 10 * t + s) as f32);
    let layers = ["k0", "k1", "k2"].map(str::to_owned);
    products.sequence("line", values.view(), &layers, &metadata()).unwrap();
    let plane = |k: usize| values.index_axis(Axis(0), k).iter().copied().collect::<Vec<f32>>();
    let expected: Vec<_> =
        layers.iter().enumerate().map(|(k, layer)| (format!("{layer}.Y"), plane(k))).collect();
    assert_eq!(exr_channels(&products.dir().join("line.exr")), expected);
    let back: Array3<f32> = read_npy(products.dir().join("line.npy")).unwrap();
    assert_eq!(back, values);
    assert_eq!(
        products.read_image_of("line", 2).unwrap(),
        (values.index_axis(Axis(0), 2).to_owned().into_dyn(), 3)
    );
    let beyond = products.read_image_of("line", 3).unwrap_err().to_string();
    assert!(beyond.contains("image 3, counted from 0") && beyond.contains("[3, 5, 4]"), "{beyond}");
    products.image("single", values.index_axis(Axis(0), 0), &metadata()).unwrap();
    assert!(matches!(products.read_image_of("single", 0), Err(Error::Shape { .. })));
    // A colour image, from a file that holds a multiple of it.
    let colour =
        ndarray::Array4::from_shape_fn((2, 3, 4, 3), |(k, t, s, c)| (1000 * k + 100 * t + 10 * s + c) as f32);
    ndarray_npy::write_npy(products.dir().join("colour.npy"), &colour).unwrap();
    let second = colour.index_axis(Axis(0), 1).to_owned().into_dyn();
    assert_eq!(products.read_image_of("colour", 1).unwrap(), (second, 2));
    let short = products.sequence("line", values.view(), &layers[..2], &metadata());
    assert!(matches!(short, Err(Error::Shape { .. })));
}

#[test]
fn a_table_says_the_same_in_csv_and_npy() {
    let (_dir, products) = products();
    let columns = [("delay_us", vec![-1.5, 0.1]), ("light", vec![0.25, f64::NAN])];
    products.table("profile", &columns, &metadata()).unwrap();
    let csv = fs::read_to_string(products.dir().join("profile.csv")).unwrap();
    assert_eq!(csv, "delay_us,light\n-1.5,0.25\n0.1,NaN\n");
    let back: Array2<f32> = read_npy(products.dir().join("profile.npy")).unwrap();
    assert_eq!((back.dim(), back[[0, 0]], back[[1, 0]], back[[0, 1]]), ((2, 2), -1.5, 0.1, 0.25));
    let uneven = [("delay_us", vec![-1.5, 0.1]), ("light", vec![0.25])];
    assert!(matches!(products.table("profile", &uneven, &metadata()), Err(Error::Shape { .. })));
}

#[test]
fn colours_keep_their_places() {
    let (_dir, products) = products();
    let values = Array3::from_shape_fn((4, 5, 3), |(t, s, c)| (c * 100 + t * 10 + s) as f32);
    products.rgb("composite", values.view(), &metadata()).unwrap();
    let channels = exr_channels(&products.dir().join("composite.exr"));
    // OpenEXR sorts channels by name.
    for ((name, found), (expected_name, c)) in channels.iter().zip([("B", 2), ("G", 1), ("R", 0)]) {
        assert_eq!(name, expected_name);
        assert_eq!(*found, values.index_axis(Axis(2), c).iter().copied().collect::<Vec<_>>());
    }
    let back: Array3<f32> = read_npy(products.dir().join("composite.npy")).unwrap();
    assert_eq!(back, values);
    let four = Array3::<f32>::zeros((4, 5, 4));
    assert!(matches!(products.rgb("composite", four.view(), &metadata()), Err(Error::Shape { .. })));
}

#[test]
fn a_volume_is_written_in_c_order_whatever_its_order_in_memory() {
    let (_dir, products) = products();
    let values = Array3::from_shape_fn((3, 4, 5), |(u, t, s)| (u * 100 + t * 10 + s) as f32);
    let turned = values.t().as_standard_layout().into_owned();
    products.volume("transport", turned.t(), &metadata()).unwrap();
    let bytes = fs::read(products.dir().join("transport.npy")).unwrap();
    let header = String::from_utf8_lossy(&bytes[..128]).into_owned();
    assert!(header.contains("'fortran_order': False") && header.contains("'<f4'"), "{header}");
    assert_eq!(Array3::<f32>::read_npy(bytes.as_slice()).unwrap(), values);
    assert!(!products.dir().join("transport.exr").exists());
}

#[test]
fn a_volume_in_strips_has_the_bytes_of_the_whole() {
    let (_dir, products) = products();
    let values = Array3::from_shape_fn((4, 7, 5), |(u, t, s)| (u * 100 + t * 10 + s) as f32 / 3.0);
    products.volume("whole", values.view(), &metadata()).unwrap();
    let mut writer = products.volume_writer("strips", (4, 7, 5), &metadata()).unwrap();
    for rows in [0..3, 3..4, 4..7] {
        writer.append(values.slice(ndarray::s![.., rows, ..])).unwrap();
        assert!(!products.dir().join("strips.npy").exists(), "nothing is seen before the end");
    }
    assert!(matches!(writer.append(values.slice(ndarray::s![.., ..1, ..])), Err(Error::Shape { .. })));
    writer.commit().unwrap();
    for extension in ["npy", "json"] {
        let bytes = |name: &str| fs::read(products.dir().join(format!("{name}.{extension}"))).unwrap();
        assert!(bytes("strips") == bytes("whole"), "{extension}");
    }
    let mut cut_short = products.volume_writer("strips", (4, 7, 5), &metadata()).unwrap();
    cut_short.append(values.slice(ndarray::s![.., ..6, ..])).unwrap();
    assert!(matches!(cut_short.commit(), Err(Error::Shape { .. })));
    assert_eq!(fs::read_dir(products.dir()).unwrap().count(), 4, "what was not whole left nothing");
}

#[test]
fn the_same_image_gives_the_same_bytes() {
    let (_dir, products) = products();
    let bytes = |name: &str| {
        products.image(name, image(40, 50).view(), &metadata()).unwrap();
        fs::read(products.dir().join(format!("{name}.exr"))).unwrap()
    };
    let first = bytes("a");
    for name in ["b", "c", "d", "e", "f", "g"] {
        assert!(bytes(name) == first, "{name}");
    }
}

#[test]
fn names_that_would_leave_the_folder_and_empty_images_are_refused() {
    let (dir, products) = products();
    for name in ["", "../plan", "a/b", ".hidden", "a.b", "ä"] {
        assert!(
            matches!(products.image(name, image(2, 2).view(), &metadata()), Err(Error::Codec { .. })),
            "{name}"
        );
    }
    assert!(matches!(
        products.image("empty", image(1, 1).slice(ndarray::s![..0, ..]), &metadata()),
        Err(Error::Codec { .. })
    ));
    let long = Map::from_iter([("x".repeat(300), Value::Null)]);
    assert!(matches!(products.image("long", image(2, 2).view(), &long), Err(Error::Codec { .. })));
    assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 0, "nothing was written");
}

#[test]
fn a_damaged_image_is_an_error() {
    let (_dir, products) = products();
    assert!(matches!(products.read_image("epipolar"), Err(Error::Io { .. })));
    products.image("epipolar", image(2, 2).view(), &metadata()).unwrap();
    let path = products.dir().join("epipolar.npy");
    let bytes = fs::read(&path).unwrap();
    for damaged in [&b"garbage"[..], &bytes[..bytes.len() - 1], &bytes[..40]] {
        fs::write(&path, damaged).unwrap();
        assert!(matches!(products.read_image("epipolar"), Err(Error::Codec { .. })));
    }
    // A header that claims far more than there is.
    let claim = "{'descr': '<f4', 'fortran_order': False, 'shape': (1000000, 1000000), }";
    let huge = [b"\x93NUMPY\x01\x00\x76\x00", format!("{claim:<117}\n").as_bytes(), &bytes[128..]].concat();
    fs::write(&path, huge).unwrap();
    assert!(matches!(products.read_image("epipolar"), Err(Error::Codec { .. })));
}

#[test]
fn an_image_of_a_damaged_sequence_is_refused_before_memory_is_taken_for_it() {
    let (_dir, products) = products();
    let path = products.dir().join("line.npy");
    products.volume("line", Array3::zeros((3, 5, 4)).view(), &metadata()).unwrap();
    let whole = fs::read(&path).unwrap();
    let damaged = |bytes: &[u8]| {
        fs::write(&path, bytes).unwrap();
        products.read_image_of("line", 1).unwrap_err().to_string()
    };
    let claims = |what: &str, instead: &str| {
        let text = String::from_utf8_lossy(&whole[..128]).replace(what, instead);
        let padded = format!("{:127}\n", text.trim_end().trim_start_matches('\u{fffd}'));
        [&whole[..1], &padded.as_bytes()[..127], &whole[128..]].concat()
    };
    for (bytes, expected) in [
        (whole[..whole.len() - 1].to_vec(), "bytes are not"),
        ([&whole[..], &[0]].concat(), "bytes are not"),
        (claims("(3, 5, 4)", "(3, 99999, 99999)"), "values"),
        (claims("(3, 5, 4)", "(3, 4294967296, 4294967296)"), "values"),
        (claims("(3, 5, 4)", "(20, 3)"), "[k, t, s]"),
        (claims("<f4", "<f8"), "`<f8`"),
        (whole[..60].to_vec(), "line.npy"),
        (Vec::new(), "line.npy"),
    ] {
        let said = damaged(&bytes);
        assert!(said.contains(expected), "{expected}: {said}");
    }
}
