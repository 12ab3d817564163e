//! What is wrong with a session after a kill.

use std::collections::BTreeMap;
use std::fs;
use std::path::Path;
use std::process::{Command, Output};

use raysweep_core::Counts;
use raysweep_session::Session;
use raysweep_session::ledger::{self, Entry, PointEntry};

/// Files of a folder, by their paths in it.
pub type Files = BTreeMap<String, Vec<u8>>;

/// What is wrong after one kill, by its kind.
#[derive(Debug, Default)]
pub struct Verdict {
    /// Whether the kill came before the end of what was killed.
    pub within: bool,
    pub unreadable: Vec<String>,
    pub lost: Vec<String>,
    pub double: Vec<String>,
    pub different: Vec<String>,
}

impl Verdict {
    /// Whether a session that was just killed is readable: by the library, and by the command line.
    pub fn read(&mut self, session: &Path) -> bool {
        if let Err(error) = Session::open(session).and_then(|session| session.state()) {
            self.unreadable.push(error.to_string());
            return false;
        }
        let shown = raysweep(&["show"], session);
        if !shown.status.success() {
            self.unreadable.push(format!("show: {}", text(&shown)));
        }
        true
    }

    /// Whether all that is acknowledged is sound.
    pub fn verify(&mut self, session: &Path) {
        let verified = raysweep(&["verify"], session);
        if !verified.status.success() {
            self.lost.push(format!("verify: {}", text(&verified)));
        }
    }

    /// The same after a kill, when the results of a run that has stored everything may still be missing.
    pub fn verify_killed(&mut self, session: &Path) {
        let verified = text(&raysweep(&["verify"], session));
        let lacks_results_only = verified.contains("manifest.json is damaged (it is missing")
            && verified.contains("1 damaged: results alone");
        if !lacks_results_only {
            self.verify(session);
        }
    }

    /// Compares what is stored now with what was stored at the kill: nothing is away or stored a second time.
    pub fn keeps(&mut self, before: &[Stored], now: &[Stored]) {
        for stored in before.iter().filter(|stored| !now.contains(stored)) {
            self.lost.push(format!("{stored:?}"));
        }
        let mut known = BTreeMap::<_, usize>::new();
        for stored in now {
            *known.entry((&stored.what, stored.index)).or_default() += 1;
        }
        self.double.extend(known.iter().filter(|(_, times)| **times > 1).map(|(of, _)| format!("{of:?}")));
    }

    /// Compares files, where those of `expected` are the ones that count.
    pub fn compare(&mut self, what: &str, found: &Files, expected: &Files) {
        for (name, bytes) in expected {
            match found.get(name) {
                Some(found) if found == bytes => {}
                Some(_) => self.different.push(format!("{what}: {name}")),
                None => self.different.push(format!("{what}: {name} is missing")),
            }
        }
        let more = found.keys().filter(|name| !expected.contains_key(*name));
        self.different.extend(more.map(|name| format!("{what}: {name} is more")));
    }
}

/// What a line of the ledger says is stored.
#[derive(Debug, Clone, PartialEq)]
pub struct Stored {
    what: String,
    index: usize,
    /// Settings, delays and checksum. The fate of frames that still had the previous settings, and the times of all
    /// frames, belong to the run's history.
    content: String,
}

/// What is stored, in the order of the ledger's lines.
pub fn stored(session: &Path) -> Vec<Stored> {
    let text = |entry: serde_json::Value| entry.to_string();
    let of = |entry: Entry| match entry {
        Entry::Point(point) => {
            let (what, index) = (format!("{:?}", point.array), point.index);
            let point = PointEntry { counts: Counts::default(), exposed: None, ..point };
            Some(Stored { what, index, content: text(serde_json::to_value(point).unwrap()) })
        }
        Entry::Cycle(cycle) => {
            let content = format!("{:?} {}", cycle.delays_us, cycle.crc32);
            Some(Stored { what: "cycle".into(), index: cycle.cycle, content })
        }
        Entry::Batch(batch) => {
            let content = format!("{:?} {:?} {}", batch.plane, batch.missing, batch.crc32);
            Some(Stored { what: "batch".into(), index: batch.batch, content })
        }
        Entry::Axis(axis) => {
            let content = format!("{} {} {}", axis.frames, axis.lost, axis.empty);
            Some(Stored { what: "axis".into(), index: axis.axis, content })
        }
        _ => None,
    };
    ledger::read(&session.join("ledger.jsonl")).unwrap().into_iter().filter_map(of).collect()
}

/// Whether the latest run of a session has ended.
pub fn has_ended(session: &Path) -> bool {
    Session::open(session).and_then(|session| session.state()).is_ok_and(|state| state.end.is_some())
}

/// A command that needs no daemon.
pub fn raysweep(arguments: &[&str], session: &Path) -> Output {
    command(arguments, session).output().unwrap()
}

pub fn command(arguments: &[&str], session: &Path) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_raysweep"));
    // Without video encoders, whose files differ from time to time, and with other threads than the daemon's.
    command.args(arguments).arg(session).env("PATH", "/nonexistent").env("RAYON_NUM_THREADS", "3");
    command
}

pub fn text(output: &Output) -> String {
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    format!("{} {}{}", output.status, text(&output.stdout), text(&output.stderr))
}

/// All files of a folder but those that tell of times and those that a crash leaves behind.
pub fn files_of(folder: &Path) -> Files {
    let timed = ["ledger.jsonl", "report.html", "manifest.json", "calibration.toml"];
    let mut files = Files::new();
    let mut folders = vec![folder.to_owned()];
    while let Some(inner) = folders.pop() {
        for path in fs::read_dir(inner).unwrap().map(|entry| entry.unwrap().path()) {
            let name = path.strip_prefix(folder).unwrap().display().to_string();
            if name.contains(".raysweep-tmp") || timed.contains(&name.as_str()) {
                continue;
            } else if path.is_dir() {
                folders.push(path);
            } else {
                files.insert(name, fs::read(&path).unwrap());
            }
        }
    }
    files
}

/// Those of the files that are made from the data.
pub fn results_of(folder: &Path) -> Files {
    let mut files = files_of(folder);
    let results = ["products/", "transport", "calibration.npz"];
    files.retain(|name, _| results.iter().any(|result| name.starts_with(result)));
    files
}

pub fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap().map(Result::unwrap) {
        let (from, to) = (entry.path(), to.join(entry.file_name()));
        match from.is_dir() {
            true => copy(&from, &to),
            false => fs::write(&to, fs::read(&from).unwrap()).unwrap(),
        }
    }
}
