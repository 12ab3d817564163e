//! Python environments under the target folder.

use std::path::PathBuf;
use std::process::Command;

use crate::run::{Done, root, run, target};

/// Returns the Python of an environment with the packages listed in `tests/python/<requirements>`. The environment is
/// recreated when that file has changed or the system's Python, to which it links, is gone.
pub fn environment(name: &str, requirements: &str) -> Done<PathBuf> {
    let requirements = root().join("tests/python").join(requirements);
    let wanted =
        std::fs::read(&requirements).map_err(|error| format!("{}: {error}", requirements.display()))?;
    let venv = target().join(name);
    let (python, installed) = (venv.join("bin/python"), venv.join("requirements.txt"));
    let starts = || Command::new(&python).arg("--version").output().is_ok_and(|it| it.status.success());
    if std::fs::read(&installed).is_ok_and(|installed| installed == wanted) && starts() {
        return Ok(python);
    }
    eprintln!("making a Python environment with what {} names", requirements.display());
    run(Command::new("python3").args(["-m", "venv", "--clear"]).arg(&venv))?;
    run(Command::new(&python).args(["-m", "pip", "install", "--quiet", "--requirement"]).arg(&requirements))?;
    std::fs::write(&installed, wanted).map_err(|error| format!("{}: {error}", installed.display()))?;
    Ok(python)
}
