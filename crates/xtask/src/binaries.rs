//! What cargo builds for the workspace's tests, and running it: several test binaries at once, because most tests wait
//! for the time of devices.

use std::collections::VecDeque;
use std::fs::File;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitStatus, Stdio};
use std::sync::{Mutex, PoisonError};
use std::thread::{available_parallelism, scope, sleep};
use std::time::{Duration, Instant};

use crate::run::{Done, cargo, say, target};

/// Tests of one binary that run at once.
const TESTS_AT_ONCE: &str = "2";
/// A binary that runs longer is named, in case it hangs.
const LONG: Duration = Duration::from_secs(300);

/// An executable that cargo has built.
#[derive(Debug, PartialEq)]
pub struct Binary {
    pub path: PathBuf,
    /// Folder of its crate, in which cargo runs tests.
    pub folder: PathBuf,
    /// What cargo made it of: `test`, `lib`, `bin`, `example`.
    pub kind: String,
    /// Whether it is a harness with tests rather than a program.
    pub is_test: bool,
}

impl Binary {
    /// Its name: of a harness that of the program or library, or the file name in the crate's `tests`, without `.rs`.
    pub fn name(&self) -> String {
        let file = self.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        match file.rsplit_once('-') {
            Some((name, _hash)) if self.is_test => name.to_owned(),
            _ => file,
        }
    }

    /// Its crate, its name, and what it has the unit tests of.
    fn shown(&self) -> String {
        let crate_name = self.folder.file_name().unwrap_or_default().display();
        match self.kind.as_str() {
            "test" => format!("{crate_name} {}", self.name()),
            kind => format!("{crate_name} {} ({kind})", self.name()),
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
        true => binaries(&String::from_utf8_lossy(&output.stdout)),
        false => Err("the tests do not build; see the compiler's messages above".to_owned()),
    }
}

/// The executables in cargo's JSON messages.
fn binaries(messages: &str) -> Done<Vec<Binary>> {
    let made = messages.lines().filter(|line| line.contains("\"executable\":\""));
    made.map(|line| binary(line).ok_or_else(|| format!("cargo's message is not understood: {line}")))
        .collect()
}

fn binary(line: &str) -> Option<Binary> {
    let after = |key: &str| Some(line.split_once(key)?.1);
    let text = |key: &str| Some(after(&format!("\"{key}\":\""))?.split_once('"')?.0);
    Some(Binary {
        path: text("executable")?.into(),
        folder: Path::new(text("manifest_path")?).parent()?.to_owned(),
        kind: after("\"kind\":[\"")?.split_once('"')?.0.to_owned(),
        is_test: after("\"profile\":{")?.split_once('}')?.0.contains("\"test\":true"),
    })
}

/// Runs all tests; what those binaries said that fail is printed, and of all it is in the folder `tests` of the target.
pub fn run_tests(binaries: &[Binary], environment: &[(&str, &Path)]) -> Done {
    let mut tests: Vec<&Binary> = binaries.iter().filter(|binary| binary.is_test).collect();
    if tests.is_empty() {
        return Err("cargo built no tests".to_owned());
    }
    let logs = target().join("tests");
    // Logs of earlier builds have other names.
    let _ = std::fs::remove_dir_all(&logs);
    std::fs::create_dir_all(&logs).map_err(|error| format!("{}: {error}", logs.display()))?;
    tests.sort_by_key(|test| (&test.folder, test.name()));
    let (began, count) = (Instant::now(), tests.len());
    let (left, failed) = (Mutex::new(VecDeque::from(tests)), Mutex::new(Vec::new()));
    let next = |core: usize| {
        let mut left = left.lock().unwrap_or_else(PoisonError::into_inner);
        if core.is_multiple_of(2) { left.pop_front() } else { left.pop_back() }
    };
    // From both ends: the drivers' tests wait for the time of devices, the last crate's compute.
    let work = |core| {
        while let Some(test) = next(core) {
            let began = Instant::now();
            let log = logs.join(test.path.file_name().unwrap_or_default()).with_added_extension("log");
            let verdict = match run_test(test, &log, environment) {
                Ok(status) => {
                    verdict(status, &String::from_utf8_lossy(&std::fs::read(&log).unwrap_or_default()))
                }
                Err(error) => Err(error.to_string()),
            };
            let said = verdict.as_ref().unwrap_or_else(|said| said);
            // Whoever closed the pipe does not want to know.
            let _ = say(&format!("{} ({:.0} s)\n{said}", test.shown(), began.elapsed().as_secs_f64()));
            if verdict.is_err() {
                failed.lock().unwrap_or_else(PoisonError::into_inner).push(test.shown());
            }
        }
    };
    scope(|scope| {
        let cores = available_parallelism().map_or(1, usize::from);
        let work = &work;
        (0..cores).for_each(|core| drop(scope.spawn(move || work(core))));
    });
    let failed = failed.into_inner().unwrap_or_else(PoisonError::into_inner);
    if !failed.is_empty() {
        return Err(format!("tests failed, see their output above: {}", failed.join(", ")));
    }
    say(&format!("{count} test binaries passed in {:.0} s", began.elapsed().as_secs_f64()))
}

/// Runs the tests of a binary with what they need of cargo's environment; the rest of it is that of `cargo xtask`.
fn run_test(test: &Binary, log: &Path, environment: &[(&str, &Path)]) -> std::io::Result<ExitStatus> {
    let output = File::create(log)?;
    let mut run = Command::new(&test.path);
    run.current_dir(&test.folder).env("CARGO_MANIFEST_DIR", &test.folder);
    run.env("CARGO_TARGET_DIR", target()).env_remove("CARGO_BUILD_TARGET");
    run.env("RUST_TEST_THREADS", TESTS_AT_ONCE).envs(environment.iter().copied());
    // A file, not a pipe: a program that a failed test leaves behind would keep a pipe open.
    run.stdin(Stdio::null()).stderr(output.try_clone()?).stdout(output);
    let (mut running, began) = (run.spawn()?, Instant::now());
    let mut is_told = false;
    loop {
        if let Some(status) = running.try_wait()? {
            return Ok(status);
        }
        if !is_told && began.elapsed() > LONG {
            is_told = true;
            let _ =
                say(&format!("{}: still running; its output so far is in {}", test.shown(), log.display()));
        }
        sleep(Duration::from_millis(50));
    }
}

/// What was skipped, and the harness's line `test result: …` unchanged, as cargo prints it, for scripts that count tests;
/// or all that was said.
fn verdict(status: ExitStatus, said: &str) -> Result<String, String> {
    let result = said.lines().rfind(|line| line.starts_with("test result: ok"));
    match result {
        Some(result) if status.success() => {
            let skipped = said.lines().filter(|line| line.contains("SKIPPED"));
            Ok(skipped.chain([result]).collect::<Vec<_>>().join("\n"))
        }
        _ => Err(format!("{status}\n{said}")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn executables_are_found_with_their_names() {
        let messages = r#"{"reason":"compiler-artifact","manifest_path":"/p/drivers/Cargo.toml","target":{"kind":["lib"],"test":true},"profile":{"test":true},"executable":null}
{"reason":"compiler-artifact","manifest_path":"/p/drivers/Cargo.toml","target":{"kind":["test"],"test":true},"profile":{"opt_level":"0","test":true},"executable":"/a/deps/guest_drm_more-0123","fresh":true}
{"reason":"compiler-artifact","manifest_path":"/p/daemon/Cargo.toml","target":{"kind":["bin"],"test":true},"profile":{"opt_level":"0","test":true},"executable":"/a/deps/raysweepd-89ab","fresh":true}
{"reason":"compiler-artifact","manifest_path":"/p/daemon/Cargo.toml","target":{"kind":["bin"],"test":true},"profile":{"opt_level":"0","test":false},"executable":"/a/raysweepd","fresh":true}"#;
        let found = binaries(messages).unwrap();
        let names: Vec<String> = found.iter().map(Binary::name).collect();
        assert_eq!(names, ["guest_drm_more", "raysweepd", "raysweepd"]);
        let is_test: Vec<bool> = found.iter().map(|binary| binary.is_test).collect();
        assert_eq!(is_test, [true, true, false]);
        let shown: Vec<String> = found.iter().map(Binary::shown).collect();
        assert_eq!(shown[..2], ["drivers guest_drm_more", "daemon raysweepd (bin)"]);
        assert_eq!(found[0].folder, Path::new("/p/drivers"));
    }

    #[test]
    fn where_nothing_is_built_nothing_passes() {
        assert!(binaries(r#"{"executable":"/a/deps/guest_drm-4567","profile":[]}"#).is_err());
        assert!(run_tests(&[], &[]).is_err());
    }

    /// A test binary that says `said` and ends with `code`.
    fn ran(said: &str, code: i32) -> Result<String, String> {
        let status = Command::new("sh").args(["-c", &format!("exit {code}")]).status().unwrap();
        verdict(status, said)
    }

    #[test]
    fn what_failed_is_told_whole_and_of_what_passed_its_result() {
        let passed = "running 2 tests\nmounts: SKIPPED: forbidden\ntest result: ok. 2 passed; 0 failed";
        assert_eq!(
            ran(passed, 0),
            Ok("mounts: SKIPPED: forbidden\ntest result: ok. 2 passed; 0 failed".to_owned())
        );
        let said = ran("test a ... FAILED", 101).unwrap_err();
        assert!(said.contains("test a ... FAILED") && said.contains("101"), "{said}");
        // A process that ends before its tests has not passed, whatever its code; nor has one that crashes after them.
        assert!(ran("running 2 tests", 0).is_err() && ran(passed, 1).is_err());
    }
}
