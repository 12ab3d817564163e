//! What cargo builds for the workspace's tests, and running it: several test binaries at once, because most tests wait
//! for the time of devices.

use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::{available_parallelism, scope};
use std::time::Instant;

use crate::run::{Done, cargo, say};

/// Tests of one binary that run at once.
const TESTS_AT_ONCE: &str = "2";

/// An executable that cargo has built.
#[derive(Debug, PartialEq)]
pub struct Binary {
    pub path: PathBuf,
    /// Folder of its crate, in which cargo runs tests.
    pub folder: PathBuf,
    /// Whether it is a harness with tests rather than a program.
    pub is_test: bool,
}

impl Binary {
    /// Its name: of a test the file name in the crate's `tests`, without `.rs`.
    pub fn name(&self) -> String {
        let file = self.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        match file.rsplit_once('-') {
            Some((name, _hash)) if self.is_test => name.to_owned(),
            _ => file,
        }
    }
}

/// Builds the tests of the workspace with all features, and the programs that they start.
pub fn build() -> Done<Vec<Binary>> {
    let mut build = cargo();
    build.args([
        "test",
        "--workspace",
        "--all-features",
        "--no-run",
        "--message-format=json-render-diagnostics",
    ]);
    eprintln!("building the tests");
    let output =
        build.stderr(Stdio::inherit()).output().map_err(|error| format!("cannot start cargo: {error}"))?;
    match output.status.success() {
        true => Ok(binaries(&String::from_utf8_lossy(&output.stdout))),
        false => Err("the tests do not build; see the compiler's messages above".to_owned()),
    }
}

/// The executables in cargo's JSON messages.
fn binaries(messages: &str) -> Vec<Binary> {
    let text = |line: &str, key: &str| {
        let (_, value) = line.split_once(&format!("\"{key}\":\""))?;
        Some(value.split_once('"')?.0.to_owned())
    };
    let binary = |line: &str| {
        let folder = Path::new(&text(line, "manifest_path")?).parent()?.to_owned();
        let (_, profile) = line.split_once("\"profile\":{")?;
        let is_test = profile.split_once('}')?.0.contains("\"test\":true");
        Some(Binary { path: text(line, "executable")?.into(), folder, is_test })
    };
    messages.lines().filter_map(binary).collect()
}

/// Runs all tests, and prints the output of those binaries that fail.
pub fn run_tests(binaries: &[Binary], environment: &[(&str, &Path)]) -> Done {
    let tests: Vec<&Binary> = binaries.iter().filter(|binary| binary.is_test).collect();
    let began = Instant::now();
    let (next, failed) = (AtomicUsize::new(0), Mutex::new(Vec::new()));
    let work = || {
        while let Some(test) = tests.get(next.fetch_add(1, Ordering::Relaxed)) {
            let began = Instant::now();
            let output = run_test(test, environment);
            let (passed, said) = verdict(output);
            let name = format!("{} {}", test.folder.file_name().unwrap_or_default().display(), test.name());
            // Whoever closed the pipe does not want to know.
            let _ = say(&format!("{name}: {said} ({:.0} s)", began.elapsed().as_secs_f64()));
            if !passed && let Ok(mut failed) = failed.lock() {
                failed.push(name);
            }
        }
    };
    scope(|scope| {
        let cores = available_parallelism().map_or(1, usize::from);
        (0..cores).for_each(|_| drop(scope.spawn(work)));
    });
    let failed = failed.into_inner().unwrap_or_default();
    if !failed.is_empty() {
        return Err(format!("tests failed, see their output above: {}", failed.join(", ")));
    }
    say(&format!("{} test binaries passed in {:.0} s", tests.len(), began.elapsed().as_secs_f64()))
}

/// Runs the tests of a binary as cargo does.
fn run_test(test: &Binary, environment: &[(&str, &Path)]) -> std::io::Result<Output> {
    let mut run = Command::new(&test.path);
    run.current_dir(&test.folder).env("CARGO_MANIFEST_DIR", &test.folder);
    run.env("RUST_TEST_THREADS", TESTS_AT_ONCE).envs(environment.iter().copied());
    run.stdin(Stdio::null()).output()
}

/// Whether the tests passed, and the line that says so, or all that they said.
fn verdict(output: std::io::Result<Output>) -> (bool, String) {
    let output = match output {
        Ok(output) => output,
        Err(error) => return (false, format!("cannot start: {error}")),
    };
    let said = String::from_utf8_lossy(&output.stdout);
    let result = said.lines().rfind(|line| line.starts_with("test result: ok"));
    match result {
        Some(result) if output.status.success() => {
            (true, result.trim_start_matches("test result: ").to_owned())
        }
        _ => {
            let errors = String::from_utf8_lossy(&output.stderr);
            (false, format!("{}\n{said}\n{errors}", output.status))
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn executables_are_found_with_their_names() {
        let messages = r#"{"reason":"compiler-artifact","manifest_path":"/p/drivers/Cargo.toml","profile":{"test":true},"executable":null}
{"reason":"compiler-artifact","manifest_path":"/p/drivers/Cargo.toml","target":{"test":true},"profile":{"opt_level":"0","test":true},"executable":"/a/deps/guest_drm-4567","fresh":true}
{"reason":"compiler-artifact","manifest_path":"/p/daemon/Cargo.toml","target":{"test":true},"profile":{"opt_level":"0","test":true},"executable":"/a/deps/raysweepd-89ab","fresh":true}
{"reason":"compiler-artifact","manifest_path":"/p/daemon/Cargo.toml","target":{"test":true},"profile":{"opt_level":"0","test":false},"executable":"/a/raysweepd","fresh":true}"#;
        let found = binaries(messages);
        let names: Vec<String> = found.iter().map(Binary::name).collect();
        assert_eq!(names, ["guest_drm", "raysweepd", "raysweepd"]);
        let is_test: Vec<bool> = found.iter().map(|binary| binary.is_test).collect();
        assert_eq!(is_test, [true, true, false]);
        assert_eq!(found[0].folder, Path::new("/p/drivers"));
    }

    /// A test binary that says `said` and ends with `code`.
    fn ran(said: &str, code: i32) -> (bool, String) {
        let script = format!("echo '{said}'; echo why >&2; exit {code}");
        verdict(Command::new("sh").args(["-c", &script]).output())
    }

    #[test]
    fn what_failed_is_told_whole_and_what_passed_in_a_line() {
        let passed = "running 2 tests\ntest result: ok. 2 passed; 0 failed";
        assert_eq!(ran(passed, 0), (true, "ok. 2 passed; 0 failed".to_owned()));
        let (is_passed, said) = ran("test a ... FAILED", 101);
        assert!(!is_passed && said.contains("test a ... FAILED") && said.contains("why"), "{said}");
        // A process that ends before its tests has not passed, whatever its code; nor has one that crashes after them.
        assert!(!ran("running 2 tests", 0).0 && !ran(passed, 1).0);
        assert!(!verdict(Command::new("/nonexistent").output()).0);
    }
}
