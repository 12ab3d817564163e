//! Debian's installer.

use std::process::{Command, Stdio};

use crate::run::{Done, run};

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

/// Whether a package of this name can be installed.
pub fn has_candidate(name: &str) -> bool {
    // The output is parsed below, so it must not be translated.
    let policy = Command::new("apt-cache").args(["policy", name]).env("LC_ALL", "C").output();
    policy.is_ok_and(|output| candidate(&String::from_utf8_lossy(&output.stdout)).is_some())
}

fn candidate(policy: &str) -> Option<&str> {
    let version = policy.lines().find_map(|line| line.trim().strip_prefix("Candidate: "));
    version.filter(|&version| version != "(none)")
}

/// Installs packages.
pub fn install(names: &[String]) -> Done {
    eprintln!("installing them through apt");
    let names_of: Vec<&str> = names.iter().map(String::as_str).collect();
    apt_get(&[&INSTALL, names_of.as_slice()].concat())
        .map_err(|error| format!("{error}\ninstall them by hand:\n  {}", by_hand(names)))
}

/// Commands for installing packages by hand; package lists that are only partly updated may be sufficient.
pub fn by_hand(names: &[String]) -> String {
    format!("apt-get update; apt-get {} {}", INSTALL.join(" "), names.join(" "))
}

fn apt_get(arguments: &[&str]) -> Done {
    let mut apt = Command::new("apt-get");
    run(apt.args(arguments).env("DEBIAN_FRONTEND", "noninteractive").stdout(Stdio::null()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_candidate_is_a_version() {
        let policy =
            |version| format!("name:\n  Installed: (none)\n  Candidate: {version}\n  Version table:\n");
        assert_eq!(candidate(&policy("1:14.0.6-12")), Some("1:14.0.6-12"));
        assert_eq!(candidate(&policy("(none)")), None);
        assert_eq!(candidate(""), None);
    }
}
