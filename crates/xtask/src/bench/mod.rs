//! `cargo xtask bench`: benchmarks.

mod live;
mod times;
mod view;

use crate::python;
use crate::run::{Done, cargo, run, target};

const BENCHES: &str = "\
benchmarks: cargo xtask bench <name> [options]

  demux   the demultiplexer: seconds, share of the machine's GEMM peak, distance from the f64 reference
          --peers  beside CVXPY, SciPy and NumPy on the same stack, in a Python environment made for it
          --json   JSON lines instead of tables: bench, case, method, seconds, ratio, gap
  live    the paper's sweep on the simulated rig in real time, 30 frames a second of 128x128 and 512x512 pixels: seconds
          from the last frame to the transport on disk, and what the simulator takes of the cores
          --json   JSON lines: bench, case, seconds, and the other figures
  dots    the flying dot's stages: time, ratio to a plain read of the same bytes, frames a second
          --peers  beside NumPy, SciPy and OpenCV on the same frames and columns
          --json   JSON lines instead of tables: bench, case, stage, method, seconds, times_read, ratio
          --live   frames of 1024x1024 pixels from memory through pool, queue and stages, as fast as they are taken and for a
                   minute at 0.8 of that, beside the same kernels in a plain loop; with --json one line
  camera  the driver aravis on the simulated GigE camera: frames a second, processor time of a frame beside
          arv-camera-test-0.8 in the same run, and from a frame's last packet until it is in the pool; best as root
          --sweep  instead, the paper's sweep over the wire in real time, with late settings, lost packets and a
                   camera that dies: seconds of light and frames lost, each image held against the scene; as root
          --only CASE  the cases alone whose names have this in them: 512x512, \"packets of 9000\"
          --json   JSON lines
  edges   the logic analyser's edge scan on one core: samples a second against its 24 MHz, quiet to worst
  view    what live pictures take of the daemon, of which `raysweep view` shows some to a browser: processor time of a
          viewfinder of 1280x720 pixels at 15 pictures a second and of a film of 128x128, alone and watched
          --json   JSON lines
  unpack  packed pixels to u16: share of the speed of a memcpy of the same output, by format and instructions";

/// Output format.
enum Print {
    /// Text for people.
    Text,
    /// JSON lines for programs.
    JsonLines,
}

/// Runs the benchmark named by the first argument with the options that follow; without arguments, lists all
/// benchmarks.
pub fn bench(arguments: &[&str]) -> Done {
    match arguments {
        [] => {
            println!("{BENCHES}");
            Ok(())
        }
        ["demux", options @ ..] => transport("demux", "python-peers", "peers-requirements.txt", options),
        ["dots", "--live", options @ ..] if options.is_empty() || options == ["--json"] => {
            let mut bench = cargo();
            bench.args(["bench", "--package", "raysweep-pipeline", "--bench", "dots", "--"]);
            run(bench.args(options))
        }
        ["dots", "--live", unknown, ..] => Err(format!("`dots --live` has no option `{unknown}`\n{BENCHES}")),
        ["dots", options @ ..] => {
            transport("dots", "python-peers-dots", "peers-dots-requirements.txt", options)
        }
        ["unpack"] => run(cargo().args(["bench", "--package", "raysweep-core", "--bench", "unpack"])),
        ["unpack", option, ..] => Err(format!("`unpack` has no option `{option}`\n{BENCHES}")),
        ["edges"] => run(cargo().args(["bench", "--package", "raysweep-drivers", "--bench", "edges"])),
        ["edges", option, ..] => Err(format!("`edges` has no option `{option}`\n{BENCHES}")),
        ["camera", options @ ..] => camera(options),
        ["live"] => live::live(Print::Text),
        ["live", "--json"] => live::live(Print::JsonLines),
        ["live", unknown, ..] => Err(format!("`live` has no option `{unknown}`\n{BENCHES}")),
        ["view"] => view::view(Print::Text),
        ["view", "--json"] => view::view(Print::JsonLines),
        ["view", unknown, ..] => Err(format!("`view` has no option `{unknown}`\n{BENCHES}")),
        [unknown, ..] => Err(format!("no benchmark `{unknown}`\n{BENCHES}")),
    }
}

/// Runs a benchmark of the numerics; its peers run in a Python environment with the packages in `requirements`.
fn transport(name: &str, environment: &str, requirements: &str, options: &[&str]) -> Done {
    if let Some(unknown) = options.iter().find(|option| !["--json", "--peers"].contains(option)) {
        return Err(format!("`{name}` has no option `{unknown}`\n{BENCHES}"));
    }
    let mut bench = cargo();
    bench.args(["bench", "--package", "raysweep-transport", "--bench", name, "--"]);
    if options.contains(&"--json") {
        bench.arg("--json");
    }
    if options.contains(&"--peers") {
        let python = python::environment(environment, requirements)?;
        bench.arg("--peers").arg(python);
    }
    run(&mut bench)
}

/// Runs the benchmark of the camera's driver, alone or within a complete sweep.
fn camera(options: &[&str]) -> Done {
    let (mut is_sweep, mut passed_on) = (false, Vec::new());
    let mut words = options.iter().copied();
    while let Some(word) = words.next() {
        match (word, is_sweep) {
            ("--sweep", _) => is_sweep = true,
            ("--json", _) => passed_on.push(word),
            ("--only", false) => {
                let case = words.next().ok_or_else(|| format!("`--only` takes a case\n{BENCHES}"))?;
                passed_on.extend([word, case]);
            }
            (unknown, _) => return Err(format!("`camera` has no option `{unknown}`\n{BENCHES}")),
        }
    }
    let mut bench = cargo();
    if is_sweep {
        bench.args(["bench", "--package", "raysweep", "--features", "aravis", "--bench", "wire_sweep", "--"]);
    } else {
        run(cargo().args(["build", "--package", "raysweep", "--bin", "raysweep-sim-camera", "--release"]))?;
        bench.args([
            "bench",
            "--package",
            "raysweep-drivers",
            "--features",
            "aravis",
            "--bench",
            "camera",
            "--",
        ]);
        bench.arg("--camera").arg(target().join("release/raysweep-sim-camera"));
    }
    run(bench.args(passed_on))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn unknown_names_and_options_are_told_what_there_is() {
        let unknown: [&[&str]; 9] = [
            &["demuxx"],
            &["demux", "--fast"],
            &["dots", "--live", "--fast"],
            &["live", "--fast"],
            &["view", "--fast"],
            &["unpack", "--json"],
            &["edges", "--json"],
            &["camera", "--peers"],
            &["camera", "--only"],
        ];
        for arguments in unknown {
            let message = bench(arguments).unwrap_err();
            assert!(
                message.contains(arguments[arguments.len() - 1]) && message.contains(BENCHES),
                "{message}"
            );
        }
    }
}
