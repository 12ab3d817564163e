//! `cargo xtask test`: everything that must hold.

use crate::run::{Done, cargo, run};
use crate::{packages, python};

/// Installs what is missing, then format, lints, tests, doc tests.
pub fn test() -> Done {
    packages::install()?;
    // Packages that read our files in real life.
    let python = python::environment("python", "requirements.txt")?;
    run(cargo().args(["fmt", "--all", "--check"]))?;
    run(cargo().args(["clippy", "--workspace", "--all-targets", "--", "-D", "warnings"]))?;
    run(cargo().args(["clippy", "--workspace", "--all-targets", "--all-features", "--", "-D", "warnings"]))?;
    run(cargo().args(["test", "--workspace", "--all-features"]).env("RAYSWEEP_PYTHON", python))
}
