//! Benchmark of the dot rig's stages on synthetic 12-bit batches of 2250 dots, each compared with a plain read of the
//! same bytes in the same run. Run it with `cargo xtask bench dots`.
//!
//! Options: `--json` prints JSON lines for the table; `--peers PYTHON` times `tests/python/peers_dots.py` with that
//! interpreter on the same frames and columns.

mod peers;
mod scene;
mod stages;

use std::error::Error;
use std::path::PathBuf;

use serde::Serialize;

/// One stage of one case, by one method.
#[derive(Debug, Serialize)]
struct Figure {
    bench: &'static str,
    /// Frame size and number of threads.
    case: String,
    stage: String,
    method: String,
    /// Minimum of the repetitions, per frame, or per batch if the stage works on columns.
    seconds: f64,
    /// Relative to a plain read of the stage's input with the same number of threads.
    times_read: f64,
    /// Relative to raysweep's seconds with all threads; 1 for raysweep itself.
    ratio: f64,
    /// Only for stages that work on frames.
    frames_per_second: Option<f64>,
}

#[derive(Default)]
struct Options {
    json: bool,
    peers: Option<PathBuf>,
}

impl Options {
    fn parse() -> Result<Self, Box<dyn Error>> {
        let mut options = Self::default();
        let mut arguments = std::env::args().skip(1);
        while let Some(argument) = arguments.next() {
            match argument.as_str() {
                "--json" => options.json = true,
                "--peers" => options.peers = Some(arguments.next().ok_or("--peers needs a Python")?.into()),
                // Passed by Cargo.
                "--bench" => {}
                unknown => {
                    return Err(format!("no option `{unknown}`: there are --json and --peers PYTHON").into());
                }
            }
        }
        Ok(options)
    }
}

fn main() -> Result<(), Box<dyn Error>> {
    let options = Options::parse()?;
    let mut figures = Vec::new();
    for size in [1024, 512, 256, 128] {
        eprintln!("frames of {size} x {size}");
        figures.extend(stages::of_frames(size)?);
    }
    eprintln!("columns of 1024 x 1024");
    let columns = stages::Columns::new()?;
    figures.extend(stages::of_columns(&columns)?);
    if let Some(python) = &options.peers {
        figures.extend(peers::time(python, &columns, &figures)?);
    }
    for figure in &figures {
        match options.json {
            true => println!("{}", serde_json::to_string(figure)?),
            false => print(figure),
        }
    }
    if !options.json {
        print_sum(&figures);
    }
    Ok(())
}

fn print(figure: &Figure) {
    let rate = figure.frames_per_second.map_or(String::new(), |rate| format!("{rate:>10.0} frames/s"));
    println!(
        "{:<22} {:<28} {:<34} {:>10.4} ms {:>8.2} x read {:>8.1} x raysweep {rate}",
        figure.case,
        figure.stage,
        figure.method,
        1e3 * figure.seconds,
        figure.times_read,
        figure.ratio,
    );
}

/// Prints the total time for a batch once its columns exist.
fn print_sum(figures: &[Figure]) {
    for threads in [1, 2] {
        let case = stages::case(1024, threads);
        let of_columns = figures.iter().filter(|figure| {
            figure.case == case && figure.method == stages::OURS && figure.frames_per_second.is_none()
        });
        let sum: f64 = of_columns.map(|figure| figure.seconds).sum();
        println!("{case}: all stages on columns together {:.1} ms a batch", 1e3 * sum);
    }
}
