//! A stored session that is being processed, and what comes of it.

use std::path::{Path, PathBuf};

use raysweep_config::{ConfigError, DotRigFile, Plan, RigFile};
use raysweep_session::Session;
use raysweep_session::ledger::State;

/// Why a session cannot be processed.
#[derive(Debug, thiserror::Error)]
pub enum ProcessError {
    /// The session cannot be read or written.
    #[error(transparent)]
    Session(#[from] raysweep_session::Error),
    /// Its plan or rig file cannot be read.
    #[error("{0}")]
    Config(String),
    /// A product that was asked for cannot be had.
    #[error("{0}")]
    Product(String),
    /// The results do not fit into the memory, in strips either.
    #[error(
        "the results take {} MB of memory even some camera rows at a time, and {} MB may be used: raise --memory, make shorter sequences, or end other programs",
        needed_bytes / 1_000_000,
        available_bytes / 1_000_000
    )]
    Memory {
        /// What they take.
        needed_bytes: u64,
        /// What they may take.
        available_bytes: u64,
    },
    /// A file cannot be copied.
    #[error("cannot copy to {}: {source}", path.display())]
    Copy {
        /// Where to.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

/// What was made.
#[derive(Debug, Clone)]
pub struct Processed {
    /// The report.
    pub report: PathBuf,
    /// Points of the sweep, or cycles of the film, that went into it.
    pub stored: usize,
    /// All of them.
    pub points: usize,
    /// What could not be made, and why.
    pub problems: Vec<String>,
}

/// Products that are asked for beside a session's plan.
#[derive(Debug, Clone, Default)]
pub struct Asked {
    /// The keys of a `[[product]]` each, with commas between them.
    pub products: Vec<String>,
    /// Whether the plan's own products are left as they lie there.
    pub only: bool,
    /// Results that would take more memory than this are made some camera rows at a time, and are the same; none: more
    /// than is free.
    pub memory_limit_bytes: Option<u64>,
}

/// A session that is being processed.
pub struct Stored<'a> {
    /// Its folder.
    pub session: &'a Session,
    /// What its ledger knows.
    pub state: &'a State,
    /// Its plan.
    pub plan: &'a Plan,
    pub(crate) plan_text: &'a str,
}

impl Stored<'_> {
    /// An error in the session's plan.
    pub(crate) fn in_plan(&self, error: &ConfigError) -> ProcessError {
        let path = self.session.plan_path().display().to_string();
        ProcessError::Config(error.render(&path, self.plan_text))
    }

    /// The rig file of a session of the plane rig.
    ///
    /// # Errors
    /// When it cannot be read.
    pub(crate) fn plane_rig(&self) -> Result<RigFile, ProcessError> {
        self.rig(RigFile::parse)
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
        let text = read(&path)?;
        parse(&text).map_err(|error| ProcessError::Config(error.render(&path.display().to_string(), &text)))
    }
}

/// The text of a session's file.
pub(crate) fn read(path: &Path) -> Result<String, ProcessError> {
    std::fs::read_to_string(path)
        .map_err(|error| ProcessError::Config(format!("cannot read {}: {error}", path.display())))
}
