//! A whole sweep whose edges come from a real driver: a triggerbox on a pseudo-terminal makes the VSYNC of the simulated rig.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use raysweep::control::Control;
use raysweep_sim::mirror::{Link, WireFaults};
use raysweep_sim::triggerbox::TriggerBoxPty;
use raysweep_tests::{Bench, rig_text};

#[test]
fn a_sweep_with_a_triggerbox_is_complete() {
    let faults = WireFaults { seed: 2, garbage: 0.1, ..WireFaults::default() };
    let pty = TriggerBoxPty::plug(16_666_667, Link::VirtualCom, faults).unwrap();
    let sim = "realtime = true\nscene = \"slab\"\nscene_rows = 16\nscene_columns = 8";
    let rig = rig_text(16, sim, "[sim.vsync]\njitter_us = 0\n").replace(
        "[vsync]\ndriver = \"sim\"",
        &format!(
            "[vsync]\ndriver = \"triggerbox\"\ntriggerbox = {{ port = {:?}, link = \"usb\" }}",
            pty.path()
        ),
    );
    let bench = Bench::new(&rig);
    // A round trip over a pseudo-terminal of a busy machine tells the time to a hundred microseconds or so.
    let plan = "kind = \"sweep\"\n[sweep]\ndelay_us = [-300, 0, 300]\nexposure_us = [500]\naverage = 4\nmax_jitter_us = 180\n";
    let ended = bench.run(plan);
    assert_eq!(ended.state, "complete", "{:?}", ended.error);
    let (_, state) = ended.open();
    let vsync = state.end.unwrap().vsync.unwrap();
    println!("{vsync:?}, {:?}", bench.runner.status().vsync_clock);
    assert!(vsync.edges > 12, "{vsync:?}");
}
