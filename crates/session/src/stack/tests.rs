use super::*;
use std::fs;

fn shape(rows: usize, columns: usize) -> StackShape {
    StackShape { contents: Contents::Sweep { points: 4, exposures: 2 }, rows, columns }
}

fn image(shape: &StackShape, seed: u32) -> Array2<u32> {
    Array2::from_shape_fn((shape.rows, shape.columns), |(t, s)| {
        (t as u32 * 1_000 + s as u32).wrapping_mul(2_654_435_761).wrapping_add(seed) >> 12
    })
}

#[test]
fn every_array_reads_back_at_sizes_around_a_chunk() {
    for (rows, columns) in [(1, 1), (3, 5), (64, 64), (65, 63), (8, 130), (129, 64)] {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("stack.zarr");
        let shape = shape(rows, columns);
        let stack = Stack::create(&path, &shape, "sweep").unwrap();
        for array in ArrayName::ALL {
            for index in 0..shape.len(array) {
                let data = image(&shape, index as u32);
                assert_eq!(stack.write(array, index, data.view()).unwrap(), crc32(data.view()));
            }
        }
        let stack = Stack::open(&path, &shape).unwrap();
        assert_eq!(*stack.shape(), shape);
        for array in ArrayName::ALL {
            let all = stack.read(array).unwrap();
            assert_eq!(all.dim(), (shape.len(array), rows, columns));
            for (index, plane) in all.outer_iter().enumerate() {
                assert_eq!(plane, image(&shape, index as u32), "{array:?} {index}");
                assert_eq!(stack.read_point(array, index).unwrap(), plane);
            }
        }
    }
}

#[test]
fn the_checksum_is_that_of_zip_over_little_endian_values() {
    // CRC-32 of the ASCII digits 1 to 8, and for "123456789" the check value of the standard.
    let digits = ndarray::array![[0x3433_3231, 0x3837_3635]];
    assert_eq!(crc32(digits.view()), 0x9ae0_daaf);
    assert_eq!(crc32fast::hash(b"123456789"), 0xcbf4_3926);
    let square = image(&shape(3, 3), 7);
    assert_ne!(crc32(square.view()), crc32(square.t()), "order matters");
    let copy = square.t().as_standard_layout().into_owned();
    assert_eq!(crc32(square.t()), crc32(copy.view()), "the order in memory does not");
}

#[test]
fn a_later_write_replaces_the_earlier() {
    let dir = tempfile::tempdir().unwrap();
    let shape = shape(3, 5);
    let stack = Stack::create(dir.path(), &shape, "sweep").unwrap();
    stack.write(ArrayName::Sum, 1, image(&shape, 1).view()).unwrap();
    stack.write(ArrayName::Sum, 1, image(&shape, 2).view()).unwrap();
    assert_eq!(stack.read_point(ArrayName::Sum, 1).unwrap(), image(&shape, 2));
}

#[test]
fn a_point_of_zeros_is_stored_and_a_missing_one_is_not() {
    let dir = tempfile::tempdir().unwrap();
    let shape = shape(3, 5);
    let stack = Stack::create(dir.path(), &shape, "sweep").unwrap();
    let zeros = Array2::zeros((3, 5));
    stack.write(ArrayName::Dark, 1, zeros.view()).unwrap();
    assert_eq!(stack.read_point(ArrayName::Dark, 1).unwrap(), zeros);
    assert!(matches!(
        stack.read_point(ArrayName::Dark, 0),
        Err(Error::NotStored { array: "dark", index: 0, .. })
    ));
    assert_eq!(stack.read(ArrayName::Dark).unwrap(), Array3::<u32>::zeros((2, 3, 5)));
}

#[test]
fn what_does_not_fit_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let shape = shape(3, 5);
    assert!(matches!(
        Stack::create(dir.path(), &StackShape { columns: 0, ..shape }, "sweep"),
        Err(Error::Shape { .. })
    ));
    let stack = Stack::create(dir.path(), &shape, "sweep").unwrap();
    let turned = Array2::zeros((5, 3));
    assert!(matches!(stack.write(ArrayName::Sum, 0, turned.view()), Err(Error::Shape { .. })));
    let fitting = Array2::zeros((3, 5));
    assert!(matches!(stack.write(ArrayName::Sum, 4, fitting.view()), Err(Error::Index { len: 4, .. })));
    assert!(matches!(stack.read_point(ArrayName::Regular, 1), Err(Error::Index { len: 1, .. })));
}

#[test]
fn the_same_data_give_the_same_bytes_in_a_new_stack_and_in_a_resumed_one() {
    let shape = shape(200, 190);
    let dir = tempfile::tempdir().unwrap();
    let bytes = |stack: Stack| {
        stack.write(ArrayName::Sum, 2, image(&shape, 5).view()).unwrap();
        fs::read(dir.path().join("sum/c.2.0.0")).unwrap()
    };
    let first = bytes(Stack::create(dir.path(), &shape, "sweep").unwrap());
    for _ in 0..10 {
        assert!(bytes(Stack::create(dir.path(), &shape, "sweep").unwrap()) == first);
        assert!(bytes(Stack::open(dir.path(), &shape).unwrap()) == first);
    }
}

#[test]
fn every_damaged_byte_of_a_shard_is_noticed() {
    let dir = tempfile::tempdir().unwrap();
    let shape = shape(8, 8);
    let stack = Stack::create(dir.path(), &shape, "sweep").unwrap();
    let data = image(&shape, 3);
    stack.write(ArrayName::Sum, 0, data.view()).unwrap();
    let path = dir.path().join("sum/c.0.0.0");
    let whole = fs::read(&path).unwrap();
    for byte in 0..whole.len() {
        for flip in [1, 0x80, 0xff] {
            let mut damaged = whole.clone();
            damaged[byte] ^= flip;
            fs::write(&path, damaged).unwrap();
            if let Ok(back) = stack.read_point(ArrayName::Sum, 0) {
                assert_eq!(back, data, "byte {byte} ^ {flip}");
            }
        }
        fs::write(&path, &whole[..byte]).unwrap();
        assert!(stack.read_point(ArrayName::Sum, 0).is_err(), "cut at {byte}");
    }
}

#[test]
fn rows_of_a_point_are_those_of_the_whole() {
    for (rows, columns) in [(1, 1), (64, 63), (65, 130), (200, 70)] {
        let dir = tempfile::tempdir().unwrap();
        let shape = shape(rows, columns);
        let stack = Stack::create(dir.path(), &shape, "sweep").unwrap();
        stack.write(ArrayName::Sum, 1, image(&shape, 1).view()).unwrap();
        stack.write(ArrayName::Sum, 2, image(&shape, 2).view()).unwrap();
        for part in [0..1, 0..rows, rows - 1..rows, rows / 3..rows.min(rows / 3 + 64), rows / 2..rows] {
            if part.is_empty() {
                continue;
            }
            let found = stack.read_rows(ArrayName::Sum, 2, part.clone()).unwrap();
            assert_eq!(found, image(&shape, 2).slice(s![part.clone(), ..]), "{rows} x {columns}: {part:?}");
        }
        for part in [0..0, 0..rows + 1, rows..rows + 1] {
            let refused = stack.read_rows(ArrayName::Sum, 2, part.clone());
            assert!(matches!(refused, Err(Error::Shape { .. })), "{part:?}");
        }
        let missing = stack.read_rows(ArrayName::Sum, 0, 0..1);
        assert!(matches!(missing, Err(Error::NotStored { array: "sum", index: 0, .. })));
        assert!(matches!(stack.read_rows(ArrayName::Sum, 4, 0..1), Err(Error::Index { len: 4, .. })));
    }
}

#[test]
fn rows_are_read_without_the_rest_of_their_shard_and_their_damage_is_noticed() {
    let dir = tempfile::tempdir().unwrap();
    let shape = shape(192, 64);
    let stack = Stack::create(dir.path(), &shape, "sweep").unwrap();
    let data = image(&shape, 3);
    stack.write(ArrayName::Sum, 0, data.view()).unwrap();
    let path = dir.path().join("sum/c.0.0.0");
    let whole = fs::read(&path).unwrap();
    let strip = |t: usize| stack.read_rows(ArrayName::Sum, 0, t..t + 64);
    // Three inner chunks of about equal size, followed by their index.
    for (byte, broken) in [(whole.len() / 6, 0), (whole.len() / 2, 64), (whole.len() * 5 / 6, 128)] {
        let mut damaged = whole.clone();
        damaged[byte] ^= 0x10;
        fs::write(&path, damaged).unwrap();
        for t in [0, 64, 128] {
            match strip(t) {
                Ok(found) => {
                    assert!(t != broken && found == data.slice(s![t..t + 64, ..]), "byte {byte}, row {t}")
                }
                Err(error) => {
                    assert!(
                        t == broken && matches!(error, Error::Zarr { .. }),
                        "byte {byte}, row {t}: {error}"
                    )
                }
            }
        }
    }
    for cut in [0, 1, whole.len() / 2, whole.len() - 1] {
        fs::write(&path, &whole[..cut]).unwrap();
        assert!(matches!(strip(0), Err(Error::Zarr { .. })), "cut at {cut}");
    }
}

#[test]
fn a_hierarchy_that_is_not_a_stack_is_an_error() {
    let dir = tempfile::tempdir().unwrap();
    assert!(matches!(Stack::open(&dir.path().join("missing"), &shape(8, 8)), Err(Error::Zarr { .. })));
    let stack = Stack::create(dir.path(), &shape(8, 8), "sweep").unwrap();
    stack.write(ArrayName::Sum, 0, image(&shape(8, 8), 0).view()).unwrap();
    let path = dir.path().join("sum/zarr.json");
    let metadata = fs::read_to_string(&path).unwrap();
    let compact = metadata.replace([' ', '\n'], "");
    for (from, to) in [
        ("\"shape\":[4,8,8]", "\"shape\":[4,8,9]"),
        ("\"shape\":[4,8,8]", "\"shape\":[4,8]"),
        ("\"shape\":[4,8,8]", "\"shape\":[0,8,8]"),
        ("\"chunk_shape\":[1,8,8],\"codecs\"", "\"chunk_shape\":[1,3,3],\"codecs\""),
        ("\"chunk_shape\":[1,8,8]", "\"chunk_shape\":[1,4,4]"),
        ("\"chunk_shape\":[1,8,8]", "\"chunk_shape\":[1,0,0]"),
        ("uint32", "float99"),
        ("zstd", "unheard-of"),
        ("{", ""),
    ] {
        assert!(compact.contains(from), "{from}");
        fs::write(&path, compact.replace(from, to)).unwrap();
        let opened = Stack::open(dir.path(), &shape(8, 8));
        let error = opened.and_then(|stack| stack.read_point(ArrayName::Sum, 0)).err();
        assert!(matches!(error, Some(Error::Zarr { .. } | Error::Shape { .. })), "{from} -> {to}: {error:?}");
    }
}
