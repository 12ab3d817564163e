//! `cargo xtask figures`: the paper's figures on the simulated rig, as one page.

use std::process::Command;

use crate::python;
use crate::run::{Done, cargo, root, run, say, target};

/// Builds, renders the scenes' true transport, runs the plans, writes the page; fails if a figure misses its bound.
pub fn figures() -> Done {
    let python = python::environment("python", "requirements.txt")?;
    let profile = ["--profile", "demo"];
    run(cargo().args(["build", "--package", "raysweep", "--bins", "--no-default-features"]).args(profile))?;
    let scenes = target().join("figures-scenes");
    run(cargo()
        .args(["run", "--quiet", "--package", "raysweep-sim", "--example", "scenes"])
        .args(profile)
        .arg("--")
        .arg(&scenes))?;
    let folder = target().join("figures");
    match std::fs::remove_dir_all(&folder) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            return Err(format!("cannot remove {}: {error}", folder.display()));
        }
        _ => {}
    }
    run(Command::new(&python).arg(root().join("tests/python/figures.py")).args([
        target().join("demo"),
        scenes,
        root(),
        folder.clone(),
    ]))?;
    say(&format!("page: {}", folder.join("index.html").display()))
}
