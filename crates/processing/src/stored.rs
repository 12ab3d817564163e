//! A stored session that is being processed, and the results.

use std::path::{Path, PathBuf};

use raysweep_config::{ConfigError, DotRigFile, Plan, RigFile};
use raysweep_core::{Size, io_text};
use raysweep_session::Session;
use raysweep_session::ledger::State;
use raysweep_session::stack::Contents;

use crate::calibration::KeptCalibration;
use crate::plane::{KnownRig, PlaneTask};

/// Why a session cannot be processed.
#[derive(Debug, thiserror::Error)]
pub enum ProcessError {
    /// The session cannot be read or written.
    #[error(transparent)]
    Session(#[from] raysweep_session::Error),
    /// Something of it is damaged.
    #[error(
        "{} is damaged, so nothing was made, and its results are as they were:{}\n{}`raysweep resume` acquires damaged points again (not those of films and batches, whose moment is over), a backup may have the files, and --accept-damage goes on without what is damaged",
        dir.display(), listed(damage), if *is_edited { EDITED } else { "" }
    )]
    Damaged {
        /// The session.
        dir: PathBuf,
        /// What is damaged.
        damage: Vec<String>,
        /// Whether the user may have edited what looks damaged.
        is_edited: bool,
    },
    /// Results to be copied are damaged.
    #[error(
        "{} is damaged, so nothing was copied:{}\n`raysweep process` makes results again; --accept-damage copies the files as they are",
        dir.display(), listed(damage)
    )]
    DamagedResults {
        /// The session.
        dir: PathBuf,
        /// What is damaged.
        damage: Vec<String>,
    },
    /// Its plan or rig file cannot be read.
    #[error("{0}")]
    Config(String),
    /// A requested product cannot be made.
    #[error("{0}")]
    Product(String),
    /// The results do not fit into memory, not even in strips.
    #[error(
        "the results need {} of memory even if solved in strips of camera rows, but only {} may be used: raise --memory, make shorter sequences, or close other programs",
        Size(*needed_bytes),
        Size(*available_bytes)
    )]
    Memory {
        /// Memory needed.
        needed_bytes: u64,
        /// Memory allowed.
        available_bytes: u64,
    },
    /// A file cannot be copied.
    #[error("cannot copy to {}: {}", path.display(), io_text(source))]
    Copy {
        /// Destination.
        path: PathBuf,
        /// Error of the operating system.
        source: std::io::Error,
    },
}

impl ProcessError {
    /// The same error of a session that was processed in a copy: the session itself is what is damaged.
    #[must_use]
    pub fn of(self, session: &Path) -> Self {
        match self {
            Self::Damaged { damage, is_edited, .. } => {
                Self::Damaged { dir: session.to_owned(), damage, is_edited }
            }
            error => error,
        }
    }
}

/// Most damaged parts that an error names.
const MOST_NAMED: usize = 10;
const EDITED: &str =
    "If you edited plan.toml or rig.toml, --accept-edits takes them as they are now. Otherwise, ";

/// Damaged parts as lines, the first ones by name.
fn listed(damage: &[String]) -> String {
    let mut lines: Vec<String> =
        damage.iter().take(MOST_NAMED).map(|damage| format!("\n  {damage}")).collect();
    if let Some(more @ 1..) = damage.len().checked_sub(MOST_NAMED) {
        lines.push(format!("\n  and {more} more, which `raysweep verify` lists"));
    }
    lines.concat()
}

/// Results of processing.
#[derive(Debug, Clone)]
pub struct Processed {
    /// Path of the report.
    pub report: PathBuf,
    /// Points of the sweep, or cycles of the film, that were used.
    pub stored: usize,
    /// Points or cycles in the plan.
    pub points: usize,
    /// What could not be made, and why.
    pub problems: Vec<String>,
}

/// Products requested in addition to a session's plan.
#[derive(Debug, Clone, Default)]
pub struct Asked {
    /// One entry per product: the keys of a `[[product]]`, separated by commas.
    pub products: Vec<String>,
    /// Make only these, and leave the plan's own products as they are.
    pub only: bool,
    /// Memory limit; results that need more are made in strips of camera rows, with the same values. `None`: the
    /// memory that is free.
    pub memory_limit_bytes: Option<u64>,
    /// Go on if something is damaged: without it, which the results then say.
    pub accept_damage: bool,
    /// Take plan and rig file as they are, even if they are not the ones that the session was begun with.
    pub accept_edits: bool,
}

/// A session that is being processed.
pub struct Stored<'a> {
    /// Its folder.
    pub session: &'a Session,
    /// State according to its ledger.
    pub state: &'a State,
    /// Its plan.
    pub plan: &'a Plan,
    pub(crate) plan_text: &'a str,
}

impl Stored<'_> {
    /// Reads a session's plan, and calls `read` with all that there is.
    ///
    /// # Errors
    /// When the plan cannot be read, and those of `read`.
    pub(crate) fn with<T>(
        session: &Session,
        state: &State,
        read: impl FnOnce(&Stored<'_>) -> Result<T, ProcessError>,
    ) -> Result<T, ProcessError> {
        let path = session.plan_path();
        let plan_text = session.read_text(&path)?;
        let plan = Plan::parse_stored(&plan_text)
            .map_err(|error| ProcessError::Config(error.render(&path.display().to_string(), &plan_text)))?;
        read(&Stored { session, state, plan: &plan, plan_text: &plan_text })
    }

    /// Wraps an error in the session's plan.
    pub(crate) fn in_plan(&self, error: &ConfigError) -> ProcessError {
        let path = self.session.plan_path().display().to_string();
        ProcessError::Config(error.render(&path, self.plan_text))
    }

    /// Checks that the ledger stores what the plan makes.
    ///
    /// # Errors
    /// When `plan.toml` is not the one that the session was begun with.
    pub(crate) fn check_contents(&self, planned: Contents) -> Result<(), ProcessError> {
        let stored = self.state.session.shape.contents;
        if stored == planned {
            return Ok(());
        }
        Err(ProcessError::Config(format!(
            "{} was changed after the session was begun: its points are not those of the ledger; restore the original",
            self.session.plan_path().display()
        )))
    }

    /// As [`Self::check_contents`], and checks that the stored points were acquired with the plan's settings.
    ///
    /// # Errors
    /// When `plan.toml` is not the one that the session was begun with.
    pub(crate) fn check_points(&self, planned: Contents, task: &PlaneTask) -> Result<(), ProcessError> {
        self.check_contents(planned)?;
        match task.unlike(self.state) {
            None => Ok(()),
            Some(what) => Err(ProcessError::Config(format!(
                "{} was changed after the session was begun: {what}; restore the original",
                self.session.plan_path().display()
            ))),
        }
    }

    /// The rig file of a session of the plane rig.
    ///
    /// # Errors
    /// When it cannot be read.
    pub(crate) fn plane_rig(&self) -> Result<RigFile, ProcessError> {
        self.rig(RigFile::parse)
    }

    /// What is known of the plane rig that the session was recorded on; `rig` is its file.
    ///
    /// # Errors
    /// When the session's calibration cannot be read.
    pub(crate) fn known<'a>(&self, rig: &'a RigFile) -> Result<KnownRig<'a>, ProcessError> {
        let (shape, first_row) = (self.state.session.shape, self.state.session.first_row);
        let refused = |error: ConfigError| ProcessError::Config(error.to_string());
        let kept = KeptCalibration::of(rig, self.session.dir(), None).map_err(refused)?;
        let calibration = kept.map(|kept| kept.known(rig)).transpose().map_err(refused)?;
        Ok(KnownRig { file: rig, first_row, size: (shape.rows, shape.columns), calibration })
    }

    /// The rig file of a session of the dot rig.
    ///
    /// # Errors
    /// When it cannot be read.
    pub(crate) fn dot_rig(&self) -> Result<DotRigFile, ProcessError> {
        self.rig(DotRigFile::parse)
    }

    fn rig<T>(&self, parse: impl FnOnce(&str) -> Result<T, ConfigError>) -> Result<T, ProcessError> {
        let path = self.session.rig_path();
        let text = self.session.read_text(&path)?;
        parse(&text).map_err(|error| ProcessError::Config(error.render(&path.display().to_string(), &text)))
    }
}
