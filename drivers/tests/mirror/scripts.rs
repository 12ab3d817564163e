//! The drivers with scripts: both sides follow the makers' documents byte for byte, without a simulator.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use raysweep_core::{DeviceErrorKind, Mirror, MirrorPath, Tilt};
use raysweep_drivers::mirror::{self, LightGuard, Mti, Optotune, OptotuneConfig, PlayzerX};
use raysweep_sim::mirror::{Pty, SerialLink, WireFaults};
use tempfile::TempDir;

use crate::points::{Lamp, mti_config};
use crate::rig::LIMITS;

/// A port that answers every message according to rules.
pub struct Script {
    pub pty: Pty,
    heard: Arc<Mutex<Vec<u8>>>,
    folder: TempDir,
}

type Answers = &'static [(&'static [u8], &'static [u8])];

impl Script {
    /// Every message that begins with one of these prefixes gets the answer next to it. `message` returns the length
    /// of the message at the start of the bytes, if it is complete.
    fn new(answers: Answers, message: fn(&[u8]) -> Option<usize>) -> Self {
        Self::with(message, move |message, _| {
            let answer = answers.iter().find(|(begins, _)| message.starts_with(begins));
            answer.map(|(_, answer)| answer.to_vec()).unwrap_or_default()
        })
    }

    /// Every message gets the answer that `answer` returns at that time.
    pub fn with(
        message: fn(&[u8]) -> Option<usize>,
        answer: impl FnMut(&[u8], i64) -> Vec<u8> + Send + 'static,
    ) -> Self {
        Self::on_wire(WireFaults::default(), message, answer)
    }

    /// The same, on a wire with faults.
    pub fn on_wire(
        faults: WireFaults,
        message: fn(&[u8]) -> Option<usize>,
        mut answer: impl FnMut(&[u8], i64) -> Vec<u8> + Send + 'static,
    ) -> Self {
        let heard = Arc::new(Mutex::new(Vec::new()));
        let record = heard.clone();
        let mut waiting = Vec::new();
        let run = move |bytes: &[u8], now_ns: i64, replies: &mut Vec<u8>| {
            record.lock().unwrap().extend_from_slice(bytes);
            waiting.extend_from_slice(bytes);
            while let Some(length) = message(&waiting) {
                let message: Vec<u8> = waiting.drain(..length).collect();
                replies.extend(answer(&message, now_ns));
            }
        };
        let pty = Pty::plug(Box::new(run), SerialLink::VirtualCom, faults).unwrap();
        Self { pty, heard, folder: tempfile::tempdir().unwrap() }
    }

    pub fn light(&self) -> LightGuard {
        LightGuard { armed_file: self.folder.path().join("nobody"), interlock: None }
    }

    pub fn state(&self) -> std::path::PathBuf {
        self.folder.path().join("mirror.json")
    }

    /// The received lines, without consecutive duplicates: a mirror at rest gets the same command repeatedly.
    pub fn lines(&self) -> Vec<String> {
        let heard = self.heard.lock().unwrap();
        let mut lines: Vec<String> =
            String::from_utf8(heard.clone()).unwrap().lines().map(str::to_owned).collect();
        lines.retain(|line| !line.is_empty());
        lines.dedup();
        lines
    }
}

pub fn line(bytes: &[u8]) -> Option<usize> {
    bytes.iter().position(|byte| *byte == b'\n').map(|at| at + 1)
}

/// Plays two positions one step from the origin, dark.
pub fn play(mirror: &mut dyn Mirror) {
    let places = [Tilt::new(0.13, 0.0), Tilt::new(0.13, -0.26)];
    let points = places.map(|tilt| raysweep_core::MirrorPoint { tilt, light: 0 });
    mirror.load(&MirrorPath::new(points.into(), 100.0, &LIMITS).unwrap()).unwrap();
    mirror.start(1).unwrap();
    while !mirror.feed().unwrap().parked {
        std::thread::sleep(Duration::from_millis(1));
    }
}

#[test]
fn mti_says_what_the_maker_documents() {
    let script = Script::new(&[(b"$MTI$", b"MTI-Device MTI-MZ\r\n"), (b"MTI+", b"MTI-OK\r\n")], line);
    let config = mti_config(script.pty.path().to_owned(), script.state(), script.light());
    let mut mirror = Mti::open(config).unwrap();
    play(&mut mirror);
    drop(mirror);
    let lines = script.lines();
    let expected = [
        "$MTI$",
        "MTI+EC",
        "MTI+DI",
        "MTI+VB 80",
        "MTI+VD 150",
        "MTI+BW 200",
        "MTI+EN",
        "MTI+GT 0.00000 0.00000 0",
    ];
    assert_eq!(lines[..8], expected);
    assert!(lines.iter().any(|line| line == "MTI+GT 0.02000 0.00000 0"), "{lines:?}");
    assert!(lines.iter().any(|line| line == "MTI+GT 0.02000 -0.04000 0"), "{lines:?}");
    assert_eq!(lines[lines.len() - 3..], ["MTI+GT 0.00000 0.00000 0", "MTI+DI", "MTI+EX"]);
}

#[test]
fn what_a_killed_process_was_answered_is_no_answer_to_us() {
    // The killed process sent a movement and a partial line, which our line end completes; the controller is still in
    // its command mode.
    const STALE: &[u8] = b"MTI-OK\r\nMTI-ERR InvalidCommand\r\n";
    let answers: Answers =
        &[(b"\n", STALE), (b"$MTI$", b"MTI-ERR InvalidCommand\r\n"), (b"MTI+", b"MTI-OK\r\n")];
    let script = Script::new(answers, line);
    let config = mti_config(script.pty.path().to_owned(), script.state(), script.light());
    play(&mut Mti::open(config).unwrap());

    let answers: Answers = &[(b"\r\n", b"OK\r\nNO\r\n"), (b"START", b"OK\r\n"), (b"XY=", b"OK\r\n")];
    let script = Script::new(answers, line);
    let (state, light) = (script.state(), script.light());
    let port = script.pty.path().to_owned();
    let config = OptotuneConfig { port, laser_port: None, limits: LIMITS, state, light };
    play(&mut Optotune::open(config, Box::new(Lamp::default())).unwrap());
}

#[test]
fn an_mti_that_refuses_is_quoted() {
    let script = Script::new(
        &[
            (b"$MTI$", b"MTI-Device MTI-MZ\r\n"),
            (b"MTI+VB", b"MTI-ERR InvalidParameter\r\n"),
            (b"MTI+", b"MTI-OK\r\n"),
        ],
        line,
    );
    let config = mti_config(script.pty.path().to_owned(), script.state(), script.light());
    let error = Mti::open(config).err().unwrap();
    assert_eq!(error.kind, DeviceErrorKind::Protocol, "{error}");
    assert!(error.to_string().contains("InvalidParameter"), "{error}");
    assert!(!script.lines().iter().any(|line| line == "MTI+EN"), "no high voltage");
}

#[test]
fn optotune_says_what_the_maker_documents() {
    let script = Script::new(&[(b"START", b"OK\r\n"), (b"XY=", b"OK\r\n")], line);
    let (state, light) = (script.state(), script.light());
    let port = script.pty.path().to_owned();
    let config = OptotuneConfig { port, laser_port: None, limits: LIMITS, state, light };
    let mut mirror = Optotune::open(config, Box::new(Lamp::default())).unwrap();
    play(&mut mirror);
    drop(mirror);
    let lines = script.lines();
    assert_eq!(lines[..2], ["START", "XY=0.00000;0.00000"]);
    // tan 0.26 degrees / tan 50 degrees, tan 0.52 degrees / tan 50 degrees
    assert!(lines.iter().any(|line| line == "XY=0.00381;-0.00762"), "{lines:?}");
    assert_eq!(lines.last().unwrap(), "XY=0.00000;0.00000");
}

#[test]
fn an_optotune_that_refuses_or_falls_silent_is_quoted() {
    let refused = |answers: Answers| {
        let script = Script::new(answers, line);
        let (state, light) = (script.state(), script.light());
        let port = script.pty.path().to_owned();
        let config = OptotuneConfig { port, laser_port: None, limits: LIMITS, state, light };
        Optotune::open(config, Box::new(Lamp::default())).err().unwrap()
    };
    for (answer, says) in [(b"NO\r\n", "answers NO"), (b"OL\r\n", "answers OL"), (b"OU\r\n", "answers OU")] {
        let answers: [(&[u8], &[u8]); 2] = [(b"START", b"OK\r\n"), (b"XY=", answer)];
        let error = refused(Box::leak(Box::new(answers)));
        assert!(error.kind == DeviceErrorKind::Protocol && error.to_string().contains(says), "{error}");
    }
    let error = refused(&[(b"START", b"OK\r\n")]);
    assert!(error.kind == DeviceErrorKind::Timeout && error.to_string().contains("\"XY="), "{error}");
    let error = refused(&[(b"XY=", b"OK\r\n")]);
    assert!(error.kind == DeviceErrorKind::Timeout && error.to_string().contains("\"START"), "{error}");
}

/// Length of a PlayzerX frame: 'p', 'l', command, length; zeros complete a cut-off write.
pub fn frame(bytes: &[u8]) -> Option<usize> {
    match bytes {
        [0, ..] => Some(1),
        [_, _, _, length, ..] => Some(usize::from(*length)).filter(|length| bytes.len() >= *length),
        _ => None,
    }
}

#[test]
fn a_playzerx_is_known_by_its_words() {
    let open = |answers: Answers| {
        let script = Script::new(answers, frame);
        let config = mirror::PlayzerXConfig {
            port: script.pty.path().to_owned(),
            link: mirror::PlayzerXLink::VirtualCom,
            full_scale: LIMITS.max_tilt,
            limits: LIMITS,
            state: script.state(),
            light: script.light(),
        };
        let opened = PlayzerX::open(config).map(|mirror| mirror.capabilities().model.clone());
        let heard = script.heard.lock().unwrap().clone();
        (opened, heard)
    };
    let (model, heard) = open(&[(b"pln", b"pl-info\nPX1\nPLX-2.1.0.0\nXYM\n"), (b"plg", b"pl-\x00\x00\x00")]);
    assert_eq!(model.unwrap(), "PX1, firmware PLX-2.1.0.0");
    assert!(heard.ends_with(b"plu\x07\x00\x00\npln\x05\nplg\x05\n"), "{heard:?}");

    let refused = |answers: Answers| open(answers).0.unwrap_err();
    let colour = refused(&[(b"pln", b"pl-info\nPX1\nPLX-2.1.0.0\nXYRGB\n")]);
    assert!(colour.kind == DeviceErrorKind::Unsupported && colour.to_string().contains("XYRGB"), "{colour}");
    let busy = refused(&[(b"pln", b"pl-info\nPX1\nA\nXYM\n"), (b"plg", b"pl-\x05\x00\x00")]);
    assert!(busy.kind == DeviceErrorKind::NotReady && busy.to_string().contains("did not send"), "{busy}");
    assert_eq!(refused(&[]).kind, DeviceErrorKind::Timeout);
}
