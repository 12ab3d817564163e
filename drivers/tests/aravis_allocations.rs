//! Allocations per frame: none by the driver, from the library's buffer to the pool's, and a few by the library,
//! which it frees again.
//!
//! All allocations of the process are counted: a program's own `malloc` replaces the C library's for all libraries in
//! it.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]
#![allow(unsafe_code, reason = "an allocator that counts")]

mod support;

use std::alloc::{GlobalAlloc, Layout, System};
use std::cell::Cell;
use std::ffi::c_void;
use std::process::Command;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use raysweep_core::{Camera, CameraSettings, FramePool, PixelFormat, SettingsId, Shutter};
use raysweep_drivers::camera::aravis::{AravisCamera, AravisConfig, RigFacts, SensorRegion};

use support::{ADDRESS, FakeCamera, own_network};

/// Allocations of the whole process.
static ALLOCATED: AtomicU64 = AtomicU64::new(0);
static FREED: AtomicU64 = AtomicU64::new(0);

thread_local! {
    /// Allocations by Rust code in the thread that takes frames.
    static OURS: Cell<u64> = const { Cell::new(0) };
}

/// Counts the allocations of Rust code, to separate them from those of libraries.
struct Counting;

// SAFETY: every call is passed on to the system's allocator unchanged; the counter is a plain thread-local number.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        let _ = OURS.try_with(|count| count.set(count.get() + 1));
        // SAFETY: the caller's guarantee is passed on.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: the caller's guarantee is passed on.
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

unsafe extern "C" {
    fn __libc_malloc(bytes: usize) -> *mut c_void;
    fn __libc_calloc(items: usize, bytes: usize) -> *mut c_void;
    fn __libc_free(memory: *mut c_void);
}

#[unsafe(no_mangle)]
extern "C" fn malloc(bytes: usize) -> *mut c_void {
    ALLOCATED.fetch_add(1, Ordering::Relaxed);
    // SAFETY: the C library's own function under its other name.
    unsafe { __libc_malloc(bytes) }
}

#[unsafe(no_mangle)]
extern "C" fn calloc(items: usize, bytes: usize) -> *mut c_void {
    ALLOCATED.fetch_add(1, Ordering::Relaxed);
    // SAFETY: as above.
    unsafe { __libc_calloc(items, bytes) }
}

#[unsafe(no_mangle)]
unsafe extern "C" fn free(memory: *mut c_void) {
    FREED.fetch_add(u64::from(!memory.is_null()), Ordering::Relaxed);
    // SAFETY: the caller's guarantee is passed on.
    unsafe { __libc_free(memory) }
}

/// GLib caches small pieces of memory itself, unless this is set before it starts.
const GLIB: (&str, &str) = ("G_SLICE", "always-malloc");
const FRAMES: u64 = 1000;
/// Allocations of libaravis 0.8.26 per frame: 5 for its stream's thread and its queue of buffers, and some more for
/// its heartbeat.
const LIBRARYS: u64 = 6;

/// The actual test, in a process in which GLib does not cache memory.
#[test]
fn a_frame_costs_no_allocation_of_ours_and_few_of_the_librarys() {
    let output = Command::new(std::env::current_exe().unwrap())
        .args(["--ignored", "--exact", "stream", "--nocapture"])
        .env(GLIB.0, GLIB.1)
        .output()
        .unwrap();
    let text = String::from_utf8_lossy(&output.stdout) + String::from_utf8_lossy(&output.stderr);
    println!("{text}");
    assert!(output.status.success(), "{text}");
}

#[test]
#[ignore = "needs an environment of its own: the other test runs it"]
fn stream() {
    own_network();
    let _device = FakeCamera::start(&["-r", "1"]);
    let config = AravisConfig {
        address: Some(ADDRESS.into()),
        features: vec!["R[0x138]=2000".into()],
        region: Some(SensorRegion { x: 0, y: 0, width: 128, height: 128 }),
        trigger_source: "off".into(),
        ..AravisConfig::default()
    };
    let facts = RigFacts {
        format: PixelFormat::Mono8,
        row_time_us: 22.22,
        trigger_period_us: 16_666.667,
        trigger_margin_us: 500.0,
        reopen: Duration::from_secs(20),
        free_hz: None,
    };
    let mut camera = AravisCamera::open(&config, facts).unwrap();
    let settings = CameraSettings { shutter: Shutter::Rolling, exposure_us: 10_000.0, trigger_delay_us: 0.0 };
    camera.configure(SettingsId { point: 0, attempt: 0 }, &settings).unwrap();
    camera.arm().unwrap();
    let pool = FramePool::new(1, 128 * 128);
    let mut buf = pool.take();
    let mut take = |frames: u64| {
        let mut taken = 0_u64;
        while taken < frames {
            taken += u64::from(camera.next_frame(&mut buf, Duration::from_secs(2)).unwrap().is_some());
        }
    };
    take(200);
    let count = || (OURS.get(), ALLOCATED.load(Ordering::Relaxed), FREED.load(Ordering::Relaxed));
    let before = count();
    take(FRAMES);
    let after = count();
    let (ours, allocated, freed) = (after.0 - before.0, after.1 - before.1, after.2 - before.2);
    println!("{FRAMES} frames: {ours} allocations of ours, {allocated} in the process, {freed} given back");
    assert_eq!(ours, 0);
    // The library's allocations are visible, have the known number, and are all freed.
    assert!((FRAMES..LIBRARYS * FRAMES).contains(&allocated));
    assert!(allocated.abs_diff(freed) < FRAMES / 10);
}
