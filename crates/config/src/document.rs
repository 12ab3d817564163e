//! Parses a TOML text once, decodes its tables one by one, and collects the mistakes that checks find.

use std::collections::BTreeMap;
use std::fmt;
use std::ops::{Range, RangeInclusive};

use raysweep_core::decoding_message;
use serde::Deserialize;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use crate::{ConfigError, ConfigMistake};

/// A value of a device's table that no device can be opened with: its key, and a message that follows the key.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("{key}{message}")]
pub struct Fault {
    /// Path of the key, relative to the device's table.
    pub key: &'static str,
    pub(crate) message: String,
}

/// The faults of values outside their ranges, which include both ends.
pub(crate) fn out_of_range<const N: usize>(
    rules: [(&'static str, f64, RangeInclusive<f64>); N],
) -> impl Iterator<Item = Fault> {
    rules.into_iter().filter(|(_, value, allowed)| !allowed.contains(value)).map(|(key, value, allowed)| {
        let (low, high) = (allowed.start(), allowed.end());
        Fault { key, message: format!(" = {value}: must be from {low} to {high}") }
    })
}

/// A number of things, such as "1 value" and "3 values".
pub(crate) fn counted(number: usize, noun: &str) -> String {
    format!("{number} {noun}{}", if number == 1 { "" } else { "s" })
}

/// What a required key takes, for messages about files that lack it.
fn required(key: &str) -> Option<&'static str> {
    Some(match key {
        "max_tilt" => "a mechanical tilt in degrees, 0.01 to 45",
        "max_step" => "the largest step per sample in degrees, 0.0001 to max_tilt",
        "max_slew_deg_per_s" => "the largest speed in degrees per second, 0.001 to 1e7",
        "bandwidth_hz" => "a bandwidth in Hz, 1 to 1e5",
        "out_of_band" => "a tilt in degrees, 0 to max_tilt",
        "sigma_rows" => "a standard deviation in rows, above 0, at most 100",
        "up_rows" | "down_rows" => "an extent in rows, 0 or more; both together are above 0 and at most 500",
        "start" | "stop" => "the first and the last value of a range",
        "count" => "the number of values in the range",
        _ => return None,
    })
}

/// A text that is being read.
pub(crate) struct Document<'a> {
    tables: DeTable<'a>,
    places: Places,
    mistakes: Vec<ConfigMistake>,
    purpose: ReadingPurpose,
}

/// What a text is read for.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum ReadingPurpose {
    /// For a run that is still to be made.
    NewRun,
    /// For what a session already has: mistakes that earlier versions allowed, and that do not keep it from being
    /// processed, are none.
    StoredSession,
}

impl<'a> Document<'a> {
    /// Parses a text.
    ///
    /// # Errors
    /// A syntax error, in which case nothing else is checked.
    pub fn parse(text: &'a str) -> Result<Self, ConfigError> {
        let table = DeTable::parse(text).map_err(|error| {
            ConfigError::from(ConfigMistake {
                message: error.message().into(),
                field: None,
                span: error.span(),
            })
        })?;
        let places = Places::of(&table);
        Ok(Self { tables: table.into_inner(), places, mistakes: Vec::new(), purpose: ReadingPurpose::NewRun })
    }

    /// The same text, read for this purpose.
    pub fn read_for(self, purpose: ReadingPurpose) -> Self {
        Self { purpose, ..self }
    }

    /// As [`Self::refuse`], but only in a text for a new run.
    pub fn refuse_new(&mut self, path: &[&str], message: impl Into<String>) {
        if self.purpose == ReadingPurpose::NewRun {
            self.refuse(path, message);
        }
    }

    /// Positions of its values.
    pub fn places(&self) -> &Places {
        &self.places
    }

    /// Decodes the value of a key of the file, if present. A value that cannot be decoded is a mistake.
    pub fn take<T: Deserialize<'a>>(&mut self, key: &str) -> Option<T> {
        let (_, value) = self.tables.remove_entry(key)?;
        match T::deserialize(toml::de::ValueDeserializer::from(value)) {
            Ok(value) => Some(value),
            Err(error) => {
                let field = error.span().and_then(|span| self.places.path_at(&span));
                let field = field.unwrap_or_else(|| key.to_owned());
                let mut message = format!("{field}: {}", decoding_message(error.message(), "table"));
                let missing =
                    message.split_once("missing key `").and_then(|(_, rest)| rest.strip_suffix('`'));
                if let Some((key, takes)) = missing.and_then(|key| Some((key, required(key)?))) {
                    message = format!("{message}: add {key} = .., {takes}");
                }
                self.mistakes.push(ConfigMistake { message, field: Some(field), span: error.span() });
                None
            }
        }
    }

    /// The value of a key of the file, if it is a string.
    pub fn string(&self, key: &str) -> Option<&str> {
        match self.tables.get(key)?.get_ref() {
            DeValue::String(text) => Some(text),
            _ => None,
        }
    }

    /// Removes a key without decoding it, and returns whether it was there.
    pub fn drop_key(&mut self, key: &str) -> bool {
        self.tables.remove_entry(key).is_some()
    }

    /// Decodes the value of a key; returns the default if the key is missing.
    pub fn take_or_default<T: Deserialize<'a> + Default>(&mut self, key: &str) -> Option<T> {
        if self.tables.contains_key(key) { self.take(key) } else { Some(T::default()) }
    }

    /// Decodes the value of a required key; `example` shows what to write.
    pub fn require<T: Deserialize<'a>>(&mut self, key: &str, example: &str) -> Option<T> {
        if !self.tables.contains_key(key) {
            self.refuse(&[key], format!("missing key `{key}`: add {example}"));
        }
        self.take(key)
    }

    /// Refuses the remaining keys of the file, which nothing has asked for.
    pub fn refuse_others(&mut self, known: &[&str]) {
        let others: Vec<String> = self.tables.keys().map(|key| key.get_ref().to_string()).collect();
        for key in others.iter().filter(|key| !known.contains(&key.as_str())) {
            let known = known.iter().map(|known| format!("`{known}`")).collect::<Vec<_>>().join(", ");
            let shown = key.escape_debug();
            let mut mistake =
                self.places.mistake(&[key], format!("unknown key `{shown}`, expected one of {known}"));
            mistake.span = self.places.root.inside.get(key).map(|place| place.key.clone());
            self.mistakes.push(mistake);
        }
    }

    /// Whether none of these values has been refused, so that rules between them can be checked.
    pub fn is_sound(&self, paths: &[&[&str]]) -> bool {
        let is_refused = |path: &&[&str]| {
            let field = path.join(".");
            self.mistakes.iter().any(|mistake| mistake.field.as_ref() == Some(&field))
        };
        !paths.iter().any(is_refused)
    }

    /// Records a mistake about the value at a path of keys.
    pub fn refuse(&mut self, path: &[&str], message: impl Into<String>) {
        self.mistakes.push(self.places.mistake(path, message));
    }

    /// Records the faults of a device's table.
    pub fn refuse_all(&mut self, table: &[&str], faults: Vec<Fault>) {
        for Fault { key, message } in faults {
            let path: Vec<&str> = table.iter().copied().chain(key.split('.')).collect();
            self.refuse(&path, format!("{}.{key}{message}", table.join(".")));
        }
    }

    /// Records a mistake unless a value is within its range, both ends included.
    pub fn check_range(&mut self, path: &[&str], value: f64, allowed: RangeInclusive<f64>) {
        if !allowed.contains(&value) {
            let (low, high) = (allowed.start(), allowed.end());
            self.refuse(path, format!("{} = {value}: must be from {low} to {high}", path.join(".")));
        }
    }

    /// Notes a mistake unless a count is within its range, both ends included.
    pub fn check_count(&mut self, path: &[&str], value: u64, allowed: RangeInclusive<u64>) {
        if !allowed.contains(&value) {
            let (low, high) = (allowed.start(), allowed.end());
            self.refuse(path, format!("{} = {value}: must be from {low} to {high}", path.join(".")));
        }
    }

    /// Records a mistake unless a value is finite and greater than zero.
    pub fn check_positive(&mut self, path: &[&str], value: f64, unit: &str) {
        if !(value > 0.0 && value.is_finite()) {
            self.refuse(path, format!("{} = {value}: must be more than 0 {unit}", path.join(".")));
        }
    }

    /// Finishes reading: returns the value, unless there were mistakes.
    ///
    /// # Errors
    /// All mistakes.
    pub fn finish<T>(self, read: Option<T>) -> Result<T, ConfigError> {
        match (ConfigError::of(self.mistakes), read) {
            (None, Some(read)) => Ok(read),
            (Some(error), _) => Err(error),
            // Reading never fails without a mistake.
            (None, None) => Err(ConfigError::of_field("kind", "the file cannot be read")),
        }
    }
}

/// Positions of the values in a TOML text, for errors that are found later.
#[derive(Clone, Default)]
pub struct Places {
    root: Place,
}

#[derive(Clone, Default)]
struct Place {
    key: Range<usize>,
    value: Range<usize>,
    inside: BTreeMap<String, Place>,
}

impl Places {
    fn of(table: &Spanned<DeTable<'_>>) -> Self {
        let inside = Place::of_table(table.get_ref());
        Self { root: Place { key: 0..0, value: table.span(), inside } }
    }

    /// Whether the text has a value at a path of keys.
    pub fn has(&self, path: &[&str]) -> bool {
        path.iter().try_fold(&self.root, |place, key| place.inside.get(*key)).is_some()
    }

    /// `text`, of which these are the places, with other strings as the values at some paths of keys (for arrays,
    /// indices). Everything else stays as it is; values that the text does not have are not added.
    pub fn with_strings(&self, text: &str, strings: &[(Vec<String>, String)]) -> String {
        let found = strings.iter().filter_map(|(path, string)| {
            let place = path.iter().try_fold(&self.root, |place, key| place.inside.get(key.as_str()))?;
            Some((place.value.clone(), string))
        });
        let mut found: Vec<_> = found.collect();
        // From the end, so that spans stay true.
        found.sort_by_key(|(span, _)| std::cmp::Reverse(span.start));
        let mut text = text.to_owned();
        for (span, string) in found.into_iter().filter(|(span, _)| !span.is_empty()) {
            text.replace_range(span, &toml::Value::String(string.clone()).to_string());
        }
        text
    }

    /// A mistake about the value at a path of keys (for arrays, indices). If the text has no such value, the mistake
    /// points to the deepest table on the way to it.
    pub fn mistake(&self, path: &[&str], message: impl Into<String>) -> ConfigMistake {
        let mut place = &self.root;
        for key in path {
            match place.inside.get(*key) {
                Some(inner) => place = inner,
                None => break,
            }
        }
        ConfigMistake {
            message: message.into(),
            field: Some(path.join(".")),
            span: Some(place.value.clone()),
        }
    }

    /// An error with this [`Self::mistake`] only.
    pub fn error(&self, path: &[&str], message: impl Into<String>) -> ConfigError {
        self.mistake(path, message).into()
    }

    /// The path of the innermost key or value that a span begins in. The text of a table need not lie within that of
    /// its parent table.
    fn path_at(&self, span: &Range<usize>) -> Option<String> {
        let (_, path) =
            self.root.inside.iter().filter_map(|(key, place)| place.narrowest(key, span.start)).min()?;
        Some(path)
    }
}

impl Place {
    /// The shortest key or value at a byte of the text, with its length and path: the one at `path` or one inside it.
    fn narrowest(&self, path: &str, byte: usize) -> Option<(usize, String)> {
        let own = [&self.key, &self.value].into_iter().filter(|text| text.contains(&byte));
        let own = own.map(|text| (text.len(), path.to_owned())).min();
        let inner =
            self.inside.iter().filter_map(|(key, place)| place.narrowest(&format!("{path}.{key}"), byte));
        inner.chain(own).min()
    }

    fn of_table(table: &DeTable<'_>) -> BTreeMap<String, Self> {
        let place = |(key, value): (&Spanned<std::borrow::Cow<'_, str>>, &Spanned<DeValue<'_>>)| {
            let inside = Self::of_value(value.get_ref());
            (key.get_ref().to_string(), Self { key: key.span(), value: value.span(), inside })
        };
        table.iter().map(place).collect()
    }

    fn of_value(value: &DeValue<'_>) -> BTreeMap<String, Self> {
        match value {
            DeValue::Table(table) => Self::of_table(table),
            DeValue::Array(array) => {
                let place = |(index, value): (usize, &Spanned<DeValue<'_>>)| {
                    let (key, value_span) = (value.span(), value.span());
                    (
                        index.to_string(),
                        Self { key, value: value_span, inside: Self::of_value(value.get_ref()) },
                    )
                };
                array.iter().enumerate().map(place).collect()
            }
            _ => BTreeMap::new(),
        }
    }
}

/// Files with the same values are equal, regardless of positions.
impl fmt::Debug for Places {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Places")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_point_at_the_value_however_it_is_written() {
        let text = "kind = \"sweep\"\n[sweep]\ndelay_us = { start = 1, stop = 2, count = 0 }\n";
        let at = |text: &str, path: &[&str]| {
            let document = Document::parse(text).unwrap();
            let span = document.places().mistake(path, "").span.unwrap();
            text[span].to_owned()
        };
        assert_eq!(at(text, &["sweep", "delay_us", "count"]), "0");
        assert!(at(text, &["sweep", "average"]).contains("[sweep]"));
        let stages = "[[stage]]\nname = \"a\"\n[[stage]]\nname = \"b\"\n";
        assert_eq!(at(stages, &["stage", "1", "name"]), "\"b\"");
    }
}
