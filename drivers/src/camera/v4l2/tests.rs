use std::time::Duration;

use nix::libc::{EBUSY, EINVAL, EIO, ENOENT, ENOTTY};
use raysweep_core::{
    Camera, CameraSettings, DeviceError, DeviceErrorKind, DeviceState, FirstFrame, FrameBuf, FramePool,
    FrameStamp, LossCause, PixelFormat, SettingsId, Shutter,
};

use super::node::{FLAG_CLOCK_MONOTONIC, FLAG_ERROR, FLAG_MOMENT_START_OF_EXPOSURE};
use super::scripted::{Script, Step, control};
use super::*;

/// Eight columns, four rows of 10 us: 40 us of readout.
fn setup(keys: &str) -> V4l2Setup {
    let text = format!("device = \"/dev/video0\"\nwidth = 8\nheight = 4\nlate_frames = 2\n{keys}");
    V4l2Setup {
        config: toml::from_str(&text).unwrap(),
        format: PixelFormat::Mono8,
        row_time_us: 10.0,
        trigger_period_us: 10_000.0,
        reopen: Duration::from_secs(60),
    }
}

fn open(script: &Script, setup: V4l2Setup) -> Result<V4l2Camera, DeviceError> {
    V4l2Camera::open(setup, Box::new(script.clone()), script.clock.clone())
}

/// A frame whose exposure starts when the clock reads a millisecond per count.
fn frame(sequence: u32) -> Step {
    Step::Frame {
        sequence,
        timestamp_ns: i64::from(sequence) * 1_000_000,
        flags: FLAG_CLOCK_MONOTONIC | FLAG_MOMENT_START_OF_EXPOSURE,
    }
}

fn exposed(exposure_us: f64) -> CameraSettings {
    CameraSettings { shutter: Shutter::Rolling, exposure_us, trigger_delay_us: 0.0 }
}

const ID: SettingsId = SettingsId { point: 0, attempt: 0 };
const WAIT: Duration = Duration::from_millis(100);

struct Feed {
    camera: V4l2Camera,
    buf: FrameBuf,
}

impl Feed {
    fn new(script: &Script, setup: V4l2Setup) -> Self {
        let mut camera = open(script, setup).unwrap();
        camera.arm().unwrap();
        let capabilities = camera.capabilities();
        let bytes = capabilities.format.frame_bytes(capabilities.width * capabilities.height);
        Self { camera, buf: FramePool::new(1, bytes).take() }
    }

    fn next(&mut self) -> Option<FrameStamp> {
        self.camera.next_frame(&mut self.buf, WAIT).unwrap()
    }

    fn seqs(&mut self, frames: usize) -> Vec<u64> {
        (0..frames).map(|_| self.next().unwrap().seq).collect()
    }
}

#[test]
fn a_camera_is_set_up_in_order_and_streams_until_it_is_disarmed() {
    let script = Script::new([frame(0), Step::Nothing, frame(1), frame(2)]);
    let keys = "frames_per_s = 60\nbuffers = 3\ncontrols = [[\"gain\", 7], [\"trigger_mode\", 1]]";
    let mut camera = open(&script, setup(keys)).unwrap();
    assert_eq!(camera.state(), DeviceState::Ready);
    let applied = camera.configure(ID, &exposed(1_249.0)).unwrap();
    assert_eq!(applied.actual, exposed(1_200.0), "in steps of 100 us, read back");
    camera.arm().unwrap();
    camera.arm().unwrap();
    assert_eq!(camera.state(), DeviceState::Streaming);
    let mut feed = Feed { camera, buf: FramePool::new(1, 32).take() };
    for seq in 0..3 {
        let stamp = feed.next().unwrap();
        assert_eq!((stamp.seq, stamp.exposure_start_ns), (seq, seq as i64 * 1_000_000));
        assert!(feed.buf.iter().all(|byte| u64::from(*byte) == seq), "each frame's own pixels");
    }
    assert!(feed.next().is_none(), "an idle trigger is no error");
    feed.camera.disarm().unwrap();
    feed.camera.disarm().unwrap();
    assert_eq!(feed.camera.state(), DeviceState::Ready);
    assert_eq!(
        script.device().calls,
        [
            "open",
            "identity",
            "set_format",
            "set_frame_rate 60",
            "controls",
            "set_control Gain 7",
            "control Gain",
            "set_control trigger_mode 1",
            "control trigger_mode",
            "controls",
            "map_buffers 3",
            "control Exposure Time, Absolute",
            "set_control Exposure Time, Absolute 12",
            "control Exposure Time, Absolute",
            "start",
            "stop",
        ]
    );
    let early = feed.camera.next_frame(&mut feed.buf, WAIT).unwrap_err();
    assert_eq!(early.kind, DeviceErrorKind::NotReady);
}

#[test]
fn what_a_camera_cannot_do_is_told_with_what_it_can() {
    type Prepare = fn(&Script);
    let cases: [(&str, Prepare, DeviceErrorKind, &str); 13] = [
        ("", |s| s.device().refusals.push_back(ENOENT), DeviceErrorKind::Disconnected, "/dev/video0"),
        ("", |s| s.device().failures.push(("set_format", EBUSY)), DeviceErrorKind::Busy, "another program"),
        ("", |s| s.device().identity.captures = false, DeviceErrorKind::Unsupported, "does not capture"),
        (
            "",
            |s| s.device().buffers_max = 1,
            DeviceErrorKind::Busy,
            "buffers = 8: the camera's driver gives 1",
        ),
        (
            "",
            |s| s.device().format = |wanted| Format { width: 16, ..wanted },
            DeviceErrorKind::OutOfRange,
            "8 x 4 pixels of Mono8 (GREY) were asked for, the driver makes it 16 x 4 of GREY",
        ),
        ("", |s| s.device().controls.clear(), DeviceErrorKind::OutOfRange, "exposure_time_absolute"),
        (
            "controls = [[\"shutter\", 1]]",
            |_| (),
            DeviceErrorKind::OutOfRange,
            "no control \"shutter\"; it has exposure_time_absolute, gain, trigger_mode",
        ),
        (
            "controls = [[\"gain\", 256]]",
            |_| (),
            DeviceErrorKind::OutOfRange,
            "gain = 256: must be from 0 to 255",
        ),
        (
            "controls = [[\"coarse\", 7]]",
            |s| s.device().controls.push(control("Coarse", 0, 10, 1, 0)),
            DeviceErrorKind::OutOfRange,
            "coarse = 7 reads back as 4",
        ),
        (
            "frames_per_s = 60",
            |s| s.device().frame_rate_max = 30.0,
            DeviceErrorKind::OutOfRange,
            "frames_per_s = 60: the driver makes it 30.000",
        ),
        (
            "frames_per_s = 60",
            |s| s.device().failures.push(("set_frame_rate", ENOTTY)),
            DeviceErrorKind::Unsupported,
            "leave the key out",
        ),
        (
            "",
            |s| {
                let blanking = [
                    control("Horizontal Blanking", 0, 1000, 1, 92),
                    control("Pixel Rate", 0, 1 << 40, 1, 5_000_000),
                ];
                s.device().controls.extend(blanking);
            },
            DeviceErrorKind::OutOfRange,
            "rows take 20.000 us",
        ),
        ("buffers = 1", |_| (), DeviceErrorKind::OutOfRange, "buffers = 1: must be from 2 to 32"),
    ];
    for (keys, prepare, kind, expected) in cases {
        let script = Script::new([]);
        prepare(&script);
        let error = open(&script, setup(keys)).err().unwrap();
        assert_eq!(error.kind, kind, "{error}");
        assert!(error.to_string().contains(expected), "{expected:?}: {error}");
    }
    for (format, width, expected) in [("Mono12p", 8, "Mono12g24"), ("Mono10g40", 6, "multiple of 4")] {
        let mut setup = setup("");
        setup.format = format.parse().unwrap();
        setup.config.width = width;
        let error = open(&Script::new([]), setup).err().unwrap();
        assert!(error.to_string().contains(expected), "{error}");
    }
}

#[test]
fn row_times_come_from_the_sensor_where_it_tells_them() {
    let script = Script::new([]);
    script.device().controls = vec![
        control("Exposure", 2, 3000, 1, 100),
        control("Horizontal Blanking", 0, 1000, 1, 42),
        control("Pixel Rate", 0, 1 << 40, 1, 5_000_000),
        control("Trigger Delay", 0, 4_000_000, 1, 0),
    ];
    let keys = "trigger_delay = { control = \"trigger_delay\", unit_us = 0.5 }\ntrigger_latency_us = 3";
    let mut camera = open(&script, setup(keys)).unwrap();
    let capabilities = camera.capabilities();
    assert_eq!((capabilities.row_time_us, capabilities.readout_us), (10.0, 40.0));
    assert_eq!(capabilities.exposure_us, 20.0..=30_000.0, "the sensor's exposure is in rows");
    assert_eq!(capabilities.trigger_delay_us, 0.0..=2e6);
    assert_eq!(capabilities.model, "Camera (scripted)");
    let settings = CameraSettings { trigger_delay_us: 700.2, ..exposed(614.0) };
    let applied = camera.configure(ID, &settings).unwrap();
    assert_eq!(applied.actual, CameraSettings { trigger_delay_us: 700.0, ..exposed(610.0) });
}

#[test]
fn without_a_delay_control_delays_cannot_be_swept() {
    let mut camera = open(&Script::new([]), setup("")).unwrap();
    let refused =
        camera.configure(ID, &CameraSettings { trigger_delay_us: 1.0, ..exposed(500.0) }).unwrap_err();
    assert_eq!(refused.kind, DeviceErrorKind::OutOfRange);
    assert!(refused.to_string().contains("delays cannot be swept"), "{refused}");
    let refused = camera.configure(ID, &exposed(1e6)).unwrap_err();
    assert!(refused.to_string().contains("100 to 10000"), "{refused}");
    let refused = camera.configure(ID, &CameraSettings { shutter: Shutter::Global, ..exposed(500.0) });
    assert_eq!(refused.unwrap_err().kind, DeviceErrorKind::Unsupported);
}

#[test]
fn settings_are_promised_from_a_frame_that_surely_has_them() {
    let script = Script::new([frame(0), frame(1), frame(2), Step::Nothing]);
    let mut feed = Feed::new(&script, setup(""));
    assert_eq!(feed.seqs(1), [0]);
    // Frames 1 and 2 are already complete and wait; frame 3 is in progress, and 3 and 4 may still have the old
    // settings.
    let applied = feed.camera.configure(ID, &exposed(700.0)).unwrap();
    assert_eq!(applied.first_frame, FirstFrame::Within { earliest: 3, certain: 5 });
    assert_eq!(feed.seqs(2), [1, 2]);
    let again = feed.camera.configure(ID, &exposed(700.0)).unwrap();
    assert_eq!(again.first_frame.certain(), 5, "nothing is written, nothing is later");
    script.device().steps.extend([frame(3), frame(4), frame(5), frame(6), frame(7)]);
    assert_eq!(feed.seqs(4), [3, 4, 5, 6]);
    let later = feed.camera.configure(ID, &exposed(700.0)).unwrap();
    assert_eq!(later.first_frame, FirstFrame::Within { earliest: 8, certain: 8 }, "frame 7 was there");
}

#[test]
fn refused_settings_leave_the_old_ones() {
    let script = Script::new([frame(0)]);
    let mut feed = Feed::new(&script, setup(""));
    feed.camera.configure(ID, &exposed(700.0)).unwrap();
    script.device().failures.push(("set_control", EBUSY));
    let refused = feed.camera.configure(ID, &exposed(900.0)).unwrap_err();
    assert_eq!(refused.kind, DeviceErrorKind::OutOfRange);
    assert!(refused.to_string().contains("exposure_us = 900"), "{refused}");
    assert_eq!(feed.camera.state(), DeviceState::Streaming);
    assert_eq!(script.device().controls[0].1, 7);
    assert_eq!(feed.camera.configure(ID, &exposed(700.0)).unwrap().actual, exposed(700.0));
}

#[test]
fn stamps_at_the_end_of_a_frame_are_taken_back_by_its_own_exposure() {
    let end = |sequence: u32| Step::Frame {
        sequence,
        timestamp_ns: 10_000_000 + i64::from(sequence) * 1_000_000,
        flags: FLAG_CLOCK_MONOTONIC,
    };
    let script = Script::new([]);
    let mut feed = Feed::new(&script, setup(""));
    // At first 1000 us, the camera's initial value. Frame 0 is in progress, and 0 and 1 may still have it.
    let applied = feed.camera.configure(ID, &exposed(500.0)).unwrap();
    assert_eq!(applied.first_frame, FirstFrame::Within { earliest: 0, certain: 2 });
    script.device().steps.extend([end(0), end(1), end(2)]);
    let starts: Vec<i64> = (0..3).map(|_| feed.next().unwrap().exposure_start_ns).collect();
    assert_eq!(starts, [10_000_000 - 1_040_000, 11_000_000 - 1_040_000, 12_000_000 - 540_000]);
}

#[test]
fn stamps_of_an_unknown_clock_give_way_to_the_arrival() {
    let script = Script::new([Step::Frame { sequence: 0, timestamp_ns: 77, flags: 0 }]);
    let mut feed = Feed::new(&script, setup(""));
    let stamp = feed.next().unwrap();
    assert_eq!(stamp.exposure_start_ns, stamp.host_ns - 1_040_000);
}

#[test]
fn damaged_frames_and_gaps_show_in_the_ids() {
    let damaged =
        |sequence| Step::Frame { sequence, timestamp_ns: 0, flags: FLAG_CLOCK_MONOTONIC | FLAG_ERROR };
    let script = Script::new([
        frame(0xFFFF_FF80),
        damaged(0xFFFF_FF81),
        frame(0xFFFF_FF82),
        Step::Short { sequence: 0xFFFF_FF83 },
        frame(0xFFFF_FFFF),
        frame(1),
    ]);
    let mut feed = Feed::new(&script, setup("buffers = 2"));
    assert_eq!(feed.seqs(4), [0, 2, 127, 129], "with two buffers: damaged ones go back too");
}

#[test]
fn rows_with_gaps_between_them_are_put_together() {
    let script = Script::new([frame(9)]);
    script.device().format = |wanted| Format { bytes_per_line: 64, ..wanted };
    let mut feed = Feed::new(&script, setup(""));
    feed.next().unwrap();
    assert!(feed.buf.iter().all(|byte| *byte == 9), "{:?}", &*feed.buf);
}

#[test]
fn a_camera_that_is_pulled_out_and_plugged_in_goes_on_as_it_was() {
    let script = Script::new([]);
    // The frame before the loss is exposed at 5 ms.
    let keys = "controls = [[\"trigger_mode\", 1]]";
    let mut feed = Feed::new(&script, setup(keys));
    feed.camera.configure(ID, &exposed(700.0)).unwrap();
    script.device().steps.extend([frame(5), Step::Gone]);
    assert_eq!(feed.seqs(1), [0]);
    script.device().refusals.extend([ENOENT; 3]);
    assert!(feed.next().is_none());
    assert_eq!(feed.camera.state(), DeviceState::Lost);
    let refused = feed.camera.configure(ID, &exposed(800.0)).unwrap_err();
    assert_eq!(refused.kind, DeviceErrorKind::Disconnected);
    // It comes back with the control values that it has after power-on.
    script.device().controls[0].1 = 10;
    script.device().controls[2].1 = 0;
    script.device().steps = [frame(0), frame(1)].into();
    let began_ns = feed.camera.clock.now_ns();
    let waits = (0..20).take_while(|_| feed.next().is_none()).count();
    assert!(waits < 20, "it never came back");
    assert_eq!(feed.camera.state(), DeviceState::Streaming);
    // Attempts at once and after 100, 200 and 400 ms.
    assert!(feed.camera.clock.now_ns() - began_ns <= 700_000_000);
    // The time away in periods of 10 ms, from the exposure of frame 0; the first frame after the gap was taken above.
    let seq = feed.seqs(1)[0];
    let first = seq - 1;
    assert_eq!(first, 1 + (feed.camera.clock.now_ns() as u64 - 5_000_000) / 10_000_000);
    assert_eq!(feed.camera.loss_of(1), LossCause::CameraLost);
    assert_eq!(feed.camera.loss_of(first - 1), LossCause::CameraLost);
    assert_eq!(feed.camera.loss_of(first), LossCause::CameraGap);
    let held = script.device().controls.iter().map(|(_, value)| *value).collect::<Vec<_>>();
    assert_eq!(held, [7, 0, 1], "settings and controls are back");
}

#[test]
fn a_camera_that_stays_away_ends_the_run() {
    let script = Script::new([Step::Gone]);
    let mut feed = Feed::new(&script, V4l2Setup { reopen: Duration::from_secs(3), ..setup("") });
    script.device().refusals.extend([ENOENT; 1000]);
    let gone = loop {
        match feed.camera.next_frame(&mut feed.buf, WAIT) {
            Ok(stamp) => assert!(stamp.is_none()),
            Err(error) => break error,
        }
    };
    assert_eq!(gone.kind, DeviceErrorKind::Disconnected);
    assert!(gone.to_string().contains("camera.reopen_s = 3 s"), "{gone}");
    assert_eq!(feed.camera.clock.now_ns(), 3_000_000_000);
}

#[test]
fn a_camera_that_opens_again_and_then_stays_silent_ends_the_run() {
    let script = Script::new([Step::Gone]);
    let mut feed = Feed::new(&script, V4l2Setup { reopen: Duration::from_secs(3), ..setup("") });
    let silent = loop {
        match feed.camera.next_frame(&mut feed.buf, WAIT) {
            Ok(stamp) => assert_eq!((stamp, feed.camera.state()), (None, DeviceState::Lost)),
            Err(error) => break error,
        }
    };
    assert_eq!((silent.kind, script.device().opened), (DeviceErrorKind::Disconnected, 2));
    assert!(silent.to_string().contains("delivered nothing within camera.reopen_s = 3 s"), "{silent}");
    assert_eq!(feed.camera.clock.now_ns(), 3_000_000_000);
}

#[test]
fn another_camera_at_the_same_place_is_not_taken() {
    let script = Script::new([Step::Gone]);
    let mut feed = Feed::new(&script, setup(""));
    script.device().identity.card = "Other".into();
    assert!((0..5).all(|_| feed.next().is_none()));
    assert_eq!(feed.camera.state(), DeviceState::Lost);
}

#[test]
fn a_stream_that_fails_is_built_anew() {
    for errno in [EIO, EINVAL] {
        let script = Script::new([frame(0), Step::Error(errno), frame(0)]);
        let mut feed = Feed::new(&script, setup(""));
        assert_eq!(feed.seqs(2), [0, 1]);
        assert_eq!(script.device().opened, 2);
    }
    // A buffer that cannot be queued again.
    let script = Script::new([frame(0), frame(0)]);
    let mut feed = Feed::new(&script, setup(""));
    script.device().failures.push(("queue", EINVAL));
    assert_eq!(feed.seqs(1).len(), 1);
    assert_eq!((script.device().opened, feed.camera.state()), (2, DeviceState::Streaming));
}

#[test]
fn a_stream_that_fails_for_ever_takes_no_more_than_the_time_given_and_is_given_up() {
    let script = Script::new([Step::Error(EIO); 1000]);
    let mut feed = Feed::new(&script, setup(""));
    assert!((0..50).all(|_| feed.next().is_none()));
    assert_eq!(feed.camera.clock.now_ns(), 50 * 100_000_000);
    // Attempts after 0, 0.1, 0.3, 0.7, 1.5, 2.5, 3.5 and 4.5 s.
    assert_eq!(script.device().opened, 1 + 8);
    let given_up = (0..).find_map(|_| feed.camera.next_frame(&mut feed.buf, WAIT).err()).unwrap();
    assert_eq!(given_up.kind, DeviceErrorKind::Disconnected);
    assert_eq!(feed.camera.clock.now_ns(), 60_000_000_000);
}

#[test]
fn arming_a_camera_that_another_program_took_says_so_and_can_be_tried_again() {
    let script = Script::new([frame(0)]);
    let mut camera = open(&script, setup("")).unwrap();
    script.device().failures.push(("start", EBUSY));
    let refused = camera.arm().unwrap_err();
    assert_eq!((refused.kind, camera.state()), (DeviceErrorKind::Busy, DeviceState::Ready));
    camera.arm().unwrap();
    let mut feed = Feed { camera, buf: FramePool::new(1, 32).take() };
    assert_eq!(feed.seqs(1), [0]);
}

#[test]
fn a_device_that_goes_while_it_stops_is_lost_and_arms_again_when_it_is_back() {
    let script = Script::new([frame(0), Step::Gone]);
    let mut feed = Feed::new(&script, setup(""));
    feed.seqs(1);
    script.device().refusals.extend([ENOENT; 2]);
    assert!(feed.next().is_none());
    feed.camera.disarm().unwrap();
    assert_eq!(feed.camera.state(), DeviceState::Lost);
    assert_eq!(feed.camera.arm().map_err(|error| error.kind), Ok(()));
    script.device().steps.push_back(frame(0));
    assert_eq!(feed.seqs(1), [1]);
}

#[test]
fn a_buffer_of_another_size_is_refused() {
    let mut feed = Feed::new(&Script::new([frame(0)]), setup(""));
    let mut small = FramePool::new(1, 31).take();
    let refused = feed.camera.next_frame(&mut small, WAIT).unwrap_err();
    assert!(refused.to_string().contains("31 bytes for frames of 32"), "{refused}");
}
