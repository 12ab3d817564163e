//! Output of the commands.

use std::io::{self, Write};

use serde::Serialize;

use super::failure::CommandFailure;

/// Prints results for people or for programs.
#[derive(Debug, Clone, Copy)]
pub(super) struct Printer {
    pub json: bool,
    /// Whether a run is followed without its progress.
    pub quiet: bool,
}

impl Printer {
    pub fn print<T: Serialize>(
        self,
        result: &T,
        text: impl FnOnce(&T) -> String,
    ) -> Result<(), CommandFailure> {
        let line = match self.json {
            true => serde_json::to_string(result).map_err(io::Error::from).map_err(CommandFailure::Output)?,
            false => text(result),
        };
        writeln!(io::stdout(), "{line}").map_err(CommandFailure::Output)
    }
}
