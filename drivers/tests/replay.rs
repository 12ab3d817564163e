//! The replay camera with files written here according to their formats' definitions.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use raysweep_core::{Camera, DeviceErrorKind, DeviceState, FramePool, PixelFormat};
use raysweep_drivers::camera::replay::{RawPacking, ReplayCamera, ReplayConfig, ReplayPace};

const ROWS: usize = 6;
const COLUMNS: usize = 10;
const RATE_HZ: f64 = 1000.0;

fn count(frame: usize, pixel: usize) -> u16 {
    ((frame * 977 + pixel * 61) % 4096) as u16
}

fn counts(frame: usize) -> Vec<u16> {
    (0..ROWS * COLUMNS).map(|pixel| count(frame, pixel)).collect()
}

fn words(frames: std::ops::Range<usize>) -> Vec<u8> {
    frames.flat_map(counts).flat_map(u16::to_le_bytes).collect()
}

/// Least significant bits first, without gaps.
fn mono12p(frame: usize) -> Vec<u8> {
    let pairs: Vec<u16> = counts(frame);
    pairs
        .chunks(2)
        .flat_map(|p| [p[0] as u8, (p[0] >> 8 | (p[1] & 15) << 4) as u8, (p[1] >> 4) as u8])
        .collect()
}

/// Most significant bits first.
fn mraw(frame: usize) -> Vec<u8> {
    let pairs: Vec<u16> = counts(frame);
    pairs
        .chunks(2)
        .flat_map(|p| [(p[0] >> 4) as u8, ((p[0] & 15) << 4 | p[1] >> 8) as u8, p[1] as u8])
        .collect()
}

/// An `.npy` file of version 1 as NumPy writes it.
fn npy(dtype: &str, shape: &str, data: &[u8]) -> Vec<u8> {
    let mut header = format!("{{'descr': '{dtype}', 'fortran_order': False, 'shape': {shape}, }}");
    while !(10 + header.len() + 1).is_multiple_of(64) {
        header.push(' ');
    }
    header.push('\n');
    let mut file = b"\x93NUMPY\x01\x00".to_vec();
    file.extend((header.len() as u16).to_le_bytes());
    file.extend(header.as_bytes());
    file.extend(data);
    file
}

fn png(path: &Path, frame: usize, depth: png::BitDepth, colour: png::ColorType) {
    let mut encoder = png::Encoder::new(fs::File::create(path).unwrap(), COLUMNS as u32, ROWS as u32);
    encoder.set_depth(depth);
    encoder.set_color(colour);
    let data: Vec<u8> = counts(frame).into_iter().flat_map(u16::to_be_bytes).collect();
    let bytes = ROWS * COLUMNS * colour.samples() * if depth == png::BitDepth::Sixteen { 2 } else { 1 };
    let data: Vec<u8> = data.into_iter().cycle().take(bytes).collect();
    encoder.write_header().unwrap().write_image_data(&data).unwrap();
}

fn config(path: PathBuf) -> ReplayConfig {
    ReplayConfig {
        path,
        width: Some(COLUMNS),
        height: Some(ROWS),
        header_bytes: 0,
        packing: RawPacking::PixelFormat,
        pace: ReplayPace::Pipeline,
    }
}

fn unsized_config(path: PathBuf) -> ReplayConfig {
    ReplayConfig { width: None, height: None, ..config(path) }
}

/// All frames of a recording, unpacked; checks that ids and times advance evenly and that the recording ends.
fn replayed(config: &ReplayConfig, format: PixelFormat) -> Vec<Vec<u16>> {
    let mut camera = ReplayCamera::open(config, format, RATE_HZ).unwrap();
    assert_eq!((camera.capabilities().height, camera.capabilities().width), (ROWS, COLUMNS));
    camera.arm().unwrap();
    let pool = FramePool::new(1, format.frame_bytes(ROWS * COLUMNS) + 7);
    let mut buffer = pool.take();
    let mut frames: Vec<Vec<u16>> = Vec::new();
    let mut first_ns = None;
    while let Some(stamp) = camera.next_frame(&mut buffer, Duration::ZERO).unwrap() {
        assert_eq!(stamp.seq, frames.len() as u64);
        let first_ns = *first_ns.get_or_insert(stamp.exposure_start_ns);
        assert_eq!(stamp.exposure_start_ns - first_ns, 1_000_000 * frames.len() as i64);
        let mut counts = vec![0; ROWS * COLUMNS];
        let bytes = format.frame_bytes(ROWS * COLUMNS);
        format.unpack_into(&buffer[..bytes], &mut counts).unwrap();
        frames.push(counts);
        let over = frames.len() as u64 == camera.frames();
        assert_eq!(camera.state(), if over { DeviceState::Ready } else { DeviceState::Streaming });
    }
    frames
}

fn recorded(frames: std::ops::Range<usize>) -> Vec<Vec<u16>> {
    frames.map(counts).collect()
}

#[test]
fn raw_frames_come_as_they_were_recorded() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("frames.raw");
    fs::write(&file, words(0..5)).unwrap();
    assert_eq!(replayed(&config(file.clone()), PixelFormat::Mono12), recorded(0..5));
    fs::write(&file, (0..5).flat_map(mono12p).collect::<Vec<u8>>()).unwrap();
    assert_eq!(replayed(&config(file.clone()), PixelFormat::Mono12p), recorded(0..5));
    let mut with_header = vec![9; 24];
    with_header.extend((0..5).flat_map(mraw));
    fs::write(&file, with_header).unwrap();
    let config = ReplayConfig { header_bytes: 24, packing: RawPacking::Mraw12, ..config(file) };
    assert_eq!(replayed(&config, PixelFormat::Mono12), recorded(0..5));
}

#[test]
fn arrays_and_pictures_say_their_size() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("frames.npy");
    fs::write(&file, npy("<u2", "(5, 6, 10)", &words(0..5))).unwrap();
    assert_eq!(replayed(&unsized_config(file), PixelFormat::Mono12), recorded(0..5));
    let pictures = folder.path().join("pictures");
    fs::create_dir(&pictures).unwrap();
    for frame in 0..12 {
        png(
            &pictures.join(format!("f{frame}.png")),
            frame,
            png::BitDepth::Sixteen,
            png::ColorType::Grayscale,
        );
    }
    assert_eq!(replayed(&unsized_config(pictures), PixelFormat::Mono12), recorded(0..12));
}

#[test]
fn a_folder_is_one_recording_in_the_order_of_its_numbers() {
    let folder = tempfile::tempdir().unwrap();
    for (name, frames) in [("part9.raw", 0..3), ("part10.raw", 3..4), ("part100.raw", 4..9)] {
        fs::write(folder.path().join(name), words(frames)).unwrap();
    }
    fs::write(folder.path().join("notes.txt"), "exposed by night").unwrap();
    assert_eq!(replayed(&config(folder.path().into()), PixelFormat::Mono12), recorded(0..9));
    for part in 0..3 {
        fs::remove_file(folder.path().join(["part9.raw", "part10.raw", "part100.raw"][part])).unwrap();
        let frames = 2 * part..2 * part + 2;
        fs::write(folder.path().join(format!("{part}.npy")), npy("<u2", "(2, 6, 10)", &words(frames)))
            .unwrap();
    }
    assert_eq!(replayed(&unsized_config(folder.path().into()), PixelFormat::Mono12), recorded(0..6));
}

#[test]
fn a_recording_comes_as_fast_as_it_was_made_where_that_is_asked_for() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("frames.raw");
    fs::write(&file, words(0..20)).unwrap();
    let config = ReplayConfig { pace: ReplayPace::Recorded, ..config(file) };
    let mut camera = ReplayCamera::open(&config, PixelFormat::Mono12, 100.0).unwrap();
    let began = Instant::now();
    camera.arm().unwrap();
    let mut buffer = FramePool::new(1, 2 * ROWS * COLUMNS).take();
    let mut frames = 0;
    while frames < 20 {
        frames += u64::from(camera.next_frame(&mut buffer, Duration::from_secs(1)).unwrap().is_some());
    }
    assert!(began.elapsed() >= Duration::from_millis(190), "20 frames of 10 ms in {:?}", began.elapsed());
    assert!(camera.next_frame(&mut buffer, Duration::ZERO).unwrap().is_none());
}

fn refusal(config: &ReplayConfig, format: PixelFormat) -> String {
    let error = ReplayCamera::open(config, format, RATE_HZ).err().unwrap();
    error.to_string()
}

#[test]
fn what_is_cut_short_or_is_something_else_is_refused_with_its_file() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name);
    let raw = |bytes: &[u8]| {
        fs::write(at("frames.raw"), bytes).unwrap();
        config(at("frames.raw"))
    };
    let array = |bytes: &[u8]| {
        fs::write(at("frames.npy"), bytes).unwrap();
        unsized_config(at("frames.npy"))
    };
    let picture = |depth, colour| {
        png(&at("frame.png"), 0, depth, colour);
        unsized_config(at("frame.png"))
    };
    let whole = words(0..3);
    let whole_npy = npy("<u2", "(3, 6, 10)", &whole);
    let mono12 = PixelFormat::Mono12;
    use png::{BitDepth, ColorType};
    let refused = |config: ReplayConfig, format, expected: &str| {
        let error = refusal(&config, format);
        assert!(error.contains(expected), "{error}\nexpected: {expected}");
        assert!(error.contains(&config.path.display().to_string()), "{error}");
    };
    refused(raw(&whole[..whole.len() - 1]), mono12, "2 frames of 120 bytes and 119 more: it is cut short");
    refused(raw(&[]), mono12, "0 frames");
    refused(raw(&words(0..3)[..300]), PixelFormat::Mono12p, "3 frames of 90 bytes and 30 more");
    refused(ReplayConfig { header_bytes: 1000, ..raw(&whole) }, mono12, "360 of header");
    refused(ReplayConfig { width: None, ..raw(&whole) }, mono12, "camera.replay.width and height");
    refused(ReplayConfig { packing: RawPacking::Mraw12, ..raw(&whole) }, PixelFormat::Mono12p, "mraw12");
    refused(config(at("absent.raw")), mono12, "cannot read");
    refused(array(&whole_npy[..whole_npy.len() - 5]), mono12, "it is cut short");
    refused(array(&whole_npy[..40]), mono12, "cannot read");
    refused(array(b"\x93NUMPY\x01\x00\xff\xff{}"), mono12, "cannot read");
    refused(array(b"something else"), mono12, "does not begin as an .npy file");
    refused(array(&npy("<f4", "(3, 6, 10)", &whole)), mono12, "its elements are <f4");
    refused(array(&npy(">u2", "(3, 6, 10)", &whole)), mono12, "its elements are >u2");
    refused(array(&npy("<u2", "(3, 60)", &whole)), PixelFormat::Mono12p, "is; take Mono12");
    refused(array(&npy("<u2", "(180,)", &whole)), mono12, "[frames, rows, columns]");
    refused(array(&npy("<u2", "(9223372036854775807, 6, 10)", &whole)), mono12, "it is cut short");
    refused(array(&npy("<u2", "(3, 0, 10)", &[])), mono12, "no pixels");
    fs::create_dir(at("empty")).unwrap();
    refused(unsized_config(at("empty")), mono12, "is in this folder");
    refused(unsized_config(folder.path().into()), mono12, "several kinds");
    // The content of a picture is known only when it is read.
    for (depth, colour, expected) in [
        (BitDepth::Eight, ColorType::Grayscale, "of Eight bits"),
        (BitDepth::Sixteen, ColorType::Rgb, "a Rgb picture"),
    ] {
        let mut camera = ReplayCamera::open(&picture(depth, colour), mono12, RATE_HZ).unwrap();
        camera.arm().unwrap();
        let mut buffer = FramePool::new(1, 2 * ROWS * COLUMNS).take();
        let error = camera.next_frame(&mut buffer, Duration::ZERO).unwrap_err();
        assert!(error.to_string().contains(expected), "{error}");
    }
    png(&at("frame.png"), 0, BitDepth::Sixteen, ColorType::Grayscale);
    let mut camera =
        ReplayCamera::open(&unsized_config(at("frame.png")), PixelFormat::Mono10, RATE_HZ).unwrap();
    camera.arm().unwrap();
    let mut buffer = FramePool::new(1, 2 * ROWS * COLUMNS).take();
    let error = camera.next_frame(&mut buffer, Duration::ZERO).unwrap_err();
    assert!(error.to_string().contains("more than 1023"), "{error}");
    let bytes = fs::read(at("frame.png")).unwrap();
    fs::write(at("frame.png"), &bytes[..bytes.len() / 2]).unwrap();
    let mut camera = ReplayCamera::open(&unsized_config(at("frame.png")), mono12, RATE_HZ).unwrap();
    camera.arm().unwrap();
    let error = camera.next_frame(&mut buffer, Duration::ZERO).unwrap_err();
    assert!(error.to_string().contains("cut short"), "{error}");
}

#[test]
fn a_file_that_is_cut_short_while_it_is_read_ends_with_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("frames.raw");
    fs::File::create(&file).unwrap().write_all(&words(0..5)).unwrap();
    let mut camera = ReplayCamera::open(&config(file.clone()), PixelFormat::Mono12, RATE_HZ).unwrap();
    let mut buffer = FramePool::new(1, 2 * ROWS * COLUMNS).take();
    let error = camera.next_frame(&mut buffer, Duration::ZERO).unwrap_err();
    assert_eq!(error.kind, DeviceErrorKind::NotReady, "{error}");
    camera.arm().unwrap();
    camera.next_frame(&mut buffer, Duration::ZERO).unwrap().unwrap();
    fs::OpenOptions::new().write(true).open(&file).unwrap().set_len(200).unwrap();
    let error = camera.next_frame(&mut buffer, Duration::ZERO).unwrap_err();
    assert!(error.to_string().contains("cannot read"), "{error}");
}
