//! The projector on a virtual display: QEMU's screen dump shows the pattern, pixel for pixel.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod guest;

use std::fs;
use std::path::{Path, PathBuf};
use std::time::Instant;

use guest::{Monitor, PATIENCE, wait_for};
use raysweep_core::{Clock, DeviceErrorKind, Pattern, Projector};
use raysweep_drivers::projector::drm::{DrmConfig, DrmProjector, Timing};

const COLUMNS: usize = 1280;
const ROWS: usize = 720;

fn config() -> DrmConfig {
    let card = PathBuf::from(std::env::var("RAYSWEEP_DRM_CARD").unwrap());
    DrmConfig { card, connector: None, timing: Timing::HD_720P60, settle_frames: 2 }
}

/// Size of a screen dump and the red, green and blue values of its pixels.
fn read_ppm(path: &Path) -> (usize, usize, Vec<[u8; 3]>) {
    let bytes = fs::read(path).unwrap();
    let mut fields = bytes.splitn(4, |&byte| byte == b'\n' || byte == b' ');
    let mut field = || std::str::from_utf8(fields.next().unwrap()).unwrap().to_owned();
    assert_eq!(field(), "P6");
    let (columns, rows) = (field().parse().unwrap(), field().parse().unwrap());
    let pixels = fields.next().unwrap().strip_prefix(b"255\n").unwrap();
    (columns, rows, pixels.as_chunks::<3>().0.to_vec())
}

/// Waits until the screen shows `expected`: the display follows a flip after a moment.
fn screen_shows(monitor: &mut Monitor, what: &str, expected: impl Fn(usize, usize) -> [u8; 3]) {
    let began = Instant::now();
    loop {
        let (columns, rows, pixels) = read_ppm(&monitor.screen_dump("screen.ppm"));
        let size = (columns, rows) == (COLUMNS, ROWS);
        let wrong =
            pixels.iter().enumerate().position(|(at, &pixel)| pixel != expected(at % columns, at / columns));
        match wrong {
            None if size => return,
            _ if began.elapsed() < PATIENCE => {}
            Some(at) => panic!("{what}: pixel {at} of {columns}x{rows} is {:?}", pixels[at]),
            None => panic!("{what}: the screen is {columns}x{rows}"),
        }
    }
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn each_pattern_is_on_the_screen_pixel_for_pixel() {
    let mut monitor = Monitor::open();
    let mut projector = DrmProjector::open(&config()).unwrap();
    let (black, white) = ([0; 3], [255; 3]);
    screen_shows(&mut monitor, "open", |_, _| black);
    let mut show = |pattern: Pattern, expected: &dyn Fn(usize, usize) -> [u8; 3]| {
        let asked_ns = Clock::real().now_ns();
        let shown = projector.show(&pattern).unwrap();
        // Two video frames of 16.667 ms after a flip, which cannot have been before the request.
        assert!(shown.not_before_ns >= asked_ns + 33_333_333, "{pattern:?}");
        screen_shows(&mut monitor, &format!("{pattern:?}"), expected);
    };
    show(Pattern::White, &|_, _| white);
    show(Pattern::Black, &|_, _| black);
    show(Pattern::Line { row: 700 }, &|_, y| if y == 700 { white } else { black });
    let weights = (0..ROWS).map(|y| (y % 256) as f32 / 255.0).collect();
    show(Pattern::Rows(weights), &|_, y| [(y % 256) as u8; 3]);
    let lit = |x: usize, y: usize| (x / 8 + y / 8).is_multiple_of(2);
    let level = |lit| if lit { white } else { black };
    show(Pattern::Checkerboard { cell_px: 8, shift_px: (0, 0) }, &|x, y| level(lit(x, y)));
    show(Pattern::Checkerboard { cell_px: 8, shift_px: (3, 14) }, &|x, y| level(lit(x + 13, y + 2)));

    let path = std::env::temp_dir().join("picture.png");
    let coloured = |x: usize, y: usize| [(x % 251) as u8, (y % 241) as u8, (x * y % 239) as u8];
    let mut encoder = png::Encoder::new(fs::File::create(&path).unwrap(), COLUMNS as u32, ROWS as u32);
    encoder.set_color(png::ColorType::Rgb);
    let pixels: Vec<u8> = (0..COLUMNS * ROWS).flat_map(|at| coloured(at % COLUMNS, at / COLUMNS)).collect();
    encoder.write_header().unwrap().write_image_data(&pixels).unwrap();
    show(Pattern::Image(path), &coloured);

    projector.blank().unwrap();
    screen_shows(&mut monitor, "blank", |_, _| black);
    let refused = projector.show(&Pattern::Line { row: ROWS }).unwrap_err();
    assert_eq!(refused.kind, DeviceErrorKind::OutOfRange, "{refused}");
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn a_card_in_use_and_outputs_that_are_not_there_are_refused() {
    let unknown = DrmConfig { connector: Some("HDMI-A-9".to_owned()), ..config() };
    let refused = DrmProjector::open(&unknown).err().unwrap();
    assert_eq!(refused.kind, DeviceErrorKind::Disconnected);
    assert!(refused.to_string().contains("Virtual-1"), "{refused}");
    let named = DrmConfig { connector: Some("Virtual-1".to_owned()), ..config() };
    let _projector = DrmProjector::open(&named).unwrap();
    assert_eq!(DrmProjector::open(&config()).err().unwrap().kind, DeviceErrorKind::Busy);
}

#[test]
#[ignore = "needs the kernel guest: cargo xtask guest"]
fn a_card_that_goes_is_told_and_can_come_back() {
    let mut monitor = Monitor::open();
    let driver = Path::new("/sys/bus/virtio/drivers/virtio_gpu");
    let entries =
        fs::read_dir(driver).unwrap().map(|entry| entry.unwrap().file_name().into_string().unwrap());
    let device = entries.into_iter().find(|name| name.starts_with("virtio")).unwrap();
    let mut projector = DrmProjector::open(&config()).unwrap();
    fs::write(driver.join("unbind"), &device).unwrap();
    let error = projector.show(&Pattern::White).unwrap_err();
    assert_eq!(error.kind, DeviceErrorKind::Disconnected, "{error}");
    drop(projector);
    fs::write(driver.join("bind"), &device).unwrap();
    let mut projector = wait_for("the card", || DrmProjector::open(&config()).ok());
    projector.show(&Pattern::White).unwrap();
    screen_shows(&mut monitor, "after the card came back", |_, _| [255; 3]);
}
