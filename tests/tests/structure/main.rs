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
        // What tests and fuzzes all of them.
        if ["raysweep-tests", "raysweep-fuzz"].contains(&name) {
            continue;
        }
        let edges = allowed.get(name).unwrap_or_else(|| panic!("{name} is not in the list of allowed edges"));
        seen.insert(name.to_owned());
        let dependencies = package["dependencies"].as_array().unwrap().iter();
        let normal = dependencies.filter(|dependency| dependency["kind"].is_null());
        for dependency in normal.map(|dependency| dependency["name"].as_str().unwrap()) {
            assert!(name != "xtask" || dependency == "clang-sys", "xtask must build quickly: {dependency}");
            assert!(
                !dependency.starts_with("raysweep") || edges.contains(&dependency),
                "{name} must not depend on {dependency}"
            );
        }
    }
    assert_eq!(seen.len(), allowed.len(), "crates are missing: {seen:?}");
}

/// Files of the daemon that may refer to the simulator: the factory, and the simulated camera's program.
const KNOW_THE_SIMULATOR: [&str; 2] = ["src/rig/", "src/bin/raysweep-sim-camera.rs"];

#[test]
fn only_the_factory_knows_that_devices_may_be_simulated() {
    let daemon = project().join("daemon");
    let mut named = 0;
    for (path, text) in sources(&daemon.join("src")) {
        if text.contains("raysweep_sim") {
            let file = path.strip_prefix(&daemon).unwrap().to_str().unwrap();
            assert!(
                KNOW_THE_SIMULATOR.iter().any(|known| file.starts_with(known)),
                "{file} names raysweep_sim"
            );
            named += 1;
        }
    }
    assert!(named > 1, "nothing names raysweep_sim: is it called otherwise?");
}

/// The files of Rust below a folder, with their texts.
fn sources(folder: &Path) -> Vec<(PathBuf, String)> {
    let (mut folders, mut found) = (vec![folder.to_owned()], Vec::new());
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else if path.extension().is_some_and(|extension| extension == "rs") {
                let text = std::fs::read_to_string(&path).unwrap();
                found.push((path, text));
            }
        }
    }
    found
}

/// The fences of backticks in docs that rustdoc would take for Rust.
fn examples(text: &str) -> usize {
    let fences = text.lines().filter_map(|line| {
        let line = line.trim_start();
        line.strip_prefix("///").or(line.strip_prefix("//!"))?.trim_start().strip_prefix("```")
    });
    fences.step_by(2).filter(|language| !["text", "python", "toml", "json", "sh"].contains(language)).count()
}

#[test]
fn docs_have_no_example_that_no_test_runs() {
    assert_eq!(examples("//! ```text\n//! a\n//! ```\n    /// ```\n    /// b\n    /// ```\n"), 1);
    for (path, text) in crates().into_values().flat_map(|folder| sources(&folder.join("src"))) {
        let path = path.display();
        assert_eq!(examples(&text), 0, "{path}: doc tests are not run; make the example a test");
    }
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

/// The folders of all crates, by the folder's name.
fn crates() -> BTreeMap<String, PathBuf> {
    let project = project();
    let crates = std::fs::read_dir(project.join("crates")).unwrap().map(|entry| entry.unwrap().path());
    let others = ["daemon", "drivers", "sim"].map(|name| project.join(name));
    let name = |folder: &PathBuf| folder.file_name().unwrap().to_str().unwrap().to_owned();
    crates.chain(others).map(|folder| (name(&folder), folder)).collect()
}

#[test]
fn files_import_each_other_in_no_large_circle_and_in_none_between_folders() {
    let (mut files, mut forbidden) = (0, Vec::new());
    for (name, folder) in crates() {
        let graph = Graph::read(&folder.join("src"));
        files += graph.edges().len();
        forbidden.extend(forbidden_cycles(&graph).into_iter().map(|cycle| format!("{name}: {cycle}")));
    }
    assert!(forbidden.is_empty(), "{}", forbidden.join("\n"));
    assert!(files > 200, "only {files} files were read");
}

/// Names that several types may share, and why.
const SHARED_NAMES: [(&str, &str); 1] =
    [("Error", "what can go wrong in a module; its users write `module::Error`")];

/// Types of the same name that are visible beyond their files, each with those files.
fn doubles(graphs: &BTreeMap<String, Graph>) -> Vec<String> {
    let mut files: BTreeMap<&str, Vec<String>> = BTreeMap::new();
    for (crate_name, graph) in graphs {
        for (name, file) in graph.visible_types() {
            files.entry(name).or_default().push(format!("{crate_name}/src/{}", file.display()));
        }
    }
    files.retain(|name, files| files.len() > 1 && SHARED_NAMES.iter().all(|(shared, _)| shared != name));
    files.into_iter().map(|(name, files)| format!("{name}: {}", files.join(", "))).collect()
}

#[test]
fn no_two_types_that_others_see_have_the_same_name() {
    let graph = |(name, folder): (String, PathBuf)| (name, Graph::read(&folder.join("src")));
    let doubles = doubles(&crates().into_iter().map(graph).collect());
    assert!(doubles.is_empty(), "rename all but one of each:\n{}", doubles.join("\n"));
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
    // A circle between folders, one of its edges through a re-export.
    let cycles = forbidden_cycles(&Graph::of(&[
        ("lib.rs", "mod a; mod b; pub use b::c::Deep;"),
        ("a.rs", "use crate::Deep;"),
        ("b/mod.rs", "pub mod c;"),
        ("b/c.rs", "pub struct Deep; fn f() { crate::a::g() }"),
    ]));
    assert_eq!(cycles, ["{\"a.rs\", \"b/c.rs\"}"]);
    // Four files of one folder; a test does not count.
    let ring = |last: &str| {
        let cycles = forbidden_cycles(&Graph::of(&[
            ("lib.rs", "mod a; mod b; mod c; mod d;"),
            ("a.rs", "use crate::b::B; pub struct A;"),
            ("b.rs", "use super::c::C; pub struct B;"),
            ("c.rs", "use crate::{d::D}; pub struct C;"),
            ("d.rs", &format!("pub struct D; {last}")),
        ]));
        cycles.len()
    };
    assert_eq!(ring("use crate::a::A;"), 1);
    assert_eq!(ring("#[cfg(test)] mod tests { use crate::a::A; }"), 0);
    let imports = forbidden_imports(&Graph::of(&[
        ("lib.rs", "mod procedure; mod run;"),
        ("procedure/mod.rs", "mod film; mod lab; mod sweep; use self::sweep::f;"),
        ("procedure/lab.rs", "pub struct Lab;"),
        ("procedure/film/mod.rs", "use crate::procedure::sweep::f; use crate::procedure::lab::Lab;"),
        ("procedure/sweep/mod.rs", "use crate::run::Run; pub fn f() {}"),
        ("run/mod.rs", "use crate::procedure::sweep::f; pub struct Run;"),
    ]));
    assert_eq!(
        imports,
        ["procedure/film/mod.rs imports procedure/sweep/mod.rs", "run/mod.rs imports procedure/sweep/mod.rs"]
    );
}

#[test]
fn doubles_are_found() {
    let one = Graph::of(&[
        ("lib.rs", "pub mod a; mod b; pub struct Error;"),
        ("a.rs", "pub struct Line; struct Own; pub enum Kind { Line } mod c { pub trait Deep {} }"),
        (
            "b.rs",
            "pub(super) union Line { x: u8 } struct Own; #[cfg(test)] pub struct Kind; pub type Deep = u8;",
        ),
    ]);
    let two = Graph::of(&[("lib.rs", "pub(crate) trait Deep {} pub struct Error; pub fn Line() {}")]);
    let doubles = doubles(&[("one".to_owned(), one), ("two".to_owned(), two)].into());
    assert_eq!(doubles, ["Deep: one/src/a.rs, two/src/lib.rs", "Line: one/src/a.rs, one/src/b.rs"]);
}

/// What `x/mod.rs` names, if this is its text beside two children, a module `other` and the crate's root.
fn named_by(text: &str) -> Vec<String> {
    let graph = Graph::of(&[
        ("lib.rs", "mod other; mod x; pub fn root() {}"),
        ("other.rs", "pub struct Other; pub fn call() {}"),
        ("x/mod.rs", text),
        ("x/a.rs", "pub struct A; pub enum E { V } pub trait T {} pub fn f() {}"),
        ("x/b.rs", "pub use super::a::A as Again; pub struct B;"),
    ]);
    graph.edges()[Path::new("x/mod.rs")].iter().map(|file| file.display().to_string()).collect()
}

#[test]
fn every_way_to_name_an_item_is_an_edge_to_the_file_that_defines_it() {
    let named_by = |text: &str| named_by(&format!("mod a; mod b; {text}"));
    for text in [
        "use a::A;",
        "use self::a::{A, E};",
        "use crate::x::a::f as g;",
        "fn g() -> a::A { a::A }",
        "struct S { field: Vec<a::A> }",
        "impl a::T for u8 {}",
        "fn g() { self::a::f() }",
        "fn g() { super::x::a::f() }",
        "fn g(e: &a::E) -> bool { matches!(e, a::E::V) }",
        "fn g() { println!(\"{}\", [a::f()].len()) }",
        "macro_rules! g { () => { $crate::x::a::f() } }",
        "#[wrapped(by = a::f)] struct S;",
        "mod inner { use super::a::A; }",
        "use self::inner::A as I; mod inner { pub use super::a::A; }",
        // Through imports of modules and of everything, and through re-exports.
        "use crate::x; fn g() { x::a::f() }",
        "use a as c; fn g() { c::f() }",
        "use a::*; fn g() { f() }",
        "use b::Again;",
        "fn g() -> b::Again { loop {} }",
        "pub use a::f; fn g() { f() }",
        "pub(crate) use b::Again; struct S(Again);",
    ] {
        assert_eq!(named_by(text), ["x/a.rs"], "{text}");
    }
    assert_eq!(named_by("use crate::root;"), ["lib.rs"]);
    assert_eq!(named_by("use crate::other::{self, Other};"), ["other.rs"]);
    assert_eq!(named_by("use super::other; fn g() { other::call(); b::B; }"), ["other.rs", "x/b.rs"]);
    // What a macro may have defined.
    assert_eq!(named_by("use a::unknown;"), ["x/a.rs"]);
    for text in [
        "",
        "pub use a::A;",
        "pub(crate) use a::{E, f};",
        "pub use a::*;",
        "use crate::other;",
        "fn g(a: u8) -> u8 { a }",
        "use a_crate::a::A; fn g() { ::a::f() }",
        "#[cfg(test)] use a::A;",
        "#[cfg(test)] fn g() { a::f() }",
        "struct S; impl S { #[cfg(test)] fn g() { a::f() } }",
    ] {
        assert_eq!(named_by(text), [""; 0], "{text}");
    }
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
