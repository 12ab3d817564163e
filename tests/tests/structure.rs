//! Only the dependencies between crates that ARCHITECTURE.md allows exist.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
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

/// Files of the daemon that may refer to the simulator: the factory, the types of `[sim]`, and the simulated camera's
/// program.
const KNOW_THE_SIMULATOR: [&str; 5] =
    ["src/rig.rs", "src/rig/", "src/config/rig.rs", "src/config/dots.rs", "src/bin/raysweep-sim-camera.rs"];

#[test]
fn only_the_factory_knows_that_devices_may_be_simulated() {
    let daemon = Path::new(env!("CARGO_MANIFEST_DIR")).join("../daemon");
    let mut folders = vec![daemon.join("src")];
    let mut named = 0;
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if std::fs::read_to_string(&path).unwrap().contains("raysweep_sim") {
                let file = path.strip_prefix(&daemon).unwrap().to_str().unwrap();
                assert!(
                    KNOW_THE_SIMULATOR.iter().any(|known| file.starts_with(known)),
                    "{file} names raysweep_sim"
                );
                named += 1;
            }
        }
    }
    assert!(named > 1, "nothing names raysweep_sim: is it called otherwise?");
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
