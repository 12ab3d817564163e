//! The list of packages, `tests/packages.txt`.

use super::probe::Probe;
use crate::run::Done;

/// Path of the list in the project.
pub const PATH: &str = "tests/packages.txt";

const TEXT: &str = include_str!("../../../../tests/packages.txt");

/// One line of the list.
#[derive(Debug, PartialEq)]
pub struct Entry {
    /// The package's name in each Debian release, in the order in which they are tried.
    pub names: Vec<String>,
    /// Probes that must all succeed if the package is present.
    pub probes: Vec<Probe>,
    /// Purpose of the package.
    pub why: String,
}

impl Entry {
    /// Whether all probes succeed.
    pub fn is_there(&self) -> bool {
        self.probes.iter().all(Probe::holds)
    }

    /// The package's names, formatted for display.
    pub fn name(&self) -> String {
        self.names.join(" or ")
    }
}

/// Reads the project's list.
pub fn entries() -> Done<Vec<Entry>> {
    parse(TEXT)
}

fn parse(text: &str) -> Done<Vec<Entry>> {
    let lines = text.lines().enumerate().map(|(index, line)| (index + 1, line.trim()));
    lines
        .filter(|(_, line)| !line.is_empty() && !line.starts_with('#'))
        .map(|(number, line)| entry(line).map_err(|error| format!("{PATH}, line {number}: {error}")))
        .collect()
}

fn entry(line: &str) -> Done<Entry> {
    let mut fields = line.splitn(3, char::is_whitespace).map(str::trim);
    let (Some(names), Some(probes), Some(why)) = (fields.next(), fields.next(), fields.next()) else {
        return Err(format!("`{line}` is not a package, what shows that it is there, and why it is needed"));
    };
    let names: Vec<String> = names.split('|').map(str::to_owned).collect();
    if names.iter().any(String::is_empty) {
        return Err(format!("`{}` has an empty name", names.join("|")));
    }
    let probes = probes.split(',').map(Probe::parse).collect::<Done<_>>()?;
    Ok(Entry { names, probes, why: why.to_owned() })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_names_probes_and_a_reason() {
        let entries = parse("# comment\n\na|b static:x,libclang what for, in words\n").unwrap();
        let [entry] = entries.as_slice() else { panic!("{entries:?}") };
        assert_eq!(entry.names, ["a", "b"]);
        assert_eq!(entry.probes, [Probe::Static("x".to_owned()), Probe::Libclang]);
        assert_eq!((entry.why.as_str(), entry.name().as_str()), ("what for, in words", "a or b"));
    }

    #[test]
    fn a_bad_line_is_told_by_its_number() {
        for (line, what) in [
            ("gcc cc", "why"),
            ("a||b cc why", "empty name"),
            ("a nonsense:x why", "nonsense"),
            ("a b, why", "``"),
        ] {
            let error = parse(&format!("# comment\n{line}\n")).unwrap_err();
            assert!(error.starts_with("tests/packages.txt, line 2: ") && error.contains(what), "{error}");
        }
    }

    #[test]
    fn the_projects_own_list_is_sound() {
        assert!(entries().unwrap().len() > 10);
    }
}
