//! A viewfinder over the wire on a rig whose VSYNC never comes: without its trigger, the camera sends pictures.

#![allow(clippy::unwrap_used, clippy::expect_used, reason = "a test that cannot go on may panic")]

mod process;
mod wire_rig;

use std::process::{Command, Stdio};

use process::{Process, wait_for};
use raysweep_proto::{Client, Event, RunParams, ViewfinderValues};
use wire_rig::WireRig;

const RIG: &str = "kind = \"plane\"\n[camera]\ndriver = \"aravis\"\naravis.address = \"127.0.0.1\"\n[vsync]\ndriver = \"sim\"\n\
    [projector]\ndriver = \"sim\"\nrows = 64\nrow_time_us = 22.22\nfirst_row_us = 2200\n[sim]\nbench = \"bench.sock\"\n\
    scene = \"v-groove\"\nscene_rows = 64\nscene_columns = 64\n[sim.vsync]\nmissing = 1.0\n";

/// Reads the camera's features with an independent client.
fn camera_says(features: &[&str]) -> String {
    let arguments = [&["-a", "127.0.0.1", "control"], features].concat();
    let output = Command::new("arv-tool-0.8").args(arguments).output().expect("aravis-tools is installed");
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// The first that a viewfinder with this plan says for which this holds, and how the camera is set meanwhile.
fn view(rig: &WireRig, plan: &str, holds: fn(&ViewfinderValues) -> bool) -> (ViewfinderValues, String) {
    let mut client = Client::connect(rig.path("socket")).unwrap();
    let events = Client::connect(rig.path("socket")).unwrap().subscribe().unwrap();
    let plan =
        format!("kind = \"viewfinder\"\n[viewfinder]\nsubject = \"board\"\npictures_per_s = 20\n{plan}");
    client.run(&RunParams { plan, ..RunParams::default() }).unwrap();
    let mut found = None;
    for event in events {
        match event.unwrap() {
            Event::Viewfinder(values) if found.is_none() && holds(&values) => {
                found = Some((*values, camera_says(&["TriggerMode", "AcquisitionFrameRate"])));
                client.cancel().unwrap();
            }
            Event::Finished { state, error, .. } => {
                assert_eq!((state.as_str(), error), ("complete", None));
                break;
            }
            _ => {}
        }
    }
    found.unwrap()
}

#[test]
fn a_camera_whose_trigger_is_not_wired_is_focused_all_the_same() {
    let rig = WireRig::start(RIG, &[], 9000);
    let mut command = Command::new(env!("CARGO_BIN_EXE_raysweepd"));
    command.arg("--rig").arg(rig.path("rig.toml")).arg("--socket").arg(rig.path("socket"));
    let _daemon = Process::start(command.arg("--data").arg(rig.path("data")).stderr(Stdio::null()));
    wait_for("the daemon does not listen", || Client::connect(rig.path("socket")).ok());

    // Before and after runs by the trigger.
    for _ in 0..2 {
        let (values, camera) = view(&rig, "trigger = \"none\"\n", |values| values.pictures == 3);
        assert!((values.mean_dn / 2564.0 - 1.0).abs() < 0.02 && values.problem.is_none(), "{values:?}");
        assert!(
            camera.contains("TriggerMode = Off") && camera.contains("AcquisitionFrameRate = 20"),
            "{camera}"
        );
        let (values, camera) = view(&rig, "", |values| values.problem.is_some());
        let problem = values.problem.unwrap();
        assert!(values.pictures == 0 && problem.contains("viewfinder --trigger none"), "{problem}");
        assert!(camera.contains("TriggerMode = On"), "{camera}");
    }
}
