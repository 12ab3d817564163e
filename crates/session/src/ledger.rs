//! The ledger of a session: `ledger.jsonl`, one JSON object per line, append-only.
//!
//! The ledger is the source of truth: a point is stored if and only if the ledger has its line. Each line is
//! appended with one write and made durable before [`Ledger::append`] returns, so a crash can tear only the
//! last line. A torn line is dropped, since its write was never acknowledged. Each line has a checksum of itself and
//! its predecessor, so no other damage goes unnoticed. The first lines appear together, so a ledger is never empty.

mod chain;
mod entry;
mod state;

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use nix::errno::Errno;
use nix::fcntl::{Flock, FlockArg, OFlag};
use serde::Deserialize;

use self::chain::{Chain, Fit};
pub use self::entry::{
    AxisEntry, EndEntry, EndState, Entry, FORMAT, FrameStarts, PointEntry, Remark, SessionEntry,
};
pub use self::state::{Replay, State};
use crate::damage::Damage;
use crate::durable::DraftFile;
use crate::{Error, Result, input};

/// Length at which a ledger is full: an estimate of twice what the longest run writes, 388,800 batches.
const MOST_BYTES: u64 = 256 << 20;

/// Neither follows a link nor waits for the other end of a pipe.
const NEVER_ELSEWHERE: OFlag = OFlag::O_NOFOLLOW.union(OFlag::O_NONBLOCK);

/// A ledger opened for appending. The file is locked, so only one process can do so at a time.
#[derive(Debug)]
pub struct Ledger {
    path: PathBuf,
    /// Released on drop, not when the last copy of its descriptor is closed: a process that another thread is starting
    /// has one for a moment.
    file: Flock<File>,
    len: u64,
    /// Whether an earlier line is damaged.
    broken: bool,
    /// Whether a part of a line that could not be written may follow the last line.
    torn: bool,
    chain: Chain,
    state: State,
}

/// What a ledger says, as far as it can be read.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LedgerText {
    /// The sound entries, each with the number of its line, counted from 1.
    pub entries: Vec<(usize, Entry)>,
    /// The damaged lines, and what is wrong with them.
    pub damaged: Vec<(usize, String)>,
    /// Bytes of a torn last line, which is none of them.
    pub torn_bytes: usize,
}

impl LedgerText {
    /// Reads a ledger without locking it.
    ///
    /// # Errors
    /// [`Error::Io`] if it cannot be read, [`Error::NewerFormat`] for a newer format.
    pub fn read(path: &Path) -> Result<Self> {
        let file = input::open(path, MOST_BYTES).map_err(Error::io("open ledger", path))?;
        Ok(parse(&read_bytes(&file, path)?, path)?.0)
    }

    /// The state that the sound entries result in.
    ///
    /// # Errors
    /// [`Error::Ledger`] if a line contradicts the ones before it, [`Error::Torn`] without a first line.
    pub fn replay(&self, path: &Path) -> Result<State> {
        if self.entries.is_empty() && self.damaged.is_empty() {
            return Err(Error::Torn { path: path.to_owned() });
        }
        if let Some((line @ 1, why)) = self.damaged.first().cloned() {
            return Err(Error::Ledger { path: path.to_owned(), line, why });
        }
        State::replay(self.entries.iter().map(|(_, entry)| entry)).map_err(|Replay { entry, why }| {
            let line = self.entries.get(entry).map_or(1, |(line, _)| *line);
            Error::Ledger { path: path.to_owned(), line, why }
        })
    }

    /// The entries and their state, if no line is damaged.
    fn whole(self, path: &Path) -> Result<(Vec<Entry>, State)> {
        if let Some((line, why)) = self.damaged.first().cloned() {
            return Err(Error::Ledger { path: path.to_owned(), line, why });
        }
        let state = self.replay(path)?;
        Ok((self.entries.into_iter().map(|(_, entry)| entry).collect(), state))
    }
}

impl Ledger {
    /// Creates the ledger of a new session with its first lines: the session, and the SHA-256 of the `files` that
    /// belong to it, if there are any. The ledger appears with these lines or not at all.
    ///
    /// # Errors
    /// [`Error::Io`] if a ledger exists or the file system refuses; [`Error::Entry`] as for
    /// [`Ledger::append`].
    pub fn create(path: &Path, session: SessionEntry, files: BTreeMap<String, String>) -> Result<Ledger> {
        if path.exists() {
            return Err(Error::io("create ledger", path)(io::ErrorKind::AlreadyExists.into()));
        }
        let files = (!files.is_empty()).then_some(Entry::Files { sha256: files });
        let draft = DraftFile::create(path)?;
        let file = OpenOptions::new()
            .append(true)
            .open(draft.path())
            .map_err(Error::io("create ledger", draft.path()))?;
        let file = lock(file, path)?;
        let first = Entry::Session(session);
        let state = State::replay(std::iter::once(&first)).map_err(refused(path))?;
        let mut ledger = Ledger {
            path: path.to_owned(),
            file,
            len: 0,
            broken: false,
            torn: false,
            chain: Chain::new(),
            state,
        };
        ledger.append_line(&first)?;
        files.iter().try_for_each(|files| ledger.append(files))?;
        draft.commit()?;
        Ok(ledger)
    }

    /// Opens a ledger for appending. Truncates a torn last line.
    ///
    /// # Errors
    /// [`Error::InUse`] if another process has it open for appending; otherwise as [`read`].
    pub fn open(path: &Path) -> Result<Ledger> {
        let (ledger, text) = Ledger::open_damaged(path)?;
        text.whole(path)?;
        Ok(ledger)
    }

    /// Opens a ledger as far as it can be read, with what it says. If a line is damaged, nothing can be appended.
    ///
    /// # Errors
    /// [`Error::InUse`] if another process has it open for appending; otherwise as [`LedgerText::read`] and
    /// [`LedgerText::replay`].
    pub fn open_damaged(path: &Path) -> Result<(Ledger, LedgerText)> {
        let file = hold(path)?;
        let bytes = read_bytes(&file, path)?;
        let (text, chain) = parse(&bytes, path)?;
        let state = text.replay(path)?;
        let len = (bytes.len() - text.torn_bytes) as u64;
        let broken = !text.damaged.is_empty();
        if text.torn_bytes > 0 && !broken {
            file.set_len(len)
                .and_then(|()| file.sync_all())
                .map_err(Error::io("cut the torn last line off", path))?;
        }
        Ok((Ledger { path: path.to_owned(), file, len, broken, torn: false, chain, state }, text))
    }

    /// The state so far.
    pub fn state(&self) -> &State {
        &self.state
    }

    /// Takes damaged data for not stored, so that they are acquired again. The file is unchanged: a later line replaces
    /// the one of the damaged data.
    pub fn leave_out(&mut self, damage: &[Damage]) {
        self.state.leave_out(damage);
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
            return Err(refused(&self.path)("an earlier line is damaged; open the session again"));
        }
        // The closing brace follows the checksum.
        line.pop();
        let line = self.chain.seal(line);
        if self.len + line.len() as u64 > MOST_BYTES {
            return Err(refused(&self.path)("the ledger is full: begin another session"));
        }
        self.cut_torn().map_err(Error::io("append to", &self.path))?;
        if let Err(error) = self.file.write_all(&line).and_then(|()| self.file.sync_data()) {
            self.torn = true;
            // If this fails too, the next append begins with it.
            let _ = self.cut_torn();
            return Err(Error::io("append to", &self.path)(error));
        }
        self.len += line.len() as u64;
        self.chain.follow(&line);
        Ok(())
    }

    /// Removes what a failed write has left. Half a line followed by another one would damage the ledger permanently.
    fn cut_torn(&mut self) -> io::Result<()> {
        if self.torn {
            self.file.set_len(self.len)?;
            self.torn = false;
        }
        Ok(())
    }
}

/// Reads a ledger's entries without locking it; a torn last line is left out.
///
/// # Errors
/// [`Error::Io`] if it cannot be read, [`Error::Ledger`] for a damaged line, or one that contradicts the ones before it,
/// [`Error::Torn`] without a first line, [`Error::NewerFormat`] for a newer format.
pub fn read(path: &Path) -> Result<Vec<Entry>> {
    Ok(LedgerText::read(path)?.whole(path)?.0)
}

/// Reads a ledger and replays it.
///
/// # Errors
/// As [`read`].
pub fn read_state(path: &Path) -> Result<State> {
    Ok(LedgerText::read(path)?.whole(path)?.1)
}

fn read_bytes(file: &File, path: &Path) -> Result<Vec<u8>> {
    input::read_open(file, MOST_BYTES).map_err(Error::io("read ledger", path))
}

/// What a ledger's bytes say, and the chain that its next line continues.
fn parse(bytes: &[u8], path: &Path) -> Result<(LedgerText, Chain)> {
    let (mut text, mut chain) = (LedgerText::default(), Chain::new());
    let mut format = 1;
    let mut whole_bytes = 0;
    for (line, number) in bytes.split_inclusive(|&byte| byte == b'\n').zip(1..) {
        if whole_bytes + line.len() == bytes.len() && is_torn(line) {
            break;
        }
        whole_bytes += line.len();
        let fit = chain.follow(line);
        let is_chained = fit == Fit::Fits || (fit == Fit::Unchained && format < FORMAT);
        match serde_json::from_slice::<Entry>(line) {
            Ok(Entry::Session(session)) if number == 1 && session.format > FORMAT => {
                check_format(line, path)?;
            }
            Ok(Entry::Session(session)) if number == 1 && fit != Fit::Broken => {
                format = session.format;
                match fit == Fit::Fits || format < FORMAT {
                    true => text.entries.push((number, Entry::Session(session))),
                    false => text.damaged.push((number, UNCHAINED.into())),
                }
            }
            Ok(entry) if is_chained => text.entries.push((number, entry)),
            Ok(_) => {
                let why = if chain::sealed(line).is_some() { MISFIT } else { UNCHAINED };
                text.damaged.push((number, why.into()));
            }
            Err(error) => {
                check_format(line, path)?;
                text.damaged.push((number, error.to_string()));
            }
        }
    }
    text.torn_bytes = bytes.len() - whole_bytes;
    Ok((text, chain))
}

const MISFIT: &str = "its checksum does not fit it and the line before it";
const UNCHAINED: &str = "it has no checksum, which all lines of this ledger have";

/// Whether a last line was never acknowledged. Its blocks may have reached the disk in any order, but what is there is
/// never valid JSON with another meaning. A line that ends as lines do, and has no hole, was whole once.
fn is_torn(line: &[u8]) -> bool {
    let was_whole = chain::sealed(line).is_some() && !line.contains(&0);
    !line.ends_with(b"\n") || (!was_whole && serde_json::from_slice::<serde_json::Value>(line).is_err())
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

/// Opens a ledger for appending, whatever it says; while it is held, no other process does so.
///
/// # Errors
/// [`Error::InUse`] if another process holds it, [`Error::Io`] if it cannot be opened.
pub(crate) fn hold(path: &Path) -> Result<Flock<File>> {
    let to_append =
        OpenOptions::new().read(true).append(true).custom_flags(NEVER_ELSEWHERE.bits()).open(path);
    lock(to_append.map_err(Error::io("open ledger", path))?, path)
}

fn lock(file: File, path: &Path) -> Result<Flock<File>> {
    Flock::lock(file, FlockArg::LockExclusiveNonblock).map_err(|(_, errno)| match errno {
        Errno::EWOULDBLOCK => Error::InUse { path: path.to_owned() },
        errno => Error::io("lock", path)(errno.into()),
    })
}

fn refused<E: ToString>(path: &Path) -> impl FnOnce(E) -> Error {
    move |why| Error::Entry { path: path.to_owned(), why: why.to_string() }
}

#[cfg(test)]
mod tests;
