//! `cargo xtask fresh`: the README's two commands where nothing is but a bare Debian, Rust and a C compiler.

use std::io::Write;
use std::process::Command;
use std::time::Instant;

use crate::rootfs::{self, Running};
use crate::run::{Done, root, target};

const SCRIPT: &str = include_str!("inside.sh");

/// A release of Debian.
struct Release {
    number: &'static str,
    suite: &'static str,
}

const RELEASES: [Release; 2] =
    [Release { number: "12", suite: "bookworm" }, Release { number: "13", suite: "trixie" }];

/// Variables of a machine without which its network is not reached.
const NETWORK: [&str; 6] = ["http_proxy", "https_proxy", "no_proxy", "HTTP_PROXY", "HTTPS_PROXY", "NO_PROXY"];

/// Tries the releases that are named, or all; a line for each at the end.
pub fn fresh(numbers: &[&str]) -> Done {
    let releases = chosen(numbers)?;
    if let Some(why) = rootfs::forbidden() {
        println!("fresh: SKIPPED: {why}");
        return Ok(());
    }
    for program in ["mmdebstrap", "git"] {
        if Command::new(program).arg("--version").output().is_err() {
            return Err(format!("`cargo xtask fresh` needs {program}: apt-get install {program}"));
        }
    }
    let rust = sysroot()?;
    let tried = releases.iter().map(|release| attempt(release, &rust)).collect::<Done<Vec<Attempt>>>()?;
    for Attempt { line, .. } in &tried {
        println!("{line}");
    }
    match tried.iter().filter(|attempt| !attempt.passed).count() {
        0 => Ok(()),
        failed => Err(format!("{failed} of {} releases failed", tried.len())),
    }
}

fn chosen(numbers: &[&str]) -> Done<Vec<&'static Release>> {
    if let Some(unknown) = numbers.iter().find(|&&number| RELEASES.iter().all(|known| known.number != number))
    {
        return Err(format!("`{unknown}` is not 12 or 13, the releases of Debian that there are to try"));
    }
    Ok(RELEASES.iter().filter(|known| numbers.is_empty() || numbers.contains(&known.number)).collect())
}

/// How a release fared.
struct Attempt {
    passed: bool,
    line: String,
}

/// Makes a root of a release and runs the commands in it; what they print goes to the terminal and to a log.
fn attempt(Release { number, suite }: &Release, rust: &str) -> Done<Attempt> {
    let began = Instant::now();
    let folder = target().join("fresh").join(number);
    std::fs::create_dir_all(&folder).map_err(|error| format!("{}: {error}", folder.display()))?;
    let path = folder.join("log");
    let mut log = std::fs::File::create(&path).map_err(|error| format!("{}: {error}", path.display()))?;
    println!("fresh: Debian {number}; log: {}", path.display());

    let checkout = root().display().to_string();
    let network = network();
    let arguments = [suite, rust, &checkout].into_iter().chain(network.iter().map(String::as_str));
    let running = Running::start(SCRIPT, &folder.join("root"), &arguments.collect::<Vec<_>>())?;
    let mut logged = Ok(());
    let passed = running.follow(|line| {
        println!("{line}");
        if logged.is_ok() {
            logged = writeln!(log, "{line}");
        }
    })?;
    logged.map_err(|error| format!("{}: {error}", path.display()))?;

    let seconds = began.elapsed().as_secs();
    let line = if passed {
        format!("Debian {number}: passed, {seconds} s")
    } else {
        format!("Debian {number}: failed, {seconds} s; log: {}", path.display())
    };
    Ok(Attempt { passed, line })
}

/// Where the Rust lies that runs us: its programs and libraries, in one folder.
fn sysroot() -> Done<String> {
    let rustc = std::env::var_os("RUSTC").unwrap_or_else(|| "rustc".into());
    let output = Command::new(rustc).args(["--print", "sysroot"]).current_dir(root()).output();
    let output = output.map_err(|error| format!("cannot start rustc: {error}"))?;
    Ok(String::from_utf8_lossy(&output.stdout).trim().to_owned())
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
        assert!(chosen(&["12", "11"]).err().unwrap().contains("`11`"));
    }
}
