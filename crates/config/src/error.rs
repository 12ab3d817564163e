//! Mistakes in a rig or plan file, with their positions.

use std::fmt;
use std::ops::Range;

/// One mistake in a file.
#[derive(Debug, Clone, PartialEq)]
pub struct ConfigMistake {
    /// Names the field and value, says what is allowed and what to do.
    pub message: String,
    /// The path of the field, for example `sweep.delay_us.count`, if there is one.
    pub field: Option<String>,
    /// Byte range in the text.
    pub span: Option<Range<usize>>,
}

/// All mistakes in a rig or plan file: at least one, in the order of the text.
#[derive(Debug, Clone, PartialEq)]
pub struct ConfigError {
    first: ConfigMistake,
    others: Vec<ConfigMistake>,
}

/// Mistakes of a file that are reported: more help nobody, and each is shown with its lines.
const MOST_SHOWN: usize = 50;

impl ConfigError {
    /// An error without a position in a text.
    pub fn of_field(field: &str, message: impl Into<String>) -> Self {
        ConfigMistake { message: message.into(), field: Some(field.into()), span: None }.into()
    }

    /// An error with these mistakes; `None` if there are none.
    pub(crate) fn of(mut mistakes: Vec<ConfigMistake>) -> Option<Self> {
        mistakes.sort_by_key(|mistake| mistake.span.as_ref().map(|span| span.start));
        let more = mistakes.len().saturating_sub(MOST_SHOWN);
        mistakes.truncate(MOST_SHOWN);
        if more > 0 {
            mistakes.push(ConfigMistake { message: format!("and {more} more"), field: None, span: None });
        }
        let mut mistakes = mistakes.into_iter();
        Some(Self { first: mistakes.next()?, others: mistakes.collect() })
    }

    /// The first mistake.
    pub fn first(&self) -> &ConfigMistake {
        &self.first
    }

    /// All mistakes.
    pub fn mistakes(&self) -> impl Iterator<Item = &ConfigMistake> {
        std::iter::once(&self.first).chain(&self.others)
    }

    /// Formats the mistakes with file name, line number and the line's text, for logs and plain output.
    pub fn render(&self, file: &str, text: &str) -> String {
        let rendered = self.mistakes().map(|ConfigMistake { message, span, .. }| {
            let Some(span) = span.clone().filter(|span| span.start <= text.len()) else {
                return format!("{file}: {message}");
            };
            let line = text[..span.start].matches('\n').count();
            let shown = text.lines().nth(line).unwrap_or_default();
            let excerpt = if shown.trim().is_empty() { String::new() } else { format!("\n  {shown}") };
            format!("{file}, line {}: {message}{excerpt}", line + 1)
        });
        rendered.collect::<Vec<_>>().join("\n")
    }
}

impl From<ConfigMistake> for ConfigError {
    fn from(first: ConfigMistake) -> Self {
        Self { first, others: Vec::new() }
    }
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let messages: Vec<&str> = self.mistakes().map(|mistake| mistake.message.as_str()).collect();
        f.write_str(&messages.join("\n"))
    }
}

impl std::error::Error for ConfigError {}
