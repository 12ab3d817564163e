//! The paper's sweep over a real network connection in real time: 75 points of 8 frames at 128 x 128 pixels and 60
//! edges per second, with each image compared with the scene. Measures the time from the first to the last frame with
//! light, and the losses. `cargo xtask bench camera --sweep` runs it.

#![allow(clippy::unwrap_used, reason = "a benchmark that cannot go on may panic")]

#[path = "../tests/wire/mod.rs"]
mod wire;

use wire::{Sweep, Swept, Then};

const SWEEP: Sweep = Sweep {
    side_px: 128,
    kind: "sweep",
    plan: "average = 8\ndelay_us = { start = -1500, stop = 1500, count = 15 }\n\
           exposure_us = { start = 600, stop = 1200, count = 5 }\n",
    camera: "",
    faults: &[],
    then: None,
};

fn main() {
    let mut arguments = std::env::args().skip(1).filter(|argument| argument != "--bench");
    let json = match arguments.next().as_deref() {
        None => false,
        Some("--json") => true,
        Some(unknown) => panic!("no option `{unknown}`: there is --json"),
    };
    let (late, varying) = ("late_frames_min = 3\nlate_frames_max = 3\n", "late_frames_max = 3\n");
    let cases = [
        ("settings act on the next frame", SWEEP),
        ("settings act 3 frames late", Sweep { camera: late, ..SWEEP }),
        ("settings act 0 to 3 frames late", Sweep { camera: varying, ..SWEEP }),
        ("1 % of packets lost", Sweep { faults: &["packet_loss=0.01"], ..SWEEP }),
        (
            "1 % of packets lost, none sent again",
            Sweep { faults: &["packet_loss=0.01", "resend=false"], ..SWEEP },
        ),
        ("the camera dies for 2 s", Sweep { then: Some((30, Then::Dies)), ..SWEEP }),
    ];
    for (case, sweep) in cases {
        let Swept { counts, wire, end } = sweep.run();
        let light_s = end.light_s.unwrap();
        let (lost, resent) = (counts.lost_total(), wire.packets_resent);
        if json {
            println!(
                "{{\"bench\":\"camera-sweep\",\"case\":\"{case}\",\"light_s\":{light_s:.3},\"frames_lost\":{lost},\
                 \"frames_settling\":{},\"packets_lost\":{},\"packets_resent\":{resent}}}",
                counts.settling, wire.packets_lost
            );
        } else {
            println!(
                "{case}: {light_s:.2} s from the first frame with light to the last, every image true; {lost} frames lost {:?}, \
                 {} settling, {} of {} packets lost, {resent} sent again; latency found: {:?}",
                counts.lost, counts.settling, wire.packets_lost, wire.packets, end.settings_latency
            );
        }
    }
}
