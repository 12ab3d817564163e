//! Reads plans and other short texts that users name.

use std::path::Path;

use raysweep_session::input;

use super::failure::CommandFailure;

/// The text of a plan.
pub(super) fn read_plan(path: &Path) -> Result<String, CommandFailure> {
    read_small(path)
}

/// Longest text that a user names: much more than the socket takes of a plan.
const MOST_BYTES: u64 = 1 << 24;

/// A short text file.
pub(super) fn read_small(path: &Path) -> Result<String, CommandFailure> {
    input::read_text(path, MOST_BYTES)
        .map_err(|source| CommandFailure::File { path: path.to_owned(), source })
}
