//! Output of the commands.

use std::borrow::Cow;
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
            true => json_line(result).map_err(CommandFailure::Output)?,
            false => printable(&text(result)).into_owned(),
        };
        writeln!(io::stdout(), "{line}").map_err(CommandFailure::Output)
    }
}

/// A value as a line of JSON, in which what controls a terminal is escaped: JSON itself escapes only some of it.
pub(super) fn json_line(value: &impl Serialize) -> io::Result<String> {
    let line = serde_json::to_string(value)?;
    Ok(match line.contains(is_unprintable) {
        true => line.chars().fold(String::with_capacity(line.len()), |mut shown, letter| {
            match is_unprintable(letter) {
                // All of these have at most four hexadecimal digits.
                true => shown.extend(format!("\\u{:04x}", u32::from(letter)).chars()),
                false => shown.push(letter),
            }
            shown
        }),
        false => line,
    })
}

/// A text as it may be shown on a terminal. What others wrote into a session, a file or a device could otherwise move the
/// cursor, or turn the direction of writing: such characters are shown as escapes, `\u{1b}`.
pub(super) fn printable(text: &str) -> Cow<'_, str> {
    match text.contains(is_unprintable) {
        true => Cow::Owned(text.chars().fold(String::with_capacity(text.len()), |mut shown, letter| {
            match is_unprintable(letter) {
                true => shown.extend(letter.escape_unicode()),
                false => shown.push(letter),
            }
            shown
        })),
        false => Cow::Borrowed(text),
    }
}

/// Whether a character is a control character other than those of our own texts, or controls the direction of writing
/// (Unicode's `Bidi_Control`, and the separators of lines).
pub(super) fn is_unprintable(letter: char) -> bool {
    let is_control = letter.is_control() && !matches!(letter, '\n' | '\t');
    let turns = '\u{202a}'..='\u{202e}';
    let isolates = '\u{2066}'..='\u{2069}';
    let is_other = matches!(letter, '\u{61c}' | '\u{200e}' | '\u{200f}' | '\u{2028}' | '\u{2029}');
    is_control || is_other || turns.contains(&letter) || isolates.contains(&letter)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_controls_a_terminal_is_shown_as_an_escape() {
        assert_eq!(printable("a\tb\nµ → Ω"), "a\tb\nµ → Ω");
        assert_eq!(printable("\u{1b}[2J\r\u{9b}1m"), "\\u{1b}[2J\\u{d}\\u{9b}1m");
        assert_eq!(printable("\u{202e}txt.exe\u{2066}"), "\\u{202e}txt.exe\\u{2066}");
        let hostile = "a\u{1b}\u{9b}\u{202e}b";
        let line = json_line(&hostile).unwrap();
        assert_eq!(line, "\"a\\u001b\\u009b\\u202eb\"");
        assert_eq!(serde_json::from_str::<String>(&line).unwrap(), hostile);
    }
}
