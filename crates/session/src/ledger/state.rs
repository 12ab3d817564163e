//! What the entries of a ledger add up to.

use std::collections::BTreeMap;

use raysweep_core::{Counts, FilmSummary};

use super::entry::{AxisEntry, EndEntry, EndState, Entry, PointEntry, Remark, SessionEntry};
use crate::damage::{Damage, DamagedPart};
use crate::dots::BatchEntry;
use crate::film::CycleEntry;
use crate::stack::{ArrayName, Contents};

/// The state that results from the lines of a ledger.
#[derive(Debug, Clone, PartialEq)]
pub struct State {
    /// Description of the session.
    pub session: SessionEntry,
    /// Number of acquisition runs begun.
    pub runs: u32,
    /// How many times in a row, up to the ledger's end, a resumed run stored no point.
    pub barren_resumes: u32,
    /// All frames of all runs, including repeated and failed attempts.
    pub counts: Counts,
    /// How the latest run ended; `None` before the first, while one is running and after a crash.
    pub end: Option<EndEntry>,
    /// Summary of the film, once it is over.
    pub film: Option<FilmSummary>,
    /// Remarks, oldest first.
    pub remarks: Vec<Remark>,
    stored: BTreeMap<(ArrayName, usize), PointEntry>,
    cycles: BTreeMap<usize, CycleEntry>,
    batches: BTreeMap<usize, BatchEntry>,
    axes: BTreeMap<usize, AxisEntry>,
    next_attempts: BTreeMap<(ArrayName, usize), u32>,
    files: BTreeMap<String, String>,
    left_out: Vec<Damage>,
}

impl State {
    /// Computes the state from entries, starting with the ledger's first line.
    ///
    /// # Errors
    /// [`Replay`] names the entry (counted from 0) that contradicts the ones before it.
    pub fn replay<'a>(mut entries: impl Iterator<Item = &'a Entry>) -> Result<State, Replay> {
        let Some(Entry::Session(session)) = entries.next() else {
            return Err(Replay { entry: 0, why: "the first line is not a `session` entry".into() });
        };
        let mut state = State {
            session: session.clone(),
            runs: 0,
            barren_resumes: 0,
            counts: Counts::default(),
            end: None,
            film: None,
            remarks: Vec::new(),
            stored: BTreeMap::new(),
            cycles: BTreeMap::new(),
            batches: BTreeMap::new(),
            axes: BTreeMap::new(),
            next_attempts: BTreeMap::new(),
            files: BTreeMap::new(),
            left_out: Vec::new(),
        };
        for (entry, line) in entries.zip(1..) {
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
            Contents::Sweep { .. } | Contents::Board { .. } | Contents::Patterns { .. } => {
                self.stored(ArrayName::Sum).count()
            }
            Contents::Film { .. } => self.cycles.len(),
            Contents::Batches { .. } => self.batches.len(),
            Contents::Axes { .. } => self.axes.len(),
            Contents::Darks { .. } => self.stored(ArrayName::Dark).count(),
            Contents::Nothing => 0,
        }
    }

    /// Number of points of the plan that are not stored.
    pub fn missing_points(&self) -> usize {
        // Each stored point is one of those planned, see `check`.
        self.session.shape.points() - self.stored_points()
    }

    /// Whether `raysweep resume` would add to what is stored, or end what did not come to its end, by the ledger alone:
    /// damage is not looked for. Also true during its run.
    pub fn can_resume(&self) -> bool {
        let is_over =
            |end: &EndEntry| end.is_final || (end.state == EndState::Complete && self.missing_points() == 0);
        self.session.shape.contents.past().is_none() && !self.end.as_ref().is_some_and(is_over)
    }

    /// SHA-256, hexadecimal, of the files that the session's results depend on, by path with `/` separators; empty in
    /// sessions of format 1.
    pub fn files(&self) -> &BTreeMap<String, String> {
        &self.files
    }

    /// What is damaged, was left out of this state, and was not stored again since.
    pub fn left_out(&self) -> Vec<String> {
        let is_back = |damage: &&Damage| match damage.part {
            DamagedPart::Point { array, index } => self.point(array, index).is_some(),
            _ => false,
        };
        self.left_out.iter().filter(|damage| !is_back(damage)).map(ToString::to_string).collect()
    }

    /// Leaves out damaged data, as if they were not stored. The attempt at a damaged point is made again under the same
    /// number, because it did not fail.
    pub fn leave_out(&mut self, damage: &[Damage]) {
        for damage in damage {
            match damage.part {
                DamagedPart::Point { array, index } => {
                    if let Some(point) = self.stored.remove(&(array, index)) {
                        self.next_attempts.insert((array, index), point.attempt);
                    }
                }
                DamagedPart::Cycle { cycle } => drop(self.cycles.remove(&cycle)),
                DamagedPart::Batch { batch } => drop(self.batches.remove(&batch)),
                DamagedPart::Line { .. }
                | DamagedPart::Input { .. }
                | DamagedPart::Result { .. }
                | DamagedPart::Manifest => {}
            }
            self.left_out.push(damage.clone());
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

    pub(super) fn check(&self, entry: &Entry) -> Result<(), String> {
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
            Entry::Files { .. }
            | Entry::Run { .. }
            | Entry::Film(_)
            | Entry::Outside { .. }
            | Entry::Note(_)
            | Entry::End(_) => Ok(()),
        }
    }

    pub(super) fn apply(&mut self, entry: &Entry) -> Result<(), String> {
        self.check(entry)?;
        match entry {
            Entry::Session(_) => {}
            Entry::Files { sha256 } => self.files.extend(sha256.clone()),
            &Entry::Run { resumed, .. } => {
                self.runs += 1;
                self.barren_resumes = if resumed { self.barren_resumes + 1 } else { 0 };
                self.end = None;
            }
            Entry::Point(point) => {
                self.barren_resumes = 0;
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
            Entry::Note(remark) => self.remarks.push(remark.clone()),
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
