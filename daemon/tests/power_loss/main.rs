//! Power loss at any moment of a session, as SQLite tests it: what the daemon writes, syncs, renames and removes is
//! recorded, each prefix of the record gives states in which a disk can be left, and each of these is resumed or
//! processed. `RAYSWEEP_CRASH_STATES=10000 cargo test -p raysweep --all-features --test power_loss -- --nocapture`
//! tries more of them.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod disk;
#[path = "../outcome/mod.rs"]
mod outcome;
#[path = "../process/mod.rs"]
mod process;
mod record;

use std::collections::hash_map::DefaultHasher;
use std::collections::{BTreeMap, HashSet};
use std::fs;
use std::hash::{Hash, Hasher};
use std::path::{Path, PathBuf};
use std::process::Command;

use disk::{History, Loss, Tree};
use outcome::{Outcome, outcome};
use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::SeedableRng;
use raysweep::Runner;
use raysweep::control::Control;
use raysweep::rig::Rig;
use raysweep_processing::calibration::{KeptCalibration, current_in};
use raysweep_proto::{Event, ResumeParams};
use raysweep_session::integrity::{Audit, DamagedPart};
use raysweep_session::{Error, Session};
use record::{Call, Recorded};
use tempfile::TempDir;

/// 8 x 8 pixels, and all faults whose effects could differ after a crash.
const PLANE: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n\
                     [projector]\ndriver = \"sim\"\nrows = 8\n\
                     [sim]\nscene = \"v-groove\"\nscene_rows = 8\nscene_columns = 8\nseed = 11\n\
                     [sim.vsync]\nmissing = 0.02\nfalse_edges = 0.02\nunseen = 0.02\n\
                     [sim.camera]\nlate_frames_max = 3\ndropped = 0.02\n\
                     [sim.ambient]\nlevel = 0.001\nflicker = 0.5\nphase = \"drawn\"\n";
const BOARD: &str = "kind = \"plane\"\n[camera]\ndriver = \"sim\"\n[vsync]\ndriver = \"sim\"\n\
                     [projector]\ndriver = \"sim\"\nrows = 720\nrow_time_us = 22.22\n\
                     [sim]\nscene_rows = 96\nscene_columns = 48\n";
const DOTS: &str = "kind = \"dots\"\n[camera]\ndriver = \"sim\"\n[mirror]\ndriver = \"sim\"\n\
                    [sim.dots]\nscene = \"v-groove\"\nrows = 112\ncolumns = 128\nmargin_rows = 16\nseed = 5\n";
const SWEEP_PLAN: &str =
    "kind = \"sweep\"\n[sweep]\naverage = 2\ndelay_us = [-60, 0, 60]\nexposure_us = [50, 100]\n";
const FILM_PLAN: &str = "kind = \"film\"\n[film]\ncycles = 5\ndelay_us = [-60, 0, 60]\nexposure_us = 50\n";
const BATCHES_PLAN: &str = "kind = \"batches\"\nproduct = [{ kind = \"floodlit\" }]\n[batches]\ncount = 2\ndots = 60\n\
                            exposure_us = 100\ndark_frames = 64\ntrailing_region = [112, 128, 48, 80]\n\
                            background_indices = [0]\ncalibration = []\n[batches.path]\nshape = \"lissajous\"\n\
                            cycles = [7, 1]\namplitude_deg = [2.3, 1.3]\nsamples = 1500\nrate_hz = 30000\n";
const CALIBRATION_PLAN: &str =
    "kind = \"calibration\"\n[calibration]\nframes = 8\npicture_frames = 2\ndelays = 40\n";

/// States that are tried in each run of the tests.
const STATES: usize = 500;

type Files = BTreeMap<String, Vec<u8>>;

/// What becomes of a state.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Verdict {
    /// The session had not begun, and is called no session.
    NotBegun,
    /// It was resumed, or processed if its kind cannot be resumed, to the bits of the uninterrupted run.
    SameBits,
    /// As another state, after what resuming does first: removing temporary files and a torn last line.
    AsAnother,
    /// Nothing acknowledged is missing or damaged; only one in several such states is resumed, because that takes long.
    Intact,
}

/// How a kind of session is continued after a crash.
enum Continued {
    Resumed(Box<Runner>, Outcome),
    Processed,
}

/// A recorded session, and a folder in which its crash states are tried.
struct Trial {
    history: History,
    /// The recorded session when it was complete.
    whole: Files,
    name: String,
    work: TempDir,
    continued: Continued,
    known: HashSet<u64>,
    /// Of how many different states one is resumed.
    resumed_every: usize,
    /// Results that processing makes of the data of so many bytes of the ledger.
    processed: BTreeMap<usize, (bool, Files)>,
}

impl Trial {
    fn new(kind: &str, rig: &str, plan: &str) -> Self {
        Self::sabotaged(kind, rig, plan, |_| {})
    }

    /// A session whose record is changed, as if the daemon had done something else.
    fn sabotaged(kind: &str, rig: &str, plan: &str, change: impl FnOnce(&mut Vec<Recorded>)) -> Self {
        // In memory: the states of a disk are computed, and syncing to a real one would take minutes.
        let work = tempfile::tempdir_in("/dev/shm").unwrap();
        fs::write(work.path().join("rig.toml"), rig).unwrap();
        let (mut calls, session) = record::record(work.path(), plan);
        let data = work.path().join("sessions");
        change(&mut calls);
        let history = History::of(&calls, &data);
        let name = session.file_name().unwrap().to_str().unwrap().to_owned();
        let continued = match kind {
            "sweep" | "calibration" => {
                let rig = Rig::load(&work.path().join("rig.toml")).unwrap_or_else(|error| panic!("{error}"));
                let runner = Runner::new(rig, data.clone()).unwrap_or_else(|error| panic!("{error}"));
                Continued::Resumed(Box::new(runner), outcome(&session))
            }
            _ => Continued::Processed,
        };
        let whole = files_of(&session);
        let (known, processed) = (HashSet::new(), BTreeMap::new());
        let resumed_every = if kind == "calibration" { 5 } else { 1 };
        let trial = Self { history, whole, name, work, continued, known, resumed_every, processed };
        // What was recorded is what happened: without a loss, the states end with the session itself.
        let mut random = Xoshiro256PlusPlus::seed_from_u64(0);
        let last = trial.history.after_power_loss(trial.history.len, Loss::Nothing, &mut random);
        trial.make(&last);
        assert!(files_of(&trial.session()) == trial.whole, "{kind}: the record is not what happened");
        trial
    }

    fn data(&self) -> PathBuf {
        self.work.path().join("sessions")
    }

    fn session(&self) -> PathBuf {
        self.data().join(&self.name)
    }

    /// Makes the data folder that of a state.
    fn make(&self, tree: &Tree) {
        fs::remove_dir_all(self.data()).unwrap();
        fs::create_dir(self.data()).unwrap();
        for (path, bytes) in tree {
            let path = self.data().join(path);
            match bytes {
                None => fs::create_dir(path).unwrap(),
                Some(bytes) => fs::write(path, bytes).unwrap(),
            }
        }
    }

    /// What becomes of a state after `time` calls.
    fn judge(&mut self, tree: &Tree, time: usize, what: &str) -> Verdict {
        self.make(tree);
        let acknowledged = self.history.acknowledged_bytes(time);
        let whole = &self.whole["ledger.jsonl"];
        let listing = raysweep_session::list(&self.data()).unwrap();
        let kept = KeptCalibration::read(&current_in(&self.data()));
        assert!(kept.is_ok(), "{what}: the calibration in use cannot be read: {:?}", kept.err());
        let session = match Session::open(&self.session()) {
            Ok(session) => session,
            Err(error @ Error::NotASession { .. }) => {
                assert_eq!(acknowledged, 0, "{what}: lost: {error}");
                assert!(listing.sessions.is_empty() && listing.unreadable.is_empty(), "{what}");
                return Verdict::NotBegun;
            }
            Err(error) => panic!("{what}: unreadable: {error}"),
        };
        assert_eq!(
            (listing.sessions.len(), listing.unreadable.len()),
            (1, 0),
            "{what}: {:?}",
            listing.unreadable
        );
        let (_, audit) = Audit::of(&session).unwrap_or_else(|error| panic!("{what}: unreadable: {error}"));
        // The manifest is written when the run is complete already.
        let manifest = DamagedPart::Result { file: "manifest.json".into() };
        let is_sound = audit.damage.iter().all(|damage| damage.part == manifest);
        assert!(is_sound, "{what}: a line without its data: {:?}", audit.damage);
        let ledger = fs::read(session.ledger_path()).unwrap();
        let lines = &ledger[..ledger.len() - audit.torn_bytes];
        assert!(whole.starts_with(lines), "{what}: other lines than were written");
        assert!(lines.len() >= acknowledged, "{what}: {} bytes of {acknowledged} acknowledged", lines.len());

        drop(session.resume().unwrap_or_else(|error| panic!("{what}: {error}")));
        let mut hasher = DefaultHasher::new();
        files_of(session.dir()).hash(&mut hasher);
        if !self.known.insert(hasher.finish()) {
            return Verdict::AsAnother;
        }
        if !self.known.len().is_multiple_of(self.resumed_every) {
            return Verdict::Intact;
        }
        match &self.continued {
            Continued::Resumed(runner, expected) => {
                resume(runner, session.dir(), what);
                let found = outcome(session.dir());
                assert_eq!(found.points, expected.points, "{what}: other points");
                assert!(found.files == expected.files, "{what}: other products");
                assert_eq!(differing(&files_of(session.dir()), &self.whole), None, "{what}: other arrays");
            }
            Continued::Processed => self.process(lines.len(), what),
        }
        Verdict::SameBits
    }

    /// Processes a state, whose results must be those of the recorded data of the same lines.
    fn process(&mut self, ledger_bytes: usize, what: &str) {
        let folder = self.session();
        let made = processed(&folder);
        let expected = self.processed.entry(ledger_bytes).or_insert_with(|| {
            let data = self.whole.iter().filter(|(name, _)| !is_result(name));
            let ledger = self.whole["ledger.jsonl"][..ledger_bytes].to_vec();
            fs::remove_dir_all(&folder).unwrap();
            for (name, bytes) in data.chain([(&"ledger.jsonl".to_owned(), &ledger)]) {
                fs::create_dir_all(folder.join(name).parent().unwrap()).unwrap();
                fs::write(folder.join(name), bytes).unwrap();
            }
            fs::create_dir_all(folder.join("products")).unwrap();
            processed(&folder)
        });
        assert_eq!(made.0, expected.0, "{what}: processed or not");
        // Where nothing can be made yet, what the run had begun to make may still be there.
        let made = made.1.into_iter().filter(|(name, _)| expected.1.contains_key(name)).collect();
        assert_eq!(differing(&made, &expected.1), None, "{what}: other results");
    }
}

/// Acquires the missing points of a session.
fn resume(runner: &Runner, session: &Path, what: &str) {
    let mut events = runner.events();
    runner.resume(ResumeParams { session: session.into() }).unwrap_or_else(|error| panic!("{what}: {error}"));
    loop {
        match events.blocking_recv() {
            Ok(Event::Finished { state, error, .. }) => {
                assert_eq!(state, "complete", "{what}: {error:?}");
                return;
            }
            Ok(_) | Err(tokio::sync::broadcast::error::RecvError::Lagged(_)) => {}
            Err(error) => panic!("{what}: {error}"),
        }
    }
}

/// Whether `raysweep process` succeeds, and the results.
fn processed(session: &Path) -> (bool, Files) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
    let output = command.arg("process").arg(session).env("PATH", "/nonexistent").output().unwrap();
    let results = files_of(session).into_iter().filter(|(name, _)| is_result(name)).collect();
    (output.status.success(), results)
}

/// Whether a file is made from the data. Reports and manifests tell of times.
fn is_result(name: &str) -> bool {
    let results = ["products/", "transport", "report.html", "manifest.json"];
    results.iter().any(|result| name.starts_with(result))
}

/// The first file that is not the same in two folders, apart from those that tell of times.
fn differing<'a>(found: &'a Files, expected: &'a Files) -> Option<&'a String> {
    let timed = ["ledger.jsonl", "report.html", "manifest.json", "calibration.toml"];
    let names = found.keys().chain(expected.keys()).filter(|name| !timed.contains(&name.as_str()));
    names.into_iter().find(|name| found.get(*name) != expected.get(*name))
}

/// All files of a folder, by their paths in it.
fn files_of(folder: &Path) -> Files {
    let mut files = Files::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(inner) = folders.pop() {
        for path in fs::read_dir(inner).unwrap().map(|entry| entry.unwrap().path()) {
            match path.is_dir() {
                true => folders.push(path),
                false => {
                    let name = path.strip_prefix(folder).unwrap().display().to_string();
                    files.insert(name, fs::read(&path).unwrap());
                }
            }
        }
    }
    files
}

/// Tries states of a session, `percent` of all.
fn try_states(percent: usize, seed: u64, mut trial: Trial) {
    let all = std::env::var("RAYSWEEP_CRASH_STATES").map_or(STATES, |states| states.parse().unwrap());
    let (count, calls) = (all * percent / 100, trial.history.len);
    let began = std::time::Instant::now();
    let mut random = Xoshiro256PlusPlus::seed_from_u64(seed);
    let mut verdicts: BTreeMap<Loss, BTreeMap<Verdict, usize>> = BTreeMap::new();
    for state in 0..count {
        let loss = Loss::ALL[state % Loss::ALL.len()];
        // Spread over the record, so that few states leave no part of it out.
        let time = (state * calls).div_ceil(count - 1);
        let tree = trial.history.after_power_loss(time, loss, &mut random);
        let what = format!("{}, state {state}: {loss:?} lost after {time} of {calls} calls", trial.name);
        let verdict = trial.judge(&tree, time, &what);
        *verdicts.entry(loss).or_default().entry(verdict).or_default() += 1;
    }
    println!("{}: {calls} calls, {count} states in {:.1?}", trial.name, began.elapsed());
    for (loss, verdicts) in &verdicts {
        println!("  {loss:?} lost, {}: {verdicts:?}", verdicts.values().sum::<usize>());
    }
    let same = verdicts.values().filter_map(|verdicts| verdicts.get(&Verdict::SameBits)).sum::<usize>();
    assert!(same > 0, "{verdicts:?}");
}

#[test]
fn a_sweep_resumes_from_whatever_a_power_loss_leaves() {
    try_states(40, 1, Trial::new("sweep", PLANE, SWEEP_PLAN));
}

#[test]
fn a_film_is_processed_from_whatever_a_power_loss_leaves() {
    try_states(29, 2, Trial::new("film", PLANE, FILM_PLAN));
}

#[test]
fn batches_are_processed_from_whatever_a_power_loss_leaves() {
    try_states(28, 3, Trial::new("batches", DOTS, BATCHES_PLAN));
}

#[test]
fn a_calibration_resumes_from_whatever_a_power_loss_leaves() {
    try_states(3, 4, Trial::new("calibration", BOARD, CALIBRATION_PLAN));
}

/// What is wrong with the first of a few states that is not as it must be.
fn first_found(trial: &mut Trial) -> Option<String> {
    let mut random = Xoshiro256PlusPlus::seed_from_u64(5);
    let calls = trial.history.len;
    (0..calls).step_by(7).find_map(|time| {
        let tree = trial.history.after_power_loss(time, Loss::Everything, &mut random);
        let judged = std::panic::catch_unwind(std::panic::AssertUnwindSafe(|| trial.judge(&tree, time, "")));
        judged.err().map(|panic| raysweep_pipeline::message_of(&*panic).to_owned())
    })
}

/// The calls after a change of their order or number: each is made when the one before it has returned.
fn renumbered(calls: impl IntoIterator<Item = Recorded>) -> Vec<Recorded> {
    (0..).zip(calls).map(|(begun, recorded)| Recorded { begun, ..recorded }).collect()
}

/// Leaves out the syncs of some files or folders.
fn without_syncs(calls: &mut Vec<Recorded>, of: impl Fn(&Path) -> bool) {
    let before = calls.len();
    calls.retain(|recorded| !matches!(&recorded.call, Call::Sync(path) if of(path)));
    assert!(calls.len() < before, "no sync to leave out");
    *calls = renumbered(std::mem::take(calls));
}

/// Appends each line of the ledger before the data of its point are written.
fn lines_first(calls: &mut Vec<Recorded>) {
    let is_line = |call: &Call| matches!(call, Call::Write { path, .. } | Call::Sync(path) if path.ends_with("ledger.jsonl"));
    let mut turned: Vec<Recorded> = Vec::new();
    let mut data_from = None;
    for recorded in std::mem::take(calls) {
        if matches!(&recorded.call, Call::Open { path, create: true, .. } if path.to_string_lossy().contains("/sum/c."))
        {
            data_from.get_or_insert(turned.len());
        }
        match data_from.filter(|_| is_line(&recorded.call)) {
            Some(at) => {
                data_from = matches!(recorded.call, Call::Write { .. }).then_some(at + 1);
                turned.insert(at, recorded);
            }
            None => turned.push(recorded),
        }
    }
    *calls = renumbered(turned);
}

#[test]
fn a_sync_left_out_or_a_line_before_its_data_is_found() {
    type Change = fn(&mut Vec<Recorded>);
    let sabotages: [(&str, Change, &str); 4] = [
        (
            "no sync of data",
            |calls| without_syncs(calls, |path| path.to_string_lossy().contains("/sum/c.")),
            "a line without its data",
        ),
        (
            "no sync of their folder",
            |calls| without_syncs(calls, |path| path.ends_with("stack.zarr/sum")),
            "a line without its data",
        ),
        (
            "no sync of lines",
            |calls| without_syncs(calls, |path| path.ends_with("ledger.jsonl")),
            "acknowledged",
        ),
        ("lines before data", lines_first, "a line without its data"),
    ];
    for (what, change, symptom) in sabotages {
        let mut trial = Trial::sabotaged("sweep", PLANE, SWEEP_PLAN, change);
        let found = first_found(&mut trial).unwrap_or_else(|| panic!("{what}: not found"));
        println!("{what}: {found}");
        assert!(found.contains(symptom), "{what}: {found}");
    }
}
