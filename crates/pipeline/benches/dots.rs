//! Benchmark of the flying dot's pipeline at the rate that the machine sustains: frames of 1024 x 1024 pixels from
//! memory through pool, queue, workers and gatherer, compared with the same kernels in a plain loop over the same
//! frames.
//!
//! `cargo xtask bench dots --live [--json]`

use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::{Rng, SeedableRng};
use std::error::Error;
use std::sync::Mutex;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use rayon::prelude::*;
use raysweep_core::{Counts, Frame, FramePool, FrameStamp, LossCause, PixelFormat};
use raysweep_pipeline::dots::{
    Arrival, Cut, CutSink, DarkRun, DotScan, DotsFlow, DotsFlowConfig, Gathered, Sensor, column_stage,
};
use raysweep_pipeline::{Policy, QueueError};
use raysweep_transport::dots::product::floodlit;
use raysweep_transport::dots::{Background, Batch, FrameShape, Region, Sampling, SparseColumn};

const SIDE_PX: usize = 1024;
/// Dots per batch, as in the paper.
const DOTS: u32 = 2250;
const FORMAT: PixelFormat = PixelFormat::Mono12;
/// Number of distinct frames; together they exceed the caches.
const DISTINCT: usize = 128;
/// Frames without light.
const DARK: usize = 32;
/// Enough that a host which stalls for a fifth of a second, as virtual machines do, loses no frames.
const POOL_FRAMES: usize = QUEUE_FRAMES + 16;
const QUEUE_FRAMES: usize = 640;
/// Duration of the rate measurements, and of the paced run.
const MEASURED: Duration = Duration::from_secs(10);
const PACED: Duration = Duration::from_secs(60);
/// Share of the measured rate at which frames arrive in the paced run.
const PACE: f64 = 0.8;

/// Frames in memory: some without light, some of the scene, one of the beam dump, one with the trailing dot.
struct Memory {
    shape: FrameShape,
    dark: Vec<Vec<u16>>,
    frames: Vec<Vec<u16>>,
}

impl Memory {
    fn new() -> Result<Self, Box<dyn Error>> {
        let shape = FrameShape::new(SIDE_PX, SIDE_PX, 1)?;
        let frame = |number: usize| {
            let mut random = Xoshiro256PlusPlus::seed_from_u64(number as u64);
            let mut counts: Vec<u16> = (0..shape.pixels())
                .map(|_| {
                    let state = random.next_u64();
                    // The sum of four uniform numbers approximates normal noise of 3 counts.
                    100 + (0..4).map(|byte| (state >> (8 * byte) & 0xff) as f32 / 49.0).sum::<f32>() as u16
                })
                .collect();
            let mut stamp = |row: usize, column: usize, light: f64| {
                for (down, right) in (0..33).flat_map(|down| (0..33).map(move |right| (down, right))) {
                    let distance = (down as f64 - 16.0).hypot(right as f64 - 16.0) / 16.0;
                    let pixel = &mut counts[(row + down) * SIDE_PX + column + right];
                    *pixel = (f64::from(*pixel) + light * (1.0 - distance.powi(4)).max(0.0)) as u16;
                }
            };
            match number {
                0 | DISTINCT.. => {}
                1 => stamp(0, 0, 1500.0),
                _ => {
                    let place = number * 7919;
                    stamp(64 + place % 900, 64 + place / 3 % 900, 1500.0);
                    if number.is_multiple_of(3) {
                        stamp(64 + place / 7 % 900, 64 + place / 11 % 900, 80.0);
                    }
                }
            }
            counts
        };
        let mut frames: Vec<Vec<u16>> = (0..DISTINCT + DARK).into_par_iter().map(frame).collect();
        let dark = frames.split_off(DISTINCT);
        Ok(Self { shape, dark, frames })
    }

    /// The camera's frame number `seq`.
    fn frame(&self, seq: u64) -> &[u16] {
        let index = (seq % u64::from(DOTS)) as u32;
        match index {
            0 => &self.frames[0],
            index if index == DOTS - 1 => &self.frames[1],
            index => &self.frames[2 + index as usize % (DISTINCT - 2)],
        }
    }

    fn scan(&self) -> DotScan {
        DotScan {
            shape: self.shape,
            dots: DOTS,
            trailing_index: DOTS - 1,
            trailing_region: Region { rows: 0..48, columns: 0..48 },
            background_indices: vec![0],
            batches: u32::MAX,
        }
    }

    fn sensor(&self) -> Result<Sensor, Box<dyn Error>> {
        let mut run = DarkRun::new(self.shape, FORMAT.max_value(), DARK as u32, 64)?;
        for dark in &self.dark {
            run.push(dark)?;
        }
        Ok(run.finish(8.0, None, Sampling::Full)?)
    }
}

/// Counts batches, and computes the floodlit image of each as the daemon does.
struct Watched {
    shape: FrameShape,
    batches: u64,
    counts: Counts,
}

impl CutSink for Watched {
    fn take(&mut self, cut: Cut) {
        self.batches += 1;
        self.counts.add(&cut.counts);
        if let Ok(batch) = Batch::new(self.shape, cut.columns) {
            std::hint::black_box(floodlit(&batch));
        }
    }

    fn outside(&mut self, counts: Counts) {
        self.counts.add(&counts);
    }
}

/// The results of a flow.
struct Ran {
    frames: u64,
    lost: u64,
    batches: u64,
    seconds: f64,
}

impl Ran {
    fn rate_hz(&self) -> f64 {
        self.frames as f64 / self.seconds
    }
}

/// Sends frames for `duration`, as fast as they are accepted or at the given rate.
fn flow(memory: &Memory, duration: Duration, rate_hz: Option<f64>) -> Result<Ran, Box<dyn Error>> {
    let Sensor { correction, background, floor } = memory.sensor()?;
    let stage = column_stage("denoise", serde_json::json!({}), &correction)?;
    let config = DotsFlowConfig {
        scan: memory.scan(),
        format: FORMAT,
        saturation_dn: FORMAT.max_value(),
        stage,
        correction,
        background,
        floor,
        threads: 0,
        queue_frames: QUEUE_FRAMES,
        policy: if rate_hz.is_some() { Policy::Fail } else { Policy::Wait },
    };
    let sink = Watched { shape: memory.shape, batches: 0, counts: Counts::default() };
    let (flow, mut input) = DotsFlow::start(config, sink)?;
    let pool = FramePool::new(POOL_FRAMES, FORMAT.frame_bytes(memory.shape.pixels()));
    let (mut seq, mut refused) = (0, Counts::default());
    let began = Instant::now();
    while began.elapsed() < duration {
        if let Some(rate_hz) = rate_hz {
            let due = Duration::from_secs_f64(seq as f64 / rate_hz);
            std::thread::sleep(due.saturating_sub(began.elapsed()));
        }
        let data = if rate_hz.is_some() { pool.try_take() } else { Some(pool.take()) };
        let Some(mut data) = data else {
            refused.lose(LossCause::PoolEmpty, 1);
            seq += 1;
            continue;
        };
        // The copy that a driver would make.
        data.copy_from_slice(bytemuck::cast_slice(memory.frame(seq)));
        let stamp = FrameStamp { seq, device_ns: 0, exposure_start_ns: 0, host_ns: 0, exposure_us: None };
        let arrival = Arrival { frame: Frame { data, format: FORMAT, stamp }, lost_before: Vec::new() };
        match input.offer(arrival) {
            Ok(()) => {}
            Err(QueueError::Full(_)) => refused.lose(LossCause::QueueFull, 1),
            Err(QueueError::Closed) => return Err("the pipeline has ended".into()),
        }
        seq += 1;
    }
    drop(input);
    let Gathered { sink, error, .. } = flow.join()?;
    let seconds = began.elapsed().as_secs_f64();
    match error {
        Some(error) => Err(error.into()),
        None => Ok(Ran {
            frames: seq - refused.lost_total(),
            lost: refused.lost_total() + sink.counts.lost_total(),
            batches: sink.batches,
            seconds,
        }),
    }
}

/// Who copies the frames of a plain loop.
#[derive(Clone, Copy)]
enum Copying {
    /// Nobody: they are processed in place.
    No,
    /// Each thread copies its own frames, all in parallel.
    ByEach,
    /// One source copies them, one after the other, like a device's driver.
    ByOneSource,
}

/// Runs the same kernels over the same frames without queues and batches; returns frames per second.
fn plain(memory: &Memory, copying: Copying) -> Result<f64, Box<dyn Error>> {
    let Sensor { correction, background, floor } = memory.sensor()?;
    let stage = column_stage("denoise", serde_json::json!({}), &correction)?;
    let background = Background::new(&correction, background.mean())?;
    let threads = std::thread::available_parallelism()?.get();
    let (source, next) = (Mutex::new(()), AtomicU64::new(0));
    let began = Instant::now();
    std::thread::scope(|scope| {
        for _ in 0..threads {
            scope.spawn(|| {
                let (mut worker, mut column) = (stage.worker(), SparseColumn::default());
                let mut copy = vec![0; memory.shape.pixels()];
                while began.elapsed() < MEASURED {
                    let turn = matches!(copying, Copying::ByOneSource).then(|| source.lock());
                    let mut frame = memory.frame(next.fetch_add(1, Ordering::Relaxed));
                    if !matches!(copying, Copying::No) {
                        copy.copy_from_slice(frame);
                        frame = &copy;
                    }
                    drop(turn);
                    std::hint::black_box(worker.column(frame, &background, floor, &mut column).is_ok());
                }
            });
        }
    });
    Ok(next.into_inner() as f64 / began.elapsed().as_secs_f64())
}

fn main() -> Result<(), Box<dyn Error>> {
    let is_json = std::env::args().any(|argument| argument == "--json");
    let memory = Memory::new()?;
    let bare_hz = plain(&memory, Copying::No)?;
    let copied_hz = plain(&memory, Copying::ByEach)?;
    let source_hz = plain(&memory, Copying::ByOneSource)?;
    let free = flow(&memory, MEASURED, None)?;
    let paced = flow(&memory, PACED, Some(PACE * free.rate_hz()))?;
    let ratio = free.rate_hz() / source_hz;
    let [of_copied, of_bare] = [copied_hz, bare_hz].map(|hz| free.rate_hz() / hz);
    let case = format!("{SIDE_PX}x{SIDE_PX}, {DOTS} dots");
    if is_json {
        println!(
            "{{\"bench\":\"dots-live\",\"case\":\"{case}\",\"plain_hz\":{bare_hz:.1},\"copied_hz\":{copied_hz:.1},\"one_source_hz\":{source_hz:.1},\"pipeline_hz\":{:.1},\"ratio\":{ratio:.3},\"paced_hz\":{:.1},\"paced_seconds\":{:.1},\"paced_frames\":{},\"paced_lost\":{},\"paced_batches\":{}}}",
            free.rate_hz(),
            paced.rate_hz(),
            paced.seconds,
            paced.frames,
            paced.lost,
            paced.batches
        );
        return Ok(());
    }
    println!("{case}: frames a second");
    println!("  kernels in a plain loop                 {bare_hz:8.0}");
    println!("  the same, each thread copies its frames {copied_hz:8.0}");
    println!("  the same, one source copies them        {source_hz:8.0}");
    println!(
        "  pool, queue, workers, batches           {:8.0}   {ratio:.2} of the plain loop with one source, {of_copied:.2} of that with copies by each thread, {of_bare:.2} of that without",
        free.rate_hz()
    );
    println!(
        "  the same, paced, for {:.0} s              {:8.0}   {} frames, {} lost, {} batches",
        paced.seconds,
        paced.rate_hz(),
        paced.frames,
        paced.lost,
        paced.batches
    );
    if paced.lost > 0 { Err("frames were lost".into()) } else { Ok(()) }
}
