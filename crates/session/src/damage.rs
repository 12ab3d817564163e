//! What can be damaged in a session.

use std::fmt;

use serde::Serialize;

use crate::stack::ArrayName;

/// A part of a session that can be damaged by itself.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(tag = "part", rename_all = "snake_case")]
pub enum DamagedPart {
    /// A line of the ledger, counted from 1.
    Line {
        /// Its number.
        line: usize,
    },
    /// A point of the stack.
    Point {
        /// Its array.
        array: ArrayName,
        /// Its index in that array.
        index: usize,
    },
    /// A cycle of a film.
    Cycle {
        /// Counted from 0.
        cycle: usize,
    },
    /// A batch of a flying dot.
    Batch {
        /// Counted from 0.
        batch: usize,
    },
    /// A file that results depend on.
    Input {
        /// Its path in the session, with `/` separators.
        file: String,
    },
    /// A file that can be made again from the others.
    Result {
        /// Its path in the session, with `/` separators.
        file: String,
    },
    /// The manifest: it does not say what the results should be.
    Manifest,
}

/// A damaged part.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Damage {
    /// The part.
    #[serde(flatten)]
    pub part: DamagedPart,
    /// What is wrong with it.
    pub why: String,
}

impl fmt::Display for Damage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match &self.part {
            DamagedPart::Line { line } => write!(f, "line {line} of ledger.jsonl")?,
            DamagedPart::Point { array, index } => write!(f, "{} {index}", array.as_str())?,
            DamagedPart::Cycle { cycle } => write!(f, "cycle {cycle}")?,
            DamagedPart::Batch { batch } => write!(f, "batch {batch}")?,
            DamagedPart::Input { file } | DamagedPart::Result { file } => f.write_str(file)?,
            DamagedPart::Manifest => f.write_str("manifest.json")?,
        }
        write!(f, " is damaged ({})", self.why)
    }
}

impl Damage {
    /// Whether results that are made now would lack something, or could be wrong.
    pub fn is_of_results_only(&self) -> bool {
        matches!(self.part, DamagedPart::Result { .. })
    }
}
