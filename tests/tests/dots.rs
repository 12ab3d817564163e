//! The dot rig from plan to videos through the daemon's core, on the virtual clock.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use raysweep_core::LossCause;
use raysweep_session::dots::BatchEntry;
use raysweep_tests::{Bench, Ended};

/// A moving V-groove of 112 x 128 pixels with 16 rows for the trailing dot below it.
fn rig(more: &str) -> String {
    format!(
        "kind = \"dots\"\n[camera]\ndriver = \"sim\"\n[mirror]\ndriver = \"sim\"\n\
         [sim.dots]\nscene = \"v-groove\"\nrows = 112\ncolumns = 128\nmargin_rows = 16\nseed = 5\n{more}"
    )
}

/// 300 dots a batch, 20 batches a second.
fn plan(more: &str, batches: u32) -> String {
    format!(
        "kind = \"batches\"\n{more}\n[batches]\ncount = {batches}\ndots = 300\nexposure_us = 100\ndark_frames = 64\n\
         trailing_region = [112, 128, 48, 80]\nbackground_indices = [0]\n\
         [batches.path]\nshape = \"lissajous\"\ncycles = [7, 1]\namplitude_deg = [2.3, 1.3]\nsamples = 1500\nrate_hz = 30000\n\
         [[batches.calibration]]\nbatches = 2\n[[batches.calibration]]\nbatches = 2\n"
    )
}

fn entries(ended: &Ended) -> Vec<BatchEntry> {
    ended.open().1.batches().cloned().collect()
}

#[test]
fn one_command_makes_the_videos_of_a_moving_scene() {
    let bench = Bench::dots(&rig(""));
    let ended = bench.run(&plan("", 3));
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let (session, state) = ended.open();
    assert_eq!(state.batches().count(), 7);
    assert!(state.counts.lost.is_empty(), "{:?}", state.counts);
    for video in ["floodlit", "relit", "neighbours-direct", "neighbours-global", "epipolar-direct", "epipolar-global", "dual"] {
        for file in [format!("{video}.npy"), format!("{video}/0002.png"), format!("{video}/0002.exr")] {
            assert!(session.products_path().join(&file).exists(), "{file}");
        }
        assert!(!session.products_path().join(format!("{video}/0003.png")).exists());
    }
    assert!(session.report_path().exists() && session.manifest_path().exists());
}

#[test]
fn lost_and_repeated_frames_cost_their_dots_alone() {
    let bench = Bench::dots(&rig("[sim.dots.camera]\ndropped = 0.01\nduplicated = 0.01\nsaturated = 0.005\n"));
    let ended = bench.run(&plan("", 3));
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let entries = entries(&ended);
    assert_eq!(entries.len(), 7);
    let counts = ended.open().1.counts;
    assert!(counts.lost[&LossCause::CameraGap] > 5 && counts.lost[&LossCause::Saturated] > 1, "{counts:?}");
    assert!(entries.iter().map(|entry| entry.duplicates).sum::<u64>() > 5);
    assert!(entries.iter().all(|entry| entry.missing.len() < 20 && entry.counts.balanced()));
}
