//! `cargo xtask test`: everything that must hold.

use crate::run::{Done, cargo, run};
use crate::{guest, packages, python};

/// Whether the tests in the kernel guest belong to it.
#[derive(Clone, Copy, PartialEq)]
pub enum Guest {
    Run,
    Skip,
}

/// Installs what is missing, then format, lints, the fuzz targets' check, tests, doc tests, tests in the kernel guest.
pub fn test(wanted: Guest) -> Done {
    packages::install()?;
    // Packages that read our files in real life.
    let python = python::environment("python", "requirements.txt")?;
    run(cargo().args(["fmt", "--all", "--check"]))?;
    run(cargo().args(["clippy", "--workspace", "--all-targets", "--", "-D", "warnings"]))?;
    run(cargo().args(["clippy", "--workspace", "--all-targets", "--all-features", "--", "-D", "warnings"]))?;
    // A workspace of its own, which nothing else compiles.
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
