//! `cargo xtask test`: all checks.

use std::process::Command;

use crate::run::{Done, all, cargo, run, say, target};
use crate::{binaries, guest, packages, python, rootfs, space};

/// The most that all of this command has on the disk of the target folder, without incremental files, if temporary files
/// are on it too.
const TARGET_GIB: u64 = 11;
/// What cargo's incremental files add, unless CARGO_INCREMENTAL forbids them.
const INCREMENTAL_GIB: u64 = 3;
/// What tests that run at once have in the folder for temporary files; and what is built anew after a small change.
const TEMPORARY_GIB: u64 = 2;

/// Whether to run the tests in virtual machines.
#[derive(Clone, Copy, PartialEq)]
pub enum Guest {
    Run,
    Skip,
}

/// Installs missing packages, then checks format, lints, tests, and tests in both guests.
pub fn test(wanted: Guest) -> Done {
    has_components()?;
    has_networks()?;
    has_space()?;
    packages::install()?;
    // Packages that read our files in practice; they are downloaded while we compile.
    let python = std::thread::spawn(|| python::environment("python", "requirements.txt"));
    run(cargo().args(["fmt", "--all", "--check"]))?;
    let clippy = |what: &[&str]| {
        run(cargo().args(["clippy", "--all-targets"]).args(what).args(["--", "-D", "warnings"]))
    };
    clippy(&["--workspace", "--all-features"])?;
    // What has features must be clean with the default ones alone, too.
    clippy(&["--package", "raysweep", "--package", "raysweep-drivers"])?;
    let built = binaries::build()?;
    let python =
        python.join().unwrap_or_else(|_| Err("the Python environment's thread panicked".to_owned()))?;
    has_space()?;
    // All failures at once: the next look at them is far away.
    let parts = std::thread::scope(|scope| {
        // Beside the tests, many of which wait for the time of devices, so that no core is idle at the end.
        let guests = scope.spawn(|| match wanted {
            Guest::Run => guest::both(&built),
            Guest::Skip => Ok(()),
        });
        let tested = binaries::run_tests(&built, &[("RAYSWEEP_PYTHON", &python)]);
        [tested, guests.join().unwrap_or_else(|_| Err("the guests' thread panicked".to_owned()))]
    });
    all(parts)?;
    match wanted {
        Guest::Run => Ok(()),
        Guest::Skip => say(&guest::skipped()),
    }
}

/// Fails, before anything is installed or built, where tests cannot have networks of their own, in which simulated
/// cameras use the ports and the discovery of real ones.
fn has_networks() -> Done {
    let Err(error) = unshare_network() else { return Ok(()) };
    let remedy = if rootfs::is_root() {
        "permit it, as containers do with `--cap-add SYS_ADMIN`"
    } else {
        "be root: sudo env \"PATH=$PATH\" \"HOME=$HOME\" cargo xtask test"
    };
    Err(format!("the tests need networks of their own, and `unshare --net` fails here ({error}); {remedy}"))
}

fn unshare_network() -> Done {
    let tried = Command::new("unshare").args(["--net", "true"]).output();
    let output = tried.map_err(|error| error.to_string())?;
    match output.status.success() {
        true => Ok(()),
        false => Err(String::from_utf8_lossy(&output.stderr).trim().to_owned()),
    }
}

/// Fails where the build or the tests would fill the disk.
fn has_space() -> Done {
    let target = target();
    // What other commands have left there saves nothing.
    let taken_bytes: u64 = ["debug", "guest"].iter().map(|name| space::taken_bytes(&target.join(name))).sum();
    let is_incremental = std::env::var_os("CARGO_INCREMENTAL").is_none_or(|value| value != "0");
    let needed_gib = TARGET_GIB + if is_incremental { INCREMENTAL_GIB } else { 0 };
    let missing_gib = needed_gib.saturating_sub(taken_bytes / space::GIB).max(TEMPORARY_GIB);
    let remedy = "make room, or name a folder on another disk by CARGO_TARGET_DIR";
    space::require(&target, missing_gib, "what is made there may take another", remedy)?;
    let remedy = "make room, or name a folder on another disk by TMPDIR";
    space::require(&std::env::temp_dir(), TEMPORARY_GIB, "the tests write up to", remedy)
}

/// Fails without rustfmt or clippy, which `rustup` can leave out, before anything is installed or built.
fn has_components() -> Done {
    let starts =
        |name: &&str| cargo().args([*name, "--version"]).output().is_ok_and(|it| it.status.success());
    if ["fmt", "clippy"].iter().all(starts) {
        return Ok(());
    }
    Err("`cargo xtask test` needs rustfmt and clippy: rustup component add rustfmt clippy".to_owned())
}
