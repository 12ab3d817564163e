//! `cargo xtask guest`: the drivers' hardware tests against real kernel drivers, in a small QEMU guest.
//!
//! The tests are ordinary integration tests, most of them in the crate `drivers`, marked `#[ignore]` because they need
//! devices. The guest runs a stock Debian kernel in software emulation and mounts the host's `/usr` read-only, so that
//! it runs the same executables that cargo built. Tests reach QEMU's monitor (QMP) at `/dev/virtio-ports/qmp`, with
//! which they plug and unplug devices and take screen dumps. The dumps are written to `/share`, which is `guest/run` in
//! the host's target folder. Timing in the guest is meaningless: tests check order, counts, values and kinds of errors.

mod initramfs;
mod kernel;
mod qemu;
mod report;
mod script;

use std::path::PathBuf;
use std::process::Stdio;
use std::time::Instant;

use crate::packages;
use crate::run::{Done, cargo, target};
use kernel::Kernel;

/// An integration test and its requirements on the guest.
pub struct GuestTest {
    /// File name in the crate's `tests` folder, without `.rs`.
    name: &'static str,
    /// Programs of that crate that the test starts; they are placed next to it.
    programs: &'static [&'static str],
    /// Kernel modules with their parameters, loaded just before the test.
    modules: &'static [&'static str],
    /// QEMU devices present from the start; tests plug in others through QMP.
    devices: &'static [&'static str],
    /// QEMU character devices whose other end the test opens as `/dev/virtio-ports/NAME`.
    pipes: &'static [&'static str],
    /// Environment variables that tell the test its devices.
    environment: &'static [(&'static str, &'static str)],
}

/// To add a test, add its line here, and its modules' folder in `kernel.rs` if that is new.
const TESTS: &[GuestTest] = &[
    GuestTest {
        name: "guest_daemon",
        programs: &["raysweepd"],
        modules: &["vhci-hcd"],
        devices: &[],
        pipes: &[],
        environment: &[],
    },
    GuestTest {
        name: "guest_drm",
        programs: &[],
        modules: &["virtio-gpu"],
        devices: &["virtio-gpu-pci"],
        pipes: &[],
        environment: &[("RAYSWEEP_DRM_CARD", "/dev/dri/card0")],
    },
    GuestTest {
        name: "guest_fx2lafw",
        programs: &[],
        modules: &["vhci-hcd"],
        devices: &[],
        pipes: &[],
        environment: &[],
    },
    GuestTest {
        name: "guest_mirror",
        programs: &[],
        modules: &["xhci_pci", "ftdi_sio"],
        devices: &[],
        pipes: &["serial"],
        environment: &[],
    },
    GuestTest {
        name: "guest_modemline",
        programs: &[],
        modules: &["vhci-hcd", "ftdi_sio", "pps-ldisc"],
        devices: &[],
        pipes: &[],
        environment: &[],
    },
    GuestTest {
        name: "guest_serial",
        programs: &[],
        modules: &["xhci_pci", "ftdi_sio"],
        devices: &[],
        pipes: &["serial"],
        environment: &[],
    },
    GuestTest {
        name: "v4l2_vivid",
        programs: &[],
        modules: &["vivid n_devs=1 node_types=0x1 num_inputs=1 input_types=3"],
        devices: &[],
        pipes: &[],
        environment: &[("RAYSWEEP_V4L2_DEVICE", "/dev/video0")],
    },
];

/// Runs the given tests, or all.
pub fn guest(names: &[&str]) -> Done {
    let tests = chosen(names)?;
    packages::install()?;
    let folder = target().join("guest");
    let kernel = Kernel::fetch(&folder)?;
    let executables = build(&tests)?;
    let began = Instant::now();
    let run = folder.join("run");
    let _ = std::fs::remove_dir_all(&run);
    for Executable { test, name, path } in &executables {
        let folder = run.join(test);
        let placed = std::fs::create_dir_all(&folder).and_then(|()| std::fs::copy(path, folder.join(name)));
        placed.map_err(|error| format!("{}: {error}", folder.join(name).display()))?;
    }
    let script = run.join("run.sh");
    std::fs::write(&script, script::script(&tests))
        .map_err(|error| format!("{}: {error}", script.display()))?;
    initramfs::write(&run.join("initramfs"), &kernel)?;
    println!("kernel guest: Linux {}, {} tests", kernel.release(), tests.len());
    let mut machine = qemu::Machine::start(&kernel, &run, &tests)?;
    let checks = report::follow(&mut machine, &run, &tests)?;
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

/// Builds the tests with the same features as `cargo xtask test`, so that both share build artifacts.
fn build(tests: &[&GuestTest]) -> Done<Vec<Executable>> {
    let mut build = cargo();
    build.args([
        "test",
        "--workspace",
        "--all-features",
        "--no-run",
        "--message-format=json-render-diagnostics",
    ]);
    for test in tests {
        build.args(["--test", test.name]);
    }
    eprintln!("building the guest's tests");
    let output =
        build.stderr(Stdio::inherit()).output().map_err(|error| format!("cannot start cargo: {error}"))?;
    if !output.status.success() {
        return Err("the guest's tests do not build; the compiler's messages stand above".to_owned());
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
