//! `cargo xtask bench`: what is fast enough, and how we know.

use crate::python;
use crate::run::{Done, cargo, run};

const BENCHES: &str = "\
benchmarks: cargo xtask bench <name> [options]

  demux   the demultiplexer: seconds, share of the machine's GEMM peak, distance from the f64 reference
          --peers  beside CVXPY, SciPy and NumPy on the same stack, in a Python environment made for it
          --json   JSON lines instead of tables: bench, case, method, seconds, ratio, gap
  unpack  packed pixels to u16: share of the speed of a memcpy of the same output, by format and instructions";

/// Runs the benchmark that the first argument names with the options that follow; without a name, lists all.
pub fn bench(arguments: &[&str]) -> Done {
    match arguments {
        [] => {
            println!("{BENCHES}");
            Ok(())
        }
        ["demux", options @ ..] => demux(options),
        ["unpack"] => run(cargo().args(["bench", "--package", "raysweep-core", "--bench", "unpack"])),
        ["unpack", option, ..] => Err(format!("`unpack` has no option `{option}`\n{BENCHES}")),
        [unknown, ..] => Err(format!("no benchmark `{unknown}`\n{BENCHES}")),
    }
}

fn demux(options: &[&str]) -> Done {
    if let Some(unknown) = options.iter().find(|option| !["--json", "--peers"].contains(option)) {
        return Err(format!("`demux` has no option `{unknown}`\n{BENCHES}"));
    }
    let mut bench = cargo();
    bench.args(["bench", "--package", "raysweep-transport", "--bench", "demux", "--"]);
    if options.contains(&"--json") {
        bench.arg("--json");
    }
    if options.contains(&"--peers") {
        let python = python::environment("python-peers", "peers-requirements.txt")?;
        bench.arg("--peers").arg(python);
    }
    run(&mut bench)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_names_and_options_are_told_what_there_is() {
        for arguments in [&["demuxx"] as &[&str], &["demux", "--fast"], &["unpack", "--json"]] {
            let message = bench(arguments).unwrap_err();
            assert!(
                message.contains(arguments[arguments.len() - 1]) && message.contains(BENCHES),
                "{message}"
            );
        }
    }
}
