//! Checks the package list `tests/packages.txt` on a bare Debian: the probes of each package fail without it, even when
//! similar packages are installed, and succeed with it.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

#[path = "../src/rootfs.rs"]
mod rootfs;

use std::io::Write;
use std::path::Path;
use std::process::Command;

const SCRIPT: &str = include_str!("packages.sh");

/// Last line of the script's output if there is no mirror for making a root, or mmdebstrap fails otherwise.
const NO_ROOT: &str = "no root";

/// Suites of the list, and in each the packages that could be mistaken for listed ones: libraries without their
/// headers, libclang-cpp, a compiler under another name, a Python that cannot create environments, a busybox that needs
/// libraries.
const SUITES: [(&str, &str); 2] = [
    ("bookworm", "gcc-12,python3,libusb-1.0-0,libaravis-0.8-0,libclang-cpp14,qemu-utils,busybox"),
    ("trixie", "gcc-14,python3,libusb-1.0-0,libaravis-0.8-0,libclang-cpp19,qemu-utils,busybox"),
];

#[test]
fn each_package_is_missing_before_it_is_installed_and_present_after() {
    let Some((suite, decoys)) = own_suite() else {
        return skipped("this machine is neither Debian 12 nor 13");
    };
    if let Some(why) = rootfs::forbidden() {
        return skipped(&why);
    }
    if Command::new("mmdebstrap").arg("--version").output().is_err() {
        return skipped("mmdebstrap is missing; `cargo xtask test` installs it");
    }
    let root = Path::new(env!("CARGO_TARGET_TMPDIR")).join("packages");
    let list = concat!(env!("CARGO_MANIFEST_DIR"), "/../../tests/packages.txt");
    let arguments = [suite, decoys, env!("CARGO_BIN_EXE_xtask"), list];
    let script = rootfs::Running::start(SCRIPT, &root, &arguments).unwrap();
    let mut said = Vec::new();
    let ended_well = script.follow(|line| said.push(line.to_owned())).unwrap();
    assert!(!rootfs::folder_of(&root).exists(), "the root is removed");
    if said.last().is_some_and(|line| line == NO_ROOT) {
        return skipped(&format!("mmdebstrap could not make a Debian root: {}", reason(&said)));
    }
    let all = said.join("\n");
    assert!(ended_well, "{all}");

    let entries: Vec<&str> = said.iter().filter_map(|line| line.strip_prefix("entry ")).collect();
    let lines = std::fs::read_to_string(list).unwrap();
    let lines = lines.lines().map(str::trim);
    let listed = lines.filter(|line| !line.is_empty() && !line.starts_with('#')).count();
    assert_eq!(entries.len(), listed, "{all}");
    for entry in entries {
        let states = entry.split_once(' ').unwrap().1;
        assert!(["missing installed present", "present already present"].contains(&states), "{entry}\n{all}");
    }
}

/// This machine's suite, and the packages in it that resemble listed ones.
fn own_suite() -> Option<(&'static str, &'static str)> {
    let about = std::fs::read_to_string("/etc/os-release").ok()?;
    let suite = about.lines().find_map(|line| line.strip_prefix("VERSION_CODENAME="))?;
    SUITES.into_iter().find(|&(known, _)| about.lines().any(|line| line == "ID=debian") && known == suite)
}

/// The last meaningful line of mmdebstrap's output; the very last one only says that it has failed.
fn reason(said: &[String]) -> &str {
    let tells = |line: &&String| *line != NO_ROOT && !line.ends_with("mmdebstrap failed to run");
    said.iter().rev().find(tells).map_or("it does not say why", String::as_str)
}

/// Prints directly to standard output, because the test harness captures `println!` of tests that pass.
fn skipped(why: &str) {
    std::io::stdout().write_all(format!("packages: SKIPPED: {why}\n").as_bytes()).unwrap();
}
