//! The sessions of a data folder.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use jiff::Timestamp;

use crate::folder::Session;
use crate::ledger::EndState;
use crate::{Error, Result, durable};

/// A session in a list of sessions.
#[derive(Debug, Clone, PartialEq)]
pub struct SessionSummary {
    /// Its folder.
    pub dir: PathBuf,
    /// The session's name as given.
    pub name: String,
    /// The plan's kind.
    pub kind: String,
    /// Who ran it.
    pub operator: Option<String>,
    /// What was in front of the camera.
    pub sample: Option<String>,
    /// Its tags.
    pub tags: Vec<String>,
    /// Creation time, UTC.
    pub created: Timestamp,
    /// Planned points: of a sweep, cycles of a film, batches, or axes of a mirror.
    pub points: usize,
    /// Stored points of those planned.
    pub stored: usize,
    /// See [`State::can_resume`](crate::ledger::State::can_resume).
    pub can_resume: bool,
    /// How its latest run ended; `None` while one is running and after a crash.
    pub end: Option<EndState>,
    /// Warnings of its latest run.
    pub warnings: Vec<String>,
}

/// The sessions of a data folder.
#[derive(Debug, Default)]
pub struct Listing {
    /// Sorted by folder name, and so by age.
    pub sessions: Vec<SessionSummary>,
    /// Folders whose ledger cannot be read, with the reason.
    pub unreadable: Vec<(PathBuf, Error)>,
}

/// Lists the sessions in a data folder; only their ledgers are read. Folders without a ledger are not
/// sessions.
///
/// # Errors
/// [`Error::Io`] if `root` cannot be listed. Errors of single sessions are in [`Listing::unreadable`].
pub fn list(root: &Path) -> Result<Listing> {
    let mut dirs = fs::read_dir(root)
        .and_then(|entries| entries.map(|entry| Ok(entry?.path())).collect::<io::Result<Vec<_>>>())
        .map_err(Error::io("list", root))?;
    dirs.sort();
    let mut listing = Listing::default();
    // A copy that is being made, or was cut off, is no session yet.
    let is_draft = |dir: &PathBuf| dir.to_string_lossy().ends_with(durable::TEMPORARY_SUFFIX);
    for dir in dirs.into_iter().filter(|dir| !is_draft(dir)) {
        let Ok(session) = Session::open(&dir) else { continue };
        // Its path could not be told to anybody in JSON.
        if dir.to_str().is_none() {
            let why = io::Error::new(io::ErrorKind::InvalidInput, "its name is not UTF-8: rename it");
            let shown = PathBuf::from(dir.to_string_lossy().into_owned());
            listing.unreadable.push((shown.clone(), Error::io("list", &shown)(why)));
            continue;
        }
        match session.state() {
            Ok(state) => listing.sessions.push(SessionSummary {
                stored: state.stored_points(),
                points: state.session.shape.points(),
                can_resume: state.can_resume(),
                end: state.end.as_ref().map(|end| end.state),
                warnings: state.end.map_or_else(Vec::new, |end| end.warnings),
                name: state.session.name,
                kind: state.session.kind,
                operator: state.session.operator,
                sample: state.session.sample,
                tags: state.session.tags,
                created: state.session.created,
                dir,
            }),
            Err(error) => listing.unreadable.push((dir, error)),
        }
    }
    Ok(listing)
}

#[cfg(test)]
mod tests {
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt;

    use super::*;
    use crate::folder::tests::session;

    #[test]
    fn the_list_names_what_it_cannot_read() {
        let root = tempfile::tempdir().unwrap();
        let (kept, _) = Session::create(root.path(), session("a"), "", "").unwrap();
        let (bad, _) = Session::create(root.path(), session("b"), "", "").unwrap();
        fs::write(bad.ledger_path(), "{}\n{}\n").unwrap();
        fs::create_dir(root.path().join("other")).unwrap();
        let unnamed = root.path().join(OsStr::from_bytes(b"z\xff"));
        fs::create_dir(&unnamed).unwrap();
        fs::copy(kept.ledger_path(), unnamed.join("ledger.jsonl")).unwrap();
        let listing = list(root.path()).unwrap();
        assert_eq!(listing.sessions.len(), 1);
        let summary = &listing.sessions[0];
        assert_eq!((summary.dir.as_path(), summary.points, summary.stored), (kept.dir(), 4, 0));
        assert_eq!(listing.unreadable.len(), 2);
        assert!(listing.unreadable[1].1.to_string().contains("rename it"), "{:?}", listing.unreadable);
        assert_eq!(listing.unreadable[0].0, bad.dir());
    }
}
