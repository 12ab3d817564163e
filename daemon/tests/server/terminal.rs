//! `raysweep run` at a terminal.

use std::fs::{self, File};
use std::io::Read;
use std::os::fd::OwnedFd;
use std::process::{Command, Stdio};
use std::sync::{Arc, Mutex};
use std::thread;

use nix::pty::{Winsize, openpty};
use raysweep_core::{Counts, LossCause, PointUnderWay, VsyncStats};
use raysweep_proto::{Event, Progress};

use crate::fake::Daemon;
use crate::process::{Process, wait_for};

const COLUMNS: usize = 80;

/// What a long run with every kind of loss tells.
fn much() -> Vec<Event> {
    let mut counts = Counts { expected: 9_999_999, averaged: 9_000_000, ..Counts::default() };
    for cause in [LossCause::CameraGap, LossCause::DriverFull, LossCause::FalseEdge, LossCause::Jitter] {
        counts.lose(cause, 249_999);
    }
    let progress = Progress {
        points_stored: 12_345,
        points_planned: 67_890,
        under_way: Some(PointUnderWay { frames: 1234, of: 4096 }),
        counts,
        elapsed_s: 360_000.0,
        left_s: Some(1_234_567.0),
        frames_per_s: 1234.5,
    };
    let vsync = VsyncStats { jitter_us: 123.45, ..VsyncStats::default() };
    vec![
        Event::Vsync(vsync),
        Event::Live { sequence: 1, points: 12_345, seconds: 1.0 },
        Event::Progress(progress),
    ]
}

/// What was written between returns of the cursor, without colours and its other movements.
fn lines(written: &str) -> Vec<String> {
    let mut text = String::new();
    let mut letters = written.chars();
    while let Some(letter) = letters.next() {
        match letter {
            '\u{1b}' => while letters.next().is_some_and(|letter| !letter.is_ascii_alphabetic()) {},
            letter => text.push(letter),
        }
    }
    text.split(['\r', '\n']).map(str::to_owned).collect()
}

#[test]
fn progress_has_a_bar_and_never_wraps_at_a_terminal_of_80_columns() {
    let daemon = Daemon::start();
    let plan = daemon.folder.path().join("plan.toml");
    fs::write(&plan, "hang").unwrap();
    let size = Winsize { ws_row: 24, ws_col: COLUMNS as u16, ws_xpixel: 0, ws_ypixel: 0 };
    let pty = openpty(Some(&size), None).unwrap();
    let end = |end: &OwnedFd| Stdio::from(end.try_clone().unwrap());
    let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
    command.env("RAYSWEEP_SOCKET", &daemon.path).env("TERM", "xterm").arg("run").arg(&plan);
    command.stdin(Stdio::null()).stdout(end(&pty.slave)).stderr(end(&pty.slave));
    let mut process = Process::start(&mut command);
    // The terminal ends when the process has ended and nobody here holds its end.
    drop((command, pty.slave));
    let written = Arc::new(Mutex::new(Vec::new()));
    let reader = thread::spawn({
        let (written, mut terminal) = (written.clone(), File::from(pty.master));
        move || {
            let mut bytes = [0; 4096];
            // It ends in an error.
            while let Ok(count @ 1..) = terminal.read(&mut bytes) {
                written.lock().unwrap().extend(&bytes[..count]);
            }
        }
    });
    let seen = || lines(&String::from_utf8_lossy(&written.lock().unwrap()));
    // Bars are drawn now and then.
    wait_for("a bar and its details", || {
        much().into_iter().for_each(|event| daemon.fake.publish(event));
        let lines = seen();
        let has = |part| lines.iter().any(|line| line.contains(part));
        (has("12345/67890") && has("1234 frames/s")).then_some(())
    });
    daemon.client().cancel().unwrap();
    assert_eq!(process.wait().code(), Some(3));
    reader.join().unwrap();

    // A full line and the next one are written in one go.
    for drawn in seen().into_iter().filter(|drawn| drawn.contains("measurements")) {
        let columns: Vec<char> = drawn.chars().collect();
        let rows: Vec<String> = columns.chunks(COLUMNS).map(|row| row.iter().collect()).collect();
        let (bar, message) = rows[0].split_once('[').unwrap().1.split_once(']').unwrap();
        assert!(bar.len() == 20 && message.contains(" measurements  frame "), "{rows:#?}");
        let details = rows.get(1).map_or("", |details| details.trim());
        let is_whole =
            details.is_empty() || details.split_once(" frames/s").unwrap().0.parse::<u32>().is_ok();
        assert!(rows.len() <= 2 && is_whole, "{rows:#?}");
    }
}
