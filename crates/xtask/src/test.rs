//! `cargo xtask test`: all checks.

use crate::run::{Done, cargo, run};
use crate::{guest, packages, python};

/// Whether to run the tests in the kernel guest.
#[derive(Clone, Copy, PartialEq)]
pub enum Guest {
    Run,
    Skip,
}

/// Installs missing packages, then checks format, lints, fuzz targets, tests, doc tests, and tests in the kernel guest.
pub fn test(wanted: Guest) -> Done {
    packages::install()?;
    // Packages that read our files in practice.
    let python = python::environment("python", "requirements.txt")?;
    run(cargo().args(["fmt", "--all", "--check"]))?;
    run(cargo().args(["clippy", "--workspace", "--all-targets", "--", "-D", "warnings"]))?;
    run(cargo().args(["clippy", "--workspace", "--all-targets", "--all-features", "--", "-D", "warnings"]))?;
    // A separate workspace, which nothing else compiles.
    run(cargo().args(["check", "--manifest-path", "fuzz/Cargo.toml"]))?;
    run(cargo().args(["test", "--workspace", "--all-features"]).env("RAYSWEEP_PYTHON", python))?;
    match wanted {
        Guest::Run => guest::guest(&[]),
        Guest::Skip => {
            println!("{}", guest::skipped());
            Ok(())
        }
    }
}
