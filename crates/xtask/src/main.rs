//! `cargo xtask demo | test`: the project's own commands. Plain std, so that they build at once everywhere.

mod demo;
mod packages;
mod run;
mod test;

use std::process::ExitCode;

const USAGE: &str = "\
usage: cargo xtask <command>

  demo    build, run the paper's sweep on the simulated rig, write a report
  test    install what the tests need, then format, lints, tests";

fn main() -> ExitCode {
    let command = std::env::args().nth(1);
    let done = match command.as_deref() {
        Some("demo") => demo::demo(),
        Some("test") => test::test(),
        _ => Err(USAGE.to_owned()),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("{message}");
            ExitCode::FAILURE
        }
    }
}
