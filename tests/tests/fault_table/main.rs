//! Faults, what happens then, and what happens to the data: `docs/reliability.md` is made from this table. Each row
//! names the test that holds it.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod dots;
mod table;

use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::Duration;

use raysweep::Probes;
use raysweep::rig::Devices;
use raysweep_core::{
    Applied, Camera, CameraCapabilities, CameraSettings, DeviceError, DeviceErrorKind, DeviceState, Edge,
    FrameBuf, FrameStamp, Pattern, Projector, SettingsId, Shown, Vsync,
};
use raysweep_session::stack::ArrayName;
use raysweep_tests::{Bench, Ended, rig_text};
use table::TABLE;

/// The least number of rows.
const ROWS: usize = 60;

fn root() -> &'static Path {
    Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/.."))
}

/// The page of the documentation.
fn page() -> String {
    let mut page = include_str!("head.md").to_owned();
    for (class, rows) in TABLE {
        writeln!(
            page,
            "\n## {class}\n\n| fault | what happens | the data | test |\n| --- | --- | --- | --- |"
        )
        .unwrap();
        for row in *rows {
            let [fault, outcome, data, file, test] = row;
            writeln!(page, "| {fault} | {outcome} | {data} | [`{test}`](../{file}) |").unwrap();
        }
    }
    page
}

#[test]
fn the_page_is_made_from_the_table() {
    let path = root().join("docs/reliability.md");
    if std::env::var("INSTA_UPDATE").is_ok_and(|update| update == "always") {
        fs::write(&path, page()).unwrap();
    }
    let found = fs::read_to_string(path).unwrap();
    assert!(found == page(), "docs/reliability.md is not the table: INSTA_UPDATE=always writes it anew");
}

#[test]
fn every_row_is_held_by_a_test() {
    let rows = TABLE.iter().flat_map(|(_, rows)| *rows);
    let mut count = 0;
    for [fault, _, _, file, test] in rows {
        let text =
            fs::read_to_string(root().join(file)).unwrap_or_else(|error| panic!("{fault}: {file}: {error}"));
        let (before, _) = text
            .split_once(&format!("fn {test}()"))
            .unwrap_or_else(|| panic!("{fault}: there is no `{test}` in {file}"));
        let attributes: Vec<&str> =
            before.trim_end().lines().rev().map(str::trim).take_while(|line| line.starts_with('#')).collect();
        // The kernel guest runs those that are left out elsewhere.
        let is_left_out = |line: &&str| line.contains("ignore") && !line.contains("cargo xtask guest");
        let is_run = attributes.contains(&"#[test]") && !attributes.iter().any(is_left_out);
        assert!(is_run, "{fault}: `{test}` in {file} is no test that is run: {attributes:?}");
        count += 1;
    }
    assert!(count >= ROWS, "{count} rows");
}

/// A rig without faults of its own, whose frames say nothing but their times.
const PLAN: &str =
    "kind = \"sweep\"\n[sweep]\naverage = 2\ndelay_us = [-60, 0, 60]\nexposure_us = [50, 100]\n";

fn rig() -> String {
    rig_text(8, "scene = \"v-groove\"\nscene_rows = 8\nscene_columns = 8\nseed = 11", "")
}

/// What goes wrong with a device, from some call on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Fault {
    CameraPanics,
    CameraIsGone,
    CameraRefusesSettings,
    CameraClockIsFrozen,
    CameraClockJumps,
    CameraSaysWrongExposures,
    WatcherPanics,
    WatcherIsGone,
    WatcherClockIsFrozen,
    ProjectorPanics,
    ProjectorIsGone,
}

/// A device with a fault that begins after so many calls.
struct Faulty<D> {
    device: D,
    fault: Fault,
    calls_left: Arc<AtomicU32>,
}

impl<D> Faulty<D> {
    /// Counts a call; returns whether the fault has begun.
    fn has_begun(&self) -> bool {
        let left = self.calls_left.load(Ordering::Relaxed);
        self.calls_left.store(left.saturating_sub(1), Ordering::Relaxed);
        left == 0
    }
}

fn gone(device: &'static str) -> DeviceError {
    DeviceError::new(device, DeviceErrorKind::Disconnected, "somebody has pulled the plug")
}

impl Camera for Faulty<Box<dyn Camera>> {
    fn capabilities(&self) -> &CameraCapabilities {
        self.device.capabilities()
    }

    fn state(&self) -> DeviceState {
        self.device.state()
    }

    fn configure(&mut self, id: SettingsId, settings: &CameraSettings) -> Result<Applied, DeviceError> {
        if self.fault == Fault::CameraRefusesSettings && self.has_begun() {
            return Err(DeviceError::new("camera", DeviceErrorKind::OutOfRange, "no such exposure"));
        }
        self.device.configure(id, settings)
    }

    fn arm(&mut self) -> Result<(), DeviceError> {
        self.device.arm()
    }

    fn next_frame(
        &mut self,
        buf: &mut FrameBuf,
        timeout: Duration,
    ) -> Result<Option<FrameStamp>, DeviceError> {
        let Some(stamp) = self.device.next_frame(buf, timeout)? else { return Ok(None) };
        if !self.has_begun() {
            return Ok(Some(stamp));
        }
        let stamp = match self.fault {
            Fault::CameraPanics => panic!("as planned"),
            Fault::CameraIsGone => return Err(gone("camera")),
            Fault::CameraClockIsFrozen => FrameStamp { device_ns: 0, exposure_start_ns: 0, ..stamp },
            Fault::CameraClockJumps => {
                FrameStamp { exposure_start_ns: stamp.exposure_start_ns + 3_600_000_000_000, ..stamp }
            }
            Fault::CameraSaysWrongExposures => FrameStamp { exposure_us: Some(77.0), ..stamp },
            _ => stamp,
        };
        Ok(Some(stamp))
    }

    fn disarm(&mut self) -> Result<(), DeviceError> {
        self.device.disarm()
    }
}

impl Vsync for Faulty<Box<dyn Vsync>> {
    fn next_edge(&mut self, timeout: Duration) -> Result<Option<Edge>, DeviceError> {
        let Some(edge) = self.device.next_edge(timeout)? else { return Ok(None) };
        if !self.has_begun() {
            return Ok(Some(edge));
        }
        match self.fault {
            Fault::WatcherPanics => panic!("as planned"),
            Fault::WatcherIsGone => Err(gone("vsync")),
            _ => Ok(Some(Edge { host_ns: 0, ..edge })),
        }
    }
}

impl Projector for Faulty<Box<dyn Projector>> {
    fn show(&mut self, _: &Pattern) -> Result<Shown, DeviceError> {
        match self.fault {
            Fault::ProjectorPanics => panic!("as planned"),
            _ => Err(gone("projector")),
        }
    }

    fn blank(&mut self) -> Result<Shown, DeviceError> {
        self.device.blank()
    }
}

/// Devices one of which has a fault after so many calls.
fn with_fault(mut devices: Devices, fault: Fault, calls: u32) -> Devices {
    let calls_left = Arc::new(AtomicU32::new(calls));
    match fault {
        Fault::CameraPanics
        | Fault::CameraIsGone
        | Fault::CameraRefusesSettings
        | Fault::CameraClockIsFrozen
        | Fault::CameraClockJumps
        | Fault::CameraSaysWrongExposures => {
            devices.camera = Box::new(Faulty { device: devices.camera, fault, calls_left });
        }
        Fault::WatcherPanics | Fault::WatcherIsGone | Fault::WatcherClockIsFrozen => {
            devices.vsync = Box::new(Faulty { device: devices.vsync, fault, calls_left });
        }
        Fault::ProjectorPanics | Fault::ProjectorIsGone => {
            devices.projector = Box::new(Faulty { device: devices.projector, fault, calls_left });
        }
    }
    devices
}

/// The attempt and the checksum of each image of a session.
fn images(ended: &Ended) -> BTreeMap<(ArrayName, usize), (u32, u32)> {
    let (_, state) = ended.open();
    let arrays = [ArrayName::Sum, ArrayName::Dark, ArrayName::Regular];
    let stored = arrays.into_iter().flat_map(|array| state.stored(array).cloned().collect::<Vec<_>>());
    stored.map(|point| ((point.array, point.index), (point.attempt, point.crc32))).collect()
}

/// A run with this fault is faulted, says so, and keeps what it has; on sound devices it then ends with the bits of a
/// run without any fault. Only an image whose attempt has failed is one of other frames.
fn faults_and_resumes(fault: Fault, calls: u32, says: &str) {
    let mut bench = Bench::new(&rig());
    let expected = images(&bench.run(PLAN));
    bench.restart_with(Probes {
        devices: Some(Arc::new(move |devices| with_fault(devices, fault, calls))),
        ..Probes::default()
    });
    let ended = bench.run(PLAN);
    assert_eq!(ended.state, "faulted", "{fault:?}");
    let error = ended.error.clone().unwrap();
    println!("{fault:?}: {error}");
    assert!(error.contains(says), "{fault:?}: {error}");
    let (_, state) = ended.open();
    assert_eq!(state.end.unwrap().error, Some(error), "{fault:?}: the end is in the ledger");
    let kept = images(&ended);
    assert!(kept.len() < expected.len(), "{fault:?}: {kept:?}");
    bench.restart_with(Probes::default());
    let resumed = bench.resume(&ended.session);
    assert_eq!(resumed.state, "complete", "{fault:?}: {:?}", resumed.error);
    let images = images(&resumed);
    assert!(images.keys().eq(expected.keys()), "{fault:?}: {images:?}");
    assert!(kept.iter().all(|(place, kept)| images[place] == *kept), "{fault:?}: {kept:?}, then {images:?}");
    for (place, image) in images.iter().filter(|(place, image)| image.0 == expected[place].0) {
        assert_eq!(*image, expected[place], "{fault:?}: {place:?}");
    }
}

/// Calls after which some images are stored, and others are not.
const MIDWAY: u32 = 45;

#[test]
fn a_camera_that_is_gone_ends_the_run() {
    faults_and_resumes(Fault::CameraIsGone, MIDWAY, "pulled the plug");
}

#[test]
fn a_camera_that_refuses_settings_ends_the_run() {
    faults_and_resumes(Fault::CameraRefusesSettings, 8, "no such exposure");
}

#[test]
fn a_camera_whose_clock_is_frozen_stores_nothing_more() {
    faults_and_resumes(Fault::CameraClockIsFrozen, MIDWAY, "its clock stands still");
}

#[test]
fn a_camera_whose_clock_jumps_stores_nothing_more() {
    faults_and_resumes(Fault::CameraClockJumps, MIDWAY, "lost (edge missing)");
}

#[test]
fn a_camera_that_says_wrong_exposures_stores_nothing_more() {
    faults_and_resumes(Fault::CameraSaysWrongExposures, MIDWAY, "lost (settings mismatch)");
}

#[test]
fn a_watcher_that_is_gone_ends_the_run() {
    faults_and_resumes(Fault::WatcherIsGone, MIDWAY, "pulled the plug");
}

#[test]
fn a_watcher_whose_clock_is_frozen_stores_nothing_more() {
    faults_and_resumes(Fault::WatcherClockIsFrozen, MIDWAY, "lost (edge missing)");
}

#[test]
fn a_projector_that_is_gone_ends_the_run() {
    faults_and_resumes(Fault::ProjectorIsGone, 0, "pulled the plug");
}

#[test]
fn a_panic_of_the_camera_s_thread_ends_the_run() {
    faults_and_resumes(Fault::CameraPanics, MIDWAY, "panicked");
}

#[test]
fn a_panic_of_the_watcher_s_thread_ends_the_run() {
    faults_and_resumes(Fault::WatcherPanics, MIDWAY, "panicked");
}

#[test]
fn a_panic_of_the_run_s_thread_ends_the_run() {
    faults_and_resumes(Fault::ProjectorPanics, 0, "panicked");
}

/// Wall-clock times may only be labels, since the wall clock can be set at any moment.
#[test]
fn nothing_is_measured_with_the_wall_clock() {
    let labels = [
        // When a remark on a session was made.
        "daemon/src/cli/mod.rs",
        // The age of a calibration.
        "daemon/src/procedure/lab.rs",
        // When a session was created, and when a run began.
        "daemon/src/run/life.rs",
        "daemon/src/runner.rs",
        // Edges that the kernel stamps with it are converted at once by the offset of that moment.
        "drivers/src/vsync/pps.rs",
    ];
    let mut found = Vec::new();
    let mut folders: Vec<_> =
        ["crates", "daemon/src", "drivers/src", "sim/src"].map(|folder| root().join(folder)).into();
    while let Some(folder) = folders.pop() {
        for path in fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()) {
            let name = path.strip_prefix(root()).unwrap().display().to_string();
            if path.is_dir() {
                folders.extend((!name.ends_with("xtask") && !name.ends_with("tests")).then_some(path));
            } else if name.ends_with(".rs") {
                let text = fs::read_to_string(&path).unwrap();
                let reads = ["SystemTime::now", "Timestamp::now", "Zoned::now", "(ClockId::CLOCK_REALTIME"];
                found.extend(reads.iter().any(|read| text.contains(read)).then_some(name));
            }
        }
    }
    found.sort();
    assert_eq!(found, labels);
}
