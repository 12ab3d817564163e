//! `cargo xtask guest`: the drivers' hardware tests against real kernel drivers, in a small QEMU guest.
//!
//! The tests are ordinary integration tests, most of them in the crate `drivers`, marked `#[ignore]` because they need
//! devices. The guest runs a stock Debian kernel in software emulation and mounts the host's `/usr` read-only, so that
//! it runs the same executables that cargo built. Tests reach QEMU's monitor (QMP) at `/dev/virtio-ports/qmp`, with
//! which they plug and unplug devices and take screen dumps. The dumps are written to `/share`, which is `guest/run` in
//! the host's target folder. Timing in the guest is meaningless: tests check order, counts, values and kinds of errors.

mod initramfs;
mod kernel;
mod pipe;
mod qemu;
mod report;
mod script;
pub mod systemd;
mod table;

use std::path::PathBuf;
use std::time::Instant;

use crate::binaries::{self, Binary};
use crate::packages;
use crate::run::{Done, target};
use kernel::GuestKernel;
use qemu::GuestClock;
use table::{GuestTest, TESTS};

/// Runs the given tests, or all.
pub fn guest(names: &[&str]) -> Done {
    let tests = chosen(names)?;
    packages::install()?;
    let folder = target().join("guest");
    let kernel = GuestKernel::fetch(&folder)?;
    let executables = build(&tests)?;
    let began = Instant::now();
    let run = folder.join("run");
    let _ = std::fs::remove_dir_all(&run);
    for Executable { test, name, path } in &executables {
        let folder = run.join(test);
        let placed = std::fs::create_dir_all(&folder).and_then(|()| std::fs::copy(path, folder.join(name)));
        placed.map_err(|error| format!("{}: {error}", folder.join(name).display()))?;
    }
    initramfs::write(&run.join("initramfs"), &kernel, &initramfs::BOOT_MODULES, initramfs::INIT)?;
    println!("kernel guest: Linux {}, {} tests", kernel.release(), tests.len());
    let mut checks = 0;
    for clock in [GuestClock::Instructions, GuestClock::Host] {
        let tests: Vec<_> = tests.iter().copied().filter(|test| test.clock() == clock).collect();
        if tests.is_empty() {
            continue;
        }
        let script = run.join("run.sh");
        std::fs::write(&script, script::script(&tests))
            .map_err(|error| format!("{}: {error}", script.display()))?;
        let mut machine = qemu::Machine::start(&kernel, &run, &tests, clock)?;
        let names: Vec<&str> = tests.iter().map(|test| test.name).collect();
        checks += report::follow(&mut machine, &run, &names, script::TEST_LIMIT_S)?;
    }
    println!("kernel guest: {checks} checks passed in {:.0} s", began.elapsed().as_secs_f64());
    Ok(())
}

/// Message when the guests are skipped on request.
pub fn skipped() -> String {
    let names: Vec<&str> = TESTS.iter().map(|test| test.name).collect();
    format!(
        "guests: SKIPPED (--no-guest); not tested: the package under systemd; against the kernel: {}",
        names.join(", ")
    )
}

fn chosen(names: &[&str]) -> Done<Vec<&'static GuestTest>> {
    if let Some(unknown) = names.iter().find(|&&name| TESTS.iter().all(|test| test.name != name)) {
        let known: Vec<&str> = TESTS.iter().map(|test| test.name).collect();
        return Err(format!("the guest has no test `{unknown}`; it has {}", known.join(", ")));
    }
    Ok(TESTS.iter().filter(|test| names.is_empty() || names.contains(&test.name)).collect())
}

/// A test or program to copy to a test's folder.
struct Executable {
    test: &'static str,
    name: &'static str,
    path: PathBuf,
}

/// Builds the tests by the very command of `cargo xtask test`, so that both share build artifacts: selecting single
/// tests would resolve other features of the dependencies and build them again.
fn build(tests: &[&GuestTest]) -> Done<Vec<Executable>> {
    let binaries = binaries::build()?;
    let mut all = Vec::new();
    for GuestTest { name: test, programs, .. } in tests {
        all.push(Executable { test, name: "test", path: find(&binaries, test, true)? });
        for name in *programs {
            all.push(Executable { test, name, path: find(&binaries, name, false)? });
        }
    }
    Ok(all)
}

/// The path of a test, or of a program, whose own unit tests have its name too.
fn find(binaries: &[Binary], name: &str, is_test: bool) -> Done<PathBuf> {
    let found = binaries.iter().find(|binary| binary.is_test == is_test && binary.name() == name);
    found.map(|binary| binary.path.clone()).ok_or_else(|| format!("cargo built no {name}"))
}

/// Builds programs with the tests of the daemon, and so with what `cargo xtask test` has built; returns their folder.
fn build_programs(names: &[&str]) -> Done<PathBuf> {
    let test =
        TESTS.iter().find(|test| test.programs.contains(&"raysweepd")).ok_or("no test of the daemon")?;
    let built = build(&[test])?;
    let daemon = built.iter().find(|built| built.name == "raysweepd").ok_or("cargo built no raysweepd")?;
    let folder = daemon.path.parent().ok_or("raysweepd in no folder")?;
    match names.iter().find(|name| !folder.join(name).exists()) {
        Some(missing) => Err(format!("cargo built no {missing} in {}", folder.display())),
        None => Ok(folder.to_owned()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_program_is_not_taken_for_its_own_unit_tests() {
        let binary = |path: &str, is_test| Binary {
            path: path.into(),
            folder: PathBuf::new(),
            kind: "bin".into(),
            is_test,
        };
        let binaries = [binary("/a/deps/raysweepd-89ab", true), binary("/a/raysweepd", false)];
        assert_eq!(find(&binaries, "raysweepd", false), Ok(PathBuf::from("/a/raysweepd")));
        assert_eq!(find(&binaries, "raysweepd", true), Ok(PathBuf::from("/a/deps/raysweepd-89ab")));
        assert!(find(&binaries, "raysweep", false).is_err());
    }

    #[test]
    fn unknown_tests_are_told_what_there_is() {
        let error = chosen(&["nonsense"]).err().unwrap();
        assert!(error.contains("nonsense") && error.contains(TESTS[0].name), "{error}");
        assert_eq!(chosen(&[]).ok().unwrap().len(), TESTS.len());
    }
}
