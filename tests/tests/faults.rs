//! Simulated faults: whatever goes wrong with VSYNC, camera or settings, each stored image matches its settings.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::path::Path;

use ndarray::Array2;
use raysweep_config::{Plan, Procedure, RigFile};
use raysweep_core::{LossCause, PixelFormat};
use raysweep_session::stack::ArrayName;
use raysweep_sim::{PlaneRig, PlaneSetup};
use raysweep_tests::{Bench, Ended, rig_text};

/// Exposures and delays are spaced so widely that no frame can be mistaken for one of another point.
const PLAN: &str = "kind = \"sweep\"\n[sweep]\naverage = 4\n\
                    delay_us = [-900, -300, 150, 450, 1100]\nexposure_us = [300, 800, 1300]\n";

/// A textured scene of 32 x 24 pixels without noise, but with jitter and a 720-row projector frame.
fn rig(faults: &str) -> String {
    let sim = "scene = \"v-groove\"\nscene_rows = 32\nscene_columns = 24\nseed = 5";
    rig_text(720, sim, &format!("[sim.sensor]\nnoise = false\n{faults}"))
}

/// The reference for stored points: noise-free light at the delays measured for their frames.
fn truth(rig_toml: &str) -> PlaneRig {
    let rig = RigFile::parse(rig_toml).unwrap();
    let setup = PlaneSetup {
        raster: rig.raster(),
        camera_row_time_us: rig.camera_row_time_us(),
        row_pitch: 1.0,
        white_dn: rig.camera.white_dn(),
        black_dn: rig.camera.black_dn(),
        format: PixelFormat::Mono12,
        first_row: None,
    };
    PlaneRig::new(rig.sim, setup, Path::new("")).unwrap()
}

fn assert_true(rig_toml: &str, ended: &Ended) {
    let truth = truth(rig_toml);
    let (_, state) = ended.open();
    let Procedure::Sweep(sweep) = Plan::parse(PLAN).unwrap().procedure else { panic!("a sweep") };
    let (delays, exposures) = (sweep.delay_us.values(), sweep.exposure_us.values());
    assert!(state.counts.balanced(), "{:?}", state.counts);
    assert_eq!(state.stored(ArrayName::Sum).count(), 15, "every point is stored");
    for point in state.stored(ArrayName::Sum) {
        assert!(point.counts.balanced(), "{point:?}");
        assert_eq!(point.exposure_us, exposures[point.index / 5]);
        assert_eq!(point.delay_us, delays[point.index % 5]);
        let mut expected = Array2::<f64>::zeros((32, 24));
        for &delay_us in &point.delays_us {
            assert!((delay_us - point.delay_us).abs() < 50.0);
            expected += &truth.noise_free(delay_us, point.exposure_us).unwrap().mapv(f64::from);
        }
        expected *= 2500.0 / point.delays_us.len() as f64;
        let stored = ended.mean(ArrayName::Sum, point.index) - 64.0;
        let off = (&stored - &expected).iter().fold(0.0_f64, |most, x| x.abs().max(most));
        assert!(
            off < 2.0,
            "point {} ({} us, {} us) is off by {off} counts",
            point.index,
            point.delay_us,
            point.exposure_us
        );
    }
}

/// Runs the plan under faults; returns the number of losses by cause.
fn survive(faults: &str) -> std::collections::BTreeMap<LossCause, u64> {
    let rig = rig(faults);
    let bench = Bench::new(&rig);
    let ended = bench.run(PLAN);
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    assert_true(&rig, &ended);
    ended.open().1.counts.lost
}

#[test]
fn without_faults_nothing_is_lost() {
    assert!(survive("").is_empty());
}

#[test]
fn settings_three_frames_late() {
    survive("[sim.camera]\nlate_frames_min = 3\nlate_frames_max = 3\n");
    survive("[sim.camera]\nlate_frames_min = 3\nlate_frames_max = 3\nchunk_exposure = false\n");
    survive(
        "[sim.camera]\nlate_frames_min = 3\nlate_frames_max = 3\ndropped = 0.05\n[sim.vsync]\nmissing = 0.05\n",
    );
}

#[test]
fn settings_late_by_varying_numbers_of_frames() {
    survive("[sim.camera]\nlate_frames_min = 0\nlate_frames_max = 3\n");
    survive("[sim.camera]\nlate_frames_min = 0\nlate_frames_max = 3\nchunk_exposure = false\n");
}

#[test]
fn missing_edges() {
    let lost = survive("[sim.vsync]\nmissing = 0.05\n");
    assert!(lost.contains_key(&LossCause::MissedTrigger), "{lost:?}");
}

#[test]
fn false_edges_that_trigger_the_camera() {
    let lost = survive("[sim.vsync]\nfalse_edges = 0.05\n");
    assert!(lost.contains_key(&LossCause::FalseEdge), "{lost:?}");
}

#[test]
fn edges_that_the_watcher_misses() {
    let lost = survive("[sim.vsync]\nunseen = 0.05\n");
    assert!(lost.contains_key(&LossCause::EdgeMissing), "{lost:?}");
}

#[test]
fn no_frame_of_a_bad_line_is_tied_to_a_wrong_edge_and_its_jitter_is_known() {
    let rig = rig("[sim.vsync]\njitter_us = 5\nmissing = 0.01\nfalse_edges = 0.01\n");
    let bench = Bench::new(&rig);
    let ended = bench.run(&PLAN.replace("average = 4", "average = 40"));
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    assert_true(&rig, &ended);
    let vsync = ended.open().1.end.unwrap().vsync.unwrap();
    println!("{vsync:?}");
    assert!(vsync.missed > 5 && vsync.false_edges > 5, "{vsync:?}");
    assert!((vsync.jitter_us / 5.0 - 1.0).abs() < 0.1, "{vsync:?}");
    // For a normal distribution and white phase noise.
    assert!((vsync.jitter_p99_us / (2.576 * 5.0) - 1.0).abs() < 0.2, "{vsync:?}");
    assert!((vsync.allan_1s.unwrap() / (3_f64.sqrt() * 5e-6) - 1.0).abs() < 0.2, "{vsync:?}");
}

#[test]
fn frames_dropped_on_the_way() {
    let lost = survive("[sim.camera]\ndropped = 0.05\n");
    assert!(lost.contains_key(&LossCause::CameraGap), "{lost:?}");
}

#[test]
fn everything_at_once() {
    survive(
        "[sim.vsync]\nmissing = 0.02\nfalse_edges = 0.02\nunseen = 0.02\njitter_us = 8\n\
         [sim.camera]\nlate_frames_min = 0\nlate_frames_max = 3\ndropped = 0.02\n",
    );
}

#[test]
fn a_camera_whose_readout_overlaps_exposure() {
    survive("[sim.camera]\nreadout = \"overlapped\"\nreadout_us = 16000\n");
}

#[test]
fn a_camera_that_answers_every_second_edge() {
    assert!(survive("[sim.camera]\nreadout_us = 16100\n").is_empty());
}

#[test]
fn a_camera_without_a_trigger_faults_the_run_and_says_so() {
    let bench = Bench::new(&rig("[sim.vsync]\nmissing = 1.0\n"));
    let ended = bench.run(PLAN);
    assert_eq!(ended.state, "faulted");
    assert!(ended.error.unwrap().contains("VSYNC"), "the error says what to look at");
}

#[test]
fn points_that_no_pass_brings_are_given_up_and_the_error_says_what_was_lost() {
    let bench = Bench::new(&rig("[sim.vsync]\njitter_us = 5\n"));
    // No line has so little jitter.
    let ended = bench.run(&PLAN.replace("average = 4", "average = 4\nmax_jitter_us = 0.001"));
    assert_eq!(ended.state, "faulted");
    let error = ended.error.clone().unwrap();
    assert!(
        error.contains("points failed in 8 passes in a row; frames of the last pass:")
            && error.contains("jitter)"),
        "{error}"
    );
    let counts = ended.open().1.counts;
    assert!(counts.balanced() && counts.lost.keys().eq([&LossCause::Jitter]), "{counts:?}");
}
