//! The command-line client of `raysweepd`.

use std::process::ExitCode;

fn main() -> ExitCode {
    raysweep::cli::main()
}
