//! Exports sessions for use elsewhere.

mod formats;
mod mat;

use std::fs::{File, FileType};
use std::path::{Path, PathBuf};

use raysweep_session::integrity::Audit;
use raysweep_session::ledger::LedgerText;
use raysweep_session::{Session, durable};

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

/// Copies a session into the new folder `to`, which must not exist; returns the number of files. Symbolic links, pipes
/// and devices, of which a session contains none, are not copied.
///
/// # Errors
/// When the session cannot be read, its results are damaged (unless `accept_damage`), or `to` cannot be written.
pub fn export(dir: &Path, to: &Path, accept_damage: bool, scope: ExportScope) -> Result<usize, ProcessError> {
    let session = Session::open(dir)?;
    if !accept_damage {
        check_sound(&session)?;
    }
    in_new_folder(&session, to, |to| {
        let own = [session.report_path(), session.manifest_path(), session.plan_path(), session.rig_path()];
        let mut files: Vec<PathBuf> =
            own.into_iter().filter(|file| is_real(file, FileType::is_file)).collect();
        files.extend(session.products().files());
        files.push(session.ledger_path());
        for file in &files {
            // Each video has its own folder.
            let inner = file.strip_prefix(session.products_path()).or_else(|_| file.strip_prefix(dir));
            let target = to.join(inner.unwrap_or(file));
            let folder = target.parent().unwrap_or(to);
            std::fs::create_dir_all(folder).map_err(not_copied(folder))?;
            copy(&session, file, &target)?;
        }
        let readme = to.join("README.md");
        std::fs::write(&readme, formats::readme_of_copy(&session, accept_damage)?)
            .map_err(not_copied(&readme))?;
        let mut copied = files.len() + 1;
        if scope == ExportScope::ResultsAndArrays {
            let is_array = |path: &&PathBuf| path.extension().is_some_and(|ending| ending == "zarr");
            for array in listed(dir, FileType::is_dir).iter().filter(is_array) {
                let target = to.join(array.file_name().unwrap_or_default());
                copied += copy_folder(&session, array, &target, &copy)?;
            }
        }
        Ok(copied)
    })
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
    in_new_folder(&session, to, |to| copy_into(&session, to))
}

/// Copies what was acquired.
fn copy_into(session: &Session, to: &Path) -> Result<(), ProcessError> {
    let dir = session.dir();
    let made = [session.products_path(), session.transport_path(), session.transport_film_path()];
    for path in listed(dir, FileType::is_dir).iter().filter(|path| !made.contains(path)) {
        let target = to.join(path.file_name().unwrap_or_default());
        let is_array = path.extension().is_some_and(|ending| ending == "zarr");
        let put: Put<'_> = if is_array { &link } else { &copy };
        copy_folder(session, path, &target, put)?;
    }
    let made = [session.report_path(), session.manifest_path()];
    for path in listed(dir, FileType::is_file).iter().filter(|path| !made.contains(path)) {
        copy(session, path, &to.join(path.file_name().unwrap_or_default()))?;
    }
    // Records of mirrors and flat fields lie among the products, and are not made by processing.
    for file in session.state()?.files().keys().filter(|file| file.starts_with("products/")) {
        let target = to.join(file);
        std::fs::create_dir_all(target.parent().unwrap_or(to)).map_err(not_copied(&target))?;
        copy(session, &dir.join(file), &target)?;
    }
    Ok(())
}

/// Makes the folder `to`, which must not exist, with what `fill` writes: after an error or a crash there is none.
fn in_new_folder<T>(
    session: &Session,
    to: &Path,
    fill: impl FnOnce(&Path) -> Result<T, ProcessError>,
) -> Result<T, ProcessError> {
    check_new(session, to, "folder")?;
    durable::replace_dir(to, |draft| {
        let filled = fill(draft)?;
        // Nothing is replaced that came meanwhile.
        check_new(session, to, "folder")?;
        Ok(filled)
    })
}

/// Refuses a target that exists, or that is in the session itself, whose files it would join.
fn check_new(session: &Session, to: &Path, what: &str) -> Result<(), ProcessError> {
    let refused = |why: &str| Err(ProcessError::Config(format!("{} {why}: give a new {what}", to.display())));
    if std::fs::symlink_metadata(to).is_ok() {
        return refused("already exists");
    }
    let parent = to.parent().filter(|parent| !parent.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let found = |path: &Path| std::fs::canonicalize(path).map_err(not_copied(to));
    match found(parent)?.starts_with(found(session.dir())?) {
        true => refused("is in the session itself"),
        false => Ok(()),
    }
}

fn not_copied(to: &Path) -> impl FnOnce(std::io::Error) -> ProcessError {
    let path = to.to_owned();
    move |source| ProcessError::Copy { path, source }
}

/// Whether something itself, not what a link leads to, is of this kind.
fn is_real(path: &Path, is_kind: fn(&FileType) -> bool) -> bool {
    std::fs::symlink_metadata(path).is_ok_and(|found| is_kind(&found.file_type()))
}

/// What of this kind is in a folder; nothing if it cannot be read.
fn listed(dir: &Path, is_kind: fn(&FileType) -> bool) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
    entries.map(|entry| entry.path()).filter(|path| is_real(path, is_kind)).collect()
}

/// Puts a file of a session to another place.
type Put<'a> = &'a dyn Fn(&Session, &Path, &Path) -> Result<(), ProcessError>;

fn copy(session: &Session, from: &Path, to: &Path) -> Result<(), ProcessError> {
    let mut source = session.open_file(from, u64::MAX)?;
    let mut copied = || {
        let mut target = File::create(to)?;
        std::io::copy(&mut source, &mut target)?;
        target.set_permissions(source.metadata()?.permissions())?;
        target.sync_all()
    };
    copied().map_err(not_copied(to))
}

/// Links a file, or copies it to another file system.
fn link(session: &Session, from: &Path, to: &Path) -> Result<(), ProcessError> {
    std::fs::hard_link(from, to).or_else(|_| copy(session, from, to))
}

/// Copies a folder with everything in it; returns the number of files.
fn copy_folder(session: &Session, from: &Path, to: &Path, put: Put<'_>) -> Result<usize, ProcessError> {
    std::fs::create_dir_all(to).map_err(not_copied(to))?;
    let files = listed(from, FileType::is_file);
    for path in &files {
        put(session, path, &to.join(path.file_name().unwrap_or_default()))?;
    }
    let mut copied = files.len();
    for path in listed(from, FileType::is_dir) {
        copied += copy_folder(session, &path, &to.join(path.file_name().unwrap_or_default()), put)?;
    }
    Ok(copied)
}
