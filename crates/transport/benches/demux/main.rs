//! Benchmark of the demultiplexer: seconds, share of the machine's GEMM peak, and the distance of all results from
//! the f64 reference; its linear algebra beside nalgebra's; on request also common alternatives for the same problem.
//! Run it with `cargo xtask bench demux`.
//!
//! Options: `--json` prints JSON lines for the table; `--peers PYTHON` times `tests/python/peers.py` with that
//! interpreter on the same stacks. `--large PRIOR` is internal: the 1280x720 case runs in its own process, so that
//! the peak memory is that of this case alone.

mod censored;
mod check;
#[allow(clippy::unwrap_used, reason = "shared with the tests, where a helper that cannot go on may panic")]
#[path = "../../tests/common/mod.rs"]
mod common;
mod gemm;
mod linear;
mod peers;
mod print;
mod scene;

use std::error::Error;
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::Instant;

use ndarray::Axis;
use raysweep_transport::plane::{Demux, Prior, SimdLevel, Transport};
use serde::{Deserialize, Serialize};

use check::{Accuracy, Sample};
use peers::Peer;
use scene::Case;

const PRIORS: [Prior; 2] = [Prior::PAPER, Prior::SPLIT];

/// The pixels for checking the slower instruction levels.
const FEW: Sample = Sample { every_row: 8, every_column: 8 };

/// The measurements of one case with one prior.
#[derive(Debug, Serialize, Deserialize)]
struct Figures {
    case: String,
    instructions: String,
    prior: String,
    settings: usize,
    /// Unknowns of most pixels; pixels near the projector's borders have fewer.
    unknowns: usize,
    pixels: usize,
    threads: usize,
    repetitions: usize,
    seconds_min: f64,
    seconds_median: f64,
    /// See [`useful_flops`].
    useful_mflops_per_pixel: f64,
    /// Compared with the f64 reference.
    accuracy: Accuracy,
    /// Of the whole process, including stack and result, before the reference ran; 0 if not requested.
    peak_memory_mib: u64,
}

impl Figures {
    fn useful_flops_per_second(&self) -> f64 {
        self.useful_mflops_per_pixel * 1e6 * self.pixels as f64 / self.seconds_min
    }
}

#[derive(Default)]
struct Options {
    json: bool,
    peers: Option<PathBuf>,
    large: Option<Prior>,
}

impl Options {
    fn parse() -> Result<Self, Box<dyn Error>> {
        let mut options = Self::default();
        let mut arguments = std::env::args().skip(1);
        while let Some(argument) = arguments.next() {
            match argument.as_str() {
                "--json" => options.json = true,
                "--peers" => options.peers = Some(arguments.next().ok_or("--peers needs a Python")?.into()),
                "--large" => options.large = Some(arguments.next().ok_or("--large needs a prior")?.parse()?),
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
    if let Some(prior) = options.large {
        let (figures, _) = measure(&scene::whole_projector()?, prior, SimdLevel::best())?;
        println!("{}", serde_json::to_string(&figures)?);
        return Ok(());
    }

    let peak = gemm::peak();
    let mut compared = Vec::new();
    let mut measured: Vec<(Figures, Vec<Peer>)> = Vec::new();
    for case in [scene::paper_sized()?, scene::paper_sweep()?] {
        compared.extend(linear::compare(&case, Prior::PAPER)?);
        for prior in PRIORS {
            let (figures, best) = measure(&case, prior, SimdLevel::best())?;
            let timed = match &options.peers {
                Some(python) if case.with_peers => peers::time(python, &case, prior, &best)?,
                _ => Vec::new(),
            };
            measured.push((figures, timed));
        }
    }
    for prior in PRIORS {
        measured.push((in_a_process_of_its_own(prior)?, Vec::new()));
    }
    let slower = Case { sample: FEW, repetitions: 3, ..scene::paper_sized()? };
    for level in SimdLevel::available().into_iter().rev().skip(1) {
        for prior in PRIORS {
            measured.push((measure(&slower, prior, level)?.0, Vec::new()));
        }
    }
    match options.json {
        true => print::json_lines(&measured, &compared, &peak),
        false => {
            print::tables(&measured, &compared, &peak);
            censored::print()?;
        }
    }
    Ok(())
}

/// Times one case, then compares it with the reference. Also returns the reference's objective values, `[t, s]`.
fn measure(
    case: &Case,
    prior: Prior,
    level: SimdLevel,
) -> Result<(Figures, ndarray::Array2<f64>), Box<dyn Error>> {
    eprintln!("{}, {} prior, {}", case.name, prior.name(), level.name());
    let demux = Demux::new(case.timing.clone(), case.settings.clone(), prior)?.with_simd(level);
    let mut seconds = Vec::with_capacity(case.repetitions);
    let mut solve = || {
        let began = Instant::now();
        let transport = demux.solve(case.stack.view(), None);
        seconds.push(began.elapsed().as_secs_f64());
        transport
    };
    let mut transport = solve()?;
    for _ in 1..case.repetitions {
        drop(transport);
        transport = solve()?;
    }
    seconds.sort_by(f64::total_cmp);
    let peak_memory_mib = if case.in_its_own_process { peak_memory_mib()? } else { 0 };

    let (accuracy, best) = check::against_the_reference(case, prior, &transport);
    let pixels = case.stack.len_of(Axis(1)) * case.stack.len_of(Axis(2));
    let figures = Figures {
        case: case.name.to_owned(),
        instructions: level.name().to_owned(),
        prior: prior.name().to_owned(),
        settings: case.settings.len(),
        unknowns: demux.reach().count(),
        pixels,
        threads: rayon::current_num_threads(),
        repetitions: case.repetitions,
        seconds_min: seconds[0],
        seconds_median: seconds[seconds.len() / 2],
        useful_mflops_per_pixel: useful_flops(&transport, case.settings.len()) / pixels as f64 / 1e6,
        accuracy,
        peak_memory_mib,
    };
    Ok((figures, best))
}

/// Floating-point operations that the result itself requires, over all pixels: `A'I` and `H^-1 c` (`2NV + 2V^2`),
/// then one confirmation of the correct set of zero rows, on the smaller of the two sides: with `k` rows, a Cholesky
/// factor, two triangular systems and the values of the other rows, `k^3/3 + 2k^2 + 2kV`. Operations on sets that
/// turn out wrong are not counted, so the share of the peak is a lower bound of what the machine does.
fn useful_flops(transport: &Transport, settings: usize) -> f64 {
    let mut flops = 0.0;
    for (profiles, exists) in transport.t.axis_iter(Axis(1)).zip(transport.exists.columns()) {
        let unknowns = exists.iter().filter(|exists| **exists).count();
        for profile in profiles.columns() {
            let free = profile.iter().filter(|light| **light > 0.0).count();
            let (n, v, k) = (settings as f64, unknowns as f64, free.min(unknowns - free) as f64);
            flops += 2.0 * v * (n + v) + k * k * (k / 3.0 + 2.0) + 2.0 * k * v;
        }
    }
    flops
}

/// The 1280x720 case, measured by a new process of this program.
fn in_a_process_of_its_own(prior: Prior) -> Result<Figures, Box<dyn Error>> {
    let output = Command::new(std::env::current_exe()?)
        .args(["--large", prior.name()])
        .stderr(Stdio::inherit())
        .output()?;
    if !output.status.success() {
        return Err(
            format!("the 1280x720 case ended with {}; its message stands above", output.status).into()
        );
    }
    Ok(serde_json::from_slice(&output.stdout)?)
}

/// The peak memory of this process so far, as reported by Linux.
fn peak_memory_mib() -> Result<u64, Box<dyn Error>> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).ok_or("VmHWM is not in status")?;
    let kib: u64 = line.trim().trim_end_matches(" kB").parse()?;
    Ok(kib / 1024)
}
