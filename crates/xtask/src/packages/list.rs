//! The list of packages, `tests/packages.txt`.

use super::probe::Probe;
use crate::run::{Done, root};

/// Path of the list in the project.
pub const PATH: &str = "tests/packages.txt";

/// One line of the list.
#[derive(Debug, PartialEq)]
pub struct PackageEntry {
    /// The package's name in each Debian release, in the order in which they are tried.
    pub names: Vec<String>,
    /// Probes that must all succeed if the package is present.
    pub probes: Vec<Probe>,
    /// Purpose of the package.
    pub why: String,
}

impl PackageEntry {
    /// Fails, and tells why, if a probe fails.
    pub fn check(&self) -> Done {
        let failed: Vec<_> = self.probes.iter().filter_map(|probe| probe.check().err()).collect();
        if failed.is_empty() { Ok(()) } else { Err(failed.join("; ")) }
    }
}

/// Reads the project's list.
pub fn entries() -> Done<Vec<PackageEntry>> {
    let path = root().join(PATH);
    let bytes = std::fs::read(&path).map_err(|error| format!("{}: {error}", path.display()))?;
    parse(&bytes)
}

fn parse(bytes: &[u8]) -> Done<Vec<PackageEntry>> {
    let mut entries: Vec<PackageEntry> = Vec::new();
    for (index, line) in bytes.split(|&byte| byte == b'\n').enumerate() {
        let failed = |error: String| format!("{PATH}, line {}: {error}", index + 1);
        let line = std::str::from_utf8(line).map_err(|error| failed(format!("not UTF-8: {error}")))?.trim();
        if line.is_empty() || line.starts_with('#') {
            continue;
        }
        let entry = entry(line).map_err(failed)?;
        if let Some(name) = entry.names.iter().find(|name| entries.iter().any(|it| it.names.contains(name))) {
            return Err(failed(format!("package `{name}` is listed twice")));
        }
        entries.push(entry);
    }
    if entries.is_empty() {
        return Err(format!("{PATH}: expected a line for each package, found none"));
    }
    Ok(entries)
}

fn entry(line: &str) -> Done<PackageEntry> {
    if line.starts_with('\u{feff}') {
        return Err("begins with a byte order mark: save the file as UTF-8 without one".to_owned());
    }
    let fields = line.split_once(char::is_whitespace).and_then(|(names, rest)| {
        let (probes, why) = rest.trim_start().split_once(char::is_whitespace)?;
        Some((names, probes, why.trim_start()))
    });
    let (names, probes, why) = fields.ok_or_else(|| {
        format!("`{line}`: expected a package, what shows that it is there, and why it is needed")
    })?;
    let names = names.split('|').map(package).collect::<Done<Vec<_>>>()?;
    if names.iter().enumerate().any(|(index, name)| names[..index].contains(name)) {
        return Err(format!("package `{}` repeats a name", names.join("|")));
    }
    let probes = probes.split(',').map(Probe::parse).collect::<Done<_>>();
    let probes = probes.map_err(|error| format!("what shows that it is there: {error}"))?;
    Ok(PackageEntry { names, probes, why: why.to_owned() })
}

/// Names are given to apt, which would take others for options.
fn package(name: &str) -> Done<String> {
    let letter = |letter: char| letter.is_ascii_lowercase() || letter.is_ascii_digit();
    if name.starts_with(letter) && name.chars().all(|it| letter(it) || "+-.".contains(it)) {
        return Ok(name.to_owned());
    }
    Err(format!(
        "package: `{name}`: expected a name of small letters, digits and any of +-., first a letter or digit"
    ))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_names_probes_and_a_reason() {
        let entries = parse(b"# comment\r\n\na|b  static:x,libclang  what for, in words\r\n").unwrap();
        let [entry] = entries.as_slice() else { panic!("{entries:?}") };
        assert_eq!(entry.names, ["a", "b"]);
        assert_eq!(entry.probes, [Probe::Static("x".to_owned()), Probe::Libclang]);
        assert_eq!(entry.why, "what for, in words");
    }

    #[test]
    fn a_bad_line_is_told_by_its_number_and_field() {
        for (line, what) in [
            ("gcc cc", "expected a package, what shows that it is there, and why"),
            ("a||b cc why", "package: ``: expected"),
            ("-y cc why", "package: `-y`: expected"),
            ("Gcc cc why", "package: `Gcc`: expected"),
            ("a|a cc why", "package `a|a` repeats a name"),
            ("x|other cc why", "package `other` is listed twice"),
            ("a nonsense:x why", "what shows that it is there: `nonsense:x`"),
            ("a b, why", "what shows that it is there: ``"),
            ("\u{feff}a b why", "byte order mark"),
        ] {
            let error = parse(format!("other cc why\n{line}\n").as_bytes()).unwrap_err();
            assert!(error.starts_with("tests/packages.txt, line 2: ") && error.contains(what), "{error}");
        }
        assert!(parse(b"a b why\na b \xff\n").unwrap_err().contains("line 2: not UTF-8"));
        assert!(parse(b"# comment\n").unwrap_err().contains("found none"));
    }

    #[test]
    fn the_projects_own_list_is_sound() {
        assert!(entries().unwrap().len() > 10);
    }
}
