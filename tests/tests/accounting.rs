//! Checks the accounting against the ground truth of the simulated line, which no device reports: the frames that the
//! camera exposed, those lost in transit, and those triggered by false edges.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::path::Path;
use std::sync::mpsc::channel;
use std::time::Duration;

use raysweep_config::RigFile;
use raysweep_core::{CameraSettings, Counts, Frame, FramePool, LossCause, SettingsId, Shutter};
use raysweep_pipeline::{Assembler, AssemblerConfig, Decision, DeviceEvent, Job, Label};
use raysweep_sim::{PlaneDevices, PlaneRig, PlaneSetup};
use raysweep_tests::rig_text;

const FRAMES: u32 = 400;

/// Acquires frames under one setting and the given faults; returns the combined accounts and the ground truth.
fn observe(faults: &str) -> (Counts, Truth) {
    let rig = RigFile::parse(&rig_text(16, "scene = \"slab\"\nscene_rows = 16\nscene_columns = 8", faults))
        .unwrap();
    let setup = PlaneSetup {
        raster: rig.raster(),
        camera_row_time_us: rig.camera_row_time_us(),
        row_pitch: 1.0,
        white_dn: rig.camera.white_dn(),
        black_dn: rig.camera.black_dn(),
        format: rig.camera.pixel_format,
        first_row: None,
    };
    let bench = PlaneRig::new(rig.sim.clone(), setup, Path::new("")).unwrap();
    let PlaneDevices { mut camera, mut vsync, truth, .. } = bench.open();
    let (seen, edges) = channel();
    let watcher = std::thread::spawn(move || {
        while let Ok(edge) = vsync.next_edge(Duration::from_secs(1)) {
            if edge.is_some_and(|edge| seen.send(edge).is_err()) {
                break;
            }
        }
    });
    let capabilities = camera.capabilities().clone();
    let pool = FramePool::new(16, capabilities.format.frame_bytes(16 * 8));
    let mut assembler = Assembler::new(AssemblerConfig {
        camera: capabilities.clone(),
        raster: rig.raster(),
        first_row: 0,
        max_jitter_us: 50.0,
        saturation_dn: 4000.0,
        edge_gate_us: 500.0,
    });
    camera.arm().unwrap();
    let settings = CameraSettings { shutter: Shutter::Rolling, exposure_us: 300.0, trigger_delay_us: 500.0 };
    let id = SettingsId { point: 0, attempt: 0 };
    let applied = camera.configure(id, &settings).unwrap();
    let delay_us = rig.raster().delay_us(0, 500.0 + capabilities.trigger_latency_us, 300.0);
    let mut counts = Counts::default();
    let mut push = |event| {
        assembler.push(event, |decision| match decision {
            Decision::Failed(_, _, account) | Decision::Flushed(account, _) => counts.add(&account),
            Decision::UnderWay(_) => {}
            Decision::Unit(_) => panic!("a unit"),
        });
    };
    push(DeviceEvent::Begin(Job {
        id,
        frames: FRAMES + 1,
        applied,
        delay_us,
        light_edges_later: 0,
        periods_from_last: None,
    }));
    let mut last_seq = 0;
    for _ in 0..FRAMES {
        let mut data = pool.take();
        let stamp = camera.next_frame(&mut data, Duration::from_secs(5)).unwrap().unwrap();
        last_seq = stamp.seq;
        edges.try_iter().for_each(|edge| push(DeviceEvent::Edge(edge)));
        push(DeviceEvent::Frame(Frame { data, format: capabilities.format, stamp }, Label::Counted));
    }
    let truth = truth.read();
    push(DeviceEvent::Flush);
    drop((camera, edges));
    watcher.join().unwrap();
    assert!(counts.balanced(), "{counts:?}");
    (counts, Truth { line: truth, delivered: u64::from(FRAMES), exposed: last_seq + 1 })
}

struct Truth {
    line: raysweep_sim::LineTruth,
    delivered: u64,
    /// Exposures up to the last received frame; later ones are still in transit.
    exposed: u64,
}

fn lost(counts: &Counts, cause: LossCause) -> u64 {
    counts.lost.get(&cause).copied().unwrap_or(0)
}

#[test]
fn every_exposure_is_in_one_column_and_every_dropped_frame_in_its() {
    let (counts, truth) = observe("[sim.camera]\ndropped = 0.1\n");
    assert!(truth.line.dropped_frames > 20);
    assert_eq!(counts.expected, truth.exposed);
    assert_eq!(lost(&counts, LossCause::CameraGap), truth.exposed - truth.delivered);
    assert!(truth.line.exposures - truth.exposed <= 1, "at most one frame is on its way");
}

#[test]
fn every_false_trigger_is_found() {
    let (counts, truth) = observe("[sim.vsync]\nfalse_edges = 0.1\n");
    assert!(truth.line.false_triggers > 20);
    assert!(truth.line.false_triggers.abs_diff(lost(&counts, LossCause::FalseEdge)) <= 1, "{counts:?}");
}

#[test]
fn every_edge_that_never_came_is_a_missed_trigger() {
    let (counts, truth) = observe("[sim.vsync]\nmissing = 0.1\n");
    assert!(truth.line.missing_edges > 20);
    assert!(truth.line.missing_edges.abs_diff(lost(&counts, LossCause::MissedTrigger)) <= 1, "{counts:?}");
    assert_eq!(counts.expected, truth.exposed + lost(&counts, LossCause::MissedTrigger));
}

#[test]
fn every_edge_that_the_watcher_missed_costs_its_frame() {
    let (counts, truth) = observe("[sim.vsync]\nunseen = 0.1\n");
    assert!(truth.line.unseen_edges > 20);
    assert!(truth.line.unseen_edges.abs_diff(lost(&counts, LossCause::EdgeMissing)) <= 1, "{counts:?}");
}
