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
use std::process::Stdio;
use std::time::Instant;

use crate::packages;
use crate::run::{Done, cargo, target};
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

/// Message when the guest is skipped on request.
pub fn skipped() -> String {
    let names: Vec<&str> = TESTS.iter().map(|test| test.name).collect();
    format!("kernel guest: SKIPPED (--no-guest); not tested against the kernel: {}", names.join(", "))
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
    let mut build = cargo();
    build.args([
        "test",
        "--workspace",
        "--all-features",
        "--no-run",
        "--message-format=json-render-diagnostics",
    ]);
    eprintln!("building the guest's tests");
    let output =
        build.stderr(Stdio::inherit()).output().map_err(|error| format!("cannot start cargo: {error}"))?;
    if !output.status.success() {
        return Err("the guest's tests do not build; see the compiler's messages above".to_owned());
    }
    let messages = String::from_utf8_lossy(&output.stdout);
    let built = |test, name, path: Option<PathBuf>, what: &str| {
        path.map(|path| Executable { test, name, path }).ok_or_else(|| format!("cargo built no {what}"))
    };
    let mut all = Vec::new();
    for GuestTest { name: test, programs, .. } in tests {
        all.push(built(test, "test", test_executable(&messages, test), &format!("test {test}"))?);
        for name in *programs {
            all.push(built(test, name, program(&messages, name), &format!("program {name}"))?);
        }
    }
    Ok(all)
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

/// Paths of the executables in cargo's JSON messages.
fn executables(messages: &str) -> impl Iterator<Item = PathBuf> {
    messages
        .lines()
        .filter_map(|line| line.split_once("\"executable\":\"")?.1.split_once('"'))
        .map(|(path, _)| PathBuf::from(path))
}

/// The executable of a test: named after the test, with a dash and a hash.
fn test_executable(messages: &str, name: &str) -> Option<PathBuf> {
    executables(messages).find(|path| {
        let file = path.file_name().map(|file| file.to_string_lossy().into_owned()).unwrap_or_default();
        file.rsplit_once('-').is_some_and(|(stem, _)| stem == name)
    })
}

/// The executable of a program, which cargo builds together with the tests of its crate; it has the program's name.
fn program(messages: &str, name: &str) -> Option<PathBuf> {
    executables(messages).find(|path| path.file_name().is_some_and(|file| file == name))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn executables_are_found_by_their_names() {
        let messages = r#"{"reason":"compiler-artifact","executable":null}
{"reason":"compiler-artifact","executable":"/a/deps/guest_drm_more-0123","fresh":true}
{"reason":"compiler-artifact","executable":"/a/deps/guest_drm-4567","fresh":true}
{"reason":"compiler-artifact","executable":"/a/guest","fresh":true}"#;
        assert_eq!(test_executable(messages, "guest_drm"), Some(PathBuf::from("/a/deps/guest_drm-4567")));
        assert_eq!(test_executable(messages, "guest"), None);
        assert_eq!(program(messages, "guest"), Some(PathBuf::from("/a/guest")));
        assert_eq!(program(messages, "guest_drm"), None);
    }

    #[test]
    fn unknown_tests_are_told_what_there_is() {
        let error = chosen(&["nonsense"]).err().unwrap();
        assert!(error.contains("nonsense") && error.contains(TESTS[0].name), "{error}");
        assert_eq!(chosen(&[]).ok().unwrap().len(), TESTS.len());
    }
}
