//! Follows the tests in the guest: prints one line per finished check, and the log of each failed test.

use std::path::Path;
use std::time::{Duration, Instant};

use super::qemu::Machine;
use crate::run::Done;

/// Added to the guest's own time limit so that the guest's limit applies first: covers booting (5 s) and loading
/// modules.
const MARGIN: Duration = Duration::from_secs(60);

/// Exit code of `timeout` for a program that it had to kill.
const KILLED: &str = "137";

/// Prints the tests' results until the last has ended; returns the number of checks that passed.
pub fn follow(machine: &mut Machine, run: &Path, names: &[&str], limit_s: u32) -> Done<usize> {
    let mut checks = 0;
    let mut failures = Vec::new();
    for name in names {
        let folder = run.join(name);
        // On a busy host the guest's seconds are longer than ours.
        let limit = Duration::from_secs(limit_s.into()) * 4 + MARGIN;
        let mut printed = 0;
        let began = Instant::now();
        let code = loop {
            // Read the exit code first: if it exists, the log is complete.
            let code = std::fs::read_to_string(folder.join("exit")).ok().filter(|code| code.ends_with('\n'));
            let ended = machine.has_ended();
            let log = std::fs::read_to_string(folder.join("log")).unwrap_or_default();
            let verdicts: Vec<&str> = log.lines().filter_map(verdict).collect();
            for line in &verdicts[printed..] {
                println!("  {name}: {line}");
            }
            printed = verdicts.len();
            if code.is_some() || ended || began.elapsed() > limit {
                checks += verdicts.iter().filter(|line| line.contains(" ... ok")).count();
                break code;
            }
            std::thread::sleep(Duration::from_millis(50));
        };
        match code.as_deref().map(str::trim) {
            Some("0") if printed > 0 => {}
            Some("0") => failures.push(format!("{name}: no check in it")),
            Some(KILLED) => {
                failures.push(failure(&folder, &format!("{name} did not end within {limit_s} s")));
            }
            Some(code) => failures.push(failure(&folder, &format!("{name} ended with code {code}"))),
            None => {
                let what = if machine.has_ended() { "the guest ended" } else { "the guest hangs" };
                failures.push(failure(&folder, &format!("{what} in {name}")));
                for log in ["console", "qemu.log"] {
                    let log = run.join(log);
                    let said = std::fs::read_to_string(&log).unwrap_or_default();
                    failures.push(format!("{}:\n{said}", log.display()));
                }
                break;
            }
        }
    }
    if failures.is_empty() { Ok(checks) } else { Err(format!("checks failed\n{}", failures.join("\n"))) }
}

/// Returns the line if it reports the end of a check: `test name ... ok`.
fn verdict(line: &str) -> Option<&str> {
    let line = line.strip_prefix("test ")?;
    let (_, verdict) = line.split_once(" ... ")?;
    ["ok", "FAILED", "ignored"].iter().any(|known| verdict.starts_with(known)).then_some(line)
}

/// A failed test's log, and where to find more.
fn failure(folder: &Path, what: &str) -> String {
    let log = folder.join("log");
    let said = std::fs::read_to_string(&log).unwrap_or_default();
    format!("{said}\n{what}; its log is {}, the kernel's beside it", log.display())
}
