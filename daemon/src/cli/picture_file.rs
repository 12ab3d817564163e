//! The PNG files that commands write where a user says.

use std::fs::{self, File};
use std::io::{self, Read};
use std::path::Path;

use raysweep_processing::ProcessError;
use raysweep_session::durable;

use super::CommandFailure;

/// How a PNG file begins.
const SIGNATURE: [u8; 8] = *b"\x89PNG\r\n\x1a\n";

/// Refuses a file whose name does not end in .png, and one that exists and is no PNG file or lies in a session: nobody
/// wants it replaced by a picture.
pub(super) fn check(file: &Path) -> Result<(), CommandFailure> {
    if !file.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("png")) {
        return Err(CommandFailure::NotPng(file.to_owned()));
    }
    match fs::symlink_metadata(file) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => {}
        Err(source) => return Err(CommandFailure::Write { path: file.to_owned(), source }),
        Ok(_) if is_picture(file) => {}
        Ok(_) => return Err(CommandFailure::OtherFile(file.to_owned())),
    }
    // The folder may have to be made: that above it which exists decides.
    let above = file.ancestors().skip(1).find_map(|folder| fs::canonicalize(folder).ok());
    let above = above.or_else(|| fs::canonicalize(".").ok()).unwrap_or_default();
    let in_session = above.ancestors().any(|folder| folder.join("ledger.jsonl").exists());
    match in_session {
        true => Err(CommandFailure::InSession(file.to_owned())),
        false => Ok(()),
    }
}

/// Writes a picture to a file that [`check`] accepts.
pub(super) fn write(file: &Path, png: &[u8]) -> Result<(), CommandFailure> {
    check(file)?;
    Ok(durable::write(file, png).map_err(ProcessError::from)?)
}

fn is_picture(file: &Path) -> bool {
    let is_regular = fs::symlink_metadata(file).is_ok_and(|found| found.is_file());
    let mut signature = [0; SIGNATURE.len()];
    is_regular
        && File::open(file).and_then(|mut file| file.read_exact(&mut signature)).is_ok()
        && signature == SIGNATURE
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_pictures_outside_of_sessions_are_replaced() {
        let folder = tempfile::tempdir().unwrap();
        let at = |name: &str| folder.path().join(name);
        for written in 0..2 {
            write(&at("seen.png"), &SIGNATURE).unwrap_or_else(|error| panic!("{written}: {error}"));
        }
        let refusal = |file: &Path| write(file, &SIGNATURE).unwrap_err().to_string();
        assert!(refusal(&at("seen.jpg")).contains(".png"));
        fs::write(at("notes.png"), "not a picture").unwrap();
        assert!(refusal(&at("notes.png")).contains("no PNG file"));
        std::os::unix::fs::symlink(at("seen.png"), at("link.png")).unwrap();
        assert!(refusal(&at("link.png")).contains("no PNG file"));
        let products = at("session/products");
        fs::create_dir_all(&products).unwrap();
        fs::write(at("session/ledger.jsonl"), "").unwrap();
        assert!(refusal(&products.join("new.png")).contains("a session"));
        assert!(refusal(&products.join("folder/that/is/not/there/new.png")).contains("a session"));
        assert_eq!(fs::read(at("notes.png")).unwrap(), b"not a picture");
    }
}
