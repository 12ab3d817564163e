//! Debian's installer.

use std::process::{Command, Stdio};

use crate::run::{Done, say};

/// Installs only the named packages and their dependencies.
const INSTALL: [&str; 3] = ["install", "--yes", "--no-install-recommends"];

/// Whether this system has apt.
pub fn is_there() -> bool {
    Command::new("apt-get").arg("--version").output().is_ok()
}

/// Updates the package lists.
pub fn update() -> Done {
    apt_get(&["update"])
}

/// Those of the names whose packages can be installed.
pub fn candidates<'a>(names: impl IntoIterator<Item = &'a String>) -> Vec<String> {
    // The output is parsed below, so it must not be translated.
    let policy = Command::new("apt-cache").arg("policy").args(names).env("LC_ALL", "C").output();
    policy.map_or(Vec::new(), |output| with_candidate(&String::from_utf8_lossy(&output.stdout)))
}

/// Names in apt's answer, each of which stands above the versions of its package.
fn with_candidate(policy: &str) -> Vec<String> {
    let (mut all, mut name) = (Vec::new(), "");
    for line in policy.lines() {
        if !line.starts_with(' ') {
            name = line.trim_end_matches(':');
        } else if line.trim().strip_prefix("Candidate: ").is_some_and(|version| version != "(none)") {
            all.push(name.to_owned());
        }
    }
    all
}

/// Installs packages.
pub fn install(names: &[String]) -> Done {
    eprintln!("installing them through apt");
    let names_of: Vec<&str> = names.iter().map(String::as_str).collect();
    apt_get(&[&INSTALL, names_of.as_slice()].concat())
        .map_err(|error| format!("{error}\ninstall them by hand:\n  {}", by_hand(names, true)))
}

/// Commands for installing packages by hand; package lists that are only partly updated may be sufficient.
pub fn by_hand(names: &[String], is_root: bool) -> String {
    let commands = format!("apt-get update; apt-get {} {}", INSTALL.join(" "), names.join(" "));
    if is_root { commands } else { format!("sudo sh -c '{commands}'") }
}

fn apt_get(arguments: &[&str]) -> Done {
    let mut apt = Command::new("apt-get");
    // A machine that has just started updates itself, and downloads can fail once.
    apt.args(["-o", "DPkg::Lock::Timeout=600", "-o", "Acquire::Retries=3"]);
    // A question would not be seen.
    apt.args(["-o", "Dpkg::Options::=--force-confold"]).env("DEBIAN_FRONTEND", "noninteractive");
    apt.args(arguments).stdin(Stdio::null()).stderr(Stdio::inherit()).env("LC_ALL", "C");
    eprintln!("$ apt-get {}", arguments.join(" "));
    let output = apt.output().map_err(|error| format!("cannot start apt-get: {error}"))?;
    let said = String::from_utf8_lossy(&output.stdout);
    if !output.status.success() {
        eprint!("{said}");
        return Err(format!("`apt-get {}` ended with {}", arguments.join(" "), output.status));
    }
    removed(&said).map_or(Ok(()), |names| say(&format!("apt removed {names}, which conflicts with them")))
}

/// The packages that apt says it removes.
fn removed(said: &str) -> Option<String> {
    let (_, after) = said.split_once("The following packages will be REMOVED:\n")?;
    let names = after.lines().take_while(|line| line.starts_with(' '));
    Some(names.map(str::trim).collect::<Vec<_>>().join(" "))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_apt_removes_is_told() {
        let said =
            "Reading\nThe following packages will be REMOVED:\n  a b\n  c\nThe following NEW packages\n  d\n";
        assert_eq!(removed(said).unwrap(), "a b c");
        assert_eq!(removed("The following NEW packages\n  d\n"), None);
    }

    #[test]
    fn a_candidate_is_a_version() {
        let policy = |name, version| {
            format!("{name}:\n  Installed: (none)\n  Candidate: {version}\n  Version table:\n     1:14 500\n")
        };
        let said = [policy("a-14", "1:14.0.6-12"), policy("awk", "(none)"), policy("b", "2")].concat();
        assert_eq!(with_candidate(&said), ["a-14", "b"]);
        assert!(with_candidate("").is_empty());
    }
}
