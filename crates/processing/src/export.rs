//! Exports sessions for use elsewhere.

use std::path::Path;

use raysweep_session::Session;
use raysweep_session::integrity::Audit;
use raysweep_session::ledger::LedgerText;

use crate::stored::ProcessError;

/// Copies a session's products, report and manifest into the new folder `to`, which must not exist.
///
/// # Errors
/// When the session cannot be read, its results are damaged (unless `accept_damage`), or `to` cannot be written.
pub fn export(dir: &Path, to: &Path, accept_damage: bool) -> Result<usize, ProcessError> {
    let session = Session::open(dir)?;
    if !accept_damage {
        let text = LedgerText::read(&session.ledger_path())?;
        let state = text.replay(&session.ledger_path())?;
        let Audit { damage, .. } = Audit::without_data(&session, &text, &state)?;
        if !damage.is_empty() {
            let damage = damage.iter().map(ToString::to_string).collect();
            return Err(ProcessError::DamagedResults { dir: dir.to_owned(), damage });
        }
    }
    if to.exists() {
        return Err(ProcessError::Config(format!("{} already exists: give a new folder", to.display())));
    }
    std::fs::create_dir(to).map_err(|source| ProcessError::Copy { path: to.to_owned(), source })?;
    let mut files =
        vec![session.report_path(), session.manifest_path(), session.plan_path(), session.rig_path()];
    let listed = |dir: &Path| {
        let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
        entries.map(|entry| entry.path()).collect::<Vec<_>>()
    };
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
        std::fs::create_dir_all(&folder)
            .map_err(|source| ProcessError::Copy { path: folder.clone(), source })?;
        std::fs::copy(file, &target).map_err(|source| ProcessError::Copy { path: target, source })?;
        copied += 1;
    }
    Ok(copied)
}
