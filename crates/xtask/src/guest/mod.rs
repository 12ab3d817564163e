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
mod systemd;
mod table;

use std::path::PathBuf;
use std::time::Instant;

use crate::binaries::{self, Binary};
use crate::packages;
use crate::run::{Done, all, target};
use kernel::GuestKernel;
use qemu::GuestClock;
use table::{GuestTest, TESTS};

/// Runs the given tests of the drivers, or all.
pub fn drivers(names: &[&str]) -> Done {
    let tests = chosen(names)?;
    packages::install()?;
    Ready::make(&binaries::build()?)?.drivers(&tests)
}

/// Runs the package under systemd.
pub fn systemd() -> Done {
    packages::install()?;
    Ready::make(&binaries::build()?)?.systemd()
}

/// Runs both guests with what is built and installed, one after the other: each keeps two cores busy.
pub fn both(binaries: &[Binary]) -> Done {
    let (tests, ready) = (chosen(&[])?, Ready::make(binaries)?);
    let named = |name: &str, done: Done| done.map_err(|error| format!("{name}: {error}"));
    all([named("kernel guest", ready.drivers(&tests)), named("systemd guest", ready.systemd())])
}

/// What every guest needs.
struct Ready<'a> {
    /// What guests leave is in folders of theirs in it.
    folder: PathBuf,
    kernel: GuestKernel,
    /// Built by the very command of `cargo xtask test`, so that both share build artifacts: selecting single tests would
    /// resolve other features of the dependencies and build them again.
    binaries: &'a [Binary],
}

impl<'a> Ready<'a> {
    fn make(binaries: &'a [Binary]) -> Done<Self> {
        let folder = target().join("guest");
        let kernel = GuestKernel::fetch(&folder)?;
        Ok(Self { folder, kernel, binaries })
    }

    fn drivers(&self, tests: &[&GuestTest]) -> Done {
        let began = Instant::now();
        let run = self.folder.join("run");
        let _ = std::fs::remove_dir_all(&run);
        for GuestTest { name: test, programs, .. } in tests {
            let folder = run.join(test);
            std::fs::create_dir_all(&folder).map_err(|error| format!("{}: {error}", folder.display()))?;
            let programs = programs.iter().map(|name| (*name, find(self.binaries, name, false)));
            for (name, path) in [("test", find(self.binaries, test, true))].into_iter().chain(programs) {
                let copy = folder.join(name);
                std::fs::copy(path?, &copy).map_err(|error| format!("{}: {error}", copy.display()))?;
            }
        }
        initramfs::write(&run.join("initramfs"), &self.kernel, &initramfs::BOOT_MODULES, initramfs::INIT)?;
        println!("kernel guest: Linux {}, {} tests", self.kernel.release(), tests.len());
        let mut checks = 0;
        for clock in [GuestClock::Instructions, GuestClock::Host] {
            let tests: Vec<_> = tests.iter().copied().filter(|test| test.clock() == clock).collect();
            if tests.is_empty() {
                continue;
            }
            let script = run.join("run.sh");
            std::fs::write(&script, script::script(&tests))
                .map_err(|error| format!("{}: {error}", script.display()))?;
            let mut machine = qemu::Machine::start(&self.kernel, &run, &tests, clock)?;
            let names: Vec<&str> = tests.iter().map(|test| test.name).collect();
            checks += report::follow(&mut machine, &run, &names, script::TEST_LIMIT_S)?;
        }
        println!("kernel guest: {checks} checks passed in {:.0} s", began.elapsed().as_secs_f64());
        Ok(())
    }

    fn systemd(&self) -> Done {
        let daemon = find(self.binaries, "raysweepd", false)?;
        let programs = daemon.parent().ok_or("raysweepd in no folder")?;
        systemd::run(&self.folder, &self.kernel, programs)
    }
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

/// The path of a test, or of a program, whose own unit tests have its name too.
fn find(binaries: &[Binary], name: &str, is_test: bool) -> Done<PathBuf> {
    let found = binaries.iter().find(|binary| binary.is_test == is_test && binary.name() == name);
    found.map(|binary| binary.path.clone()).ok_or_else(|| format!("cargo built no {name}"))
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
