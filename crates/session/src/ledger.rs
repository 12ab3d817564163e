//! The ledger of a session: `ledger.jsonl`, one JSON object per line, append-only.
//!
//! The ledger is the source of truth: a point is stored if and only if the ledger has its line. Each line is
//! appended with one write and made durable before [`Ledger::append`] returns, so a crash can tear only the
//! last line. A torn line is dropped, since its write was never acknowledged.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Read, Write};
use std::path::{Path, PathBuf};

use jiff::Timestamp;
use raysweep_core::{Counts, FilmSummary, SettingsLatency, VsyncStats};
use serde::{Deserialize, Serialize};

use crate::dots::BatchEntry;
use crate::film::CycleEntry;
use crate::stack::{ArrayName, Contents, StackShape};
use crate::{Error, Result};

/// The format of the session folder that this version writes.
pub const FORMAT: u32 = 1;

/// One line of the ledger; the key `event` tells the kinds apart.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Entry {
    /// The first line, and only the first: describes the session.
    Session(SessionEntry),
    /// An acquisition run begins.
    Run {
        /// Wall-clock time, UTC.
        started: Timestamp,
        /// Whether it acquires what an earlier run left missing.
        resumed: bool,
    },
    /// A point's data are durable in the stack. A later line for the same point replaces the earlier one.
    Point(PointEntry),
    /// An attempt at a point failed.
    AttemptFailed {
        /// The array of the stack.
        array: ArrayName,
        /// The point's index in that array.
        index: usize,
        /// Counted from 0.
        attempt: u32,
        /// What became of the attempt's frames.
        counts: Counts,
    },
    /// An attempt at a point was interrupted through no fault of its own; it is repeated with the same
    /// number.
    AttemptInterrupted {
        /// The array of the stack.
        array: ArrayName,
        /// The point's index in that array.
        index: usize,
        /// Counted from 0.
        attempt: u32,
        /// What became of the attempt's frames.
        counts: Counts,
    },
    /// A point is stored, but a processing stage failed on it: the results of this run lack it.
    StageFailed {
        /// The array of the stack.
        array: ArrayName,
        /// The point's index in that array.
        index: usize,
        /// Counted from 0.
        attempt: u32,
        /// The stage and its error.
        error: String,
    },
    /// A cycle of a film is durable in `film.zarr`.
    Cycle(CycleEntry),
    /// A cycle of a film lacks frames and is not stored; a film does not repeat frames.
    CycleLost {
        /// Counted from 0.
        cycle: usize,
        /// The settings without a usable frame.
        missing: Vec<usize>,
        /// What became of the cycle's frames.
        counts: Counts,
    },
    /// A batch of a flying dot is durable in `dots.zarr`.
    Batch(BatchEntry),
    /// A batch lacks too many frames or could not be written, and is not stored; it is not repeated.
    BatchLost {
        /// Counted from 0.
        batch: usize,
        /// What became of the batch's frames.
        counts: Counts,
    },
    /// The record of a mirror axis during its chirp is durable in `products`.
    Axis(AxisEntry),
    /// A film has ended; its cycles have lines of their own.
    Film(FilmSummary),
    /// Frames outside any point: drained, during a pause, or after a cancel.
    Outside {
        /// What became of these frames.
        counts: Counts,
    },
    /// An acquisition run has ended.
    End(EndEntry),
}

/// Description of a session.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SessionEntry {
    /// Format version, [`FORMAT`].
    pub format: u32,
    /// The name as given, before it was adapted for the folder's name.
    pub name: String,
    /// The plan's kind, for example `sweep`.
    pub kind: String,
    /// Who ran it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub operator: Option<String>,
    /// What was in front of the camera.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub sample: Option<String>,
    /// Free text.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
    /// Labels for finding the session.
    #[serde(default)]
    pub tags: Vec<String>,
    /// Creation time, UTC.
    pub created: Timestamp,
    /// Name and version of the software.
    pub software: String,
    /// The arrays of the stack; `shape.points` is the number of planned points.
    pub shape: StackShape,
    /// Projector row that camera row 0 sees.
    pub first_row: usize,
}

/// A stored point.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PointEntry {
    /// The array of the stack.
    pub array: ArrayName,
    /// The point's index in that array: for `sum`, `exposure_index * delays + delay_index`; for `dark`,
    /// `exposure_index`.
    pub index: usize,
    /// Attempt, counted from 0.
    pub attempt: u32,
    /// Frames summed.
    pub frames: u32,
    /// The exposure time that the camera applied, in us.
    pub exposure_us: f64,
    /// The requested and applied delay in us (centre of exposure minus centre of illumination).
    pub delay_us: f64,
    /// The true delay of each summed frame in us, from its exposure start and its VSYNC edge; empty for dark
    /// and regular frames, for which delays are meaningless.
    pub delays_us: Vec<f64>,
    /// What became of the attempt's frames.
    pub counts: Counts,
    /// CRC-32 of the stored data, see [`crate::stack::crc32`].
    pub crc32: u32,
}

impl PointEntry {
    /// The mean of the true delays, if there are any.
    pub fn mean_delay_us(&self) -> Option<f64> {
        let frames = self.delays_us.len();
        (frames > 0).then(|| self.delays_us.iter().sum::<f64>() / frames as f64)
    }
}

/// The stored record of a mirror axis.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct AxisEntry {
    /// 0: x, 1: y.
    pub axis: usize,
    /// Frames of the record, which covers the axis's chirp.
    pub frames: usize,
    /// Frames of these that were lost.
    pub lost: usize,
    /// Frames of these that arrived but show no dot.
    pub empty: usize,
    /// What became of its triggers.
    pub counts: Counts,
}

/// How an acquisition run ended.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EndEntry {
    /// Final state.
    pub state: EndState,
    /// Why it faulted.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
    /// Sweep points stored by now.
    pub stored: usize,
    /// Sweep points planned and not stored.
    pub missing: usize,
    /// Statistics of the VSYNC line during the run, if it was watched.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub vsync: Option<VsyncStats>,
    /// Seconds from the end of the last frame's exposure to the transport on disk, if the run had both.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub final_s: Option<f64>,
    /// Seconds from the first frame with light to the end of the last, without the probe and the dark points.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub light_s: Option<f64>,
    /// Latency of the camera's settings, if a probe measured it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub settings_latency: Option<SettingsLatency>,
}

/// Final state of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EndState {
    /// Everything planned is stored.
    Complete,
    /// The operator ended it.
    Cancelled,
    /// A device or the disk failed.
    Faulted,
}

impl EndState {
    /// The state in a word, as reports and messages call it.
    pub fn name(self) -> &'static str {
        match self {
            Self::Complete => "complete",
            Self::Cancelled => "cancelled",
            Self::Faulted => "faulted",
        }
    }
}

/// The state that results from the lines of a ledger.
#[derive(Debug, Clone, PartialEq)]
pub struct State {
    /// Description of the session.
    pub session: SessionEntry,
    /// Number of acquisition runs begun.
    pub runs: u32,
    /// All frames of all runs, including repeated and failed attempts.
    pub counts: Counts,
    /// How the latest run ended; `None` before the first, while one is running and after a crash.
    pub end: Option<EndEntry>,
    /// Summary of the film, once it is over.
    pub film: Option<FilmSummary>,
    stored: BTreeMap<(ArrayName, usize), PointEntry>,
    cycles: BTreeMap<usize, CycleEntry>,
    batches: BTreeMap<usize, BatchEntry>,
    axes: BTreeMap<usize, AxisEntry>,
    next_attempts: BTreeMap<(ArrayName, usize), u32>,
}

impl State {
    /// Computes the state from entries, starting with the ledger's first line.
    ///
    /// # Errors
    /// [`Replay`] names the entry (counted from 0) that contradicts the ones before it.
    pub fn replay(entries: &[Entry]) -> std::result::Result<State, Replay> {
        let Some((Entry::Session(session), rest)) = entries.split_first() else {
            return Err(Replay { entry: 0, why: "the first line is not a `session` entry".into() });
        };
        let mut state = State {
            session: session.clone(),
            runs: 0,
            counts: Counts::default(),
            end: None,
            film: None,
            stored: BTreeMap::new(),
            cycles: BTreeMap::new(),
            batches: BTreeMap::new(),
            axes: BTreeMap::new(),
            next_attempts: BTreeMap::new(),
        };
        for (entry, line) in rest.iter().zip(1..) {
            state.apply(entry).map_err(|why| Replay { entry: line, why })?;
        }
        Ok(state)
    }

    /// The stored points of an array, by index; for repeated points the latest entry.
    pub fn stored(&self, array: ArrayName) -> impl Iterator<Item = &PointEntry> {
        self.stored.range((array, 0)..=(array, usize::MAX)).map(|(_, point)| point)
    }

    /// The stored cycles of a film, in order.
    pub fn cycles(&self) -> impl Iterator<Item = &CycleEntry> {
        self.cycles.values()
    }

    /// The stored batches of a flying dot, in order.
    pub fn batches(&self) -> impl Iterator<Item = &BatchEntry> {
        self.batches.values()
    }

    /// The stored records of a mirror's axes, x first.
    pub fn axes(&self) -> impl Iterator<Item = &AxisEntry> {
        self.axes.values()
    }

    /// Number of stored points of the plan, which are what [`Contents`] says.
    pub fn stored_points(&self) -> usize {
        match self.session.shape.contents {
            Contents::Sweep { .. } => self.stored(ArrayName::Sum).count(),
            Contents::Film { .. } => self.cycles.len(),
            Contents::Batches { .. } => self.batches.len(),
            Contents::Axes { .. } => self.axes.len(),
            Contents::Darks { .. } => self.stored(ArrayName::Dark).count(),
        }
    }

    /// A point, if it is stored.
    pub fn point(&self, array: ArrayName, index: usize) -> Option<&PointEntry> {
        self.stored.get(&(array, index))
    }

    /// The planned indices of an array that are not stored, ascending.
    pub fn missing(&self, array: ArrayName) -> impl Iterator<Item = usize> {
        (0..self.session.shape.len(array)).filter(move |&index| self.point(array, index).is_none())
    }

    /// The number of the next attempt at a point. Numbers of stored or failed attempts are never reused;
    /// those of attempts that were interrupted, or cut short by a crash, are.
    pub fn next_attempt(&self, array: ArrayName, index: usize) -> u32 {
        self.next_attempts.get(&(array, index)).copied().unwrap_or(0)
    }

    fn check(&self, entry: &Entry) -> std::result::Result<(), String> {
        match entry {
            Entry::Session(_) => Err("a `session` entry may only be the first line".into()),
            Entry::Point(PointEntry { array, index, .. })
            | Entry::AttemptFailed { array, index, .. }
            | Entry::AttemptInterrupted { array, index, .. }
            | Entry::StageFailed { array, index, .. } => {
                let len = self.session.shape.len(*array);
                if *index < len {
                    Ok(())
                } else {
                    Err(format!(
                        "index {index} is outside of array `{}`, which has {len} points",
                        array.as_str()
                    ))
                }
            }
            Entry::Cycle(CycleEntry { cycle, .. }) | Entry::CycleLost { cycle, .. } => {
                let cycles = match self.session.shape.contents {
                    Contents::Film { cycles, .. } => cycles,
                    _ => 0,
                };
                if *cycle < cycles {
                    Ok(())
                } else {
                    Err(format!("cycle {cycle} is outside of the film, which has {cycles} cycles"))
                }
            }
            Entry::Batch(BatchEntry { batch, .. }) | Entry::BatchLost { batch, .. } => {
                let batches = match self.session.shape.contents {
                    Contents::Batches { batches, .. } => batches,
                    _ => 0,
                };
                if *batch < batches {
                    Ok(())
                } else {
                    Err(format!("batch {batch} is outside of the plan, which has {batches} batches"))
                }
            }
            Entry::Axis(AxisEntry { axis, .. }) => {
                let axes = match self.session.shape.contents {
                    Contents::Axes { axes } => axes,
                    _ => 0,
                };
                if *axis < axes {
                    Ok(())
                } else {
                    Err(format!("axis {axis} is outside of the plan, which has {axes} axes"))
                }
            }
            Entry::Run { .. } | Entry::Film(_) | Entry::Outside { .. } | Entry::End(_) => Ok(()),
        }
    }

    fn apply(&mut self, entry: &Entry) -> std::result::Result<(), String> {
        self.check(entry)?;
        match entry {
            Entry::Session(_) => {}
            Entry::Run { .. } => {
                self.runs += 1;
                self.end = None;
            }
            Entry::Point(point) => {
                self.counts.add(&point.counts);
                self.note_attempt(point.array, point.index, point.attempt);
                self.stored.insert((point.array, point.index), point.clone());
            }
            Entry::AttemptFailed { array, index, attempt, counts } => {
                self.counts.add(counts);
                self.note_attempt(*array, *index, *attempt);
            }
            Entry::Cycle(cycle) => {
                self.counts.add(&cycle.counts);
                self.cycles.insert(cycle.cycle, cycle.clone());
            }
            Entry::Batch(batch) => {
                self.counts.add(&batch.counts);
                self.batches.insert(batch.batch, batch.clone());
            }
            Entry::Axis(axis) => {
                self.counts.add(&axis.counts);
                self.axes.insert(axis.axis, axis.clone());
            }
            Entry::CycleLost { counts, .. } | Entry::BatchLost { counts, .. } => self.counts.add(counts),
            Entry::Film(film) => self.film = Some(film.clone()),
            Entry::Outside { counts } | Entry::AttemptInterrupted { counts, .. } => self.counts.add(counts),
            Entry::StageFailed { .. } => {}
            Entry::End(end) => self.end = Some(end.clone()),
        }
        Ok(())
    }

    fn note_attempt(&mut self, array: ArrayName, index: usize, attempt: u32) {
        let next = self.next_attempts.entry((array, index)).or_default();
        *next = (*next).max(attempt.saturating_add(1));
    }
}

/// An entry that contradicts the ones before it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("entry {entry}: {why}")]
pub struct Replay {
    /// Index of the entry, counted from 0.
    pub entry: usize,
    /// What is wrong.
    pub why: String,
}

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
        let file =
            OpenOptions::new().read(true).append(true).open(path).map_err(Error::io("open ledger", path))?;
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
    let file = File::open(path).map_err(Error::io("open ledger", path))?;
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

fn read_bytes(mut file: &File, path: &Path) -> Result<Vec<u8>> {
    let mut text = Vec::new();
    file.read_to_end(&mut text).map_err(Error::io("read ledger", path))?;
    Ok(text)
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
