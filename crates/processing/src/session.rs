//! Products made again from what a session holds, and sessions copied out for others.

use std::path::Path;

use raysweep_config::{Plan, Procedure};
use raysweep_session::Session;

use crate::stored::{Asked, ProcessError, Processed, Stored, read};
use crate::{batches, film, response, sweep};

/// Makes the products of a session again, with the plan and the rig file that lie in it: the same bits as the run's.
///
/// # Errors
/// When the session is being written by a run, or cannot be read.
pub fn process(dir: &Path) -> Result<Processed, ProcessError> {
    process_asked(dir, &Asked::default())
}

/// [`process`], and products that the plan does not name. Files of products that are not made now stay.
///
/// # Errors
/// Those of [`process`]; and when a product cannot be had of this session, before anything is written.
pub fn process_asked(dir: &Path, asked: &Asked) -> Result<Processed, ProcessError> {
    let session = Session::open(dir)?;
    let ledger = session.resume()?;
    let path = session.plan_path();
    let plan_text = read(&path)?;
    let plan = Plan::parse(&plan_text)
        .map_err(|error| ProcessError::Config(error.render(&path.display().to_string(), &plan_text)))?;
    let stored = Stored { session: &session, state: ledger.state(), plan: &plan, plan_text: &plan_text };
    match plan.procedure.clone() {
        Procedure::Sweep(own) => sweep::process(&stored, own, asked),
        Procedure::Film(own) => film::process(&stored, own, asked),
        Procedure::Batches(own) => batches::process(&stored, own, asked),
        Procedure::Response(own) => response::process(&stored, own, asked),
    }
}

/// Copies a session's products, report and manifest into `to`, a folder that is made and must not exist.
///
/// # Errors
/// When the session cannot be read or `to` cannot be written.
pub fn export(dir: &Path, to: &Path) -> Result<usize, ProcessError> {
    let session = Session::open(dir)?;
    if to.exists() {
        return Err(ProcessError::Config(format!("{} exists: give a folder that does not", to.display())));
    }
    std::fs::create_dir(to).map_err(|source| ProcessError::Copy { path: to.to_owned(), source })?;
    let mut files =
        vec![session.report_path(), session.manifest_path(), session.plan_path(), session.rig_path()];
    let listed = |dir: &Path| {
        let entries = std::fs::read_dir(dir).into_iter().flatten().flatten();
        entries.map(|entry| entry.path()).collect::<Vec<_>>()
    };
    // Videos have folders of their own.
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
