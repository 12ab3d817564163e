//! Requirements on every driver of a device trait, checked on the simulated rig, on simulated devices with their real
//! protocols, and, with `RAYSWEEP_HIL=rig.toml`, on a lab's hardware. On a plane rig, the camera must be triggered and
//! the projector may light up. On a dot rig, the mirror moves by a quarter of its range with the light off. A projector
//! worked by an operator (`driver = "external"`) is operated through prompts on the terminal.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

#[path = "../../drivers/tests/suite/mirror.rs"]
mod suite;

use std::fs::File;
use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::Path;
use std::sync::mpsc::Receiver;
use std::thread;
use std::time::{Duration, Instant};

use raysweep::rig::{AnyRig, Devices, DotRig, Rig};
use raysweep_core::{
    Camera, CameraSettings, Clock, DeviceErrorKind, DeviceState, FramePool, Pattern, Projector, SettingsId,
    Shutter, Vsync,
};
use raysweep_drivers::projector::external::ShowRequest;
use raysweep_sim::mirror::{MirrorPty, PlayzerXController, PlayzerXControllerConfig, SerialLink, WireFaults};
use raysweep_sim::triggerbox::TriggerBoxPty;
use raysweep_tests::{HUNG, rig_text};

/// Edges are numbered and stamped in order, no stamp is in the future, and the median interval is the period.
fn vsync_conforms(vsync: &mut dyn Vsync, clock: &Clock, period_us: f64) {
    let began = Instant::now();
    let mut edges = Vec::new();
    while edges.len() < 60 {
        assert!(began.elapsed() < HUNG, "{} edges: is there a VSYNC on the line?", edges.len());
        let edge = vsync.next_edge(Duration::from_millis(100)).unwrap();
        assert!(edge.is_none_or(|edge| edge.host_ns <= clock.now_ns()), "{edge:?} is of the future");
        edges.extend(edge);
    }
    let in_order = edges.is_sorted_by(|a, b| a.seq < b.seq && a.host_ns < b.host_ns);
    assert!(in_order, "{edges:?}");
    let period = |pair: &[raysweep_core::Edge]| {
        (pair[1].host_ns - pair[0].host_ns) as f64 / 1e3 / (pair[1].seq - pair[0].seq) as f64
    };
    let mut periods_us: Vec<f64> = edges.windows(2).map(period).collect();
    periods_us.sort_by(f64::total_cmp);
    let median_us = periods_us[periods_us.len() / 2];
    assert!((median_us / period_us - 1.0).abs() < 0.02, "a period of {median_us} us, not {period_us}");
    vsync.next_edge(Duration::ZERO).unwrap();
    if let Some(clock) = vsync.clock() {
        assert!(
            clock.residual_us.is_finite() && clock.rate_ppm.abs() < 1000.0 && clock.round_trips > 0,
            "{clock:?}"
        );
    }
}

/// Settings are applied completely or rejected, frames are numbered and stamped in order, and disarming is idempotent.
fn camera_conforms(camera: &mut dyn Camera) {
    let capabilities = camera.capabilities().clone();
    let bytes = capabilities.format.frame_bytes(capabilities.width * capabilities.height);
    let pool = FramePool::new(2, bytes);
    let error = camera.next_frame(&mut pool.take(), Duration::ZERO).unwrap_err();
    assert_eq!(error.kind, DeviceErrorKind::NotReady, "{error}");
    assert_eq!(camera.state(), DeviceState::Ready);

    let id = SettingsId { point: 0, attempt: 0 };
    let exposure_us = 500.0_f64.clamp(*capabilities.exposure_us.start(), *capabilities.exposure_us.end());
    let settings = CameraSettings {
        shutter: Shutter::Rolling,
        exposure_us,
        trigger_delay_us: *capabilities.trigger_delay_us.start(),
    };
    let impossible = CameraSettings { exposure_us: capabilities.exposure_us.end() * 10.0 + 1.0, ..settings };
    let error = camera.configure(id, &impossible).unwrap_err();
    assert_eq!(error.kind, DeviceErrorKind::OutOfRange, "{error}");

    let applied = camera.configure(id, &settings).unwrap();
    assert!(capabilities.allows(&applied.actual).is_ok(), "{applied:?}");
    assert!(applied.first_frame.earliest() <= applied.first_frame.certain());
    camera.arm().unwrap();
    assert_eq!(camera.state(), DeviceState::Streaming);
    let began = Instant::now();
    let mut stamps = Vec::new();
    while stamps.len() < 8 {
        assert!(began.elapsed() < HUNG, "{} frames: is the camera triggered?", stamps.len());
        stamps.extend(camera.next_frame(&mut pool.take(), Duration::from_millis(200)).unwrap());
        if stamps.len() == 4 {
            camera.configure(SettingsId { point: 1, attempt: 0 }, &settings).unwrap();
        }
    }
    let in_order = |a: &raysweep_core::FrameStamp, b: &raysweep_core::FrameStamp| {
        a.seq < b.seq && a.exposure_start_ns < b.exposure_start_ns
    };
    assert!(stamps.is_sorted_by(in_order), "{stamps:?}");
    assert!(stamps.iter().all(|stamp| stamp.exposure_start_ns < stamp.host_ns), "{stamps:?}");
    camera.disarm().unwrap();
    camera.disarm().unwrap();
    assert_eq!(camera.state(), DeviceState::Ready);
}

/// Reported times of certainty are not before the request; blanking is idempotent.
fn projector_conforms(projector: &mut dyn Projector, clock: &Clock) {
    let asked_ns = clock.now_ns();
    assert!(projector.show(&Pattern::White).unwrap().not_before_ns >= asked_ns);
    let dark = projector.blank().unwrap();
    assert!(projector.blank().unwrap().not_before_ns >= dark.not_before_ns);
}

/// Terminal on which an operator is prompted and answers with a line.
struct Terminal {
    say: Box<dyn Write + Send>,
    hear: Box<dyn BufRead + Send>,
}

/// Forwards a projector's questions to the operator until the projector is dropped.
fn ask(questions: Receiver<ShowRequest>, terminal: &mut Terminal) {
    for question in questions {
        writeln!(terminal.say, "projector: show {:?}, then press Enter", question.wanted).unwrap();
        match terminal.hear.read_line(&mut String::new()) {
            Ok(1..) => question.done(),
            answer => question.refuse(format!("no answer: {answer:?}")),
        }
    }
}

/// Checks a rig without an operator.
fn rig_conforms(path: &Path) {
    rig_conforms_with(path, None);
}

fn rig_conforms_with(path: &Path, terminal: Option<Terminal>) {
    match AnyRig::load(path).unwrap() {
        AnyRig::Plane(rig) => plane_rig_conforms(&rig, terminal),
        AnyRig::Dots(rig) => mirror_conforms(&rig),
    }
}

/// Checks the mirror of a dot rig, with a data folder in which the light has not been armed.
fn mirror_conforms(rig: &DotRig) {
    let data = tempfile::tempdir().unwrap();
    let mirror = rig.open_mirror(data.path()).unwrap();
    let mut mirror = mirror.expect("[mirror] names the driver of a mirror that is there, not \"sim\"");
    suite::mirror_conforms(&mut *mirror, 5_000.0);
}

fn plane_rig_conforms(rig: &Rig, terminal: Option<Terminal>) {
    let Devices { mut camera, mut vsync, mut projector, questions, clock, .. } = rig.open().unwrap();
    vsync_conforms(&mut *vsync, &clock, rig.file.vsync.period_us);
    match (questions, terminal) {
        (None, _) => projector_conforms(&mut *projector, &clock),
        (Some(questions), Some(mut terminal)) => thread::scope(|scope| {
            scope.spawn(|| ask(questions, &mut terminal));
            projector_conforms(&mut *projector, &clock);
            drop(projector);
        }),
        (Some(_), None) => {
            // Not with `println!`, whose output is captured when a test passes.
            let words = "projector: SKIPPED: an operator works it (driver = \"external\"), and there is no terminal to ask on\n";
            std::io::stderr().write_all(words.as_bytes()).unwrap();
        }
    }
    // During a run, the monitor has its own thread: virtual time does not advance without it.
    drop(vsync);
    camera_conforms(&mut *camera);
}

fn rig_file(vsync: &str, sim: &str) -> (tempfile::TempDir, std::path::PathBuf) {
    let sim = format!("{sim}\nscene = \"slab\"\nscene_rows = 16\nscene_columns = 8");
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("rig.toml");
    let text = rig_text(16, &sim, "").replace("[vsync]\ndriver = \"sim\"", &format!("[vsync]\n{vsync}"));
    std::fs::write(&path, text).unwrap();
    (folder, path)
}

#[test]
fn the_simulated_rig_in_the_host_s_time() {
    let (_folder, path) = rig_file("driver = \"sim\"", "realtime = true");
    rig_conforms(&path);
}

#[test]
fn a_projector_that_an_operator_works() {
    let (_folder, path) = rig_file("driver = \"sim\"", "realtime = true");
    let text = std::fs::read_to_string(&path).unwrap();
    let external = text.replace("[projector]\ndriver = \"sim\"", "[projector]\ndriver = \"external\"");
    assert_ne!(text, external);
    std::fs::write(&path, external).unwrap();
    let (terminal, mut operator) = UnixStream::pair().unwrap();
    let hear = Box::new(BufReader::new(terminal.try_clone().unwrap()));
    operator.write_all(b"\n\n").unwrap();
    rig_conforms_with(&path, Some(Terminal { say: Box::new(terminal), hear }));
    let asked: Vec<String> = BufReader::new(operator).lines().map(Result::unwrap).collect();
    assert_eq!(asked.len(), 2, "{asked:?}");
    assert!(asked[0].contains("White") && asked[1].contains("Dark"), "{asked:?}");
    // Without an operator the projector is skipped, but not the rest of the rig.
    rig_conforms(&path);
}

#[test]
fn a_triggerbox_on_its_wire() {
    let pty = TriggerBoxPty::plug(16_666_667, SerialLink::VirtualCom, WireFaults::default()).unwrap();
    let vsync =
        format!("driver = \"triggerbox\"\ntriggerbox = {{ port = {:?}, link = \"usb\" }}", pty.path());
    let (_folder, path) = rig_file(&vsync, "realtime = true");
    rig_conforms(&path);
}

#[test]
fn a_mirror_by_its_rig_file() {
    let controller = PlayzerXController::new(PlayzerXControllerConfig::default());
    let pty = MirrorPty::plug(controller, SerialLink::VirtualCom, WireFaults::default()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("rig.toml");
    let mirror = format!("[mirror]\ndriver = \"playzerx\"\nport = {:?}\n", pty.path());
    std::fs::write(&path, format!("kind = \"dots\"\n[camera]\ndriver = \"sim\"\n{mirror}")).unwrap();
    rig_conforms(&path);
    let truth = pty.truth();
    assert!(truth.parked_since_ns.is_some() && truth.held.len() > 1000);
    assert!(truth.held.iter().all(|held| held.light == 0));
}

#[test]
#[ignore = "needs hardware: RAYSWEEP_HIL=rig.toml cargo test -p raysweep-tests --test conformance -- --ignored"]
fn the_hardware_of_a_lab() {
    let path = std::env::var_os("RAYSWEEP_HIL").expect("RAYSWEEP_HIL names the lab's rig file");
    // Not the standard streams, which the test harness captures.
    let terminal = File::options().read(true).write(true).open("/dev/tty").ok();
    let terminal = terminal.map(|terminal| {
        let hear = Box::new(BufReader::new(terminal.try_clone().unwrap()));
        Terminal { say: Box::new(terminal), hear }
    });
    rig_conforms_with(Path::new(&path), terminal);
}
