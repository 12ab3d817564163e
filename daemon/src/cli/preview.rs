//! `preview`: the running estimate as an image.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::thread;
use std::time::Duration;

use ndarray::{Array2, Axis, Ix2, concatenate};
use raysweep_proto::Client;
use raysweep_session::report::{Picture, ToneMap};
use serde_json::{Value, json};

use super::exit::Exit;
use super::failure::CommandFailure;
use super::printer::Printer;
use crate::live::{EPIPOLAR, INDIRECT, LiveError, LiveImage, LiveReader};

/// Polling interval for newer images.
const PACE: Duration = Duration::from_millis(200);
/// Columns between the two images.
const GAP_PX: usize = 4;
/// Percentile of the pixels that maps to white in an image.
const PERCENTILE: f64 = 99.5;

/// Writes epipolar and indirect light, side by side and each on its own scale, as a PNG file; with `follow`, repeats
/// this for every newer estimate until the daemon or the run ends.
pub(super) fn preview(
    socket: &Path,
    output: &Path,
    follow: bool,
    printer: Printer,
) -> Result<Exit, CommandFailure> {
    let mut client = Client::connect(socket)?;
    let file = client.status()?.live.ok_or(CommandFailure::NoLiveImage)?;
    let reader = LiveReader::open(&file)?;
    let mut drawn = None;
    loop {
        match pair(&reader)? {
            Some((epipolar, indirect)) if drawn != Some(indirect.sequence) => {
                let first = drawn.replace(indirect.sequence).is_none();
                let picture = side_by_side(epipolar, &indirect)?;
                replace(output, &picture)?;
                tell(&indirect, output, printer)?;
                // The first image may be the result of an earlier run.
                if !first && indirect.metadata.get("last") == Some(&Value::Bool(true)) {
                    return Ok(Exit::Done);
                }
            }
            None if !follow => return Err(CommandFailure::NoLiveImage),
            _ => {}
        }
        if !follow {
            return Ok(Exit::Done);
        }
        // Detects that the daemon is gone: a removed file never changes.
        client.status()?;
        thread::sleep(PACE);
    }
}

/// Both images of the newest estimate, if there is one.
fn pair(reader: &LiveReader) -> Result<Option<(LiveImage, LiveImage)>, LiveError> {
    let indirect = reader.newest(INDIRECT)?;
    let epipolar = reader.newest(EPIPOLAR)?;
    // The writer publishes the images one after the other: if they belong to different estimates, the pair is
    // complete a moment later.
    let of_one = |(epipolar, indirect): &(LiveImage, LiveImage)| {
        epipolar.sequence + 1 == indirect.sequence && epipolar.image.shape() == indirect.image.shape()
    };
    Ok(epipolar.zip(indirect).filter(of_one))
}

fn side_by_side(epipolar: LiveImage, indirect: &LiveImage) -> Result<Vec<u8>, CommandFailure> {
    let scaled = |image: &LiveImage| {
        let image = image.image.view().into_dimensionality::<Ix2>().map_err(io::Error::other)?;
        Ok::<_, io::Error>(image.mapv(|light| light / ToneMap::percentile(&[image], PERCENTILE).white))
    };
    let (left, right) = (
        scaled(&epipolar).map_err(CommandFailure::Output)?,
        scaled(indirect).map_err(CommandFailure::Output)?,
    );
    let gap = Array2::zeros((left.nrows(), GAP_PX));
    let both = concatenate(Axis(1), &[left.view(), gap.view(), right.view()])
        .map_err(|error| CommandFailure::Output(io::Error::other(error)))?;
    Ok(Picture::grey(both.view(), ToneMap { white: 1.0 })
        .to_png()
        .map_err(raysweep_processing::ProcessError::from)?)
}

/// Replaces the file atomically, so that a viewer never sees half an image.
fn replace(output: &Path, png: &[u8]) -> Result<(), CommandFailure> {
    let failed = |source| CommandFailure::Write { path: output.to_owned(), source };
    let mut name = output.as_os_str().to_owned();
    name.push(".part");
    let part = PathBuf::from(name);
    fs::write(&part, png).and_then(|()| fs::rename(&part, output)).map_err(failed)
}

fn tell(image: &LiveImage, output: &Path, printer: Printer) -> Result<(), CommandFailure> {
    let points = image.metadata.get("points").and_then(Value::as_u64).unwrap_or_default();
    let value = json!({ "output": output, "sequence": image.sequence, "points": points });
    printer.print(&value, |_| format!("{}: estimated from {points} points", output.display()))?;
    io::stdout().flush().map_err(CommandFailure::Output)
}
