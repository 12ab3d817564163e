//! A sink that waits, as for its disk, holds up no frame of the point that is being taken.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant};

use raysweep_core::{
    Applied, CameraCapabilities, CameraSettings, Edge, FirstFrame, Frame, FramePool, FrameStamp, PixelFormat,
    Raster, Readout, SettingsId, Shutter,
};
use raysweep_pipeline::{
    AssemblerConfig, DeviceEvent, Job, Label, Ordered, Pipeline, PipelineConfig, Policy, Sink, Stages,
};

const PERIOD_NS: i64 = 16_666_667;
/// Ten seconds, in which progress is due twenty times.
const FRAMES: u32 = 600;
/// A test that has not come so far after this time hangs; a busy machine takes a minute.
const HUNG: Duration = Duration::from_secs(600);

fn config() -> AssemblerConfig {
    AssemblerConfig {
        camera: CameraCapabilities {
            model: "scripted".into(),
            width: 2,
            height: 1,
            format: PixelFormat::Mono8,
            row_time_us: 20.0,
            trigger_latency_us: 0.0,
            readout_us: 1000.0,
            readout: Readout::Sequential,
            exposure_us: 1.0..=1e6,
            trigger_delay_us: 0.0..=1e6,
        },
        raster: Raster { rows: 2, row_time_us: 20.0, first_row_us: 990.0, period_us: 16_666.667 },
        first_row: 0,
        max_jitter_us: 50.0,
        saturation_dn: 255.0,
        edge_gate_us: 500.0,
    }
}

/// Holds its first unit until it is released; keeps how many frames each has.
struct Held {
    release: Receiver<()>,
    frames: Vec<u32>,
}

impl Sink for Held {
    fn take(&mut self, item: Ordered) {
        if let Ordered::Unit(unit, _) = item {
            if self.frames.is_empty() {
                self.release.recv().unwrap();
            }
            self.frames.push(unit.frames);
        }
    }

    fn end(&mut self) {}
}

#[test]
fn progress_is_left_out_rather_than_waited_for() {
    let (released, release) = channel();
    let size =
        PipelineConfig { queue_events: 4096, policy: Policy::Fail, units_under_way: 1, worker_threads: 1 };
    let sink = Held { release, frames: Vec::new() };
    let (pipeline, input) = Pipeline::start(size, config(), Stages::default(), sink).unwrap();
    let offer = |event| input.offer(event).map_err(|_full| "the queue is full").unwrap();
    let pool = FramePool::new(FRAMES as usize + 1, 2);
    let settings = CameraSettings { shutter: Shutter::Rolling, exposure_us: 600.0, trigger_delay_us: 700.0 };
    let begin = |point, frames| {
        DeviceEvent::Begin(Job {
            id: SettingsId { point, attempt: 0 },
            frames,
            applied: Applied { actual: settings, first_frame: FirstFrame::Exactly(0) },
            delay_us: 0.0,
            light_edges_later: 0,
            periods_from_last: None,
        })
    };
    (0..3).for_each(|k| offer(DeviceEvent::Edge(Edge { seq: 0, host_ns: k * PERIOD_NS })));
    offer(begin(0, 1));
    for k in 3..i64::from(FRAMES) + 4 {
        offer(DeviceEvent::Edge(Edge { seq: 0, host_ns: k * PERIOD_NS }));
        let exposure_start_ns = k * PERIOD_NS + 700_000;
        let stamp = FrameStamp {
            seq: k as u64,
            device_ns: 0,
            exposure_start_ns,
            host_ns: exposure_start_ns + 2_000_000,
            exposure_us: Some(600.0),
        };
        offer(DeviceEvent::Frame(
            Frame { data: pool.take(), format: PixelFormat::Mono8, stamp },
            Label::Counted,
        ));
        if k == 3 {
            offer(DeviceEvent::End);
            offer(begin(1, FRAMES));
        }
    }
    let decided = Arc::new(AtomicBool::new(false));
    // Before the second unit, which has to wait for the first.
    (0..2).for_each(|k| {
        let host_ns = (i64::from(FRAMES) + 4 + k) * PERIOD_NS;
        offer(DeviceEvent::Edge(Edge { seq: 0, host_ns }));
    });
    offer(DeviceEvent::Settle(decided.clone()));
    let began = Instant::now();
    while !decided.load(Ordering::Acquire) {
        assert!(began.elapsed() < HUNG, "the frames are held up");
        std::thread::sleep(Duration::from_millis(1));
    }
    released.send(()).unwrap();
    offer(DeviceEvent::End);
    drop(input);
    assert_eq!(pipeline.join().unwrap().frames, [1, FRAMES]);
}
