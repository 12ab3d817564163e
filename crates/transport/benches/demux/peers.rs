//! Alternative software for the same problem, timed by `tests/python/peers.py`.

use std::error::Error;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use ndarray::Array2;
use ndarray_npy::write_npy;
use raysweep_transport::plane::{Prior, reach};
use serde::Deserialize;

use super::check::Objective;
use super::scene::Case;

/// The program's result for one method, printed as one JSON line.
#[derive(Debug, Deserialize)]
pub struct Peer {
    pub method: String,
    /// For all pixels of the case, extrapolated from those that were timed: minimum and median of the repetitions.
    pub seconds: f64,
    pub seconds_median: f64,
    pub pixels_timed: usize,
    pub gap_median: f64,
    pub gap_largest: f64,
}

/// Times all peers on the case's stack. `best` holds the least objective of each pixel, `[t, s]`.
///
/// All rows of the case must share one model.
pub fn time(
    python: &Path,
    case: &Case,
    prior: Prior,
    best: &Array2<f64>,
) -> Result<Vec<Peer>, Box<dyn Error>> {
    let folder = PathBuf::from(env!("CARGO_TARGET_TMPDIR")).join("bench-demux").join(prior.name());
    std::fs::create_dir_all(&folder)?;
    let objective = Objective::new(case, prior, &reach(&case.timing, &case.settings)?, 0);
    write_npy(folder.join("weights.npy"), &objective.model.weights)?;
    write_npy(folder.join("differences.npy"), &objective.differences)?;
    write_npy(folder.join("stack.npy"), &case.stack)?;
    write_npy(folder.join("best.npy"), best)?;
    let weights = serde_json::json!({ "alpha": prior.alpha(), "beta": prior.beta() });
    std::fs::write(folder.join("prior.json"), weights.to_string())?;

    let program = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../tests/python/peers.py");
    let started = Command::new(python).arg(program).arg(&folder).stderr(Stdio::inherit()).output();
    let output = started.map_err(|error| format!("cannot start {}: {error}", python.display()))?;
    if !output.status.success() {
        return Err(format!("peers.py ended with {}; its message stands above", output.status).into());
    }
    let lines = output.stdout.split(|byte| *byte == b'\n').filter(|line| !line.is_empty());
    Ok(lines.map(serde_json::from_slice).collect::<Result<_, _>>()?)
}
