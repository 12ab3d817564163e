//! Complete sweeps with edges from a real driver: a triggerbox on a pseudo-terminal provides the simulated rig's VSYNC.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::os::unix::fs::symlink;
use std::path::Path;
use std::time::Duration;

use raysweep::control::Control;
use raysweep_core::{Counts, LossCause};
use raysweep_proto::{Event, RunParams};
use raysweep_sim::mirror::{SerialLink, WireFaults};
use raysweep_sim::triggerbox::TriggerBoxPty;
use raysweep_tests::{Bench, Ended, end_of, next_event, rig_text};

fn plug(faults: WireFaults) -> TriggerBoxPty {
    TriggerBoxPty::plug(16_666_667, SerialLink::VirtualCom, faults).unwrap()
}

fn bench(port: &Path, reopen_s: f64) -> Bench {
    let sim = "realtime = true\nscene = \"slab\"\nscene_rows = 16\nscene_columns = 8";
    let rig = rig_text(16, sim, "[sim.vsync]\njitter_us = 0\n");
    let vsync = format!(
        "[vsync]\ndriver = \"triggerbox\"\nreopen_s = {reopen_s}\ntriggerbox = {{ port = {port:?}, link = \"usb\" }}"
    );
    Bench::new(&rig.replace("[vsync]\ndriver = \"sim\"", &vsync))
}

/// On a busy machine, a round trip over a pseudo-terminal determines the time to about a hundred microseconds.
fn plan(delays: usize, average: u32) -> String {
    format!(
        "kind = \"sweep\"\n[sweep]\ndelay_us = {{ start = -300, stop = 300, count = {delays} }}\nexposure_us = [500]\n\
         average = {average}\nmax_jitter_us = 180\n"
    )
}

#[test]
fn a_sweep_with_a_triggerbox_is_complete() {
    let pty = plug(WireFaults { seed: 2, garbage: 0.1, stalls: 0.002, stall_ms: 30 });
    let bench = bench(pty.path(), 60.0);
    let ended = bench.run(&plan(3, 4));
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let (_, state) = ended.open();
    let vsync = state.end.unwrap().vsync.unwrap();
    println!("{vsync:?}, {:?}", bench.runner.status().vsync_clock);
    assert!(vsync.edges > 12, "{vsync:?}");
}

/// Runs a sweep and unplugs the box when two points are stored; `meanwhile` may plug it in again.
fn run_unplugged(reopen_s: f64, meanwhile: impl FnOnce(&Path) -> Option<TriggerBoxPty>) -> (Ended, Counts) {
    let folder = tempfile::tempdir().unwrap();
    let port = folder.path().join("by-id");
    let mut pty = plug(WireFaults::default());
    symlink(pty.path(), &port).unwrap();
    let bench = bench(&port, reopen_s);
    let (mut events, mut told) = (bench.runner.events(), bench.runner.events());
    bench.runner.run(RunParams { plan: plan(8, 2), ..RunParams::default() }).unwrap();
    let stored = |event| matches!(event, Event::Progress(progress) if progress.points_stored >= 2);
    while !stored(next_event(&mut events)) {}
    pty.unplug();
    std::fs::remove_file(&port).unwrap();
    let _again = meanwhile(&port);
    let ended = end_of(&mut told);
    let counts = ended.open().1.counts;
    assert!(counts.balanced(), "{counts:?}");
    (ended, counts)
}

#[test]
fn a_watcher_may_be_away_for_longer_than_all_attempts_at_its_points_take() {
    let (ended, counts) = run_unplugged(60.0, |port| {
        std::thread::sleep(Duration::from_secs(8));
        let pty = plug(WireFaults::default());
        symlink(pty.path(), port).unwrap();
        Some(pty)
    });
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    println!("{counts:?}");
    assert!(counts.lost[&LossCause::EdgeMissing] > 0, "{counts:?}");
}

#[test]
fn a_watcher_that_stays_away_ends_the_run_and_what_was_stored_stays() {
    let (ended, counts) = run_unplugged(1.0, |_| None);
    assert_eq!(ended.state, "faulted");
    let error = ended.error.unwrap();
    assert!(error.contains("vsync") && error.contains("by-id"), "{error}");
    assert!(counts.averaged >= 4 && counts.lost[&LossCause::EdgeMissing] > 0, "{counts:?}");
}
