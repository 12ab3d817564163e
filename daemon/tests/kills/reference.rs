//! A session that nothing interrupted, and kills whose outcomes are compared with it.

use std::cell::{Cell, RefCell};
use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};

use rand_xoshiro::Xoshiro256PlusPlus;
use rand_xoshiro::rand_core::Rng;
use raysweep_proto::Client;
use tempfile::TempDir;

use crate::daemon::{Daemon, end, plan};
use crate::judge::{
    Files, Stored, Verdict, command, copy, files_of, has_ended, raysweep, results_of, stored, text,
};
use crate::kinds::Kind;
use crate::process::{HUNG, Process};

/// A session that nothing interrupted, in the folder in which others of its kind are killed.
pub struct Reference<'a> {
    kind: &'a Kind,
    folder: TempDir,
    /// Away from the data folder.
    session: PathBuf,
    run_time: Usual,
    /// Of resumed runs, which are shorter.
    resume_time: Usual,
    process_time: Usual,
    /// What was stored, in the order of the lines.
    stored: Vec<Stored>,
    files: Files,
    /// The results before and after processing, which differ if the plan was edited.
    results: [Files; 2],
    /// What is made of the first lines of the ledger, by their number.
    made: RefCell<BTreeMap<usize, Option<Files>>>,
}

/// How long something takes, which changes with the load of the machine.
struct Usual {
    now: Cell<Duration>,
    at_most: Duration,
}

impl Usual {
    fn new(took: Duration) -> Self {
        Self { now: Cell::new(took), at_most: took }
    }

    /// About one kill in twelve comes after the end.
    fn learn(&self, verdict: &Verdict) {
        let factor = if verdict.within { 1.02 } else { 0.8 };
        self.now.set(self.now.get().mul_f64(factor).min(self.at_most));
    }
}

/// When something is killed.
enum Moment {
    After(Duration),
    /// After a line of the ledger.
    Line(usize, Duration),
}

impl<'a> Reference<'a> {
    pub fn new(kind: &'a Kind) -> Self {
        // In memory: processes are killed here, not the machine, and a disk would only be slower.
        let folder = tempfile::tempdir_in("/dev/shm").unwrap();
        fs::write(folder.path().join("rig.toml"), &kind.rig).unwrap();
        let mut daemon = Daemon::start(folder.path());
        let mut complete = |text: &str| {
            let began = Instant::now();
            let (session, state) = end(&mut daemon, |client| drop(client.run(&plan(text)).unwrap()));
            assert_eq!(state, "complete", "{}", kind.name);
            (session, began.elapsed())
        };
        if let Some(before) = kind.before {
            let (session, _) = complete(before);
            fs::remove_dir_all(session).unwrap();
        }
        let (made, run_time) = complete(kind.plan);
        daemon.kill();
        let session = folder.path().join("reference").join(made.file_name().unwrap());
        copy(&made, &session);
        fs::remove_dir_all(&made).unwrap();
        let (stored, files) = (stored(&session), files_of(&session));
        let made = RefCell::default();
        let [run_time, resume_time, process_time] = [run_time, run_time, Duration::ZERO].map(Usual::new);
        let results = [results_of(&session), Files::new()];
        let new =
            Self { kind, folder, session, run_time, resume_time, process_time, stored, files, results, made };
        let processed = new.to_be_processed();
        let began = Instant::now();
        new.process(&processed).unwrap();
        let process_time = Usual::new(began.elapsed());
        let results = [new.results[0].clone(), results_of(&processed)];
        assert_eq!(results[0] != results[1], kind.edit.is_some(), "{}", kind.name);
        Self { process_time, results, ..new }
    }

    fn data(&self) -> PathBuf {
        self.folder.path().join("sessions")
    }

    /// Up to a little after the end, or after a line of the ledger.
    fn moment(&self, random: &mut Xoshiro256PlusPlus, time: &Usual, lines: usize) -> Moment {
        let share = (random.next_u64() >> 11) as f64 / (1_u64 << 53) as f64;
        match random.next_u64() % 2 {
            1 if lines > 0 => {
                let later = Duration::from_micros(random.next_u64() % 3000);
                Moment::Line(1 + (share * lines as f64) as usize, later)
            }
            _ => Moment::After(time.now.get().mul_f64(share * 1.05)),
        }
    }

    /// Waits for the moment. Returns what the ledger said before it.
    fn wait(&self, moment: &Moment, session: impl Fn() -> Option<PathBuf>) -> String {
        let ledger = || session().and_then(|session| fs::read_to_string(session.join("ledger.jsonl")).ok());
        match moment {
            Moment::After(time) => std::thread::sleep(*time),
            Moment::Line(line, later) => {
                let began = Instant::now();
                while ledger().map_or(0, |ledger| ledger.lines().count()) < *line {
                    assert!(began.elapsed() < HUNG, "no line {line} after {HUNG:?}");
                    std::thread::sleep(Duration::from_micros(200));
                }
                std::thread::sleep(*later);
            }
        }
        ledger().unwrap_or_default()
    }

    /// The session in the data folder, if there is one.
    fn begun(&self) -> Option<PathBuf> {
        let folders = fs::read_dir(self.data()).ok()?.flatten().map(|entry| entry.path());
        folders.filter(|path| path.join("ledger.jsonl").exists()).find(|path| !path.is_symlink())
    }

    /// Kills a run.
    pub fn kill_a_run(&self, random: &mut Xoshiro256PlusPlus) -> (Verdict, String) {
        let lines = fs::read_to_string(self.session.join("ledger.jsonl")).unwrap().lines().count();
        let moment = self.moment(random, &self.run_time, lines);
        let (verdict, when) = self.kill_daemon(&moment, |client| drop(client.run(&plan(self.kind.plan))));
        if let Moment::After(_) = moment {
            self.run_time.learn(&verdict);
        }
        (verdict, when)
    }

    /// Kills a run that resumes a session.
    pub fn kill_a_resumed_run(&self, random: &mut Xoshiro256PlusPlus) -> (Verdict, String) {
        let ledger = fs::read_to_string(self.session.join("ledger.jsonl")).unwrap();
        let lines: Vec<&str> = ledger.split_inclusive('\n').collect();
        let kept = 2 + random.next_u64() as usize % (lines.len() - 2);
        let session = self.data().join(self.session.file_name().unwrap());
        copy(&self.session, &session);
        cut(&session, &lines[..kept].concat());
        let moment = self.moment(random, &self.resume_time, 0);
        let (verdict, when) = self.kill_daemon(&moment, |client| drop(client.resume(&session)));
        self.resume_time.learn(&verdict);
        (verdict, format!("resumed after line {kept}, {when}"))
    }

    fn kill_daemon(&self, moment: &Moment, begin: impl FnOnce(&mut Client) + Send) -> (Verdict, String) {
        let mut daemon = Daemon::start(self.folder.path());
        let mut client = daemon.client();
        let seen = std::thread::scope(|scope| {
            // The request may be answered or not: the daemon is also killed before its answer.
            scope.spawn(move || begin(&mut client));
            let seen = self.wait(moment, || self.begun());
            daemon.kill();
            seen
        });
        (self.judge(&seen), moment.to_string())
    }

    /// Judges the session that a killed daemon has left; `seen` is what its ledger said before.
    fn judge(&self, seen: &str) -> Verdict {
        let mut verdict = Verdict::default();
        let listing = raysweep_session::list(&self.data());
        let unreadable = listing.map(|listing| listing.unreadable).unwrap_or_default();
        verdict
            .unreadable
            .extend(unreadable.iter().map(|(dir, error)| format!("{}: {error}", dir.display())));
        let Some(session) = self.begun() else {
            verdict.within = true;
            if !seen.is_empty() {
                verdict.lost.push("the session".into());
            }
            return verdict;
        };
        verdict.within = !has_ended(&session);
        let ledger = fs::read_to_string(session.join("ledger.jsonl")).unwrap();
        let acknowledged = &seen[..seen.rfind('\n').map_or(0, |end| end + 1)];
        if !ledger.starts_with(acknowledged) {
            verdict.lost.push("lines that were in the ledger before the kill".into());
        }
        if verdict.read(&session) {
            verdict.verify_killed(&session);
            let before = stored(&session);
            match self.kind.is_resumable {
                true => self.judge_resumed(&mut verdict, &session, &before),
                false => self.judge_processed(&mut verdict, &session, &before),
            }
        }
        fs::remove_dir_all(&session).unwrap();
        verdict
    }

    fn judge_resumed(&self, verdict: &mut Verdict, session: &Path, before: &[Stored]) {
        let mut daemon = Daemon::start(self.folder.path());
        let (_, state) = end(&mut daemon, |client| drop(client.resume(session).unwrap()));
        daemon.kill();
        let now = stored(session);
        if state != "complete" {
            verdict.lost.push(format!("resumed, the run ends as {state}"));
        }
        verdict.keeps(before, &now);
        verdict.lost.extend(
            self.stored
                .iter()
                .filter(|point| !now.contains(point))
                .map(|point| format!("not as in the run without a kill: {point:?}")),
        );
        verdict.compare("resumed", &files_of(session), &self.files);
        verdict.verify(session);
    }

    fn judge_processed(&self, verdict: &mut Verdict, session: &Path, before: &[Stored]) {
        verdict.keeps(before, before);
        if !self.stored.starts_with(before) {
            verdict.different.push("what was stored".into());
        }
        let lines = fs::read_to_string(session.join("ledger.jsonl")).unwrap();
        let lines = lines.split_inclusive('\n').filter(|line| line.ends_with('\n')).count();
        let made = self.process(session).map(|()| results_of(session)).ok();
        let mut known = self.made.borrow_mut();
        let expected = known.entry(lines).or_insert_with(|| self.made_of(lines));
        match (made, expected) {
            (Some(mut made), Some(expected)) => {
                // The run itself makes the folder of a film's transports, in which none need be.
                made.retain(|name, _| !name.ends_with("zarr.json") || expected.contains_key(name));
                verdict.compare("processed", &made, expected);
                verdict.verify(session);
            }
            (None, None) => {}
            (made, _) => verdict.different.push(format!("processed: {}", made.is_some())),
        }
    }

    /// What processing makes of the first lines of the reference, if anything.
    fn made_of(&self, lines: usize) -> Option<Files> {
        let session = self.folder.path().join("cut").join(self.session.file_name().unwrap());
        let _ = fs::remove_dir_all(&session);
        copy(&self.session, &session);
        let ledger = fs::read_to_string(session.join("ledger.jsonl")).unwrap();
        cut(&session, &ledger.split_inclusive('\n').take(lines).collect::<String>());
        self.process(&session).map(|()| results_of(&session)).ok()
    }

    fn process(&self, session: &Path) -> Result<(), String> {
        let processed = raysweep(&["process", "--accept-edits"], session);
        processed.status.success().then_some(()).ok_or_else(|| text(&processed))
    }

    /// The complete session with an edited plan.
    fn to_be_processed(&self) -> PathBuf {
        let session = self.folder.path().join("processed").join(self.session.file_name().unwrap());
        let _ = fs::remove_dir_all(&session);
        copy(&self.session, &session);
        if let Some([was, is]) = self.kind.edit {
            fs::write(session.join("plan.toml"), self.kind.plan.replace(was, is)).unwrap();
        }
        session
    }

    /// Kills `raysweep process` of the complete session.
    pub fn kill_processing(&self, random: &mut Xoshiro256PlusPlus) -> (Verdict, String) {
        let session = self.to_be_processed();
        let moment = self.moment(random, &self.process_time, 0);
        let mut processing = command(&["process", "--accept-edits"], &session);
        let mut processing = Process::start(processing.stdout(Stdio::null()).stderr(Stdio::null()));
        self.wait(&moment, || Some(session.clone()));
        let mut verdict = Verdict { within: !processing.has_ended(), ..Verdict::default() };
        self.process_time.learn(&verdict);
        drop(processing);
        verdict.read(&session);
        verdict.keeps(&self.stored, &stored(&session));
        let [old, new] = &self.results;
        let results = results_of(&session);
        for (name, bytes) in &results {
            if old.get(name) != Some(bytes) && new.get(name) != Some(bytes) {
                verdict.different.push(format!("{name} is neither old nor new"));
            }
        }
        // A mixture is told: the plan is not the one that the ledger knows, or files are not those of the manifest.
        let is_told = !raysweep(&["verify"], &session).status.success();
        if &results != old && &results != new && !is_told {
            verdict.different.push("old and new results, and `verify` does not say so".into());
        }
        match self.process(&session) {
            Ok(()) => verdict.compare("processed again", &results_of(&session), new),
            Err(error) => verdict.lost.push(format!("processed again: {error}")),
        }
        verdict.verify(&session);
        (verdict, moment.to_string())
    }
}

/// Leaves a session with these lines of its ledger and without results, as a crash does.
fn cut(session: &Path, lines: &str) {
    fs::write(session.join("ledger.jsonl"), lines).unwrap();
    let results = ["transport.zarr", "transport_film.zarr", "report.html", "manifest.json"];
    let products = fs::read_dir(session.join("products")).unwrap().map(|entry| entry.unwrap().path());
    // A mirror's chirps are records, not results.
    let products = products.filter(|path| !path.to_string_lossy().contains("chirp_"));
    for made in results.map(|result| session.join(result)).into_iter().chain(products) {
        match made.is_dir() {
            true => fs::remove_dir_all(made).unwrap(),
            false if made.exists() => fs::remove_file(made).unwrap(),
            false => {}
        }
    }
}

impl std::fmt::Display for Moment {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::After(time) => write!(f, "{time:?} after its start"),
            Self::Line(line, later) => write!(f, "{later:?} after line {line}"),
        }
    }
}
