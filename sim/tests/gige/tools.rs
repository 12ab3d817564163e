//! Independent clients, from the package aravis-tools: what they find, set and receive.

use std::process::Command;

use raysweep_sim::gige::{Faults, GigeCamera, GigeSetup, Look};

use super::{rig, setup};

/// Returns a tool's standard output and standard error.
fn run(tool: &str, arguments: &[&str]) -> String {
    let output = Command::new(tool).args(arguments).output();
    let output =
        output.unwrap_or_else(|error| panic!("{tool}: {error}; tests/packages.txt names its package"));
    String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned()
}

fn arv_tool(camera: &GigeSetup, arguments: &[&str]) -> String {
    run("arv-tool-0.8", &[&["-a", &camera.address.to_string()], arguments].concat())
}

/// Reads a number from arv-camera-test's summary.
fn figure(report: &str, name: &str) -> u64 {
    let line =
        report.lines().find(|line| line.starts_with(name)).unwrap_or_else(|| panic!("{name}: {report}"));
    line.split('=').nth(1).unwrap().trim().parse().unwrap()
}

#[test]
fn arv_tool_reads_and_writes_features() {
    for zipped in [false, true] {
        let wire = rig(|_| {}).open_for_wire();
        let setup = GigeSetup { zipped, ..setup(Faults::default()) };
        let _camera = GigeCamera::start(&setup, wire.camera).unwrap();
        let set = arv_tool(
            &setup,
            &[
                "control",
                "ExposureTime=765.25",
                "TriggerDelay=1234.5",
                "TriggerSelector=FrameStart",
                "TriggerSource=Software",
                "TriggerMode=On",
                "SensorShutterMode=Global",
                "PixelFormat=Mono12p",
                "Width=12",
                "ChunkSelector=Timestamp",
                "ChunkEnable=true",
                "DeviceUserID=left",
            ],
        );
        assert!(!set.to_lowercase().contains("error"), "{set}");
        let got = arv_tool(
            &setup,
            &[
                "control",
                "ExposureTime",
                "TriggerDelay",
                "TriggerSource",
                "TriggerMode",
                "SensorShutterMode",
                "PixelFormat",
                "Width",
                "PayloadSize",
                "DeviceUserID",
                "DeviceModelName",
                "ChunkEnable",
            ],
        );
        for line in [
            "ExposureTime = 765.25 us",
            "TriggerDelay = 1234.5 us",
            "TriggerSource = Software",
            "TriggerMode = On",
            "SensorShutterMode = Global",
            "PixelFormat = Mono12p",
            "Width = 12 min:1 max:20",
            "PayloadSize = 432",
            "DeviceUserID = left",
            "DeviceModelName = raysweep simulated camera",
            "ChunkEnable = true",
        ] {
            assert!(got.contains(line), "{line}: {got}");
        }
        let set = arv_tool(
            &setup,
            &[
                "control",
                "SequencerConfigurationMode=On",
                "SequencerFeatureSelector=TriggerDelay",
                "SequencerFeatureEnable=true",
                "SequencerSetSelector=3",
                "TriggerDelay=800",
                "SequencerPathSelector=0",
                "SequencerSetNext=4",
                "SequencerTriggerSource=FrameStart",
                "SequencerSetSave",
                "SequencerSetStart=3",
                "SequencerConfigurationMode=Off",
                "SequencerMode=On",
            ],
        );
        assert!(!set.to_lowercase().contains("error"), "{set}");
        let got = arv_tool(&setup, &["control", "SequencerMode", "SequencerSetNext", "SequencerSetStart"]);
        for line in ["SequencerMode = On", "SequencerSetNext = 4", "SequencerSetStart = 3"] {
            assert!(got.contains(line), "{line}: {got}");
        }
        let refused = arv_tool(&setup, &["control", "PixelFormat=Mono9", "PixelFormat"]);
        assert!(refused.contains("PixelFormat = Mono12p"), "{refused}");
        // Every feature can be read: registers and description agree.
        let values = arv_tool(&setup, &["values"]);
        assert!(!values.to_lowercase().contains("error"), "{values}");
        let features = arv_tool(&setup, &["features"]);
        assert!(!features.contains("not found"), "{features}");
    }
}

#[test]
fn arv_camera_test_streams_without_loss() {
    let wire = rig(|_| {}).open_for_wire();
    let setup = setup(Faults::default());
    let camera = GigeCamera::start(&setup, wire.camera).unwrap();
    let name = setup.address.to_string();
    let features = "TriggerMode=On TriggerSource=Line0 TriggerDelay=500 PixelFormat=Mono12p";
    let report = run(
        "arv-camera-test-0.8",
        &["-n", &name, "--duration", "2", "--features", features, "-u", "ExposureTime,Timestamp"],
    );
    let completed = figure(&report, "n_completed_buffers");
    assert!(completed > 0, "{report}");
    for name in ["n_failures", "n_missing_frames", "n_missing_packets", "n_error_packets"] {
        assert_eq!(figure(&report, name), 0, "{name}: {report}");
    }
    // On a busy machine the tool is late with its buffers and skips packets, which it does not count as frames; what it
    // has of a frame is then too short. Frames in transit when it stops are not counted at all.
    let (mismatches, ignored) =
        (figure(&report, "n_size_mismatch_errors"), figure(&report, "n_ignored_packets"));
    assert!(mismatches == 0 || ignored > 0, "{report}");
    let truth = camera.truth();
    assert!(completed <= truth.frames, "{truth:?} {report}");
    assert!(figure(&report, "n_received_packets") * 2 > truth.packets, "{truth:?} {report}");
    assert!(report.contains("ChunkExposureTime = 1000"), "{report}");
}

#[test]
fn arv_camera_test_gets_lost_packets_back() {
    let faults = Faults { packet_loss: 0.01, ..Faults::default() };
    let setup = setup(faults);
    let camera = GigeCamera::start(&setup, Look::at_test_pictures((512, 512))).unwrap();
    let name = setup.address.to_string();
    // Few frames with a long retention time: a busy machine requests packets late.
    let report = run(
        "arv-camera-test-0.8",
        &["-n", &name, "--duration", "2", "--features", "AcquisitionFrameRate=20", "-m", "5000"],
    );
    let truth = camera.truth();
    assert!(truth.packets_lost > 0, "{truth:?}");
    assert!(figure(&report, "n_resent_packets") > 0, "{report}");
    assert_eq!(figure(&report, "n_failures"), 0, "{report}");
    assert_eq!(figure(&report, "n_missing_packets"), 0, "{report}");
    // Late with its buffers, the tool skips frames, but takes their packets.
    assert!(figure(&report, "n_completed_buffers") > 0, "{report}");
    assert!(figure(&report, "n_received_packets") * 2 > truth.packets, "{truth:?} {report}");
}

/// Discovery is a broadcast, to which cameras of other tests would respond.
#[test]
fn arv_tool_discovers_cameras_by_broadcast() {
    let itself = std::env::current_exe().unwrap();
    let arguments = ["--map-root-user", "--net", "--", itself.to_str().unwrap()];
    let report = run(
        "unshare",
        &[&arguments[..], &["--exact", "tools::in_a_network_of_its_own", "--ignored", "--nocapture"]]
            .concat(),
    );
    assert!(report.contains("1 passed"), "{report}");
}

#[test]
#[ignore = "arv_tool_discovers_cameras_by_broadcast runs it in a network namespace"]
fn in_a_network_of_its_own() {
    run("ip", &["link", "set", "lo", "up"]);
    let setups = [0; 2].map(|_| setup(Faults::default()));
    let start = |setup| GigeCamera::start(setup, Look::at_test_pictures((8, 8))).unwrap();
    let _cameras = setups.each_ref().map(start);
    let found = run("arv-tool-0.8", &[]);
    for GigeSetup { serial, address, .. } in &setups {
        assert!(found.contains(&format!("{serial} ({address})")), "{found}");
    }
    let serial = &setups[1].serial;
    let opened = run("arv-tool-0.8", &["-n", &format!("raysweep-{serial}"), "control", "DeviceSerialNumber"]);
    assert!(opened.contains(&format!("DeviceSerialNumber = {serial}")), "{opened}");
}
