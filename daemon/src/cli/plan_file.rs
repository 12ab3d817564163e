//! Reads the plans that users name.

use std::fs;
use std::path::Path;

use super::failure::CommandFailure;

/// The text of a plan.
pub(super) fn read_plan(path: &Path) -> Result<String, CommandFailure> {
    fs::read_to_string(path).map_err(|source| CommandFailure::File { path: path.to_owned(), source })
}
