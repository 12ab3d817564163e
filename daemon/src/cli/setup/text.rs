//! The rig file that `setup` writes: only what was asked for; all else has its defaults.

use std::fmt::Write as _;

use toml::Value;

/// A rig file under construction.
pub(super) struct RigText(String);

impl RigText {
    /// A file of this kind.
    pub fn new(kind: &str) -> Self {
        Self(format!(
            "# Written by `raysweep setup`. Keys that are left out have their defaults:\n\
             # docs/reference/rig.md lists them. [A] marks what is assumed: replace it with what you know.\n\
             kind = \"{kind}\"\n"
        ))
    }

    /// Begins a table.
    pub fn table(mut self, name: &str) -> Self {
        let _ = writeln!(self.0, "\n[{name}]");
        self
    }

    /// Adds a key with its value.
    pub fn key(self, name: &str, value: impl Into<Value>) -> Self {
        self.line(name, value, None)
    }

    /// Adds a key with its value and a comment.
    pub fn key_with(self, name: &str, value: impl Into<Value>, comment: &str) -> Self {
        self.line(name, value, Some(comment))
    }

    /// Adds a line that is a comment.
    pub fn comment(mut self, comment: &str) -> Self {
        let _ = writeln!(self.0, "# {comment}");
        self
    }

    fn line(mut self, name: &str, value: impl Into<Value>, comment: Option<&str>) -> Self {
        let _ = write!(self.0, "{name} = {}", value.into());
        if let Some(comment) = comment {
            let _ = write!(self.0, "  # {comment}");
        }
        self.0.push('\n');
        self
    }

    /// The file's text.
    pub fn finish(self) -> String {
        self.0
    }
}
