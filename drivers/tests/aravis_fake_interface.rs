//! Tests the code path of cameras other than GigE Vision, such as USB3 Vision, with the library's own camera within
//! this process: found by discovery, opened by name, without packets, sockets or addresses.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]
#![allow(unsafe_code, reason = "the bindings have no word for it")]

mod support;

use std::time::Duration;

use raysweep_core::{Camera, CameraSettings, DeviceErrorKind, FramePool, PixelFormat, SettingsId, Shutter};
use raysweep_drivers::camera::aravis::{AravisCamera, AravisConfig, RigFacts, SensorRegion, discover};

use support::own_network;

const FACTS: RigFacts = RigFacts {
    format: PixelFormat::Mono8,
    row_time_us: 22.22,
    trigger_period_us: 16_666.667,
    trigger_margin_us: 500.0,
    reopen: Duration::from_secs(20),
    free_hz: None,
};

#[test]
fn a_camera_that_is_not_on_the_network_is_found_opened_by_name_and_streams() {
    own_network();
    // SAFETY: the text is static, and no other thread uses the library yet.
    unsafe { aravis_sys::arv_enable_interface(c"Fake".as_ptr()) };
    let found = discover();
    let [camera] = found.as_slice() else { panic!("{found:?}") };
    assert_eq!(camera.protocol, "Fake");
    let config = AravisConfig {
        name: Some(camera.name.clone()),
        region: Some(SensorRegion { x: 0, y: 0, width: 64, height: 32 }),
        trigger_source: "off".into(),
        // Applies only to cameras on the network.
        packet_size: Some(9000),
        ..AravisConfig::default()
    };
    let mut camera = AravisCamera::open(&config, FACTS).unwrap();
    let capabilities = camera.capabilities();
    assert_eq!((capabilities.width, capabilities.height), (64, 32));
    let settings = CameraSettings { shutter: Shutter::Rolling, exposure_us: 5_000.0, trigger_delay_us: 0.0 };
    camera.configure(SettingsId { point: 0, attempt: 0 }, &settings).unwrap();
    camera.arm().unwrap();
    let mut buf = FramePool::new(1, 64 * 32).take();
    let mut before: Option<(u64, i64)> = None;
    for _ in 0..10 {
        let stamp = camera.next_frame(&mut buf, Duration::from_secs(2)).unwrap().unwrap();
        assert!(buf.iter().any(|&pixel| pixel != buf[0]), "a picture");
        if let Some((seq, start_ns)) = before.replace((stamp.seq, stamp.exposure_start_ns)) {
            assert!(stamp.seq > seq && stamp.exposure_start_ns > start_ns);
        }
    }
    camera.disarm().unwrap();

    let nobody = AravisConfig { name: Some("Nobody-1".into()), ..config };
    let error = AravisCamera::open(&nobody, FACTS).err().unwrap();
    assert_eq!(error.kind, DeviceErrorKind::Disconnected, "{error}");
}
