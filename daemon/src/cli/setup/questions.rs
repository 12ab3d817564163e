//! Questions to an operator at a terminal, or to a file of answers.

use std::fmt::Write as _;
use std::fs;
use std::io::{self, BufRead, IsTerminal, Write};
use std::ops::RangeInclusive;
use std::os::unix::fs::{FileTypeExt, MetadataExt};
use std::path::{Path, PathBuf};

use nix::sys::stat;
use toml::{Table, Value};

use crate::cli::failure::CommandFailure;
use crate::cli::plan_file::read_small;

/// An answer that may be chosen.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct AnswerChoice {
    pub value: String,
    /// What it is, for people.
    pub about: String,
}

impl AnswerChoice {
    pub fn new(value: impl Into<String>, about: impl Into<String>) -> Self {
        Self { value: value.into(), about: about.into() }
    }
}

/// Asks a person, or a file.
pub(super) enum Questions {
    /// The answers of a file that are not asked for yet, and what is wrong with others.
    File { path: PathBuf, answers: Table, mistakes: Vec<String> },
    /// A person.
    Terminal,
}

type Answer<T> = Result<T, CommandFailure>;

fn refused<T>(what: impl Into<String>) -> Answer<T> {
    Err(CommandFailure::Setup(what.into()))
}

impl Questions {
    /// Questions to a file, or, without one, to the person at the terminal.
    ///
    /// # Errors
    /// When the file cannot be read, or nobody is at a terminal.
    pub fn of(file: Option<&Path>) -> Answer<Self> {
        let Some(path) = file else {
            return match io::stdin().is_terminal() {
                true => Ok(Self::Terminal),
                false => refused("nobody to ask: call it at a terminal, or give --answers FILE"),
            };
        };
        let text = read_small(path)?;
        let parsed: Result<Table, _> = text.parse();
        match parsed {
            Ok(answers) => Ok(Self::File { path: path.to_owned(), answers, mistakes: Vec::new() }),
            Err(error) => refused(format!("{}: {}", path.display(), in_place(&text, &error))),
        }
    }

    /// Asks for one of `choices`, or for a value of one of the `forms`, such as `triggerbox:PORT`. `default`, if any,
    /// stands for no answer.
    pub fn choose(
        &mut self,
        key: &str,
        question: &str,
        choices: &[AnswerChoice],
        forms: &[&str],
        default: Option<&str>,
    ) -> Answer<String> {
        let fits = |value: &str| {
            choices.iter().any(|choice| choice.value == value)
                || forms.iter().any(|form| {
                    let parts: Vec<&str> = value.splitn(form.split(':').count(), ':').collect();
                    parts.len() > 1
                        && form.split(':').next() == parts.first().copied()
                        && parts.iter().all(|part| !part.is_empty())
                })
        };
        let values = choices.iter().map(|choice| choice.value.as_str()).chain(forms.iter().copied());
        let allowed = format!("allowed: {}", values.collect::<Vec<_>>().join(", "));
        if let Self::File { .. } = self {
            let is_given = matches!(self, Self::File { answers, .. } if answers.contains_key(key));
            let given = self.given(key, "a string", |value| value.as_str().map(str::to_owned));
            // What is asked next depends on it, so that no other value stands in for one that was wrong.
            if let (true, None, Self::File { mistakes, .. }) = (is_given, &given, &*self) {
                return refused(mistakes.join("\n"));
            }
            return match given.or_else(|| default.map(str::to_owned)) {
                Some(value) if fits(&value) => Ok(value),
                Some(value) => Err(self.ended_by(&format!("{key} = {:?}; {allowed}", short(&value)))),
                None => Err(self.ended_by(&format!("{key} is missing: {question}; {allowed}"))),
            };
        }
        let mut prompt = format!("{question}\n");
        for (number, AnswerChoice { value, about }) in (1..).zip(choices) {
            let _ = writeln!(prompt, "  {number}  {value:<24} {about}");
        }
        for form in forms {
            let _ = writeln!(prompt, "     {form}");
        }
        loop {
            let line = asked(&prompt, default)?;
            let numbered = line.parse::<usize>().ok().and_then(|number| choices.get(number.checked_sub(1)?));
            let value = numbered.map_or(line, |choice| choice.value.clone());
            if fits(&value) {
                return Ok(value);
            }
            prompt = format!("{value:?} is none of them; {allowed}\n");
        }
    }

    /// Asks for a number.
    pub fn number(
        &mut self,
        key: &str,
        question: &str,
        default: f64,
        allowed: RangeInclusive<f64>,
    ) -> Answer<f64> {
        let range = format!("allowed: {} to {}", allowed.start(), allowed.end());
        if let Self::File { .. } = self {
            let number = |value: &Value| value.as_float().or(value.as_integer().map(|whole| whole as f64));
            let value = self.given(key, "a number", number).unwrap_or(default);
            if !allowed.contains(&value) {
                self.note(&format!("{key} = {value}; {range}"));
                return Ok(default);
            }
            return Ok(value);
        }
        let mut prompt = format!("{question}, {range}\n");
        loop {
            let line = asked(&prompt, Some(&default.to_string()))?;
            match line.parse() {
                Ok(value) if allowed.contains(&value) => return Ok(value),
                _ => prompt = format!("{line:?} is no number in this range; {range}\n"),
            }
        }
    }

    /// Asks for a whole number.
    pub fn whole(
        &mut self,
        key: &str,
        question: &str,
        default: u32,
        allowed: RangeInclusive<u32>,
    ) -> Answer<u32> {
        let (first, last) = (*allowed.start(), *allowed.end());
        let allowed = format!("allowed: whole numbers, {first} to {last}");
        loop {
            let value = self.number(key, question, f64::from(default), f64::from(first)..=f64::from(last))?;
            match self {
                _ if value.fract() == 0.0 => return Ok(value as u32),
                Self::File { .. } => {
                    self.note(&format!("{key} = {value}; {allowed}"));
                    return Ok(default);
                }
                Self::Terminal => println!("{value} is no whole number; {allowed}"),
            }
        }
    }

    /// Asks for a text, which may be empty if the default is.
    pub fn text(&mut self, key: &str, question: &str, default: &str) -> Answer<String> {
        if let Self::File { .. } = self {
            let given = self.given(key, "a string", |value| value.as_str().map(str::to_owned));
            return Ok(given.unwrap_or_else(|| default.into()));
        }
        asked(&format!("{question}\n"), Some(default))
    }

    /// Asks for a text that means something: `read` says what, or what is wrong with it.
    pub fn read<T>(
        &mut self,
        key: &str,
        question: &str,
        default: &str,
        read: impl Fn(&str) -> Result<T, String>,
    ) -> Answer<T> {
        loop {
            let text = self.text(key, question, default)?;
            match (read(&text), &self) {
                (Ok(value), _) => return Ok(value),
                (Err(what), Self::Terminal) => println!("{text:?}: {what}"),
                (Err(what), Self::File { .. }) => {
                    let what = format!("{key} = {text:?}: {what}");
                    let Ok(instead) = read(default) else { return Err(self.ended_by(&what)) };
                    self.note(&what);
                    return Ok(instead);
                }
            }
        }
    }

    /// Asks which serial ports to take, none by default; `choices` are those that were found.
    pub fn ports(&mut self, key: &str, question: &str, choices: &[PathBuf]) -> Answer<Vec<PathBuf>> {
        let wrong = |paths: &[PathBuf]| {
            paths.iter().find_map(|path| {
                Some(format!("{}: {}", short(&path.to_string_lossy()), no_serial_port(path)?))
            })
        };
        if let Self::File { .. } = self {
            let strings = |value: &Value| {
                let values = value.as_array()?.iter();
                values.map(|value| value.as_str().map(PathBuf::from)).collect::<Option<Vec<_>>>()
            };
            let paths = self.given(key, "a list of strings", strings).unwrap_or_default();
            if let Some(what) = wrong(&paths) {
                self.note(&format!("{key}: {what}; allowed: paths of serial ports, such as /dev/ttyUSB0"));
                return Ok(Vec::new());
            }
            return Ok(paths);
        }
        if choices.is_empty() {
            return Ok(Vec::new());
        }
        let allowed = "none, or paths separated by spaces";
        let listed: Vec<String> = choices.iter().map(|path| path.display().to_string()).collect();
        let mut prompt = format!("{question}\n  {}\n{allowed}", listed.join("\n  "));
        loop {
            let line = asked(&prompt, Some("none"))?;
            let paths: Vec<PathBuf> = match line.as_str() {
                "none" => Vec::new(),
                paths => paths.split_whitespace().map(PathBuf::from).collect(),
            };
            match wrong(&paths) {
                Some(what) => prompt = format!("{what}; allowed: {allowed}\n"),
                None => return Ok(paths),
            }
        }
    }

    /// Ends the questions.
    ///
    /// # Errors
    /// For all answers of a file that were wrong, or, if none was, for those to questions that were not asked.
    pub fn finish(self) -> Answer<()> {
        match &self {
            Self::File { mistakes, .. } if !mistakes.is_empty() => refused(mistakes.join("\n")),
            Self::File { answers, .. } if !answers.is_empty() => {
                let keys: Vec<&str> = answers.keys().map(String::as_str).collect();
                let keys = short(&keys.join(", "));
                refused(format!("{}{keys}: not asked for with the other answers; remove it", self.place()))
            }
            _ => Ok(()),
        }
    }

    /// The answer of a file to `key`, if it has one.
    fn given<T>(&mut self, key: &str, wanted: &str, read: impl Fn(&Value) -> Option<T>) -> Option<T> {
        let Self::File { answers, .. } = self else { return None };
        let value = answers.remove(key)?;
        let given = read(&value);
        if given.is_none() {
            self.note(&format!("{key} = {}; allowed: {wanted}", short(&value.to_string())));
        }
        given
    }

    /// Notes what is wrong with an answer of a file, so that all mistakes are told at once.
    fn note(&mut self, what: &str) {
        let what = format!("{}{what}", self.place());
        if let Self::File { mistakes, .. } = self {
            mistakes.push(what);
        }
    }

    /// The mistakes of a file, up to one without whose answer the questions cannot go on.
    fn ended_by(&mut self, what: &str) -> CommandFailure {
        self.note(what);
        let Self::File { mistakes, .. } = self else { return CommandFailure::Setup(what.into()) };
        CommandFailure::Setup(mistakes.join("\n"))
    }

    fn place(&self) -> String {
        match self {
            Self::File { path, .. } => format!("{}: ", path.display()),
            Self::Terminal => String::new(),
        }
    }
}

/// Most characters of a value that a message repeats.
const MOST_SHOWN: usize = 80;

/// A value as a message repeats it.
fn short(value: &str) -> String {
    match value.char_indices().nth(MOST_SHOWN) {
        Some((end, _)) => format!("{}…", &value[..end]),
        None => value.to_owned(),
    }
}

/// What is wrong with a TOML text, and where. The error's own text repeats the whole line.
fn in_place(text: &str, error: &toml::de::Error) -> String {
    let before = error.span().and_then(|span| text.get(..span.start));
    let line =
        before.map_or_else(String::new, |before| format!("line {}: ", before.matches('\n').count() + 1));
    format!("{line}{}", error.message())
}

/// Why a path cannot be a serial port's; tells it without opening what may be there.
fn no_serial_port(path: &Path) -> Option<&'static str> {
    let Ok(metadata) = path.metadata() else { return Some("there is no such file") };
    let (major, minor) = (stat::major(metadata.rdev()), stat::minor(metadata.rdev()));
    // Pseudo-terminals are not listed there.
    let subsystem = fs::read_link(format!("/sys/dev/char/{major}:{minor}/subsystem"));
    let is_other = subsystem.is_ok_and(|subsystem| !subsystem.ends_with("tty"));
    (!metadata.file_type().is_char_device() || is_other).then_some("this is no serial port")
}

/// One line of the person at the terminal; nothing stands for the default.
fn asked(prompt: &str, default: Option<&str>) -> Answer<String> {
    let shown = default.filter(|default| !default.is_empty());
    let default_text = shown.map_or(String::new(), |default| format!("[{default}]"));
    let prompt = prompt.trim_end();
    // Below a list, the answer has a line of its own.
    let gap = if prompt.contains('\n') { "\n" } else { " " };
    print!("{prompt}{gap}{default_text}: ");
    io::stdout().flush().map_err(CommandFailure::Output)?;
    let mut line = String::new();
    let read = io::stdin().lock().read_line(&mut line);
    match read {
        Ok(0) => refused("the questions were not answered: nothing is written"),
        Ok(_) => {
            let line = line.trim();
            Ok(if line.is_empty() { default.unwrap_or_default().to_owned() } else { line.to_owned() })
        }
        Err(error) => refused(format!("cannot read the answer: {}", raysweep_core::io_text(&error))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn questions(answers: &str) -> Questions {
        let (answers, mistakes) = (answers.parse().unwrap(), Vec::new());
        Questions::File { path: "answers.toml".into(), answers, mistakes }
    }

    fn message<T: std::fmt::Debug>(answer: Answer<T>) -> String {
        answer.unwrap_err().to_string()
    }

    #[test]
    fn answers_of_a_file_are_held_against_what_is_allowed() {
        let choices = [AnswerChoice::new("sim", "simulated")];
        let choose = |text: &str, default| {
            questions(text).choose("vsync", "What watches?", &choices, &["pps:SOURCE"], default)
        };
        assert_eq!(choose("vsync = 'sim'", None).unwrap(), "sim");
        assert_eq!(choose("vsync = 'pps:/dev/pps0'", None).unwrap(), "pps:/dev/pps0");
        assert_eq!(choose("", Some("sim")).unwrap(), "sim");
        for (wrong, part) in [
            ("vsync = 'pps:'", "answers.toml: vsync = \"pps:\"; allowed: sim, pps:SOURCE"),
            ("vsync = 'ppsource'", "allowed: sim, pps:SOURCE"),
            ("vsync = 1", "allowed: a string"),
            ("", "vsync is missing: What watches?; allowed: sim, pps:SOURCE"),
        ] {
            let found = message(choose(wrong, None));
            assert!(found.contains(part), "{found}");
        }
        let number = |text: &str| {
            let mut questions = questions(text);
            let number = questions.number("rows", "Rows?", 720.0, 1.0..=8192.0)?;
            questions.finish().map(|()| number)
        };
        assert_eq!((number("rows = 360").unwrap(), number("").unwrap()), (360.0, 720.0));
        assert!(message(number("rows = nan")).contains("allowed: 1 to 8192"));
        assert!(message(number("rows = 'many'")).contains("a number"));
        let whole = |text: &str| {
            let mut questions = questions(text);
            let whole = questions.whole("rows", "Rows?", 720, 1..=8192)?;
            questions.finish().map(|()| whole)
        };
        assert_eq!(whole("rows = 360.0").unwrap(), 360);
        assert!(message(whole("rows = 1.5")).contains("allowed: whole numbers, 1 to 8192"));
        let long = message(choose(&format!("vsync = '{}'", "x".repeat(1 << 20)), None));
        assert!(long.len() < 300 && long.contains("xxx…"), "{} bytes", long.len());
        let drm = |text: &str| {
            let mut questions = questions(&format!("projector = '{text}'"));
            questions.choose("projector", "What drives it?", &[], &["drm:CARD:CONNECTOR"], None)
        };
        assert_eq!(drm("drm:/dev/dri/card0:HDMI-A-1").unwrap(), "drm:/dev/dri/card0:HDMI-A-1");
        for wrong in ["drm", "drm:", "drm::", "drm::HDMI-A-1", "drm:/dev/dri/card0:"] {
            assert!(message(drm(wrong)).contains("allowed: drm:CARD:CONNECTOR"), "{wrong}");
        }
        assert!(message(questions("colour = 'red'").finish()).contains("colour: not asked for"));
    }
}
