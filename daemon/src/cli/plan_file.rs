//! Reads plans and other short texts that users name.

use std::fs::File;
use std::io::{self, Read};
use std::os::unix::fs::FileTypeExt;
use std::path::Path;

use raysweep_session::input;

use super::failure::CommandFailure;

/// The text of a plan, which may come through a pipe, as scripts make plans.
pub(super) fn read_plan(path: &Path) -> Result<String, CommandFailure> {
    let read = || {
        let file = File::open(path)?;
        if !file.metadata()?.file_type().is_fifo() {
            return input::read_text(path, MOST_BYTES);
        }
        let text = io::read_to_string(file.take(MOST_BYTES + 1))?;
        match text.len() as u64 > MOST_BYTES {
            true => {
                Err(io::Error::new(io::ErrorKind::InvalidInput, format!("longer than {MOST_BYTES} bytes")))
            }
            false => Ok(text),
        }
    };
    read().map_err(|source| CommandFailure::File { path: path.to_owned(), source })
}

/// Longest text that a user names: much more than the socket takes of a plan.
pub(super) const MOST_BYTES: u64 = 1 << 24;

/// A short text file.
pub(super) fn read_small(path: &Path) -> Result<String, CommandFailure> {
    input::read_text(path, MOST_BYTES)
        .map_err(|source| CommandFailure::File { path: path.to_owned(), source })
}
