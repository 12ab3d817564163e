//! Number of allocations per frame of the flying dot, from the pool to its batch: none. A batch costs a few, however
//! many frames it has.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]
#![allow(unsafe_code, reason = "an allocator that counts")]

use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use std::alloc::{GlobalAlloc, Layout, System};
use std::sync::atomic::{AtomicU64, Ordering};

use raysweep_core::{Counts, Frame, FramePool, FrameStamp, PixelFormat};
use raysweep_pipeline::Policy;
use raysweep_pipeline::dots::{
    Arrival, Cut, CutSink, DarkRun, DotScan, DotsFlow, DotsFlowConfig, Sensor, column_stage,
};
use raysweep_transport::dots::{FrameShape, Region, Sampling};
use serde_json::json;

/// Number of allocations by all threads.
static ALLOCATED: AtomicU64 = AtomicU64::new(0);

struct Counting;

// SAFETY: every call is forwarded unchanged to the system's allocator; the counter is a plain number.
unsafe impl GlobalAlloc for Counting {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        ALLOCATED.fetch_add(1, Ordering::Relaxed);
        // SAFETY: the caller upholds the contract, which is the same.
        unsafe { System.alloc(layout) }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        // SAFETY: the caller upholds the contract, which is the same.
        unsafe { System.dealloc(memory, layout) }
    }
}

#[global_allocator]
static ALLOCATOR: Counting = Counting;

const SIDE: usize = 64;
const BATCHES: u32 = 40;
/// Number of batches after which all buffers have their final size.
const WARM: usize = 24;

/// Records the allocations up to the end of each batch.
#[derive(Default)]
struct Ledger(Vec<u64>);

impl CutSink for Ledger {
    fn take(&mut self, cut: Cut) {
        assert_eq!(cut.counts.averaged as usize, cut.seen.len());
        self.0.push(ALLOCATED.load(Ordering::Relaxed));
    }

    fn outside(&mut self, _: Counts) {}
}

/// A frame with noise, and light around `centre`.
fn counts(seed: u64, centre: Option<(usize, usize)>) -> Vec<u16> {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
    let mut counts: Vec<u16> = (0..SIDE * SIDE).map(|_| 100 + (random.next_u64() >> 61) as u16).collect();
    if let Some((row, column)) = centre {
        for pixel in
            (row - 2..row + 3).flat_map(|row| (column - 2..column + 3).map(move |column| row * SIDE + column))
        {
            counts[pixel] += 500;
        }
    }
    counts
}

/// Allocations per batch of this many dots, in the steady state.
fn allocations_a_batch(dots: u32, format: PixelFormat) -> f64 {
    let shape = FrameShape::new(SIDE, SIDE, 1).unwrap();
    let mut dark = DarkRun::new(shape, 4000, 32, 16).unwrap();
    for number in 0..32 {
        assert_eq!(dark.push(&counts(number, None)).unwrap(), number < 31);
    }
    let Sensor { correction, background, floor } = dark.finish(8.0, None, Sampling::Full).unwrap();
    let stage = column_stage("denoise", json!({ "radius_px": 5.0 }), &correction).unwrap();
    let trailing_region = Region { rows: 0..8, columns: 56..64 };
    let scan = DotScan {
        shape,
        dots,
        trailing_index: dots - 1,
        trailing_region,
        background_indices: vec![0],
        batches: BATCHES,
    };
    let config = DotsFlowConfig {
        scan,
        format,
        saturation_dn: 4000,
        stage,
        correction,
        background,
        floor,
        threads: 2,
        queue_frames: 8,
        policy: Policy::Wait,
    };
    let pool = FramePool::new(64, format.frame_bytes(SIDE * SIDE));
    let packed = |counts: Vec<u16>| {
        let mut frame = vec![0; format.frame_bytes(SIDE * SIDE)];
        format.pack_into(&counts, &mut frame).unwrap();
        frame
    };
    let (dump, trailing) = (packed(counts(90, None)), packed(counts(91, Some((4, 60)))));
    let lit: Vec<Vec<u8>> = (0..16)
        .map(|dot| packed(counts(100 + dot, Some((20 + dot as usize, 10 + 2 * dot as usize)))))
        .collect();
    let (flow, mut input) = DotsFlow::start(config, Ledger::default()).unwrap();
    for step in 0..u64::from(dots) * u64::from(BATCHES + 2) {
        let index = step % u64::from(dots);
        let image = match index {
            0 => &dump,
            last if last + 1 == u64::from(dots) => &trailing,
            index => &lit[index as usize % 16],
        };
        let mut data = pool.take();
        data.copy_from_slice(image);
        let at_ns = step as i64 * 1000;
        let stamp = FrameStamp {
            seq: step,
            device_ns: at_ns,
            exposure_start_ns: at_ns,
            host_ns: at_ns,
            exposure_us: None,
        };
        let arrival = Arrival { frame: Frame { data, format, stamp }, lost_before: Vec::new() };
        assert!(input.offer(arrival).is_ok());
    }
    drop(input);
    let gathered = flow.join().unwrap();
    assert!(gathered.error.is_none());
    let allocated = gathered.sink.0;
    assert_eq!(allocated.len(), BATCHES as usize);
    // Memory for columns grows whenever more of them are under way than ever before, which a busy machine brings about
    // in many batches; it only ever adds allocations, while those of individual frames would show in every batch.
    allocated[WARM..BATCHES as usize - 1].windows(2).map(|ends| ends[1] - ends[0]).min().unwrap() as f64
}

#[test]
fn a_frame_allocates_nothing_and_a_batch_the_same_whatever_its_length() {
    for format in [PixelFormat::Mono12, PixelFormat::Mono12p] {
        let (few, many) = (allocations_a_batch(64, format), allocations_a_batch(512, format));
        println!("{format}: {few} allocations for a batch of 64 dots, {many} for one of 512");
        assert!(few < 64.0 && (many - few) / 448.0 < 0.02, "{format}: {few}, {many}");
    }
}
