//! Exports sessions for use elsewhere.

mod formats;
mod mat;

use std::path::{Path, PathBuf};

use raysweep_session::Session;
use raysweep_session::integrity::Audit;
use raysweep_session::ledger::LedgerText;

pub use self::formats::{ExportFormat, export_as};
use crate::stored::ProcessError;

/// What is copied of a session.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ExportScope {
    /// Products, report and manifest.
    Results,
    /// Also the arrays: what the camera saw, and the light transport.
    ResultsAndArrays,
}

/// Copies a session into the new folder `to`, which must not exist; returns the number of files.
///
/// # Errors
/// When the session cannot be read, its results are damaged (unless `accept_damage`), or `to` cannot be written.
pub fn export(dir: &Path, to: &Path, accept_damage: bool, scope: ExportScope) -> Result<usize, ProcessError> {
    let session = Session::open(dir)?;
    if !accept_damage {
        check_sound(&session)?;
    }
    create_new(to)?;
    let mut files =
        vec![session.report_path(), session.manifest_path(), session.plan_path(), session.rig_path()];
    // Each video has its own folder.
    let products = listed(&session.products_path());
    files.extend(products.iter().filter(|path| path.is_dir()).flat_map(|dir| listed(dir)));
    files.extend(products);
    files.push(session.ledger_path());
    let mut copied = 0;
    for file in files.iter().filter(|file| file.is_file()) {
        let parent = file.parent().filter(|parent| parent.parent() == Some(&session.products_path()));
        let folder = parent.and_then(Path::file_name).map_or_else(|| to.to_owned(), |name| to.join(name));
        let Some(name) = file.file_name() else { continue };
        let target = folder.join(name);
        std::fs::create_dir_all(&folder).map_err(not_copied(&folder))?;
        copy(file, &target)?;
        copied += 1;
    }
    if scope == ExportScope::ResultsAndArrays {
        for array in listed(dir).iter().filter(|path| path.extension().is_some_and(|ending| ending == "zarr"))
        {
            copied += copy_folder(array, &to.join(array.file_name().unwrap_or_default()), &copy)?;
        }
    }
    Ok(copied)
}

/// Checks that no result of a session is damaged.
fn check_sound(session: &Session) -> Result<(), ProcessError> {
    let text = LedgerText::read(&session.ledger_path())?;
    let state = text.replay(&session.ledger_path())?;
    let Audit { damage, .. } = Audit::without_data(session, &text, &state)?;
    if damage.is_empty() {
        return Ok(());
    }
    let damage = damage.iter().map(ToString::to_string).collect();
    Err(ProcessError::DamagedResults { dir: session.dir().to_owned(), damage })
}

/// Puts what was acquired of a session into the new folder `to`, which must not exist, so that it can be processed there
/// and its own results stay as they are. Arrays that no processing changes are linked where the file system can, which
/// takes no space.
///
/// # Errors
/// When the session cannot be read or is in use, or `to` exists or cannot be written.
pub fn copy_acquired(dir: &Path, to: &Path) -> Result<(), ProcessError> {
    let session = Session::open(dir)?;
    // Nothing is acquired or processed meanwhile.
    let _locked = session.open_damaged()?;
    create_new(to)?;
    // What is there of a copy that failed would be taken for a session.
    copy_into(&session, to).inspect_err(|_| drop(std::fs::remove_dir_all(to)))
}

/// Copies what was acquired.
fn copy_into(session: &Session, to: &Path) -> Result<(), ProcessError> {
    let dir = session.dir();
    let made = [session.products_path(), session.transport_path(), session.transport_film_path()];
    for path in listed(dir).iter().filter(|path| !made.contains(path)) {
        let target = to.join(path.file_name().unwrap_or_default());
        let is_array = path.extension().is_some_and(|ending| ending == "zarr");
        match path.is_dir() {
            true if is_array => drop(copy_folder(path, &target, &link)?),
            true => drop(copy_folder(path, &target, &copy)?),
            false if [session.report_path(), session.manifest_path()].contains(path) => {}
            false => copy(path, &target)?,
        }
    }
    // Records of mirrors and flat fields lie among the products, and are not made by processing.
    for file in session.state()?.files().keys().filter(|file| file.starts_with("products/")) {
        let target = to.join(file);
        std::fs::create_dir_all(target.parent().unwrap_or(to)).map_err(not_copied(&target))?;
        copy(&dir.join(file), &target)?;
    }
    Ok(())
}

fn create_new(to: &Path) -> Result<(), ProcessError> {
    if to.exists() {
        return Err(ProcessError::Config(format!("{} already exists: give a new folder", to.display())));
    }
    std::fs::create_dir(to).map_err(not_copied(to))
}

fn not_copied(to: &Path) -> impl FnOnce(std::io::Error) -> ProcessError {
    let path = to.to_owned();
    move |source| ProcessError::Copy { path, source }
}

/// What is in a folder; nothing if it cannot be read.
fn listed(dir: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).collect()
}

fn copy(from: &Path, to: &Path) -> Result<(), ProcessError> {
    std::fs::copy(from, to).map(drop).map_err(not_copied(to))
}

/// Links a file, or copies it to another file system.
fn link(from: &Path, to: &Path) -> Result<(), ProcessError> {
    std::fs::hard_link(from, to).or_else(|_| copy(from, to))
}

/// Copies a folder with everything in it; returns the number of files.
fn copy_folder(
    from: &Path,
    to: &Path,
    put: &dyn Fn(&Path, &Path) -> Result<(), ProcessError>,
) -> Result<usize, ProcessError> {
    std::fs::create_dir_all(to).map_err(not_copied(to))?;
    let mut files = 0;
    for path in listed(from) {
        let target = to.join(path.file_name().unwrap_or_default());
        match path.is_dir() {
            true => files += copy_folder(&path, &target, put)?,
            false => {
                put(&path, &target)?;
                files += 1;
            }
        }
    }
    Ok(files)
}
