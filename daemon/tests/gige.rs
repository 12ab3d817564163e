//! Complete sweeps over a real network connection, see [`wire`]. `cargo xtask bench camera --sweep` runs one at full
//! size.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod wire;

use raysweep_core::LossCause;

use wire::{Sweep, Then};

const SWEEP: Sweep = Sweep {
    side_px: 32,
    kind: "sweep",
    plan: "average = 4\ndelay_us = { start = -300, stop = 300, count = 7 }\nexposure_us = [400, 600]\n",
    camera: "",
    faults: &[],
    then: None,
};

/// A film by the camera's sequencer, as checked by [`wire`].
const FILM: Sweep = Sweep {
    kind: "film",
    plan: "cycles = 40\ndelay_us = [-300, -200, -100, 0, 120, 200, 350]\nexposure_us = 400\n",
    ..SWEEP
};

#[test]
fn a_sweep_over_the_wire_stores_what_the_scene_gives() {
    let counts = SWEEP.run().counts;
    assert!(!counts.lost.contains_key(&LossCause::CameraLost), "{counts:?}");
}

#[test]
fn packets_that_are_sent_again_cost_nothing() {
    let swept = Sweep { faults: &["packet_loss=0.01", "reordering=0.01"], ..SWEEP }.run();
    assert!(swept.wire.packets_lost > 0 && swept.wire.packets_resent > 0, "{:?}", swept.wire);
    // Frames delayed by resending are still attributed correctly.
    assert!(!swept.counts.lost.contains_key(&LossCause::SettingsMismatch), "{:?}", swept.counts);
}

#[test]
fn packets_that_nobody_sends_again_cost_frames_and_no_image() {
    let faults = &["packet_loss=0.05", "resend=false", "reordering=0.02"];
    let counts = Sweep { faults, ..SWEEP }.run().counts;
    assert!(counts.lost[&LossCause::PacketsLost] > 0, "{counts:?}");
}

#[test]
fn settings_that_act_late_now_and_then_mislabel_nothing() {
    Sweep { camera: "late_frames_min = 0\nlate_frames_max = 3\n", ..SWEEP }.run();
}

#[test]
fn settings_that_act_three_frames_late_mislabel_nothing() {
    let swept = Sweep { camera: "late_frames_min = 3\nlate_frames_max = 3\n", ..SWEEP }.run();
    // On a busy host a probe may see too few changes, and says so; `tests/tests/latency.rs` demands what it finds.
    if let Some(latency) = swept.end.settings_latency {
        assert_eq!((latency.min_frames, latency.max_frames), (3, 3));
    }
}

#[test]
fn a_camera_that_dies_in_the_middle_costs_the_frames_of_its_absence() {
    // During a pass, while points wait for frames; between two passes none do.
    let counts = Sweep { then: Some((8, Then::Dies)), ..SWEEP }.run().counts;
    assert!(counts.lost[&LossCause::CameraLost] > 0, "{counts:?}");
}

#[test]
fn a_film_by_the_cameras_sequencer_is_what_the_scene_gives() {
    let filmed = FILM.run();
    assert!(!filmed.counts.lost.contains_key(&LossCause::CameraLost), "{:?}", filmed.counts);
}

#[test]
fn a_film_of_more_settings_than_the_camera_has_sets_is_written_ahead() {
    let plan = "cycles = 16\ndelay_us = { start = -800, stop = 800, count = 17 }\nexposure_us = 400\n";
    Sweep { plan, ..FILM }.run();
}

#[test]
fn frames_of_a_film_that_are_lost_take_their_sets_with_them() {
    let faults = &["packet_loss=0.01", "resend=false", "reordering=0.02"];
    let counts = Sweep { faults, ..FILM }.run().counts;
    assert!(counts.lost[&LossCause::PacketsLost] > 0, "{counts:?}");
    assert!(!counts.lost.contains_key(&LossCause::Jitter), "{counts:?}");
}

#[test]
fn a_camera_that_dies_within_a_film_has_its_sets_again_when_it_is_back() {
    let counts = Sweep { then: Some((10, Then::Dies)), ..FILM }.run().counts;
    assert!(counts.lost[&LossCause::CameraLost] > 0, "{counts:?}");
}

#[test]
fn a_film_whose_sets_stamps_cannot_tell_goes_by_what_frames_say_of_them() {
    // Half a period apart: by its stamp, a frame could belong to either set.
    let plan = "cycles = 60\ndelay_us = [-500, 7833]\nexposure_us = 400\n";
    Sweep { plan, ..FILM }.run();
}

#[test]
fn a_pause_stops_the_cameras_sequencer_and_costs_no_frame() {
    let filmed = Sweep { then: Some((10, Then::IsHeld)), ..FILM }.run();
    assert!(!filmed.counts.lost.contains_key(&LossCause::Jitter), "{:?}", filmed.counts);
}

#[test]
fn a_film_that_is_cancelled_leaves_the_camera_without_its_sequencer() {
    let filmed = Sweep { then: Some((10, Then::IsCancelled)), ..FILM }.run();
    assert!(!filmed.counts.lost.contains_key(&LossCause::Jitter), "{:?}", filmed.counts);
}
