//! `cargo xtask bench`: what is fast enough, and how we know.

use crate::run::{Done, cargo, run};
use crate::{live, python};

const BENCHES: &str = "\
benchmarks: cargo xtask bench <name> [options]

  demux   the demultiplexer: seconds, share of the machine's GEMM peak, distance from the f64 reference
          --peers  beside CVXPY, SciPy and NumPy on the same stack, in a Python environment made for it
          --json   JSON lines instead of tables: bench, case, method, seconds, ratio, gap
  live    the paper's sweep on the simulated rig in real time, 30 frames a second of 128x128 and 512x512 pixels: seconds
          from the last frame to the transport on disk, and what the simulator takes of the cores
          --json   JSON lines: bench, case, seconds, and the other figures";

/// Runs the benchmark that the first argument names with the options that follow; without a name, lists all.
pub fn bench(arguments: &[&str]) -> Done {
    match arguments {
        [] => {
            println!("{BENCHES}");
            Ok(())
        }
        ["demux", options @ ..] => demux(options),
        ["live"] => live::live(live::Print::Text),
        ["live", "--json"] => live::live(live::Print::JsonLines),
        ["live", unknown, ..] => Err(format!("`live` has no option `{unknown}`\n{BENCHES}")),
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
        for arguments in [&["demuxx"] as &[&str], &["demux", "--fast"], &["live", "--fast"]] {
            let message = bench(arguments).unwrap_err();
            assert!(
                message.contains(arguments[arguments.len() - 1]) && message.contains(BENCHES),
                "{message}"
            );
        }
    }
}
