//! Every page of `--help` of the daemon and the command line.

#![allow(clippy::unwrap_used, reason = "a test that cannot go on may panic")]

use std::process::Command;

/// The page of a command, and those of its subcommands.
fn pages(program: &str, path: &[&str]) -> String {
    let output = Command::new(program).args(path).arg("--help").output().unwrap();
    assert!(output.status.success(), "{path:?}");
    let page = String::from_utf8(output.stdout).unwrap();
    let commands = page.split("Commands:\n").nth(1).and_then(|rest| rest.split("\n\n").next());
    let names = commands.into_iter().flat_map(str::lines).filter_map(|line| line.split_whitespace().next());
    let below: String = names
        .filter(|name| *name != "help")
        .map(|name| pages(program, &path.iter().copied().chain([name]).collect::<Vec<_>>()))
        .collect();
    let name = std::path::Path::new(program).file_name().unwrap().to_str().unwrap();
    format!("$ {} --help\n{page}\n{below}", [&[name], path].concat().join(" "))
}

#[test]
fn every_page_of_help() {
    let programs = [env!("CARGO_BIN_EXE_raysweep"), env!("CARGO_BIN_EXE_raysweepd")];
    insta::assert_snapshot!(programs.map(|program| pages(program, &[])).concat());
}
