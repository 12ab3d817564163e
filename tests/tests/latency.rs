//! Sweeps with cameras whose settings take effect late: the latency found by the probe, and its cost. `faults.rs`
//! checks that all images are correct nevertheless.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use raysweep::control::Control;
use raysweep_core::SettingsLatency;
use raysweep_session::stack::ArrayName;
use raysweep_tests::{Bench, Ended, rig_text};

const PERIOD_S: f64 = 1.0 / 60.0;
/// The paper's sweep: 75 points of 8 frames, exposure in the outer loop. The regular image precedes it; its 8 frames
/// take two periods each.
const PLAN: &str = "kind = \"sweep\"\n[sweep]\ndelay_us = { start = -1500, stop = 1500, count = 15 }\n\
                    exposure_us = { start = 600, stop = 1200, count = 5 }\naverage = 8\n";
const FRAMES: f64 = 75.0 * 8.0 + 2.0 * 8.0;

struct Swept {
    bench: Bench,
    ended: Ended,
    latency: Option<SettingsLatency>,
    /// VSYNC periods between the first and the last frame with light in which no frame of a point was exposed.
    spent: f64,
    /// Unused frames within points.
    unused: u64,
}

fn sweep(camera: &str) -> Swept {
    let sim = "scene = \"v-groove\"\nscene_rows = 16\nscene_columns = 8\nseed = 5";
    let bench = Bench::new(&rig_text(720, sim, &format!("[sim.camera]\n{camera}")));
    let ended = bench.run(PLAN);
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let (_, state) = ended.open();
    assert_eq!(state.counts.lost_total(), 0, "{:?}", state.counts);
    let end = state.end.clone().unwrap();
    assert_eq!(bench.runner.status().settings_latency, end.settings_latency);
    let points = state.stored(ArrayName::Sum);
    let unused = points.map(|point| point.counts.expected - point.counts.averaged).sum();
    let spent = end.light_s.unwrap() / PERIOD_S - FRAMES;
    println!("{camera:?}: {:?}, {spent:.2} periods and {unused} frames spent", end.settings_latency);
    Swept { bench, ended, latency: end.settings_latency, spent, unused }
}

fn late(frames: u32) -> Option<SettingsLatency> {
    Some(SettingsLatency { min_frames: frames, max_frames: frames })
}

#[test]
fn settings_that_act_at_once_cost_no_time() {
    for chunk in ["", "chunk_exposure = false\n"] {
        let Swept { latency, spent, unused, .. } = sweep(chunk);
        assert_eq!((latency, unused), (late(0), 0));
        // After the regular image, whose frames end late in their second period, and before the first and after the
        // last exposure.
        assert!(spent < 2.0, "{spent}");
    }
}

#[test]
fn settings_that_act_three_frames_late_are_written_ahead() {
    let three = "late_frames_min = 3\nlate_frames_max = 3\n";
    let Swept { bench, ended, latency, spent, unused } = sweep(three);
    assert_eq!((latency, unused), (late(3), 0));
    assert!(spent < 2.0, "{spent}");
    let manifest = std::fs::read_to_string(ended.session.join("manifest.json")).unwrap();
    let manifest: serde_json::Value = serde_json::from_str(&manifest).unwrap();
    assert_eq!(manifest["settings"]["latency"], serde_json::json!({ "min_frames": 3, "max_frames": 3 }));
    drop(bench);

    // Frames do not report when a new exposure takes effect, so the maximum latency is allowed for after each of
    // the five exposure changes.
    let Swept { latency, spent, .. } = sweep(&format!("{three}chunk_exposure = false\n"));
    assert_eq!(latency, late(3));
    assert!(spent < 2.0 + 5.0 * 5.0, "{spent}");
}

#[test]
fn settings_that_act_no_one_knows_when_cost_the_frames_that_they_are_late() {
    let vary = "late_frames_min = 0\nlate_frames_max = 3\n";
    let Swept { latency, spent, .. } = sweep(vary);
    assert!(latency.is_some_and(|latency| latency.constant().is_none()), "{latency:?}");
    // 1.5 frames per point on average, as the frames' own stamps tell when settings take effect.
    assert!(spent < 2.0 + 76.0 * 2.0, "{spent}");
    let Swept { spent, .. } = sweep(&format!("{vary}chunk_exposure = false\n"));
    assert!(spent < 2.0 + 76.0 * 4.0, "{spent}");
}
