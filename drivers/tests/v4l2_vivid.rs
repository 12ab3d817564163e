//! The V4L2 driver against the kernel's virtual camera `vivid`, on a machine whose kernel has that module: the kernel
//! guest, or by hand as root
//!
//! ```text
//! modprobe vivid n_devs=1 node_types=0x1 num_inputs=1 input_types=3
//! RAYSWEEP_V4L2_DEVICE=/dev/video0 cargo test -p raysweep-drivers --features v4l2 --test v4l2_vivid -- --ignored --test-threads 1
//! ```
//!
//! vivid uses an HDMI input, because that allows any frame size. It has no exposure control: its brightness stands
//! for one. `v4l2-ctl` sets its controls from outside. The tests check order, counts and values, but no times: the
//! guest's clock jitters by a tenth of a second.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::{Duration, Instant};

use raysweep_core::{
    Camera, CameraSettings, DeviceErrorKind, DeviceState, FrameBuf, FramePool, FrameStamp, PixelFormat,
    Readout, SettingsId, Shutter,
};
use raysweep_drivers::camera::v4l2::{self, TimeControl, V4l2Camera, V4l2Config, V4l2Setup, fourcc};

const WIDTH: u32 = 320;
const HEIGHT: u32 = 180;
/// A frame arrives within this time or never.
const PATIENCE: Duration = Duration::from_secs(10);

struct Device {
    path: PathBuf,
}

impl Device {
    fn named() -> Self {
        let path = std::env::var_os("RAYSWEEP_V4L2_DEVICE");
        Self { path: path.expect("RAYSWEEP_V4L2_DEVICE names vivid's node").into() }
    }

    fn setup(&self, format: PixelFormat, controls: &[(&str, i64)]) -> V4l2Setup {
        // Timestamps at the start of exposure: vivid's others lie in the future.
        let controls = [("timestamp_source", 1)].iter().chain(controls);
        V4l2Setup {
            config: V4l2Config {
                device: self.path.clone(),
                width: WIDTH,
                height: HEIGHT,
                controls: controls.map(|(name, value)| ((*name).to_owned(), *value)).collect(),
                free_running: Vec::new(),
                exposure: Some(TimeControl { control: "brightness".into(), unit_us: Some(10.0) }),
                trigger_delay: None,
                frames_per_s: None,
                buffers: 4,
                late_frames: 2,
                trigger_latency_us: 0.0,
                readout: Readout::Sequential,
            },
            format,
            row_time_us: 20.0,
            trigger_period_us: 16_666.7,
            reopen: PATIENCE,
        }
    }

    fn streaming(&self, format: PixelFormat, controls: &[(&str, i64)]) -> Feed {
        let mut camera = v4l2::open(self.setup(format, controls)).unwrap();
        camera.arm().unwrap();
        let pool = FramePool::new(1, format.frame_bytes((WIDTH * HEIGHT) as usize));
        Feed { camera, buf: pool.take() }
    }
}

struct Feed {
    camera: V4l2Camera,
    buf: FrameBuf,
}

impl Feed {
    fn next(&mut self) -> FrameStamp {
        let began = Instant::now();
        loop {
            if let Some(stamp) = self.camera.next_frame(&mut self.buf, Duration::from_millis(100)).unwrap() {
                return stamp;
            }
            assert!(began.elapsed() < PATIENCE, "no frame came");
        }
    }

    /// Presses one of vivid's buttons or sets one of its controls, from outside, with `v4l2-ctl`.
    fn press(&self, device: &Device, control: &str, value: i64) {
        let status = Command::new("v4l2-ctl")
            .arg("--device")
            .arg(&device.path)
            .arg("--set-ctrl")
            .arg(format!("{control}={value}"))
            .status()
            .unwrap();
        assert!(status.success(), "v4l2-ctl --set-ctrl {control}={value}: {status}");
    }
}

#[test]
#[ignore = "needs vivid: cargo xtask guest"]
fn frames_come_in_every_format_that_the_kernel_has() {
    let device = &Device::named();
    for format in PixelFormat::all().filter(|format| fourcc(*format).is_some()) {
        let name = format.to_string();
        let mut camera = match v4l2::open(device.setup(format, &[])) {
            Ok(camera) => camera,
            // vivid does not support MIPI packings.
            Err(refused) if name.ends_with("g40") || name.ends_with("g24") => {
                assert_eq!(refused.kind, DeviceErrorKind::OutOfRange, "{refused}");
                continue;
            }
            Err(refused) => panic!("{name}: {refused}"),
        };
        camera.arm().unwrap();
        let pixels = (WIDTH * HEIGHT) as usize;
        let mut feed = Feed { camera, buf: FramePool::new(1, format.frame_bytes(pixels)).take() };
        let stamps: Vec<FrameStamp> = (0..5).map(|_| feed.next()).collect();
        assert!(
            stamps.is_sorted_by(|a, b| a.seq < b.seq && a.exposure_start_ns < b.exposure_start_ns),
            "{name}"
        );
        let mut unpacked = vec![0; pixels];
        format.unpack_into(&feed.buf, &mut unpacked).unwrap();
        let (low, high) = (unpacked.iter().min().unwrap(), unpacked.iter().max().unwrap());
        assert!(low < high && *high <= format.max_value(), "{name}: {low} to {high} is no picture");
        feed.camera.disarm().unwrap();
        println!("  {name}: {low} to {high}");
    }
}

#[test]
#[ignore = "needs vivid: cargo xtask guest"]
fn controls_are_set_and_read_back() {
    let device = &Device::named();
    let mut camera = v4l2::open(device.setup(PixelFormat::Mono8, &[("contrast", 100)])).unwrap();
    let settings = CameraSettings { shutter: Shutter::Rolling, exposure_us: 1_234.0, trigger_delay_us: 0.0 };
    let id = SettingsId { point: 0, attempt: 0 };
    assert_eq!(camera.configure(id, &settings).unwrap().actual.exposure_us, 1_230.0);
    let refused = camera.configure(id, &CameraSettings { exposure_us: 1e6, ..settings }).unwrap_err();
    assert_eq!(refused.kind, DeviceErrorKind::OutOfRange);
    drop(camera);
    let refused = v4l2::open(device.setup(PixelFormat::Mono8, &[("contrast", 1000)])).err().unwrap();
    assert!(refused.to_string().contains("contrast = 1000: must be from 0 to 255"), "{refused}");
    let refused = v4l2::open(device.setup(PixelFormat::Mono8, &[("no_such_control", 1)])).err().unwrap();
    assert!(refused.to_string().contains("brightness"), "{refused}");
}

#[test]
#[ignore = "needs vivid: cargo xtask guest"]
fn frame_rates_that_the_driver_clamps_are_refused() {
    let device = &Device::named();
    let mut setup = device.setup(PixelFormat::Mono8, &[]);
    // An HDMI input has only one rate.
    setup.config.frames_per_s = Some(60.0);
    v4l2::open(setup.clone()).unwrap();
    setup.config.frames_per_s = Some(30.0);
    let refused = v4l2::open(setup).err().unwrap();
    assert_eq!(refused.kind, DeviceErrorKind::OutOfRange);
    assert!(refused.to_string().contains("frames_per_s = 30: the driver makes it 60"), "{refused}");
}

#[test]
#[ignore = "needs vivid: cargo xtask guest"]
fn a_second_program_is_told_that_the_camera_is_busy() {
    let device = &Device::named();
    let mut feed = device.streaming(PixelFormat::Mono8, &[]);
    feed.next();
    let refused = v4l2::open(device.setup(PixelFormat::Mono8, &[])).err().unwrap();
    assert_eq!(refused.kind, DeviceErrorKind::Busy, "{refused}");
    feed.next();
}

#[test]
#[ignore = "needs vivid: cargo xtask guest"]
fn ids_rise_over_a_wrap_of_the_kernels_count() {
    let device = &Device::named();
    // The kernel's count starts 128 before its maximum.
    let mut feed = device.streaming(PixelFormat::Mono8, &[("wrap_sequence_number", 1)]);
    let seqs: Vec<u64> = (0..200).map(|_| feed.next().seq).collect();
    assert!(seqs.is_sorted_by(|a, b| a < b), "{seqs:?}");
    assert!(seqs[199] < 1000, "{}: the wrap is no gap", seqs[199]);
    feed.press(device, "wrap_sequence_number", 0);
}

#[test]
#[ignore = "needs vivid: cargo xtask guest"]
fn damaged_frames_are_left_out_and_counted() {
    let device = &Device::named();
    // Some percent of the frames are flagged; the others arrive.
    let mut feed = device.streaming(PixelFormat::Mono8, &[("percentage_of_dropped_buffers", 50)]);
    let first = feed.next().seq;
    let last = (0..30).map(|_| feed.next().seq).last().unwrap();
    feed.press(device, "percentage_of_dropped_buffers", 0);
    assert!(last - first > 30, "{} frames in {} ids: some were dropped", 31, last - first + 1);
    feed.press(device, "inject_v4l2_buf_flag_error", 1);
    let after: Vec<u64> = (0..10).map(|_| feed.next().seq).collect();
    assert!(after.is_sorted_by(|a, b| a < b), "{after:?}");
}

#[test]
#[ignore = "needs vivid: cargo xtask guest"]
fn a_stream_that_fails_is_built_anew() {
    let device = &Device::named();
    // After the last one, the node stays and returns ENODEV until all processes have closed it.
    for button in ["inject_vidioc_qbuf_error", "inject_fatal_streaming_error", "disconnect"] {
        let mut feed = device.streaming(PixelFormat::Mono8, &[]);
        let before = feed.next().seq;
        feed.press(device, button, 1);
        let after = (0..30).map(|_| feed.next().seq).last().unwrap();
        assert!(after > before, "{button}");
        assert_eq!(feed.camera.state(), DeviceState::Streaming, "{button}");
    }
}

#[test]
#[ignore = "needs vivid: cargo xtask guest"]
fn a_camera_that_is_unbound_and_bound_goes_on() {
    let device = &Device::named();
    let driver = Path::new("/sys/bus/platform/drivers/vivid");
    let bind = |file: &str| std::fs::write(driver.join(file), "vivid.0").unwrap();
    let mut feed = device.streaming(PixelFormat::Mono8, &[]);
    let before = feed.next().seq;
    bind("unbind");
    let began = Instant::now();
    while feed.camera.state() != DeviceState::Lost {
        let _ = feed.camera.next_frame(&mut feed.buf, Duration::from_millis(100));
        assert!(began.elapsed() < PATIENCE, "nobody noticed");
    }
    bind("bind");
    assert!(feed.next().seq > before, "ids go on");
    assert_eq!(feed.camera.state(), DeviceState::Streaming);
}
