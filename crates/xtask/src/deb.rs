//! `cargo xtask deb`: the Debian package, made by debhelper from programs that cargo has built.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::packages;
use crate::run::{Done, cargo, root, run, say, target};

/// Programs of the package.
pub const PROGRAMS: [&str; 3] = ["raysweep", "raysweepd", "raysweep-sim-camera"];

/// Files of `deploy`, by the names that debhelper expects in `debian`.
const UNITS: [(&str, &str); 5] = [
    ("systemd/raysweepd.service", "raysweep.raysweepd.service"),
    ("systemd/raysweepd.socket", "raysweep.raysweepd.socket"),
    ("sysusers.d/raysweep.conf", "raysweep.sysusers"),
    ("tmpfiles.d/raysweep.conf", "raysweep.tmpfiles"),
    ("udev/60-raysweep.rules", "raysweep.udev"),
];

/// Builds the programs as released, makes the package, and prints its path last.
pub fn deb() -> Done {
    packages::install()?;
    run(cargo().args(["build", "--package", "raysweep", "--bins", "--all-features", "--release"]))?;
    let package = package(&target().join("release"), &target().join("deb"))?;
    say(&package.display().to_string())
}

/// Makes the package of programs in a folder, in which lintian may find no errors; returns the path of the package, which
/// is in `folder`.
pub fn package(programs: &Path, folder: &Path) -> Done<PathBuf> {
    // What an earlier version has left would be packed too.
    let _ = std::fs::remove_dir_all(folder);
    let stage = folder.join("raysweep");
    let deploy = root().join("deploy");
    copy(&deploy.join("debian"), &stage.join("debian"))?;
    for (from, to) in UNITS {
        copy(&deploy.join(from), &stage.join("debian").join(to))?;
    }
    for name in ["rig.toml", "systemd/simulated.conf", "sysctl.d"] {
        copy(&deploy.join(name), &stage.join(name))?;
    }
    for name in ["rigs", "plans", "scenes"] {
        copy(&deploy.join(name), &stage.join("examples").join(name))?;
    }
    for name in ["README.md", "CHANGELOG.md", "docs"] {
        copy(&root().join(name), &stage.join(name))?;
    }
    for name in PROGRAMS {
        copy(&programs.join(name), &stage.join("bin").join(name))?;
    }
    run(Command::new(programs.join("raysweep")).arg("manuals").arg(&stage))?;
    write(&stage.join("crates.txt"), &crates()?)?;
    write(&stage.join("debian/changelog"), &changelog()?)?;
    run(Command::new("dpkg-buildpackage")
        .args(["--build=binary", "--no-check-builddeps", "--unsigned-source", "--unsigned-changes"])
        .env("DEB_BUILD_OPTIONS", "noautodbgsym")
        .current_dir(&stage)
        .stdout(Stdio::null()))?;
    let entries = std::fs::read_dir(folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    let mut packages = entries.flatten().map(|entry| entry.path());
    let package = packages
        .find(|path| path.extension().is_some_and(|ending| ending == "deb"))
        .ok_or_else(|| format!("{}: dpkg-buildpackage made no package", folder.display()))?;
    run(Command::new("lintian").args(["--fail-on", "error"]).arg(&package))?;
    Ok(package)
}

/// The crates that the programs contain, and their licences.
fn crates() -> Done<String> {
    let said = output(cargo().args([
        "tree",
        "--package=raysweep",
        "--all-features",
        "--edges=normal",
        "--prefix=none",
        "--format={p}: {l}",
    ]))?;
    // Crates of this project have a path.
    let lines =
        said.lines().filter(|line| !line.contains(" (/")).map(|line| line.replace(" (proc-macro)", ""));
    let lines: std::collections::BTreeSet<String> = lines.map(|line| line.replace(" (*)", "")).collect();
    Ok(lines.into_iter().map(|line| line + "\n").collect())
}

/// Debian's changelog with the present version: the project's, then the number of commits, so that each is newer than
/// the last.
fn changelog() -> Done<String> {
    let git = |arguments: &[&str]| output(Command::new("git").args(arguments).current_dir(root()));
    let (commits, date) = (git(&["rev-list", "--count", "HEAD"])?, git(&["log", "-1", "--format=%aD"])?);
    Ok(format!(
        "raysweep ({}+{}) unstable; urgency=medium\n\n  * See changelog.gz.\n\n -- raysweep developers <developers@raysweep.example.org>  {}\n",
        env!("CARGO_PKG_VERSION"),
        commits.trim(),
        date.trim()
    ))
}

fn output(command: &mut Command) -> Done<String> {
    let name = command.get_program().to_string_lossy().into_owned();
    let output =
        command.stderr(Stdio::inherit()).output().map_err(|error| format!("cannot start {name}: {error}"))?;
    if !output.status.success() {
        return Err(format!("{name} ended with {}", output.status));
    }
    Ok(String::from_utf8_lossy(&output.stdout).into_owned())
}

fn write(path: &Path, text: &str) -> Done {
    std::fs::write(path, text).map_err(|error| format!("{}: {error}", path.display()))
}

/// Copies a file, or a folder with all that is in it; links are followed.
pub fn copy(from: &Path, to: &Path) -> Done {
    let failed = |error| format!("{} to {}: {error}", from.display(), to.display());
    if from.is_dir() {
        std::fs::create_dir_all(to).map_err(failed)?;
        let entries = std::fs::read_dir(from).map_err(failed)?;
        return entries.flatten().try_for_each(|entry| copy(&entry.path(), &to.join(entry.file_name())));
    }
    if let Some(folder) = to.parent() {
        std::fs::create_dir_all(folder).map_err(failed)?;
    }
    std::fs::copy(from, to).map(drop).map_err(failed)
}
