//! `cargo xtask demo | test | packages | fresh | guest | bench`: the project's own commands. Uses only std, so that it
//! builds quickly everywhere.

mod bench;
mod daemon;
mod demo;
mod fresh;
mod guest;
mod live;
mod packages;
mod python;
mod rootfs;
mod run;
mod test;

use std::process::ExitCode;

use test::Guest;

const USAGE: &str = "\
usage: cargo xtask <command>

  demo    build, run the paper's sweep on the simulated rig, write a report
  test    install what the tests need, then format, lints, tests, the guest's too; --no-guest leaves these out
  packages
          what the tests need of Debian, and whether it is there
  fresh   demo and test of the last commit on a bare Debian 12 and 13, each in a root file system made for it; [12|13]... only
          those
  guest   the drivers' tests against real kernel drivers, in a QEMU guest; [TEST...] runs only those
  bench   measure: without a name, tells which benchmarks there are";

fn main() -> ExitCode {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let done = match arguments.as_slice() {
        ["demo"] => demo::demo(),
        ["test"] => test::test(Guest::Run),
        ["test", "--no-guest"] => test::test(Guest::Skip),
        ["fresh", numbers @ ..] => fresh::fresh(numbers),
        ["packages"] => packages::print(),
        ["guest", names @ ..] => guest::guest(names),
        ["bench", arguments @ ..] => bench::bench(arguments),
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
