//! `preview`: the live images as a picture.

use std::io::{self, Write};
use std::path::Path;
use std::thread;
use std::time::Duration;

use ndarray::{Array2, Axis, Ix2, concatenate};
use raysweep_proto::Client;
use raysweep_session::report::{Picture, ToneMap};
use serde_json::{Value, json};

use super::exit::Exit;
use super::failure::CommandFailure;
use super::picture_file;
use super::printer::Printer;
use crate::live::{EPIPOLAR, FLOODLIT, INDIRECT, LiveError, LiveImage, LiveReader};

/// Polling interval for newer images.
const PACE: Duration = Duration::from_millis(200);
/// Columns between the two images.
const GAP_PX: usize = 4;
/// Percentile of the pixels that maps to white in an image.
const PERCENTILE: f64 = 99.5;

/// Writes the newest live picture as a PNG file: epipolar and indirect light side by side, each on its own scale, or on a
/// dot rig the newest batch under all dots. With `follow`, repeats this for every newer one until the run or the daemon
/// ends.
pub(super) fn preview(
    socket: &Path,
    output: &Path,
    follow: bool,
    printer: Printer,
) -> Result<Exit, CommandFailure> {
    picture_file::check(output)?;
    let mut client = Client::connect(socket)?;
    let file = client.status()?.live.ok_or(CommandFailure::NoLiveImage)?;
    let reader = LiveReader::open(&file)?;
    let (mut drawn, mut was_under_way) = (None, false);
    loop {
        // Also detects that the daemon is gone: a removed file never changes.
        let is_under_way = !client.status()?.state.is_over();
        let newest = newest(&reader)?;
        let is_none = newest.is_none();
        let mut is_last = was_under_way && !is_under_way;
        if let Some((picture, image)) = newest.filter(|(_, image)| drawn != Some(image.sequence)) {
            let first = drawn.replace(image.sequence).is_none();
            picture_file::write(output, &picture)?;
            tell(&image, output, printer)?;
            // The first image may be the result of an earlier run.
            is_last |= !first && image.metadata.get("last") == Some(&Value::Bool(true));
        }
        match follow {
            true if is_last => return Ok(Exit::Done),
            true => {}
            false if is_none => return Err(CommandFailure::NoLiveImage),
            false => return Ok(Exit::Done),
        }
        was_under_way |= is_under_way;
        thread::sleep(PACE);
    }
}

/// The newest picture, if there is one, and the last of its images.
fn newest(reader: &LiveReader) -> Result<Option<(Vec<u8>, LiveImage)>, CommandFailure> {
    if let Some((epipolar, indirect)) = pair(reader)? {
        return Ok(Some((side_by_side(epipolar, &indirect)?, indirect)));
    }
    let Some(batch) = reader.newest(FLOODLIT)? else { return Ok(None) };
    let picture = png(&scaled(&batch)?)?;
    Ok(Some((picture, batch)))
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

/// The image, with its brightest pixels at 1.
fn scaled(image: &LiveImage) -> Result<Array2<f32>, CommandFailure> {
    let image = image.image.view().into_dimensionality::<Ix2>();
    let image = image.map_err(|error| CommandFailure::Output(io::Error::other(error)))?;
    let ToneMap { white } = ToneMap::percentile(&[image], PERCENTILE);
    Ok(image.mapv(|light| light / white))
}

fn side_by_side(epipolar: LiveImage, indirect: &LiveImage) -> Result<Vec<u8>, CommandFailure> {
    let (left, right) = (scaled(&epipolar)?, scaled(indirect)?);
    let gap = Array2::zeros((left.nrows(), GAP_PX));
    let both = concatenate(Axis(1), &[left.view(), gap.view(), right.view()])
        .map_err(|error| CommandFailure::Output(io::Error::other(error)))?;
    png(&both)
}

fn png(image: &Array2<f32>) -> Result<Vec<u8>, CommandFailure> {
    let picture = Picture::grey(image.view(), ToneMap { white: 1.0 });
    Ok(picture.to_png().map_err(raysweep_processing::ProcessError::from)?)
}

fn tell(image: &LiveImage, output: &Path, printer: Printer) -> Result<(), CommandFailure> {
    let count = |key: &str| image.metadata.get(key).and_then(Value::as_u64);
    let (points, cycle, batch) = (count("points"), count("cycle"), count("batch"));
    let of = match (points, cycle, batch) {
        (_, Some(cycle), _) => format!("of cycle {cycle}"),
        (_, _, Some(batch)) => format!("of batch {batch}"),
        (points, ..) => format!("estimated from {} points", points.unwrap_or_default()),
    };
    let value = json!({
        "output": output, "sequence": image.sequence, "points": points, "cycle": cycle, "batch": batch,
    });
    printer.print(&value, |_| format!("{}: {of}", output.display()))?;
    io::stdout().flush().map_err(CommandFailure::Output)
}
