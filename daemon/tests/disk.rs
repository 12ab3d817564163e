//! Disks that refuse or are slow: `strace` makes single system calls of the real daemon fail, or last long, while a
//! session is resumed whose folder is known.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod outcome;
mod process;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use outcome::{Outcome, outcome};
use process::{Process, wait_for};
use raysweep_proto::{Client, Event, RunParams, RunState};
use tempfile::TempDir;

const RIG: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n\
                   [projector]\ndriver = \"sim\"\nrows = 8\n\
                   [sim]\nscene = \"v-groove\"\nscene_rows = 8\nscene_columns = 8\nseed = 11\n";
const PLAN: &str =
    "kind = \"sweep\"\n[sweep]\naverage = 2\ndelay_us = [-60, 0, 60]\nexposure_us = [50, 100]\n";

/// A session that a run has completed, and is cut back to its beginning.
struct Begun {
    folder: TempDir,
    session: PathBuf,
    whole: Outcome,
}

/// How a run ended.
#[derive(Debug)]
struct Ended {
    state: String,
    error: Option<String>,
    /// What it was paused for.
    waited_for: Vec<String>,
}

impl Begun {
    fn new() -> Self {
        let folder = tempfile::tempdir_in("/dev/shm").unwrap();
        std::fs::write(folder.path().join("rig.toml"), RIG).unwrap();
        let mut daemon = Self::daemon(folder.path(), Command::new(env!("CARGO_BIN_EXE_raysweepd")));
        let (events, mut client) = Self::clients(folder.path(), &mut daemon);
        let session = client.run(&RunParams { plan: PLAN.into(), ..RunParams::default() }).unwrap().session;
        assert_eq!(ended(events, &mut client, |_| {}).state, "complete");
        let whole = outcome(&session);
        let ledger = std::fs::read_to_string(session.join("ledger.jsonl")).unwrap();
        let begun: String = ledger.split_inclusive('\n').take(2).collect();
        std::fs::write(session.join("ledger.jsonl"), begun).unwrap();
        for made in ["products", "transport.zarr", "stack.zarr/sum/c.2.0.0"] {
            let made = session.join(made);
            if made.is_dir() { std::fs::remove_dir_all(made) } else { std::fs::remove_file(made) }.unwrap();
        }
        std::fs::create_dir(session.join("products")).unwrap();
        Self { folder, session, whole }
    }

    fn daemon(folder: &Path, mut command: Command) -> Process {
        command.arg("--rig").arg(folder.join("rig.toml")).arg("--socket").arg(folder.join("socket"));
        Process::start(command.arg("--data").arg(folder.join("sessions")).stderr(Stdio::null()))
    }

    /// A client that has subscribed, and another one.
    fn clients(folder: &Path, daemon: &mut Process) -> (impl Iterator<Item = Event> + use<>, Client) {
        let socket = folder.join("socket");
        let client = wait_for("the daemon does not listen", || {
            assert!(!daemon.has_ended(), "the daemon has ended");
            Client::connect(&socket).ok()
        });
        (client.subscribe().unwrap().map(Result::unwrap), Client::connect(&socket).unwrap())
    }

    /// Resumes the session while `strace` tampers with calls that concern a file of it. `paused` is done when the run
    /// waits for the disk.
    fn resume(&self, file: &str, tamper: &str, paused: impl FnMut(&mut Client)) -> Ended {
        let command = tampered(tamper, &[self.session.join(file)]);
        let mut daemon = Self::daemon(self.folder.path(), command);
        let (events, mut client) = Self::clients(self.folder.path(), &mut daemon);
        client.resume(&self.session).unwrap();
        ended(events, &mut client, paused)
    }
}

/// The daemon, whose calls that concern these files are tampered with.
fn tampered(tamper: &str, files: &[PathBuf]) -> Command {
    let mut command = Command::new("strace");
    command.args(["-D", "-f", "-qqq", "-o", "/dev/null", "-e", &format!("inject={tamper}")]);
    for file in files {
        command.arg("-P").arg(file);
    }
    command.arg(env!("CARGO_BIN_EXE_raysweepd"));
    command
}

fn ended(
    events: impl Iterator<Item = Event>,
    client: &mut Client,
    mut paused: impl FnMut(&mut Client),
) -> Ended {
    let mut waited_for = Vec::new();
    for event in events {
        match event {
            Event::Ask(question) => {
                let status = client.status().unwrap();
                assert_eq!((status.state, status.question.as_ref()), (RunState::Paused, Some(&question)));
                assert!(!question.wants_answer, "the run goes on by itself");
                waited_for.push(question.text);
                paused(client);
            }
            Event::Finished { state, error, .. } => return Ended { state, error, waited_for },
            _ => {}
        }
    }
    panic!("the daemon ended before the run");
}

/// The file in which a point of the sweep is written.
const DATA: &str = "stack.zarr/sum/c.2.0.0.raysweep-tmp";

#[test]
fn a_run_on_a_full_or_read_only_disk_is_paused_and_goes_on_by_itself() {
    // A file that cannot be made, written, synced or named, and a line that cannot be written or synced.
    let cases = [
        (DATA, "openat:error=EROFS:when=1..2", "Read-only"),
        (DATA, "write:error=ENOSPC:when=1", "No space"),
        (DATA, "fsync:error=EDQUOT:when=1", "uota exceeded"),
        (DATA, "rename:error=ENOSPC:when=1", "No space"),
        ("ledger.jsonl", "write:error=ENOSPC:when=4..5", "No space"),
        ("ledger.jsonl", "fdatasync:error=ENOSPC:when=5", "No space"),
    ];
    std::thread::scope(|scope| {
        for (file, tamper, says) in cases {
            scope.spawn(move || {
                let begun = Begun::new();
                let ended = begun.resume(file, tamper, |_| {});
                assert_eq!(ended.state, "complete", "{tamper}: {ended:?}");
                let [text] = &ended.waited_for[..] else { panic!("{tamper}: {ended:?}") };
                assert!(text.contains(says) && text.contains("goes on by itself"), "{tamper}: {text}");
                let found = outcome(&begun.session);
                assert!(found == begun.whole, "{tamper}: other bits");
            });
        }
    });
}

#[test]
fn a_run_that_waits_for_the_disk_can_be_continued_and_cancelled() {
    let begun = Begun::new();
    let mut pauses = 0;
    // Continuing makes no room: the run is paused again. Cancelling ends it with what is wrong.
    let ended = begun.resume(DATA, "write:error=ENOSPC", |client| {
        pauses += 1;
        if pauses == 1 { client.go_on() } else { client.cancel() }.unwrap();
    });
    assert_eq!((ended.state.as_str(), ended.waited_for.len()), ("faulted", 2), "{ended:?}");
    assert!(ended.error.unwrap().contains("No space left"));
    let mended = begun.resume("nothing", "write:error=ENOSPC", |_| {});
    assert_eq!(mended.state, "complete", "{mended:?}");
    assert!(outcome(&begun.session) == begun.whole, "other bits");
}

#[test]
fn a_disk_that_fails_ends_the_run_with_its_cause() {
    for (file, tamper) in [(DATA, "fsync:error=EIO"), ("ledger.jsonl", "fdatasync:error=EIO:when=5")] {
        let begun = Begun::new();
        let ended = begun.resume(file, tamper, |_| {});
        assert_eq!((ended.state.as_str(), ended.waited_for.len()), ("faulted", 0), "{tamper}: {ended:?}");
        assert!(ended.error.unwrap().contains("Input/output error"), "{tamper}");
        assert_eq!(begun.resume("nothing", "write:error=EIO", |_| {}).state, "complete");
        assert!(outcome(&begun.session) == begun.whole, "{tamper}: other bits");
    }
}

#[test]
fn a_slow_disk_changes_no_bit() {
    let begun = Begun::new();
    let ended = begun.resume("ledger.jsonl", "fdatasync:delay_exit=50000", |_| {});
    assert_eq!((ended.state.as_str(), ended.waited_for.len()), ("complete", 0), "{ended:?}");
    assert!(outcome(&begun.session) == begun.whole, "other bits");
}

/// Runs a plan in a folder of its own while `strace` tampers with calls that concern a file of its session, which is named
/// after the second in which it begins and the plan's name.
fn tampered_run(rig: &str, plan: &str, name: &str, file: &str, tamper: &str) -> (TempDir, PathBuf, Ended) {
    let folder = tempfile::tempdir_in("/dev/shm").unwrap();
    std::fs::write(folder.path().join("rig.toml"), rig).unwrap();
    let stamp = |second| {
        let begins = jiff::Timestamp::now() + jiff::SignedDuration::from_secs(second);
        let stamp = begins.to_zoned(jiff::tz::TimeZone::UTC).strftime("%Y%m%d-%H%M%S").to_string();
        folder.path().join(format!("sessions/{stamp}_{name}/{file}"))
    };
    let files: Vec<PathBuf> = (0..600).map(stamp).collect();
    let command = tampered(tamper, &files);
    let mut daemon = Begun::daemon(folder.path(), command);
    let (events, mut client) = Begun::clients(folder.path(), &mut daemon);
    let plan = format!("name = \"{name}\"\n{plan}");
    let session = client.run(&RunParams { plan, ..RunParams::default() }).unwrap().session;
    let ended = ended(events, &mut client, |_| {});
    (folder, session, ended)
}

#[test]
fn a_film_on_a_full_disk_is_held_between_two_cycles_and_loses_none() {
    let plan = "kind = \"film\"\n[film]\ncycles = 6\ndelay_us = [-60, 0, 60]\nexposure_us = 50\n";
    let file = "film.zarr/film/c.3.0.0.0.raysweep-tmp";
    let (_folder, session, ended) = tampered_run(RIG, plan, "film", file, "fsync:error=ENOSPC:when=1");
    assert_eq!((ended.state.as_str(), ended.waited_for.len()), ("complete", 1), "{ended:?}");
    let state = raysweep_session::Session::open(&session).unwrap().state().unwrap();
    assert_eq!(state.cycles().count(), 6);
}

const DOTS: &str = "kind = \"dots\"\n[camera]\ndriver = \"sim\"\n[mirror]\ndriver = \"sim\"\n\
                    [sim.dots]\nscene = \"v-groove\"\nrows = 112\ncolumns = 128\nmargin_rows = 16\nseed = 5\n";

#[test]
fn batches_on_a_full_disk_are_held_and_none_is_lost() {
    let plan = "kind = \"batches\"\nproduct = [{ kind = \"floodlit\" }]\n\
                [batches]\ncount = 6\ndots = 300\nexposure_us = 100\ndark_frames = 64\nkeep_raw = true\n\
                trailing_region = [112, 128, 48, 80]\nbackground_indices = [0]\n\
                [batches.path]\nshape = \"lissajous\"\ncycles = [7, 1]\namplitude_deg = [2.3, 1.3]\nsamples = 1500\n\
                rate_hz = 30000\n";
    // A batch that cannot be named, the last, a line, and raw frames.
    let cases = [
        ("dots.zarr/b0002.raysweep-tmp", "rename:error=ENOSPC:when=1"),
        ("dots.zarr/b0007.raysweep-tmp", "rename:error=ENOSPC:when=1..2"),
        ("ledger.jsonl", "fdatasync:error=ENOSPC:when=5"),
        ("raw.npy", "write:error=ENOSPC:when=1000"),
    ];
    std::thread::scope(|scope| {
        for (file, tamper) in cases {
            scope.spawn(move || {
                let (_folder, session, ended) = tampered_run(DOTS, plan, "dots", file, tamper);
                assert_eq!(ended.state, "complete", "{tamper}: {ended:?}");
                // Each pass has a thread of its own for raw frames, and `strace` counts the calls of each thread.
                assert!(!ended.waited_for.is_empty(), "{file}, {tamper}: {ended:?}");
                let is_told = |text: &String| text.contains("No space") && text.contains("goes on by itself");
                assert!(ended.waited_for.iter().all(is_told), "{tamper}: {ended:?}");
                let session = raysweep_session::Session::open(&session).unwrap();
                let state = session.state().unwrap();
                assert_eq!(
                    state.batches().map(|entry| entry.batch).collect::<Vec<_>>(),
                    (0..8).collect::<Vec<_>>()
                );
                assert!(state.batches().all(|entry| entry.missing.is_empty()), "{file}");
                assert!(state.counts.balanced() && state.counts.lost_total() == 0, "{:?}", state.counts);
                // Each raw frame is there once, and has its line.
                let bytes = std::fs::metadata(session.raw_path()).unwrap().len() - 128;
                assert_eq!(bytes % (2 * 128 * 128), 0, "{file}");
                let lines = std::fs::read_to_string(session.raw_path().with_extension("csv")).unwrap();
                let mut noted: Vec<usize> = lines
                    .lines()
                    .skip(1)
                    .map(|line| line.split_once(',').unwrap().0.parse().unwrap())
                    .collect();
                noted.sort_unstable();
                assert!(noted.into_iter().eq(0..bytes as usize / (2 * 128 * 128)), "{file}");
            });
        }
    });
}

#[test]
fn a_chirp_on_a_full_disk_is_held_and_none_is_lost() {
    let plan = "kind = \"response\"\n[response]\nchirp_s = 0.5\nrest_s = 0.2\nrate_hz = 30000\n\
                camera_rate_hz = 4000\nexposure_us = 100\ndark_frames = 64\nregion = [0, 112, 0, 128]\n";
    let rig = format!("{DOTS}[sim.dots.mirror]\nf0_hz = [500.0, 480.0]\nq = [30.0, 22.0]\n");
    let file = "products/chirp_x.npy.raysweep-tmp";
    let (_folder, session, ended) = tampered_run(&rig, plan, "response", file, "fsync:error=ENOSPC:when=1");
    assert_eq!((ended.state.as_str(), ended.waited_for.len()), ("complete", 1), "{ended:?}");
    let state = raysweep_session::Session::open(&session).unwrap().state().unwrap();
    assert_eq!(state.stored_points(), 2);
}
