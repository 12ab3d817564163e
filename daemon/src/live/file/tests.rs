use std::sync::atomic::{AtomicBool, Ordering};

use ndarray::{Array2, Array3, ArrayD, IxDyn};

use super::super::LiveReader;
use super::*;

fn folder() -> (tempfile::TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("live");
    (folder, path)
}

fn flat(value: f32, rows: usize, columns: usize) -> ArrayD<f32> {
    ArrayD::from_elem(IxDyn(&[rows, columns]), value)
}

fn show(live: &LiveFile, name: &str, image: &ArrayD<f32>) -> u64 {
    let metadata = Map::from_iter([("mean".to_owned(), json!(image.mean()))]);
    live.publish(name, image.view(), &metadata).unwrap()
}

#[test]
fn an_image_reads_back_from_a_file_of_fixed_size_for_all_that_is_removed_at_the_end() {
    let (_folder, path) = folder();
    let live = LiveFile::create(&path).unwrap();
    let bytes = fs::metadata(&path).unwrap().len();
    assert_eq!(fs::metadata(&path).unwrap().permissions().mode() & 0o777, 0o644);
    let reader = LiveReader::open(&path).unwrap();
    assert_eq!(reader.newest("epipolar").unwrap(), None);
    let image = Array3::from_shape_fn((2, 3, 5), |(k, t, s)| (k * 100 + t * 10 + s) as f32).into_dyn();
    let before_ns = host_ns();
    assert_eq!(show(&live, "epipolar", &flat(1.0, 4, 4)), 1);
    assert_eq!(show(&live, "epipolar", &image), 2);
    let found = reader.newest("epipolar").unwrap().unwrap();
    assert_eq!((found.sequence, &found.image), (2, &image));
    assert_eq!(found.metadata, Map::from_iter([("mean".to_owned(), json!(image.mean()))]));
    assert!((before_ns..=host_ns()).contains(&found.host_ns) && before_ns > 0);
    assert_eq!(fs::metadata(&path).unwrap().len(), bytes);
    live.clear().unwrap();
    assert_eq!(reader.newest("epipolar").unwrap(), None);
    assert_eq!(show(&live, "epipolar", &image), 3, "numbers go on, so that nobody takes the new for the old");
    drop(live);
    assert!(!path.exists());
}

#[test]
fn a_name_that_is_seldom_written_outlasts_one_that_often_is() {
    let (_folder, path) = folder();
    let live = LiveFile::with_slots_of(64, &path).unwrap();
    let reader = LiveReader::open(&path).unwrap();
    let rare: Vec<String> = (0..SLOTS - 2).map(|index| format!("rare-{index}")).collect();
    for name in &rare {
        show(&live, name, &flat(7.0, 2, 2));
    }
    for value in 0..100 {
        show(&live, "often", &flat(value as f32, 8, 8));
    }
    assert!(rare.iter().all(|name| reader.newest(name).unwrap().unwrap().image == flat(7.0, 2, 2)));
    assert_eq!(reader.newest("often").unwrap().unwrap().image, flat(99.0, 8, 8));
}

#[test]
fn what_is_too_large_is_averaged_over_blocks() {
    let (_folder, path) = folder();
    let live = LiveFile::with_slots_of(6, &path).unwrap();
    let image = Array2::from_shape_fn((3, 5), |(t, s)| (10 * t + s) as f32).into_dyn();
    show(&live, "large", &image);
    let found = LiveReader::open(&path).unwrap().newest("large").unwrap().unwrap();
    let means = [5.5, 7.5, 9.0, 20.5, 22.5, 24.0];
    assert_eq!(found.image, ArrayD::from_shape_vec(IxDyn(&[2, 3]), means.to_vec()).unwrap());
    assert_eq!(found.metadata["reduced_by"], 2);
}

#[test]
fn what_has_no_place_is_refused_by_name() {
    let (_folder, path) = folder();
    let live = LiveFile::with_slots_of(6, &path).unwrap();
    let try_to = |name: &str, shape: &[usize], metadata: &Map<String, Value>| {
        let error = live.publish(name, ArrayD::zeros(IxDyn(shape)).view(), metadata).unwrap_err();
        assert!(matches!(&error, LiveError::Refused { name: refused, .. } if refused == name), "{error}");
        format!("{error}\n")
    };
    let none = Map::new();
    let long = Map::from_iter([("note".to_owned(), json!("x".repeat(5000)))]);
    let shown = [
        try_to("", &[2, 2], &none),
        try_to(&"n".repeat(41), &[2, 2], &none),
        try_to("a", &[2, 0], &none),
        try_to("a", &[1; 5], &none),
        try_to("a", &[7, 2, 2], &none),
        try_to("a", &[2, 2], &long),
    ];
    insta::assert_snapshot!(shown.concat());
    assert_eq!(LiveReader::open(&path).unwrap().newest("a").unwrap(), None);
}

#[test]
fn a_living_daemons_file_and_what_is_no_live_file_are_left_alone() {
    let (_folder, path) = folder();
    let living = LiveFile::create(&path).unwrap();
    show(&living, "a", &flat(1.0, 1, 1));
    assert!(matches!(LiveFile::create(&path), Err(LiveError::Taken(_))));
    assert!(LiveReader::open(&path).unwrap().newest("a").unwrap().is_some());
    // A killed daemon removes nothing.
    let left = fs::read(&path).unwrap();
    drop(living);
    fs::write(&path, left).unwrap();
    let next = LiveFile::create(&path).unwrap();
    assert_eq!(LiveReader::open(&path).unwrap().newest("a").unwrap(), None);
    drop(next);
    fs::write(&path, "precious").unwrap();
    assert!(matches!(LiveFile::create(&path), Err(LiveError::NotLive { .. })));
    assert!(matches!(LiveReader::open(&path), Err(LiveError::Io { .. } | LiveError::NotLive { .. })));
    assert_eq!(fs::read(&path).unwrap(), b"precious");
    assert!(matches!(LiveFile::create(&path.join("no/folder")), Err(LiveError::Io { .. })));
}

#[test]
fn an_image_that_is_not_whole_is_not_taken() {
    let (_folder, path) = folder();
    let live = LiveFile::with_slots_of(64, &path).unwrap();
    let reader = LiveReader::open(&path).unwrap();
    show(&live, "image", &flat(1.0, 8, 8));
    show(&live, "image", &flat(2.0, 8, 8));
    let newest = || reader.newest("image").map(|image| image.unwrap().sequence);
    assert_eq!(newest().unwrap(), 2);
    let slot =
        live.offset_of(live.slots.lock().unwrap().held.iter().position(|held| held.sequence == 2).unwrap());
    live.file.write_all_at(&3_u64.to_le_bytes(), slot).unwrap();
    assert_eq!(newest().unwrap(), 1, "the newest is being written");
    live.file.write_all_at(&4_u64.to_le_bytes(), slot).unwrap();
    let pixels = slot + (SLOT_HEADER_BYTES + METADATA_BYTES) as u64;
    live.file.write_all_at(&[7], pixels + 100).unwrap();
    assert!(matches!(newest(), Err(LiveError::Outrun(_))), "its pixels are others");
}

#[test]
fn readers_that_race_the_writer_see_whole_images_only() {
    const IMAGES: u64 = 20_000;
    const SHAPE: [usize; 2] = [128, 128];
    let (_folder, path) = folder();
    let live = LiveFile::with_slots_of(SHAPE[0] * SHAPE[1], &path).unwrap();
    let bytes = |value: f32| {
        let mut bytes = b"{}".to_vec();
        bytes.resize(METADATA_BYTES, 0);
        bytes.extend(flat(value, SHAPE[0], SHAPE[1]).iter().flat_map(|pixel| pixel.to_le_bytes()));
        bytes
    };
    let images: Vec<_> = (0..10_u8).map(|value| bytes(value.into())).collect();
    // All into the same slot, so that readers are often overtaken.
    let write = |sequence: u64| {
        let bytes = &images[sequence as usize % images.len()];
        let held = Held { lock: 2 * sequence, sequence, name: "image".into() };
        let header = header(&held, &SHAPE, 2, bytes, live.offset_of(0));
        live.write_slot(0, &header, bytes).unwrap();
    };
    write(1);
    let done = AtomicBool::new(false);
    let read = || {
        let reader = LiveReader::open(&path).unwrap();
        let mut whole = 0;
        while !done.load(Ordering::Relaxed) {
            match reader.newest("image") {
                Ok(Some(image)) => {
                    let value = (image.sequence % images.len() as u64) as f32;
                    assert!(image.image.iter().all(|&pixel| pixel == value), "torn at {value}");
                    whole += 1;
                }
                Ok(None) | Err(LiveError::Outrun(_)) => {}
                Err(error) => panic!("{error}"),
            }
        }
        whole
    };
    let reads: Vec<u64> = std::thread::scope(|scope| {
        let readers = [scope.spawn(read), scope.spawn(read)];
        (2..IMAGES).for_each(write);
        done.store(true, Ordering::Relaxed);
        readers.into_iter().map(|reader| reader.join().unwrap()).collect()
    });
    assert!(reads.iter().any(|&whole| whole > 0), "{reads:?}");
}

#[test]
fn the_layout_that_is_described_is_the_one_that_is_written() {
    let (_folder, path) = folder();
    let live = LiveFile::with_slots_of(64, &path).unwrap();
    show(&live, "n", &flat(2.0, 3, 4));
    let file = fs::read(&path).unwrap();
    let layout = raysweep_proto::describe("").live;
    let number = |fields: &[raysweep_proto::live::LiveField], start: usize, name: &str, index: usize| {
        let field = fields.iter().find(|field| field.name == name).unwrap();
        let bytes: usize = field.dtype[2..].parse().unwrap();
        let at = start + field.offset + index * bytes;
        file[at..at + bytes].iter().rev().fold(0_u64, |number, &byte| number << 8 | u64::from(byte))
    };
    let first = number(&layout.header, 0, "first_slot", 0) as usize;
    assert_eq!(number(&layout.header, 0, "slots", 0), SLOTS as u64);
    assert_eq!(first as u64 + SLOTS as u64 * number(&layout.header, 0, "slot_bytes", 0), file.len() as u64);
    let slot = |name: &str, index: usize| number(&layout.slot, first, name, index) as usize;
    assert_eq!((slot("lock", 0), slot("sequence", 0), slot("ndim", 0)), (2, 1, 2));
    assert_eq!([slot("shape", 0), slot("shape", 1), slot("shape", 2)], [3, 4, 0]);
    let at = slot("data_offset", 0);
    assert!(file[at..at + 48].chunks(4).all(|pixel| pixel == 2.0_f32.to_le_bytes()));
    let at = slot("metadata_offset", 0);
    let metadata = &file[at..at + slot("metadata_bytes", 0)];
    assert_eq!(serde_json::from_slice::<Value>(metadata).unwrap(), json!({ "mean": 2.0 }));
}
