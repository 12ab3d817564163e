//! `cargo xtask test`: everything that must hold.

use std::path::PathBuf;
use std::process::Command;

use crate::packages;
use crate::run::{Done, cargo, root, run, target};

/// Installs what is missing, then format, lints, tests, doc tests.
pub fn test() -> Done {
    packages::install()?;
    let python = python()?;
    run(cargo().args(["fmt", "--all", "--check"]))?;
    run(cargo().args(["clippy", "--workspace", "--all-targets", "--", "-D", "warnings"]))?;
    run(cargo().args(["clippy", "--workspace", "--all-targets", "--all-features", "--", "-D", "warnings"]))?;
    run(cargo().args(["test", "--workspace", "--all-features"]).env("RAYSWEEP_PYTHON", python))
}

/// A Python with the packages that read our files in real life.
fn python() -> Done<PathBuf> {
    let requirements = root().join("tests/python/requirements.txt");
    let wanted =
        std::fs::read(&requirements).map_err(|error| format!("{}: {error}", requirements.display()))?;
    let venv = target().join("python");
    let (python, installed) = (venv.join("bin/python"), venv.join("requirements.txt"));
    if std::fs::read(&installed).is_ok_and(|installed| installed == wanted) {
        return Ok(python);
    }
    eprintln!("making a Python environment with what tests/python/requirements.txt names");
    run(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&venv))?;
    run(Command::new(&python).args(["-m", "pip", "install", "--quiet", "--requirement"]).arg(&requirements))?;
    std::fs::write(&installed, wanted).map_err(|error| format!("{}: {error}", installed.display()))?;
    Ok(python)
}
