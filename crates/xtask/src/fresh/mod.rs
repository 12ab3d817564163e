//! `cargo xtask fresh`: runs the README's two commands on a bare Debian with only Rust and a C compiler.

use std::fs::{File, TryLockError};
use std::io::{ErrorKind, Write};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Instant;

use crate::rootfs::{self, Running};
use crate::run::{Done, program, root, run, say, target};

const SCRIPT: &str = include_str!("inside.sh");

/// A release of Debian.
struct Release {
    number: &'static str,
    suite: &'static str,
}

const RELEASES: [Release; 2] =
    [Release { number: "12", suite: "bookworm" }, Release { number: "13", suite: "trixie" }];

/// Programs needed on this machine, and their packages.
const PROGRAMS: [(&str, &str); 3] = [("unshare", "util-linux"), ("mmdebstrap", "mmdebstrap"), ("git", "git")];

/// Environment variables needed for network access on some machines.
const NETWORK: [&str; 6] = ["http_proxy", "https_proxy", "no_proxy", "HTTP_PROXY", "HTTPS_PROXY", "NO_PROXY"];

/// Tries the given releases, or all; prints one line for each at the end.
pub fn fresh(numbers: &[&str]) -> Done {
    let releases = chosen(numbers)?;
    let rust = found()?;
    if let Some(why) = rootfs::forbidden() {
        return Err(format!("fresh: SKIPPED: {why}"));
    }
    tell_uncommitted()?;
    let tried = releases.iter().map(|release| attempt(release, &rust)).collect::<Done<Vec<Attempt>>>()?;
    for Attempt { line, .. } in &tried {
        say(line)?;
    }
    match tried.iter().filter(|attempt| !attempt.passed).count() {
        0 => Ok(()),
        failed => Err(format!("{failed} of {} releases failed", tried.len())),
    }
}

fn chosen(words: &[&str]) -> Done<Vec<&'static Release>> {
    let names = |release: &Release, word: &str| [release.number, release.suite].contains(&word);
    if let Some(unknown) = words.iter().find(|word| !RELEASES.iter().any(|release| names(release, word))) {
        return Err(format!(
            "unknown release `{unknown}`: use 12 (bookworm), 13 (trixie), or none for both, as in `cargo xtask fresh \
             12`"
        ));
    }
    let is_chosen = |release: &&Release| words.is_empty() || words.iter().any(|word| names(release, word));
    Ok(RELEASES.iter().filter(is_chosen).collect())
}

/// Finds what is needed on this machine, or names all that is missing; returns the folder of the Rust toolchain.
fn found() -> Done<String> {
    let missing = PROGRAMS.iter().filter(|(name, _)| program(name).is_none());
    let missing = missing.map(|(name, package)| format!("no program `{name}`: apt-get install {package}"));
    let rust = sysroot();
    let missing: Vec<String> = missing.chain(rust.clone().err()).collect();
    if missing.is_empty() {
        return rust;
    }
    Err(format!("`cargo xtask fresh` lacks:\n  {}", missing.join("\n  ")))
}

/// Result for a release.
struct Attempt {
    passed: bool,
    line: String,
}

/// Makes a root of a release and runs the commands in it; their output goes to the terminal and to a log.
fn attempt(Release { number, suite }: &Release, rust: &str) -> Done<Attempt> {
    let began = Instant::now();
    let folder = target().join("fresh").join(number);
    std::fs::create_dir_all(&folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    // Held until the function returns.
    let _lock = lock(&folder.join("lock"), number)?;
    let path = folder.join("log");
    let mut log = File::create(&path).map_err(|error| format!("{}: {error}", path.display()))?;
    say(&format!("fresh: Debian {number}; log: {}", path.display()))?;

    let checkout = copy_of_commits(&folder)?.display().to_string();
    let network = network();
    let arguments = [suite, rust, &checkout].into_iter().chain(network.iter().map(String::as_str));
    let running = Running::start(SCRIPT, &folder.join("root"), &arguments.collect::<Vec<_>>())?;
    let mut noted = Ok(());
    let passed = running.follow(|line| {
        if noted.is_ok() {
            let logged = writeln!(log, "{line}").map_err(|error| format!("{}: {error}", path.display()));
            noted = logged.and_then(|()| say(line));
        }
    })?;
    noted?;

    let seconds = began.elapsed().as_secs();
    let line = if passed {
        format!("Debian {number}: passed, {seconds} s")
    } else {
        format!("Debian {number}: failed, {seconds} s; log: {}", path.display())
    };
    Ok(Attempt { passed, line })
}

/// Takes a lock, because two runs at once would remove each other's root.
fn lock(path: &Path, number: &str) -> Done<File> {
    let failed = |error| format!("{}: {error}", path.display());
    let file = File::create(path).map_err(failed)?;
    match file.try_lock() {
        Ok(()) => Ok(file),
        Err(TryLockError::WouldBlock) => {
            Err(format!("another `cargo xtask fresh` is at work on Debian {number}"))
        }
        Err(TryLockError::Error(error)) => Err(failed(error)),
    }
}

/// Warns if there are uncommitted changes, which are not tested.
fn tell_uncommitted() -> Done {
    let output = Command::new("git").args(["status", "--porcelain"]).current_dir(root()).output();
    let output = output.map_err(|error| format!("cannot start git: {error}"))?;
    // Without a repository, making the copy fails with a message.
    let changed = String::from_utf8_lossy(&output.stdout).into_owned();
    let Some(first) = changed.lines().next() else { return Ok(()) };
    let rest = match changed.lines().count() - 1 {
        0 => String::new(),
        rest => format!(" and {rest} more"),
    };
    say(&format!("fresh: uncommitted changes are not tried: {}{rest}", first.trim()))
}

/// Makes a complete repository in one folder, which can be mounted in the root: the commits of a worktree or a shared
/// clone are stored elsewhere.
fn copy_of_commits(folder: &Path) -> Done<PathBuf> {
    let copy = folder.join("source.git");
    if copy.exists() {
        std::fs::remove_dir_all(&copy).map_err(|error| format!("{}: {error}", copy.display()))?;
    }
    run(Command::new("git")
        .args(["clone", "--quiet", "--bare", "--no-local"])
        .args([&root(), &copy])
        .stdin(Stdio::null()))?;
    Ok(copy)
}

/// Folder of the current Rust toolchain: its programs and libraries.
fn sysroot() -> Done<String> {
    let (rustc, shown) = match std::env::var_os("RUSTC") {
        Some(rustc) => (rustc.clone(), format!("RUSTC={}", rustc.display())),
        None => ("rustc".into(), "rustc".to_owned()),
    };
    let output = Command::new(rustc).args(["--print", "sysroot"]).current_dir(root()).output();
    let output = output.map_err(|error| match error.kind() {
        ErrorKind::NotFound => format!("{shown}: no such program; Rust is at https://rustup.rs"),
        _ => format!("{shown}: {error}"),
    })?;
    if !output.status.success() {
        let said = String::from_utf8_lossy(&output.stderr).trim().to_owned();
        return Err(format!("{shown}: `--print sysroot` ended with {}: {said}", output.status));
    }
    let sysroot = String::from_utf8_lossy(&output.stdout).trim().to_owned();
    lendable(Path::new(&sysroot))?;
    Ok(sysroot)
}

/// Rejects a toolchain in /usr: with all other programs of the distribution, the Debian would not be bare.
fn lendable(sysroot: &Path) -> Done {
    let shown = sysroot.display();
    if sysroot.canonicalize().is_ok_and(|sysroot| sysroot == Path::new("/usr")) {
        return Err(format!(
            "Rust is installed in {shown} among all other programs; `fresh` mounts the toolchain into a bare Debian \
             and needs one in a folder of its own: install it from https://rustup.rs"
        ));
    }
    if !sysroot.join("bin/cargo").is_file() {
        return Err(format!(
            "{shown}, where rustc is installed, has no bin/cargo: install both from https://rustup.rs"
        ));
    }
    Ok(())
}

fn network() -> Vec<String> {
    let variable = |name: &&str| Some(format!("{name}={}", std::env::var(name).ok()?));
    NETWORK.iter().filter_map(variable).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn releases_are_chosen_by_their_numbers() {
        let suites = |numbers: &[&str]| -> Vec<&str> {
            chosen(numbers).ok().unwrap().iter().map(|release| release.suite).collect()
        };
        assert_eq!(suites(&[]), ["bookworm", "trixie"]);
        assert_eq!(suites(&["13"]), ["trixie"]);
        assert_eq!(suites(&["bookworm"]), ["bookworm"]);
        assert!(chosen(&["12", "11"]).err().unwrap().contains("`11`"));
    }

    #[test]
    fn only_a_rust_in_a_folder_of_its_own_is_lent() {
        assert!(lendable(Path::new("/usr")).unwrap_err().contains("among all other programs"));
        assert!(lendable(Path::new("/nowhere")).unwrap_err().contains("no bin/cargo"));
    }

    #[test]
    fn a_release_is_tried_by_one_at_a_time() {
        let path = std::env::temp_dir().join(format!("raysweep-fresh-lock-{}", std::process::id()));
        let first = lock(&path, "12").unwrap();
        assert!(lock(&path, "12").unwrap_err().contains("at work on Debian 12"));
        drop(first);
        // A process that another test is just starting has the file open, and so locked, until it has started.
        let is_free = || {
            lock(&path, "12").is_ok() || {
                std::thread::sleep(std::time::Duration::from_millis(20));
                false
            }
        };
        assert!((0..500).any(|_| is_free()));
        std::fs::remove_file(&path).unwrap();
    }
}
