//! Moving sessions out of sight and back, and deleting them.

use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use crate::folder::Session;
use crate::{Error, Result, durable, ledger};

/// The folder in a data folder to which sessions are moved that are no longer wanted. It is not a session itself, so no
/// list shows what is in it.
pub const TRASH: &str = ".trash";

impl Session {
    /// Moves the session to the folder [`TRASH`] beside it, where no list shows it; returns its new folder.
    ///
    /// # Errors
    /// [`Error::InUse`] during a run, [`Error::Io`] if it is there already or the file system refuses.
    pub fn trash(&self) -> Result<PathBuf> {
        let dir = fs::canonicalize(self.dir()).map_err(moved(self.dir()))?;
        let trash = dir.parent().unwrap_or(&dir).join(TRASH);
        check_trash(&trash)?;
        self.move_to(&dir, &trash)
    }

    /// Whether the session is in a folder [`TRASH`].
    pub fn is_in_trash(&self) -> bool {
        let dir = fs::canonicalize(self.dir()).unwrap_or_else(|_| self.dir().to_owned());
        dir.parent().is_some_and(|parent| parent.file_name().is_some_and(|name| name == TRASH))
    }

    /// Moves a session back from the folder [`TRASH`]; returns its folder.
    ///
    /// # Errors
    /// [`Error::NotASession`] if it is not in such a folder; otherwise as [`Session::trash`].
    pub fn restore(&self) -> Result<PathBuf> {
        if let Some(trash) =
            self.dir().parent().filter(|parent| parent.file_name().is_some_and(|name| name == TRASH))
        {
            check_trash(trash)?;
        }
        let dir = fs::canonicalize(self.dir()).map_err(moved(self.dir()))?;
        let trash = dir.parent().filter(|parent| parent.file_name().is_some_and(|name| name == TRASH));
        let Some(data) = trash.and_then(Path::parent) else {
            let why = format!("it is not in a folder {TRASH}, so there is nothing to restore");
            return Err(Error::NotASession { path: dir, why });
        };
        self.move_to(&dir, data)
    }

    /// Deletes the session. Its ledger goes first, so that what is left of it after a failure is no session.
    ///
    /// # Errors
    /// [`Error::InUse`] during a run, [`Error::Io`] if the file system refuses.
    pub fn delete_for_good(self) -> Result<()> {
        let path = self.ledger_path();
        let _held = ledger::hold(&path)?;
        fs::remove_file(&path).map_err(Error::io("delete", &path))?;
        fs::remove_dir_all(self.dir()).map_err(Error::io("delete", self.dir()))
    }

    fn move_to(&self, dir: &Path, folder: &Path) -> Result<PathBuf> {
        // No run goes on in a folder that is moved; a ledger that cannot be read is moved too.
        let _held = ledger::hold(&self.ledger_path()).map_err(|error| match error {
            Error::Io { source, .. } if source.kind() == io::ErrorKind::NotFound => moved(dir)(source),
            error => error,
        })?;
        durable::create_dir_all(folder)?;
        let target = folder.join(dir.file_name().unwrap_or_default());
        if target.exists() {
            let why = "a session of this name is there; move or rename it first";
            return Err(Error::io("replace", &target)(io::Error::new(io::ErrorKind::AlreadyExists, why)));
        }
        fs::rename(dir, &target).map_err(moved(dir))?;
        Ok(target)
    }
}

/// For `map_err`: a session that is missing where it has just been seen was moved by another process.
fn moved(dir: &Path) -> impl FnOnce(io::Error) -> Error {
    move |error| match error.kind() {
        io::ErrorKind::NotFound => {
            let why = "it is not there any more; another process has already moved or deleted it";
            Error::io("move", dir)(io::Error::new(io::ErrorKind::NotFound, why))
        }
        _ => Error::io("move", dir)(error),
    }
}

/// Refuses a trash that leads elsewhere: what is moved there would leave the data folder.
fn check_trash(trash: &Path) -> Result<()> {
    match fs::symlink_metadata(trash) {
        Ok(found) if !found.is_dir() => {
            let why = "it is not a folder itself, and what is moved through it would leave the data folder: put a folder in its place";
            Err(Error::io("use the trash", trash)(io::Error::new(io::ErrorKind::NotADirectory, why)))
        }
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::folder::tests::session;

    #[test]
    fn a_session_of_which_nothing_can_be_read_goes_to_the_trash() {
        let data = tempfile::tempdir().unwrap();
        let (session, ledger) = Session::create(data.path(), session("s"), "plan", "rig").unwrap();
        assert!(matches!(session.trash(), Err(Error::InUse { .. })));
        drop(ledger);
        fs::write(session.ledger_path(), "").unwrap();
        let trashed = Session::open(&session.trash().unwrap()).unwrap();
        trashed.delete_for_good().unwrap();
        assert_eq!(fs::read_dir(data.path().join(TRASH)).unwrap().count(), 0);
    }

    #[test]
    fn who_moves_a_session_second_is_told_that_it_was_moved() {
        let data = tempfile::tempdir().unwrap();
        let (first, ledger) = Session::create(data.path(), session("s"), "plan", "rig").unwrap();
        drop(ledger);
        let second = Session::open(first.dir()).unwrap();
        let trashed = Session::open(&first.trash().unwrap()).unwrap();
        let said = second.trash().unwrap_err().to_string();
        assert!(said.contains("already moved or deleted it"), "{said}");
        let again = Session::open(trashed.dir()).unwrap();
        trashed.restore().unwrap();
        let said = again.restore().unwrap_err().to_string();
        assert!(said.contains("already moved or deleted it"), "{said}");
    }
}
