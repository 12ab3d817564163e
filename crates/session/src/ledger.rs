//! The ledger of a session: `ledger.jsonl`, one JSON object per line, append-only.
//!
//! The ledger is the source of truth: a point is stored if and only if the ledger has its line. Each line is
//! appended with one write and made durable before [`Ledger::append`] returns, so a crash can tear only the
//! last line. A torn line is dropped, since its write was never acknowledged.

mod entry;
mod state;

use std::fs::{File, OpenOptions, TryLockError};
use std::io::Write;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use nix::fcntl::OFlag;

use serde::Deserialize;

pub use self::entry::{AxisEntry, EndEntry, EndState, Entry, FORMAT, PointEntry, SessionEntry};
pub use self::state::{Replay, State};
use crate::{Error, Result, input};

/// Length at which a ledger is full: twice that of the longest run, 388,800 batches.
const MOST_BYTES: u64 = 256 << 20;

/// Neither follows a link nor waits for the other end of a pipe.
const NEVER_ELSEWHERE: OFlag = OFlag::O_NOFOLLOW.union(OFlag::O_NONBLOCK);

/// A ledger opened for appending. The file is locked, so only one process can do so at a time.
#[derive(Debug)]
pub struct Ledger {
    path: PathBuf,
    file: File,
    len: u64,
    broken: bool,
    state: State,
}

impl Ledger {
    /// Creates the ledger of a new session with its first line.
    ///
    /// # Errors
    /// [`Error::Io`] if a ledger exists or the file system refuses; [`Error::Entry`] as for
    /// [`Ledger::append`].
    pub fn create(path: &Path, session: SessionEntry) -> Result<Ledger> {
        let first = Entry::Session(session);
        let state = State::replay(std::slice::from_ref(&first)).map_err(refused(path))?;
        let file = OpenOptions::new()
            .append(true)
            .create_new(true)
            .open(path)
            .map_err(Error::io("create ledger", path))?;
        lock(&file, path)?;
        let mut ledger = Ledger { path: path.to_owned(), file, len: 0, broken: false, state };
        ledger.append_line(&first)?;
        if let Some(dir) = path.parent() {
            crate::durable::sync_dir(dir)?;
        }
        Ok(ledger)
    }

    /// Opens a ledger for appending. Truncates a torn last line.
    ///
    /// # Errors
    /// [`Error::InUse`] if another process has it open for appending; otherwise as [`read`].
    pub fn open(path: &Path) -> Result<Ledger> {
        let to_append = OpenOptions::new().read(true).append(true).custom_flags(NEVER_ELSEWHERE.bits()).open(path);
        let file = to_append.map_err(Error::io("open ledger", path))?;
        lock(&file, path)?;
        let text = read_bytes(&file, path)?;
        let (entries, len) = parse(&text, path)?;
        let state = replay(&entries, path)?;
        if len < text.len() as u64 {
            file.set_len(len)
                .and_then(|()| file.sync_all())
                .map_err(Error::io("cut the torn last line off", path))?;
        }
        Ok(Ledger { path: path.to_owned(), file, len, broken: false, state })
    }

    /// The state so far.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Appends a line; when this returns, it is durable. On failure the ledger is unchanged.
    ///
    /// # Errors
    /// [`Error::Entry`] if the entry would not read back unchanged (a number that is not finite) or
    /// contradicts the ones before it (an index outside the plan); [`Error::Io`] if the file system refuses.
    pub fn append(&mut self, entry: &Entry) -> Result<()> {
        self.state.check(entry).map_err(refused(&self.path))?;
        self.append_line(entry)?;
        self.state.apply(entry).map_err(refused(&self.path))
    }

    fn append_line(&mut self, entry: &Entry) -> Result<()> {
        let mut line = serde_json::to_vec(entry).map_err(refused(&self.path))?;
        // JSON has no NaN or infinity: they would be written as `null`, which later readers reject.
        if serde_json::from_slice::<Entry>(&line).ok().as_ref() != Some(entry) {
            return Err(refused(&self.path)("it would not read back unchanged; every number must be finite"));
        }
        if self.broken {
            return Err(refused(&self.path)(
                "an earlier line could not be removed after a failed write; open the session again",
            ));
        }
        line.push(b'\n');
        if self.len + line.len() as u64 > MOST_BYTES {
            return Err(refused(&self.path)("the ledger is full: begin another session"));
        }
        if let Err(error) = self.file.write_all(&line).and_then(|()| self.file.sync_data()) {
            // Half a line followed by another line would damage the ledger permanently.
            self.broken = self.file.set_len(self.len).is_err();
            return Err(Error::io("append to", &self.path)(error));
        }
        self.len += line.len() as u64;
        Ok(())
    }
}

/// Reads a ledger's entries without locking it; a torn last line is left out.
///
/// # Errors
/// [`Error::Io`] if it cannot be read, [`Error::Ledger`] for a corrupt line, [`Error::NewerFormat`] for a
/// newer format.
pub fn read(path: &Path) -> Result<Vec<Entry>> {
    let file = input::open(path, MOST_BYTES).map_err(Error::io("open ledger", path))?;
    let text = read_bytes(&file, path)?;
    Ok(parse(&text, path)?.0)
}

/// Reads a ledger and replays it.
///
/// # Errors
/// As [`read`], and [`Error::Ledger`] if a line contradicts the ones before it.
pub fn read_state(path: &Path) -> Result<State> {
    replay(&read(path)?, path)
}

fn replay(entries: &[Entry], path: &Path) -> Result<State> {
    State::replay(entries).map_err(|Replay { entry, why }| Error::Ledger {
        path: path.to_owned(),
        line: entry + 1,
        why,
    })
}

fn read_bytes(file: &File, path: &Path) -> Result<Vec<u8>> {
    input::read_open(file, MOST_BYTES).map_err(Error::io("read ledger", path))
}

/// The complete entries, and their total length in bytes.
fn parse(text: &[u8], path: &Path) -> Result<(Vec<Entry>, u64)> {
    let mut entries = Vec::new();
    let mut whole = 0;
    for (line, number) in text.split_inclusive(|&byte| byte == b'\n').zip(1..) {
        let is_last = whole + line.len() == text.len();
        let entry = match serde_json::from_slice(line) {
            // A line without its newline was never acknowledged, even if it happens to parse.
            Ok(_) if !line.ends_with(b"\n") => break,
            Ok(entry) => entry,
            // The blocks of the last line may have reached the disk in any order, but what is there is never
            // valid JSON with another meaning.
            Err(_) if is_last && serde_json::from_slice::<serde_json::Value>(line).is_err() => break,
            Err(error) => {
                check_format(line, path)?;
                return Err(Error::Ledger { path: path.to_owned(), line: number, why: error.to_string() });
            }
        };
        if number == 1 {
            check_format(line, path)?;
        }
        whole += line.len();
        entries.push(entry);
    }
    Ok((entries, whole as u64))
}

fn check_format(line: &[u8], path: &Path) -> Result<()> {
    #[derive(Deserialize)]
    struct Format {
        format: u32,
    }
    match serde_json::from_slice(line) {
        Ok(Format { format }) if format > FORMAT => {
            Err(Error::NewerFormat { path: path.to_owned(), found: format, known: FORMAT })
        }
        _ => Ok(()),
    }
}

fn lock(file: &File, path: &Path) -> Result<()> {
    file.try_lock().map_err(|error| match error {
        TryLockError::WouldBlock => Error::InUse { path: path.to_owned() },
        TryLockError::Error(source) => Error::io("lock", path)(source),
    })
}

fn refused<E: ToString>(path: &Path) -> impl FnOnce(E) -> Error {
    move |why| Error::Entry { path: path.to_owned(), why: why.to_string() }
}

#[cfg(test)]
mod tests;
