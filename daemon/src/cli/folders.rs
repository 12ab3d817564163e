//! Where a session lies that is given by its folder or by its name.

use std::ffi::OsStr;
use std::fs;
use std::path::{Path, PathBuf};

use raysweep_proto::Client;
use raysweep_session::TRASH;

use super::failure::CommandFailure;

/// The folder of a session, which is given by its folder, or by its name in the data folder of the daemon, if that answers.
///
/// # Errors
/// If it lies in the trash.
pub(super) fn folder_of(given: PathBuf, socket: &Path) -> Result<PathBuf, CommandFailure> {
    if given.exists() {
        return Ok(given);
    }
    let (name, mut data) = (given.file_name().unwrap_or_default(), given.parent().map(Path::to_owned));
    if given.components().count() == 1 {
        let listed = Client::connect(socket).and_then(|mut client| client.sessions()).unwrap_or_default();
        if let Some(named) = listed.into_iter().find(|info| info.session.file_name() == Some(name)) {
            return Ok(named.session);
        }
        data = data_folder(socket);
    }
    match data.and_then(|data| why_gone(&data.join(name))) {
        Some(why) => Err(CommandFailure::Trash(why)),
        None => Ok(given),
    }
}

/// Where a session is that is not in its folder any more, if it lies in the trash.
pub(super) fn why_gone(folder: &Path) -> Option<String> {
    let name = folder.file_name()?;
    let trashed = folder.parent()?.join(TRASH).join(name);
    (!folder.exists() && trashed.exists()).then(|| {
        format!("{} is in the trash: `raysweep restore {}` brings it back", name.display(), trashed.display())
    })
}

/// The daemon's data folder, if it answers and tells it.
fn data_folder(socket: &Path) -> Option<PathBuf> {
    Client::connect(socket).and_then(|mut client| client.status()).ok()?.data
}

/// The folder of a session in the trash, which is given by its folder, or by its name if the daemon answers.
pub(super) fn trashed_folder_of(given: PathBuf, socket: &Path) -> Result<PathBuf, CommandFailure> {
    if given.exists() {
        return Ok(given);
    }
    let trash = match given.parent() {
        Some(folder) if folder.file_name() == Some(TRASH.as_ref()) => folder.to_owned(),
        // `raysweep sessions` lists no trash, so that an error about a folder of that name would lead nowhere.
        Some(folder) if folder.as_os_str().is_empty() => {
            let data = data_folder(socket).ok_or_else(|| {
                let name = given.display();
                let why = "no daemon answers that could look it up in its trash; give its folder in .trash";
                CommandFailure::Trash(format!("there is no folder {name} here, and {why}"))
            })?;
            data.join(TRASH)
        }
        _ => return Ok(given),
    };
    let name = given.file_name().unwrap_or_default();
    let folder = trash.join(name);
    if folder.exists() { Ok(folder) } else { Err(CommandFailure::Trash(not_in_trash(&trash, name))) }
}

/// Most names of sessions in the trash that are listed.
const LISTED: usize = 10;

/// Says what is in the trash instead, the newest first.
fn not_in_trash(trash: &Path, name: &OsStr) -> String {
    let missing = format!("there is no {} in the trash", name.display());
    let mut names: Vec<String> = match fs::read_dir(trash) {
        Ok(entries) => entries.flatten().map(|entry| entry.file_name().display().to_string()).collect(),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Vec::new(),
        Err(error) => return format!("{missing}, or {} cannot be read: {error}", trash.display()),
    };
    // Names begin with the time at which the run began.
    names.sort_by(|a, b| b.cmp(a));
    let more = names.len().saturating_sub(LISTED);
    names.truncate(LISTED);
    match (names.as_slice(), more) {
        ([], _) => format!("{missing}: it is empty"),
        (names, 0) => format!("{missing}; it holds: {}", names.join(", ")),
        (names, more) => format!("{missing}; it holds: {}, and {more} older ones", names.join(", ")),
    }
}
