//! Only the dependencies between crates, folders and files that ARCHITECTURE.md allows exist.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

mod graph;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::process::Command;

use graph::{Graph, folder};

fn allowed() -> BTreeMap<&'static str, &'static [&'static str]> {
    [
        ("raysweep-core", &[] as &[_]),
        ("raysweep-transport", &[]),
        ("raysweep-pipeline", &["raysweep-core", "raysweep-transport"]),
        ("raysweep-session", &["raysweep-core"]),
        ("raysweep-proto", &["raysweep-core"]),
        ("raysweep-config", &["raysweep-core"]),
        (
            "raysweep-processing",
            &[
                "raysweep-config",
                "raysweep-core",
                "raysweep-pipeline",
                "raysweep-session",
                "raysweep-transport",
            ],
        ),
        ("raysweep-drivers", &["raysweep-config", "raysweep-core"]),
        ("raysweep-sim", &["raysweep-config", "raysweep-core"]),
        ("xtask", &[]),
        (
            "raysweep",
            &[
                "raysweep-config",
                "raysweep-core",
                "raysweep-drivers",
                "raysweep-pipeline",
                "raysweep-processing",
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

/// Files of the daemon that may refer to the simulator: the factory, and the simulated camera's program.
const KNOW_THE_SIMULATOR: [&str; 2] = ["src/rig/", "src/bin/raysweep-sim-camera.rs"];

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

fn project() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// Most files that may import each other in a circle, all of one folder.
const LARGEST_CYCLE: usize = 3;

/// The cycles that are too large, or go through several folders.
fn forbidden_cycles(graph: &Graph) -> Vec<String> {
    let all: BTreeSet<&Path> = graph.edges().into_keys().collect();
    let is_forbidden = |cycle: &BTreeSet<&Path>| {
        let folders: BTreeSet<PathBuf> = cycle.iter().map(|file| folder(file, &all)).collect();
        cycle.len() > LARGEST_CYCLE || folders.len() > 1
    };
    graph.cycles().into_iter().filter(is_forbidden).map(|cycle| format!("{cycle:?}")).collect()
}

#[test]
fn files_import_each_other_in_no_large_circle_and_in_none_between_folders() {
    let project = project();
    let crates = std::fs::read_dir(project.join("crates")).unwrap().map(|entry| entry.unwrap().path());
    let others = ["daemon", "drivers", "sim"].map(|name| project.join(name));
    let (mut files, mut forbidden) = (0, Vec::new());
    for folder in crates.chain(others) {
        let graph = Graph::read(&folder.join("src"));
        files += graph.edges().len();
        let cycles = forbidden_cycles(&graph).into_iter();
        forbidden.extend(cycles.map(|cycle| format!("{}: {cycle}", folder.display())));
    }
    assert!(forbidden.is_empty(), "{}", forbidden.join("\n"));
    assert!(files > 200, "only {files} files were read");
}

/// The imports between the daemon's folders that are not allowed.
fn forbidden_imports(graph: &Graph) -> Vec<String> {
    let procedure = |file: &Path| {
        let folder = file.strip_prefix("procedure").ok()?.parent()?;
        (folder != Path::new("")).then(|| folder.to_owned())
    };
    let lower = ["devices", "live", "plane", "rig", "run", "server", "cli"];
    let mut forbidden = Vec::new();
    for (file, imported) in graph.edges() {
        for other in imported {
            let from_lower =
                lower.iter().any(|folder| file.starts_with(folder)) && other.starts_with("procedure");
            let between = procedure(file).zip(procedure(other)).is_some_and(|(own, others)| own != others);
            if from_lower || between {
                forbidden.push(format!("{} imports {}", file.display(), other.display()));
            }
        }
    }
    forbidden
}

#[test]
fn procedures_know_nothing_of_each_other_and_nothing_below_knows_a_procedure() {
    let graph = Graph::read(&project().join("daemon/src"));
    assert!(graph.edges().keys().any(|file| file.starts_with("procedure/sweep")), "procedures are elsewhere");
    assert_eq!(forbidden_imports(&graph), [""; 0]);
}

#[test]
fn broken_rules_are_found() {
    let graph = |sources: &[(&'static str, &'static str)]| {
        Graph::of(sources.iter().map(|(name, text)| (Path::new(*name), *text)))
    };
    // A circle between folders, one of its edges through a re-export.
    let cycles = forbidden_cycles(&graph(&[
        ("lib.rs", "mod a; mod b; pub use b::c::Deep;"),
        ("a.rs", "use crate::Deep;"),
        ("b/mod.rs", "pub mod c;"),
        ("b/c.rs", "pub struct Deep; fn f() { crate::a::g() }"),
    ]));
    assert_eq!(cycles, ["{\"a.rs\", \"b/c.rs\"}"]);
    // Four files of one folder; a test does not count.
    let ring = |last: &'static str| {
        forbidden_cycles(&graph(&[
            ("lib.rs", "mod a; mod b; mod c; mod d;"),
            ("a.rs", "use crate::b::B;"),
            ("b.rs", "use super::c::C;"),
            ("c.rs", "use crate::{d::D};"),
            ("d.rs", last),
        ]))
    };
    assert_eq!(ring("use crate::a::A;").len(), 1);
    assert_eq!(ring("#[cfg(test)] mod tests { use crate::a::A; }").len(), 0);
    let imports = forbidden_imports(&graph(&[
        ("lib.rs", "mod procedure; mod run;"),
        ("procedure/mod.rs", "mod film; mod sweep; use self::sweep::f;"),
        ("procedure/lab.rs", ""),
        ("procedure/film/mod.rs", "use crate::procedure::sweep::f; use crate::procedure::lab::Lab;"),
        ("procedure/sweep/mod.rs", "use crate::run::Run;"),
        ("run/mod.rs", "use crate::procedure::sweep::f;"),
    ]));
    assert_eq!(
        imports,
        ["procedure/film/mod.rs imports procedure/sweep/mod.rs", "run/mod.rs imports procedure/sweep/mod.rs"]
    );
}

#[test]
fn processing_needs_no_devices_and_no_server() {
    let output = Command::new(std::env::var_os("CARGO").expect("cargo runs this test"))
        .args([
            "tree",
            "--package",
            "raysweep-processing",
            "--edges",
            "normal",
            "--prefix",
            "none",
            "--offline",
        ])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    let tree = String::from_utf8(output.stdout).unwrap();
    assert!(tree.starts_with("raysweep-processing"), "{}", String::from_utf8_lossy(&output.stderr));
    for unwanted in ["raysweep-drivers", "raysweep-sim", "raysweep-proto", "tokio", "serialport", "nusb"] {
        assert!(!tree.lines().any(|line| line.starts_with(&format!("{unwanted} "))), "it needs {unwanted}");
    }
}
