//! A frame costs no allocation between the library's buffer and the pool's.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]
#![allow(unsafe_code, reason = "an allocator that counts")]

mod support;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::time::Duration;

use raysweep_core::{Camera, CameraSettings, FramePool, PixelFormat, SettingsId, Shutter};
use raysweep_drivers::camera::aravis::{AravisCamera, AravisConfig, Region, RigFacts};

use support::{ADDRESS, FakeCamera, own_network};

struct Counting;

thread_local! {
    static ALLOCATIONS: Cell<u64> = const { Cell::new(0) };
}

// SAFETY: every call goes to the system's allocator as it came; the counter is a plain number of the thread.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let _ = ALLOCATIONS.try_with(|count| count.set(count.get() + 1));
        // SAFETY: the caller's promise is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: the caller's promise is passed on.
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

#[test]
fn a_frame_costs_no_allocation() {
    own_network();
    let _device = FakeCamera::start(&["-r", "1"]);
    let config = AravisConfig {
        address: Some(ADDRESS.into()),
        features: vec!["R[0x138]=2000".into()],
        region: Some(Region { x: 0, y: 0, width: 128, height: 128 }),
        trigger_source: "off".into(),
        ..AravisConfig::default()
    };
    let facts = RigFacts {
        format: PixelFormat::Mono8,
        row_time_us: 22.22,
        trigger_period_us: 16_666.667,
        trigger_margin_us: 500.0,
        reopen: Duration::from_secs(20),
    };
    let mut camera = AravisCamera::open(&config, facts).unwrap();
    let settings = CameraSettings { shutter: Shutter::Rolling, exposure_us: 10_000.0, trigger_delay_us: 0.0 };
    camera.configure(SettingsId { point: 0, attempt: 0 }, &settings).unwrap();
    camera.arm().unwrap();
    let pool = FramePool::new(1, 128 * 128);
    let mut buf = pool.take();
    let mut take = |frames: u32| {
        let mut taken = 0;
        while taken < frames {
            taken += u32::from(camera.next_frame(&mut buf, Duration::from_secs(2)).unwrap().is_some());
        }
    };
    take(200);
    let before = ALLOCATIONS.get();
    take(1000);
    assert_eq!(ALLOCATIONS.get(), before);
}
