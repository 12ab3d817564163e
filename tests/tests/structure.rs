//! The edges between crates that ARCHITECTURE.md allows, and no others.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::collections::{BTreeMap, BTreeSet};
use std::process::Command;

fn allowed() -> BTreeMap<&'static str, &'static [&'static str]> {
    [
        ("raysweep-core", &[] as &[_]),
        ("raysweep-transport", &[]),
        ("raysweep-pipeline", &["raysweep-core", "raysweep-transport"]),
        ("raysweep-session", &["raysweep-core"]),
        ("raysweep-proto", &["raysweep-core"]),
        ("raysweep-drivers", &["raysweep-core"]),
        ("raysweep-sim", &["raysweep-core"]),
        ("xtask", &[]),
        (
            "raysweep",
            &[
                "raysweep-core",
                "raysweep-drivers",
                "raysweep-pipeline",
                "raysweep-proto",
                "raysweep-session",
                "raysweep-sim",
                "raysweep-transport",
            ],
        ),
    ]
    .into()
}

#[test]
fn crates_depend_on_each_other_as_allowed() {
    let cargo = std::env::var_os("CARGO").expect("cargo runs this test");
    let output = Command::new(cargo)
        .args(["metadata", "--format-version", "1", "--no-deps"])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    let metadata: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let allowed = allowed();
    let mut seen = BTreeSet::new();
    for package in metadata["packages"].as_array().unwrap() {
        let name = package["name"].as_str().unwrap();
        if name == "raysweep-tests" {
            continue;
        }
        let edges = allowed.get(name).unwrap_or_else(|| panic!("{name} is not in the list of allowed edges"));
        seen.insert(name.to_owned());
        let dependencies = package["dependencies"].as_array().unwrap().iter();
        let normal = dependencies.filter(|dependency| dependency["kind"].is_null());
        let mut external = 0;
        for dependency in normal.map(|dependency| dependency["name"].as_str().unwrap()) {
            external += usize::from(!dependency.starts_with("raysweep"));
            assert!(
                !dependency.starts_with("raysweep") || edges.contains(&dependency),
                "{name} must not depend on {dependency}"
            );
        }
        assert!(name != "xtask" || external == 0, "xtask depends on nothing but std");
    }
    assert_eq!(seen.len(), allowed.len(), "crates are missing: {seen:?}");
}

#[test]
fn only_what_serves_the_socket_knows_of_tokio() {
    let output = Command::new(std::env::var_os("CARGO").expect("cargo runs this test"))
        .args(["metadata", "--format-version", "1", "--no-deps"])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    let metadata: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    for package in metadata["packages"].as_array().unwrap() {
        let uses = package["dependencies"].as_array().unwrap().iter().any(|d| d["name"] == "tokio");
        let name = package["name"].as_str().unwrap();
        assert!(!uses || ["raysweep", "raysweep-tests"].contains(&name), "{name} depends on tokio");
    }
}
