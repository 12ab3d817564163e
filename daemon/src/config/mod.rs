//! Rig and plan files: TOML with unknown keys refused and errors that point at the place in the text.

mod batches;
mod dots;
mod film;
mod plan;
mod product;
mod response;
mod rig;
mod vsync;

use std::ops::Range;

use toml::de::DeValue;

pub use batches::{BatchesPlan, PathPlan, PlanePlan, Shape};
pub use dots::{
    DotCameraDriver, DotCameraSection, DotRigFile, DotSimSection, MirrorDriver, MirrorSection, ResponseKey,
};
pub use film::FilmPlan;
pub use plan::{Axis, Plan, PlanKind, StageTable, Sweep};
pub use product::{ProductTable, append_argument};
pub use response::ResponsePlan;
pub use rig::{
    CameraDriver, CameraNoise, CameraSection, DrmSection, ProjectorDriver, ProjectorSection, RigFile, RigKind,
};
pub use vsync::{VsyncDriver, VsyncSection};

/// What is wrong with a rig or plan file, and where.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[error("{message}")]
pub struct ConfigError {
    /// Field, value, what is allowed.
    pub message: String,
    /// The field, where one is meant.
    pub field: Option<String>,
    /// Bytes of the text that it is about.
    pub span: Option<Range<usize>>,
}

impl ConfigError {
    /// An error about the value at a path of keys (`["sweep", "average"]`) of `text`.
    pub(crate) fn at(text: &str, path: &[&str], message: impl Into<String>) -> Self {
        Self { message: message.into(), field: Some(path.join(".")), span: span_of(text, path) }
    }

    pub(crate) fn parse(error: &toml::de::Error) -> Self {
        Self { message: error.message().to_owned(), field: None, span: error.span() }
    }

    /// The error with the name of its file, the line and the line's text, for logs and plain output.
    pub fn render(&self, file: &str, text: &str) -> String {
        let Some(span) = self.span.clone().filter(|span| span.start <= text.len()) else {
            return format!("{file}: {self}");
        };
        let line = text[..span.start].matches('\n').count();
        let shown = text.lines().nth(line).unwrap_or_default();
        format!("{file}, line {}: {self}\n  {shown}", line + 1)
    }
}

/// Where the value at a path of keys (of an array: numbers) stands, or the deepest table on the way to it.
fn span_of(text: &str, path: &[&str]) -> Option<Range<usize>> {
    let document = toml::de::DeTable::parse(text).ok()?;
    let (first, rest) = path.split_first()?;
    let mut value = document.get_ref().iter().find(|(name, _)| name.get_ref() == first)?.1;
    for key in rest {
        let inner = match value.get_ref() {
            DeValue::Table(table) => {
                table.iter().find(|(name, _)| name.get_ref() == key).map(|(_, value)| value)
            }
            DeValue::Array(array) => key.parse::<usize>().ok().and_then(|index| array.get(index)),
            _ => None,
        };
        match inner {
            Some(inner) => value = inner,
            None => break,
        }
    }
    Some(value.span())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn spans_point_at_the_value_however_it_is_written() {
        let text = "kind = \"sweep\"\n[sweep]\ndelay_us = { start = 1, stop = 2, count = 0 }\n";
        let span = span_of(text, &["sweep", "delay_us", "count"]).unwrap();
        assert_eq!(&text[span], "0");
        let table = span_of(text, &["sweep", "average"]).unwrap();
        assert!(text[table].contains("[sweep]"));
        let stages = "[[stage]]\nname = \"a\"\n[[stage]]\nname = \"b\"\n";
        assert_eq!(&stages[span_of(stages, &["stage", "1", "name"]).unwrap()], "\"b\"");
    }

    #[test]
    fn the_example_files_are_what_they_say() {
        let deploy = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../deploy");
        let texts = |folder: &str| {
            let files = std::fs::read_dir(deploy.join(folder)).unwrap().map(|file| file.unwrap().path());
            files.map(|file| std::fs::read_to_string(file).unwrap()).collect::<Vec<_>>()
        };
        let (rigs, plans) = (texts("rigs"), texts("plans"));
        assert!(rigs.len() >= 2 && plans.len() >= 3);
        for text in &rigs {
            match RigKind::of(text).unwrap() {
                RigKind::Plane => drop(RigFile::parse(text).unwrap()),
                RigKind::Dots => drop(DotRigFile::parse(text).unwrap()),
            }
        }
        plans.iter().for_each(|text| drop(Plan::parse(text).unwrap()));
    }
}
