//! `cargo xtask demo | test | figures | packages | fresh | deb | guest | soak | bench`: the project's own commands. Apart
//! from std it uses the small clang-sys alone, so that it builds quickly everywhere.

mod bench;
mod binaries;
mod daemon;
mod deb;
mod demo;
mod figures;
mod fresh;
mod guest;
mod packages;
mod python;
mod rootfs;
mod run;
mod soak;
mod space;
mod test;

use std::process::ExitCode;

use run::say;
use test::Guest;

const USAGE: &str = "\
usage: cargo xtask <command>

  demo               builds, runs the paper's sweep on the simulated rig, writes a report
  test [--no-guest]  installs what the tests need, checks format, lints and tests, with both
                     guests beside the tests; --no-guest leaves those out
  figures            the figures of Kubo et al. on the simulated rig, compared with the scenes' true transport, as
                     one page
  packages           what the tests need of Debian, what of it is missing, and how to install it
  fresh [12|13]...   runs demo and test of the last commit on a bare Debian 12 (bookworm) and 13 (trixie), or on
                     one: about 40 minutes each
  deb                builds the Debian package and prints its path
  guest [TEST...]    the drivers' tests against real kernel drivers in a QEMU guest, or some of them
  guest --systemd    the package under systemd in a QEMU guest: installed, used, killed, cut off from power
  soak [--minutes N] runs all procedures with faults, misbehaving clients and kills for 20 minutes, or N; reports
                     growth, differences and losses
  bench [NAME]       measures; without a name, tells which benchmarks there are";

fn main() -> ExitCode {
    if let Some(error) = run::find_system_programs() {
        eprintln!("{error}");
        return ExitCode::FAILURE;
    }
    let arguments: Vec<String> =
        std::env::args_os().skip(1).map(|word| word.to_string_lossy().into_owned()).collect();
    let arguments: Vec<&str> = arguments.iter().map(String::as_str).collect();
    let asks_for_help =
        arguments.first() == Some(&"help") || arguments.iter().any(|word| ["--help", "-h"].contains(word));
    let done = match arguments.as_slice() {
        ["bench", ..] if asks_for_help => bench::bench(&[]),
        _ if asks_for_help => say(USAGE),
        ["demo"] => demo::demo(),
        ["test", options @ ..] => match options.iter().find(|&&option| option != "--no-guest") {
            Some(unknown) => Err(format!("`{unknown}` is not an option of test; there is --no-guest")),
            None => test::test(if options.is_empty() { Guest::Run } else { Guest::Skip }),
        },
        ["packages"] => packages::print(),
        ["deb"] => deb::deb(),
        ["figures"] => figures::figures(),
        [command @ ("demo" | "packages" | "deb" | "figures"), unknown, ..] => {
            Err(format!("`{unknown}` is not an option of {command}; it has none"))
        }
        ["fresh", releases @ ..] => fresh::fresh(releases),
        ["guest", "--systemd"] => guest::systemd(),
        ["guest", option, ..] if option.starts_with('-') => {
            Err(format!("`{option}` is not an option of guest; there is --systemd, alone"))
        }
        ["guest", names @ ..] => guest::drivers(names),
        ["soak"] => soak::soak(20.0),
        ["soak", "--minutes"] => {
            Err("`--minutes` needs a number of minutes, such as --minutes 60".to_owned())
        }
        ["soak", "--minutes", minutes] => match minutes.parse::<f64>() {
            Ok(minutes) if (0.0..=100_000.0).contains(&minutes) => soak::soak(minutes),
            _ => Err(format!("`{minutes}` is not a number of minutes from 0 to 100000")),
        },
        ["bench", arguments @ ..] => bench::bench(arguments),
        [unknown, ..] => Err(format!("`{unknown}` is not a command\n{USAGE}")),
        [] => Err(USAGE.to_owned()),
    };
    match done {
        Ok(()) => ExitCode::SUCCESS,
        Err(message) => {
            eprintln!("{message}");
            ExitCode::FAILURE
        }
    }
}
