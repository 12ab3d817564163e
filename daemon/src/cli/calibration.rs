//! `raysweep calibration`: show, list, choose and compare calibrations.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};

use clap::Subcommand;
use raysweep_processing::calibration::{CalibratedAmbient, KeptCalibration, Pair};
use raysweep_proto::{CalibrationInfo, Client, Empty};
use serde_json::json;

use super::exit::Exit;
use super::failure::CommandFailure;
use super::folders::folder_of;
use super::printer::Printer;

/// The plan of `raysweep calibrate`.
pub(super) const PLAN: &str = "kind = \"calibration\"\n";

/// What to do with calibrations.
#[derive(Debug, Subcommand)]
pub(super) enum CalibrationCommand {
    /// Show a calibration
    Show {
        /// The session that measured it, or one that used it: its folder, or its name within the daemon's data folder
        /// [default: the calibration in use]
        session: Option<PathBuf>,
    },
    /// List the calibrations in the daemon's data folder, oldest first
    List,
    /// Make a session's calibration the one that later runs use
    Use {
        /// The session's folder, or its name within the daemon's data folder
        session: PathBuf,
    },
    /// Compare two calibrations; needs no daemon if their folders are given
    Compare {
        /// Session of the first: its folder, or its name within the daemon's data folder
        first: PathBuf,
        /// Session of the second
        second: PathBuf,
    },
}

/// Carries out a command.
pub(super) fn calibration(
    socket: &Path,
    command: CalibrationCommand,
    printer: Printer,
) -> Result<Exit, CommandFailure> {
    match command {
        CalibrationCommand::Show { session } => {
            let folder = match session {
                Some(session) => folder_of(session, socket)?,
                None => in_use(socket)?,
            };
            let kept = read(&folder)?;
            printer.print(&json!(kept.header), |_| shown(&kept))?;
        }
        CalibrationCommand::List => {
            printer.print(&Client::connect(socket)?.calibrations()?, |found| list(found))?;
        }
        CalibrationCommand::Use { session } => {
            let session = folder_of(session, socket)?;
            // The daemon's working directory is another: what exists here is named in full.
            let session = std::fs::canonicalize(&session).unwrap_or(session);
            Client::connect(socket)?.use_calibration(&session)?;
            let done = || format!("runs use the calibration of {} from now on", session.display());
            printer.print(&Empty {}, |_| done())?;
        }
        CalibrationCommand::Compare { first, second } => {
            let read = |session| read(&folder_of(session, socket)?);
            let difference = Comparison::new(&read(first)?, &read(second)?)?;
            printer.print(&difference.to_json(), |_| difference.to_string())?;
        }
    }
    Ok(Exit::Done)
}

/// Folder of the calibration in use.
fn in_use(socket: &Path) -> Result<PathBuf, CommandFailure> {
    let found = Client::connect(socket)?.calibrations()?;
    let none =
        "no calibration is in use: run `raysweep calibrate`, or choose one with `raysweep calibration use`";
    let in_use = found.into_iter().find(|info| info.in_use);
    in_use.map(|info| info.session).ok_or_else(|| CommandFailure::Calibration(none.into()))
}

fn read(folder: &Path) -> Result<KeptCalibration, CommandFailure> {
    KeptCalibration::read(folder).map_err(CommandFailure::Calibration)?.ok_or_else(|| {
        let what = "has no calibration.toml: give the folder of a session of kind \"calibration\", or of a run that used one";
        CommandFailure::Calibration(format!("{} {what}", folder.display()))
    })
}

fn list(found: &[CalibrationInfo]) -> String {
    if found.is_empty() {
        return "no calibrations: run `raysweep calibrate`".into();
    }
    let line = |info: &CalibrationInfo| {
        let mark = if info.in_use { "in use" } else { "" };
        let what = info.problem.as_deref().unwrap_or(&info.camera);
        format!("{mark:6}  {}  {what}", info.session.display())
    };
    found.iter().map(line).collect::<Vec<_>>().join("\n")
}

/// The figures of a calibration with their units and standard deviations.
fn figures(kept: &KeptCalibration) -> Vec<(&'static str, Pair)> {
    let (timing, light) = (&kept.header.timing, &kept.header.light);
    let width_rows = kept.arrays.response_width_rows();
    let width = light.response_width_sd.map(|share| [width_rows, share * width_rows]);
    let width = width.map(|width| ("width of the responses / rows", width));
    let figures = [
        ("projector row time / us", timing.row_time_us),
        ("camera row time / us", timing.camera_row_time_us),
        ("exposure offset / us", timing.exposure_offset_us),
        ("jitter of the light against the VSYNC edge / us", timing.jitter_us),
        ("white / DN", light.white_dn),
        ("gain / (e/DN)", light.electrons_per_dn),
        ("read noise / e", light.read_noise_e),
        ("PRNU", light.prnu),
    ];
    let curve =
        light.linearity_per_dn.map(|per_dn| ("curve: a of DN (1 + a DN) / 1e-6", per_dn.map(|it| it * 1e6)));
    figures.into_iter().chain(width).chain(curve).collect()
}

fn shown(kept: &KeptCalibration) -> String {
    let header = &kept.header;
    let valid_for = &header.valid_for;
    let [rows, columns] = valid_for.size;
    let [first, end] = header.timing.seen_rows;
    let mut text = format!(
        "made       {}\nsession    {}\ncamera     {}, {columns} x {rows} {}\nprojector  {} rows, of which {first} to {} are seen\n",
        header.made.strftime("%Y-%m-%d %H:%M UTC"),
        header.session,
        valid_for.camera,
        valid_for.pixel_format,
        valid_for.projector_rows,
        end.saturating_sub(1),
    );
    if let Some(drawing) = &header.drawing {
        text += &format!("rows       {}\n", drawing.text());
    }
    if let Some(of) = header.light.response_of {
        text += &format!("responses  {}\n", of.text());
    }
    for (name, pair) in figures(kept) {
        // Writing to a string does not fail.
        let _ = writeln!(text, "{name:NAME_WIDTH$} {}", with_error(pair));
    }
    let [_, latency_sd] = rounded([0.0, header.timing.latency_sd_us]);
    let clocks = "with the clocks of camera and VSYNC watcher as they were tied then";
    let _ = write!(text, "{:NAME_WIDTH$} known to {latency_sd} us, {clocks}", "latency");
    if let Some(dn) = header.light.saturation_dn {
        let _ = write!(text, "\n{:NAME_WIDTH$} {dn:.0}", "pixels saturate from / DN");
    }
    for (name, said) in header.ambient.iter().flat_map(CalibratedAmbient::lines) {
        let _ = write!(text, "\n{name:NAME_WIDTH$} {said}");
    }
    text
}

/// Width of the column of names: that of the longest.
const NAME_WIDTH: usize = 46;

/// A value with its standard deviation.
fn with_error(pair: Pair) -> String {
    let [value, sd] = rounded(pair);
    format!("{value} +- {sd}")
}

/// A value and its standard deviation, both up to the second digit of the latter.
fn rounded([value, sd]: Pair) -> [String; 2] {
    // Of a deviation that is not known, no digit tells anything; five of the value are enough.
    let is_known = sd > 0.0 && sd.is_finite();
    let decimals = if is_known { (1.0 - sd.log10().floor()).clamp(0.0, 12.0) as usize } else { 5 };
    [value, sd].map(|number| format!("{number:.decimals$}"))
}

/// Two calibrations of the same rig.
struct Comparison {
    /// First, second, and the difference in standard deviations.
    figures: Vec<(&'static str, f64, f64, f64)>,
    /// Mean and largest difference of the times of the rows that both see, the mean apart.
    rows_us: [f64; 2],
    /// Root mean square difference of places, in rows.
    place_rows: f64,
}

impl Comparison {
    fn new(first: &KeptCalibration, second: &KeptCalibration) -> Result<Self, CommandFailure> {
        let shape =
            |kept: &KeptCalibration| (kept.header.valid_for.size, kept.header.valid_for.projector_rows);
        if shape(first) != shape(second) {
            return Err(CommandFailure::Calibration(format!(
                "the calibrations are of different rigs: {:?} and {:?} camera rows and columns, {} and {} projector rows",
                first.header.valid_for.size,
                second.header.valid_for.size,
                first.header.valid_for.projector_rows,
                second.header.valid_for.projector_rows
            )));
        }
        let of_second: BTreeMap<&str, Pair> = figures(second).into_iter().collect();
        let figures = figures(first).into_iter().filter_map(|(name, [a, a_sd])| {
            let [b, b_sd] = of_second.get(name)?;
            Some((name, a, *b, (b - a) / a_sd.hypot(*b_sd)))
        });
        let seen = |kept: &KeptCalibration| kept.header.timing.seen_rows;
        let rows = seen(first)[0].max(seen(second)[0])..seen(first)[1].min(seen(second)[1]);
        let differences: Vec<f64> =
            rows.map(|row| second.arrays.row_starts_us[row] - first.arrays.row_starts_us[row]).collect();
        let mean_us = differences.iter().sum::<f64>() / differences.len().max(1) as f64;
        let most_us = differences.iter().fold(0.0, |most: f64, value| most.max((value - mean_us).abs()));
        let places = first.arrays.place.iter().zip(&second.arrays.place);
        let squares: f64 = places.map(|(a, b)| f64::from(b - a).powi(2)).sum();
        let place_rows = (squares / first.arrays.place.len().max(1) as f64).sqrt();
        Ok(Self { figures: figures.collect(), rows_us: [mean_us, most_us], place_rows })
    }

    fn to_json(&self) -> serde_json::Value {
        let figures = self.figures.iter().map(|(name, first, second, sds)| {
            json!({ "name": name, "first": first, "second": second, "standard_deviations": sds })
        });
        json!({
            "figures": figures.collect::<Vec<_>>(),
            "rows_mean_us": self.rows_us[0],
            "rows_most_us": self.rows_us[1],
            "place_rms_rows": self.place_rows,
        })
    }
}

impl std::fmt::Display for Comparison {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        writeln!(f, "{:NAME_WIDTH$} {:>12} {:>12} {:>12}", "", "first", "second", "difference")?;
        for (name, first, second, sds) in &self.figures {
            writeln!(f, "{name:NAME_WIDTH$} {first:12.5} {second:12.5} {sds:9.1} sd")?;
        }
        let [mean_us, most_us] = self.rows_us;
        writeln!(
            f,
            "rows are lit {mean_us:.3} us later on average; beside that, they differ by at most {most_us:.3} us"
        )?;
        write!(f, "places differ by {:.4} rows (root mean square)", self.place_rows)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn values_end_at_the_second_digit_of_their_errors() {
        assert_eq!(with_error([22.300_123_4, 0.000_123_4]), "22.30012 +- 0.00012");
        assert_eq!(with_error([2_503.456, 1.234]), "2503.5 +- 1.2");
        assert_eq!(with_error([2_503.456, 123.4]), "2503 +- 123");
        assert_eq!(with_error([0.25, 0.0]), "0.25000 +- 0.00000");
    }
}
