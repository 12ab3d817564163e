//! `cargo xtask guest`: the drivers' hardware tests against real kernel drivers, in a small QEMU guest.
//!
//! The tests are ordinary integration tests of the crate `drivers`, marked `#[ignore]` since they need devices. The guest
//! runs a stock Debian kernel in software emulation, mounts the host's `/usr` read-only, and so runs the very
//! executables that cargo built. A test has QEMU's monitor (QMP) at `/dev/virtio-ports/qmp`, with which it plugs and
//! unplugs devices and takes screen dumps; these land in `/share`, which the host keeps in `guest/run` of its
//! target folder. Timing in the guest says nothing: tests assert order, counts, values and kinds of errors.

mod initramfs;
mod kernel;
mod qemu;
mod report;
mod script;

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::process::Stdio;
use std::time::Instant;

use crate::packages;
use crate::run::{Done, cargo, target};
use kernel::Kernel;

/// One integration test of `drivers` and the guest that it needs.
pub struct GuestTest {
    /// The file in `drivers/tests`, without `.rs`.
    name: &'static str,
    /// Kernel modules with their parameters, loaded right before the test.
    modules: &'static [&'static str],
    /// Devices of the guest that QEMU must have from the start; others are plugged in by the test, through QMP.
    devices: &'static [&'static str],
    /// QEMU's character devices whose other end the test holds, as `/dev/virtio-ports/NAME`.
    pipes: &'static [&'static str],
    /// Names the devices to the test.
    environment: &'static [(&'static str, &'static str)],
}

/// Adding a test is adding its line here, and its modules' folder in `kernel.rs` if it has a new one.
const TESTS: &[GuestTest] = &[
    GuestTest {
        name: "guest_drm",
        modules: &["virtio-gpu"],
        devices: &["virtio-gpu-pci"],
        pipes: &[],
        environment: &[("RAYSWEEP_DRM_CARD", "/dev/dri/card0")],
    },
    GuestTest { name: "guest_fx2lafw", modules: &["vhci-hcd"], devices: &[], pipes: &[], environment: &[] },
    GuestTest {
        name: "guest_mirror",
        modules: &["xhci_pci", "ftdi_sio"],
        devices: &[],
        pipes: &["serial"],
        environment: &[],
    },
    GuestTest {
        name: "guest_modemline",
        modules: &["vhci-hcd", "ftdi_sio", "pps-ldisc"],
        devices: &[],
        pipes: &[],
        environment: &[],
    },
    GuestTest {
        name: "guest_serial",
        modules: &["xhci_pci", "ftdi_sio"],
        devices: &[],
        pipes: &["serial"],
        environment: &[],
    },
    GuestTest {
        name: "v4l2_vivid",
        modules: &["vivid n_devs=1 node_types=0x1 num_inputs=1 input_types=3"],
        devices: &[],
        pipes: &[],
        environment: &[("RAYSWEEP_V4L2_DEVICE", "/dev/video0")],
    },
];

/// Runs the tests that are named, or all.
pub fn guest(names: &[&str]) -> Done {
    packages::install()?;
    let tests = chosen(names)?;
    let folder = target().join("guest");
    let kernel = Kernel::fetch(&folder)?;
    let executables = build(&tests)?;
    let began = Instant::now();
    let run = folder.join("run");
    let _ = std::fs::remove_dir_all(&run);
    let place = |name: &str, executable: &PathBuf| {
        let folder = run.join(name);
        std::fs::create_dir_all(&folder)?;
        std::fs::copy(executable, folder.join("test"))
    };
    for (name, executable) in &executables {
        place(name, executable).map_err(|error| format!("{}: {error}", run.join(name).display()))?;
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

/// What is said when the guest is not wanted.
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

/// Builds the tests with the very features that `cargo xtask test` uses, so that both share what is built.
fn build(tests: &[&GuestTest]) -> Done<BTreeMap<&'static str, PathBuf>> {
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
    tests
        .iter()
        .map(|test| {
            let executable = executable(&messages, test.name);
            executable
                .map(|path| (test.name, path))
                .ok_or_else(|| format!("cargo built no test {}", test.name))
        })
        .collect()
}

/// The executable of a test in cargo's JSON messages: a file named after the test, a dash and a hash.
fn executable(messages: &str, name: &str) -> Option<PathBuf> {
    let paths = messages.lines().filter_map(|line| line.split_once("\"executable\":\"")?.1.split_once('"'));
    paths.map(|(path, _)| PathBuf::from(path)).find(|path| {
        let file = path.file_name().map(|file| file.to_string_lossy().into_owned()).unwrap_or_default();
        file.rsplit_once('-').is_some_and(|(stem, _)| stem == name)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn executables_are_found_by_their_names() {
        let messages = r#"{"reason":"compiler-artifact","executable":null}
{"reason":"compiler-artifact","executable":"/a/deps/guest_drm_more-0123","fresh":true}
{"reason":"compiler-artifact","executable":"/a/deps/guest_drm-4567","fresh":true}"#;
        assert_eq!(executable(messages, "guest_drm"), Some(PathBuf::from("/a/deps/guest_drm-4567")));
        assert_eq!(executable(messages, "guest"), None);
    }

    #[test]
    fn unknown_tests_are_told_what_there_is() {
        let error = chosen(&["nonsense"]).err().unwrap();
        assert!(error.contains("nonsense") && error.contains(TESTS[0].name), "{error}");
        assert_eq!(chosen(&[]).ok().unwrap().len(), TESTS.len());
    }
}
